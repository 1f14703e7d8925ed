"""Policies that move the voltage, and tests that know what it does: open loop, and as the posterior asks for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs.policies.fault_posterior import ProbeBelief, final_worth
from motor_env.envs.policies.rule_policies import Actions, Observations, ThresholdPolicy, declarations
from motor_env.envs.setup import Setup
from motor_env.motor.parameters import FloatArray, require


class Bursts(NamedTuple):
    """An open-loop probe: bursts of steps in which the voltage is moved; times in steps.

    Attributes:
        start: of the first burst.
        period: from burst to burst.
        length: of a burst; at most `period`.
        half_period: steps before the voltage changes sides; `length` or more: one pulse, always to the same side.
    """

    start: int
    period: int
    length: int
    half_period: int = 1

    def actions(self, n_steps: int) -> Actions:
        """The action of every step of an episode, with offsets 1 and 2 as the two sides, 1 first."""
        require(1 <= self.length <= self.period, f"length must be from 1 to {self.period}, got {self.length}")
        since = np.arange(n_steps) - self.start
        within = since % self.period
        side = (within // self.half_period) % 2
        moved = (since >= 0) & (within < self.length)
        return np.where(moved, 1 + side, 0)


class WorthTest(ThresholdPolicy):
    """Declares a kind once the reward that it expects from this, under the posterior, reaches a threshold.

    At the last step whatever is worth more than silence.

    Args:
        setup: see `ProbeBelief`.
        threshold: worth of a declaration.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        self.belief, self.threshold = ProbeBelief(setup), threshold
        self._declarations = declarations(setup)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self.belief.start(count)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """The worth of a declaration, and its kind."""
        self.belief.watch(observations)
        return self._statistic()

    def _statistic(self) -> tuple[FloatArray, Actions]:
        options, belief = self.belief.setup.options, self.belief
        value = final_worth(options, belief.steps >= options.n_steps - 1, belief.quiet, belief.kinds)
        return value, self._declarations[belief.kinds.argmax(axis=1)]


class Probing(ThresholdPolicy):
    """Moves the voltage, and leaves the decision to a test."""

    def __init__(self, test: ThresholdPolicy) -> None:
        self.test, self.threshold = test, test.threshold

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self.test.start(count)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """What the test says."""
        return self.test.judge(observations)


class OpenLoop(Probing):
    """A test under voltages that were chosen beforehand.

    Args:
        test: decides.
        schedule: action of every step.
    """

    def __init__(self, test: ThresholdPolicy, schedule: Actions) -> None:
        super().__init__(test)
        self._schedule, self._step = schedule, -1

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._step = -1

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """What the test says."""
        self._step += 1
        return super().judge(observations)

    def probe(self) -> Actions:
        """The action that is due."""
        return np.full(self.count, self._schedule[self._step])


def winding_of(setup: Setup) -> int:
    """Number of the kind that a probe looks for."""
    kinds = setup.kinds
    require("winding" in kinds, f"a probe needs a recipe with winding faults, got {', '.join(kinds)}")
    return kinds.index("winding")


class OnDemand(Probing):
    """Moves the voltage while a winding fault is likely enough: on-off control of Banerjee & Veeravalli (2012).

    Each step changes sides. Left alone, the probability of a fault grows with the hazard until it is worth a look.

    Args:
        test: decides.
        above: probability of a winding fault from which on the voltage is moved.
    """

    test: WorthTest

    def __init__(self, test: WorthTest, above: float) -> None:
        super().__init__(test)
        self.above, self._winding = above, winding_of(test.belief.setup)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._side: NDArray[np.int64] = np.zeros(count, dtype=np.int64)

    def probe(self) -> Actions:
        """Move where a winding fault is likely enough."""
        moves = self.test.belief.kinds[:, self._winding] >= self.above
        actions = np.where(moves, 1 + self._side, 0)
        self._side = np.where(moves, 1 - self._side, self._side)
        return actions
