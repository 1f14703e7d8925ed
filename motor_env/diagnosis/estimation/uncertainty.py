"""Covariance of the unknowns: Fisher information, residuals that are not white, terms that were left out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import WIDTHS, Problem, Solution, motor_unknowns
from motor_env.diagnosis.estimation.terms import Term
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.motor.parameters import FloatArray

_NO_NUMBER = 1e60
_BRUSHES = 0.04  # of the largest voltage
_KNEES = {0.1: 1.0, 1.0: 2.0}
"""Share of the largest current at which half of the brushes' voltage is there: that voltage over the usual."""
_SAG = 0.05  # of the supply's voltage, at the largest current
_LARGEST_EFFECT = 3.0  # over its usual size: brushes do not lose the whole voltage
_GEAR = 0.07
"""Share of the motor's torque that a gear usually takes."""
_CONVERTED = math.sqrt(0.5 * (1.0 / 12.0 + 0.25))
"""Error of a converter in steps (rms): it rounds, or cuts off."""
_CANDIDATES = ("gear_loss", "load_constant", "load_square", "sensor_lag", "speed_lag", "supply_resistance")
_WIDEST = 1e3
_ANYTHING_LOG_SD = 3.0
_PARTS = 20  # of a record, whose scores are compared
_HARDLY = 1e-3  # of what tells an unknown, beside the one part that tells it
_DUST = 1e-6  # of the largest reading
_NO_LESS = 1e-3  # of the squared error of a free model: the part that is not white is never none
_BY_CHANCE = 4.0  # over the root of the number of samples: of the variance of white noise, by its differences
_FOLLOWS = 0.15
"""Share of the free run's error that may look like the unknowns, by `benchmarks/repeatability.py`."""


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """Result of a score test: what adding a term would do.

    Attributes:
        chi_square: fall of -2 log likelihood.
        value, sd: of the unknown.
        moves: of the other unknowns, for one unit of it.
    """

    chi_square: float
    value: float
    sd: float
    moves: FloatArray


def candidates(best: Solution) -> list[str]:
    """Name the terms that a record may tell and the model lacks."""
    recorded, every = best.problem.record.recorded, best.problem.available_terms
    left = [name for name in _CANDIDATES if name in every and name not in best.problem.names]
    if not recorded[0]:
        left = [name for name in left if name not in {"sensor_lag", "load_square", "supply_resistance"}]
    if not recorded[1]:
        left = [name for name in left if name != "speed_lag"]
    if not recorded.all():  # one of them alone cannot tell it from other friction
        left = [name for name in left if name != "gear_loss"]
    if best.problem.record.hold != "held":  # else it has sagged when it is read
        left = [name for name in left if name != "supply_resistance"]
    return left


def score_tests(
    best: Solution, every: Mapping[str, Term], tested: Sequence[str], sizes: Sequence[float] = ()
) -> dict[str, ScoreTest]:
    """Test terms without fitting them (score tests).

    Args:
        best: a fit without them.
        every: all terms.
        tested: names of those that are tested.
        sizes: of each term over its usual one, of which the most telling counts; by default it is small.
    """
    if not tested:
        return {}
    direction = _ResidualSlopes(best)
    tests = {}
    for name in tested:
        term = every[name]
        problem = best.problem.with_terms([term])
        sides = np.array([min(size * term.usual, term.high) for size in sizes] or [term.slope_at])
        moved = problem.residuals_each(np.column_stack([np.tile(best.theta, (len(sides), 1)), sides]))
        moved = np.delete(moved, len(direction.base), axis=1)
        test = direction.test(moved, sides, is_positive=term.low >= 0.0)
        if test is not None:
            tests[name] = test
    return tests


