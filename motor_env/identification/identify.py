"""A motor's parameters from one real start, by least squares, with the extensions for which there is evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from motor_env.identification.covariance import capped, unknowns_covariance
from motor_env.identification.residuals import Problem
from motor_env.identification.start_model import Extension
from motor_env.motor import identifiable as quantities
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.recordings.defects import Defect, DefectKind, UnusableError
from motor_env.recordings.noise import difference_noise
from motor_env.recordings.periodic_lines import line_share, over_angle, periodic_lines
from motor_env.recordings.start import Start

TEXTBOOK: tuple[str, ...] = ()
NUISANCES = ("supply_ramp", "supply_curve", "sensor_lag", "speed_lag", "dead_zone")
"""Extensions that do not touch the motor: what a diagnosis may add. Coulomb friction and viscous friction, and a brush
drop and the supply, can hardly be told apart in one start, and would take the friction out of the comparison."""
EXTENSIONS = (*NUISANCES, "coulomb", "brush_drop")
"""All of them: what is tried where nothing is compared."""
STRONG_EVIDENCE = 6.0
_FIT_SAMPLES = 40_000
_UNTOLD_LOG_SD = 1.0
_WILD_SPREADS = 10.0
_PROMISING = 6.0  # of a chi-square with one degree; strong evidence takes 12 and more


@dataclass(frozen=True, slots=True)
class Identified:
    """A fitted start.

    Attributes:
        start: what was fitted.
        model: extensions used.
        parameters: textbook parameters; absolute ones only as far as `quantities` says.
        extension: what was added to the textbook.
        onset_s: fitted onset.
        offset_a: fitted offset of the current.
        quantity_names: what this recording can tell.
        log_values: logarithms of these quantities, shape (n,).
        log_covariance: their covariance, shape (n, n).
        expected: fitted current and speed, shape (n_samples, 2), offset and periodic ripple included.
        r2_current: share of the current's variance that the fit explains.
        r2_speed: the same for the speed, or None.
        noise_a: white noise of the current while the motor runs.
        independent: number of independent samples that the residual's autocorrelation leaves, each channel.
        misfit: mean squared residual over the channel's variance, each channel.
        lag_one: autocorrelation of the current's residual at one sample; 0 would be white.
        fitted_extension: value and standard error of each extension; of a supply curve the middle of the rise.
        unknowns: the vector that was fitted.
        inductance_off: how far L lies from the typical one, in standard deviations of 30 %; 0 where none is known.
    """

    start: Start
    model: tuple[str, ...]
    parameters: MotorParameters
    extension: Extension
    onset_s: float
    offset_a: float
    quantity_names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    expected: FloatArray
    r2_current: float
    r2_speed: float | None
    noise_a: float
    independent: tuple[float, ...]
    misfit: tuple[float, ...]
    lag_one: float
    fitted_extension: dict[str, tuple[float, float]]
    unknowns: FloatArray
    inductance_off: float = 0.0

    @property
    def defects(self) -> tuple[Defect, ...]:
        """What is wrong with the recording, and what of the model it shows."""
        start, size = self.start, {name: value for name, (value, _) in self.fitted_extension.items()}
        found = list(start.alignment.defects)
        for k in start.alignment.wild:
            where = f"{start.alignment.sign * start.current_a[k]:.3g} A at {start.time_s[k]:.6g} s"
            found.append(Defect(DefectKind.WILD_SAMPLE, f"a wild sample of {where}, left out"))
        for line in start.lines:
            where = f"{line.amplitude_a:.3g} A at {line.frequency_hz:.4g} Hz"
            found.append(Defect(DefectKind.PWM_RIPPLE, f"PWM ripple of {where} (or an alias of it)"))
        if "supply_ramp" in size:
            text = f"supply ramp: it rises in {1e3 * size['supply_ramp']:.3g} ms"
            curve = ", in a curve" if "supply_curve" in self.model else ""
            found.append(Defect(DefectKind.SUPPLY_RAMP, text + curve))
        found += [
            Defect(kind, f"{kind.replace('_', ' ')} of {1e3 * size[kind]:.3g} ms")
            for kind in (DefectKind.SENSOR_LAG, DefectKind.SPEED_LAG)
            if kind in size
        ]
        if "dead_zone" in size:
            text = f"dead zone: the sensor hides currents below {size['dead_zone']:.3g} A"
            found.append(Defect(DefectKind.DEAD_ZONE, text))
        return tuple(found)

    @property
    def residual_a(self) -> FloatArray:
        """Measured minus fitted current; 0 at wild samples."""
        return np.where(self.start.counted, self.start.current_a - self.expected[:, 0], 0.0)

    @property
    def states(self) -> FloatArray:
        """Fitted current and speed without offset and ripple, shape (n_samples, 2)."""
        out = self.expected.copy()
        out[:, 0] -= self.start.ripple_a + (0.0 if self.start.alignment.rectified else self.offset_a)
        return out

    @property
    def exponents(self) -> FloatArray:
        """Exponents of (R, L, K, J, B, V) in each quantity, shape (n, 6)."""
        start = self.start
        return quantities.matrix(has_voltage=start.voltage_known, has_speed=start.speed_rad_s is not None)

    @property
    def values(self) -> FloatArray:
        """The identifiable quantities, SI (over volt where the voltage is unknown)."""
        return np.exp(self.log_values)

    @property
    def standard_errors(self) -> FloatArray:
        """Their standard errors."""
        return np.exp(self.log_values) * np.sqrt(np.diag(self.log_covariance))


def identify(
    start: Start,
    model: tuple[str, ...] = TEXTBOOK,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
    simpler: Identified | None = None,
) -> Identified:
    """Fit the model to a start.

    Where the residual shows lines of constant frequency, or single wild samples, they are taken off, and the fit is
    repeated.

    Args:
        start: what to fit.
        model: extensions of the textbook, of `EXTENSIONS`.
        constant: K to assume where the current alone is measured, for only K^2/J and B/J can then be told.
        typical: quantities of such a motor, by name; see `Problem`.
        simpler: a fit of the same start that lacks the last extension of the model, to begin from.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    problem = Problem(start.shortened(_FIT_SAMPLES), model, constant, typical)
    best = None
    for guess in problem.guesses() if simpler is None else problem.richer(simpler.unknowns):
        found = least_squares(
            problem.residuals,
            np.clip(guess, *problem.bounds),
            bounds=problem.bounds,
            x_scale="jac",
            max_nfev=60,
        )
        if best is None or found.cost < best.cost:
            best = found
        if simpler is None and problem.is_typical(best.x):
            break
    if best is None or not np.isfinite(best.cost):
        raise UnusableError("no motor model can be fitted")
    problem.reweight(best.x)
    best = least_squares(problem.residuals, best.x, bounds=problem.bounds, x_scale="jac", max_nfev=100)
    fit = _result(problem, best.x, np.asarray(best.jac), start)
    cleaner = _cleaner(fit)
    if cleaner is None:
        return fit
    return identify(cleaner, model, constant=constant, typical=typical, simpler=simpler)


