"""Bank of hypotheses for Monitor: every class of fault, of motor or sensor, at every onset.

A fault has a signature: the mean of the whitened innovations since the onset. Around it they are white noise of
standard deviation 1. Two channels separate motor from sensor faults (analytical redundancy: Chow & Willsky 1984): a
winding moves current and speed together, a sensor only its own reading.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import instance
from motor_env.envs.policies.fault_posterior import final_worth, kind_matrix, known_motor, onset_law
from motor_env.envs.policies.rule_policies import (
    Actions,
    Observations,
    ThresholdPolicy,
    column,
    declarations,
)
from motor_env.envs.setup import INNOVATION_BOUND, Setup, converged_gain
from motor_env.motor.compiled import njit
from motor_env.motor.faults import Fault, apply_faults
from motor_env.motor.model import Input
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.sensor_faults import fail_before_noise
from motor_env.simulation.simulate import Scenario, simulate_states


def innovation_signatures(setup: Setup, classes: list[int], n_samples: int, onset: int = 0) -> FloatArray:
    """Return mean whitened innovations of classes with an onset at sample `onset`.

    Returns:
        Shape (n_classes, n_samples, n_channels).

    Raises:
        ValueError: a stuck sensor, or a fault that recovers.
    """
    options, recipe, dt_s = setup.options, setup.options.task, setup.options.dt_s
    sensor, begins = recipe.sensor, dt_s * np.arange(n_samples, dtype=np.float64)
    volts = np.full(n_samples, float(recipe.supply.voltage_v))
    scale = Scenario(recipe.motor, supply=recipe.supply).full_scale
    levels = np.arange(options.n_levels) / options.n_levels
    edges = [*(onset + np.floor(round(options.growth_s / dt_s) * levels).astype(int)), n_samples]
    readings = np.empty((len(classes), len(sensor.channels), n_samples))
    for row, which in zip(readings, classes, strict=True):
        one, states = recipe.classes[which], np.tile(setup.rest, (n_samples, 1))
        require(
            one.kind is not None and not one.kind.endswith("stuck") and one.recovery is None,
            f"the posterior of residuals knows no class {one.name}",
        )
        row[:] = sensor.observation @ states.T
        for level, (first, end) in enumerate(pairwise(np.minimum(edges, n_samples).tolist()), 1):
            fault = Fault(one.faults[0].kind, one.severity * level / options.n_levels, onset_s=onset * dt_s)
            if first < end:
                states[first:end] = simulate_states(
                    apply_faults(recipe.motor, [fault]),
                    volts[first:end],
                    dt_s,
                    load_torque_n_m=options.load_n_m,
                    initial_state=states[max(first - 1, 0)],
                )
            shown = (sensor.observation @ states.T)[None]
            fail_before_noise(shown, sensor.channels, [fault], begins, scale)
            row[:, first:end] = shown[0, :, first:end]
    gain, covariance = converged_gain(setup.belief)
    whitening, model = np.linalg.inv(np.linalg.cholesky(covariance)), setup.belief.model
    pushed = model.gain[:, Input.VOLTAGE] * volts[0] + model.gain[:, Input.LOAD_TORQUE] * options.load_n_m
    estimate, white = (
        np.tile(setup.rest, (len(classes), 1)),
        np.empty((len(classes), n_samples, len(whitening))),
    )
    for k in range(n_samples):
        predicted = estimate @ model.transition.T + pushed
        innovation = readings[:, :, k] - predicted @ sensor.observation.T
        estimate, white[:, k] = predicted + innovation @ gain.T, innovation @ whitening.T
    return white


@njit(cache=True, error_model="numpy")
def _weigh(
    weight: FloatArray, step: int, born: float, seen: FloatArray, signature: FloatArray, mass: FloatArray
) -> None:
    """Update by one step: logarithms of prior times likelihood ratio, by class and step of the onset.

    Args:
        weight: changed in place, shape (n_lanes, n_classes, n_steps).
        step: before the observation.
        born: log prior of an onset in it.
        seen: innovations, shape (n_lanes, n_channels).
        signature: their means by age in steps, shape (n_classes, n_steps, n_channels).
        mass: written: log of the sum over the onsets, shape (n_lanes, n_classes).
    """
    for n in range(weight.shape[0]):
        for c in range(weight.shape[1]):
            row, high, total = weight[n, c], -np.inf, 0.0
            row[step] = born
            for onset in range(step + 1):
                for m in range(seen.shape[1]):
                    mean = signature[c, step - onset, m]
                    row[onset] += mean * (seen[n, m] - 0.5 * mean)
                high = max(high, row[onset])
            for onset in range(step + 1):
                total += np.exp(row[onset] - high)
            mass[n, c] = high + np.log(total) if high > -np.inf else high


class ResidualPosterior(ThresholdPolicy):
    """Declares the likeliest failure once its expected reward reaches a threshold.

    Args:
        setup: of a Monitor that starts running, with a known motor whose faults may grow or be of its sensors, and
            observed innovations of each channel.
        threshold: of the expected reward.

    Raises:
        ValueError: another task.

    Attributes:
        quiet: posterior probability of no fault so far, shape (count,).
        kinds: of each declarable kind, shape (count, n_kinds).
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        instance("setup", setup, Setup)
        self.setup, self.threshold, faults = setup, threshold, known_motor(setup)
        options, recipe = setup.options, setup.options.task
        samples = options.samples_per_step
        white = innovation_signatures(setup, faults, options.n_samples, samples // 2)
        steps = white.reshape(len(faults), options.n_steps, samples, -1).sum(axis=2) / np.sqrt(samples)
        self._signature = np.clip(steps, -INNOVATION_BOUND, INNOVATION_BOUND)
        self._columns = [column(setup, f"innovation_{channel}") for channel in recipe.sensor.channels]
        self._log_prior, self._of_kind = (
            np.log(recipe.class_probabilities[faults]),
            kind_matrix(setup, faults),
        )
        self._declarations = declarations(setup)
        stay, earliest = onset_law(options)
        self._unborn = stay ** np.maximum(np.arange(options.n_steps + 1) * samples - earliest, 0)

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        shape = (count, len(self._log_prior))
        self._weight = np.full((*shape, self.setup.options.n_steps), -np.inf)
        self._mass, self._step = np.full(shape, -np.inf), -1

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the expected reward of the best declaration, and that declaration."""
        if self._step >= 0:
            with np.errstate(divide="ignore"):
                born = np.log(self._unborn[self._step] - self._unborn[self._step + 1])
            seen: NDArray[np.float64] = observations[:, self._columns].astype(np.float64)
            _weigh(self._weight, self._step, born, seen, self._signature, self._mass)
        self._step += 1
        logs, faulty = self._mass + self._log_prior, np.exp(self._log_prior).sum()
        quiet = np.log(1.0 - faulty + faulty * self._unborn[self._step])
        high = np.maximum(logs.max(axis=1), quiet)
        classes, calm = np.exp(logs - high[:, None]), np.exp(quiet - high)
        total = calm + classes.sum(axis=1)
        self.quiet, self.kinds = calm / total, (classes / total[:, None]) @ self._of_kind
        at_end = self._step >= self.setup.options.n_steps - 1
        value = final_worth(self.setup.options, at_end, self.quiet, self.kinds)
        return value, self._declarations[self.kinds.argmax(axis=1)]