class _ResidualSlopes:
    """Residuals of a fit and their slopes at the point; wide steps made friction and load look better determined."""

    def __init__(self, best: Solution) -> None:
        self.base = best.problem.residuals(best.theta)
        self.jacobian = best.problem.jacobian(best.theta, self.base)
        self.variance = float(self.base @ self.base) / best.problem.count
        self.inverse = np.linalg.pinv(self.jacobian)

    def test(self, moved: FloatArray, sides: FloatArray, *, is_positive: bool) -> ScoreTest | None:
        """Test the most telling of several sizes of an addition, by residuals, shape (m, n); None where none tells."""
        moved = np.clip(moved, -_NO_NUMBER, _NO_NUMBER)  # a size at which the model has no numbers
        columns = (moved - self.base).T / sides
        moves = -self.inverse @ columns
        columns = columns + self.jacobian @ moves
        information = np.maximum(np.sum(columns**2, axis=0), 1e-300)
        values = -(self.base @ columns) / information
        gains = np.where((values < 0.0) & is_positive, 0.0, values**2 * information / self.variance)
        most = int(np.argmax(gains))
        if information[most] <= 1e-12 * self.variance:
            return None
        sd = math.sqrt(self.variance / information[most])
        return ScoreTest(float(gains[most]), float(values[most]), sd, moves[:, most])


def unmodelled_effects(best: Solution) -> list[ScoreTest]:
    """Test effects that no term models, each of its usual size (1), at the fitted motion.

    Brushes whose resistance falls with the current (Holm 1967), at small and at larger currents, and a gear's loss.
    """
    problem, record = best.problem, best.problem.record
    if not record.recorded[0]:
        return []
    lacked = [_with_brush_resistance(best, *usual) for usual in _KNEES.items()]
    if "gear_loss" not in best.names:
        geared = problem.known.copy()
        geared[index.GEAR] = _GEAR
        lacked.append(replace(problem, known=geared))
    return _unit_size_tests(best, lacked)


def quantisation_effects(best: Solution) -> list[ScoreTest]:
    """Test half a converter's step, by a standard deviation, where all readings of one sign err alike."""
    record, erred = best.problem.record, []
    for channel in np.flatnonzero(record.recorded):
        readings = record.readings.copy()
        readings[:, channel] += _CONVERTED * record.steps[channel] * np.sign(readings[:, channel])
        erred.append(replace(best.problem, record=replace(record, readings=readings)))
    return _unit_size_tests(best, erred)


def supply_effects(best: Solution) -> list[ScoreTest]:
    """Test effects between a stated voltage and the motor, each of its usual size (1), at the fitted current.

    Brushes as in `unmodelled_effects`, and a supply that falls with the square of the current.
    """
    record, current = best.problem.record, best.free[0][:, 2]
    lost = _SAG * record.voltage_v * (current / np.abs(current).max()) ** 2
    sagged = replace(best.problem, record=replace(record, voltage_v=record.voltage_v - lost))
    return _unit_size_tests(best, [_with_brush_resistance(best, min(_KNEES), 1.0), sagged], is_positive=True)


def _with_brush_resistance(best: Solution, knee: float, size: float) -> Problem:
    """Return the problem behind brushes whose resistance falls with the current, `size` times the usual."""
    record, current = best.problem.record, best.free[0][:, 2]
    volts, amps, _ = record.peaks
    lost = _BRUSHES * (size * volts) * current / (np.abs(current) + knee * amps)
    return replace(best.problem, record=replace(record, voltage_v=record.voltage_v - lost))


def _unit_size_tests(
    best: Solution, lacked: Sequence[Problem], *, is_positive: bool = False
) -> list[ScoreTest]:
    """Test each problem that has something of size 1 which that of the fit lacks."""
    direction = _ResidualSlopes(best)
    tests = [
        direction.test(each.residuals(best.theta)[None], np.ones(1), is_positive=is_positive)
        for each in lacked
    ]
    return [test for test in tests if test is not None]


