"""What a watch has seen so far, in a file, so that it goes on after it was killed."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from motor_env.console import ExitStatus
from motor_env.errors import InputError
from motor_env.files import write_text

_NO_FAULT = ("window healthy", "window unusable")


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
        content = {"offset": self.offset, "counts": dict(self.counts), "header": self.header}
        write_text(path, json.dumps(content))

    @property
    def exit_status(self) -> ExitStatus:
        """1: any fault; 3: a window that cannot be judged, or none; 0: all healthy."""
        if any(n for name, n in self.counts.items() if name.startswith("window ") and name not in _NO_FAULT):
            return ExitStatus.FAULT
        judged = self.counts["window healthy"] and not self.counts["window unusable"]
        return ExitStatus.HEALTHY if judged else ExitStatus.UNDECIDED
