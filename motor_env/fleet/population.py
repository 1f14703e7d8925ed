"""A population of motors: where its healthy core lies and how far it scatters, learned while sick ones are in it.

Each motor's logarithms are those of its core, off by what differs from motor to motor; each record of it is off again
by what differs from record to record, and by its fit's own error. A motor is of the core, or sick: off along one
quantity, along the direction of a fault or gain, or along all (a contaminated normal distribution; Tukey 1960).
Expectation and maximisation give each motor its probability of being of the core (Dempster, Laird & Rubin 1977). Motors
are judged by the core alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from motor_env.diagnosis.healthy_spread import PRIOR_WEIGHT
from motor_env.motor.parameters import FloatArray

_SICK_SPREAD = 10.0  # of a sick motor, over what is believed of healthy ones
_TIGHTEST = 0.75  # of the motors, from which the core grows
_STEPS = 20
_SICK, _SICK_OF = 1.0, 10.0  # prior: one motor in ten
_MAD = 1.4826  # of a normal distribution
_MOST_WITHIN = 0.8  # of the variance of another motor's record
_ROUNDS, _SETTLED = 200, 1e-6


@dataclass(frozen=True)
class Motors:
    """Records of several motors: all their quantities.

    Attributes:
        logs: logarithms that each record tells, shape (n_records, p).
        errors: their covariance by the fit, shape (n_records, p, p).
        motor: number of each record's motor, 0 to n_motors - 1, shape (n_records,).
        position: number of each motor's place in its machine, such as left or right, shape (n_motors,).
        between, within: covariance from motor to motor, and from record to record of one motor, as believed before any
            is seen, shape (p, p).
        directions: in which faults move several quantities at once, shape (m, p); each moves alone in any case.
    """

    logs: FloatArray
    errors: FloatArray
    motor: NDArray[np.intp]
    position: NDArray[np.intp]
    between: FloatArray
    within: FloatArray
    directions: FloatArray | None = None

    @cached_property
    def sick(self) -> list[FloatArray]:
        """What sick motors scatter by in addition: along one direction each, and along all, shape (p, p) each."""
        p = len(self.between)
        axes = np.eye(p) if self.directions is None else np.vstack([np.eye(p), self.directions])
        inverse = np.linalg.inv(self.between)
        sizes = _SICK_SPREAD**2 / np.einsum("np,pq,nq->n", axes, inverse, axes)
        along = [size * np.outer(axis, axis) for size, axis in zip(sizes.tolist(), axes, strict=True)]
        return [*along, _SICK_SPREAD**2 * np.diag(self.between.diagonal())]

    def only(self, kept: NDArray[np.bool_]) -> Motors:
        """Those motors alone, `kept` of shape (n_motors,)."""
        records = kept[self.motor]
        number = np.cumsum(kept) - 1
        return replace(
            self,
            logs=self.logs[records],
            errors=self.errors[records],
            motor=number[self.motor[records]],
            position=self.position[kept],
        )

    def spread_of_records(self) -> FloatArray:
        """Covariance from record to record of one motor, by those that are repeated, shape (p, p).

        The median of their deviations counts: a record may be wrong, and few motors are repeated.
        """
        off, told = [], 0
        for motor in np.flatnonzero(np.bincount(self.motor) > 1):
            own = self.logs[self.motor == motor]
            off.append((own - own.mean(axis=0)) * math.sqrt(len(own) / (len(own) - 1.0)))
            told += len(own) - 1
        if not off:
            return self.within
        error = np.median(self.errors.diagonal(axis1=1, axis2=2), axis=0)
        seen = np.maximum(np.square(_MAD * np.median(np.abs(np.concatenate(off)), axis=0)) - error, 0.0)
        return (told * np.diag(seen) + PRIOR_WEIGHT * self.within) / (told + PRIOR_WEIGHT)

    def means(self, within: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Each motor's own logarithms and their covariance, shapes (n_motors, p) and (n_motors, p, p).

        Args:
            within: covariance from record to record, shape (p, p).
        """
        count, p = len(self.position), self.logs.shape[1]
        weights = np.linalg.inv(within + self.errors)
        information, pulled = np.zeros((count, p, p)), np.zeros((count, p))
        np.add.at(information, self.motor, weights)
        np.add.at(pulled, self.motor, np.einsum("npq,nq->np", weights, self.logs))
        covariance: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
        own: FloatArray = np.einsum("npq,nq->np", covariance, pulled)
        return own, covariance


