"""Keep the state of a watch in a file, to continue it later."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Self

import numpy as np

from motor_env.common.console import ExitStatus, worst
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_TABLE_BYTES, read_json, write_text
from motor_env.diagnosis.streaming.sources import BLOCK_BYTES
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.parameters import require
from motor_env.motor.toml_files import from_dict

WINDOW = "window "
"""Prefix of the counts of verdicts on windows."""


@dataclass
class State:
    """State of a watch.

    Attributes:
        motor: digest of the motor file; empty while the motor is being learned.
        source: of the lines, without a password.
        offset: judged bytes of the file.
        last_read: the last of these bytes as Latin-1, to identify the file.
        counts: of verdicts on windows and of other events.
        header: line that names the columns.
        memory: evidence against the healthy motor, see `SequentialMonitor.state_dict`.
    """

    motor: str = ""
    source: str = ""
    offset: int = 0
    last_read: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    header: str = ""
    memory: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(
            0 <= self.offset < 2**63 and min(self.counts.values(), default=0) >= 0,
            "offset and counts must be >= 0, and a file as long as the offset",
        )
        require(
            len(self.last_read) == min(self.offset, BLOCK_BYTES)
            and max(self.last_read, default="") <= "\xff",
            f"last_read must be the last {BLOCK_BYTES} of the offset's bytes",
        )
        require(
            bool(np.isfinite([value for row in self.memory.values() for value in row]).all()),
            "memory must be finite numbers",
        )
        for name in self.counts:
            if name.startswith(WINDOW):
                Verdict(name.removeprefix(WINDOW))

    @classmethod
    def load(cls, path: Path | None, motor: str, source: str) -> Self:
        """Read a state from its file; a new one without a file.

        Raises:
            InputError: no state, or one of another motor or source.
        """
        if path is None or not path.exists():
            return cls(motor, source)
        try:
            content = read_json(path, LARGEST_TABLE_BYTES)
            names = [field.name for field in fields(cls)]
            require(
                isinstance(content, dict) and sorted(content) == sorted(names),
                f"it must hold {', '.join(names)} and nothing else",
            )
            state = from_dict(cls, content, "the state")
        except InputError:
            raise
        except (ValueError, TypeError, RecursionError) as error:
            reason = "nested too deep" if isinstance(error, RecursionError) else error
            raise InputError(f"{path}: is no state of watch ({reason}); give another file") from None
        for what, saved, current in (("motor file", state.motor, motor), ("source", state.source, source)):
            if saved != current:
                detail = (
                    f", {saved[:200]!r}, and not of {current!r}" if what == "source" else " than this one"
                )
                raise InputError(f"{path}: is the state of another {what}{detail}; give another --state")
        return state

    def save(self, path: Path) -> None:
        """Write the state atomically."""
        write_text(path, json.dumps(vars(self)))

    def advance(self, line: bytes) -> None:
        """Count judged bytes."""
        self.offset += len(line)
        self.last_read = (self.last_read + line[-BLOCK_BYTES:].decode("latin-1"))[-BLOCK_BYTES:]

    def begin(self) -> None:
        """Reset the place, for a new file."""
        self.offset, self.last_read = 0, ""

    @property
    def exit_status(self) -> ExitStatus:
        """Exit status by the verdicts on windows; undecided without one."""
        return worst(
            Verdict(name.removeprefix(WINDOW)).status
            for name, n in self.counts.items()
            if n and name.startswith(WINDOW)
        )
