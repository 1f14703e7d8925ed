"""Likelihood and posterior of every fault and onset of a known motor, for any voltage.

Under the hypothesis (class c, onset k) the innovation is a known mean plus white noise of standard deviation 1. The
log-likelihood ratio to a healthy motor grows by mean (innovation - mean / 2) a step. Its sum over the prior is the
posterior (Shiryaev 1963), its maximum over onset and severity the generalised likelihood ratio of a kind (Lorden
1971).

The innovation is summed over a step, over the root of its samples. An onset counts as the middle of a step. Onsets
older than `LONGEST_AGE_S` share one hypothesis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import instance
from motor_env.envs import layout
from motor_env.envs.options import Drive, MonitorOptions, Start
from motor_env.envs.policies.rule_policies import Actions, Observations, column
from motor_env.envs.setup import INNOVATION_BOUND, Setup, converged_gain
from motor_env.motor.compiled import njit
from motor_env.motor.faults import FaultKind, apply_faults
from motor_env.motor.model import Input, discretize
from motor_env.motor.parameters import Channel, FloatArray, require

N_HYPOTHESIS = 4  # state of a hypothesis: mean of the true state, mean of the filter's estimate


class StepModel(NamedTuple):
    """Linear step of a hypothesis: x' = transition x + gain u + drift, innovation = row x + feed u + bias."""

    transition: FloatArray  # shape (..., 4, 4)
    gain: FloatArray  # shape (..., 4), as drift and row
    drift: FloatArray
    row: FloatArray
    feed_bias: FloatArray  # shape (..., 2)


def known_faults(setup: Setup) -> list[int]:
    """Return the recipe's classes with a fault.

    Raises:
        ValueError: the task has no exact posterior, with the reason.
    """
    options, recipe = setup.options, setup.options.task
    recipe.require_motor_faults()
    require(options.growth_s == 0.0, f"growth_s must be 0 for the exact posterior, got {options.growth_s:g}")
    require(recipe.sensor.channels == (Channel.CURRENT,), "the exact posterior reads the current alone")
    return known_motor(setup)


def known_motor(setup: Setup) -> list[int]:
    """Return the classes with a fault; `ValueError` unless the motor is known and runs at a steady operating point."""
    options, recipe = setup.options, setup.options.task
    require(not recipe.spread.std.any(), f"recipe {recipe.name} must have no spread for the exact posterior")
    noisy = any(kind.changes_noise for kind in recipe.kinds)
    require(not noisy, "the exact posterior knows no noise faults")
    require(options.start is Start.RUNNING, "start must be running for the exact posterior")
    require(
        options.drive is Drive.OPEN_LOOP,
        f"drive must be open_loop for the exact posterior, got {options.drive}",
    )
    require(options.mean_onset_s > 0.0 and math.isfinite(options.mean_onset_s), "mean_onset_s must be > 0")
    return [m for m, c in enumerate(recipe.classes) if c.kind is not None]


def kind_matrix(setup: Setup, classes: list[int]) -> FloatArray:
    """Return 1 where a class has the verdict, shape (n_classes, n_kinds)."""
    verdicts = [FaultKind(setup.labels[m]).component for m in classes]
    return np.array([[v == kind for kind in setup.kinds] for v in verdicts], dtype=np.float64)


def sample_model(setup: Setup, fault_class: int | None) -> FloatArray:
    """Return the matrix of one sample on (state, u, 1), shape (5, 6); its last row is the whitened innovation."""
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
    """Return state rows (4, 6) and innovation row (6,) of samples under one voltage, on (state, u, 1)."""
    total, state = np.zeros(6), np.eye(6)
    for sample in samples:
        total += sample[4] @ state
        state[:N_HYPOTHESIS] = sample[:N_HYPOTHESIS] @ state
    return state[:N_HYPOTHESIS], total / math.sqrt(len(samples))


def step_models(setup: Setup, classes: list[int]) -> tuple[StepModel, StepModel]:
    """Return the step of every class after its onset, and that of the onset; entry 0 is the healthy motor."""
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


