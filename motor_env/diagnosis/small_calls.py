"""What has the fits of starts and of logs compiled, with all that judges them: one small simulated one each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.identification import identify
from motor_env.motor.model import State
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray
from motor_env.recordings.recording import Recording
from motor_env.simulation.simulate import simulate_states

_LEVEL_V, _STEP_S, _NOISE = 12.0, 1e-3, np.array([0.02, 0.5])


def _recorded(voltage_v: FloatArray) -> Recording:
    """What a scope shows of the paper's motor."""
    time_s: FloatArray = _STEP_S * np.arange(len(voltage_v), dtype=np.float64)
    states = simulate_states(PAPER_MOTOR, voltage_v, _STEP_S)
    states = states + np.random.default_rng(0).normal(size=states.shape) * _NOISE
    return Recording(Path("warm-up"), time_s, states[:, State.CURRENT], voltage_v, states[:, State.SPEED])


def _starts() -> None:
    start = _recorded(np.repeat([0.0, _LEVEL_V], [50, 250]))
    diagnose(replace(start, speed_rad_s=None), "paper")


def _logs() -> None:
    identify(_recorded(np.repeat([_LEVEL_V, -_LEVEL_V, 4.0, 8.0, 2.0, -6.0], 60)), regime="operation")


CALLS: dict[str, Callable[[], None]] = {"starts": _starts, "logs of a motor at work": _logs}
