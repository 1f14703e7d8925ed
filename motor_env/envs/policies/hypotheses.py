"""What a step of a known motor would show under each fault: linear models of plant and filter together.

A motor whose own parameters are known is deterministic but for the sensor's noise. Under the hypothesis that a class of
the recipe has set in, plant and filter follow from the voltages that were applied, and the mean of the whitened
innovation is linear in their state and the voltage.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from motor_env.envs.options import Drive, Start
from motor_env.envs.setup import Setup, converged_gain
from motor_env.motor.faults import FaultKind, apply_faults
from motor_env.motor.model import Input, discretize
from motor_env.motor.parameters import Channel, FloatArray, require

N_HYPOTHESIS = 4  # state of a hypothesis: mean of the true state, mean of the filter's estimate


class StepModel(NamedTuple):
    """Linear step of a hypothesis: state' = transition state + gain u + drift, innovation = row state + feed u + bias.

    Attributes:
        transition: shape (..., 4, 4).
        gain: shape (..., 4).
        drift: shape (..., 4).
        row: shape (..., 4).
        feed_bias: feed and bias, shape (..., 2).
    """

    transition: FloatArray
    gain: FloatArray
    drift: FloatArray
    row: FloatArray
    feed_bias: FloatArray


def known_faults(setup: Setup) -> list[int]:
    """Classes of the recipe that have a fault, if the motor is one whose posterior is known.

    Raises:
        ValueError: the task is another one; the sentence says why.
    """
    options, recipe = setup.options, setup.options.task
    require(not recipe.spread.std.any(), f"recipe {recipe.name} must have no spread for the exact posterior")
    noisy = any(kind.changes_noise for kind in recipe.kinds)
    require(not noisy, "the exact posterior knows no noise faults")
    require(options.start is Start.RUNNING, "start must be running for the exact posterior")
    require(
        options.drive is Drive.OPEN_LOOP,
        f"drive must be open_loop for the exact posterior, got {options.drive}",
    )
    require(options.growth_s == 0.0, f"growth_s must be 0 for the exact posterior, got {options.growth_s:g}")
    require(recipe.sensor.channels == (Channel.CURRENT,), "the exact posterior reads the current alone")
    require(options.mean_onset_s > 0.0 and math.isfinite(options.mean_onset_s), "mean_onset_s must be > 0")
    return [m for m, c in enumerate(recipe.classes) if c.kind is not None]


def kind_matrix(setup: Setup, classes: list[int]) -> FloatArray:
    """1 where a class has the verdict, shape (n_classes, n_kinds)."""
    verdicts = [FaultKind(setup.labels[m]).verdict for m in classes]
    return np.array([[v == kind for kind in setup.kinds] for v in verdicts], dtype=np.float64)


def sample_model(setup: Setup, fault_class: int | None) -> FloatArray:
    """One sample of a hypothesis as a matrix on (state, u, 1), with the whitened innovation as its last row: (5, 6)."""
    options, recipe = setup.options, setup.options.task
    gain, covariance = converged_gain(setup.belief)
    faults = () if fault_class is None else recipe.classes[fault_class].faults
    plant = discretize(apply_faults(recipe.motor, faults), options.dt_s)
    belief = setup.belief.model
    voltage, load = float(recipe.supply.voltage_v), options.load_n_m
    drift = (
        (plant.transition - np.eye(2)) @ setup.rest
        + plant.gain[:, Input.VOLTAGE] * voltage
        + plant.gain[:, Input.LOAD_TORQUE] * load
    )
    true = np.hstack([plant.transition, np.zeros((2, 2)), plant.gain[:, [Input.VOLTAGE]], drift[:, None]])
    predicted = np.hstack(
        [np.zeros((2, 2)), belief.transition, belief.gain[:, [Input.VOLTAGE]], np.zeros((2, 1))]
    )
    surprise = true[0] - predicted[0]
    estimate = predicted + gain * surprise
    return np.vstack([true, estimate, surprise / np.sqrt(covariance[0, 0])])


def step_of(samples: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Samples in a row under one voltage: state rows (4, 6) on (state, u, 1), and row of the step's innovation (6,)."""
    total, state = np.zeros(6), np.eye(6)
    for sample in samples:
        total += sample[4] @ state
        state[:N_HYPOTHESIS] = sample[:N_HYPOTHESIS] @ state
    return state[:N_HYPOTHESIS], total / math.sqrt(len(samples))


def step_models(setup: Setup, classes: list[int]) -> tuple[StepModel, StepModel]:
    """The step of every class after its onset, and the one in which the onset falls; entry 0 is the healthy motor."""
    n = setup.options.samples_per_step
    healthy = sample_model(setup, None)
    whole, split = [], []
    for which in (None, *classes):
        sample = sample_model(setup, which)
        whole.append(step_of([sample] * n))
        split.append(step_of([healthy] * (n // 2) + [sample] * (n - n // 2)))

    def packed(steps: list[tuple[FloatArray, FloatArray]]) -> StepModel:
        state = np.stack([step[0] for step in steps])
        out = np.stack([step[1] for step in steps])
        parts = (state[:, :, :4], state[:, :, 4], state[:, :, 5], out[:, :4], out[:, 4:])
        return StepModel(*(np.ascontiguousarray(part) for part in parts))

    return packed(whole), packed(split)
