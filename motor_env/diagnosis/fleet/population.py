"""Learn mean and spread of the healthy core of a population that includes faulty motors.

The logarithms of a record are the centre of its core plus deviations from motor to motor and record to record, and the
fit's own error. A motor outside the core deviates along one quantity, a fault or gain, or all (contaminated normal
distribution; Tukey 1960). Expectation-maximisation gives the probability of the core (Dempster, Laird & Rubin 1977).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT
from motor_env.motor.parameters import FloatArray

_SICK_SPREAD = 10.0  # of a sick motor, over the prior of healthy ones
_INITIAL_SHARE = 0.75  # of the motors, from which the core grows
_STEPS = 20
_SICK, _SICK_OF = 1.0, 10.0  # prior: one motor in ten
_MAD = 1.4826  # of a normal distribution
_MOST_WITHIN = 0.8  # of the variance of another motor's record
_ROUNDS, _CONVERGED = 200, 1e-6


@dataclass(frozen=True)
class Motors:
    """Quantities of the records of several motors.

    Attributes:
        logs: logarithms of each record, shape (n_records, p).
        errors: their covariance by the fit, shape (n_records, p, p).
        motor: index of each record's motor, shape (n_records,).
        position: index of each motor's place, shape (n_motors,).
        between, within: prior covariance from motor to motor, and from record to record, shape (p, p).
        directions: of faults that move several quantities, shape (m, p).
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
        """Return the additional covariances of sick motors: along each direction, and along all, (p, p) each."""
        p = len(self.between)
        axes = np.eye(p) if self.directions is None else np.vstack([np.eye(p), self.directions])
        inverse = np.linalg.inv(self.between)
        sizes = _SICK_SPREAD**2 / np.einsum("np,pq,nq->n", axes, inverse, axes)
        along = [size * np.outer(axis, axis) for size, axis in zip(sizes.tolist(), axes, strict=True)]
        return [*along, _SICK_SPREAD**2 * np.diag(self.between.diagonal())]

    def subset(self, mask: NDArray[np.bool_]) -> Motors:
        """Select motors by `mask`, shape (n_motors,)."""
        records = mask[self.motor]
        number = np.cumsum(mask) - 1
        return replace(
            self,
            logs=self.logs[records],
            errors=self.errors[records],
            motor=number[self.motor[records]],
            position=self.position[mask],
        )

    def within_covariance(self) -> FloatArray:
        """Estimate the covariance from record to record by repeated motors, shape (p, p).

        It uses the robust median deviation.
        """
        residual, freedom = [], 0
        for motor in np.flatnonzero(np.bincount(self.motor) > 1):
            logs = self.logs[self.motor == motor]
            residual.append((logs - logs.mean(axis=0)) * math.sqrt(len(logs) / (len(logs) - 1.0)))
            freedom += len(logs) - 1
        if not residual:
            return self.within
        error = np.median(self.errors.diagonal(axis1=1, axis2=2), axis=0)
        variance = np.maximum(
            np.square(_MAD * np.median(np.abs(np.concatenate(residual)), axis=0)) - error, 0.0
        )
        return (freedom * np.diag(variance) + PRIOR_WEIGHT * self.within) / (freedom + PRIOR_WEIGHT)

    def means(self, within: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each motor's mean logarithms and their covariance, (n_motors, p) and (n_motors, p, p).

        Args:
            within: covariance from record to record, shape (p, p).
        """
        count, p = len(self.position), self.logs.shape[1]
        weights = np.linalg.inv(within + self.errors)
        information, pulled = np.zeros((count, p, p)), np.zeros((count, p))
        np.add.at(information, self.motor, weights)
        np.add.at(pulled, self.motor, np.einsum("npq,nq->np", weights, self.logs))
        covariance: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
        means: FloatArray = np.einsum("npq,nq->np", covariance, pulled)
        return means, covariance


@dataclass(frozen=True, slots=True)
class HealthyPopulation:
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
        """Return the covariance of another healthy motor, without errors of records, shape (p, p)."""
        found: FloatArray = self.between + self.centre_covariances[position]
        return found


def learn_population(motors: Motors, begin: HealthyPopulation | None = None) -> HealthyPopulation:
    """Find the healthy core of some motors.

    Records are first independent; repeated motors then give the spread from record to record.

    Args:
        motors: their records.
        begin: initial core, of similar motors.
    """
    repeats = np.bincount(motors.motor)
    share = 1.0 / repeats[motors.motor]
    if begin is None:
        # A small healthy fleet may have a tight half by chance: the likelier of both initial values counts.
        ends = [
            _run_em(first, motors, share)
            for first in (_initial_population(motors), _initial_population(motors, 1.0))
        ]
        population, _ = max(ends, key=lambda end: end[1])
    else:
        at_once = replace(begin, between=begin.between + begin.within, probability=np.ones(len(motors.logs)))
        population, _ = _run_em(at_once, motors, share)
    total, of_records = population.between, motors.within_covariance()
    within = np.diag(np.minimum(of_records.diagonal(), _MOST_WITHIN * total.diagonal()))
    return replace(
        population,
        between=floor_covariance(total - within, (1.0 - _MOST_WITHIN) * total),
        within=within,
        probability=np.bincount(motors.motor, population.probability) / repeats,
    )


def _run_em(
    population: HealthyPopulation, motors: Motors, share: FloatArray
) -> tuple[HealthyPopulation, float]:
    """Iterate to convergence; return also the log posterior."""
    for _ in range(_ROUNDS):
        before, (population, likelihood) = population, _em_round(population, motors, share)
        moved = max(
            np.abs(population.centres - before.centres).max(),
            np.abs(population.between - before.between).max(),
        )
        if moved < _CONVERGED:
            break
    log_size = float(np.linalg.slogdet(population.between)[1])
    believed = (
        -0.5
        * PRIOR_WEIGHT
        * (log_size + float(np.trace(np.linalg.solve(population.between, motors.between))))
    )
    return population, likelihood + believed


def _initial_population(motors: Motors, part: float = _INITIAL_SHARE) -> HealthyPopulation:
    """Choose the part of the records with the least spread (Rousseeuw & Van Driessen 1999).

    A known factor corrects its spread.
    """
    logs, errors, position = motors.logs, motors.errors, motors.position[motors.motor]
    (count, p), places = logs.shape, int(position.max()) + 1
    n_core = max(math.ceil(part * count), min(p + 1, count))
    far = float(chi2.ppf(n_core / count, p)) if n_core < count else math.inf
    factor = n_core / count / float(chi2.cdf(far, p + 2))
    error = np.median(errors.diagonal(axis1=1, axis2=2), axis=0)
    healthy = np.ones(count)
    centres = np.stack([np.median(logs[position == n], axis=0) for n in range(places)])
    residual = logs - centres[position]
    scatter = np.square(_MAD * np.median(np.abs(residual), axis=0)) - error
    between = np.diag(np.maximum(scatter, motors.between.diagonal() / PRIOR_WEIGHT))
    for _ in range(_STEPS):
        distance = np.einsum("np,npq,nq->n", residual, np.linalg.inv(between + errors), residual)
        before, healthy = healthy, np.zeros(count)
        healthy[np.argsort(distance, kind="stable")[:n_core]] = 1.0
        if np.array_equal(before, healthy):
            break
        some = [(position == n) & (healthy > 0.0) for n in range(places)]
        centres = np.stack(
            [logs[members].mean(axis=0) if members.any() else centres[n] for n, members in enumerate(some)]
        )
        residual = logs - centres[position]
        inside = residual[healthy > 0.0]
        scatter = factor * (inside.T @ inside) - n_core * np.diag(error)
        between = floor_covariance(
            (scatter + PRIOR_WEIGHT * motors.between) / (n_core + PRIOR_WEIGHT), motors.between / count
        )
    zeros = np.zeros((places, p, p))
    return HealthyPopulation(centres, zeros, between, motors.within, PRIOR_WEIGHT, healthy)


def floor_covariance(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """Raise a covariance to at least another one in each direction."""
    root = np.linalg.cholesky(least)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ covariance @ inverse.T)
    found: FloatArray = (root @ axes * np.maximum(sizes, 1.0)) @ (root @ axes).T
    return found


def _log_density(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """Compute normal log densities without their constant; shapes (n, p) and (n, p, p)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, residual[..., None])[..., 0]
    size = np.log(root.diagonal(axis1=-2, axis2=-1)).sum(axis=-1)
    found: FloatArray = -0.5 * np.square(white).sum(axis=-1) - size
    return found


