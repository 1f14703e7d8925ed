"""`identify`: the parameters of a motor from recordings, whatever it did in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motor_env.diagnosis.diagnose import unusable_reason
from motor_env.diagnosis.motor_files import motor_of_log, not_told, to_motor
from motor_env.diagnosis.shown.report import (
    TWO_SIDED,
    estimate_json,
    extensions_json,
    quality,
    quantities_json,
    quantity_lines,
    ripple_json,
    ripple_lines,
    warnings_of,
)
from motor_env.errors import InputError, require_options, require_several
from motor_env.fitting.identify import Operation, identify_operation
from motor_env.fitting.recorded import at_terminals
from motor_env.fitting.starts.choice import EXTENSIONS, identify_best
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.starts.plausibility import implausible
from motor_env.motor.data_sheet import Motor
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, recording_of
from motor_env.recordings.regime import Taken, taken_for
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit, prepare

_HELD = {
    "held": "held until the next one",
    "straight": "on a straight line to the next one",
    "late": "held since the one before",
}
_WARM_K = 0.5


@dataclass(frozen=True, slots=True)
class Identification:
    """What recordings tell of a motor: a fit of each start, and one fit of all logs of the motor at work.

    Attributes:
        starts: each start with its fit.
        logs: recordings of the motor at work.
        taken: what the recordings, and the starts cut from them, were taken for, and why; by their paths.
        joint: the fit of the logs; None where there are none, or no motor explains them.
        trouble: why no motor explains the logs.
        periods_per_turn: of the commutation ripple, where known.
        constant: torque constant in N m/A, where known beforehand.
    """

    starts: tuple[tuple[Recording, Identified], ...]
    logs: tuple[Recording, ...]
    taken: Mapping[Path, Taken]
    joint: Operation | None = None
    trouble: str = ""
    periods_per_turn: float | None = None
    constant: float | None = None

    @property
    def usable(self) -> list[Identified]:
        """Fits of the starts that a motor explains."""
        return [fit for _, fit in self.starts if unusable_reason(fit) is None]

    @property
    def is_complete(self) -> bool:
        """Whether a motor explains all of it."""
        return len(self.usable) == len(self.starts) and not self.trouble

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Quantities with value, standard error, interval (95 %), unit: of the logs, else of the first good start."""
        if self.joint is not None:
            return _of_logs(self.joint)
        return quantities_json(self.usable[0]) if self.usable else {}

    def motor(self, name: str = "identified motor") -> Motor:
        """Motor of the logs, else of all good starts.

        Raises:
            InputError: no motor explains the recordings, or they do not tell the parameters one by one.
        """
        if self.joint is not None:
            return motor_of_log(self.joint, name)
        if not self.usable:
            raise InputError(f"no motor file: {self.trouble or 'no motor explains the starts'}")
        return to_motor(self.usable, name, constant=self.constant)

    def to_json(self) -> list[dict[str, Any]]:
        """One object a start, and one for all logs."""
        found = [self._start_json(recording, fit) for recording, fit in self.starts]
        return [*found, self._logs_json()] if self.logs else found

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Tables, and what is not told."""
        return "\n".join(map(_text, self.to_json()))

    def plot(self, folder: Path) -> None:
        """One picture a start, and one of all logs.

        Raises:
            InputError: a file cannot be written.
        """
        from motor_env.diagnosis.files import picture_of
        from motor_env.diagnosis.shown.pictures import plot_fit

        shown: list[tuple[Recording, Identified | Operation]] = [*self.starts]
        if self.joint is not None:
            shown.append((self.logs[0], self.joint))
        for place, (recording, fit) in enumerate(shown, 1):
            plot_fit(fit, recording.path.name, picture_of(recording.path, folder, place))

    def _start_json(self, recording: Recording, fit: Identified) -> dict[str, Any]:
        return {
            "files": [str(recording.path)],
            "taken_for": self.taken[recording.path]._asdict(),
            "unusable": unusable_reason(fit),
            "model": ["textbook", *fit.model],
            "parameters": quantities_json(fit) | extensions_json(fit),
            "correlations": fit.correlation.tolist(),
            "r2_current": fit.r2_current,
            "r2_speed": fit.r2_speed,
            "residual_autocorrelation": fit.lag_one,
            "commutation": ripple_json(fit, self.periods_per_turn),
            "onset_s": fit.onset_s,
            "offset_a": fit.offset_a,
            "columns": list(recording.columns),
            "defects": list(fit.defects),
            "not_told": not_told(fit),
            "warnings": warnings_of(recording, fit),
        }

    def _logs_json(self) -> dict[str, Any]:
        reasons = [self.taken[recording.path].why for recording in self.logs]
        head = {
            "files": [str(recording.path) for recording in self.logs],
            "taken_for": {"regime": "operation", "why": "; ".join(dict.fromkeys(reasons))},
            "unusable": self.trouble or None,
        }
        if self.joint is None:
            return head | {"parameters": {}, "warnings": []}
        return head | {
            "model": list(self.joint.model),
            "voltage": self.joint.record.hold,
            "parameters": _of_logs(self.joint),
            "r2_current": self.joint.r2_current,
            "r2_speed": self.joint.r2_speed,
            "warmth_k": float(self.joint.warmth_k.max()),
            "not_told": list(self.joint.notes),
            "columns": list(self.logs[0].columns),
            "warnings": [
                *(sentence for recording in self.logs for sentence in recording.warnings),
                *implausible(self.joint),
            ],
        }


def _text(told: Mapping[str, Any]) -> str:
    """One object of `to_json` for people."""
    files, rows = ", ".join(told["files"]), told["parameters"]
    if told["unusable"]:
        return f"{files}: unusable: {told['unusable']}"
    beside = {
        name: "{:.4g} to {:.4g}".format(*row["interval"]) if row.get("determined", True) else "not determined"
        for name, row in rows.items()
    }
    lines = [
        f"{files}: model {' + '.join(told['model'])}; 95 % intervals",
        f"  taken for {Taken(**told['taken_for'])}",
        "  read: " + "; ".join(told["columns"]),
        *quantity_lines(rows, beside),
    ]
    explained = f"  {quality(told['r2_current'], told['r2_speed'])}"
    if told["taken_for"]["regime"] == "operation":
        lines += [f"  the voltage of a sample is {_HELD[told['voltage']]}", explained]
        if told["warmth_k"] > _WARM_K:
            lines.append(f"  the winding warms by up to {told['warmth_k']:.0f} K")
    else:
        names = list(rows)
        pairs = [
            f"{names[i]} with {names[j]} {row[j]:+.2f}"
            for i, row in enumerate(told["correlations"])
            for j in range(i)
        ]
        lag = f"residual's autocorrelation at one sample {told['residual_autocorrelation']:.2f}"
        lines += ["  correlations: " + ", ".join(pairs), f"{explained}; {lag}"]
        lines += ripple_lines(told["commutation"])
    lines += [f"  warning: {sentence}" for sentence in told["warnings"]]
    lines += [f"  noticed: {defect}" for defect in told.get("defects", ())]
    return "\n".join([*lines, *(f"  note: {sentence}" for sentence in told["not_told"])])


def _of_logs(joint: Operation) -> dict[str, dict[str, Any]]:
    return {
        one.name: estimate_json(
            one.value, (one.high - one.low) / (2.0 * TWO_SIDED), (one.low, one.high), one.unit
        )
        | {"determined": one.is_told}
        for one in joint.quantities
    }


def identify(
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    *,
    columns: Sequence[ColumnChoice] = (),
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    regime: str = "auto",
    start: int | None = None,
    constant: float | None = None,
    periods_per_turn: float | None = None,
) -> Identification:
    """Parameters of one motor from recordings of it: each start alone, all logs of the motor at work together.

    Args:
        recordings: one or several, or their files.
        columns: columns named by the user, of files.
        voltage_v: level of the supply where none was recorded.
        circuit: what is known of the measuring circuit.
        regime: start, operation, or auto: decided by what the voltage does.
        start: which one, counted from 1, of a recording of several; all of them unless given.
        constant: torque constant in N m/A, where known and the speed was not recorded.
        periods_per_turn: of the commutation ripple, where known.

    Raises:
        InputError: one cannot be read, or holds no start; an option is not > 0.

    Example:
        >>> from motor_env import identify
        >>> found = identify("examples/startup_capture.csv")
        >>> print({name: float(f"{one['value']:.3g}") for name, one in found.parameters.items()})
        {'R': 2.18, 'L': 0.000238, 'K^2/J': 516.0, 'B/J': 1.48}
    """
    require_options(
        start=start, voltage=voltage_v, torque_constant=constant, ripple_periods_per_turn=periods_per_turn
    )
    several = [recordings] if isinstance(recordings, Recording | str | Path) else recordings
    require_several("recordings", several, (Recording, str, Path))
    read = [recording_of(one, columns) for one in several]
    taken = {one.path: taken_for(one, regime, start) for one in read}
    starts: list[tuple[Recording, Identified]] = []
    for one in read:
        if taken[one.path].regime == "operation":
            continue
        try:
            for part in chosen_starts(one, start):
                fit = identify_best(prepare(part, voltage_v, circuit), EXTENSIONS, constant=constant)
                starts.append((part, fit))
                taken[part.path] = taken[one.path]
        except UnusableError as error:
            raise InputError(f"{one.path}: {error}") from None
    at_work = tuple(
        at_terminals(one, voltage_v, circuit) for one in read if taken[one.path].regime == "operation"
    )
    joint, trouble = None, ""
    if at_work:
        try:
            joint = identify_operation(at_work)
        except UnusableError as error:
            trouble = str(error)
    return Identification(tuple(starts), at_work, taken, joint, trouble, periods_per_turn, constant)
