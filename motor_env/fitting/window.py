"""One window of a motor at work near the healthy motor: its fit, or the first step of that fit alone.

R, K, J and the drag, a factor on the whole friction, may change; all else stays as known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from motor_env.errors import InputError
from motor_env.fitting import parameter_index as index
from motor_env.fitting.ekf import BEGIN, OUTLIER_SDS
from motor_env.fitting.operation_fit import without_lines
from motor_env.fitting.problem import STEP, Problem, Solution, motor_unknowns
from motor_env.fitting.record import Record
from motor_env.fitting.terms import NOISES, terms
from motor_env.fitting.uncertainty import capped, information_covariance, secants
from motor_env.motor.parameters import FloatArray
from motor_env.motor.threads import on_one_thread

LOAD = ("load_constant", "load_walk")
_MOTOR = ("R", "K", "J", "drag")
_LOADS = ("load_constant", "load_square", "offset_current", "offset_speed")
_MOST_ROUNDS = 8  # of a fit, which begins near the healthy motor
_FAR = 0.4  # logarithm of R, K or J over the healthy one's, from where a fit goes on
_DRAG, _DRAG_PLACES = ("coulomb", "B", "load_square"), [index.COULOMB, index.B, index.SQUARE]
_LEAST_SHARE = 0.01  # of the friction, where a fit without a load begins
_NO_WORK = 1e-12  # W, summed over the samples
_TOLD_APART = 1e-10  # least eigenvalue of an information matrix whose diagonal is 1
_UNTOLD = 10.0  # standard deviation of a logarithm of which the samples tell nothing


class WindowFit(NamedTuple):
    """Logarithms of R, K, J and the drag of one window, their covariance, all physical values, innovations.

    The misfit is -2 log likelihood, without a constant.
    """

    logs: FloatArray
    covariance: FloatArray
    values: FloatArray
    whitened: FloatArray
    misfit: float


@on_one_thread
def fit_window(
    record: Record, known: FloatArray, wanted: Sequence[str], *, one_way: bool = False
) -> WindowFit:
    """Fit one window, with those of the wanted terms that differ from window to window.

    With a motor that turns one way friction and a load that walks cannot be separated: there the drag is all that
    brakes.

    The covariance is that of white residuals; healthy windows show by how much more they scatter. That of log f is
    taken over the way from 1 to f, as the error of f is that of a sum: the slope at f would count an error upwards for
    more than one downwards.
    """
    problem, begin = _problem(record, known, wanted)
    best = problem.solve(begin, _MOST_ROUNDS)
    if np.abs(best.theta[[problem.names.index(name) for name in _MOTOR[:3]]]).max() > _FAR:
        best = problem.solve(best.theta)
    record, lines = without_lines(best, record)
    if lines:
        problem = replace(problem, record=record)
        best = problem.solve(best.theta, _MOST_ROUNDS)
    chosen, jacobian = motor_unknowns(problem), secants(problem, best.theta)
    values, spread = best.values, information_covariance(problem, best.theta, jacobian)
    rows = [problem.names[n] for n in chosen]
    at = np.ix_(*2 * [[rows.index(name) for name in _MOTOR]])
    factor = best.theta[problem.names.index("drag")]
    slope, noise = np.eye(len(_MOTOR)), 0.0
    slope[-1, -1] = per_log(factor)
    if one_way and values[index.WALK] > 0.0:
        moved = best.theta + STEP * np.eye(len(best.theta))[[problem.names.index(name) for name in _MOTOR]]
        whole, sd = _drags(problem, np.vstack([best.theta, moved]), values)
        factor = max(float(whole[0]), _LEAST_SHARE)
        slope[-1], noise = (whole[1:] - whole[0]) / (STEP * factor), sd / factor
    logs = np.log([values[index.R], values[index.K], values[index.J], factor])
    covariance = slope @ spread[at] @ slope.T
    covariance[-1, -1] += noise**2
    whitened = np.where(record.told, record.predict(values)[0][:, :2], np.nan)[1:]
    return WindowFit(logs, capped(covariance), values, whitened, best.misfit)


def per_log(factor: float) -> float:
    """Return how far the logarithm moves for each step of a factor, on its way from 1."""
    return math.log(factor) / (factor - 1.0) if factor != 1.0 else 1.0


def _drags(problem: Problem, each: FloatArray, fitted: FloatArray) -> tuple[FloatArray, float]:
    """Return all that brakes in a window over the known friction, for several vectors of unknowns, shape (m,).

    By the balance of energy: what the current gives and known loads do not take, less the rotor's gain. Also returns
    the standard deviation of the first by the sensors' fitted noise: boundless where the motor stands.
    """
    values, known, record = problem.values_each(each), problem.known, problem.record
    shown = record.predict_each(values)[0][:, :, 2:4] - values[:, None, [index.OFFSET_I, index.OFFSET_W]]
    current, speed, size = shown[:, :, 0], shown[:, :, 1], np.abs(shown[:, :, 1])
    loads = values[:, [index.LOAD]] + values[:, [index.SQUARE]] * speed * size
    given = np.sum(speed * (values[:, [index.K]] * current - loads), axis=1)
    gained = np.sum(np.diff(np.square(speed), axis=1) * (record.marks[1:] != BEGIN), axis=1)
    friction = np.maximum(np.sum(size * (known[index.COULOMB] + size * known[index.B]), axis=1), _NO_WORK)
    whole: FloatArray = (given - 0.5 * values[:, index.J] * gained / record.dt_s) / friction
    noise = fitted[index.K] * np.hypot(
        fitted[index.NOISE_I] * np.linalg.norm(speed[0]), fitted[index.NOISE_W] * np.linalg.norm(current[0])
    )
    return whole, float(noise / friction[0])


def without_load(best: Solution, speed_rad_s: float) -> Solution:
    """Return a fit in which all that brakes is friction, as nothing separated it from a load.

    Its mean speed gives the drag. With a load that walks friction, which it could balance, is held.
    """
    values, theta, known = best.values, best.theta.copy(), best.problem.known.copy()
    friction = values[index.COULOMB] + abs(speed_rad_s) * (
        values[index.B] + values[index.SQUARE] * abs(speed_rad_s)
    )
    load = values[index.LOAD] + float(np.mean(best.problem.record.predict(values)[0][:, 4]))
    braking = math.copysign(1.0, speed_rad_s) * load
    share = max(1.0 + braking / friction, _LEAST_SHARE) if friction > 0.0 else 1.0
    theta[[best.names.index(name) for name in _DRAG if name in best.names]] *= share
    known[_DRAG_PLACES] = share * values[_DRAG_PLACES]
    known[index.LOAD] = 0.0
    held = ("load_constant", *(_DRAG if "load_walk" in best.names else ()))
    kept = [n for n, term in enumerate(best.problem.free) if term.name not in held]
    free = tuple(best.problem.free[n] for n in kept)
    return replace(best.problem, known=known, free=free).solve(theta[kept])


class Scores(NamedTuple):
    """Effects of small changes in sections of a record: of the logarithms of R, K, J and the drag, and of the loads.

    Attributes:
        gradients: of half the sum of squared innovations, shape (n, n_unknowns).
        information: Fisher's, shape (n, n_unknowns, n_unknowns).
        precision: of the prior, shape (n_unknowns,).
    """

    gradients: FloatArray
    information: FloatArray
    precision: FloatArray

    def steps(self) -> tuple[FloatArray, FloatArray]:
        """Return the first step of a fit of each (a score test), shape (n, 4), and its covariance, shape (n, 4, 4).

        It is linear: its error is known however little a section tells. A load or an offset without information, as
        while the circuit is open, stays as known.
        """
        known, eye = self.information + np.diag(self.precision), np.eye(len(self.precision))
        untold = np.einsum("nii->ni", known) == 0.0
        known = known + untold[:, None] * eye
        sizes = np.einsum("nii->ni", known)
        roots = np.sqrt(sizes)
        least = np.linalg.eigvalsh(known / (roots[:, :, None] * roots[:, None, :]))[:, 0]
        # Unknowns that nothing tells apart have an inverse of rounding errors alone.
        apart = np.maximum(_TOLD_APART - least, 0.0)[:, None] * sizes
        spread: FloatArray = np.asarray(np.linalg.inv(known + apart[:, None] * eye), dtype=np.float64)
        step: FloatArray = -np.einsum("nij,nj->ni", spread, self.gradients)
        return step[:, : len(_MOTOR)], spread[:, : len(_MOTOR), : len(_MOTOR)]


def scores(
    record: Record,
    known: FloatArray,
    wanted: Sequence[str],
    peaks: tuple[float, float, float],
    ends: Sequence[int],
) -> Scores:
    """Return scores of the sections of a record between given samples; the filter runs through.

    Args:
        record: with at least two samples.
        known: physical values of the healthy motor, shape (parameter_index.N_VALUES,).
        wanted: terms of its windows.
        peaks: largest voltage, current and speed of its work.
        ends: first sample of the first section, and where each ends.
    """
    problem, theta = _problem(record, known, [name for name in wanted if name in _LOADS], peaks)
    white, slopes = _slopes(problem, theta)
    slopes[_MOTOR.index("drag")] *= known[index.DRAG]  # of its logarithm
    belief = [_UNTOLD] * len(_MOTOR) + [term.prior_sd for term in problem.free[len(_MOTOR) :]]
    some = [
        (slopes[:, first:end].reshape(len(theta), -1), white[first:end].ravel())
        for first, end in pairwise(ends)
    ]
    return Scores(
        np.array([slope @ innovations for slope, innovations in some]),
        np.array([slope @ slope.T for slope, _ in some]),
        np.power(belief, -2.0),
    )


def _problem(
    record: Record, known: FloatArray, wanted: Sequence[str], peaks: tuple[float, float, float] | None = None
) -> tuple[Problem, FloatArray]:
    """Return a problem of R, K, J, the drag and the wanted terms that differ between windows, and its begin.

    Raises:
        InputError: a noise or a constant that is 0 gives them no unit.
    """
    every = terms(record, known, peaks)
    every["drag"] = replace(every["coulomb"], name="drag", place=index.DRAG, unit=1.0, low=0.05, high=20.0)
    free = tuple(every[name] for name in (*_MOTOR, *_LOADS, *NOISES) if name in (*_MOTOR, *wanted))
    with np.errstate(divide="ignore", invalid="ignore"):
        at = [known[term.place] / term.unit for term in free]
    if not np.isfinite(at).all():
        raise InputError("healthy.windows.physical of the motor file holds the values of no motor")
    begin = [
        math.log(max(value, 1e-300)) if term.is_log else value for term, value in zip(free, at, strict=True)
    ]
    return Problem(record, known, free), np.array(begin)


def _slopes(problem: Problem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return whitened innovations, shape (n, n_channels), and their derivatives, (n_unknowns, n, n_channels).

    Outliers are cut, not their derivatives: a fault that makes all innovations outliers is seen.
    """
    moved = theta + STEP * np.eye(len(theta))
    out, _ = problem.record.predict_each(problem.values_each(np.vstack([theta, moved])))
    base, *white = out[:, :, :2][:, :, problem.record.seen > 0.0]
    return np.clip(base, -OUTLIER_SDS, OUTLIER_SDS), (np.array(white) - base) / STEP
