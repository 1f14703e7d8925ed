"""Maximum likelihood or maximum a posteriori fits of parameters to transients, and their covariance.

Gauss-Newton steps with Levenberg-Marquardt damping (Levenberg 1944; Marquardt 1963), a batch at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import numbers
from motor_env.inference.sensitivities import (
    Coordinates,
    NormalEquations,
    Observed,
    common_equations,
    normal_equations,
)
from motor_env.motor.parameters import FloatArray, require

_LARGEST_RELATIVE_STEP = 0.5  # no factor is more than halved, or raised by half, in one step
_TOLERANCE = 1e-7  # of the objective: a step that promises less changes no posterior and no interval
_RIDGE = 1e-12  # lets a direction that stays open reach the sentence that says so
_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e9
_CHUNK = 512  # cases fitted at once: bounds the memory, and keeps them in the cache


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian prior on coordinates.

    Attributes:
        mean: shape (size,), or (n, size) for each case.
        precision: inverse covariance, shape (size, size) or (n, size, size); 0 without knowledge.
    """

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def from_std(cls, std: ArrayLike) -> Prior:
        """Return an independent prior about 0 from standard deviations; infinite ones express no knowledge."""
        deviations = np.asarray(std, dtype=np.float64)
        require(
            bool((deviations > 0.0).all()), f"standard deviations of a prior must be > 0, got {deviations}"
        )
        return cls(np.zeros(deviations.shape), np.diag(1.0 / np.square(deviations)))

    def require_shape(self, n_cases: int, size: int) -> None:
        """Raise `ValueError` unless the prior is of `size` coordinates, for all cases or for each."""
        for name, shape in (("mean", (size,)), ("precision", (size, size))):
            array = numbers(f"{name} of the prior", getattr(self, name))
            require(
                array.shape in (shape, (n_cases, *shape)),
                f"{name} of the prior must have shape {shape} or {(n_cases, *shape)}, got {array.shape}",
            )

    def rows(self, chosen: NDArray[np.int64] | slice) -> Prior:
        """Return the prior of some cases."""
        return Prior(
            self.mean[chosen] if self.mean.ndim > 1 else self.mean,
            self.precision[chosen] if self.precision.ndim > 2 else self.precision,
        )

    def pull(self, values: FloatArray) -> FloatArray:
        """Return precision times the distance from the mean, shape (n, size)."""
        pulled: FloatArray = np.einsum("...ij,...j->...i", self.precision, values - self.mean)
        return pulled


class Fit(NamedTuple):
    """Estimates of a batch.

    Attributes:
        values: coordinates, shape (n, size).
        factors: factors on the nominal values, shape (n, size).
        covariance: inverse information (prior included), shape (n, size, size).
        information: shape (n, size, size).
        chi2: sum of squared residuals in units of the noise, shape (n,).
        objective: chi2 plus the prior's squares, shape (n,).
        converged: shape (n,).
    """

    values: FloatArray
    factors: FloatArray
    covariance: FloatArray
    information: FloatArray
    chi2: FloatArray
    objective: FloatArray
    converged: NDArray[np.bool_]

    @property
    def std(self) -> FloatArray:
        """Standard deviation of each coordinate, shape (n, size)."""
        deviations: FloatArray = np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))
        return deviations


def _with_prior(equations: NormalEquations, values: FloatArray, prior: Prior) -> NormalEquations:
    """Add the prior as one more measurement of each coordinate: chi2 becomes the objective."""
    pull = prior.pull(values)
    return NormalEquations(
        equations.chi2 + ((values - prior.mean) * pull).sum(axis=-1),
        equations.gradient - pull,
        equations.information + prior.precision,
    )


