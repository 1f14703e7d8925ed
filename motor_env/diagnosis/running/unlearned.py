"""Windows of a log whose motor was not commissioned at work: by its data sheet, or by its healthy starts."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.healthy_motor import ReferenceShift, reference_of
from motor_env.diagnosis.hypotheses import NAMES
from motor_env.diagnosis.running.drives import NEEDED, needed_columns
from motor_env.diagnosis.running.lessons import (
    effective_speed,
    known_of,
    told_by,
    turns_one_way,
    window_length_s,
)
from motor_env.diagnosis.running.windows import WindowJudge, judge_of, viscous, windows_of
from motor_env.fitting.identify import identify_record
from motor_env.fitting.record import STRETCHES, Record
from motor_env.fitting.recorded import from_recordings
from motor_env.fitting.window import LOAD
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Windows
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording

_WINDOWS = 10  # of a log
_SHORTEST = 40.0  # a window: mechanical time constants
_SETTLED, _FEW = 20.0, 2_000  # a stretch: mechanical time constants; samples of all stretches


def judge_for(recording: Recording, motor: Motor, temperature_c: float | None = None) -> WindowJudge:
    """What judges the windows of a log.

    A motor that was commissioned by windows says so itself. Any other motor's file tells R, K, J and the drag at one
    speed. The terms, the hold of the voltage and how the drag divides into viscous and dry friction then come from a
    fit of stretches of the log.

    Raises:
        UnusableError: no current and speed, or no motor explains the log.
    """
    if motor.healthy is not None and motor.healthy.windows is not None:
        return judge_of(motor.healthy, motor.name, temperature_c)
    needed_columns(recording)  # refuses at once what the fit of the whole log would take long to find
    settles_s = float(np.mean(motor.parameters.mechanical_time_constant_s))
    joint = identify_record(_enough(from_recordings([recording]), settles_s))
    if not joint.record.seen.all():
        raise UnusableError(NEEDED)
    window_s, speed = window_length_s([recording], _WINDOWS, _SHORTEST * settles_s), effective_speed(joint)
    physical, terms = known_of(joint.solution), joint.solution.names
    if set(LOAD) & set(terms):
        records = []
        for part in windows_of(recording, window_s)[:_WINDOWS]:
            with suppress(UnusableError):  # as at rest
                records.append(replace(from_recordings([part]), hold=joint.record.hold))
        if records:
            physical, terms, _ = told_by(records, joint)
    reference = reference_of(
        motor,
        NAMES,
        are_starts=False,
        temperature_c=temperature_c,
        shift=ReferenceShift(friction=_friction(motor, physical, speed)),
    )
    if reference is None or reference.names != NAMES:
        raise UnusableError(
            f"{motor.name} does not tell {', '.join(NAMES)}, which a motor at work is judged by"
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
    """Stretches of a record in which a motor settles: they tell the terms and how the drag divides."""
    samples = max(_FEW, STRETCHES * math.ceil(_SETTLED * settles_s / record.dt_s))
    return record.sample(samples) if samples < len(record.voltage_v) else record


def _friction(motor: Motor, physical: FloatArray, speed_rad_s: float) -> float:
    """Drag over the speed in this log, over the friction of the motor's file, for the same healthy motor.

    The file's friction is that at the no-load speed. Between two speeds the drag divides as in the log.
    """
    p = motor.parameters
    if motor.nominal_voltage_v is None:
        return 1.0
    no_load = float(steady_state(p, motor.nominal_voltage_v)[1])
    return (1.0 + motor.dry_share(no_load)) * viscous(physical, speed_rad_s) / viscous(physical, no_load)
