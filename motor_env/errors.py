"""Errors that become one sentence and exit status 2 on the command line.

Example:
    >>> from motor_env import InputError, load_motor
    >>> try:
    ...     load_motor("none.toml")
    ... except InputError as error:
    ...     print(error)
    none.toml: no such motor file; presets are paper, paper-matrices
"""

from __future__ import annotations

_LONGEST = 1000  # characters: a value of a stranger's file may have thousands


class InputError(ValueError):
    """Input that cannot be used; the message is the sentence that the user reads, one line of bounded length."""

    def __init__(self, sentence: str) -> None:
        line = " ".join(sentence.splitlines())  # a name in a stranger's file may have several
        super().__init__(line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ...")


class UnknownOptionError(TypeError, ValueError):
    """An option that does not exist: a bad value to its user, an unexpected keyword to libraries that try one."""


def require_extra(module: str, extra: str) -> None:
    """Raise `InputError` unless the module of an optional extra is installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(f"this needs {module}, which is not installed: pip install 'motor-env[{extra}]'")


def require_options(*, false_alarm_rate: float = 0.01, **positive: float | None) -> None:
    """Raise `InputError` unless the rate lies between 0 and 0.5, and the other options that are given are > 0."""
    if not 0.0 < false_alarm_rate < 0.5:
        raise InputError(f"false-alarm-rate must lie between 0 and 0.5, got {false_alarm_rate:g}")
    for name, value in positive.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise InputError(f"{name.replace('_', '-')} must be > 0, got {value:g}")
