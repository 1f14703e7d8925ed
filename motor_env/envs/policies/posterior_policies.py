"""Policies that decide by the posterior of fault and onset, with or without probing the voltage.

In a known motor at its operating point, fault c with onset k adds the signature s_c[age] to the current. So the
likelihood ratio of (c, k) is a product over the samples, and the posterior a sum over the geometric prior of the onset
(Shiryaev 1963). Onsets older than `LONGEST_AGE_S` share one hypothesis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorWrapper
from numpy.typing import NDArray

from motor_env.common.arrays import instance
from motor_env.envs.policies.fault_posterior import (
    ProbeBelief,
    final_worth,
    kind_matrix,
    known_faults,
    onset_law,
)
from motor_env.envs.policies.rule_policies import (
    Actions,
    Observations,
    Policy,
    ThresholdPolicy,
    column,
    declarations,
)
from motor_env.envs.setup import Setup
from motor_env.envs.vector import MotorVectorEnv, Step
from motor_env.motor.compiled import njit
from motor_env.motor.faults import apply_faults
from motor_env.motor.model import State
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.simulate import simulate_states


class Bursts(NamedTuple):
    """An open-loop probe: bursts of voltage offsets; times in steps.

    Attributes:
        start: of the first burst.
        period: from burst to burst.
        length: of a burst; at most `period`.
        half_period: steps before a change of sign; from `length` on, one pulse of the same sign.
    """

    start: int
    period: int
    length: int
    half_period: int = 1

    def actions(self, n_steps: int) -> Actions:
        """Return the action of every step of an episode; actions 1 and 2 are the two signs, 1 first."""
        require(1 <= self.length <= self.period, f"length must be from 1 to {self.period}, got {self.length}")
        since = np.arange(n_steps) - self.start
        within = since % self.period
        side = (within // self.half_period) % 2
        moved = (since >= 0) & (within < self.length)
        return np.where(moved, 1 + side, 0)


class ExpectedRewardTest(ThresholdPolicy):
    """Declares a kind once its expected reward reaches a threshold; at the last step, that of silence.

    Args:
        setup: see `ProbeBelief`.
        threshold: of the expected reward.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        self.belief, self.threshold = ProbeBelief(setup), threshold
        self._declarations = declarations(setup)

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self.belief.start(count)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the expected reward of the best declaration, and that declaration."""
        self.belief.watch(observations)
        return self._statistic()

    def _statistic(self) -> tuple[FloatArray, Actions]:
        options, belief = self.belief.setup.options, self.belief
        value = final_worth(options, belief.steps >= options.n_steps - 1, belief.quiet, belief.kinds)
        return value, self._declarations[belief.kinds.argmax(axis=1)]


class Probing(ThresholdPolicy):
    """Moves the voltage; a test decides."""

    def __init__(self, test: ThresholdPolicy) -> None:
        self.test, self.threshold = test, test.threshold

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self.test.start(count)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Let the test judge."""
        return self.test.judge(observations)


