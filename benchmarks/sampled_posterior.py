"""The posterior over the classes of a recipe with a table `field` or `duty`, which has no closed form: sampled.

Around the best fit a start is nearly linear in its nuisances. Their posterior is then a normal distribution cut to the
box of the uniform priors, and easy to draw from. Each draw is simulated exactly, and its weight puts right what the
linear motor has wrong. Adaptive multiple importance sampling (Cornuet et al. 2012) moves the distribution until the
weights are even; the mean weight is the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import brentq, least_squares
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri_exp, softmax

from motor_env.inference.class_model import ClassModel
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FACTORS, Recipe

_DRAWS, _MOST_ROUNDS = 128, 16
_ENOUGH = 100.0  # effective draws with which sampling ends
_LOG_2PI = float(np.log(2.0 * np.pi))
_SMALLEST = 1e-300
_FEW = 20.0  # effective draws below which an evidence is not believed
_HOPELESS = 16.0  # log ratio of two best fits beyond which a class is not sampled
_NEGLIGIBLE = 8.0  # the same of evidences, beyond which it is not sampled again
_INSIDE = 0.02  # distance from the box at which a fit begins
_PACE = 0.01  # of differences, relative to the box
_DAMPING = 0.02  # of the regression, relative to the scatter of the draws


def log_joint(
    model: ClassModel, measured: FloatArray, readings: FloatArray, values: FloatArray
) -> FloatArray:
    """Log density of what was measured and of the coordinates in their box, shape (n,); nan: not measured."""
    noise, half = model.noise, 0.5 * model.steps
    error = (measured - readings) / noise
    normal = -0.5 * (np.square(error) + _LOG_2PI) - np.log(noise)
    shares = ndtr(error + half / noise) - ndtr(error - half / noise)
    logs = np.where(half > 0.0, np.log(np.maximum(shares, _SMALLEST)), normal)
    prior = -0.5 * (np.square(values[:, : len(FACTORS)]) + _LOG_2PI).sum(axis=1)
    joint: FloatArray = np.nansum(logs, axis=1) + prior
    return joint


def mirrored(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An interval mirrored to where the normal distribution's tail keeps its digits.

    Returns:
        The sign of the mirror, the log probability of what lies left of the interval, and that of the interval.
    """
    sign = np.where(low > 0.0, -1.0, 1.0)
    below, above = (
        log_ndtr(np.minimum(sign * low, sign * high)),
        log_ndtr(np.maximum(sign * low, sign * high)),
    )
    return sign, below, above + np.log(-np.expm1(below - above))


@dataclass(frozen=True, slots=True)
class TruncatedNormal:
    """A normal distribution cut to a box, as a product of normal intervals, one coordinate given those before it.

    A draw's density is that of this product, which the distribution itself is only nearly.

    Attributes:
        order: of the coordinates; those go first whose interval is hardest to hit.
        mean: before the cut, in this order, shape (size,).
        root: Cholesky factor of the covariance before the cut, in this order.
        low: of the box in this order; may be -inf.
        high: may be inf.
    """

    order: NDArray[np.intp]
    mean: FloatArray
    root: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def cut(cls, mean: FloatArray, precision: FloatArray, low: FloatArray, high: FloatArray) -> Self:
        """From mean and inverse covariance before the cut, and the box."""
        order = np.argsort(np.minimum(mean - low, high - mean))
        covariance = np.linalg.inv(precision)
        root = np.linalg.cholesky(covariance[np.ix_(order, order)])
        return cls(order, mean[order], root, low[order], high[order])

    def draw(self, rng: np.random.Generator, n_draws: int) -> FloatArray:
        """Draws, shape (n_draws, size)."""
        size = len(self.mean)
        share, normal, values = (
            rng.random((size, n_draws)),
            np.zeros((size, n_draws)),
            np.empty((n_draws, size)),
        )
        for i, scale in enumerate(np.diagonal(self.root)):
            centre = self.mean[i] + self.root[i, :i] @ normal[:i]
            sign, below, mass = mirrored((self.low[i] - centre) / scale, (self.high[i] - centre) / scale)
            normal[i] = sign * ndtri_exp(np.logaddexp(below, np.log(share[i]) + mass))
            values[:, self.order[i]] = np.clip(centre + scale * normal[i], self.low[i], self.high[i])
        return values

    def log_density(self, values: FloatArray) -> FloatArray:
        """Log density of draws at values of shape (n, size)."""
        ordered = values[:, self.order]
        normal = solve_triangular(self.root, (ordered - self.mean).T, lower=True).T
        scale = np.diagonal(self.root)
        centre = ordered - scale * normal
        _, _, mass = mirrored((self.low - centre) / scale, (self.high - centre) / scale)
        logs: FloatArray = (-0.5 * (np.square(normal) + _LOG_2PI) - np.log(scale) - mass).sum(axis=1)
        return logs


