"""`diagnose`: cut a recording into pieces, fit each, and decide against a data sheet or healthy pieces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.common.arrays import instance
from motor_env.common.errors import InputError, require_options
from motor_env.diagnosis.estimation.starts.start_fit import (
    NOT_TURNING,
    POOR_FIT,
    UNTOLD_LOG_SD,
    StartFit,
    is_blocked,
    ripple_quantities,
    shows_turning,
)
from motor_env.diagnosis.estimation.starts.start_identification import (
    EXTENSIONS,
    NUISANCES,
    behind_capacitor,
    identify,
    identify_best,
)
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.noise import explainable
from motor_env.diagnosis.readers.recording import (
    Recording,
    UnusableError,
    recording_of,
    without_lone_outliers,
)
from motor_env.diagnosis.readers.regime import RegimeDecision, taken_for
from motor_env.diagnosis.readers.start import Circuit, Start, chosen_starts, prepare
from motor_env.diagnosis.verdict import report_text
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE, decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, ReferenceShift, reference_of
from motor_env.diagnosis.verdict.hypotheses import alarm_share, compare
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, JudgedRecording, Judgement, Verdict
from motor_env.diagnosis.verdict.scaling_errors import SWAPPED, is_unlike_motor
from motor_env.diagnosis.verdict.sensor_diagnosis import (
    check_coupling,
    describe_coupling,
    diagnose_sensors,
    sensor_judgement,
)
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Motor, load_motor
from motor_env.motor.healthy import Healthy, Starts
from motor_env.motor.model import steady_state

_ANOTHER_ORDER = math.log(1.5)
_LEAST = 0.05  # of the voltage behind the brushes, and of the speed: lower bound for any motor file
_NOTHING = "there is nothing to compare with: give --motor or --healthy, or learn one by motor-env commission"
_PER_VOLT = (
    "the motor file was commissioned without a voltage, and this recording has one: leave it out"
    " (--column voltage=none, no --voltage), or commission with it"
)


@dataclass(frozen=True, slots=True)
class Diagnosis(JudgedRecording):
    """Verdict on a recording with its text, JSON and page.

    Attributes:
        recording: as read.
        taken: its regime, and why.
        pieces: judgements, in the order of time.
        of: number of pieces of the recording; of many only some are judged.
        periods_per_turn: of the commutation ripple, where known.
    """

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Quantities of the decisive piece: value, standard error, interval (95 %) and unit."""
        fit = self.decisive.fit
        return {} if fit is None else report_text.quantities_json(fit)

    def to_json(self) -> dict[str, Any]:
        """Return one JSON object; its schema is docs/output.schema.json."""
        return report_text.as_json(self)

    def __repr__(self) -> str:
        return self.text()

    def text(self, *, verbose: bool = False) -> str:
        """Describe the verdict for a maintenance engineer; `verbose` adds the quality of the fit."""
        return report_text.as_text(self, verbose=verbose)

    def page(self) -> str:
        """Draw a self-contained HTML page: verdict, first action and evidence."""
        from motor_env.diagnosis.verdict.report_page import page

        return page(self)


