"""From a recording to its verdict: prepare, fit, filter, and decide against a data sheet or healthy starts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE, Diagnosis, Verdict, decide
from motor_env.diagnosis.explanations import compare, significance_limit
from motor_env.diagnosis.filter_check import filter_check
from motor_env.diagnosis.healthy_motor import Reference, reference_from_motor, reference_from_starts
from motor_env.identification.commutation import ripple_quantities
from motor_env.identification.identify import Identified, identify
from motor_env.identification.model_choice import EXTENSIONS, NUISANCES, identify_best
from motor_env.motor import identifiable as quantities
from motor_env.motor.data_sheet import MotorFile, StartReference
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording
from motor_env.recordings.regime import refuse_work
from motor_env.recordings.start import Circuit, Start, prepare

_POOR_FIT = 0.75
_ANOTHER_ORDER = math.log(1.5)


def diagnose(
    recording: Recording,
    motor: MotorFile | None = None,
    learned: StartReference | None = None,
    *,
    voltage_v: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
) -> Diagnosis:
    """Fit, filter, compare, decide.

    Args:
        recording: as read.
        motor: data sheet, identified or commissioned motor.
        learned: what healthy recordings taught; it comes before the motor.
        voltage_v: level of the supply where the recording has none; the motor's nominal voltage otherwise.
        false_alarm_rate: per healthy recording.
        circuit: what is known of the measuring circuit.
        temperature_c: of the motor, where measured; it counts where that of the healthy starts is known too.
    """
    if voltage_v is None and motor is not None and motor.reference is None:
        voltage_v = motor.nominal_voltage_v
    constant = None if motor is None else float(np.mean(motor.parameters.torque_constant_n_m_per_a))
    try:
        if learned is not None or (motor is not None and motor.reference is not None):
            refuse_work(recording)
        start = prepare(recording, voltage_v, circuit)
        reference = _reference(start, motor, learned, temperature_c)
        typical = None if reference is None else reference.values
        if start.alignment.saturation:
            fit = identify(start, constant=constant)
        elif reference is None:
            fit = identify_best(start, EXTENSIONS, constant=constant)
        elif reference.model is None:
            fit = identify_best(start, NUISANCES, constant=constant, typical=typical)
        else:
            fit = identify(start, reference.model, constant=constant, typical=typical)
    except UnusableError as error:
        return Diagnosis(recording, Verdict.UNUSABLE, (str(error),))
    check = filter_check(fit)
    trouble = unusable_reason(fit)
    if trouble:
        return Diagnosis(recording, Verdict.UNUSABLE, (trouble,), identified=fit, filter_check=check)
    if reference is None:
        given = motor is not None or learned is not None
        reason = (
            f"this recording tells {', '.join(fit.quantity_names)}, and the reference speaks of other quantities"
            if given
            else "there is nothing to compare with: give a motor file or healthy recordings"
        )
        return Diagnosis(recording, Verdict.NO_REFERENCE, (reason,), identified=fit, filter_check=check)
    diagnosis = decide(recording, fit, reference, check, false_alarm_rate)
    starts = learned or (None if motor is None else motor.reference)
    return diagnosis if starts is None else _with_ripple(diagnosis, fit, starts, false_alarm_rate)


def _with_ripple(diagnosis: Diagnosis, fit: Identified, starts: StartReference, rate: float) -> Diagnosis:
    """What the commutation ripple says of speed and K, beside the verdict: it takes no part in it."""
    ripple = ripple_quantities(fit)
    if ripple is None or not (starts.ripple_hz and starts.ripple_constant_v_s and starts.ripple_log_sd):
        return diagnosis
    logs = np.log(ripple) - np.log([starts.ripple_hz, starts.ripple_constant_v_s])
    if abs(float(logs[0])) > _ANOTHER_ORDER:
        return diagnosis  # another of the ripple's orders is the strongest now: nothing to compare
    freedom = starts.degrees_of_freedom
    limit = significance_limit(rate, fit.exponents, freedom)
    names = ("speed", "K" if fit.start.voltage_known else "K/V")
    changes = compare(names, logs, np.eye(2) * starts.ripple_log_sd**2, freedom, limit)
    moved = [c for c in changes if c.significant]
    reasons = diagnosis.reasons
    if moved and diagnosis.verdict.is_fault:
        words = " and ".join(
            f"{c.name} {'up' if c.ratio > 1.0 else 'down'} by {abs(c.ratio - 1.0):.0%}" for c in moved
        )
        reasons = (*reasons, f"the commutation ripple of {ripple[0]:.4g} Hz shows {words}")
    return replace(diagnosis, changes=(*diagnosis.changes, *changes), reasons=reasons)


def _reference(
    start: Start, motor: MotorFile | None, learned: StartReference | None, temperature_c: float | None
) -> Reference | None:
    """What there is to compare a start with."""
    which = {"has_voltage": start.voltage_known, "has_speed": start.speed_rad_s is not None}
    if learned is not None:
        return reference_from_starts(learned, quantities.names(**which), "this motor", temperature_c)
    if motor is None:
        return None
    return reference_from_motor(motor, **which, temperature_c=temperature_c)


def unusable_reason(fit: Identified) -> str | None:
    """Why a fit cannot carry a verdict; None where it can."""
    clipped = fit.start.alignment.saturation
    if clipped:
        return f"the recording is clipped, {clipped}"
    if fit.r2_current < _POOR_FIT:
        return (
            f"no motor model explains the current (R2 {fit.r2_current:.2f}; at least {_POOR_FIT} is needed)"
        )
    if fit.r2_speed is not None and fit.r2_speed < _POOR_FIT:
        return f"no motor model explains the speed (R2 {fit.r2_speed:.2f}; at least {_POOR_FIT} is needed)"
    worst = float(np.sqrt(np.diag(fit.log_covariance)).min())
    if worst > 1.0:
        return "the recording is too short or too noisy: no quantity is known to a factor of e"
    return None
