"""What an agent of the drive chooses, and what the compiled step is told of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.envs.drive.options import Control
from motor_env.envs.single import finite_action, whole_action, whole_actions
from motor_env.motor.parameters import FloatArray

RUN, LIMP, STOP = -1.0, 0.25, 1.0
"""Second entry of a command, whose first is the voltage in units of its limit."""
DECISIONS = np.array([RUN, LIMP, STOP])


def _width(control: Control) -> int:
    return 2 if control is Control.VOLTAGE_AND_DECISION else 3


def action_space(control: Control) -> spaces.Space[Any]:
    """Actions of one sub-environment."""
    if control is Control.DECISION:
        return spaces.Discrete(len(DECISIONS))
    return spaces.Box(-1.0, 1.0, (_width(control),), dtype=np.float32)


def command(control: Control, action: Any) -> FloatArray:
    """Command of the one lane of a single environment, shape (1, 2).

    Raises:
        ValueError: there is no such action.
    """
    if control is Control.DECISION:
        return _decided(np.array([whole_action(action, len(DECISIONS))]))
    shape = (
        (2,) if control is Control.VOLTAGE_AND_DECISION else (3,)
    )  # `_width` would cost a hundredth of a step
    return _from_numbers(finite_action(action, shape)[None])


def commands(control: Control, actions: Any, count: int) -> FloatArray:
    """Commands of many lanes, shape (count, 2).

    Raises:
        ValueError: there are no such actions.
    """
    if control is Control.DECISION:
        whole = whole_actions(actions, count, len(DECISIONS))
        if ((whole < 0) | (whole >= len(DECISIONS))).any():
            raise ValueError(
                f"actions must be in 0 .. {len(DECISIONS) - 1}, got {whole.min()} .. {whole.max()}"
            )
        return _decided(whole)
    return _from_numbers(finite_action(actions, (count, _width(control))))


def as_actions(control: Control, given: FloatArray) -> NDArray[Any]:
    """The actions that give these commands, whose decisions are RUN, LIMP or STOP."""
    volts, decision = given.T
    if control is Control.DECISION:
        return np.array(np.searchsorted(DECISIONS, decision))
    if control is Control.VOLTAGE_LIMP_STOP:
        return np.stack([volts, np.sign(decision), np.where(decision == STOP, 1.0, -1.0)], axis=1)
    return given


def _decided(which: NDArray[np.int64]) -> FloatArray:
    return np.stack([np.zeros(len(which)), DECISIONS[which]], axis=1)


def _from_numbers(given: FloatArray) -> FloatArray:
    """Voltage and decision; of three numbers the third stops, the second limps."""
    if given.shape[1] == 2:
        return given
    decision = np.where(given[:, 2] > 0.5, STOP, np.where(given[:, 1] > 0.0, LIMP, RUN))
    return np.stack([given[:, 0], decision], axis=1)
