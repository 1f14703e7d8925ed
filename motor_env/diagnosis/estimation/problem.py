"""Least-squares problem of one choice of terms: whitened innovations of the Kalman filter.

Times the geometric mean of their standard deviations, their sum of squares is the concentrated likelihood (Ljung 1999,
ch. 7): one fit finds motor and noise together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.terms import NOISES, Term, terms
from motor_env.motor.parameters import FloatArray

_LEAST_LAG = 0.01  # of R dt: an L so small that the current follows at once
_LEAST_NOISE = 1e-7  # of what was believed before
_LARGEST = 1e100  # of an innovation: its square is a number
STEP = 1e-4
_ENOUGH = 0.01
"""Of -2 log likelihood: a fit ends with a step that gains less. One standard error costs 1."""
WIDTHS = (1e-3, 0.1)
"""Least and largest step over which the slope of residuals with kinks is taken."""
_WORTH, _MOST_OUT = 1.0, 20
"""Of -2 log likelihood: what wide slopes must promise, and the gain; evaluations."""


@dataclass(frozen=True)
class Problem:
    """Least-squares problem of one choice of terms.

    Attributes:
        record: what is fitted.
        known: values of what is not fitted, shape (parameter_index.N_VALUES,).
        free: the terms that are.
        without: names of terms that no model may have.
    """

    record: Record
    known: FloatArray
    free: tuple[Term, ...]
    without: tuple[str, ...] = ()

    def values(self, theta: FloatArray) -> FloatArray:
        """Return physical values and noises."""
        values: FloatArray = self.values_each(theta[None])[0]
        return values

    def values_each(self, thetas: FloatArray) -> FloatArray:
        """Return physical values for several vectors of unknowns, shape (m, n_unknowns)."""
        values = np.tile(self.known, (len(thetas), 1))
        for term, column in zip(self.free, thetas.T, strict=True):
            values[:, term.place] = term.unit * (np.exp(column) if term.is_log else column)
        if not self.record.is_start:  # there L cannot be none
            least = _LEAST_LAG * self.record.dt_s
            values[:, index.L] = np.hypot(values[:, index.L], least * values[:, index.R])
        with_drag = values[:, index.DRAG] > 0.0
        values[with_drag, index.B] *= values[with_drag, index.DRAG]
        values[with_drag, index.COULOMB] *= values[with_drag, index.DRAG]
        return values

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the scaled innovations of each sample and channel, then the priors' residuals."""
        residuals: FloatArray = self.residuals_each(theta[None])[0]
        return residuals

    def residuals_each(self, thetas: FloatArray) -> FloatArray:
        """Return residuals for several vectors of unknowns, shape (m, n_unknowns)."""
        out, logs = self.record.predict_each(self.values_each(thetas))
        if (shapes := self.record.beside) is not None:  # their least-squares amplitudes, of every theta
            out[:, :, 0] -= out[:, :, 0] @ shapes @ shapes.T
        first, last = np.flatnonzero(self.record.recorded > 0.0)[[0, -1]]
        white = out[:, :, first : last + 1].reshape(len(thetas), -1)
        if not -_LARGEST < white.min() <= white.max() < _LARGEST:
            white[~(np.abs(white) < _LARGEST)] = 1e6
        size = 0.5 * logs / self.count
        scale = np.exp(np.where(size < 100.0, size, 100.0))  # of a number that is none, too
        means, sds = np.array([(term.prior_mean, term.prior_sd) for term in self.free]).T
        prior = (thetas - means) / sds
        residuals: FloatArray = np.concatenate([white, prior], axis=1)
        residuals *= scale[:, None]
        return residuals

    @cached_property
    def available_terms(self) -> dict[str, Term]:
        """All terms that a model of the record can have, by name."""
        every = terms(self.record, self.known).items()
        return {name: term for name, term in every if name not in self.without}

    @cached_property
    def count(self) -> int:
        """Number of readings."""
        return self.record.count

    def jacobian(
        self, theta: FloatArray, base: FloatArray, chosen: Sequence[int] | None = None
    ) -> FloatArray:
        """Return one-sided derivatives of the residuals, `base` at theta, by all or the chosen unknowns."""
        moved, steps = self.steps(theta, range(len(theta)) if chosen is None else chosen)
        slopes: FloatArray = ((self.residuals_each(moved) - base) / steps[:, None]).T
        return slopes

    def steps(self, theta: FloatArray, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Move one unknown in each row, away from its nearer bound: rows, shape (m, n_unknowns), and steps, (m,)."""
        moved, steps = np.tile(theta, (len(chosen), 1)), np.empty(len(chosen))
        for row, n in enumerate(chosen):
            step = STEP * max(1.0, abs(theta[n]))
            steps[row] = -step if theta[n] + step > self.free[n].high else step
            moved[row, n] += steps[row]
        return moved, steps

    def secants(self, theta: FloatArray, chosen: Sequence[int], steps: FloatArray) -> FloatArray:
        """Return derivatives by chosen unknowns over wide steps both ways: residuals have kinks at standstill."""
        low, high = self.bounds
        rows, below = np.arange(len(chosen)), np.tile(theta, (len(chosen), 1))
        above = below.copy()
        below[rows, chosen] = np.maximum(theta[chosen] - steps, low[chosen])
        above[rows, chosen] = np.minimum(theta[chosen] + steps, high[chosen])
        widths = np.maximum((above - below)[rows, chosen], 1e-12)
        residuals = self.residuals_each(np.vstack([above, below]))
        slopes: FloatArray = ((residuals[: len(chosen)] - residuals[len(chosen) :]) / widths[:, None]).T
        return slopes

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest value of each unknown."""
        return np.array([term.low for term in self.free]), np.array([term.high for term in self.free])

    def solve(self, theta: FloatArray, most: int = 40, steps: FloatArray | None = None) -> Solution:
        """Find the best unknowns from a beginning; never worse than that.

        Args:
            theta: the beginning.
            most: evaluations.
            steps: of each unknown, for derivatives by `secants`.
        """
        low, high = self.bounds
        begin = np.clip(theta, low + 1e-9, high - 1e-9)
        # The first region of trust is as large as the unknowns are, whose zero means nothing: each begins at 1.
        zero = begin - 1.0

        def unknowns(point: FloatArray) -> FloatArray:
            return np.clip(zero + point, low, high)

        @lru_cache(maxsize=1)  # where the residuals were just asked for, their derivatives are
        def at(point: bytes) -> FloatArray:
            return self.residuals(unknowns(np.frombuffer(point)))

        def residuals(point: FloatArray) -> FloatArray:
            return at(point.tobytes())

        def jacobian(point: FloatArray) -> FloatArray:
            if steps is not None:
                return self.secants(unknowns(point), range(len(steps)), steps)
            return self.jacobian(unknowns(point), residuals(point))

        optimum = least_squares(
            residuals,
            begin - zero,
            jac=jacobian,
            bounds=(low - zero, high - zero),
            x_scale="jac",
            max_nfev=most,
            ftol=_ENOUGH / self.count,
        )
        return Solution(self, unknowns(optimum.x), self.misfit(2.0 * optimum.cost))

    def misfit(self, squares: float) -> float:
        """Return -2 log likelihood, noise level concentrated out."""
        return self.count * math.log(max(squares, 1e-300) / self.count)

    def with_terms(self, added: Sequence[Term]) -> Problem:
        """Return the problem with more terms."""
        return replace(self, free=(*self.free, *added))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(term.name for term in self.free)


@dataclass(frozen=True)
class Solution:
    """A problem with its best unknowns.

    Attributes:
        problem: what was solved.
        theta: the best unknowns.
        misfit: theirs.
        alternative_optima: unknowns and misfits of others.
    """

    problem: Problem
    theta: FloatArray
    misfit: float
    alternative_optima: tuple[tuple[FloatArray, float], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return self.problem.names

    @property
    def values(self) -> FloatArray:
        """Physical values and noises, the noises scaled to what is left."""
        values = self.problem.values(self.theta)
        out, _ = self.problem.record.predict(values)
        left = float(np.mean(out[:, :2][self.problem.record.informative] ** 2))
        values[index.NOISE_I : index.WALK + 1] *= math.sqrt(left)
        return values

    def escape_local_minimum(self) -> Solution:
        """Continue a fit that is caught between two jumps of its likelihood; return it if there is no way out.

        The likelihood jumps where the motor starts or stops at another sample. Slopes over wide steps see beyond.
        """
        problem, theta, motor = self.problem, self.theta, motor_unknowns(self.problem)
        base, (low, high) = problem.residuals(theta), problem.bounds
        size, slopes = float(base @ base) / problem.count, problem.jacobian(theta, base)
        sd = np.sqrt(np.diag(np.linalg.pinv(slopes.T @ slopes, hermitian=True)) * size)
        steps = np.clip(sd, *WIDTHS)
        wide = problem.secants(theta, motor, steps[motor])
        ways = (low - theta)[motor], (high - theta)[motor]
        if 2.0 * lsq_linear(wide, -base, ways).cost > (problem.count - _WORTH) * size:
            return self
        escaped = problem.solve(theta, _MOST_OUT, steps)
        if escaped.misfit > self.misfit - _WORTH:
            return self
        # Its rivals may be caught, too: they stay as far behind.
        gain = escaped.misfit - self.misfit
        rivals = tuple((other, misfit + gain) for other, misfit in self.alternative_optima)
        return replace(escaped, alternative_optima=rivals).escape_local_minimum()

    def reweighted(self) -> Problem:
        """Return the problem with each channel's noise as large as what is left of it."""
        problem, known = self.problem, self.problem.known.copy()
        left = problem.record.readings - problem.record.predict(problem.values(self.theta))[0][:, 2:4]
        left[~problem.record.informative] = np.nan
        for n, place in enumerate((index.NOISE_I, index.NOISE_W)):
            if problem.record.recorded[n] > 0.0:
                known[place] = max(float(np.nanstd(left[:, n])), _LEAST_NOISE * known[place])
        return replace(problem, known=known)

    @cached_property
    def free(self) -> tuple[FloatArray, FloatArray]:
        """The filter's table, and that of the free run under the voltage and the filter's load."""
        record, values = self.problem.record, self.values
        filtered, _ = record.predict(values)
        return filtered, record.predict(values, learn=False, load=filtered[:, 4])[0]

    def explained(self) -> tuple[float | None, float | None]:
        """Return the share of current's and speed's variance that the free run explains; None where not used."""
        record = self.problem.record
        left = record.readings - self.free[1][:, 2:4]
        r2 = [
            r_squared(record.readings[counted, n], left[counted, n]) if record.recorded[n] else None
            for n, counted in enumerate(record.informative.T)
        ]
        return r2[0], r2[1]

    def bic(self) -> float:
        """Return the Bayesian information criterion (Schwarz 1978)."""
        return self.misfit + len(self.theta) * math.log(self.problem.count)


def motor_unknowns(problem: Problem) -> list[int]:
    """Return the positions of the unknowns that are no noises."""
    return [n for n, name in enumerate(problem.names) if name not in NOISES]


def r_squared(measured: FloatArray, left: FloatArray) -> float:
    """Return the share of the variance of measured values that a fit explains, given its residual."""
    return 1.0 - float(np.sum(left**2) / max(np.sum((measured - measured.mean()) ** 2), 1e-300))