def _em_round(
    population: HealthyPopulation, motors: Motors, share: FloatArray
) -> tuple[HealthyPopulation, float]:
    """Update probabilities, centres and spread; return also the log likelihood before.

    `share` weights each record, shape (n_records,).
    """
    logs, errors, position = motors.logs, motors.errors, motors.position[motors.motor]
    residual, spread = logs - population.centres[position], population.between + errors
    log_healthy = _log_density(residual, spread)
    every = [_log_density(residual, spread + extra) for extra in motors.sick]
    log_sick = np.logaddexp.reduce(every, axis=0) - math.log(len(every))
    sick = (_SICK + float(share @ (1.0 - population.probability))) / (_SICK_OF + float(share.sum()))
    healthy = 1.0 / (1.0 + sick / (1.0 - sick) * np.exp(np.clip(log_sick - log_healthy, -500.0, 500.0)))
    counts = share * healthy
    likelihood = float(share @ np.logaddexp(log_healthy + math.log1p(-sick), log_sick + math.log(sick)))
    weights = np.linalg.inv(spread) * counts[:, None, None]
    centres, covariances = [], []
    for n in range(len(population.centres)):
        here = position == n
        covariance = np.linalg.inv(weights[here].sum(axis=0))
        centres.append(covariance @ np.einsum("npq,nq->p", weights[here], logs[here]))
        covariances.append(covariance)
    residual = logs - np.stack(centres)[position]
    gain = population.between @ np.linalg.inv(spread)
    deviation = np.einsum("npq,nq->np", gain, residual)
    posterior = population.between - gain @ population.between
    scatter = np.einsum("n,npq->pq", counts, deviation[:, :, None] * deviation[:, None, :] + posterior)
    freedom = max(float(counts.sum()) - len(centres), 0.0) + PRIOR_WEIGHT
    between = (scatter + PRIOR_WEIGHT * motors.between) / freedom
    after = replace(
        population,
        centres=np.stack(centres),
        centre_covariances=np.stack(covariances),
        between=0.5 * (between + between.T),
        degrees_of_freedom=freedom,
        probability=healthy,
    )
    return after, likelihood