@dataclass(frozen=True, slots=True)
class Core:
    """The healthy core of a population.

    Attributes:
        centres: mean logarithms for each position, shape (n_positions, p).
        centre_covariances: their errors, shape (n_positions, p, p).
        between: covariance from motor to motor, shape (p, p).
        within: covariance from record to record of one motor, shape (p, p).
        degrees_of_freedom: of their sum.
        probability: that each motor is of the core, shape (n_motors,).
    """

    centres: FloatArray
    centre_covariances: FloatArray
    between: FloatArray
    within: FloatArray
    degrees_of_freedom: float
    probability: FloatArray

    def next_motor(self, position: int = 0) -> FloatArray:
        """Covariance of another healthy motor about the centre, without errors of records, shape (p, p)."""
        found: FloatArray = self.between + self.centre_covariances[position]
        return found


def learn_core(motors: Motors, begin: Core | None = None) -> Core:
    """Find the healthy core of some motors.

    Records are taken by themselves, those of one motor together as one: their spread is that of another motor's
    record. How much of it is from record to record is told by the motors that are repeated.

    Args:
        motors: their records.
        begin: a core of nearly the same motors, to begin from.
    """
    repeats = np.bincount(motors.motor)
    share = 1.0 / repeats[motors.motor]
    if begin is None:
        # Few healthy motors have a tight half by chance; of many with sick ones among them the tight one is likelier.
        ends = [_settled(first, motors, share) for first in (_tightest(motors), _tightest(motors, 1.0))]
        core, _ = max(ends, key=lambda end: end[1])
    else:
        at_once = replace(begin, between=begin.between + begin.within, probability=np.ones(len(motors.logs)))
        core, _ = _settled(at_once, motors, share)
    total, of_records = core.between, motors.spread_of_records()
    within = np.diag(np.minimum(of_records.diagonal(), _MOST_WITHIN * total.diagonal()))
    return replace(
        core,
        between=at_least(total - within, (1.0 - _MOST_WITHIN) * total),
        within=within,
        probability=np.bincount(motors.motor, core.probability) / repeats,
    )


def _settled(core: Core, motors: Motors, share: FloatArray) -> tuple[Core, float]:
    """Where the rounds end, and the logarithm of its posterior probability."""
    for _ in range(_ROUNDS):
        before, (core, likelihood) = core, _updated(core, motors, share)
        moved = max(np.abs(core.centres - before.centres).max(), np.abs(core.between - before.between).max())
        if moved < _SETTLED:
            break
    log_size = float(np.linalg.slogdet(core.between)[1])
    believed = (
        -0.5 * PRIOR_WEIGHT * (log_size + float(np.trace(np.linalg.solve(core.between, motors.between))))
    )
    return core, likelihood + believed


