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

import math
from collections.abc import Sequence
from typing import Any

from motor_env.common.arrays import LARGEST_NUMBER, instance, real, shown, whole

_LEAST = 1e-300  # what is smaller is 0 to a fit
_LONGEST = 1000  # characters: a value of a stranger's file may have thousands


class InputError(ValueError):
    """Unusable input; the message is the sentence for the user, one line of bounded length."""

    def __init__(self, sentence: str) -> None:
        line = " ".join(sentence.splitlines())  # a name in a stranger's file may have several
        super().__init__(line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ...")


class UnknownOptionError(TypeError, ValueError):
    """Unknown option: bad input to a user, an unexpected keyword to libraries."""


def require_extra(module: str, extra: str) -> None:
    """Raise `InputError` unless the module of an optional extra is installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(f"this needs {module}, which is not installed: pip install 'motor-env[{extra}]'")


def require_options(**options: Any) -> list[Any]:
    """Return the options in their order, as plain numbers; None stays.

    Raises:
        InputError: a false-alarm rate not between 0 and 0.5, or another option not > 0 (`start` and `temperature` may
            be).
    """
    found: list[Any] = []
    for name, value in options.items():
        word, plain = name.replace("_", "-"), value
        if name == "start" and value is not None:
            plain = whole("start", value, least=-(2**63))  # how many there are, the recording tells
        elif value is not None or name == "false_alarm_rate":
            plain = value if isinstance(value, float) else float(real(word, value, ()))
            wanted, low, high = "be > 0", _LEAST, LARGEST_NUMBER
            if name == "false_alarm_rate":
                wanted, high = "lie between 0 and 0.5", math.nextafter(0.5, 0.0)
            elif name == "temperature":
                wanted, low = "be finite", -LARGEST_NUMBER
            if not low <= plain <= high:
                raise InputError(f"{word} must {wanted}, got {plain:g}")
        found.append(plain)
    return found


def require_several(name: str, given: Any, kinds: tuple[type, ...]) -> None:
    """Raise `InputError` or `TypeError` unless there is a non-empty list of these kinds."""
    if isinstance(given, str | bytes) or not isinstance(given, Sequence) or not given:
        raise InputError(f"{name} must be a list, and not empty, got {shown(given)}")
    for n, one in enumerate(given):
        instance(f"{name}[{n}]", one, kinds)