class OpenLoop(Probing):
    """Moves the voltage by a schedule of actions."""

    def __init__(self, test: ThresholdPolicy, schedule: Actions) -> None:
        super().__init__(test)
        self._schedule, self._step = schedule, -1

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self._step = -1

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Let the test judge."""
        self._step += 1
        return super().judge(observations)

    def probe(self) -> Actions:
        """Return the action of this step."""
        return np.full(self.count, self._schedule[self._step])


def winding_of(setup: Setup) -> int:
    """Return the number of the kind `winding`."""
    kinds = setup.kinds
    require("winding" in kinds, f"a probe needs a recipe with winding faults, got {', '.join(kinds)}")
    return kinds.index("winding")


class EventTriggeredProbing(Probing):
    """Moves the voltage while a winding fault is likely enough: on-off control of Banerjee & Veeravalli (2012).

    The sign changes with each step.

    Args:
        test: decides.
        above: probability of a winding fault at which to move it.
    """

    test: ExpectedRewardTest

    def __init__(self, test: ExpectedRewardTest, above: float) -> None:
        super().__init__(test)
        self.above, self._winding = above, winding_of(test.belief.setup)

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self._side: NDArray[np.int64] = np.zeros(count, dtype=np.int64)

    def probe(self) -> Actions:
        """Move the voltage where a winding fault is likely enough."""
        moves = self.test.belief.kinds[:, self._winding] >= self.above
        actions = np.where(moves, 1 + self._side, 0)
        self._side = np.where(moves, 1 - self._side, self._side)
        return actions


class PosteriorView(VectorWrapper[Any, Any, Any]):
    """Vector environment with the summary of `ProbeBelief` as observation and its expected reward.

    The expected reward has the true one's mean, with less noise.

    Args:
        envs: vector of a task of `ProbeBelief`, with the autoreset mode SameStep.

    Raises:
        ValueError: another autoreset mode or task.
    """

    def __init__(self, envs: MotorVectorEnv) -> None:
        instance("envs", envs, MotorVectorEnv)
        require(
            envs.autoreset_mode is AutoresetMode.SAME_STEP,
            f"autoreset_mode of the vector must be SameStep, got {envs.autoreset_mode.value}",
        )
        super().__init__(envs)
        self.autoreset_mode, self.belief = envs.autoreset_mode, ProbeBelief(envs.setup)
        self.belief.start(self.num_envs)
        shape = self.belief.summary().shape
        self.observation_space = spaces.Box(-4.0, 4.0, shape, dtype=np.float32)
        self.single_observation_space = spaces.Box(-4.0, 4.0, shape[1:], dtype=np.float32)

    def reset(self, **given: Any) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes everywhere."""
        _, info = self.env.reset(**given)
        self.belief.start(self.num_envs)
        return self.belief.summary(), info

    def step(self, actions: Actions) -> Step:
        """Step the vector, and update the posterior."""
        declares = self.belief.setup.declarations[actions] > 0
        declared = self.belief.expected_reward(actions)
        waited = self.belief.expected_reward(np.where(declares, 0, actions))
        observations, _, terminated, truncated, info = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            observations = observations.copy()
            observations[over] = np.stack(info["final_obs"][over])
        self.belief.update(observations)
        last = self.belief.summary()
        self.belief.restart(over)
        for n in np.flatnonzero(over):
            info["final_obs"][n] = last[n]
        summary = self.belief.summary() if over.any() else last
        return summary, np.where(terminated & declares, declared, waited), terminated, truncated, info


class BeliefPolicy(Policy):
    """Policy that was trained in a `PosteriorView` of the environment.

    Args:
        belief: of the environment's setup.
        choose: maps summaries of shape (count, n_columns) to actions.
    """

    def __init__(self, belief: ProbeBelief, choose: Any) -> None:
        self.belief, self._choose = belief, choose

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self.belief.start(count)

    def act(self, observations: Observations) -> Actions:
        """Choose by the summary of the posterior."""
        self.belief.watch(observations)
        actions: NDArray[np.int64] = self._choose(self.belief.summary()).astype(np.int64)
        return actions


LONGEST_AGE_S = 20e-3
LARGEST_EXPONENT = 600.0
LARGEST_WEIGHT = 1e40  # before it times exp(LARGEST_EXPONENT) is more than a float holds


def signatures(setup: Setup, n_samples: int) -> FloatArray:
    """Return the change of the current by each class, in standard deviations of the noise, (n_classes, n_samples)."""
    options, recipe = setup.options, setup.options.task
    answer = np.zeros((len(recipe.classes), n_samples))
    for row, fault_class in zip(answer, recipe.classes, strict=True):
        states = simulate_states(
            apply_faults(recipe.motor, fault_class.faults),
            np.full(n_samples, float(recipe.supply.voltage_v)),
            options.dt_s,
            load_torque_n_m=options.load_n_m,
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
    prior: FloatArray,
    mass: FloatArray,
) -> None:
    """Update by one sample; weights[lane, class, age] are prior times likelihood ratio.

    Args:
        weights: changed in place; the last age includes all older ones.
        begun: number of ages in use.
        deviation: of the current from rest, in standard deviations, shape (n_lanes,).
        signature: shape (n_classes, n_ages).
        prior: of an onset at this sample, in the unit of the weights, shape (n_lanes,).
        mass: written: sum over the onsets, shape (n_lanes, n_classes).
    """
    n_ages = weights.shape[2]
    for n in range(weights.shape[0]):
        e = deviation[n]
        for c in range(weights.shape[1]):
            row, shape = weights[n, c], signature[c]
            row[n_ages - 1] += row[n_ages - 2]
            for age in range(min(begun, n_ages - 2), 0, -1):
                row[age] = row[age - 1]
            row[0] = prior[n]
            total = 0.0
            for age in range(min(begun + 1, n_ages)):
                row[age] *= np.exp(min(shape[age] * (e - 0.5 * shape[age]), LARGEST_EXPONENT))
                total += row[age]
            mass[n, c] = total


