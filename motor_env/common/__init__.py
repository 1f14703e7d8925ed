"""Shared tools: checks of arguments, errors, files, the console, HTML pages and plots.

Begin at `arrays` (checks of a caller's values) and `errors` (messages to users).

Example:
    A wrong option is one clear sentence, and a `ValueError` like any other.

    >>> from motor_env import InputError, load_motor
    >>> try:
    ...     load_motor("no_such_file.toml")
    ... except InputError as error:
    ...     print(isinstance(error, ValueError))
    True
"""
