"""Fits of records and windows of a motor at work, as quantities with intervals: `identify_operation`, `fit_window`."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.ekf import BEGIN
from motor_env.diagnosis.estimation.model_selection import fit
from motor_env.diagnosis.estimation.preprocessing import MOST, from_recordings
from motor_env.diagnosis.estimation.problem import STEP, Problem, Solution, motor_unknowns
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.terms import NOISES, SHAPES, terms
from motor_env.diagnosis.estimation.uncertainty import capped, covariance, information_covariance, secants
from motor_env.diagnosis.readers.noise import PeriodicLine, constant_lines, explainable, periodic_lines
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.motor.compiled import on_one_thread
from motor_env.motor.parameters import FloatArray

FEWEST_STEPS = 0.2  # of the voltage's changes: where holes hide more, the best fit may be another motor's
UNSEEN_STEPS = "the inductance is then hardly determined"
_UNTOLD = 0.5
_AT_BOUND, _LARGEST = 0.99, "is the largest that physics allows"
_LONGEST_LAG_S = 0.2  # L/R of brushed motors, with a margin
_UNFIT = "its voltage hardly moves, or is a raw pulse-width modulation that was sampled more slowly than it switches"
_POOR = 0.5
_CURRENT_TELLS = 0.3
_TWO_SIDED = 1.96
_SAME_LINE = 2.0  # bins of a spectrum
_UNITS_FULL = {
    "R": "ohm", "L": "H", "K": "V s/rad", "J": "kg m2", "B": "N m s/rad", "coulomb": "N m", "brush_drop": "V",
    "load_constant": "N m", "load_square": "N m s2/rad2", "offset_current": "A", "offset_speed": "rad/s",
    "sensor_lag": "s", "speed_lag": "s", "drag": "N m", "brush_knee": "A", "stribeck": "of coulomb",
    "gear_loss": "of the torque",
    "coulomb_knee": "rad/s", "supply_resistance": "ohm",
}  # fmt: skip
_UNITS_CURRENT = _UNITS_FULL | {
    "J": "A s/V", "B": "A/V", "coulomb": "A", "load_constant": "A", "load_square": "A/V2", "drag": "A",
    "coulomb_knee": "V",
}  # fmt: skip
_UNITS_SPEED = _UNITS_FULL | {
    "J": "A s2/rad ohm", "coulomb": "V2 s/rad", "load_constant": "V2 s/rad", "load_square": "V2 s3/rad3",
}  # fmt: skip
_NAMES_CURRENT = {"J": "J/K^2", "B": "B/K^2", "coulomb": "coulomb/K", "load_constant": "load_constant/K",
                  "load_square": "load_square/K^3", "drag": "drag/K"}  # fmt: skip
LOAD = ("load_constant", "load_walk")
_MOTOR = ("R", "K", "J", "drag")
_LOADS = ("load_constant", "load_square", "offset_current", "offset_speed")
_MOST_ROUNDS = 8  # of a fit, which begins near the healthy motor
_FAR = 0.4  # logarithm of R, K or J over the healthy one's, from where a fit goes on
_DRAG, _DRAG_PLACES = ("coulomb", "B", "load_square"), [index.COULOMB, index.B, index.SQUARE]
_LEAST_SHARE = 0.01  # of the friction, where a fit without a load begins
_NO_WORK = 1e-12  # W, summed over the samples


@dataclass(frozen=True, slots=True)
class Quantity:
    """Quantity of the motor with its interval.

    Attributes:
        name: as in the reports.
        value: SI.
        low, high: interval, 95 %.
        unit: of these.
        is_determined: whether the record determines it to better than half of its value.
        log_sd: standard deviation of its logarithm, or relative standard deviation.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str
    is_determined: bool
    log_sd: float


@dataclass(frozen=True, slots=True)
class OperationFit:
    """A motor at work, identified.

    Attributes:
        record: what was fitted.
        solution: the fit.
        quantities: of the motor, undetermined ones included.
        covariance: of the unknowns that are no noises, shape (p, p), in their units.
        expected: current and speed of the free run under the voltage, shape (n, 2).
        r2_current, r2_speed: share of the variance that the free run explains; None where not used.
        notes: what the record cannot tell, in sentences.
    """

    record: Record
    solution: Solution
    quantities: tuple[Quantity, ...]
    covariance: FloatArray
    expected: FloatArray
    r2_current: float | None
    r2_speed: float | None
    notes: tuple[str, ...]

    @property
    def model(self) -> tuple[str, ...]:
        """Names of the terms that are no noises, a slowly varying load included; shapes only where determined."""
        walks = ["load_walk"] if "load_walk" in self.solution.names else []
        reported = {quantity.name for quantity in self.quantities}
        left_out = {*NOISES, *(name for name in SHAPES if name not in reported)}
        return (*(name for name in self.solution.names if name not in left_out), *walks)

    def quantity(self, name: str) -> Quantity:
        """Return a quantity by its name."""
        return next(quantity for quantity in self.quantities if quantity.name == name)


