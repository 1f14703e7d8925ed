"""A log of a motor at work: its windows against the healthy motor."""

from __future__ import annotations

from motor_env.diagnosis.running.unlearned import judge_for
from motor_env.diagnosis.verdict import Judgement, Verdict
from motor_env.fitting.recorded import at_terminals, from_recordings
from motor_env.motor.data_sheet import Motor
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording
from motor_env.recordings.start import Circuit

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
    try:
        judged, count = judge_for(whole, motor, temperature_c).judge(whole, rate)
        if all(one.verdict is Verdict.UNUSABLE for one in judged):
            from_recordings([whole])  # may say why
    except UnusableError as error:
        return [Judgement(Verdict.UNUSABLE, (str(error),)).on(whole)], 1
    return judged, count
