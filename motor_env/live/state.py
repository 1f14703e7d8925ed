"""What a watch has seen so far, in a file, so that it goes on after it was killed."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from motor_env.console import ExitStatus, worst
from motor_env.diagnosis.verdict import Verdict
from motor_env.errors import InputError
from motor_env.files import write_text

WINDOW = "window "
"""How the counts of verdicts on windows are named: this, and the verdict."""


@dataclass
class State:
    """What has been seen so far.

    Attributes:
        offset: bytes of the growing file that are judged.
        counts: verdicts of windows and kinds of other events.
        header: line that names the columns.
    """

    offset: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    header: str = ""

    @classmethod
    def load(cls, path: Path | None) -> State:
        """From its file; new where there is none.

        Raises:
            InputError: the file is no state of this command.
        """
        if path is None or not path.exists():
            return cls()
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(int(content["offset"]), Counter(content["counts"]), str(content["header"]))
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path}: is no state of watch; give another file") from None

    def save(self, path: Path) -> None:
        """Write it whole."""
        write_text(path, json.dumps(vars(self)))

    @property
    def exit_status(self) -> ExitStatus:
        """Of the verdicts on windows; undecided where there is none."""
        return worst(
            Verdict(name.removeprefix(WINDOW)).status
            for name, n in self.counts.items()
            if n and name.startswith(WINDOW)
        )