def identify_operation(recordings: Sequence[Recording], *, most: int = MOST) -> OperationFit:
    """Fit one motor to recordings of it at work, jointly.

    Args:
        recordings: with voltage, current and, where measured, speed.
        most: number of samples beyond which neighbours are averaged.

    Raises:
        UnusableError: they cannot be used together, or no motor explains them.
    """
    return identify_record(from_recordings(recordings, most=most))


def without_lines(solution: Solution, record: Record) -> tuple[Record, tuple[PeriodicLine, ...]]:
    """Take the lines off a record's current; return it with them. Each recording has its own.

    A line that the voltage has too is the motor's answer to it, and stays.

    Args:
        solution: its fit.
        record: what was fitted.
    """
    if record.recorded[0] == 0.0:
        return record, ()
    free = solution.free[1]
    residual, readings = np.nan_to_num(record.readings[:, 0] - free[:, 2]), record.readings.copy()
    begins, every = np.flatnonzero(record.marks == ekf.BEGIN), []
    for first, end in zip(begins, [*begins[1:], len(residual)], strict=True):
        some, time_s = slice(first, end), record.dt_s * np.arange(end - first)
        own = [line.frequency_hz for line in periodic_lines(record.voltage_v[some], time_s)]
        beside = _SAME_LINE / (record.dt_s * (end - first))
        for line in constant_lines(residual[some], time_s, np.abs(free[some, 3])):
            if all(abs(line.frequency_hz - frequency_hz) > beside for frequency_hz in own):
                readings[some, 0] -= line.current_a(time_s)
                every.append(line)
    return replace(record, readings=readings) if every else record, tuple(every)


@on_one_thread
def identify_record(record: Record, without: Collection[str] = ()) -> OperationFit:
    """Fit one motor to a record.

    Args:
        record: what is fitted.
        without: names of terms that the model must not have.

    Raises:
        UnusableError: no motor explains it.
    """
    solution = fit(record, without)
    record, lines = without_lines(solution, record)
    # Its terms may have stood for the lines.
    operation = _operation_fit(fit(record, without) if lines else solution, lines)
    if operation.r2_current is not None and operation.r2_current < _CURRENT_TELLS and record.recorded[1]:
        operation = _operation_fit(fit(record.only(current=False, speed=True), without))
    _refuse_poor_fit(operation)
    return operation


def _refuse_poor_fit(operation: OperationFit) -> None:
    for n, (name, r2) in enumerate((("current", operation.r2_current), ("speed", operation.r2_speed))):
        if r2 is None:
            continue
        least = _POOR * explainable(operation.record.readings[operation.record.informative[:, n], n])
        if not r2 >= least:
            raise UnusableError(
                f"no motor model explains the {name} (R2 {r2:.2f}; at least {least:.2g} is needed)"
            )
    determined = {
        quantity.name: quantity.value for quantity in operation.quantities if quantity.is_determined
    }
    names = [quantity.name for quantity in operation.quantities]
    needed = [name for name in names if name.split("/")[0] in ("R", "K", "J", "R J")]
    untold = ", ".join(name for name in needed if name not in determined)
    # Without a recorded speed, which is what R leaves of the voltage, all else rests on R and J/K^2.
    if not (any if operation.record.recorded[1] else all)(name in determined for name in needed):
        # A term at its bound says more than a guess at the voltage.
        reason = next((note for note in operation.notes if _LARGEST in note), _UNFIT)
        raise UnusableError(f"the record does not determine {untold}: {reason}")
    if determined.get("L", 0.0) > _LONGEST_LAG_S * determined.get("R", math.inf):
        raise UnusableError(f"L/R of {determined['L'] / determined['R']:.3g} s is that of no motor: {_UNFIT}")


def _operation_fit(solution: Solution, lines: tuple[PeriodicLine, ...] = ()) -> OperationFit:
    record = solution.problem.record
    spread = covariance(solution)
    r2 = solution.explained()
    quantities = tuple(_quantities(solution, spread))
    return OperationFit(
        record=record,
        solution=solution,
        quantities=quantities,
        covariance=spread,
        expected=solution.free[1][:, 2:4],
        r2_current=r2[0],
        r2_speed=r2[1],
        notes=tuple(_notes(record, solution, quantities, lines)),
    )


