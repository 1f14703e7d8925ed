"""Tests and probes that only the tables have: the likelihood ratio under a probe, and a look ahead."""

from __future__ import annotations

import numpy as np
from looks import LOG_ODDS
from pairs import PLACES, Pair
from scipy.ndimage import map_coordinates

from motor_env.envs.policies.fault_posterior import kind_matrix, known_faults
from motor_env.envs.policies.posterior_policies import ExpectedRewardTest, Probing, winding_of
from motor_env.envs.policies.rule_policies import Actions
from motor_env.motor.parameters import FloatArray


class RatioTest(ExpectedRewardTest):
    """Declares the kind whose generalised likelihood ratio reaches a threshold: matched to the voltage applied.

    Args:
        setup: see `ProbeBelief`.
        threshold: log-likelihood ratio, maximised over onset and severity.
    """

    def _statistic(self) -> tuple[FloatArray, Actions]:
        ratios = self.belief.ratios
        return ratios.max(axis=1), self._declarations[ratios.argmax(axis=1)]


class LookAhead(Probing):
    """Moves the voltage to where it is worth most, if one were told next which class of fault it may be (`pairs`).

    That is the worth of the posterior split into pairs, a class or none. Healthy motors are counted with the
    winding fault that shows least. As nobody tells the class, a look is worth more than that, by a bonus. (With
    the state told instead of the class: Littman, Cassandra & Kaelbling 1995.)

    Args:
        test: decides.
        bonus: what a step with a moved voltage is worth beyond.
    """

    test: ExpectedRewardTest

    def __init__(self, test: ExpectedRewardTest, bonus: float) -> None:
        super().__init__(test)
        setup = test.belief.setup
        options, faults = setup.options, known_faults(setup)
        self._pairs = [Pair(setup, which) for which in faults]
        self._offsets_v = np.array(options.offsets_v)
        self._bonus = np.where(self._offsets_v == 0.0, 0.0, bonus)[:, None]
        shown = np.array([pair.looks.information[3, 3] for pair in self._pairs])  # by 1 V
        hides = kind_matrix(setup, faults)[:, winding_of(setup)] > 0.0
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
