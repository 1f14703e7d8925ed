"""What both wings use: checks of arguments, errors, files, the console, HTML pages and plots.

It never knows of a motor. Begin at `arrays` (what a caller gives) and `errors` (what a user is told).

Example:
    A wrong option is one clear sentence, and a `ValueError` like any other.

    >>> from motor_env import InputError, load_motor
    >>> try:
    ...     load_motor("no_such_file.toml")
    ... except InputError as error:
    ...     print(isinstance(error, ValueError))
    True
"""