def _quantities(solution: Solution, spread: FloatArray) -> list[Quantity]:
    """Return each unknown with its interval, and the whole drag at the effective speed."""
    problem, theta = solution.problem, solution.theta
    chosen = motor_unknowns(problem)
    names, units = _names_and_units(problem.record)
    quantities = []
    for row, n in enumerate(chosen):
        term, sd = problem.free[n], math.sqrt(max(spread[row, row], 0.0))
        value, half = term.value(theta[n]), _TWO_SIDED * sd
        if term.is_log:
            low, high = value * math.exp(-min(half, 300.0)), value * math.exp(min(half, 300.0))
            relative = sd
        else:
            low, high = value - half * term.unit, value + half * term.unit
            low = max(low, 0.0) if term.low >= 0.0 else low
            if term.bound is not None:
                high = min(high, term.value(term.high))
            relative = sd * term.unit / max(abs(value), 1e-300)
        is_determined = bool(relative < _UNTOLD)
        name = term.name
        if name in SHAPES and not is_determined:
            continue
        quantities.append(
            Quantity(names.get(name, name), value, low, high, units[name], is_determined, relative)
        )
    drag = _drag(solution, spread, names.get("drag", "drag"), units["drag"])
    return [*quantities, drag] if drag else quantities


def _drag(solution: Solution, spread: FloatArray, name: str, unit: str) -> Quantity | None:
    """Return the friction torque at the effective speed, B w + Tc (+ c w^2): known better than its parts."""
    problem, values = solution.problem, solution.values
    if "B" not in problem.names:
        return None
    speed = solution.free[0][:, 3]
    w = float(np.sqrt(np.mean(speed**2)))
    slopes = {"B": w, "coulomb": 1.0, "load_square": w * w}
    terms_ = [problem.free[n] for n in motor_unknowns(problem)]
    gradient = np.array([slopes.get(term.name, 0.0) * term.unit for term in terms_])
    value = values[index.B] * w + values[index.COULOMB] + values[index.SQUARE] * w * w
    sd = math.sqrt(max(float(gradient @ spread @ gradient), 0.0))
    half = _TWO_SIDED * sd
    relative = sd / max(value, 1e-300)
    return Quantity(
        name, value, max(value - half, 0.0), value + half, unit, bool(relative < _UNTOLD), relative
    )


def _names_and_units(record: Record) -> tuple[dict[str, str], dict[str, str]]:
    if record.recorded.all():
        return {}, _UNITS_FULL
    if record.recorded[0]:
        return _NAMES_CURRENT, _UNITS_CURRENT
    return {"J": "R J", "coulomb": "R coulomb"}, _UNITS_SPEED


def _notes(
    record: Record,
    solution: Solution,
    quantities: tuple[Quantity, ...],
    lines: tuple[PeriodicLine, ...],
) -> list[str]:
    values, sentences = solution.values, []
    if record.recorded[0] and not record.recorded[1]:
        sentences.append("the current alone determines J/K^2 and B/K^2, not K, J and B")
    if not record.recorded[0]:
        gain, lag = 1.0 / values[index.K], values[index.J] / values[index.K] ** 2
        dead = values[index.COULOMB] / values[index.K]
        sentences.append(
            f"the current is all noise: R, L and the friction are not determined; the speed alone gives"
            f" {gain:.4g} rad/s a volt, a dead voltage of {dead:.3g} V and a time constant of {lag:.3g} s"
        )
    sentences += [
        f"{term.name} {_LARGEST} ({term.bound.most:g} {term.bound.unit}: {term.bound.source}):"
        " an effect outside the model may be the cause"
        for term, theta in zip(solution.problem.free, solution.theta, strict=True)
        if term.bound is not None and theta > _AT_BOUND * term.high
    ]
    untold = [
        quantity.name
        for quantity in quantities
        if not quantity.is_determined and quantity.name.split("/")[0] in ("R", "L", "K", "J", "B")
    ]
    if untold:
        sentences.append(f"not determined by this record: {', '.join(untold)}")
    if record.visible_step_share < FEWEST_STEPS:
        sentences.append(f"samples are missing at the voltage's steps: {UNSEEN_STEPS}")
    if lines:
        loudest = max(lines, key=lambda line: line.amplitude_a)
        where = f"{loudest.amplitude_a:.3g} A at {loudest.frequency_hz:.4g} Hz (or an alias of it)"
        sentences.append(f"a ripple of {where} was subtracted from the current")
    if record.averaged > 1:
        sentences.append(f"{record.averaged} neighbouring samples were averaged into one")
    if record.share < 1.0:
        sentences.append(
            f"{record.share:.0%} of the record were used, the stretches in which its voltage moves most"
        )
    return sentences


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
    whitened = np.where(record.informative, record.predict(values)[0][:, :2], np.nan)[1:]
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


def _problem(record: Record, known: FloatArray, wanted: Sequence[str]) -> tuple[Problem, FloatArray]:
    """R, K, J, the drag and those of the wanted terms that differ from window to window as unknowns; known values.

    Raises:
        InputError: a noise or a constant that is 0 gives them no unit.
    """
    every = terms(record, known)
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
