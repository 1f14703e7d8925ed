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
FIT_SAMPLES = 40_000
_UNTOLD_LOG_SD = 1.0
_WILD_SPREADS = 10.0


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
        independent: number of independent samples that the residual's autocorrelation leaves, each channel.
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
    independent: tuple[float, ...]
    fitted_extension: dict[str, tuple[float, float]]
    unknowns: FloatArray
    inductance_off: float = 0.0

    @property
    def defects(self) -> tuple[Defect, ...]:
        """What is wrong with the recording, and what of the model it shows."""
        start, size = self.start, {name: value for name, (value, _) in self.fitted_extension.items()}
        defects = list(start.alignment.defects)
        for k in start.alignment.wild:
            where = f"{start.alignment.sign * start.current_a[k]:.3g} A at {start.time_s[k]:.6g} s"
            defects.append(Defect(DefectKind.WILD_SAMPLE, f"a wild sample of {where}, left out"))
        for line in start.lines:
            where = f"{line.amplitude_a:.3g} A at {line.frequency_hz:.4g} Hz"
            defects.append(Defect(DefectKind.PWM_RIPPLE, f"PWM ripple of {where} (or an alias of it)"))
        if "supply_ramp" in size:
            text = f"supply ramp: it rises in {1e3 * size['supply_ramp']:.3g} ms"
            curve = ", in a curve" if "supply_curve" in self.model else ""
            defects.append(Defect(DefectKind.SUPPLY_RAMP, text + curve))
        defects += [
            Defect(kind, f"{kind.replace('_', ' ')} of {1e3 * size[kind]:.3g} ms")
            for kind in (DefectKind.SENSOR_LAG, DefectKind.SPEED_LAG)
            if kind in size
        ]
        if "dead_zone" in size:
            text = f"dead zone: the sensor hides currents below {size['dead_zone']:.3g} A"
            defects.append(Defect(DefectKind.DEAD_ZONE, text))
        return tuple(defects)

    @property
    def residual_a(self) -> FloatArray:
        """Measured minus fitted current; 0 at wild samples."""
        return np.where(self.start.counted, self.start.current_a - self.expected[:, 0], 0.0)

    @property
    def r2_current(self) -> float:
        """Share of the current's variance that the fit explains."""
        counted = self.start.counted
        return _r2(self.start.current_a[counted], self.residual_a[counted])

    @property
    def r2_speed(self) -> float | None:
        """The same for the speed; None where it was not recorded."""
        speed = self.start.speed_rad_s
        return None if speed is None else _r2(speed, speed - self.expected[:, 1])

    @property
    def misfit(self) -> tuple[float, ...]:
        """Mean squared residual over the channel's variance, each channel."""
        return tuple(1.0 - r2 for r2 in (self.r2_current, self.r2_speed) if r2 is not None)

    @property
    def noise_a(self) -> float:
        """White noise of the current while the motor runs."""
        return difference_noise(self.residual_a[self.start.alignment.onset_index :])

    @property
    def lag_one(self) -> float:
        """Autocorrelation of the current's residual at one sample; 0 would be white."""
        centred = self.residual_a - self.residual_a.mean()
        return float(np.sum(centred[1:] * centred[:-1]) / max(np.sum(centred**2), 1e-300))

    @property
    def states(self) -> FloatArray:
        """Fitted current and speed without offset and ripple, shape (n_samples, 2)."""
        out = self.expected.copy()
        out[:, 0] -= self.start.ripple_a + (0.0 if self.start.alignment.rectified else self.offset_a)
        return out

    @property
    def white_covariance(self) -> FloatArray:
        """Covariance of the logarithms from white noise alone: what differs between starts of one motor."""
        left = float(np.var(self.residual_a[self.start.alignment.onset_index :]))
        return self.log_covariance * min(self.noise_a**2 / max(left, 1e-300), 1.0)

    @property
    def exponents(self) -> FloatArray:
        """Exponents of (R, L, K, J, B, V) in each quantity, shape (n, 6)."""
        return quantities.matrix(self.quantity_names)

    @property
    def values(self) -> FloatArray:
        """The identifiable quantities, SI (over volt where the voltage is unknown)."""
        return np.exp(self.log_values)

    @property
    def standard_errors(self) -> FloatArray:
        """Their standard errors."""
        return self.values * np.sqrt(np.diag(self.log_covariance))

    @property
    def correlation(self) -> FloatArray:
        """Correlations of the logarithms, shape (n, n)."""
        sigma = np.sqrt(np.diag(self.log_covariance))
        out: FloatArray = self.log_covariance / np.outer(sigma, sigma)
        return out


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
        model: extensions of the textbook, of `model_choice.EXTENSIONS`.
        constant: K to assume where the current alone is measured, for only K^2/J and B/J can then be told.
        typical: quantities of such a motor, by name; see `Problem`.
        simpler: a fit of the same start that lacks the last extension of the model, to begin from.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    problem = Problem(start.shortened(FIT_SAMPLES), model, constant=constant, typical=typical)
    best = None
    for guess in problem.guesses() if simpler is None else problem.richer(simpler.unknowns):
        optimum = least_squares(
            problem.residuals,
            np.clip(guess, *problem.bounds),
            bounds=problem.bounds,
            x_scale="jac",
            max_nfev=60,
        )
        if best is None or optimum.cost < best.cost:
            best = optimum
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
    names = quantities.names(has_voltage=start.voltage_known, has_speed=problem.has_speed)
    exponents = quantities.matrix(names)
    core = exponents[:, [quantities.PARAMETERS.index(name) for name in problem.free]]
    extras = {}
    for k, name in enumerate(problem.extras, n_core):
        value = problem.base_extra[name] * math.exp(unknowns[k])
        if name in problem.model:
            extras[name] = (value, value * math.sqrt(max(covariance[k, k], 0.0)))
    if "supply_curve" in problem.model:
        extras["supply_curve"] = _middle_of_rise(problem, extension, covariance)
    expected = problem.expected(unknowns, start)
    expected[:, 0] += start.ripple_a
    return Identified(
        start=start,
        model=problem.model,
        parameters=parameters,
        extension=extension,
        onset_s=onset,
        offset_a=offset,
        quantity_names=names,
        log_values=exponents @ quantities.logarithms(parameters, start.level_v),
        log_covariance=capped(core @ covariance[:n_core, :n_core] @ core.T),
        expected=expected,
        independent=independent,
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
