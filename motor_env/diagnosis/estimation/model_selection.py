"""Model selection for a motor at work: initial values by regression, and the terms that the evidence supports.

Integrated over windows the equations need no derivative of a noisy signal. With current and speed they are linear in
all unknowns; with the current alone for each of several resistances.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls

from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.preprocessing import median_noise
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.record import HOLDS, Record
from motor_env.diagnosis.estimation.terms import SHAPES, Term, terms
from motor_env.diagnosis.estimation.uncertainty import candidates, score_tests
from motor_env.diagnosis.readers.noise import filled
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.motor.parameters import FloatArray

Fit = TypeVar("Fit")

_WINDOWS = (2, 5, 12, 30, 80, 200)
_RESISTANCES = np.geomspace(0.04, 2.0, 9)
_LEAST = 1e-9
_LEAST_LAG = 0.3  # of R dt
STRONG_EVIDENCE = 6.0
SELECTION_SAMPLES = 2_000
"""Samples on which the model of a record more than twice as long is selected."""
_FIRST_NOISE_V = 0.02
_FIRST_SHAPE = 0.1  # of what is believed
_QUIET_VALUES = {
    "brush_knee": 1e-3,
    "offset_current": 0.0,
    "offset_speed": 0.0,
    "noise_voltage": -1.0,
    "noise_torque": -4.0,
    "load_walk": -4.0,
}
_TORQUE_DISTURBANCES = ("load_walk", "noise_torque")
"""Of the torques that disturb the motor, one that wanders and one of each interval, at most one is fitted."""
_MOST_TRIED = 2
_FEW_EVALUATIONS = 6
_ALTERNATIVE, _HOPELESS = 0.1, 0.3  # of the number of readings
_CLEARLY = math.log(2.0)
_NEAR_BOUND = 0.8  # of the largest brush drop
_SMALL_DROP_V = 0.3  # of metal-graphite brushes, half of what IEC 60034-2-1 counts


def initial_values(record: Record) -> list[FloatArray]:
    """Return values to begin a fit from, each of shape (parameter_index.N_VALUES,)."""
    guesses = []
    for window in _WINDOWS:
        if len(record.voltage_v) < 12 * window:
            break
        if record.recorded.all():
            guesses += [_from_current_and_speed(record, window, loaded=loaded) for loaded in (False, True)]
        elif record.recorded[0]:
            guesses += [
                _from_current(record, window, share, loaded=loaded)
                for share in _RESISTANCES
                for loaded in (False, True)
            ]
        else:
            guesses.append(_from_speed(record, window))
    return [values for values in guesses if values is not None]


def _changes(sums: FloatArray, record: Record, width: int) -> FloatArray:
    """Return the change of a series over each window within one recording."""
    counted, starts = np.cumsum(record.begins), np.arange(0, len(sums) - width, max(width // 2, 1))
    starts = starts[counted[starts + width] == counted[starts]]
    return np.asarray(sums[starts + width] - sums[starts], dtype=np.float64)


def _means(column: FloatArray, record: Record, width: int) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (column[1:] + column[:-1]))])
    return _changes(sums, record, width) / width


def _slopes(column: FloatArray, record: Record, width: int) -> FloatArray:
    return _changes(column, record, width) / (width * record.dt_s)


def _volts(record: Record, width: int) -> FloatArray:
    """Return the mean voltage of each window; it may be held between samples."""
    sums = np.concatenate([[0.0], np.cumsum(record.between()[1:].mean(axis=1))])
    return _changes(sums, record, width) / width


def _solve(columns: list[FloatArray], target: FloatArray) -> FloatArray:
    matrix = np.stack(columns, axis=1)
    size = np.sqrt(np.mean(matrix**2, axis=0)) + 1e-300
    solution: FloatArray = nnls(matrix / size, target)[0] / size
    return solution


def _torques(
    columns: list[FloatArray], torque: FloatArray, *, loaded: bool
) -> tuple[float, float, float, float]:
    """Solve for inertia, viscous and dry friction, and a constant load of either sign if `loaded`."""
    ones = np.ones(len(torque))
    solution = _solve([*columns, ones, -ones] if loaded else columns, torque).tolist()
    load = solution[3] - solution[4] if loaded else 0.0
    return solution[0], solution[1], solution[2], load


def _values(record: Record, **given: float) -> FloatArray:
    """Return physical values with noises out of a regression's."""
    values = np.zeros(index.N_VALUES)
    for name, value in given.items():
        values[getattr(index, name)] = value
    values[index.L] = max(values[index.L], _LEAST_LAG * values[index.R] * record.dt_s)
    values[index.NOISE_I] = median_noise(filled(record.readings[:, 0])) if record.recorded[0] else 1.0
    values[index.NOISE_W] = median_noise(filled(record.readings[:, 1])) if record.recorded[1] else 1.0
    return values