def diagnose(
    recording: Recording | str | Path,
    motor: Motor | str | Path | None = None,
    *,
    columns: Sequence[ColumnChoice] = (),
    voltage_v: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
    regime: str = "auto",
    start: int | None = None,
    periods_per_turn: float | None = None,
) -> Diagnosis:
    """Diagnose a recording: which fault, how large, how sure.

    Args:
        recording: as read, or its file.
        motor: data sheet, identified or commissioned motor, or its file, or the name of a catalogue motor.
        columns: columns named by the user, of a file.
        voltage_v: level of the supply if it was not recorded; by default the motor's nominal voltage.
        false_alarm_rate: per healthy recording.
        circuit: the measuring circuit.
        temperature_c: of the motor, where measured; used if that of the healthy pieces is known too.
        regime: start, operation, or auto: by the voltage and the motor's commissioning.
        start: which one, counted from 1, of a recording of several; all of them unless given.
        periods_per_turn: periods of the commutation ripple in a turn, for the true speed.

    Raises:
        InputError: an invalid option, no such start, or a file that cannot be read.
    """
    false_alarm_rate, start, temperature_c, voltage_v, periods_per_turn = require_options(
        false_alarm_rate=false_alarm_rate,
        start=start,
        temperature=temperature_c,
        voltage=voltage_v,
        ripple_periods_per_turn=periods_per_turn,
    )
    instance("motor", motor, (Motor, str, Path, NoneType))
    recording = recording_of(recording, columns)
    if isinstance(motor, str | Path):
        motor = load_motor(motor)
    if motor is not None and motor.kind == "data_sheet":
        recording = replace(recording, warnings=(*recording.warnings, *motor.notes))
    taken = taken_for(recording, regime, start)
    if regime == "auto" and start is None and _is_like_healthy_windows(recording, motor):
        taken = RegimeDecision("operation", "as its healthy recordings")
    known: dict[str, Any] = {"voltage_v": voltage_v, "circuit": circuit, "temperature_c": temperature_c}
    if taken.regime == "operation":
        recording = without_lone_outliers(recording)
        for option, value in (("start", start), ("sensor-lag", circuit and circuit.sensor_lag_s)):
            if value:
                raise InputError(
                    f"{recording.path}: --{option} belongs to starts, and this is a motor at work ({taken.why})"
                )
    elif voltage_v is None and motor is not None and not (motor.healthy and _is_per_volt(motor.healthy)):
        known["voltage_v"] = motor.nominal_voltage_v

    def judged(recording: Recording) -> Diagnosis:
        if taken.regime == "operation":
            from motor_env.diagnosis.operation.log_diagnosis import judge_log

            pieces, count = judge_log(recording, motor, false_alarm_rate, **known)
            return Diagnosis(recording, taken, tuple(pieces), count, periods_per_turn)
        parts = chosen_starts(recording, start)
        each = (judge_start(part, motor, false_alarm_rate / len(parts), **known).on(part) for part in parts)
        return Diagnosis(recording, taken, tuple(each), len(parts), periods_per_turn)

    diagnosis = judged(recording)
    if motor is not None and recording.voltage_v is not None and is_unlike_motor(diagnosis.decisive):
        lost = None if recording.missing is None else recording.missing[:, [1, 0, 2]]
        swapped = replace(
            recording, current_a=recording.voltage_v, voltage_v=recording.current_a, missing=lost
        )
        with suppress(InputError):
            again = judged(swapped)
            # One piece of many may be like this motor by chance.
            alike = sum(not is_unlike_motor(piece) for piece in again.pieces)
            if again.decisive.verdict not in (Verdict.OTHER, Verdict.SENSOR) and 2 * alike > len(
                again.pieces
            ):
                failure = sensor_judgement("swapped", SWAPPED)
                each = (
                    replace(failure, begin_s=piece.begin_s, duration_s=piece.duration_s)
                    for piece in diagnosis.pieces
                )
                return replace(diagnosis, pieces=tuple(each))
    return diagnosis


def _is_like_healthy_windows(recording: Recording, motor: Motor | None) -> bool:
    """Whether the motor was commissioned at work, and the recording fills a window."""
    windows = None if motor is None or motor.healthy is None else motor.healthy.windows
    return windows is not None and len(recording.time_s) >= round(windows.window_s / recording.dt_s)


def _is_per_volt(healthy: Healthy) -> bool:
    """Whether the motor was learned without a voltage."""
    return any("V" in name for name in healthy.quantities)


def judge_start(
    recording: Recording,
    motor: Motor | None,
    rate: float,
    *,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
) -> Judgement:
    """Judge one start, see `diagnose`."""
    constant = None if motor is None else float(np.mean(motor.parameters.torque_constant_n_m_per_a))
    if motor is not None and motor.guesses:
        with suppress(UnusableError):
            alone = identify_best(prepare(recording, voltage_v, circuit), NUISANCES, constant=constant)
            motor = motor.with_guesses_of(alone.parameters)
    failed = None if motor is None else diagnose_sensors(recording, motor, voltage_v, circuit)
    if failed is not None:
        return failed
    try:
        start = prepare(recording, voltage_v, circuit)
        reference = _reference(start, motor, temperature_c)
        typical = None if reference is None else reference.values
        if start.alignment.saturation:
            fit = identify(start, constant=constant)
        elif reference is None:
            fit = identify_best(start, EXTENSIONS, constant=constant)
        elif reference.model is None:
            fit = identify_best(start, NUISANCES, constant=constant, typical=typical)
        else:
            fit = identify(start, reference.model, constant=constant, typical=typical)
            fit = behind_capacitor(fit, constant=constant, typical=typical) or fit
    except UnusableError as error:
        return Judgement(Verdict.UNUSABLE, (str(error),))
    stands = reference is not None and is_blocked(fit, reference.time_constant_s)
    trouble = NOT_TURNING if stands else explain_unusable(fit)
    if trouble:
        return Judgement(Verdict.OTHER if stands else Verdict.UNUSABLE, (trouble,), fit=fit)
    reason = ""
    if reference is None:
        other = f"this recording determines {', '.join(fit.quantity_names)}, and the reference has other quantities"
        reason = _NOTHING if motor is None else other
    elif motor and motor.healthy and _is_per_volt(motor.healthy) and start.voltage_known:
        reason = _PER_VOLT
    if reference is None or reason:
        return Judgement(Verdict.NO_REFERENCE, (reason,), fit=fit)
    judgement = check_coupling(decide(fit, reference, rate), constant)
    if judgement.verdict.is_fault and not shows_turning(fit):
        return Judgement(
            Verdict.OTHER, (NOT_TURNING,), fit=fit, reference=reference, changes=judgement.changes
        )
    starts = None if motor is None or motor.healthy is None else motor.healthy.starts
    return judgement if starts is None else _add_ripple(judgement, fit, starts, rate)


