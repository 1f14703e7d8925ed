"""A log of a motor at work: its windows against the healthy motor."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.healthy_motor import NORMAL_DOF
from motor_env.diagnosis.hypotheses import EXPONENTS, NAMES, Difference
from motor_env.diagnosis.running.lessons import effective_speed, known_of
from motor_env.diagnosis.running.unlearned import judge_for
from motor_env.diagnosis.running.windows import WindowJudge, viscous
from motor_env.diagnosis.scaling_errors import (
    BEYOND_WEAR,
    EXPLAINED,
    describe_scaling_errors,
    find_scaling_errors,
    is_far_from_healthy,
)
from motor_env.diagnosis.sensors.sensor_diagnosis import diagnose_sensors
from motor_env.diagnosis.verdict import Judgement, Verdict
from motor_env.fitting import places
from motor_env.fitting.identify import identify_record
from motor_env.fitting.recorded import at_terminals, from_recordings
from motor_env.motor.data_sheet import Motor
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording
from motor_env.recordings.start import Circuit

_COARSE = (0.1, 0.1, 0.1, 0.5)  # of the logarithms of R, K, J and the drag
_CLEAR = 3.0
_NOTHING = "there is nothing to compare with: give a motor file, or commission one from healthy logs"


def judge_log(
    recording: Recording,
    motor: Motor | None,
    rate: float,
    *,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
) -> tuple[list[Judgement], int]:
    """Judgements on its windows, and how many it has; one judgement on the whole where it cannot be cut."""
    whole = at_terminals(recording, voltage_v, circuit)
    if motor is None:
        return [Judgement(Verdict.NO_REFERENCE, (_NOTHING,)).on(whole)], 1
    failed = diagnose_sensors(whole, motor, voltage_v, at_work=True)
    if failed is not None:
        return [failed], 1
    try:
        judge = judge_for(whole, motor, temperature_c)
        judged, count = judge.judge(whole, rate)
        if any(is_far_from_healthy(one) for one in judged):
            judged = _as_a_whole(judged, whole, judge)
        if all(one.verdict is Verdict.UNUSABLE for one in judged):
            from_recordings([whole])  # may say why
    except UnusableError as error:
        return [Judgement(Verdict.UNUSABLE, (str(error),)).on(whole)], 1
    return judged, count


def _as_a_whole(judged: list[Judgement], whole: Recording, judge: WindowJudge) -> list[Judgement]:
    """Judgements on a log that is far from the healthy motor, from which its windows are fitted: is it read wrongly?

    A fit of the whole log begins anywhere. No wrong scale is told closer than to some percent, and friction that is
    not viscous goes by another power.
    """
    with suppress(UnusableError):
        joint = identify_record(from_recordings([whole]))
        physical = known_of(joint.solution)
        drag = viscous(physical, effective_speed(joint))
        logs = np.log([*physical[[places.R, places.K, places.J]], drag])
        spread = judge.reference.log_covariance + np.diag(np.square(_COARSE))
        difference = Difference(logs - judge.reference.log_values, spread, EXPONENTS, NORMAL_DOF)
        misread = describe_scaling_errors(
            find_scaling_errors(difference, NAMES, _CLEAR, DEFAULT_FALSE_ALARM_RATE)
        )
        if misread:
            return [_misread(one, misread) if one.verdict.is_fault else one for one in judged]
    return judged


def _misread(judgement: Judgement, misread: str) -> Judgement:
    """A judgement of a window, with what the whole log says instead of what its own fit did."""
    own = (one for one in judgement.reasons if one != BEYOND_WEAR and not one.startswith(EXPLAINED))
    return judgement.as_other(misread, *own)
