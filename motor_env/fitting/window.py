"""One window of a motor at work near the healthy motor: its fit, or the first step of that fit alone.

What may change is R, K, J and the drag, a factor f on the whole friction; everything else stays as it is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from motor_env.errors import InputError
from motor_env.fitting import places
from motor_env.fitting.fit import without_lines
from motor_env.fitting.problem import STEP, Problem, Solution
from motor_env.fitting.record import Record, joined
from motor_env.fitting.terms import NOISES, terms
from motor_env.fitting.threads import on_one_thread
from motor_env.fitting.uncertainty import capped, information_covariance, motor_places
from motor_env.motor.parameters import FloatArray

_MOTOR = ("R", "K", "J", "drag")
_LOADS = ("load_constant", "load_square", "offset_current", "offset_speed")
_MOST_ROUNDS = 8  # of a fit, which begins near the healthy motor
_WILD = 6.0  # standard deviations beyond which an innovation counts no more
_UNTOLD = 10.0  # standard deviation of a logarithm of which the samples tell nothing


class WindowFit(NamedTuple):
    """Logarithms of R, K, J and the drag of one window, their covariance, all its physical values, its innovations.

    The misfit is -2 log likelihood, without a constant.
    """

    logs: FloatArray
    covariance: FloatArray
    values: FloatArray
    whitened: FloatArray
    misfit: float = 0.0


@on_one_thread
def fit_window(record: Record, known: FloatArray, wanted: Sequence[str]) -> WindowFit:
    """Fit of one window, with those of the wanted terms that differ from window to window.

    The covariance is that of white residuals: by how much more windows scatter is seen on healthy ones.
    The error of f is that of a sum, so that of log f is taken over the way from 1 to f: the slope at f would count an
    error upwards for more than one downwards.
    """
    others = [name for name in (*_LOADS, *NOISES) if name in wanted]
    problem, begin = _problem(record, known, others)
    best = Solution(problem, *problem.solve(begin, _MOST_ROUNDS))
    record, lines = without_lines(best, record)
    if lines:
        problem = replace(problem, record=record)
        best = Solution(problem, *problem.solve(best.theta, _MOST_ROUNDS))
    values, spread = best.values, information_covariance(problem, best.theta)
    rows = [problem.names[n] for n in motor_places(problem)]
    at = [rows.index(name) for name in _MOTOR]
    factor = best.theta[problem.names.index("drag")]
    way = math.log(factor) / (factor - 1.0) if factor != 1.0 else 1.0
    slope = np.diag([1.0, 1.0, 1.0, way])
    logs = np.log([values[places.R], values[places.K], values[places.J], factor])
    whitened = np.where(record.told, record.predict(values)[0][:, :2], np.nan)[1:]
    return WindowFit(logs, capped(slope @ spread[np.ix_(at, at)] @ slope), values, whitened, best.misfit)


def first_steps(
    parts: Sequence[Record], known: FloatArray, wanted: Sequence[str], peaks: tuple[float, float, float]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """How R, K, J and the drag of each part of a window seem to differ: logarithms, and their covariance.

    It is the first step of a fit (a score test): linear, so that its error is known however little a part tells.

    Args:
        parts: with at least two samples each.
        known: physical values of the healthy motor, shape (places.N_VALUES,).
        wanted: terms of its windows.
        peaks: largest voltage, current and speed of its work.
    """
    others = [name for name in _LOADS if name in wanted]
    problem, theta = _problem(joined(parts), known, others, peaks)
    white, slopes = _slopes(problem, theta)
    belief = [_UNTOLD] * len(_MOTOR) + [term.prior_sd for term in problem.free[len(_MOTOR) :]]
    precision = np.diag(np.power(belief, -2.0))
    per_log, n = np.array([1.0, 1.0, 1.0, 1.0 / known[places.DRAG]]), len(_MOTOR)
    ends = np.cumsum([len(part.voltage_v) for part in parts])
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        some = slopes[:, first:end].reshape(len(theta), -1)
        spread = np.linalg.inv(some @ some.T + precision)
        step = -spread @ (some @ white[first:end].ravel())
        yield per_log * step[:n], spread[:n, :n] * np.outer(per_log, per_log)


def _problem(
    record: Record, known: FloatArray, others: Sequence[str], peaks: tuple[float, float, float] | None = None
) -> tuple[Problem, FloatArray]:
    """R, K, J, the drag and others as unknowns; their known values.

    Raises:
        InputError: a noise or a constant that is 0 gives them no unit.
    """
    every = terms(record, known, peaks)
    every["drag"] = replace(every["coulomb"], name="drag", place=places.DRAG, unit=1.0, low=0.05, high=20.0)
    free = tuple(every[name] for name in (*_MOTOR, *others))
    with np.errstate(divide="ignore", invalid="ignore"):
        at = [known[term.place] / term.unit for term in free]
    if not np.isfinite(at).all():
        raise InputError("healthy.windows.physical of the motor file holds the values of no motor")
    begin = [math.log(max(one, 1e-300)) if term.is_log else one for term, one in zip(free, at, strict=True)]
    return Problem(record, known, free), np.array(begin)


def _slopes(problem: Problem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened innovations, shape (n, n_channels), and their derivatives, (n_unknowns, n, n_channels)."""
    base = _white(problem, theta)
    slopes = [(_white(problem, theta + STEP * axis) - base) / STEP for axis in np.eye(len(theta))]
    return base, np.array(slopes)


def _white(problem: Problem, theta: FloatArray) -> FloatArray:
    out, _ = problem.record.predict(problem.values(theta))
    return np.clip(out[:, :2][:, problem.record.seen > 0.0], -_WILD, _WILD)