def _cleaner(fit: Identified) -> Start | None:
    """The start without what the residual shows to be no part of it, lines and wild samples; None if all is well."""
    start, residual = fit.start, fit.residual_a
    wild = sorted({*start.alignment.wild, *_wild_against(residual, start.current_a)})
    if len(wild) > max(len(residual) // 1000, 1):
        wild = list(start.alignment.wild)
    begin = start.alignment.onset_index
    lines = start.lines or periodic_lines(residual[begin:], start.time_s[begin:])
    if lines and not start.lines and _turns_with_the_motor(fit, begin):
        lines = ()
    if lines == start.lines and len(wild) == len(start.alignment.wild):
        return None
    return replace(start, lines=lines, alignment=replace(start.alignment, wild=tuple(wild)))


def _turns_with_the_motor(fit: Identified, begin: int) -> bool:
    """Whether the strongest line is sharper over the angle than over time: the commutator's, not a converter's."""
    residual, time_s = fit.residual_a[begin:], fit.start.time_s[begin:]
    turning = over_angle(residual, time_s, fit.states[begin:, 1])
    return turning is not None and line_share(turning[1], turning[0]) > line_share(residual, time_s)


def _wild_against(residual: FloatArray, current: FloatArray) -> list[int]:
    """Samples far off a fit that goes well through both neighbours, and off both neighbours to the same side."""
    off = np.abs(residual[1:-1])
    spread = 1.4826 * float(np.median(np.abs(residual)))
    beside = np.maximum(np.abs(residual[:-2]), np.abs(residual[2:]))
    left, right = current[1:-1] - current[:-2], current[1:-1] - current[2:]
    jumps = (left * right > 0.0) & (np.minimum(np.abs(left), np.abs(right)) > 0.5 * off)
    wild = (off > _WILD_SPREADS * spread) & (beside < 0.3 * off) & jumps
    return [int(k) + 1 for k in np.flatnonzero(wild)]


def _result(problem: Problem, unknowns: FloatArray, jacobian: FloatArray, start: Start) -> Identified:
    """Put the fit into words and numbers."""
    parameters, extension, onset, offset = problem.split(unknowns)
    n_core = problem.n_core
    covariance, independent = unknowns_covariance(problem, unknowns, jacobian)
    if problem.has_inductance_prior:
        # What looks like L may be the ramp or the lag, and the other way round: L tells nothing then.
        place = problem.free.index("L")
        covariance[place, place] += _UNTOLD_LOG_SD**2
    which = {"has_voltage": start.voltage_known, "has_speed": problem.has_speed}
    exponents = quantities.matrix(**which)
    core = exponents[:, [quantities.PARAMETERS.index(name) for name in problem.free]]
    fitted = {
        name: problem.base_extra[name] * math.exp(unknowns[n_core + k])
        for k, name in enumerate(problem.extras)
    }
    extras = {
        name: (value, value * math.sqrt(max(covariance[n_core + k, n_core + k], 0.0)))
        for k, (name, value) in enumerate(fitted.items())
        if name in problem.model
    }
    if "supply_curve" in problem.model:
        extras["supply_curve"] = _middle_of_rise(problem, extension, covariance)
    expected = problem.expected(unknowns, start)
    expected[:, 0] += start.ripple_a
    left = np.where(start.counted, start.current_a - expected[:, 0], 0.0)
    r2_current = _r2(start.current_a[start.counted], left[start.counted])
    r2_speed = None
    if start.speed_rad_s is not None:
        r2_speed = _r2(start.speed_rad_s, start.speed_rad_s - expected[:, 1])
    centred = left - left.mean()
    return Identified(
        start=start,
        model=problem.model,
        parameters=parameters,
        extension=extension,
        onset_s=onset,
        offset_a=offset,
        quantity_names=quantities.names(**which),
        log_values=exponents @ quantities.logarithms(parameters, start.level_v),
        log_covariance=capped(core @ covariance[:n_core, :n_core] @ core.T),
        expected=expected,
        r2_current=r2_current,
        r2_speed=r2_speed,
        noise_a=difference_noise(left[start.alignment.onset_index :]),
        independent=independent,
        misfit=tuple(1.0 - r2 for r2 in (r2_current, r2_speed) if r2 is not None),
        lag_one=float(np.sum(centred[1:] * centred[:-1]) / max(np.sum(centred**2), 1e-300)),
        fitted_extension=extras,
        unknowns=unknowns,
        inductance_off=problem.inductance_off(unknowns),
    )


def _middle_of_rise(problem: Problem, extension: Extension, covariance: FloatArray) -> tuple[float, float]:
    """Where the middle of the supply's rise lies, as a share of its time, with its standard error; 0.5 is even."""
    shares = np.array(extension.supply_shares)
    places = (np.arange(len(shares)) + 0.5) / len(shares)
    middle = float(shares @ places)
    slopes = (shares * (places - middle))[1:]
    first = problem.n_core + problem.extras.index("curve_1")
    some = slice(first, first + len(slopes))
    return middle, math.sqrt(max(float(slopes @ covariance[some, some] @ slopes), 0.0))


def _r2(measured: FloatArray, left: FloatArray) -> float:
    return 1.0 - float(np.sum(left**2) / max(np.sum((measured - measured.mean()) ** 2), 1e-300))


def evidence(simple: Identified, rich: Identified) -> float:
    """How much the richer model is preferred: the drop of the Bayesian information criterion (Schwarz 1978).

    The samples are counted as independent ones, as many as the richer model's residual leaves; above 6 is strong
    (Raftery 1995). Where a typical L is known, its prior counts: a lag of the sensor is more likely than an L that is
    three times as large.
    """
    gain = sum(
        n * math.log(max(before, 1e-300) / max(after, 1e-300))
        for n, before, after in zip(rich.independent, simple.misfit, rich.misfit, strict=True)
    )
    gain += simple.inductance_off**2 - rich.inductance_off**2
    return gain - (len(rich.unknowns) - len(simple.unknowns)) * math.log(max(sum(rich.independent), 2.0))


def identify_best(
    start: Start,
    candidates: tuple[str, ...] = EXTENSIONS,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
) -> Identified:
    """Fit the textbook, and add the extension for which the evidence is strongest, as long as it is strong.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    best = identify(start, constant=constant, typical=typical)
    start = best.start
    knows_inductance = any(name in (typical or {}) for name in ("L", "L/V"))
    while True:
        left = [
            name
            for name in candidates
            if name not in best.model
            and _applies(name, start, best.model, knows_inductance=knows_inductance)
            and _is_worth_trying(best, name, constant, typical)
        ]
        if not left:
            return best
        trials = [
            identify(start, (*best.model, name), constant=constant, typical=typical, simpler=best)
            for name in left
        ]
        gains = [evidence(best, trial) for trial in trials]
        top = int(np.argmax(gains))
        if gains[top] < STRONG_EVIDENCE:
            return best
        best = trials[top]


def _is_worth_trying(
    best: Identified, name: str, constant: float | None, typical: Mapping[str, float] | None
) -> bool:
    """Whether an extension may earn strong evidence: a score test, far cheaper than its fit, with room to spare."""
    if name in {"supply_curve", "dead_zone"} or best.inductance_off**2 > _PROMISING:
        return True
    problem = Problem(best.start.shortened(_FIT_SAMPLES), (*best.model, name), constant, typical)
    return problem.score(best.unknowns) > _PROMISING


def _applies(name: str, start: Start, model: tuple[str, ...], *, knows_inductance: bool) -> bool:
    """Whether a recording can tell one more extension.

    A measured voltage has no ramp to find. A step cannot tell a brush drop from a lower supply. The lag of the
    current's sensor is told from L/R only by a motor file that knows L: both are lags of one cascade. An
    amplifier that hides small currents hides negative ones too.
    """
    step = start.voltage_v is None
    told = {
        "supply_ramp": step,
        "supply_curve": "supply_ramp" in model,
        "brush_drop": not step,
        "sensor_lag": (not step or knows_inductance) and start.circuit.sensor_lag_s == 0.0,
        "speed_lag": start.speed_rad_s is not None,
        "dead_zone": step and start.from_rest and float(start.current_a.min()) >= 0.0,
    }
    return told.get(name, True)
