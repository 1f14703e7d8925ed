"""Least-squares fit of one real start, with the terms for which there is evidence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.model_selection import STRONG_EVIDENCE, add_terms, promising
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.starts.start_fit import UNTOLD_LOG_SD, StartFit, record_of
from motor_env.diagnosis.estimation.starts.start_prior import CURVE, StartPrior, start_prior
from motor_env.diagnosis.estimation.uncertainty import (
    capped,
    free_run_states,
    model_error,
    normalised,
    sandwich,
    supply_effects,
)
from motor_env.diagnosis.readers.noise import constant_lines, hum_frequencies
from motor_env.diagnosis.readers.start import Start
from motor_env.motor import identifiable
from motor_env.motor.compiled import on_one_thread
from motor_env.motor.parameters import FloatArray, MotorParameters

_WILD_SPREADS = 10.0
_USUAL_LAG = 0.03  # L/R over the mechanical time constant, where brushed motors have 0.01 to 0.1
_SMALL, _LARGEST_MOVE = 0.01, 3.0
NUISANCES = ("supply_ramp", "supply_curve", "sensor_lag", "speed_lag", "dead_zone")
"""Terms that do not touch the motor, which a diagnosis may add. Friction and brush drop would take what is compared."""
EXTENSIONS = (*NUISANCES, "coulomb", "brush_drop")
"""All terms, for where nothing is compared."""
SCORED_SIZES = tuple(np.exp([-2.0, 0.0, 2.0, 4.0]).tolist())  # a long lag looks different from a short one
_UNSCORED = ("supply_curve", "dead_zone")
_NO_DRAG = 0.003  # current at no load over that of a held rotor: brushed motors take more
COUPLINGS_PER_S = (0.2, 100.0)
"""Least and largest 1 / time constant of a probe's coupling."""
_CERTAIN = 40.0  # -2 log likelihood
_PROMISING = 6.0  # of a chi-square with one degree; strong evidence takes 12 and more


@on_one_thread
def identify(
    start: Start,
    model: tuple[str, ...] = (),
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
    simpler: StartFit | None = None,
) -> StartFit:
    """Fit the model to a start; take lines of constant frequency and outliers off, and fit again.

    Args:
        start: what to fit.
        model: terms beside the textbook's, of EXTENSIONS.
        constant: K to assume where only the current is measured, which tells K^2/J and B/J alone.
        typical: quantities of such a motor by name, where known: one more initial guess, and a prior of 30 % on L where
            the model makes it ambiguous.
        simpler: a fit that lacks the last term of the model, to begin from.

    Raises:
        UnusableError: the current flows against the voltage.
    """
    belief = start_prior(start, constant, typical)
    problem = belief.problem(model)
    first, *others = (
        belief.initial_guesses(problem)
        if simpler is None
        else belief.extended_guesses(problem, simpler.solution)
    )
    best = problem.solve(first, most=60)
    for guess in others:
        if simpler is None and belief.is_typical(best.theta):
            break
        best = min(best, problem.solve(guess, most=60), key=lambda solution: solution.misfit)
    fit = _start_fit(belief, model, best.reweighted().solve(best.theta, most=100))
    cleaner = _cleaned_start(fit)
    if cleaner is None:
        return fit
    return identify(cleaner, model, constant=constant, typical=typical, simpler=simpler)


