"""Diagnose a log of a motor at work by its windows.

A motor that was not commissioned at work is compared with its data sheet or healthy starts.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import LOAD, identify_record
from motor_env.diagnosis.estimation.preprocessing import at_terminals, from_recordings
from motor_env.diagnosis.estimation.record import STRETCHES, Record
from motor_env.diagnosis.operation.window_baseline import (
    choose_window_terms,
    effective_speed,
    turns_one_way,
    window_length_s,
)
from motor_env.diagnosis.operation.windows import (
    NEEDED,
    WindowJudge,
    judge_of,
    needed_columns,
    viscous,
    windows_of,
)
from motor_env.diagnosis.readers.recording import Recording, UnusableError, cut
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.verdict.healthy_motor import NORMAL_DOF, ReferenceShift, reference_of
from motor_env.diagnosis.verdict.hypotheses import EXPONENTS, NAMES, Difference
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.scaling_errors import (
    BEYOND_WEAR,
    EXPLAINED,
    describe_scaling_errors,
    find_scaling_errors,
    is_far_from_healthy,
)
from motor_env.diagnosis.verdict.sensor_diagnosis import diagnose_sensors
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Windows
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray

_COARSE = (0.1, 0.1, 0.1, 0.5)  # of the logarithms of R, K, J and the drag
_CLEAR = 3.0
_NOTHING = (
    "there is nothing to compare with: give a motor file, or learn one from healthy logs: motor-env commission log1.csv"
    " log2.csv -o motor.toml"
)
_WINDOWS = 10  # of a log
_SHORTEST = 40.0  # a window: mechanical time constants
_SETTLED, _FEW = 20.0, 2_000  # a stretch: mechanical time constants; samples of all stretches


def judge_log(
    recording: Recording,
    motor: Motor | None,
    rate: float,
    *,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
) -> tuple[list[Judgement], int]:
    """Judge the windows of a log, or the whole if it has none; return also the number of windows."""
    whole = _until_read(at_terminals(recording, voltage_v, circuit))
    if motor is None:
        return [Judgement(Verdict.NO_REFERENCE, (_NOTHING,)).on(whole)], 1
    failed = None if motor.guesses else diagnose_sensors(whole, motor, voltage_v, at_work=True)
    if failed is not None:
        return [failed], 1
    try:
        judge = judge_for(whole, motor, temperature_c)
        judged, count = judge.judge(whole, rate)
        if any(is_far_from_healthy(judgement) for judgement in judged):
            judged = _as_a_whole(judged, whole, judge)
        if all(judgement.verdict is Verdict.UNUSABLE for judgement in judged):
            from_recordings([whole])  # may raise the reason
    except UnusableError as error:
        return [Judgement(Verdict.UNUSABLE, (str(error),)).on(whole)], 1
    return judged, count


def _until_read(recording: Recording) -> Recording:
    """Return a log up to the last sample of current and speed, as padding looks like a stuck sensor."""
    missing = np.zeros((1, 3)) if recording.missing is None else recording.missing
    read = np.flatnonzero(~missing[:, 1:].any(axis=1))
    return (
        cut(recording, slice(int(read[-1]) + 1)) if recording.missing is not None and len(read) else recording
    )


def _as_a_whole(judged: list[Judgement], whole: Recording, judge: WindowJudge) -> list[Judgement]:
    """Check a log far from the healthy motor for a wrong scale, by a fit of the whole.

    Fits of windows start at the healthy motor, that of the whole log anywhere.
    """
    with suppress(UnusableError):
        joint = identify_record(from_recordings([whole]))
        physical = joint.solution.values
        drag = viscous(physical, effective_speed(joint))
        logs = np.log([*physical[[index.R, index.K, index.J]], drag])
        spread = judge.reference.log_covariance + np.diag(np.square(_COARSE))
        difference = Difference(logs - judge.reference.log_values, spread, EXPONENTS, NORMAL_DOF)
        scaling = describe_scaling_errors(
            find_scaling_errors(difference, NAMES, _CLEAR, DEFAULT_FALSE_ALARM_RATE)
        )
        if scaling:
            return [
                _misread(judgement, scaling) if judgement.verdict.is_fault else judgement
                for judgement in judged
            ]
    return judged


def _misread(judgement: Judgement, scaling: str) -> Judgement:
    own = (
        reason for reason in judgement.reasons if reason != BEYOND_WEAR and not reason.startswith(EXPLAINED)
    )
    return judgement.as_other(scaling, *own)


def judge_for(recording: Recording, motor: Motor, temperature_c: float | None = None) -> WindowJudge:
    """Make the judge of the windows of a log.

    Without commissioned windows, R, K, J and the drag at one speed come from the motor file; terms, voltage hold and
    shares of friction from a fit of stretches of the log.

    Raises:
        UnusableError: no current or speed, or no motor explains the log.
    """
    if motor.healthy is not None and motor.healthy.windows is not None:
        return judge_of(motor.healthy, motor.name, temperature_c)
    needed_columns(recording)  # refuse before the slow fit of the whole log
    settles_s = float(np.mean(motor.parameters.mechanical_time_constant_s))
    record = replace(from_recordings([recording]), brush_drop_v=motor.brush_drop_v)
    joint = identify_record(_enough(record, settles_s))
    if not joint.record.recorded.all():
        raise UnusableError(NEEDED)
    window_s, speed = window_length_s([recording], _WINDOWS, _SHORTEST * settles_s), effective_speed(joint)
    physical, terms = joint.solution.values, joint.solution.names
    if set(LOAD) & set(terms):
        records = []
        for part in windows_of(recording, window_s)[:_WINDOWS]:
            with suppress(UnusableError):  # as at rest
                records.append(replace(from_recordings([part]), hold=joint.record.hold))
        if records:
            physical, terms, _ = choose_window_terms(records, joint)
    own = {"inertia_kg_m2": physical[index.J], "viscous_friction_n_m_s_per_rad": viscous(physical, speed)}
    reference = reference_of(
        motor.with_guesses_of(replace(motor.parameters, **own)),
        NAMES,
        are_starts=False,
        temperature_c=temperature_c,
        shift=ReferenceShift(friction=_friction_scale(motor, physical, speed)),
    )
    if reference is None or reference.names != NAMES:
        raise UnusableError(
            f"{motor.name} does not give {', '.join(NAMES)}, by which a motor at work is judged"
        )
    windows = Windows(
        window_s=window_s,
        terms=terms,
        physical=physical,
        hold=joint.record.hold,
        dt_s=recording.dt_s,
        speed_rad_s=speed,
        one_way=turns_one_way(joint),
    )
    return WindowJudge(windows, reference)


def _enough(record: Record, settles_s: float) -> Record:
    samples = max(_FEW, STRETCHES * math.ceil(_SETTLED * settles_s / record.dt_s))
    return record.sample(samples) if samples < len(record.voltage_v) else record


def _friction_scale(motor: Motor, physical: FloatArray, speed_rad_s: float) -> float:
    """Divide the healthy motor's drag over the speed in this log by the friction of its file.

    The file's friction is that at the no-load speed.
    """
    p = motor.parameters
    if motor.nominal_voltage_v is None:
        return 1.0
    no_load = float(steady_state(p, motor.nominal_voltage_v)[1])
    return (1.0 + motor.dry_share(no_load)) * viscous(physical, speed_rad_s) / viscous(physical, no_load)
