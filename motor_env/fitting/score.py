"""What adding a term to a fit would do, without fitting it (Rao 1948)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motor_env.fitting.problem import Solution
from motor_env.fitting.terms import Term
from motor_env.motor.parameters import FloatArray

_NO_NUMBER = 1e60
_CANDIDATES = ("load_constant", "load_square", "heating", "sensor_lag", "speed_lag", "delay")


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """What adding a term would do (Rao 1948).

    Attributes:
        chi_square: by how much -2 log likelihood would fall.
        value, sd: of the unknown.
        moves: of the other unknowns, for one unit of it.
    """

    chi_square: float
    value: float
    sd: float
    moves: FloatArray


def candidates(best: Solution) -> list[str]:
    """Terms that a record may tell and the model lacks."""
    seen, names = best.problem.record.seen, best.problem.names
    left = [name for name in _CANDIDATES if name not in names]
    if "heating" in names and "cooling" not in names:
        left.append("cooling")
    if not seen[0]:
        left = [name for name in left if name not in {"sensor_lag", "heating", "cooling", "load_square"}]
    if not seen[1]:
        left = [name for name in left if name != "speed_lag"]
    return left


def score_tests(
    best: Solution, every: dict[str, Term], tested: Sequence[str], sizes: Sequence[float] = ()
) -> dict[str, ScoreTest]:
    """A test of each of some terms, without fitting it.

    Args:
        best: a fit without them.
        every: all terms.
        tested: names of those that are tested.
        sizes: of each term over its usual one, of which the most telling counts; by default it is small.
    """
    if not tested:
        return {}
    base = best.problem.residuals(best.theta)
    jacobian = best.problem.jacobian(best.theta, base)
    variance = float(base @ base) / best.problem.count
    inverse = np.linalg.pinv(jacobian)
    found = {}
    for name in tested:
        term = every[name]
        problem = best.problem.with_terms([term])
        sides = np.array([min(size * term.usual, term.high) for size in sizes] or [term.slope_at])
        moved = problem.residuals_each(np.column_stack([np.tile(best.theta, (len(sides), 1)), sides]))
        moved = np.clip(moved, -_NO_NUMBER, _NO_NUMBER)  # a size at which the model has no numbers
        columns = (np.delete(moved, len(base), axis=1) - base).T / sides
        moves = -inverse @ columns
        columns = columns + jacobian @ moves
        information = np.maximum(np.sum(columns**2, axis=0), 1e-300)
        values = -(base @ columns) / information
        gains = np.where((values < 0.0) & (term.low >= 0.0), 0.0, values**2 * information / variance)
        most = int(np.argmax(gains))
        if information[most] <= 1e-12 * variance:
            continue
        sd = math.sqrt(variance / information[most])
        found[name] = ScoreTest(float(gains[most]), float(values[most]), sd, moves[:, most])
    return found