def information_covariance(problem: Problem, theta: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the covariance of the unknowns that are no noises (Cramer-Rao), shape (p, p), by their `secants`."""
    base = problem.residuals(theta)
    return _inverse(jacobian.T @ jacobian) * float(base @ base) / problem.count


def secants(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return derivatives of the residuals, without the noises', over steps as wide as the unknowns are uncertain."""
    chosen = motor_unknowns(problem)
    base = problem.residuals(theta)
    jacobian = problem.jacobian(theta, base, chosen)
    for _ in range(2):
        sd = np.sqrt(np.diag(_inverse(jacobian.T @ jacobian)) * float(base @ base) / problem.count)
        steps = np.clip(sd, *WIDTHS)
        jacobian = problem.secants(theta, chosen, steps)
    return jacobian


def covariance(best: Solution) -> FloatArray:
    """Return the covariance of the unknowns that are no noises, with model error and the choice of terms.

    A term that was left out counts with its posterior probability (Hoeting et al. 1999) under its usual size; other
    optima with theirs. So do unmodelled effects, quantisation, and the model's error, in parts and throughout.
    """
    problem, chosen = best.problem, motor_unknowns(best.problem)
    white, rows = normalised(problem, best.theta, secants(problem, best.theta), chosen)
    total, _ = sandwich(white, rows)
    total += model_error(white, rows, total, states=free_run_states(best)) + _systematic_covariance(
        best, chosen
    )
    for name, test in score_tests(best, problem.available_terms, candidates(best)).items():
        occam = test.sd / math.hypot(test.sd, problem.available_terms[name].usual)
        odds = occam * math.exp(min(0.5 * test.chi_square, 50.0))
        weight, moves = odds / (1.0 + odds), test.moves[chosen]
        total += weight * (test.value**2 + test.sd**2) * np.outer(moves, moves)
    for test in unmodelled_effects(best):
        # A size of 1 is believed; the record settles this share of it.
        known = 1.0 / (1.0 + test.sd**2)
        moves = test.moves[chosen]
        size = min(abs(known * test.value), _LARGEST_EFFECT)
        total += (size**2 + 1.0 - known) * np.outer(moves, moves)
    for test in quantisation_effects(best):
        # It follows no law that the record could settle.
        total += np.outer(test.moves[chosen], test.moves[chosen])
    ahead = np.exp([0.5 * (best.misfit - misfit) for _, misfit in best.alternative_optima])
    for share, (theta, _) in zip(ahead / (1.0 + ahead.sum()), best.alternative_optima, strict=True):
        moved = (theta - best.theta)[chosen]
        total += share * np.outer(moved, moved)
    return total


def _systematic_covariance(best: Solution, chosen: Sequence[int]) -> FloatArray:
    """Return the covariance by the part of the free run's error that no number of samples averages away.

    What no term says, as cogging, comes back whenever the motor moves alike, and looks like a part of the terms.
    """
    problem, record = best.problem, best.problem.record
    moved, steps = problem.steps(best.theta, chosen)
    values = problem.values_each(np.vstack([best.theta, moved]))
    shown, *others = record.predict_each(values, learn=False, load=best.free[0][:, 4])[0][:, :, 2:4]
    information = np.diag([1.0 / min(problem.free[n].prior_sd, _WIDEST) ** 2 for n in chosen])
    for channel, counted in enumerate(record.informative.T):
        if record.recorded[channel] > 0.0:
            left = (record.readings - shown)[counted, channel]
            slopes = (np.array(others) - shown)[:, counted, channel] / steps[:, None]
            whole = float(np.mean(left**2)) + (_DUST * record.peaks[1 + channel]) ** 2
            white = difference_noise(left) ** 2 * (1.0 + _BY_CHANCE / math.sqrt(len(left)))
            size = max(whole - white, _NO_LESS * whole)
            information += slopes @ slopes.T / (len(left) * size * _FOLLOWS**2)
    return _inverse(information)


def normalised(
    problem: Problem, theta: FloatArray, jacobian: FloatArray, chosen: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return residuals in units of their size, and their derivatives: what `sandwich` and `model_error` take.

    Args:
        problem: what was fitted.
        theta: its best unknowns.
        jacobian: derivatives of the residuals, one column for each chosen unknown.
        chosen: their positions.

    Returns:
        Residuals of the samples, shape (n, channels); derivatives of all residuals, and rows of a weak prior: standard
        deviations of 3 for a logarithm, for the onset of half an interval and half the current's rise.
    """
    base, channels = problem.residuals(theta), int(problem.record.recorded.sum())
    size, n = math.sqrt(float(base @ base) / problem.count), len(problem.record.voltage_v)
    rows = np.concatenate([jacobian / size, np.diag(1.0 / _weak_prior_sd(problem, theta)[chosen])])
    return (base / size)[: n * channels].reshape(n, channels), rows


def sandwich(
    white: FloatArray, rows: FloatArray, *, begin: int = 0, level: float = 0.0
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the covariance of unknowns under autocorrelated residuals, and independent samples by channel.

    Residuals are stationary with their autocovariance up to a tenth of the record (Bartlett window; Newey & West 1987),
    and no less power at any frequency than white noise.

    Args:
        white: residuals, see `normalised`.
        rows: their derivatives.
        begin: first sample of the running motor.
        level: standard deviation of a constant error of the running motor, over the noise.
    """
    n, channels = white.shape
    bread = _inverse(rows.T @ rows)
    meat = rows[n * channels :].T @ rows[n * channels :]  # what is believed beforehand
    independent = []
    for channel in range(channels):
        series, part = white[:, channel] - white[:, channel].mean(), rows[channel : n * channels : channels]
        taper = _autocovariance(series, max(n // 10, 2))
        meat += part.T @ _coloured_product(part, taper, difference_noise(series[begin:]))
        inflation = max(float(2.0 * np.sum(taper) - taper[0]) / max(float(taper[0]), 1e-300), 1.0)
        independent.append(n / inflation)
    moved = level * rows[begin * channels : n * channels : channels].sum(axis=0)
    meat += np.outer(moved, moved)
    # Rounding may leave a direction that hardly matters a negative variance.
    variances, vectors = np.linalg.eigh(0.5 * (meat + meat.T))
    spread = bread @ (vectors * np.sqrt(np.maximum(variances, 0.0)))
    return spread @ spread.T, tuple(independent)


def free_run_states(best: Solution) -> FloatArray:
    """Return current and speed of the free run, and their slopes, shape (n, 4)."""
    states = best.free[1][:, 2:4]
    return np.concatenate([states, np.gradient(states, axis=0)], axis=1)


def model_error(white: FloatArray, rows: FloatArray, series: FloatArray, *, states: FloatArray) -> FloatArray:
    """Return the covariance that a model's error adds to that of a stationary series, shape (p, p).

    A wrong model errs most in samples that tell most. The scores of twenty parts of the record show it: their scatter
    beyond the series', scaled by the information where the model is right (Bell & McCaffrey 2002). Under a periodic
    command all parts in time err alike, so the record is also cut by its states; of these only what exceeds chance
    counts, for p unknowns (Marchenko & Pastur 1967).

    Args:
        white: residuals, see `normalised`.
        rows: their derivatives.
        series: covariance under a stationary series, see `sandwich`.
        states: what the record is cut by beside time, shape (n, m).
    """
    n, channels = white.shape
    values, axes = np.linalg.eigh(_inverse(rows.T @ rows))
    root = axes * np.sqrt(np.maximum(values, 0.0))  # unknowns of which the record tells all equally much
    shares = rows[: n * channels].reshape(n, channels, -1) @ root
    leverage = np.einsum("ncp,ncp->n", shares, shares)
    total, by_chance = series, (1.0 + math.sqrt(len(series) / _PARTS)) ** 2
    # At rest, only rounding tells states apart: they keep their order in time, so that every machine says the same.
    levels = np.round(states / np.maximum(np.ptp(states, axis=0), 1e-300), 6)
    orders = [np.arange(n), *np.argsort(levels.T, kind="stable")]
    for order, usual in zip(orders, [1.0] + [by_chance] * (len(orders) - 1), strict=True):
        cumulated = np.cumsum(leverage[order])
        parts = np.minimum((_PARTS * cumulated / max(float(cumulated[-1]), 1e-300)).astype(int), _PARTS - 1)
        moved = np.zeros_like(series)
        for part in np.unique(parts):
            of = order[parts == part]
            some = shares[of].reshape(-1, len(series))
            leverages, across = np.linalg.eigh(some.T @ some)
            score = across.T @ (some.T @ white[of].ravel())
            move = root @ (across @ (score / np.sqrt(np.maximum(1.0 - leverages, _HARDLY))))
            moved += np.outer(move, move)
        size = np.maximum(np.diag(total), np.diag(moved))
        total = total + excess_covariance(total + _HARDLY**2 * np.diag(size), moved, usual)
    return total - series


def excess_covariance(known: FloatArray, covariance: FloatArray, usual: float = 1.0) -> FloatArray:
    """Return the excess of a covariance over `usual` times a known one, shape (n, n)."""
    root = np.linalg.cholesky(known)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ covariance @ inverse.T)
    more = root @ axes * np.sqrt(np.maximum(sizes - usual, 0.0))
    return np.asarray(more @ more.T, dtype=np.float64)


def _weak_prior_sd(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return the weak prior's standard deviation of each unknown, in its unit."""
    values = problem.values(theta)
    rise = values[index.L] / values[index.R] + values[index.RISE] + values[index.LAG_I]
    late = 0.5 * (1.0 + rise / problem.record.dt_s)
    deviations = []
    for term, value in zip(problem.free, theta.tolist(), strict=True):
        if term.place in (index.ONSET, index.DELAY):
            deviations.append(late)
        elif term.prior_sd < math.inf:
            deviations.append(math.inf)
        else:
            deviations.append(_ANYTHING_LOG_SD * (1.0 if term.is_log else max(abs(value), term.usual)))
    return np.array(deviations)


def _autocovariance(series: FloatArray, lags: int) -> FloatArray:
    """Return the autocovariance of samples 0, 1, ... apart, under a Bartlett window, shape (lags,)."""
    n = len(series)
    length = fft.next_fast_len(2 * n - 1, real=True)
    spectrum = fft.rfft(series, length) * fft.rfft(series[::-1], length)
    full: FloatArray = fft.irfft(spectrum, length)[n - 1 : n - 1 + lags] / n
    return full * (1.0 - np.arange(lags) / lags)


def _inverse(information: FloatArray) -> FloatArray:
    """Invert an information matrix; an unknown direction gets a finite, hopeless variance."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, axes = np.linalg.eigh(information / np.outer(size, size))
    inverse = (axes / np.maximum(values, 1e-10)) @ axes.T
    shown = np.maximum(size, np.sqrt(np.diag(inverse)) / _WIDEST)  # no standard deviation beyond the widest
    return np.asarray(inverse / np.outer(shown, shown))


def _coloured_product(columns: FloatArray, covariance: FloatArray, noise: float) -> FloatArray:
    """Return the covariance matrix of a stationary series times columns, shape (n, m).

    Power below the white noise is chance, and would make a level look better known than noise allows.

    Args:
        columns: shape (n, m).
        covariance: of samples 0, 1, ... apart, shape (lags,).
        noise: standard deviation of the white noise in it.
    """
    n, lags = len(columns), len(covariance)
    size = n + 2 * lags
    kernel = np.concatenate([covariance, np.zeros(size - 2 * lags + 1), covariance[:0:-1]])
    spectrum = np.maximum(np.fft.rfft(kernel).real, noise**2)
    out: FloatArray = np.fft.irfft(spectrum[:, None] * np.fft.rfft(columns, size, axis=0), size, axis=0)[:n]
    return out


def capped(covariance: FloatArray) -> FloatArray:
    """Limit a covariance of logarithms to standard deviations of 10."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    out: FloatArray = (vectors * np.clip(values, 1e-12, 100.0)) @ vectors.T
    return out
