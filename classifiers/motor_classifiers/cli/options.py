"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path

from motor_env.common.errors import InputError
from motor_env.common.files import replacing


def numbers(option: str, text: str | None) -> tuple[float, ...]:
    """Numbers with commas between, none twice; empty where the option was not given.

    Raises:
        InputError: something else.
    """
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--{option} must be numbers with commas between, got {text!r}") from None
    if len(set(values)) != len(values):
        raise InputError(f"--{option} must not name a value twice, got {text!r}")
    return values


def whole_numbers(option: str, text: str) -> list[int]:
    """Whole numbers with commas between, none twice."""
    values = numbers(option, text)
    if not all(value.is_integer() for value in values):
        raise InputError(f"--{option} must be whole numbers, got {text!r}")
    return list(map(int, values))


def require_writable(out: Path) -> None:
    """Fail before the work, not after it.

    Raises:
        InputError: a file of this name.
        OSError: nothing can be written there.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, not a folder")
    probe = out / ".writable"
    with replacing(probe):
        pass
    probe.unlink()