def _cleaned_start(fit: StartFit) -> Start | None:
    """Return the start without the lines and outliers that the residual shows; None if there are none."""
    start, residual = fit.start, fit.residual_a
    wild = sorted({*start.alignment.wild, *_outliers_of_fit(residual, start.current_a)})
    if len(wild) > max(len(residual) // 1000, 1):
        wild = list(start.alignment.wild)
    begin = start.alignment.onset_index
    some = slice(begin, None)
    lines = start.lines or constant_lines(residual[some], start.time_s[some], fit.states[some, 1])
    hum_hz = start.hum_hz or _hum_of_fit(fit)
    if (lines, hum_hz) == (start.lines, start.hum_hz) and len(wild) == len(start.alignment.wild):
        return None
    start = start if hum_hz == start.hum_hz else start.with_hum(hum_hz, residual)
    return replace(start, lines=lines, alignment=replace(start.alignment, wild=tuple(wild)))


def _hum_of_fit(fit: StartFit) -> tuple[float, ...]:
    """Return frequencies of the hum in the running motor's residual beside what the unknowns explain."""
    problem, theta, begin = fit.solution.problem, fit.solution.theta, fit.start.alignment.onset_index
    base, record = problem.residuals(theta), problem.record
    n, channels = len(record.marks), int(record.recorded.sum())
    running = slice(begin * channels, n * channels, channels)
    slopes = problem.jacobian(theta, base)[running]
    return hum_frequencies(base[running], fit.start.time_s[begin:n], slopes, fit.states[begin:n, 1])


def _outliers_of_fit(residual: FloatArray, current: FloatArray) -> list[int]:
    """Return samples far off a fit that goes well through both neighbours, and off both to the same side."""
    size = np.abs(residual[1:-1])
    spread = 1.4826 * float(np.median(np.abs(residual)))
    beside = np.maximum(np.abs(residual[:-2]), np.abs(residual[2:]))
    left, right = current[1:-1] - current[:-2], current[1:-1] - current[2:]
    jumps = (left * right > 0.0) & (np.minimum(np.abs(left), np.abs(right)) > 0.5 * size)
    wild = (size > _WILD_SPREADS * spread) & (beside < 0.3 * size) & jumps
    return [int(k) + 1 for k in np.flatnonzero(wild)]


def _start_fit(belief: StartPrior, model: tuple[str, ...], best: Solution) -> StartFit:
    start, problem, theta = belief.start, best.problem, best.theta
    n_core, values = len(belief.core), problem.values(theta)
    jacobian = problem.jacobian(theta, problem.residuals(theta))
    level = start.alignment.unseen_level_a / values[index.NOISE_I]
    white, rows = normalised(problem, theta, jacobian, range(len(theta)))
    covariance, independent = sandwich(white, rows, begin=start.alignment.onset_index, level=level)
    more = model_error(white, rows, covariance, states=free_run_states(best))
    # Per volt of a supply that nobody knows, nothing is claimed.
    if start.voltage_known and start.voltage_v is None:
        wanted = math.log(problem.count) + STRONG_EVIDENCE
        for test in supply_effects(best):
            if test.chi_square > wanted:
                moved = np.clip(math.hypot(test.value, test.sd) * test.moves, -_LARGEST_MOVE, _LARGEST_MOVE)
                more += np.outer(moved, moved)
    if belief.has_inductance_prior(model):
        # What looks like L may be the ramp or the lag, and the other way round: L tells nothing then.
        covariance[1, 1] += UNTOLD_LOG_SD**2
    elif "supply_ramp" in model:
        moved = _hidden_inductance(problem, theta, jacobian)
        more += np.outer(moved, moved)
    names = identifiable.names(has_voltage=start.voltage_known, has_speed=start.speed_rad_s is not None)
    exponents = identifiable.matrix(names)
    core = exponents[:, [identifiable.PARAMETERS.index(name) for name in belief.core]]
    extras = {}
    for name in model:
        if name == "supply_curve":
            extras[name] = _middle_of_rise(problem, values, covariance + more)
            continue
        k = problem.names.index(name)
        unit = problem.free[k].unit
        extras[name] = (unit * float(theta[k]), unit * math.sqrt(max((covariance + more)[k, k], 0.0)))
    expected = record_of(start).predict(values, learn=False)[0][:, 2:4]
    if (beside := start.beside).size:
        left = start.current_a - start.ripple_a - start.alignment.offset_a - expected[:, 0]
        added = np.linalg.lstsq(beside[start.counted], left[start.counted])[0]
        start = replace(start, sizes=tuple((added + start.sizes).tolist()))
    expected[:, 0] += start.alignment.offset_a + start.ripple_a
    parameters = MotorParameters(*values[[index.R, index.L, index.K, index.K, index.J, index.B]].tolist())
    return StartFit(
        start=start,
        model=model,
        solution=best,
        quantity_names=names,
        log_values=exponents @ identifiable.logarithms(parameters, start.level_v),
        log_covariance=capped(core @ (covariance + more)[:n_core, :n_core] @ core.T),
        series_covariance=capped(core @ covariance[:n_core, :n_core] @ core.T),
        expected=expected,
        independent=independent,
        fitted_extension=extras,
        inductance_deviation=belief.inductance_deviation(theta),
    )


def _hidden_inductance(problem: Problem, theta: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return how the unknowns move with an inductance of a usual size, which a slowly rising supply may hide."""
    values, at = problem.values(theta), problem.names.index("L")
    usual = _USUAL_LAG * values[index.J] * (values[index.R] / values[index.K]) ** 2 / values[index.L]
    moved = theta.copy()
    moved[at] += math.log1p(_SMALL * usual)
    column = (problem.residuals(moved) - problem.residuals(theta)) / _SMALL
    moves = np.insert(-np.linalg.pinv(np.delete(jacobian, at, axis=1)) @ column, at, 0.0)
    moves[at] = min(math.log1p(usual), _LARGEST_MOVE)
    return moves


def _middle_of_rise(problem: Problem, values: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the middle of the supply's rise, as a share of its time, and its standard error; 0.5 is even."""
    shares = np.append(1.0, values[index.CURVE])
    shares /= shares.sum()
    at = (np.arange(len(shares)) + 0.5) / len(shares)
    middle = float(shares @ at)
    slopes = (shares * (at - middle))[1:]
    first = problem.names.index(CURVE[0])
    some = slice(first, first + len(slopes))
    return middle, math.sqrt(max(float(slopes @ covariance[some, some] @ slopes), 0.0))


def evidence(simple: StartFit, rich: StartFit) -> float:
    """Return the drop of the Bayesian information criterion (Schwarz 1978) by a richer model; above 6 is strong.

    Independent samples count, as many as the richer model's residual leaves (Raftery 1995), and the prior of L.
    """
    gain = sum(
        n * math.log(max(before, 1e-300) / max(after, 1e-300))
        for n, before, after in zip(rich.independent, simple.misfit, rich.misfit, strict=True)
    )
    gain += simple.inductance_deviation**2 - rich.inductance_deviation**2
    added = len(rich.solution.theta) - len(simple.solution.theta)
    return gain - added * math.log(max(sum(rich.independent), 2.0))


@on_one_thread
def identify_best(
    start: Start,
    candidates: tuple[str, ...] = EXTENSIONS,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
) -> StartFit:
    """Fit the textbook, then add the term with the strongest evidence, while it is strong.

    Raises:
        UnusableError: the current flows against the voltage.
    """
    best = identify(start, constant=constant, typical=typical)
    start = best.start
    knows_inductance = any(name in (typical or {}) for name in ("L", "L/V"))
    every = start_prior(start, constant, typical).available_terms

    def extended(simple: StartFit) -> Iterator[StartFit]:
        if simple.start.is_coupled:  # no fault is named then
            return
        behind = behind_capacitor(simple, constant=constant, typical=typical)
        if behind is not None:
            yield behind
        names = [
            name
            for name in candidates
            if name not in simple.model
            and _is_applicable(name, start, simple.model, knows_inductance=knows_inductance)
        ]
        scored = [name for name in names if name not in _UNSCORED]
        if simple.inductance_deviation**2 <= _PROMISING:  # a score test, far cheaper than a fit
            scored = promising(simple.solution, every, scored, _PROMISING, SCORED_SIZES)
        for name in names:
            if name in scored or name in _UNSCORED:
                model = (*simple.model, name)
                yield identify(start, model, constant=constant, typical=typical, simpler=simple)

    return add_terms(best, extended, evidence)


def behind_capacitor(
    fit: StartFit,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
    can_be_slow: bool = False,
) -> StartFit | None:
    """Return the fit of a start whose drag vanishes behind the capacitor of a probe, where that explains it; else None.

    Over the time constant s, a capacitor lowers B/J by 1/s (the charge of a start is as its speed), and then every
    level decays.

    Args:
        fit: with a probe that is coupled directly.
        constant: see `identify`.
        typical: see `identify`.
        can_be_slow: whether the start need not tell s.
    """
    values, level_v = fit.physical, fit.start.level_v
    drag = values[index.B] / values[index.K] + values[index.COULOMB] / level_v
    if fit.start.is_coupled or drag * values[index.R] > _NO_DRAG * values[index.K]:
        return None
    start = replace(fit.start, is_coupled=True, sizes=(*fit.start.sizes, 0.0, 0.0))
    behind = identify(start, fit.model, constant=constant, typical=typical)
    is_one = can_be_slow or COUPLINGS_PER_S[0] < behind.start.sizes[-1] < COUPLINGS_PER_S[1]
    return behind if is_one and likelihood_gain(fit, behind) > _CERTAIN else None


def likelihood_gain(before: StartFit, after: StartFit) -> float:
    """Return the fall of -2 log likelihood between fits of as many unknowns; only independent samples count."""
    independent = min(1.0, sum(after.independent) / after.solution.problem.count)
    return independent * (before.solution.misfit - after.solution.misfit)


def _is_applicable(name: str, start: Start, model: tuple[str, ...], *, knows_inductance: bool) -> bool:
    """Return whether a recording can tell one more term.

    A measured voltage has no ramp. A step cannot separate a brush drop from a lower supply, nor a sensor's lag from L/R
    unless L is known. An amplifier that hides small currents hides negative ones, too.
    """
    step = start.voltage_v is None
    applies = {
        "supply_ramp": step,
        "supply_curve": "supply_ramp" in model,
        "brush_drop": not step,
        "sensor_lag": (not step or knows_inductance) and start.circuit.sensor_lag_s == 0.0,
        "speed_lag": start.speed_rad_s is not None,
        "dead_zone": step and start.from_rest and float(start.current_a.min()) >= 0.0,
    }
    return applies.get(name, True)