def _from_current_and_speed(record: Record, window: int, *, loaded: bool) -> FloatArray | None:
    """Regress current and speed: V = R i + L di/dt + K w + drop, K i = J dw/dt + B w + Tc sign(w)."""
    i, w = filled(record.readings[:, 0]), filled(record.readings[:, 1])
    mean_i, mean_w, direction = (_means(column, record, window) for column in (i, w, _sign(w)))
    slope_i, slope_w = (_slopes(column, record, window) for column in (i, w))
    r, inductance, k = _solve([mean_i, slope_i, mean_w], _volts(record, window))
    if k <= 0.0 or r <= 0.0:
        return None
    inertia, drag, dry, load = _torques([slope_w, mean_w, direction], k * mean_i, loaded=loaded)
    if inertia <= 0.0:
        return None
    return _values(record, R=r, L=inductance, K=k, J=inertia, B=drag, COULOMB=dry, LOAD=load)


def _from_current(record: Record, window: int, share: float, *, loaded: bool) -> FloatArray | None:
    """Regress the current alone, with K = 1: the speed is what R leaves of the voltage."""
    volts, amps, _ = record.peaks
    r, mean_i = share * volts / amps, _means(filled(record.readings[:, 0]), record, window)
    w = _volts(record, window) - r * mean_i
    slope = (w[2:] - w[:-2]) / (2.0 * max(window // 2, 1) * record.dt_s)
    inertia, drag, dry, load = _torques([slope, w[1:-1], _sign(w)[1:-1]], mean_i[1:-1], loaded=loaded)
    if inertia <= 0.0:
        return None
    return _values(record, R=r, K=1.0, J=inertia, B=drag, COULOMB=dry, LOAD=load)


def _from_speed(record: Record, window: int) -> FloatArray | None:
    """Regress the speed alone, with R = 1 and B = 0: V = K w + J/K dw/dt + Tc/K sign(w)."""
    w = filled(record.readings[:, 1])
    columns = [_means(w, record, window), _slopes(w, record, window), _means(_sign(w), record, window)]
    k, lag, dead = _solve(columns, _volts(record, window))
    if k <= 0.0 or lag <= 0.0:
        return None
    return _values(record, R=1.0, K=k, J=lag * k, COULOMB=dead * k)


def _sign(w: FloatArray) -> FloatArray:
    slow = 0.01 * float(np.quantile(np.abs(w), 0.99)) + _LEAST
    direction: FloatArray = w / np.maximum(np.abs(w), slow)
    return direction


def fit(record: Record, without: Collection[str] = ()) -> Solution:
    """Fit the smallest model of a record that the evidence supports, with alternatives, which widen its intervals.

    Args:
        record: what is fitted.
        without: names of terms that no model may have.

    Raises:
        UnusableError: no regression finds a motor in the record.
    """
    best = _with_timing_alternatives(_with_less_brush_drop(_smallest_model(record, without)))
    return _without_process_noise(best)


def add_terms(
    best: Fit, extended: Callable[[Fit], Iterable[Fit]], evidence: Callable[[Fit, Fit], float]
) -> Fit:
    """Return the fit of a start or of a motor at work with all terms for which there is strong evidence.

    Args:
        best: the fit to begin from.
        extended: fits with one term more, of those that a score test promises.
        evidence: for a richer fit over a simpler one: the fall of the Bayesian information criterion (Schwarz 1978).
    """
    while True:
        gains = [(evidence(best, richer), richer) for richer in extended(best)]
        gain, richer = max(gains, key=lambda pair: pair[0], default=(0.0, best))
        if gain < STRONG_EVIDENCE:
            return best
        best = richer


def promising(
    best: Solution,
    every: Mapping[str, Term],
    tested: Sequence[str],
    least: float,
    sizes: Sequence[float] = (),
) -> list[str]:
    """Name the terms whose score test promises more than `least`; see `score_tests`."""
    tests = score_tests(best, every, tested, sizes)
    return [name for name, test in tests.items() if test.chi_square > least]


def _smallest_model(record: Record, without: Collection[str] = ()) -> Solution:
    """Fit a record without alternatives; a long one from a part. How the voltage is held is chosen before the terms."""
    if len(record.voltage_v) > 2 * SELECTION_SAMPLES:
        return _refit_to_all_samples(_smallest_model(record.sample(SELECTION_SAMPLES), without), record)
    best = _select_terms(_first_fit(record, without))
    # A load that walks may have stood for the shape of friction.
    shaped = _drop_if_unsupported(_with_shape_parameters(best), "load_walk", STRONG_EVIDENCE)
    return _grown(shaped).escape_local_minimum()


def _with_timing_alternatives(best: Solution) -> Solution:
    """Add fits of other voltage timing as alternatives where the voltage has no steps: a lag then looks like L/R."""
    slopes = np.diff(best.problem.record.voltage_v)
    if np.nansum(np.abs(np.diff(slopes))) > np.nansum(np.abs(slopes)):
        return best
    most = best.misfit + _ALTERNATIVE * best.problem.count
    return _with_alternatives(best, [other for other in _fits_of_other_voltages(best) if other.misfit < most])


def _without_process_noise(best: Solution) -> Solution:
    """Add the fit without process noise as an alternative of the same misfit, if it explains nearly as much.

    Process noise stands for what the model lacks. Under a controller that depends on the current, and biases R.
    """
    if not {"noise_voltage", *_TORQUE_DISTURBANCES} & {*best.names}:
        return best
    (other,) = _output_error_fits([best])
    return _with_alternatives(
        best, [other] if _log_unexplained(other).mean() < _log_unexplained(best).mean() + _CLEARLY else []
    )


def _with_less_brush_drop(best: Solution) -> Solution:
    """Add the fit with a small brush drop as an alternative where the largest that physics allows is fitted.

    What brushes lose trades with R and K, and what no term says may have asked for more of it. The drop held at its
    bound also leads out of a local minimum near it.
    """
    if "brush_drop" not in best.names:
        return best
    place = best.names.index("brush_drop")
    most = best.problem.free[place].high
    if best.theta[place] < _NEAR_BOUND * most:
        return best
    held = _with_brush_drop(best, place, most)
    if held.misfit < best.misfit - STRONG_EVIDENCE:
        best = _grown(best.problem.solve(held.theta))
    small = min(_SMALL_DROP_V / best.problem.free[place].unit, 0.5 * most)
    return _with_alternatives(best, [_with_brush_drop(best, place, small)])


def _with_brush_drop(best: Solution, place: int, drop: float) -> Solution:
    """Fit the other terms with the brush drop held, in its unit."""
    less, known = _remove_terms(best, ("brush_drop",)), best.problem.known.copy()
    known[index.DROP] = best.problem.free[place].value(drop)
    held = replace(less.problem, known=known).solve(less.theta)
    return Solution(best.problem, np.insert(held.theta, place, drop), held.misfit)


def _with_alternatives(best: Solution, others: Sequence[Solution]) -> Solution:
    """Add other fits as alternatives of the same misfit; terms that they lack stay as they are."""
    rivals = []
    for other in others:
        known = dict(zip(other.names, other.theta, strict=True))
        theta = [known.get(name, value) for name, value in zip(best.names, best.theta, strict=True)]
        rivals.append((np.array(theta), best.misfit))
    return replace(best, alternative_optima=(*best.alternative_optima, *rivals))


def _refit_to_all_samples(best: Solution, record: Record) -> Solution:
    """Fit the model of a part of a long record to all of it, with further terms."""
    hold = best.problem.record.hold
    record = replace(record if (best.problem.record.marks == ekf.OPEN).any() else record.closed(), hold=hold)
    return _grown(replace(best.problem, record=record).solve(best.theta, most=_FEW_EVALUATIONS))


def _fits_of_other_voltages(best: Solution) -> list[Solution]:
    """Fit under every other variant of the voltage."""
    problem, record = best.problem, best.problem.record
    return [
        replace(problem, record=other).solve(best.theta)
        for other in _voltage_variants(record)
        if other.hold != record.hold or not np.array_equal(other.marks, record.marks)
    ]


def _voltage_variants(record: Record) -> list[Record]:
    """Return the record with every way in which the voltage may be held, with and without open circuits."""
    circuits = [record, record.closed()] if (record.marks == ekf.OPEN).any() else [record]
    holds = HOLDS if record.averaged == 1 else (record.hold,)
    return [replace(circuit, hold=hold) for hold, circuit in product(holds, circuits)]


def _with_shape_parameters(best: Solution) -> Solution:
    """Fit the shapes of dry friction under their prior, and all else, from several initial values.

    Noise and a walking load may have carried a fit away; dry friction and a constant load may stand for each other.
    """
    every = best.problem.available_terms
    added = [
        every[shape]
        for shape, of in SHAPES.items()
        if of in best.names and shape in every and shape not in best.names
    ]
    problem = best.problem.with_terms(added)
    begin = np.append(best.theta, [_FIRST_SHAPE * term.prior_sd for term in added])
    calm = np.array(
        [_QUIET_VALUES.get(name, value) for name, value in zip(problem.names, begin, strict=True)]
    )
    starting_points = [begin, calm]
    if {"coulomb", "load_constant"} <= set(best.names):
        dry, load = problem.names.index("coulomb"), problem.names.index("load_constant")
        turns = math.copysign(1.0, float(best.free[0][:, 3].mean()))
        for more in (-begin[dry], abs(begin[load])):
            moved = begin.copy()
            moved[dry] += more
            moved[load] -= turns * more
            starting_points.append(moved)
    tried = [problem.solve(theta) for theta in starting_points]
    shaped = min(tried, key=lambda solution: solution.misfit)
    if shaped.misfit > best.misfit + len(added):
        return best
    return replace(
        shaped, alternative_optima=tuple((each.theta, each.misfit) for each in tried if each is not shaped)
    )


def _select_terms(first: Solution) -> Solution:
    """Select the terms that the evidence supports, from a fit of those that every motor has."""
    best = first
    for name in ("load_walk", "load_constant"):
        best = _drop_if_unsupported(best, name)
    best = _grown(best)
    for name in _TORQUE_DISTURBANCES:
        if name not in best.names and name in best.problem.available_terms:
            disturbed = _refit(
                _remove_terms(best, _TORQUE_DISTURBANCES), [best.problem.available_terms[name]]
            )
            if disturbed.bic() < best.bic() - STRONG_EVIDENCE:
                best = _grown(disturbed)
    # It may have stood for a term that came later.
    best = _drop_if_unsupported(best, "load_walk")
    return min([best, *_output_error_fits([first, best])], key=_free_run_misfit)


def _output_error_fits(solutions: Sequence[Solution]) -> list[Solution]:
    """Fit the same terms without process noise, to output errors."""
    reduced = [_remove_terms(solution, ("noise_voltage", *_TORQUE_DISTURBANCES)) for solution in solutions]
    return [less.problem.solve(less.theta, most=60) for less in reduced]


def _free_run_misfit(solution: Solution) -> float:
    """Sum `_log_unexplained`."""
    left = _log_unexplained(solution)
    return float(left.sum()) + (0.0 if "noise_voltage" not in solution.names else -_CLEARLY * len(left))


def _log_unexplained(solution: Solution) -> FloatArray:
    """Return the logarithm of the variance share that the free run leaves, each channel."""
    return np.log([max(1.0 - r2, 1e-12) for r2 in solution.explained() if r2 is not None])


def _grown(best: Solution) -> Solution:
    """Add the terms that the evidence supports."""

    def extended(simple: Solution) -> Iterator[Solution]:
        every, least = simple.problem.available_terms, math.log(simple.problem.count) + STRONG_EVIDENCE
        for name in promising(simple, every, candidates(simple), least):
            yield _refit(simple, [every[name]])

    return add_terms(best, extended, lambda simple, rich: simple.bic() - rich.bic())


def _drop_if_unsupported(best: Solution, name: str, least: float = 0.0) -> Solution:
    if name not in best.names:
        return best
    trial = _refit(_remove_terms(best, (name,)), [])
    return trial if trial.bic() < best.bic() + least else best


def _remove_terms(best: Solution, names: Collection[str]) -> Solution:
    kept = [n for n, name in enumerate(best.names) if name not in names]
    problem = replace(best.problem, free=tuple(best.problem.free[n] for n in kept))
    return Solution(problem, best.theta[kept], best.misfit)


def _base_terms(record: Record) -> list[str]:
    """Name the terms to begin with: what every motor has, as far as the channels can tell, and any load."""
    names = ["J", "coulomb", "load_constant", "noise_voltage", "load_walk"]
    if record.recorded[0]:
        names += ["R", "L", "B", "brush_drop", "brush_knee", "offset_current", "noise_current"]
    if record.recorded[1]:
        names += ["K", "offset_speed", "noise_speed"]
    return names


def _first_fit(record: Record, without: Collection[str]) -> Solution:
    """Fit the first terms under every way in which the voltage may be held; return the best."""
    few = []
    for behaved in _voltage_variants(record):
        initial = initial_problems(behaved, without)[:_MOST_TRIED]
        tried = [problem.solve(theta, most=_FEW_EVALUATIONS) for problem, theta in initial]
        few += sorted(tried, key=lambda solution: solution.misfit)[:1]
    if not few:
        raise UnusableError("no motor is found in the record: voltage, current and speed do not go together")
    ahead = min(solution.misfit for solution in few)
    close = [solution for solution in few if solution.misfit - ahead < _HOPELESS * solution.problem.count]
    return min((_refit(solution, []) for solution in close), key=lambda solution: solution.misfit)


def initial_problems(record: Record, without: Collection[str] = ()) -> list[tuple[Problem, FloatArray]]:
    """Return problems and initial unknowns out of regressions, smallest prediction errors first."""
    problems = [_initial_problem(record, values, without) for values in initial_values(record)]
    return sorted(problems, key=lambda pair: float(np.sum(pair[0].residuals(pair[1]) ** 2)))


def _initial_problem(
    record: Record, values: FloatArray, without: Collection[str]
) -> tuple[Problem, FloatArray]:
    every = terms(record, values)
    free = tuple(every[name] for name in _base_terms(record) if name not in without)
    problem = Problem(record, values, free, tuple(without))
    known = values.copy()
    theta = np.zeros(len(problem.free))
    for n, term in enumerate(problem.free):
        if not term.is_log:
            theta[n] = min(values[term.place] / term.unit, term.high)
        if term.name == "noise_voltage":
            theta[n] = math.log(_FIRST_NOISE_V * record.peaks[0] / term.unit)
    known[[index.L, index.LOAD]] = 0.0  # none where a fit does without
    return replace(problem, known=known), theta


def _refit(before: Solution, added: list[Term]) -> Solution:
    problem = before.problem.with_terms(added)
    begin = np.concatenate([before.theta, [0.0 if term.is_log else 1e-3 for term in added]])
    return problem.solve(begin)
