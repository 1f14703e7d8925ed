"""From log files to an identified motor: the steps of `motor-env identify` for a motor at work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motor_env.console import ExitStatus
from motor_env.errors import InputError
from motor_env.motor.data_sheet import MotorFile
from motor_env.operation import report
from motor_env.operation.identify import Operation, identify_operation
from motor_env.operation.record import at_terminals
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.regime import taken_for
from motor_env.recordings.start import Circuit


@dataclass(frozen=True, slots=True)
class Work:
    """Logs of one motor at work, and what came of them: a fit, or the sentence why there is none."""

    recordings: tuple[Recording, ...]
    reason: str
    found: Operation | None
    trouble: str = ""

    @property
    def paths(self) -> list[Path]:
        """The logs."""
        return [recording.path for recording in self.recordings]

    def motor(self, name: str) -> MotorFile:
        """Motor file.

        Raises:
            InputError: there is no fit, or it does not tell the parameters one by one.
        """
        if self.found is None:
            raise InputError(f"no motor file: {self.trouble}")
        return report.to_motor(self.found, name)

    def plot(self, folder: Path) -> None:
        """One picture of all logs."""
        if self.found is not None:
            name = self.paths[0].name
            report.plot_operation(self.found, name, folder / f"operation-{name.replace('.', '-')}.png")

    def as_text(self) -> list[str]:
        """Table, or the sentence."""
        if self.found is None:
            return [f"{', '.join(map(str, self.paths))}: unusable: {self.trouble}"]
        return [report.as_text(self.found, self.paths, self.reason)]

    def as_json(self) -> list[dict[str, Any]]:
        """The same as objects."""
        if self.found is None:
            files = [str(path) for path in self.paths]
            return [{"files": files, "regime": "operation", "verdict": "unusable", "reason": self.trouble}]
        return [report.as_json(self.found, self.paths, self.reason)]

    def exit_status(self) -> int:
        """0, or 3 where no motor explains the logs."""
        return int(ExitStatus.HEALTHY if self.found is not None else ExitStatus.UNDECIDED)


def sorted_files(
    files: Sequence[Path], columns: Sequence[ColumnChoice], *, regime: str, start: int | None
) -> tuple[list[tuple[Recording, str]], list[Recording]]:
    """Logs of a motor at work with the reason, and recordings of starts.

    Raises:
        InputError: an unknown regime, or a file that cannot be read.
    """
    works, starts = [], []
    for path in files:
        recording = read_recording(path, columns)
        taken = taken_for(recording, regime, start)
        if taken.regime == "start":
            starts.append(recording)
        else:
            works.append((recording, taken.why))
    return works, starts


def identify_logs(
    works: Sequence[tuple[Recording, str]], *, voltage_v: float | None = None, circuit: Circuit | None = None
) -> Work:
    """Fit one motor to all logs."""
    recordings = tuple(at_terminals(recording, voltage_v, circuit) for recording, _ in works)
    reason = "; ".join(dict.fromkeys(reason for _, reason in works))
    try:
        return Work(recordings, reason, identify_operation(recordings))
    except UnusableError as error:
        return Work(recordings, reason, None, str(error))
