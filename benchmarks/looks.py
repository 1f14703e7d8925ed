"""What a look at a motor tells of one class of fault: how much, and where the voltage brings the motor.

Two hypotheses with a known signature: a look moves the log-odds of the fault by N(+-information / 2, information), +
with a fault. The information is the sum of the squares of the mean whitened innovations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from motor_env.envs.policies.fault_posterior import N_HYPOTHESIS, sample_model, step_of
from motor_env.envs.setup import Setup
from motor_env.motor.compiled import njit
from motor_env.motor.model import State
from motor_env.motor.parameters import FloatArray, require

LOG_ODDS = np.linspace(-14.0, 14.0, 141)
PROBABILITY = expit(LOG_ODDS)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(25)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@njit(cache=True, error_model="numpy")
def look_matrix(information: float) -> FloatArray:
    """Matrix that makes of values by the log-odds after a look those expected before it.

    Between the places of the grid values are linear in the probability: too large where they are convex in it.
    """
    spread, step, last = math.sqrt(information), LOG_ODDS[1] - LOG_ODDS[0], len(LOG_ODDS) - 1
    matrix = np.zeros((last + 1, last + 1))
    for m in range(last + 1):
        for q in range(len(_NODES)):
            for sign in (-1.0, 1.0):
                odds = LOG_ODDS[m] + sign * 0.5 * information + spread * _NODES[q]
                odds = min(max(odds, LOG_ODDS[0]), LOG_ODDS[last])
                low = min(int((odds - LOG_ODDS[0]) / step), last - 1)
                at = (1.0 / (1.0 + math.exp(-odds)) - PROBABILITY[low]) / (
                    PROBABILITY[low + 1] - PROBABILITY[low]
                )
                weight = _WEIGHTS[q] * (PROBABILITY[m] if sign > 0.0 else 1.0 - PROBABILITY[m])
                matrix[m, low] += weight * (1.0 - at)
                matrix[m, low + 1] += weight * at
    return matrix


class Looks(NamedTuple):
    """What a step of a probed motor shows of one class, and where it brings the motor.

    The place is the speed's distance from its rest, as a voltage, and how far the fault has moved the speed. The
    current follows within a step.

    Attributes:
        information: quadratic form on (place, last offset, offset, 1): summed squares of the mean innovations, (5, 5).
        move: new place from (place, last offset, offset, 1), shape (2, 5).
        reach: largest size of the two, shape (2,).
    """

    information: FloatArray
    move: FloatArray
    reach: FloatArray


def looks(setup: Setup, which: int) -> Looks:
    """Information and movement of a class, read off its linear model along a random probe.

    Raises:
        ValueError: the current does not settle within a step, so that the place says too little.
    """
    n, offsets = setup.options.samples_per_step, np.unique(setup.offsets_v)
    samples = [sample_model(setup, which)] * n
    rows, _ = step_of(samples)
    healthy, _ = step_of([sample_model(setup, None)] * n)
    volts = float(np.asarray(setup.options.task.motor.back_emf_constant_v_s_per_rad))
    rng = np.random.default_rng(0)
    state, path, last = np.zeros(N_HYPOTHESIS), np.zeros(N_HYPOTHESIS), 0.0
    inputs, means, places = [], [], []
    for offset in rng.choice(offsets, 400):
        place = (path[State.SPEED] * volts, (state[State.SPEED] - path[State.SPEED]) * volts)
        inputs.append((*place, last, offset, 1.0))
        at, shown = np.array([*state, offset, 1.0]), np.empty(n)
        for k, sample in enumerate(samples):
            moved = sample @ at
            at[:N_HYPOTHESIS], shown[k] = moved[:N_HYPOTHESIS], moved[N_HYPOTHESIS]
        means.append(shown)
        state, path, last = rows @ [*state, offset, 1.0], healthy @ [*path, offset, 1.0], offset
        places.append((path[State.SPEED] * volts, (state[State.SPEED] - path[State.SPEED]) * volts))
    x, y, z = np.array(inputs), np.array(means), np.array(places)
    row, move = np.linalg.lstsq(x, y, rcond=None)[0], np.linalg.lstsq(x, z, rcond=None)[0]
    error = float(np.linalg.norm(y - x @ row) / np.linalg.norm(y))
    require(
        error < 0.02, f"a step must be long enough for the current to settle, got an error of {error:.1%}"
    )
    return Looks(row @ row.T, move.T, np.abs(z).max(axis=0))
