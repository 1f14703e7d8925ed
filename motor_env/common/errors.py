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

from collections.abc import Sequence
from typing import Any

from motor_env.common.arrays import LARGEST_NUMBER, instance, number, real, shown, whole

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


def require_options(
    *,
    false_alarm_rate: float = 0.01,
    start: int | None = None,
    temperature: float | None = None,
    **positive: float | None,
) -> None:
    """Raise `InputError` unless the rate lies between 0 and 0.5, and the other options that are given are > 0."""
    if not 0.0 < (rate := _number("false-alarm-rate", false_alarm_rate)) < 0.5:
        raise InputError(f"false-alarm-rate must lie between 0 and 0.5, got {rate:g}")
    if start is not None:
        whole("start", start, least=-(2**63))  # how many there are, the recording tells
    if temperature is not None:
        number("temperature", temperature)
    for name, value in positive.items():
        if (
            value is not None
            and not 0.0 < (found := _number(name.replace("_", "-"), value)) <= LARGEST_NUMBER
        ):
            raise InputError(f"{name.replace('_', '-')} must be > 0, got {found:g}")


def require_several(name: str, given: Any, kinds: tuple[type, ...]) -> None:
    """Raise `InputError` or `TypeError` unless there is a list, not empty, of such."""
    if isinstance(given, str | bytes) or not isinstance(given, Sequence) or not given:
        raise InputError(f"{name} must be a list, and not empty, got {shown(given)}")
    for n, one in enumerate(given):
        instance(f"{name}[{n}]", one, kinds)


def _number(name: str, value: Any) -> float:
    return float(real(name, value, ()))