def _steps(
    equations: NormalEquations, damping: FloatArray, coordinates: Coordinates, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return damped steps (Marquardt 1963), shortened at the region's bounds, and the expected gain."""
    information = equations.information.copy()
    diagonal = np.einsum("nii->ni", information)  # a view
    diagonal *= 1.0 + _RIDGE + damping[:, None]
    diagonal += 1e-300  # a coordinate that no sample sees and no prior holds stays where it is
    step = np.asarray(np.linalg.solve(information, equations.gradient[..., None])[..., 0], dtype=np.float64)
    slope = np.asarray(coordinates.scales)
    relative = np.abs(step) * slope / (1.0 if coordinates.logarithmic else coordinates.factors(values))
    step *= np.minimum(1.0, _LARGEST_RELATIVE_STEP / np.maximum(relative.max(axis=-1), 1e-300))[:, None]
    curvature = np.einsum("ni,nij,nj->n", step, equations.information, step)
    gain: FloatArray = 2.0 * (step * equations.gradient).sum(axis=-1) - curvature
    return step, gain


def fit(
    observed: Observed,
    coordinates: Coordinates,
    prior: Prior | None = None,
    max_iterations: int = 40,
) -> Fit:
    """Fit the most likely, or most probable, coordinates of each case.

    Args:
        observed: measured transients.
        coordinates: free parameters.
        prior: none by default; the fit begins at its mean.
        max_iterations: limit of iterations.

    Raises:
        ValueError: samples and prior leave a direction undetermined.
    """
    belief = Prior.from_std(np.full(coordinates.size, np.inf)) if prior is None else prior
    parts = []
    for first in range(0, max(observed.n_cases, 1), _CHUNK):
        chosen = slice(first, first + _CHUNK)
        part = _fit_together(
            observed.rows(chosen), coordinates, belief.rows(chosen), max_iterations=max_iterations
        )
        parts.append(part)
    return Fit(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit_together(observed: Observed, coordinates: Coordinates, belief: Prior, *, max_iterations: int) -> Fit:
    n, begin = observed.n_cases, np.asarray(belief.mean, dtype=np.float64)
    values = np.broadcast_to(begin, (n, coordinates.size)).copy()
    equations = (common_equations if begin.ndim == 1 else normal_equations)(observed, coordinates, begin)
    best = _with_prior(equations, values, belief)
    damping = np.zeros(n)
    converged = np.zeros(n, dtype=np.bool_)
    active = np.arange(n)
    for _ in range(max_iterations):
        here = NormalEquations(*(part[active] for part in best))
        step, gain = _steps(here, damping[active], coordinates, values[active])
        small = np.abs(gain) <= _TOLERANCE
        # The last step is taken without another look: it is some 1e-4 standard deviations long, and the information
        # changes by as little.
        ended = active[small]
        values[ended] += step[small]
        best.chi2[ended] -= gain[small]
        converged[ended] = True
        active = active[~small]
        if active.size == 0:
            break
        here, tried = NormalEquations(*(part[~small] for part in here)), values[active] + step[~small]
        equations = normal_equations(observed, coordinates, tried, active)
        trial = _with_prior(equations, tried, belief.rows(active))
        better = (trial.chi2 < here.chi2) & np.isfinite(trial.gradient).all(axis=-1)
        moved = active[better]
        values[moved] = tried[better]
        for whole, part in zip(best, trial, strict=True):
            whole[moved] = part[better]
        damping[moved] *= 0.1
        damping[moved] = np.where(damping[moved] < _FIRST_DAMPING, 0.0, damping[moved])
        worse = active[~better]
        damping[worse] = np.maximum(10.0 * damping[worse], _FIRST_DAMPING)
        active = active[damping[active] < _LARGEST_DAMPING]
    chi2 = best.chi2 - ((values - belief.mean) * belief.pull(values)).sum(axis=-1)
    return Fit(
        values=values,
        factors=coordinates.factors(values),
        covariance=inverse_information(best.information, coordinates.names),
        information=best.information,
        chi2=chi2,
        objective=best.chi2,
        converged=converged,
    )


_OPEN_DIRECTION = 1e-9  # smallest eigenvalue of the information scaled to a unit diagonal


def inverse_information(information: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Invert positive definite matrices (..., size, size), scaled against their units.

    Raises:
        ValueError: a direction is undetermined.
    """
    root = np.sqrt(np.einsum("...ii->...i", information))
    seen = root.min(initial=np.inf) > 0.0
    outer = root[..., :, None] * root[..., None, :]
    identifiable = seen and bool((np.linalg.eigvalsh(information / outer)[..., 0] > _OPEN_DIRECTION).all())
    require(
        identifiable,
        f"free quantities {', '.join(names)} cannot all be determined from these samples without a prior: "
        "fix one, give a prior, or measure one channel more",
    )
    inverse: FloatArray = np.linalg.inv(information / outer) / outer
    return inverse
