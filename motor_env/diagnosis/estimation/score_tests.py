"""Score tests: what adding a term to a fit would do, without fitting it (Rao 1948)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.terms import Term
from motor_env.motor.parameters import FloatArray

_NO_NUMBER = 1e60
_BRUSHES = 0.04  # of the largest voltage
_KNEES = {0.1: 1.0, 1.0: 2.0}
"""Share of the largest current at which half of the brushes' voltage is there: that voltage over the usual."""
_SAG = 0.05  # of the supply's voltage, at the largest current
_GEAR = 0.07
"""Share of the motor's torque that a gear usually takes."""
_CONVERTED = math.sqrt(0.5 * (1.0 / 12.0 + 0.25))
"""Error of a converter in steps (rms): it rounds, or cuts off, which takes half a step on average."""
_CANDIDATES = ("gear_loss", "load_constant", "load_square", "heating", "sensor_lag", "speed_lag", "delay")


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """What adding a term would do.

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
    seen, names = best.problem.record.seen, best.problem.names
    left = [name for name in _CANDIDATES if name not in names]
    if "heating" in names and "cooling" not in names:
        left.append("cooling")
    if not seen[0]:
        left = [name for name in left if name not in {"sensor_lag", "heating", "cooling", "load_square"}]
    if not seen[1]:
        left = [name for name in left if name != "speed_lag"]
    if not seen.all():  # one of them alone cannot tell it from other friction
        left = [name for name in left if name != "gear_loss"]
    return left


def score_tests(
    best: Solution, every: dict[str, Term], tested: Sequence[str], sizes: Sequence[float] = ()
) -> dict[str, ScoreTest]:
    """Test each of some terms without fitting it.

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
    """Residuals of a fit and their slopes at the point: what a further column of slopes would tell.

    Wide steps of one unknown at a time make dry friction and a load look well determined where only standstill tells
    them apart: with them more records of one motor disagreed.
    """

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
    """Test what real motors have and no term says, each of its usual size (1), at the fitted motion.

    Brushes whose resistance falls with the current (Holm 1967), at small currents, which bends the record, or at larger
    ones, which looks like R; and a gear that loses torque, where it is no term.
    """
    problem, record = best.problem, best.problem.record
    if not record.seen[0]:
        return []
    lacked = [_with_brush_resistance(best, *usual) for usual in _KNEES.items()]
    if "gear_loss" not in best.names:
        geared = problem.known.copy()
        geared[index.GEAR] = _GEAR
        lacked.append(replace(problem, known=geared))
    return _unit_size_tests(best, lacked)


def quantisation_effects(best: Solution) -> list[ScoreTest]:
    """Test what converters do to each channel, by a standard deviation, where all readings of one sign err alike.

    Noise smaller than a step does not average it away, and a motor may stay within a few steps.
    """
    record, erred = best.problem.record, []
    for channel in np.flatnonzero(record.seen):
        readings = record.readings.copy()
        readings[:, channel] += _CONVERTED * record.steps[channel] * np.sign(readings[:, channel])
        erred.append(replace(best.problem, record=replace(record, readings=readings)))
    return _unit_size_tests(best, erred)


def supply_effects(best: Solution) -> list[ScoreTest]:
    """Test what may stand between a stated voltage and the motor, each of its usual size (1), at the fitted current.

    Brushes as in `unmodelled_effects`, and a supply that falls with the square of the current.
    """
    record, current = best.problem.record, best.free[0][:, 2]
    lost = _SAG * record.voltage_v * (current / np.abs(current).max()) ** 2
    sagged = replace(best.problem, record=replace(record, voltage_v=record.voltage_v - lost))
    return _unit_size_tests(best, [_with_brush_resistance(best, min(_KNEES), 1.0), sagged], is_positive=True)


def _with_brush_resistance(best: Solution, knee: float, size: float) -> Problem:
    """Return the problem behind brushes whose resistance falls with the current (Holm 1967), `size` times the usual."""
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