def _tightest(motors: Motors, part: float = _TIGHTEST) -> Core:
    """Where to begin: at a part of the records that lies closest together (Rousseeuw & Van Driessen 1999).

    The spread of these is less than that of all of a normal distribution, by a known factor.
    """
    logs, errors, position = motors.logs, motors.errors, motors.position[motors.motor]
    (count, p), places = logs.shape, int(position.max()) + 1
    kept = max(math.ceil(part * count), min(p + 1, count))
    far = float(chi2.ppf(kept / count, p)) if kept < count else math.inf
    factor = kept / count / float(chi2.cdf(far, p + 2))
    error = np.median(errors.diagonal(axis1=1, axis2=2), axis=0)
    healthy = np.ones(count)
    centres = np.stack([np.median(logs[position == n], axis=0) for n in range(places)])
    off = logs - centres[position]
    scatter = np.square(_MAD * np.median(np.abs(off), axis=0)) - error
    between = np.diag(np.maximum(scatter, motors.between.diagonal() / PRIOR_WEIGHT))
    for _ in range(_STEPS):
        distance = np.einsum("np,npq,nq->n", off, np.linalg.inv(between + errors), off)
        before, healthy = healthy, np.zeros(count)
        healthy[np.argsort(distance, kind="stable")[:kept]] = 1.0
        if np.array_equal(before, healthy):
            break
        some = [(position == n) & (healthy > 0.0) for n in range(places)]
        centres = np.stack(
            [logs[one].mean(axis=0) if one.any() else centres[n] for n, one in enumerate(some)]
        )
        off = logs - centres[position]
        inside = off[healthy > 0.0]
        scatter = factor * (inside.T @ inside) - kept * np.diag(error)
        between = at_least(
            (scatter + PRIOR_WEIGHT * motors.between) / (kept + PRIOR_WEIGHT), motors.between / count
        )
    zeros = np.zeros((places, p, p))
    return Core(centres, zeros, between, motors.within, PRIOR_WEIGHT, healthy)


def at_least(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """A covariance that is at least another one in each direction (of an estimate that may be negative)."""
    root = np.linalg.cholesky(least)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ covariance @ inverse.T)
    found: FloatArray = (root @ axes * np.maximum(sizes, 1.0)) @ (root @ axes).T
    return found


def _log_density(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Logarithms of normal densities without their constant; shapes (n, p) and (n, p, p)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, off[..., None])[..., 0]
    size = np.log(root.diagonal(axis1=-2, axis2=-1)).sum(axis=-1)
    found: FloatArray = -0.5 * np.square(white).sum(axis=-1) - size
    return found


def _updated(core: Core, motors: Motors, share: FloatArray) -> tuple[Core, float]:
    """One round: probabilities, centres, and the spread; and the log likelihood before it.

    Each record counts by its share of its motor, shape (n_records,).
    """
    logs, errors, position = motors.logs, motors.errors, motors.position[motors.motor]
    off, spread = logs - core.centres[position], core.between + errors
    well = _log_density(off, spread)
    every = [_log_density(off, spread + way) for way in motors.sick]
    ill = np.logaddexp.reduce(every, axis=0) - math.log(len(every))
    sick = (_SICK + float(share @ (1.0 - core.probability))) / (_SICK_OF + float(share.sum()))
    healthy = 1.0 / (1.0 + sick / (1.0 - sick) * np.exp(np.clip(ill - well, -500.0, 500.0)))
    counts = share * healthy
    likelihood = float(share @ np.logaddexp(well + math.log1p(-sick), ill + math.log(sick)))
    weights = np.linalg.inv(spread) * counts[:, None, None]
    centres, covariances = [], []
    for n in range(len(core.centres)):
        here = position == n
        covariance = np.linalg.inv(weights[here].sum(axis=0))
        centres.append(covariance @ np.einsum("npq,nq->p", weights[here], logs[here]))
        covariances.append(covariance)
    off = logs - np.stack(centres)[position]
    gain = core.between @ np.linalg.inv(spread)
    own = np.einsum("npq,nq->np", gain, off)
    left = core.between - gain @ core.between
    scatter = np.einsum("n,npq->pq", counts, own[:, :, None] * own[:, None, :] + left)
    freedom = max(float(counts.sum()) - len(centres), 0.0) + PRIOR_WEIGHT
    between = (scatter + PRIOR_WEIGHT * motors.between) / freedom
    after = replace(
        core,
        centres=np.stack(centres),
        centre_covariances=np.stack(covariances),
        between=0.5 * (between + between.T),
        degrees_of_freedom=freedom,
        probability=healthy,
    )
    return after, likelihood
