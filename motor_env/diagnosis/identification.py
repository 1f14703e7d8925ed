"""`identify`: parameters of a motor from recordings of starts and of logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motor_env.common.errors import InputError, require_options, require_several
from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.estimation.operation_fit import OperationFit, identify_operation
from motor_env.diagnosis.estimation.preprocessing import at_terminals
from motor_env.diagnosis.estimation.starts.start_fit import StartFit, implausible
from motor_env.diagnosis.estimation.starts.start_identification import EXTENSIONS, identify_best
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import Recording, UnusableError, recording_of
from motor_env.diagnosis.readers.regime import RegimeDecision, taken_for
from motor_env.diagnosis.readers.start import Circuit, chosen_starts, prepare
from motor_env.diagnosis.verdict.healthy_motor import describe_undetermined, motor_of_log, to_motor
from motor_env.diagnosis.verdict.report_text import (
    TWO_SIDED,
    describe_r2,
    estimate_json,
    extensions_json,
    quantities_json,
    quantity_lines,
    ripple_json,
    ripple_lines,
    warnings_of,
)
from motor_env.motor.data_sheet import Motor

_HELD = {
    "held": "held until the next one",
    "straight": "on a straight line to the next one",
    "late": "held since the one before",
}


@dataclass(frozen=True, slots=True)
class Identification:
    """Fits of recordings of a motor: of each start, and of all logs together.

    Attributes:
        starts: each start with its fit.
        logs: recordings of the motor at work.
        taken: regime of recordings and starts, and why, by path.
        joint: the fit of the logs; None without logs, or if no motor explains them.
        trouble: why no motor explains the logs.
        periods_per_turn: of the commutation ripple, where known.
        constant: torque constant in N m/A, where known beforehand.
    """

    starts: tuple[tuple[Recording, StartFit], ...]
    logs: tuple[Recording, ...]
    taken: Mapping[Path, RegimeDecision]
    joint: OperationFit | None = None
    trouble: str = ""
    periods_per_turn: float | None = None
    constant: float | None = None

    @property
    def usable(self) -> list[StartFit]:
        """Fits of the starts that a motor explains."""
        return [fit for _, fit in self.starts if explain_unusable(fit) is None]

    @property
    def is_complete(self) -> bool:
        """Whether a motor explains all starts and the logs."""
        return len(self.usable) == len(self.starts) and not self.trouble

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, standard error, 95 % interval and unit of each quantity, of the logs, else the first good start."""
        if self.joint is not None:
            return _log_quantities(self.joint)
        return quantities_json(self.usable[0]) if self.usable else {}

    def motor(self, name: str = "identified motor") -> Motor:
        """Return the motor of the logs, else of all good starts.

        Raises:
            InputError: the recordings do not determine each parameter.
        """
        if self.joint is not None:
            return motor_of_log(self.joint, name)
        if not self.usable:
            raise InputError(f"no motor file: {self.trouble or 'no motor explains the starts'}")
        return to_motor(self.usable, name, constant=self.constant)

    def to_json(self) -> list[dict[str, Any]]:
        """Return one object a start, and one for all logs."""
        starts = [self._start_json(recording, fit) for recording, fit in self.starts]
        return [*starts, self._logs_json()] if self.logs else starts

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Describe the fits in tables, and what is not determined."""
        return "\n".join(map(_text, self.to_json()))

    def page(self) -> str:
        """Draw a self-contained HTML page: measured beside fitted current and speed."""
        from motor_env.diagnosis.verdict.report_page import page_of_fits

        fits: dict[str, StartFit | OperationFit] = {
            f"{recording.path.name}, start {number}": fit
            for number, (recording, fit) in enumerate(self.starts, 1)
        }
        if self.joint is not None:
            fits[", ".join(recording.path.name for recording in self.logs)] = self.joint
        return page_of_fits("Fits of the recordings", fits)

    def _start_json(self, recording: Recording, fit: StartFit) -> dict[str, Any]:
        return {
            "files": [str(recording.path)],
            "taken_for": self.taken[recording.path]._asdict(),
            "unusable": explain_unusable(fit),
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
            "not_told": describe_undetermined(fit),
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
            "parameters": _log_quantities(self.joint),
            "r2_current": self.joint.r2_current,
            "r2_speed": self.joint.r2_speed,
            "not_told": list(self.joint.notes),
            "columns": list(self.logs[0].columns),
            "warnings": [
                *(sentence for recording in self.logs for sentence in recording.warnings),
                *implausible(self.joint),
            ],
        }


def _text(fields: Mapping[str, Any]) -> str:
    """Format one object of `to_json` for people."""
    files, rows = ", ".join(fields["files"]), fields["parameters"]
    if fields["unusable"]:
        return f"{files}: unusable: {fields['unusable']}"
    beside = {
        name: "{:.4g} to {:.4g}".format(*row["interval"]) if row.get("determined", True) else "not determined"
        for name, row in rows.items()
    }
    lines = [
        f"{files}: model {' + '.join(fields['model'])}; 95 % intervals",
        f"  taken for {RegimeDecision(**fields['taken_for'])}",
        "  read: " + "; ".join(fields["columns"]),
        *quantity_lines(rows, beside),
    ]
    explained = f"  {describe_r2(fields['r2_current'], fields['r2_speed'])}"
    if fields["taken_for"]["regime"] == "operation":
        lines += [f"  the voltage of a sample is {_HELD[fields['voltage']]}", explained]
    else:
        names = list(rows)
        pairs = [
            f"{names[i]} with {names[j]} {row[j]:+.2f}"
            for i, row in enumerate(fields["correlations"])
            for j in range(i)
        ]
        lag = f"residual's autocorrelation at one sample {fields['residual_autocorrelation']:.2f}"
        lines += ["  correlations: " + ", ".join(pairs), f"{explained}; {lag}"]
        lines += ripple_lines(fields["commutation"])
    lines += [f"  warning: {sentence}" for sentence in fields["warnings"]]
    lines += [f"  noticed: {defect}" for defect in fields.get("defects", ())]
    return "\n".join([*lines, *(f"  note: {sentence}" for sentence in fields["not_told"])])


def _log_quantities(joint: OperationFit) -> dict[str, dict[str, Any]]:
    return {
        q.name: estimate_json(q.value, (q.high - q.low) / (2.0 * TWO_SIDED), (q.low, q.high), q.unit)
        | {"determined": q.is_determined}
        for q in joint.quantities
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
    """Identify the parameters of a motor from each start alone and from all logs together.

    Args:
        recordings: one or several, or their files.
        columns: columns named by the user, of files.
        voltage_v: level of the supply where none was recorded.
        circuit: the measuring circuit.
        regime: start, operation, or auto: decided by what the voltage does.
        start: which one, counted from 1, of several; by default all.
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
    start, voltage_v, constant, periods_per_turn = require_options(
        start=start, voltage=voltage_v, torque_constant=constant, ripple_periods_per_turn=periods_per_turn
    )
    several = [recordings] if isinstance(recordings, Recording | str | Path) else recordings
    require_several("recordings", several, (Recording, str, Path))
    read = [recording_of(each, columns) for each in several]
    taken = {recording.path: taken_for(recording, regime, start) for recording in read}
    starts: list[tuple[Recording, StartFit]] = []
    for recording in read:
        if taken[recording.path].regime == "operation":
            continue
        try:
            for part in chosen_starts(recording, start):
                fit = identify_best(prepare(part, voltage_v, circuit), EXTENSIONS, constant=constant)
                starts.append((part, fit))
                taken[part.path] = taken[recording.path]
        except UnusableError as error:
            raise InputError(f"{recording.path}: {error}") from None
    at_work = tuple(
        at_terminals(recording, voltage_v, circuit)
        for recording in read
        if taken[recording.path].regime == "operation"
    )
    joint, trouble = None, ""
    if at_work:
        try:
            joint = identify_operation(at_work)
        except UnusableError as error:
            trouble = str(error)
    return Identification(tuple(starts), at_work, taken, joint, trouble, periods_per_turn, constant)
