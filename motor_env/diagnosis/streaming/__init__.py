"""A motor watched while it works: where its lines come from, what is said of them.

Example:
    >>> from motor_env import watch
    >>> for event in watch("out/running.toml", "out/logs/today.csv"):  # doctest: +SKIP
    ...     print(event)
"""
