"""What the best policy of a probing task gets that is told which class of fault it may be: that class, or none.

What is unknown then is whether the fault has set in, one probability. Dynamic programming over it and over the place to
which the voltage has brought the motor gives the worth of every offset in every step. The value is convex in the
probability, so that interpolating it there errs upwards. A fault is taken to show, from its first step on, what one
shows that has been there for long, or more (4 ms later it does).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from looks import LOG_ODDS, PROBABILITY, look_matrix, looks

from motor_env.envs.options import MonitorOptions
from motor_env.envs.policies.fault_posterior import onset_law
from motor_env.envs.setup import Setup
from motor_env.motor.parameters import FloatArray

PLACES = 9
START = PLACES**2 // 2  # the place of a motor that was left alone


def declared_worth(options: MonitorOptions) -> FloatArray:
    """Worth of declaring the one fault that there can be, by its log-odds."""
    return PROBABILITY * options.correct_reward - (1.0 - PROBABILITY) * options.false_alarm_cost


def silent_worth(options: MonitorOptions) -> FloatArray:
    """Worth of being silent at the horizon, by the log-odds of the fault."""
    return (1.0 - PROBABILITY) * options.silent_reward - PROBABILITY * options.miss_cost


class Pair:
    """A class of fault, or none, on a probing task.

    Args:
        setup: of the task.
        which: number of the class.

    Attributes:
        looks: what a step shows of the class.
    """

    def __init__(self, setup: Setup, which: int) -> None:
        self.looks = looks(setup, which)
        self._options = options = setup.options
        self._chance = float(options.task.class_probabilities[which])
        self._stay, self._earliest = onset_law(options)
        axes = [np.linspace(-reach, reach, PLACES) for reach in self.looks.reach]
        healthy, moved = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        one, look, move = np.ones_like(healthy), [], []
        for offset, last in product(options.offsets_v, options.offsets_v):
            # of a fault that has been there, and of one that sets in: the place is where it was
            shown = [[healthy, place, last * one, offset * one, one] for place in (moved, 0.0 * one)]
            information = np.einsum("qip,ij,qjp->qp", shown, self.looks.information, shown).max(axis=0)
            look.append([look_matrix(value).astype(np.float32) for value in information])
            move.append(self._weights(self.looks.move @ shown[0]))
        n = len(options.offsets_v)
        self._look = np.array(look).reshape(n, n * len(one), len(LOG_ODDS), -1)
        self._move = np.array(move, dtype=np.float32).reshape(n, n * len(one), -1)

    def coordinates(self, place: FloatArray) -> FloatArray:
        """Where on the grid a place lies, from 0 to PLACES - 1; both of shape (2, n)."""
        at = (place / self.looks.reach[:, None] + 1.0) * 0.5 * (PLACES - 1)
        return np.clip(at, 0.0, PLACES - 1.0)

    def _weights(self, place: FloatArray) -> FloatArray:
        """What each place of the grid counts at other places, shape (n, PLACES^2)."""
        at = self.coordinates(place)[:, :, None]
        first, second = np.maximum(1.0 - np.abs(at - np.arange(PLACES)), 0.0)
        weights: FloatArray = (first[:, :, None] * second[:, None]).reshape(len(first), -1)
        return weights

    def worths(self, seeming: FloatArray) -> Iterator[FloatArray]:
        """Worth of each offset after each last offset, the last step first.

        Args:
            seeming: probabilities of a healthy episode in which this class is named, shape (n_seeming,).

        Yields:
            Shape (n_offsets, n_offsets, PLACES^2, log-odds of the fault, n_seeming).
        """
        options, p, n = self._options, PROBABILITY[:, None], len(self._look)
        per_step = options.samples_per_step
        step_s, offsets = options.dt_s * per_step, np.array(options.offsets_v)
        price = options.probe_cost_per_v2_s * step_s * offsets[:, None, None, None] ** 2
        shape = (n, PLACES**2, len(p), len(seeming))
        value = np.broadcast_to(silent_worth(options)[:, None], shape)
        declared, column = declared_worth(options)[:, None], np.arange(len(seeming))
        for step in reversed(range(options.n_steps)):
            since = np.maximum(np.array([step, step + 1]) * per_step - self._earliest, 0)
            unborn, later = self._chance * self._stay**since
            sets_in = (1.0 - p) * (unborn - later) / (unborn + seeming)
            following = self._move @ value.reshape(n, PLACES**2, -1).astype(np.float32)
            seen = self._look @ following.reshape(n, -1, *shape[2:])
            low = np.clip(np.searchsorted(PROBABILITY, p + sets_in) - 1, 0, len(LOG_ODDS) - 2)
            at = (p + sets_in - PROBABILITY[low]) / (PROBABILITY[low + 1] - PROBABILITY[low])
            seen = (1.0 - at) * seen[:, :, low, column] + at * seen[:, :, low + 1, column]
            delay = (
                options.delay_cost_per_s * step_s * (p + 0.5 * sets_in)
            )  # one that comes does so in mid-step
            worth = (seen - delay - price).reshape(n, *shape)
            yield worth
            value = np.maximum(worth.max(axis=0), declared)

    def totals(self, seeming: FloatArray) -> FloatArray:
        """What the episodes in which the class is named contribute to the mean return at most, shape (n_seeming,)."""
        for worth in self.worths(seeming):
            first: FloatArray = worth[:, 0, START, 0].max(axis=0)
        return (self._chance + seeming) * first
