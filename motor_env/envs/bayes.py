"""The Bayes posterior over onset and fault of a monitored motor whose parameters are known, as a policy.

A motor at its operating point whose own parameters are known is deterministic but for the sensor's noise: fault c with
onset k puts the signature s_c[age] on the current, whatever else. So the likelihood ratio of every hypothesis (c, k) is
a product over the samples, and the posterior a sum over the geometric prior of the onset (Shiryaev 1963, with a
signature and several faults). Onsets older than `LONGEST_AGE_S` are kept together: the transient is over, their
signatures agree.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from motor_env.envs.options import MonitorOptions, Start
from motor_env.envs.policies import Actions, Observations, Policy, column
from motor_env.envs.setup import VERDICT_OF, Setup
from motor_env.faults import FaultKind, apply_faults
from motor_env.model import State
from motor_env.parameters import Channel, FloatArray, require
from motor_env.simulation import simulate_states

LONGEST_AGE_S = 20e-3


def signatures(setup: Setup, n_samples: int) -> FloatArray:
    """Change of the current by each class of the recipe, in standard deviations, shape (n_classes, n_samples)."""
    options, recipe = setup.options, setup.options.task
    answer = np.zeros((len(recipe.classes), n_samples))
    for row, fault_class in zip(answer, recipe.classes, strict=True):
        states = simulate_states(
            apply_faults(recipe.motor, fault_class.faults),
            np.full(n_samples, float(recipe.supply.voltage_v)),
            options.dt_s,
            load_torque_n_m=options.load_torque_n_m,
            initial_state=setup.rest,
        )
        row[:] = (states[:, State.CURRENT] - setup.rest[State.CURRENT]) / recipe.sensor.current_noise_a
    return answer


@njit(cache=True, error_model="numpy")
def _update(
    weights: FloatArray,
    begun: int,
    deviation: FloatArray,
    signature: FloatArray,
    prior: float,
    mass: FloatArray,
) -> None:
    """One more sample: weights[lane, class, age] are prior times likelihood ratio; the last age gathers the old ones.

    Args:
        weights: changed in place; `begun` onsets are in it, the newest at age 0.
        begun: number of ages in use.
        deviation: of the current from rest, in standard deviations, shape (n_lanes,).
        signature: shape (n_classes, n_ages).
        prior: probability that the fault set in with this sample.
        mass: sum of the weights over the onsets, shape (n_lanes, n_classes).
    """
    n_ages = weights.shape[2]
    for n in range(weights.shape[0]):
        e = deviation[n]
        for c in range(weights.shape[1]):
            row, shape = weights[n, c], signature[c]
            row[n_ages - 1] += row[n_ages - 2]
            for age in range(min(begun, n_ages - 2), 0, -1):
                row[age] = row[age - 1]
            row[0] = prior
            total = 0.0
            for age in range(min(begun + 1, n_ages)):
                row[age] *= np.exp(shape[age] * (e - 0.5 * shape[age]))
                total += row[age]
            mass[n, c] = total


class BayesPolicy(Policy):
    """Declares the kind whose declaration is worth enough in expectation under the exact posterior.

    Optimal stopping has no closed form here; the rule declares once the expected reward of declaring exceeds a level,
    and at the last step whatever is worth more than silence. The level is to be tuned on other seeds.

    Args:
        setup: of a Monitor-v0 that starts running, with an abrupt fault and a recipe without spread or noise faults.
        level: of the expected reward.

    Raises:
        ValueError: the task is another one.
    """

    def __init__(self, setup: Setup, level: float) -> None:
        options = setup.options
        _require_known_motor(options)
        self.setup, self.level = setup, level
        recipe = options.task
        fault = [m for m, c in enumerate(recipe.classes) if c.kind is not None]
        probabilities = recipe.class_probabilities
        self._class_prior = probabilities[fault]
        self._healthy_prior = float(1.0 - self._class_prior.sum())
        self._signature = signatures(setup, round(LONGEST_AGE_S / options.dt_s))[fault]
        verdict = [VERDICT_OF[FaultKind(setup.labels[m])] for m in fault]
        self._kind_of = np.array([[v == kind for kind in setup.kinds] for v in verdict], dtype=np.float64)
        self._measured = column(setup, "measured_current")
        stall = 1.0 / float(setup.view[0, 0])
        self._to_stds = stall / recipe.sensor.current_noise_a
        self._rest_stds = float(setup.rest[State.CURRENT]) / recipe.sensor.current_noise_a
        mean = options.mean_onset_s / options.dt_s
        self._hazard = 1.0 / (1.0 + mean)
        self._earliest = round(options.earliest_onset_s / options.dt_s)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        n_classes, n_ages = self._signature.shape
        self._weights = np.zeros((count, n_classes, n_ages))
        self._mass = np.zeros((count, n_classes))
        self._sample, self._begun, self._unborn = -1, 0, 1.0

    def posterior(self) -> tuple[FloatArray, FloatArray]:
        """Probability that nothing has happened yet, shape (count,), and of each kind, shape (count, n_kinds)."""
        faulty = self._mass * self._class_prior
        quiet = self._healthy_prior + (1.0 - self._healthy_prior) * self._unborn
        total = quiet + faulty.sum(axis=1)
        return quiet / total, (faulty @ self._kind_of) / total[:, None]

    def act(self, observations: Observations) -> Actions:
        """Wait until a declaration is worth enough."""
        self._sample += 1
        interval = self._sample - 1  # the interval at whose end this sample was read; none for the first
        if interval >= self._earliest:
            born = self._unborn * self._hazard
            self._unborn -= born
            stds = observations[:, self._measured].astype(np.float64) * self._to_stds - self._rest_stds
            _update(self._weights, self._begun, stds, self._signature, born, self._mass)
            self._begun += 1
        options = self.setup.options
        quiet, kinds = self.posterior()
        faulty = kinds.sum(axis=1, keepdims=True)
        worth = (
            kinds * options.correct_reward
            - (faulty - kinds) * options.wrong_kind_cost
            - quiet[:, None] * options.false_alarm_cost
        )
        best = worth.argmax(axis=1)
        value = worth.max(axis=1)
        if self._sample < options.n_samples - 1:
            declare = value >= self.level
        else:
            declare = value > quiet * options.silent_reward - faulty[:, 0] * options.miss_cost
        return np.where(declare, 1 + best, 0)


def _require_known_motor(options: MonitorOptions) -> None:
    recipe = options.task
    kinds: set[FaultKind | None] = {c.kind for c in recipe.classes}
    require(not recipe.spread.std.any(), f"recipe {recipe.name} must have no spread for the exact posterior")
    require(FaultKind.NOISE not in kinds, "the exact posterior knows no noise faults")
    require(options.start is Start.RUNNING, "start must be running for the exact posterior")
    require(options.growth_s == 0.0, f"growth_s must be 0 for the exact posterior, got {options.growth_s:g}")
    require(options.samples_per_step == 1, "samples_per_step must be 1 for the exact posterior")
    require(recipe.sensor.channels == (Channel.CURRENT,), "the exact posterior reads the current alone")
    require(options.mean_onset_s > 0.0 and math.isfinite(options.mean_onset_s), "mean_onset_s must be > 0")
