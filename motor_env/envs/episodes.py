"""The drawing of episodes: what is true of a motor and its fault, as the compiled step takes it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import kernel
from motor_env.envs.noise import case_of
from motor_env.envs.options import MonitorOptions, Start
from motor_env.envs.setup import Setup, drift
from motor_env.motor.faults import HEALTHY, Fault, FaultKind, NoiseSource, apply_faults, noise_variance_factor
from motor_env.motor.model import Input, discretize, steady_state
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipes import Draw, draw


class Episodes(NamedTuple):
    """Drawn episodes: the truth.

    Attributes:
        records: for each its head (onset in samples, number of the verdict that is right, 0 for none, supply factor,
            initial state, what the initial estimate lacks), then the motor at each level of its fault, shape (n,
            HEAD_LENGTH + levels * ROW_LENGTH), in the precision of the step.
        class_index: class of the recipe, shape (n,).
        severity: of the fault, 0 without one, shape (n,).
    """

    records: FloatArray
    class_index: NDArray[np.int64]
    severity: FloatArray


def record_length(options: MonitorOptions) -> int:
    """Entries of an episode's record."""
    return kernel.HEAD_LENGTH + (options.n_levels + 1) * kernel.ROW_LENGTH


def draw_episodes(setup: Setup, seed: int, index: NDArray[np.int64], episode: NDArray[np.int64]) -> Episodes:
    """Draw episodes `episode[n]` of sub-environments `index[n]`: each depends on (options, seed, the two) alone."""
    recipe, precision = setup.options.task, setup.options.precision
    cases = case_of(index, episode)
    drawn = draw(recipe, seed, cases)
    if recipe.spread.std.any() or any(c.severity_to is not None for c in recipe.classes):
        records = _records(setup, drawn).astype(precision)
    else:  # all motors of a class are alike
        _, first, of_case = np.unique(drawn.class_index, return_index=True, return_inverse=True)
        records = _records(setup, draw(recipe, seed, cases[first])).astype(precision)[of_case]
    onset = _onsets(setup.options, uniforms(seed, Stream.ONSET, cases, 1)[:, 0])
    records[:, kernel.HEAD_ONSET] = np.where(records[:, kernel.HEAD_KIND] > 0, onset, kernel.NEVER)
    return Episodes(records, drawn.class_index, drawn.severity)


def _records(setup: Setup, drawn: Draw) -> FloatArray:
    """Records of drawn cases, without their onset."""
    records = np.zeros((len(drawn.cases), record_length(setup.options)))
    records[:, : kernel.HEAD_LENGTH] = _heads(setup, drawn)
    levels = setup.options.n_levels
    for level in range(levels + 1):
        first = kernel.HEAD_LENGTH + level * kernel.ROW_LENGTH
        records[:, first : first + kernel.ROW_LENGTH] = _motors(setup, drawn, level / levels)
    return records


def _motors(setup: Setup, drawn: Draw, share: float) -> FloatArray:
    """The motors at a share of their faults' severity, as their difference to the belief's, shape (n, ROW_LENGTH)."""
    options, scenario, belief = setup.options, drawn.scenario, setup.belief.model
    supply = drawn.factors[:, 0]
    faults = tuple(Fault(f.kind, f.severity * share) for f in scenario.faults)
    model = discretize(apply_faults(scenario.parameters, faults), options.dt_s)
    rows = np.empty((len(supply), kernel.ROW_LENGTH))
    rows[:, kernel.M00 : kernel.M11 + 1] = (model.transition - belief.transition).reshape(-1, 4)
    rows[:, kernel.D0 : kernel.D1 + 1] = drift(options, model, setup.rest, supply)
    by_voltage = model.gain[..., Input.VOLTAGE] * supply[:, None]
    rows[:, kernel.B0 : kernel.B1 + 1] = by_voltage - belief.gain[:, Input.VOLTAGE]
    factor = noise_variance_factor(faults, NoiseSource.MEASUREMENT, np.zeros(1))
    sensor = options.task.sensor
    std = np.array([sensor.current_noise_a, sensor.speed_noise_rad_s])
    rows[:, kernel.SIGMA_CURRENT :] = np.sqrt(factor) * std
    return rows


def _heads(setup: Setup, drawn: Draw) -> FloatArray:
    options, scenario = setup.options, drawn.scenario
    heads = np.zeros((len(drawn.cases), kernel.HEAD_LENGTH))
    heads[:, kernel.HEAD_KIND] = right_declarations(setup)[drawn.class_index]
    heads[:, kernel.HEAD_SUPPLY] = drawn.factors[:, 0]
    state: FloatArray = np.zeros(2)
    if options.start is Start.RUNNING:
        state = steady_state(scenario.parameters, scenario.supply.voltage_v, options.load_torque_n_m)
    heads[:, kernel.HEAD_CURRENT : kernel.HEAD_SPEED + 1] = state - setup.rest
    heads[:, kernel.HEAD_ERROR_CURRENT : kernel.HEAD_ERROR_SPEED + 1] = state - setup.belief.initial_state
    return heads


def right_declarations(setup: Setup) -> NDArray[np.int64]:
    """Number of the kind that is right for every class, counted from 1; 0 for healthy."""
    return np.array(
        [0 if label == HEALTHY else 1 + setup.kinds.index(FaultKind(label).verdict) for label in setup.labels]
    )


def _onsets(options: MonitorOptions, uniform: FloatArray) -> FloatArray:
    """First sample on which the fault acts: geometric after the earliest."""
    earliest = round(options.earliest_onset_s / options.dt_s)
    mean = options.mean_onset_s / options.dt_s
    if mean == 0.0:
        return np.full(uniform.shape, float(earliest))
    onsets: FloatArray = earliest + np.floor(np.log(uniform) / math.log(mean / (1.0 + mean)))
    return onsets