@dataclass(frozen=True, slots=True)
class Linear:
    """Readings near a point as a linear function of the coordinates, in units of the noise.

    Attributes:
        at: coordinates, shape (size,).
        left: measured less read there, shape (n_values,); 0 where nothing was measured.
        slopes: shape (n_values, size).
    """

    at: FloatArray
    left: FloatArray
    slopes: FloatArray

    def posterior(self, model: ClassModel) -> TruncatedNormal:
        """Posterior of the coordinates, were the motor linear and the noise normal."""
        mean, precision = model.prior
        information = self.slopes.T @ self.slopes + np.diag(precision)
        pull = self.slopes.T @ self.left + precision * (mean - self.at)
        return TruncatedNormal.cut(self.at + np.linalg.solve(information, pull), information, *model.box)

    def objective(self, model: ClassModel) -> float:
        """Minus the log density of what was measured and of the coordinates, had the converter normal errors."""
        mean, precision = model.prior
        far = np.square(self.left).sum() + (precision * np.square(self.at - mean)).sum()
        return float(0.5 * far + np.log(model.noise).sum())


class Evidence(NamedTuple):
    """Evidence of one class.

    Attributes:
        log_value: log of the probability density of what was measured; -inf where no fit comes near the best class's.
        effective: effective number of draws (Kish 1965) behind it.
    """

    log_value: float
    effective: float


def linearised(model: ClassModel, measured: FloatArray, at: FloatArray) -> Linear:
    """The motor made linear around coordinates, shape (size,), by differences."""
    low, high = model.box
    noise, pace = model.whole_noise, _PACE * (high - low)
    signed = np.where(at + pace > high, -pace, pace)
    read = model.readings(np.vstack([at, at + np.diag(signed)]))
    change = (read[1:] - read[0]).T / (noise[:, None] * signed)
    change[np.isnan(measured)] = 0.0
    return Linear(at, np.nan_to_num((measured - read[0]) / noise), change)


def best_fit(model: ClassModel, measured: FloatArray, begin: FloatArray) -> Linear:
    """The motor made linear around the most probable coordinates of a start, shape (n_values,); nan: not measured.

    Found by damped least squares from `begin`, shape (size,).
    """
    mean, precision = model.prior
    low, high = model.box
    root = np.sqrt(precision)

    @lru_cache(maxsize=1)  # the residual and its slopes are asked for one after the other
    def near(point: bytes) -> tuple[FloatArray, FloatArray]:
        linear = linearised(model, measured, np.frombuffer(point))
        pull = root * (mean - linear.at)
        return np.concatenate([linear.left, pull]), -np.vstack([linear.slopes, np.diag(root)])

    def residual(at: FloatArray) -> FloatArray:
        return near(at.tobytes())[0]

    def slopes(at: FloatArray) -> FloatArray:
        return near(at.tobytes())[1]

    found = least_squares(residual, begin, jac=slopes, bounds=(low, high), x_scale="jac", ftol=1e-2)
    n_values = len(measured)
    return Linear(found.x, residual(found.x)[:n_values], -slopes(found.x)[:n_values])


def _effective(log_weights: FloatArray) -> float:
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / (weights @ weights))


def _tempered(log_weights: FloatArray, wanted: float) -> FloatArray:
    """Weights, summing to 1, flattened by a power until so many of them count."""
    power = 1.0
    if _effective(log_weights) < wanted:
        power = brentq(lambda p: _effective(p * log_weights) - wanted, 0.0, 1.0, xtol=1e-3)
    weights: FloatArray = softmax(power * log_weights)
    return weights


def _regressed(linear: Linear, values: FloatArray, left: FloatArray, weights: FloatArray) -> Linear:
    """The linear motor that fits exact draws best: what was left over in them, shape (n, n_values), by weights."""
    centre = weights @ values
    apart = values - centre
    weighted = apart.T * weights
    scatter = weighted @ apart
    mean_left = weights @ left
    curved = left - mean_left + apart @ linear.slopes.T
    change = np.linalg.solve(scatter + _DAMPING * np.diag(np.diag(scatter)), weighted @ curved)
    return Linear(centre, mean_left, linear.slopes - change.T)