LONGEST_AGE_S = 40e-3


class Hypotheses(NamedTuple):
    """Hypotheses of every class and onset: the newest onset has age 0, the last age includes all older ones."""

    ratio: FloatArray  # log-likelihood ratio to a healthy motor, shape (n_lanes, n_classes, n_ages)
    weight: FloatArray  # the same plus the logarithm of the onset's prior; -inf where there is no onset yet
    states: FloatArray  # mean of the motor's state and of the filter's estimate, shape (n_lanes, n_classes, n_ages, 4)


def worth(options: MonitorOptions, quiet: FloatArray, kinds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the expected rewards of declaring the likeliest kind, and of silence at the horizon, (count,).

    `quiet` is the probability of no fault so far, shape (count,), `kinds` that of each kind, (count, n_kinds).
    """
    faulty = kinds.sum(axis=1)
    right = kinds.max(axis=1)
    declared = right * options.correct_reward - (faulty - right) * options.wrong_kind_cost
    return (
        declared - quiet * options.false_alarm_cost,
        quiet * options.silent_reward - faulty * options.miss_cost,
    )


def final_worth(
    options: MonitorOptions, at_end: NDArray[np.bool_] | bool, quiet: FloatArray, kinds: FloatArray
) -> FloatArray:
    """Return the expected reward of declaring the likeliest kind; at the horizon inf if above silence's, else -inf."""
    value, silence = worth(options, quiet, kinds)
    return np.where(at_end, np.where(value > silence, np.inf, -np.inf), value)


def onset_law(options: MonitorOptions) -> tuple[float, int]:
    """Return the probability of the onset being one sample later, and its first possible sample."""
    mean = options.mean_onset_s / options.dt_s
    return mean / (1.0 + mean), round(options.earliest_onset_s / options.dt_s)


@njit(cache=True, error_model="numpy", inline="always")
def _mean_and_move(model: StepModel, c: int, u: float, s: FloatArray) -> float:
    """Return the mean innovation of a step of class c, clipped as an observation; update the state s."""
    s0, s1, s2, s3 = s[0], s[1], s[2], s[3]
    row = model.row[c]
    mean = row[0] * s0 + row[1] * s1 + row[2] * s2 + row[3] * s3
    mean += model.feed_bias[c, 0] * u + model.feed_bias[c, 1]
    matrix, gain, drift = model.transition[c], model.gain[c], model.drift[c]
    for m in range(N_HYPOTHESIS):
        s[m] = matrix[m, 0] * s0 + matrix[m, 1] * s1 + matrix[m, 2] * s2 + matrix[m, 3] * s3
        s[m] += gain[m] * u + drift[m]
    return float(min(max(mean, -INNOVATION_BOUND), INNOVATION_BOUND))


@njit(cache=True, error_model="numpy", inline="always")
def _age(ratio: FloatArray, weight: FloatArray, states: FloatArray, begun: int) -> None:
    """Shift all ages by one; once all are in use, merge the two oldest."""
    n_ages = ratio.shape[0]
    newest_free = begun
    if begun == n_ages:
        last, young = n_ages - 1, n_ages - 2
        ratio[last] = max(ratio[last], ratio[young])
        high = max(weight[last], weight[young])
        weight[last] = high + np.log(np.exp(weight[last] - high) + np.exp(weight[young] - high))
        newest_free = young
    for age in range(newest_free, 0, -1):
        ratio[age], weight[age] = ratio[age - 1], weight[age - 1]
        for m in range(N_HYPOTHESIS):
            states[age, m] = states[age - 1, m]


@njit(cache=True, error_model="numpy")
def _update(
    hypotheses: Hypotheses,
    begun: NDArray[np.int64],
    healthy: FloatArray,
    voltage: FloatArray,
    innovation: FloatArray,
    born: FloatArray,
    whole: StepModel,
    split: StepModel,
) -> None:
    """Update every lane by one step: `hypotheses`, `begun` and `healthy` change in place.

    Args:
        hypotheses: of all lanes.
        begun: number of ages in use in every lane.
        healthy: state without a fault, shape (n_lanes, 4).
        voltage: applied offset, shape (n_lanes,).
        innovation: observed, shape (n_lanes,).
        born: log prior probability of an onset in this step.
        whole: see `step_models`, as `split`.
        split: the step of the onset.
    """
    n_lanes, n_classes, n_ages = hypotheses.ratio.shape
    for n in range(n_lanes):
        u, r = voltage[n], innovation[n]
        for c in range(n_classes):
            ratio, weight, states = hypotheses.ratio[n, c], hypotheses.weight[n, c], hypotheses.states[n, c]
            for age in range(begun[n]):
                mean = _mean_and_move(whole, c + 1, u, states[age])
                gain = mean * (r - 0.5 * mean)
                ratio[age] += gain
                weight[age] += gain
            if born[n] > -np.inf:
                _age(ratio, weight, states, begun[n])
                for m in range(N_HYPOTHESIS):
                    states[0, m] = healthy[n, m]
                mean = _mean_and_move(split, c + 1, u, states[0])
                ratio[0] = mean * (r - 0.5 * mean)
                weight[0] = born[n] + ratio[0]
        if born[n] > -np.inf:
            begun[n] = min(begun[n] + 1, n_ages)
        _mean_and_move(whole, 0, u, healthy[n])


class ProbeBelief:
    """Likelihood ratios and posterior of many sub-environments, from an agent's observations.

    Args:
        setup: of a task that starts running, with an abrupt fault, a recipe without spread or noise faults, and
            observations `innovation_current` and `voltage`.

    Raises:
        ValueError: the task is another one.

    Attributes:
        quiet: posterior probability of no fault so far, shape (count,).
        classes: posterior probability of each class of fault, shape (count, n_classes).
        kinds: the same of each kind, shape (count, n_kinds).
        ratios: generalised log-likelihood ratio of each kind to healthy, >= 0, shape (count, n_kinds).
    """

    def __init__(self, setup: Setup) -> None:
        instance("setup", setup, Setup)
        faults = known_faults(setup)
        options, recipe = setup.options, setup.options.task
        self.setup = setup
        self._whole, self._split = step_models(setup, faults)
        self._innovation, self._voltage = column(setup, "innovation_current"), column(setup, "voltage")
        view = setup.view[:, layout.FEATURES.index("voltage")].astype(np.float64)
        self._to_volt, self._rest_volt = 1.0 / view[0], view[2]
        self._n_ages = max(3, round(LONGEST_AGE_S / (options.dt_s * options.samples_per_step)))
        prior = recipe.class_probabilities[faults]
        self._log_prior, self._healthy = np.log(prior), float(1.0 - prior.sum())
        self._of_kind = kind_matrix(setup, faults)
        self._stay, self._earliest = onset_law(options)

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        shape = (count, len(self._log_prior), self._n_ages)
        self._hypotheses = Hypotheses(
            np.full(shape, -np.inf), np.full(shape, -np.inf), np.zeros((*shape, N_HYPOTHESIS))
        )
        self._path = np.zeros((count, N_HYPOTHESIS))
        self._begun, self.steps = np.zeros((2, count), dtype=np.int64)
        self._offset_v = np.zeros(count)
        self._has_begun = False
        self._conclude()

    def watch(self, observations: Observations) -> None:
        """Update by the observation before an action; the first follows no step."""
        if self._has_begun:
            self.update(observations)
        self._has_begun = True

    def restart(self, over: NDArray[np.bool_]) -> None:
        """Restart where an episode is over."""
        if over.any():
            self._hypotheses.ratio[over], self._hypotheses.weight[over] = -np.inf, -np.inf
            self._path[over], self._begun[over], self.steps[over] = 0.0, 0, 0
            self._offset_v[over] = 0.0
            self._conclude()

    def update(self, observations: Observations) -> None:
        """Update by the observation after a step of every sub-environment."""
        per_step = self.setup.options.samples_per_step
        first = np.maximum(self.steps * per_step - self._earliest, 0)
        last = np.maximum((self.steps + 1) * per_step - self._earliest, 0)
        with np.errstate(divide="ignore"):
            born = np.log(self._stay**first - self._stay**last)
        self._offset_v = observations[:, self._voltage] * self._to_volt - self._rest_volt
        _update(
            self._hypotheses,
            self._begun,
            self._path,
            self._offset_v,
            observations[:, self._innovation].astype(np.float64),
            born,
            self._whole,
            self._split,
        )
        self.steps += 1
        self._conclude()

    def _conclude(self) -> None:
        weight = self._hypotheses.weight
        high = np.maximum(weight.max(axis=(1, 2)), 0.0)
        mass = np.exp(weight - high[:, None, None]).sum(axis=2) * np.exp(self._log_prior)
        since = np.maximum(self.steps * self.setup.options.samples_per_step - self._earliest, 0)
        quiet = (self._healthy + (1.0 - self._healthy) * self._stay**since) * np.exp(-high)
        total = quiet + mass.sum(axis=1)
        self.quiet, self.classes = quiet / total, mass / total[:, None]
        self.kinds = self.classes @ self._of_kind
        best = np.maximum(self._hypotheses.ratio.max(axis=2), 0.0)
        self.ratios = (best[:, :, None] * self._of_kind).max(axis=1)

    @property
    def coming(self) -> FloatArray:
        """Return the probability of each class's fault being still to come, shape (count, n_classes)."""
        begun = np.maximum(self.steps * self.setup.options.samples_per_step - self._earliest, 0)
        unborn = np.exp(self._log_prior) * self._stay ** begun[:, None]
        coming: FloatArray = (
            self.quiet[:, None] * unborn / (self._healthy + unborn.sum(axis=1, keepdims=True))
        )
        return coming

    def expected_reward(self, actions: Actions) -> FloatArray:
        """Return the expected reward of an action under the posterior, shape (count,): less noise (Rao-Blackwell)."""
        setup, options = self.setup, self.setup.options
        declared = setup.declarations[actions]
        faulty = self.kinds.sum(axis=1)
        right = np.where(declared > 0, self.kinds[np.arange(len(actions)), declared - 1], 0.0)
        verdict = right * options.correct_reward - (faulty - right) * options.wrong_kind_cost
        verdict -= self.quiet * options.false_alarm_cost
        per_step = options.samples_per_step
        comes = self.coming.sum(axis=1)
        comes *= np.where(self.steps * per_step >= self._earliest, 1.0 - self._stay**per_step, 0.0)
        delay = options.delay_cost_per_s * (faulty + 0.5 * comes)  # one that comes does so in mid-step
        price = delay + options.probe_cost_per_v2_s * setup.offsets_v[actions] ** 2
        missed = faulty + comes
        silence = (1.0 - missed) * options.silent_reward - missed * options.miss_cost
        waited = -price * options.dt_s * per_step + np.where(self.steps >= options.n_steps - 1, silence, 0.0)
        reward: FloatArray = np.where(declared > 0, verdict, waited)
        return reward

    def summary(self) -> NDArray[np.float32]:
        """Return sufficient statistics, scaled to about 1, shape (count, 5 + n_classes + 2 n_kinds).

        Remaining time; posterior of no fault, of each class and kind; log-odds of each kind and of any fault (a fifth
        of them, from -2 to 2); the last offset; the healthy motor's deviation of speed, as back-EMF in volt.
        """
        back_emf = float(np.asarray(self.setup.options.task.motor.back_emf_constant_v_s_per_rad))
        remaining = 1.0 - self.steps / self.setup.options.n_steps
        odds = np.column_stack([self.kinds, 1.0 - self.quiet])
        with np.errstate(divide="ignore"):
            logits = np.clip(0.2 * (np.log(odds) - np.log1p(-np.minimum(odds, 1.0 - 1e-9))), -2.0, 2.0)
        columns = [
            remaining,
            self.quiet,
            self.classes,
            self.kinds,
            logits,
            self._offset_v,
            self._path[:, 1] * back_emf,
        ]
        return np.column_stack(columns).astype(np.float32)
