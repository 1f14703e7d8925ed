"""Which motor a file is of: machine, place of the motor in it, and repeat, read from its name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from motor_env.errors import InputError

_GROUPS = ("machine", "motor", "repeat")


class Place(NamedTuple):
    """Machine, motor and repeat whose record a file is.

    Attributes:
        machine: that the motor is part of.
        motor: its place in the machine, such as left or right; empty where machines have one motor each.
    """

    machine: str
    motor: str = ""

    @property
    def name(self) -> str:
        """Both, as tables show it."""
        return f"{self.machine} {self.motor}".strip()


def places_of(files: Sequence[Path], group: str | None) -> list[Place]:
    """Machine and motor of each file.

    Args:
        files: recordings.
        group: regular expression that is searched in each file's name, without its ending. Its named groups machine,
            motor and repeat tell machine, place of the motor and repeat; without it each file is a machine of its own.

    Raises:
        InputError: no regular expression, one without these groups, or a name that it does not match.
    """
    if group is None:
        return [Place(path.stem) for path in files]
    try:
        pattern = re.compile(group)
    except re.error as error:
        raise InputError(f"--group must be a regular expression, got {group!r} ({error})") from None
    known = set(pattern.groupindex)
    if not known or known - set(_GROUPS):
        raise InputError(f"--group must have named groups of {', '.join(_GROUPS)}, got {sorted(known)}")
    if not known & {"machine", "motor"}:
        raise InputError("--group must have a group machine or motor: a repeat alone tells no motor")
    found = []
    for path in files:
        match = pattern.search(path.stem)
        if match is None:
            raise InputError(f"{path}: --group {group!r} does not match its name")
        parts = match.groupdict(default="")
        # Motors without machines are machines of one motor each.
        machine = parts.get("machine") or parts.get("motor", "")
        found.append(Place(machine, parts.get("motor", "") if "machine" in known else ""))
    return found