def sampled_evidence(
    model: ClassModel,
    measured: FloatArray,
    linear: Linear,
    rng: np.random.Generator,
    *,
    floor: float = -np.inf,
) -> Evidence:
    """Evidence of one class by adaptive multiple importance sampling (Cornuet et al. 2012).

    Args:
        model: the class.
        measured: one start, shape (n_values,); nan: not measured.
        linear: of `best_fit`.
        rng: of the draws.
        floor: log evidence below which one round is enough.
    """
    noise = model.whole_noise
    proposals = [linear.posterior(model)]
    values, joint = np.empty((0, len(linear.at))), np.empty(0)
    left = np.empty((0, len(measured)))
    while True:
        fresh = proposals[-1].draw(rng, _DRAWS)
        read = model.readings(fresh)
        values = np.vstack([values, fresh])
        left = np.vstack([left, np.nan_to_num((measured - read) / noise)])
        joint = np.concatenate([joint, log_joint(model, measured, read, fresh)])
        densities = [proposal.log_density(values) for proposal in proposals]
        log_weights = joint - logsumexp(densities, axis=0) + np.log(len(proposals))
        found = Evidence(float(logsumexp(log_weights) - np.log(len(values))), _effective(log_weights))
        done = found.effective >= _ENOUGH or (found.effective >= _FEW and found.log_value < floor)
        if done or len(proposals) == _MOST_ROUNDS:
            return found
        weights = _tempered(log_weights, 0.5 * _DRAWS)
        linear = _regressed(linear, values, left, weights)
        proposals.append(linear.posterior(model))


def _best_fits(models: list[ClassModel], measured: FloatArray, order: list[int]) -> dict[int, Linear]:
    """Best fits of the classes, each begun at that of the one before; those far off again, from the best of all."""

    def begun(index: int, near: Linear | None) -> Linear:
        model = models[index]
        begin = model.prior[0]
        if near is not None and len(near.at) == len(begin):
            begin = np.clip(near.at, *(model.box + np.array([[_INSIDE], [-_INSIDE]])))
        return best_fit(model, measured, begin)

    def objective(index: int) -> float:
        return fits[index].objective(models[index])

    fits: dict[int, Linear] = {}
    near = None
    for index in order:
        near = fits[index] = begun(index, near)
    best = min(fits, key=objective)
    for index in order:
        if objective(index) > objective(best) + _HOPELESS:
            again = begun(index, fits[best])
            if again.objective(models[index]) < objective(index):
                fits[index] = again
    return fits


def sampled_probabilities(
    recipe: Recipe, start: ArrayLike, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Posterior of each class given one start, and the effective draws behind it, both of shape (n_classes,).

    Classes whose best fit is far from the best of all get the probability 0, and no draws.

    Args:
        recipe: what the start was drawn from; a table `field` is allowed.
        start: measurements, shape (n_channels, n_samples); nan: not measured. Of a motor at work the last channel is
            the applied voltage, which is known: speed loops that see what was measured tell no more by it.
        rng: of the draws, and of the order in which one class's best fit begins at that of another.
    """
    whole = np.asarray(start, dtype=np.float64).reshape(len(recipe.channels), -1)
    measured = whole[: len(recipe.sensor.channels)].reshape(-1)
    voltage = None if recipe.duty is None else whole[-1]
    models = [ClassModel(recipe, fault_class, voltage) for fault_class in recipe.classes]
    fits = _best_fits(models, measured, rng.permutation(len(models)).tolist())
    objective = {index: fit.objective(models[index]) for index, fit in fits.items()}
    nearest = min(objective.values())
    joint, effective = np.full(len(models), -np.inf), np.zeros(len(models))
    for index in sorted(objective, key=objective.__getitem__):
        if objective[index] < nearest + _HOPELESS:
            floor = float(joint.max()) - _NEGLIGIBLE
            joint[index], effective[index] = sampled_evidence(
                models[index], measured, fits[index], rng, floor=floor
            )
    with np.errstate(divide="ignore"):  # a class that is never drawn
        joint = joint + np.log(recipe.class_probabilities)
    return np.exp(joint - logsumexp(joint)), effective
