"""The posterior over onset and fault of a monitored motor that is known up to its tolerances, as a policy.

Before a fault the current of a motor at its operating point rests; where, depends on the tolerances: a level with a
normal prior. A fault then adds its signature, to first order that of the nominal motor. So every hypothesis (class c,
onset k) is a known signal on an unknown level in white noise, and the level can be integrated out: the log-likelihood
ratio to a healthy motor is s'P y - s'P s / 2, with P = 1 - 11' / (n + v) after n samples and a level of variance 1 / v.
A noise fault makes the same residual larger. Onsets are counted in blocks, as though in the middle of one.
"""

from __future__ import annotations

import numpy as np

from motor_env.envs.options import MonitorOptions
from motor_env.envs.policies.posterior_policies import PosteriorPolicy, signatures
from motor_env.envs.policies.rule_policies import Actions, Observations
from motor_env.envs.setup import Setup
from motor_env.motor.compiled import njit
from motor_env.motor.model import State, steady_state
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray

BLOCK = 5
SMALLEST = 30.0  # what is less likely than the likeliest by exp(-30) is left out


def level_std(options: MonitorOptions) -> float:
    """Standard deviation of the current at rest over the tolerances, to first order, in those of the sensor's noise."""
    recipe, spread = options.task, options.task.spread
    motor, volts = recipe.motor, float(recipe.supply.voltage_v)
    moved = [(motor, volts * (1.0 + spread.supply))]
    for quantity, names in QUANTITY_FIELDS.items():
        factor = 1.0 + getattr(spread, quantity, 0.0)
        moved += [(motor.scaled(**dict.fromkeys(names, factor)), volts)]
    rest = [steady_state(*each, options.load_n_m)[State.CURRENT] for each in ((motor, volts), *moved)]
    return float(np.linalg.norm(np.array(rest[1:]) - rest[0]) / recipe.sensor.current_noise_a)


@njit(cache=True, error_model="numpy")
def _weigh(
    deviation: FloatArray,
    shift: FloatArray,
    signature: FloatArray,
    explained: FloatArray,
    age: int,
    per_level: float,
    log_prior: FloatArray,
    mass: FloatArray,
    largest: FloatArray,
) -> None:
    """One more sample of every lane.

    Args:
        deviation: of the current from the nominal rest, shape (n_lanes,).
        shift: the level that all samples so far speak for, shape (n_lanes,).
        signature: and its sums over the ages: of itself, of its squares; shape (3, n_classes, n_samples).
        explained: sums of signature times deviation, shape (n_lanes, n_classes, n_blocks), changed in place.
        age: of the first block, in samples.
        per_level: 1 / (n + v).
        log_prior: of an onset in every block, shape (n_blocks,).
        mass: written: weights summed over the onsets, shape (n_lanes, n_classes), in the unit exp(largest).
        largest: written: logarithm of the largest weight, at least 0, shape (n_lanes,).
    """
    begun = min(age // BLOCK + 1, len(log_prior))
    logs = np.empty((signature.shape[1], begun))
    for n in range(len(deviation)):
        high = 0.0
        for c in range(signature.shape[1]):
            for block in range(begun):
                since = age - BLOCK * block
                explained[n, c, block] += signature[0, c, since] * deviation[n]
                total, squares = signature[1, c, since], signature[2, c, since]
                ratio = (
                    explained[n, c, block] - total * shift[n] - 0.5 * (squares - total * total * per_level)
                )
                logs[c, block] = ratio + log_prior[block]
                high = max(high, logs[c, block])
        largest[n] = high
        for c in range(signature.shape[1]):
            mass[n, c] = 0.0
            for block in range(begun):
                if logs[c, block] > high - SMALLEST:
                    mass[n, c] += np.exp(logs[c, block] - high)


class TolerancePolicy(PosteriorPolicy):
    """Declares the kind whose declaration is worth a threshold in expectation under the posterior of a tolerant motor.

    Args:
        setup: of a Monitor-v0 that starts running, with an abrupt fault, that observes `measured_current`.
        threshold: of the expected reward.

    Raises:
        ValueError: a step has several samples, or the measured current is not observed.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        options = setup.options
        found = [(m, c, c.kind) for m, c in enumerate(options.task.classes) if c.kind is not None]
        faults = [m for m, _, _ in found]
        super().__init__(setup, threshold, faults=faults)
        self._noise_std = np.array([kind.factor("noise", c.severity) ** 0.5 for _, c, kind in found])
        self._moves = self._noise_std == 1.0
        shown = signatures(setup, options.n_samples)[faults][self._moves]
        self._signature = np.array([shown, shown.cumsum(axis=1), np.square(shown).cumsum(axis=1)])
        self._precision = 1.0 / max(level_std(options), 1e-6) ** 2
        n_blocks = (options.n_samples - self._earliest) // BLOCK
        block_prior = self._stay ** (BLOCK * np.arange(n_blocks)) * (1.0 - self._stay**BLOCK)
        self._log_prior = np.log(block_prior)

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._explained = np.zeros((count, self._signature.shape[1], len(self._log_prior)))
        self._mass, self._largest = np.zeros((count, self._signature.shape[1])), np.zeros(count)
        self._louder = np.full((count, int((~self._moves).sum())), -np.inf)  # logarithm of the weight
        self._sum = np.zeros(count)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Worth of the best declaration, and that."""
        self._sample += 1
        deviation = self._deviation(observations)
        per_level = 1.0 / (self._sample + self._precision)
        surprise = (deviation - self._sum * per_level) / np.sqrt(1.0 + per_level)
        self._sum += deviation
        per_level = 1.0 / (self._sample + 1 + self._precision)
        since = (
            self._sample - 1 - self._earliest
        )  # samples after the first interval in which a fault can set in
        middle = since - BLOCK // 2
        if middle >= 0:
            _weigh(
                deviation,
                self._sum * per_level,
                self._signature,
                self._explained,
                middle,
                per_level,
                self._log_prior,
                self._mass,
                self._largest,
            )
        if since >= 0:
            std = self._noise_std[~self._moves]
            begins = np.log(self._stay**since * (1.0 - self._stay))
            gain = 0.5 * np.square(surprise)[:, None] * (1.0 - std**-2.0) - np.log(std)
            self._louder = np.logaddexp(self._louder, begins) + gain
        return self._judgement(middle)

    def _judgement(self, middle: int) -> tuple[FloatArray, Actions]:
        """Posterior, and what it is worth to declare."""
        high = np.maximum(self._largest, self._louder.max(axis=1, initial=0.0))
        unit = np.exp(-high)
        begun = min(middle // BLOCK + 1, len(self._log_prior)) if middle >= 0 else 0
        weights = np.zeros((self.count, len(self._moves)))
        weights[:, self._moves] = self._mass * np.exp(self._largest - high)[:, None]
        weights[:, ~self._moves] = np.exp(self._louder - high[:, None])
        weights *= self._class_prior
        faulty = self._class_prior.sum()
        quiet = (1.0 - faulty + faulty * self._stay ** (BLOCK * begun)) * unit
        return self._decision(quiet, weights)