def _add_ripple(judgement: Judgement, fit: StartFit, starts: Starts, rate: float) -> Judgement:
    """Add what the commutation ripple says of speed and K; the verdict stays."""
    ripple = ripple_quantities(fit)
    if ripple is None or not (starts.ripple_hz and starts.ripple_constant_v_s and starts.ripple_log_sd):
        return judgement
    logs = np.log(ripple) - np.log([starts.ripple_hz, starts.ripple_constant_v_s])
    if abs(float(logs[0])) > _ANOTHER_ORDER:
        return judgement  # another of the ripple's orders is the strongest now: nothing to compare
    freedom = 1.0 if judgement.reference is None else judgement.reference.degrees_of_freedom
    limit = -float(stdtrit(freedom, alarm_share(rate, fit.exponents)))
    names = ("speed", "K" if fit.start.voltage_known else "K/V")
    changes = compare(names, logs, np.eye(2) * starts.ripple_log_sd**2, freedom, limit, is_alarm=True)
    moved = [c for c in changes if c.significant]
    reasons = judgement.reasons
    if any(change.excludes_healthy for change in changes):
        reasons = tuple(reason.replace(NOTHING_ELSE, "") for reason in reasons)
    if moved and judgement.verdict.is_fault:
        words = " and ".join(
            f"{c.name} {'up' if c.ratio > 1.0 else 'down'} by {abs(c.ratio - 1.0):.0%}" for c in moved
        )
        reasons = (*reasons, f"the commutation ripple of {ripple[0]:.4g} Hz shows {words}")
    return replace(judgement, changes=(*judgement.changes, *changes), reasons=reasons)


def _reference(start: Start, motor: Motor | None, temperature_c: float | None) -> Reference | None:
    """Return the reference for a start; None without a motor."""
    if motor is None:
        return None
    names = identifiable.names(has_voltage=start.voltage_known, has_speed=start.speed_rad_s is not None)
    return reference_of(motor, names, temperature_c=temperature_c, shift=_reference_shift(start, motor))


def _reference_shift(start: Start, motor: Motor) -> ReferenceShift:
    """Return the shift of a start's linear fit from a motor file with brush drop, dry friction or a fan.

    Healthy starts include it already. Without a split of the sheet's friction, any dry share is equally likely.
    """
    windows = None if motor.healthy is None else motor.healthy.windows
    if not start.voltage_known or (motor.healthy is not None and windows is None):
        return ReferenceShift()
    driving = max(1.0 - motor.brush_drop_v / start.level_v, _LEAST)
    p, volts = motor.parameters, driving * start.level_v
    if windows is not None:
        from motor_env.diagnosis.operation.windows import viscous

        speed = float(steady_state(p, volts)[1])
        return ReferenceShift(
            driving, viscous(windows.physical, speed) / viscous(windows.physical, windows.speed_rad_s)
        )
    if motor.coulomb_friction_n_m > 0.0:
        speed = float(steady_state(p, volts, motor.coulomb_friction_n_m)[1])
        return ReferenceShift(
            driving, 1.0 + motor.dry_share(max(speed, _LEAST * float(steady_state(p, volts)[1])))
        )
    nominal = volts if motor.nominal_voltage_v is None else motor.nominal_voltage_v - motor.brush_drop_v
    all_dry = max(nominal, _LEAST * volts) / volts
    return ReferenceShift(driving, math.sqrt(all_dry), abs(math.log(all_dry)) / math.sqrt(12.0))


def explain_unusable(fit: StartFit) -> str | None:
    """Explain why a fit cannot carry a verdict; None if it can."""
    if fit.start.is_coupled:
        return describe_coupling(fit.start.sizes[-1])
    clipped = fit.start.alignment.saturation
    if clipped:
        return f"the recording is clipped, {clipped}"
    start = fit.start
    channels = (
        ("current", fit.r2_current, (start.current_a - start.ripple_a)[start.counted]),
        ("speed", fit.r2_speed, start.speed_rad_s),
    )
    for name, r2, shown in channels:
        least = POOR_FIT * (1.0 if shown is None else explainable(shown))
        if r2 is not None and r2 < least:
            return f"no motor model explains the {name} (R2 {r2:.2f}; at least {least:.2g} is needed)"
    deviations = np.sqrt(np.diag(fit.log_covariance))
    if deviations.min() > UNTOLD_LOG_SD:
        return (
            "the recording is too short or too noisy: every quantity is uncertain by a factor of 2.7 or more"
        )
    if deviations[0] > UNTOLD_LOG_SD:
        return f"no start is visible: {fit.quantity_names[0]} is uncertain by a factor of 2.7 or more"
    return None
