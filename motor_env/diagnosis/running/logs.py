"""Files of a running motor: `commission --window` and `diagnose` with a motor commissioned by windows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.console import ExitStatus
from motor_env.diagnosis.files import picture_of, why_not
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.running.windows import NAMES, WindowVerdict, judge_windows
from motor_env.errors import InputError
from motor_env.motor.data_sheet import MotorFile, WindowReference
from motor_env.operation.record import at_terminals, from_recordings
from motor_env.operation.report import motor_of
from motor_env.plotting import COLOUR, drawing, save, subplots
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import read_recording
from motor_env.recordings.start import Circuit

_SHOWN = {"R": "R", "K": "K", "J": "J", "B": "friction"}


@dataclass(frozen=True, slots=True)
class RunningRecord:
    """One log of a running motor: its judged windows out of so many (`of`), or why it cannot be judged."""

    path: Path
    windows: tuple[WindowVerdict, ...]
    of: int = 0
    trouble: str = ""
    unreadable: bool = False
    is_bug: bool = False

    @property
    def verdict(self) -> str:
        """Of the record as a whole: the most frequent alarm of its windows."""
        if self.trouble:
            return "unusable"
        alarms = Counter(w.verdict for w in self.windows if w.verdict not in ("healthy", "unusable"))
        if alarms:
            return alarms.most_common(1)[0][0]
        judged = any(w.verdict == "healthy" for w in self.windows)
        return "healthy" if judged else "unusable"

    def as_text(self) -> str:
        """A line for the record and one for each window."""
        lines = [f"{self.path}: {self.verdict}" + (f" ({self.trouble})" if self.trouble else "")]
        if len(self.windows) < self.of:
            lines.append(
                f"  {len(self.windows)} of {self.of} windows are judged: some evenly spread, and the oddest"
            )
        for window in self.windows:
            moved = ", ".join(f"{_SHOWN[c.name]} {c.ratio - 1.0:+.1%}" for c in window.changes)
            lines.append(f"  from {window.begin_s:.6g} s: {window.verdict}; {moved}")
        return "\n".join(lines)

    def as_json(self) -> dict[str, Any]:
        """The same as one object."""
        return {
            "file": str(self.path),
            "verdict": self.verdict,
            "reason": self.trouble or None,
            "windows_of_record": self.of,
            "windows": [
                {
                    "begin_s": window.begin_s,
                    "verdict": window.verdict,
                    "changes": {
                        _SHOWN[c.name]: {"ratio": c.ratio, "interval": [c.low, c.high]}
                        for c in window.changes
                    },
                }
                for window in self.windows
            ],
        }

    def plot(self, path: Path) -> None:
        """Each quantity over time with its interval and the alarms.

        Raises:
            InputError: the file cannot be written.
        """
        windows = [window for window in self.windows if window.changes]
        if not windows:
            return
        time_s = np.array([window.begin_s for window in windows])
        with drawing():
            figure, axes = subplots(len(NAMES), height_in=2.0 * len(NAMES))
            for n, (axis, name) in enumerate(zip(axes, NAMES, strict=True)):
                changes = [window.changes[n] for window in windows]
                ratio = np.array([c.ratio for c in changes])
                band = np.abs(np.array([[c.low, c.high] for c in changes]).T - ratio)
                for is_alarm, colour in ((False, COLOUR["healthy"]), (True, COLOUR["other"])):
                    some = np.array([(window.verdict != "healthy") == is_alarm for window in windows])
                    axis.errorbar(time_s[some], ratio[some], band[:, some], fmt="o", color=colour)
                axis.axhline(1.0, color=COLOUR["threshold"], linewidth=1.0)
                axis.set_ylabel(_SHOWN[name])
            axes[0].set_title(f"{self.path.name}: {self.verdict}")
            axes[-1].set_xlabel("begin of the window (s)")
            figure.align_ylabels()
            save(figure, path)


def commission_running(
    files: Sequence[Path],
    window_s: float,
    name: str,
    *,
    columns: Sequence[ColumnChoice] = (),
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    steady: bool = False,
) -> MotorFile:
    """Learn a motor from windows of its logs.

    Args:
        files: logs of the healthy motor at work.
        window_s: length of a window.
        name: of the motor.
        columns: columns named by the user.
        voltage_v: supply, for a voltage that was recorded as a duty cycle.
        circuit: what is known of the measuring circuit.
        steady: nothing but a fault moves the motor.

    Raises:
        InputError: a log cannot be read, or they cannot be used.
    """
    if not 0.0 < window_s < math.inf:
        raise InputError(f"window must be > 0, got {window_s:g}")
    recordings = [at_terminals(read_recording(path, columns), voltage_v, circuit) for path in files]
    try:
        reference = learn_windows(recordings, window_s, steady=steady)
    except UnusableError as error:
        raise InputError(f"the logs cannot be used: {error}") from None
    return commissioned(reference, name)


def commissioned(reference: WindowReference, name: str) -> MotorFile:
    """The motor that windows have taught."""
    return replace(motor_of(reference.physical, name, "commissioned"), operation=reference)


def commissioned_text(reference: WindowReference, rate: float) -> str:
    """What was learned, with the interval of the next healthy window."""
    half = -float(stdtrit(reference.degrees_of_freedom, rate / 2.0))
    lines = [
        f"{reference.windows} healthy windows of {reference.window_s:g} s; the next one lies within ({1 - rate:.0%})"
    ]
    for n, name in enumerate(NAMES):
        width = half * math.sqrt(reference.log_covariance[n, n])
        value = "" if name == "B" else f" {reference.values[n]:.4g}"
        lines.append(
            f"  {_SHOWN[name]:<10}{value} {math.exp(-width) - 1.0:+.1%} to {math.exp(width) - 1.0:+.1%}"
        )
    if reference.temperature_k:
        lines.append(f"  and another temperature, by {reference.temperature_k:.0f} K (1 sd), is healthy too")
    return "\n".join(lines)


def diagnose_running(
    files: Sequence[Path],
    motor: MotorFile,
    rate: float,
    out: Path | None,
    *,
    columns: Sequence[ColumnChoice] = (),
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
) -> list[RunningRecord]:
    """Judge logs by windows; one that cannot be read or judged does not stop the others."""
    records = []
    for number, path in enumerate(files, 1):
        try:
            if motor.operation is None:
                raise InputError(f"{path}: the motor was not commissioned with --window")
            recording = at_terminals(read_recording(path, columns), voltage_v, circuit)
            windows = tuple(judge_windows(recording, motor.operation, rate))
            if all(window.verdict == "unusable" for window in windows):
                from_recordings([recording])  # may say why
                raise UnusableError("no motor explains any of its windows")
            duration_s = len(recording.time_s) * recording.dt_s
            record = RunningRecord(path, windows, int(duration_s / motor.operation.window_s + 1e-6))
        except UnusableError as error:
            record = RunningRecord(path, (), trouble=str(error))
        except Exception as error:  # noqa: BLE001  # whatever it is, it is said, and the others keep their verdicts
            sentence, is_bug = why_not(path, error)
            record = RunningRecord(path, (), trouble=sentence, unreadable=True, is_bug=is_bug)
        if out is not None:
            record.plot(picture_of(path, out, number))
        records.append(record)
    return records


def exit_status(records: Sequence[RunningRecord]) -> int:
    """0: all healthy; 1: any fault; 2: a log that cannot be read; 3: no fault, but some undecided; 70: a bug."""
    if any(record.is_bug for record in records):
        return int(ExitStatus.BUG)
    if any(record.unreadable for record in records):
        return int(ExitStatus.BAD_INPUT)
    verdicts = {record.verdict for record in records}
    if verdicts - {"healthy", "unusable"}:
        return int(ExitStatus.FAULT)
    return int(ExitStatus.UNDECIDED if "unusable" in verdicts else ExitStatus.HEALTHY)
