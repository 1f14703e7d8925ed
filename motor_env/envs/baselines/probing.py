"""Policies that move the voltage, and tests that know what it does: open loop, and as the posterior asks for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from motor_env.envs.baselines.belief import ProbeBelief, final_worth
from motor_env.envs.baselines.hypotheses import kind_matrix, known_faults
from motor_env.envs.baselines.looks import LOG_ODDS
from motor_env.envs.baselines.pairs import PLACES, Pair
from motor_env.envs.baselines.policies import Actions, Observations, ThresholdPolicy, declarations
from motor_env.envs.setup import Setup
from motor_env.motor.parameters import FloatArray, require


class Bursts(NamedTuple):
    """An open-loop probe: bursts of steps in which the voltage is moved; times in steps.

    Attributes:
        start: of the first burst.
        period: from burst to burst.
        length: of a burst; at most `period`.
        half_period: steps before the voltage changes sides; `length` or more: one pulse, always to the same side.
        first: action of the first side, 1 or 2, among the offsets.
    """

    start: int
    period: int
    length: int
    half_period: int = 1
    first: int = 1

    def actions(self, n_steps: int) -> Actions:
        """The action of every step of an episode, with offsets 1 and 2 as the two sides."""
        require(1 <= self.length <= self.period, f"length must be from 1 to {self.period}, got {self.length}")
        since = np.arange(n_steps) - self.start
        within = since % self.period
        side = (within // self.half_period) % 2
        moved = (since >= 0) & (within < self.length)
        return np.where(moved, np.where(side == 0, self.first, 3 - self.first), 0)


class RatioTest(ThresholdPolicy):
    """Declares the kind whose generalised likelihood ratio reaches a threshold: matched to the voltage applied.

    Args:
        setup: see `ProbeBelief`.
        threshold: log-likelihood ratio, maximised over onset and severity.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        self.belief, self.threshold = ProbeBelief(setup), threshold
        self._declarations = declarations(setup)
        self._seen = False

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self.belief.start(count)
        self._seen = False

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """The largest ratio, and its kind. The first observation follows no step."""
        if self._seen:
            self.belief.update(observations)
        self._seen = True
        return self._statistic()

    def _statistic(self) -> tuple[FloatArray, Actions]:
        ratios = self.belief.ratios
        return ratios.max(axis=1), self._declarations[ratios.argmax(axis=1)]


class WorthTest(RatioTest):
    """Declares the kind whose declaration is worth a threshold in expectation under the posterior.

    At the last step whatever is worth more than silence.
    """

    def _statistic(self) -> tuple[FloatArray, Actions]:
        options, belief = self.belief.setup.options, self.belief
        value = final_worth(options, belief.steps >= options.n_steps - 1, belief.quiet, belief.kinds)
        return value, self._declarations[belief.kinds.argmax(axis=1)]


class _Probing(ThresholdPolicy):
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


class OpenLoop(_Probing):
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


def _winding(setup: Setup) -> int:
    """Number of the kind that a probe looks for."""
    kinds = setup.kinds
    require("winding" in kinds, f"a probe needs a recipe with winding faults, got {', '.join(kinds)}")
    return kinds.index("winding")


class OnDemand(_Probing):
    """Moves the voltage while a winding fault is likely enough: on-off control of Banerjee & Veeravalli (2012).

    Each step changes sides. Left alone, the probability of a fault grows with the hazard until it is worth a look.

    Args:
        test: decides.
        above: probability of a winding fault from which on the voltage is moved.
        actions: of the two sides.
    """

    test: RatioTest

    def __init__(self, test: RatioTest, above: float, *, actions: tuple[int, int] = (1, 2)) -> None:
        super().__init__(test)
        self.above, self._actions = above, np.array(actions)
        self._winding = _winding(test.belief.setup)
        self._side: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._side = np.zeros(count, dtype=np.int64)

    def probe(self) -> Actions:
        """Move where a winding fault is likely enough."""
        moves = self.test.belief.kinds[:, self._winding] >= self.above
        actions = np.where(moves, self._actions[self._side], 0)
        self._side = np.where(moves, 1 - self._side, self._side)
        return actions


class LookAhead(_Probing):
    """Moves the voltage to where it is worth most, if one were told next which class of fault it may be (`pairs`).

    That is the worth of the posterior split into pairs, a class or none. Healthy motors are counted with the
    winding fault that shows least. As nobody tells the class, a look is worth more than that, by a bonus. (With
    the state told instead of the class: Littman, Cassandra & Kaelbling 1995.)

    Args:
        test: decides.
        bonus: what a step with a moved voltage is worth beyond.
    """

    test: RatioTest

    def __init__(self, test: RatioTest, bonus: float) -> None:
        super().__init__(test)
        setup = test.belief.setup
        options, faults = setup.options, known_faults(setup)
        self._pairs = [Pair(setup, which) for which in faults]
        self._offsets_v = np.array(options.offsets_v)
        self._bonus = np.where(self._offsets_v == 0.0, 0.0, bonus)[:, None]
        shown = np.array([pair.looks.information[3, 3] for pair in self._pairs])  # by 1 V
        hides = kind_matrix(setup, faults)[:, _winding(setup)] > 0.0
        self._hidden = int(np.where(hides, shown, np.inf).argmin())
        healthy = float(options.task.class_probabilities[setup.right_declarations == 0].sum())
        seeming = np.where(np.arange(len(self._pairs)) == self._hidden, healthy, 0.0)
        self._worths = [
            np.array([worth[..., 0].astype(np.float32) for worth in pair.worths(at)])[::-1]
            for pair, at in zip(self._pairs, seeming[:, None], strict=True)
        ]

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._places, self._last = np.zeros((len(self._pairs), 2, count)), np.zeros(count, dtype=np.int64)

    def probe(self) -> Actions:
        """The offset that is worth most."""
        belief = self.test.belief
        present, absent = belief.classes, belief.coming
        absent[:, self._hidden] += np.maximum(belief.quiet - absent.sum(axis=1), 0.0)
        with np.errstate(divide="ignore"):
            odds = np.clip(np.log(present) - np.log(absent), LOG_ODDS[0], LOG_ODDS[-1])
        at = (odds - LOG_ODDS[0]) / (LOG_ODDS[1] - LOG_ODDS[0])
        total = np.tile(self._bonus, self.count)
        for c, (pair, worths) in enumerate(zip(self._pairs, self._worths, strict=True)):
            where = [self._last, *pair.coordinates(self._places[c]), at[:, c]]
            for m, table in enumerate(worths[belief.steps[0]]):
                cube = table.reshape(-1, PLACES, PLACES, len(LOG_ODDS))
                total[m] += (present + absent)[:, c] * map_coordinates(cube, where, order=1)
        last, self._last = self._last, total.argmax(axis=0)
        before, now = self._offsets_v[last], self._offsets_v[self._last]
        for c, pair in enumerate(self._pairs):
            self._places[c] = pair.looks.move @ [*self._places[c], before, now, np.ones(self.count)]
        return self._last