class PosteriorPolicy(ThresholdPolicy):
    """Base of policies with a posterior from the measured current of every sample.

    Args:
        setup: of the task.
        threshold: of the expected reward.
        faults: indices of the recipe's classes with a fault.

    Raises:
        ValueError: several samples a step, or no observed current.

    Attributes:
        quiet: posterior probability of no fault so far, shape (count,).
        classes: of each class of fault, shape (count, n_classes).
        kinds: of each kind of fault, shape (count, n_kinds).
    """

    def __init__(self, setup: Setup, threshold: float, *, faults: list[int]) -> None:
        self.setup, self.threshold = setup, threshold
        options, recipe = setup.options, setup.options.task
        require(options.samples_per_step == 1, "samples_per_step must be 1 for the posterior of every sample")
        self._class_prior = recipe.class_probabilities[faults]
        self._kind_of, self._declarations = kind_matrix(setup, faults), declarations(setup)
        self._measured = column(setup, "measured_current")
        self._to_stds = 1.0 / float(setup.view[0, 0]) / recipe.sensor.current_noise_a
        self._rest_stds = float(setup.rest[State.CURRENT]) / recipe.sensor.current_noise_a
        self._stay, self._earliest = onset_law(options)

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self._sample = -1

    def _deviation(self, observations: Observations) -> FloatArray:
        """Return the current's deviation from nominal, in standard deviations of the noise."""
        return observations[:, self._measured].astype(np.float64) * self._to_stds - self._rest_stds

    def _decision(self, quiet: FloatArray, classes: FloatArray) -> tuple[FloatArray, Actions]:
        """Return the best declaration and its expected reward, from an unnormalised posterior."""
        total = quiet + classes.sum(axis=1)
        self.quiet, self.classes = quiet / total, classes / total[:, None]
        self.kinds = self.classes @ self._kind_of
        at_end = self._sample >= self.setup.options.n_samples - 1
        value = final_worth(self.setup.options, at_end, self.quiet, self.kinds)
        return value, self._declarations[self.kinds.argmax(axis=1)]


class BayesPolicy(PosteriorPolicy):
    """Declares a kind once its expected reward under the exact posterior reaches a threshold.

    At the last step it declares if that is worth more than silence. The threshold is fixed, so its return is a lower
    bound of the best one.

    Args:
        setup: of a MonitorInstant-v0 that starts running, with an abrupt fault and a recipe without spread or noise
            faults.
        threshold: of the expected reward.

    Raises:
        ValueError: another task.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        faults = known_faults(setup)
        super().__init__(setup, threshold, faults=faults)
        self._healthy_prior = float(1.0 - self._class_prior.sum())
        self._signature = signatures(setup, round(LONGEST_AGE_S / setup.options.dt_s))[faults]

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        n_classes, n_ages = self._signature.shape
        self._weights = np.zeros((count, n_classes, n_ages))
        self._mass = np.zeros((count, n_classes))
        self._unit = np.ones(count)  # of the weights, so that they stay finite
        self._begun, self._unborn = 0, 1.0

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the expected reward of the best declaration, and that declaration."""
        self._sample += 1
        interval = self._sample - 1  # the interval at whose end this sample was read; none for the first
        if interval >= self._earliest:
            born = self._unborn * (1.0 - self._stay)
            self._unborn -= born
            deviation = self._deviation(observations)
            _update(self._weights, self._begun, deviation, self._signature, born / self._unit, self._mass)
            self._begun += 1
        self._rescale()
        quiet = (self._healthy_prior + (1.0 - self._healthy_prior) * self._unborn) / self._unit
        return self._decision(quiet, self._mass * self._class_prior)

    def _rescale(self) -> None:
        largest = self._mass.max(axis=1)
        large = largest > LARGEST_WEIGHT
        if large.any():
            with np.errstate(over="ignore"):
                self._unit[large] *= largest[large]
            self._weights[large] /= largest[large, None, None]
            self._mass[large] /= largest[large, None]
