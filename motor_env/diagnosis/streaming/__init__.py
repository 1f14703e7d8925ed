"""Watch a motor at work: read lines from a source, judge windows of them, keep the state.

Begin at `watch.Watch`.

Example:
    >>> from motor_env import watch
    >>> for event in watch("out/running.toml", "out/logs/today.csv"):  # doctest: +SKIP
    ...     print(event)
"""
