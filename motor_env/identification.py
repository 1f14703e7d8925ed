"""A motor's parameters from one real start, by least squares, with honest standard errors.

The residual of a real motor is not white: the model is never complete. The covariance of the estimates is therefore
the sandwich (J'J)^-1 J' W J (J'J)^-1 with W the autocovariance of the residual (Bartlett window; Newey & West 1987),
never the textbook one from white noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import fftconvolve
from scipy.special import ndtr

from motor_env import quantities
from motor_env.alignment import Alignment, UnusableError, align, difference_noise, ripple
from motor_env.motion import Extension, driven, step_start
from motor_env.parameters import FloatArray, MotorParameters
from motor_env.recordings import Recording

TEXTBOOK: tuple[str, ...] = ()
EXTENSIONS = ("supply_ramp", "sensor_lag", "speed_lag", "coulomb", "brush_drop")
NUISANCES = ("supply_ramp", "sensor_lag", "speed_lag")
"""Extensions that do not touch the motor: what a diagnosis may add. Coulomb friction and viscous friction, and a brush
drop and the supply, can hardly be told apart in one start, and would take the friction out of the comparison."""
_CORE = ("R", "L", "K", "J", "B")
_LARGEST_LOG = 12.0
_FIT_SAMPLES = 40_000
_REST_SHARE = 0.05
_OFFSET_SD_WITHOUT_QUIET = (
    0.0002  # of the current's span: without a quiet part the sensor is believed to be nulled
)
_OFFSET_SD_WITH_QUIET = 0.05


@dataclass(frozen=True, slots=True)
class Start:
    """What is fitted: one start, turned so that its current is positive.

    Attributes:
        time_s: shape (n_samples,).
        current_a: shape (n_samples,).
        speed_rad_s: shape (n_samples,), or None.
        voltage_v: measured voltage, shape (n_samples,), or None for a step.
        level_v: level of the step; 1 where the voltage is unknown (everything is then per volt).
        voltage_known: whether volts are volts.
        alignment: onset and quiet part.
        from_rest: whether the motor stands before; else it runs steadily under the first voltage.
    """

    time_s: FloatArray
    current_a: FloatArray
    speed_rad_s: FloatArray | None
    voltage_v: FloatArray | None
    level_v: float
    voltage_known: bool
    alignment: Alignment
    from_rest: bool = True

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))


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
        expected: fitted current and speed, shape (n_samples, 2), offsets included.
        r2_current: share of the current's variance that the fit explains.
        r2_speed: the same for the speed, or None.
        noise_a: white noise of the current while the motor runs.
        independent: number of independent samples that the residual's autocorrelation leaves, each channel.
        misfit: mean squared residual over the channel's variance, each channel.
        lag_one: autocorrelation of the current's residual at one sample; 0 would be white.
        fitted_extension: value and standard error of each extension.
        unknowns: the vector that was fitted.
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

    @property
    def defects(self) -> tuple[str, ...]:
        """What is wrong with the recording, and what of the model it shows, in words."""
        found = list(self.start.alignment.defects)
        line = ripple(self.residual_a[self.start.alignment.onset_index :], self.start.dt_s)
        if line is not None:
            found.append(f"PWM ripple of {line[1]:.3g} A at {line[0]:.4g} Hz (or an alias of it)")
        if "supply_ramp" in self.fitted_extension:
            found.append(f"supply ramp: it rises in {1e3 * self.fitted_extension['supply_ramp'][0]:.3g} ms")
        found += [
            f"{name.replace('_', ' ')} of {1e3 * self.fitted_extension[name][0]:.3g} ms"
            for name in ("sensor_lag", "speed_lag")
            if name in self.fitted_extension
        ]
        return tuple(found)

    @property
    def residual_a(self) -> FloatArray:
        """Measured minus fitted current."""
        return self.start.current_a - self.expected[:, 0]

    @property
    def values(self) -> FloatArray:
        """The identifiable quantities, SI (over volt where the voltage is unknown)."""
        return np.exp(self.log_values)

    @property
    def standard_errors(self) -> FloatArray:
        """Their standard errors."""
        return np.exp(self.log_values) * np.sqrt(np.diag(self.log_covariance))


def prepare(recording: Recording, voltage_v: float | None = None) -> Start:
    """Align a recording and decide what is known of its supply.

    Args:
        recording: as read.
        voltage_v: level of the supply, given by the user or the data sheet, for a recording without a voltage.

    Raises:
        UnusableError: no start in it, or too few samples after it.
    """
    alignment = align(recording)
    sign, after = alignment.sign, len(recording.time_s) - alignment.onset_index
    if after < 15:
        raise UnusableError(f"only {after} samples follow the start; at least 15 are needed")
    measured, level, known = None, 1.0, False
    if recording.voltage_v is not None:
        level, measured, sign = _supply(recording.voltage_v, sign)
        known = True
    elif recording.duty is not None:
        scale = 1.0 if voltage_v is None else abs(voltage_v)
        level, measured, sign = _supply(scale * recording.duty, sign)
        known = voltage_v is not None
    elif voltage_v is not None:
        level, known = abs(voltage_v), True
    speed = None
    if recording.speed_rad_s is not None and np.ptp(recording.speed_rad_s) > 0.0:
        speed = recording.speed_rad_s * (1.0 if _mean_tail(recording.speed_rad_s) >= 0.0 else -1.0)
    from_rest = measured is None or abs(float(measured[0])) < _REST_SHARE * float(np.max(np.abs(measured)))
    alignment = replace(alignment, sign=sign, offset_a=sign * alignment.offset_a)
    if not from_rest:
        alignment = replace(alignment, offset_a=0.0, n_quiet=0)
    return Start(
        recording.time_s, sign * recording.current_a, speed, measured, level, known, alignment, from_rest
    )


def _mean_tail(values: FloatArray) -> float:
    return float(np.mean(values[-max(len(values) // 10, 1) :]))


def _supply(voltage: FloatArray, sign: float) -> tuple[float, FloatArray | None, float]:
    """Level of a commanded step, or the measured curve: a command takes at most two values."""
    levels = np.unique(voltage)
    tail = float(np.median(voltage[-max(len(voltage) // 4, 1) :]))
    if len(levels) == 1 or (len(levels) == 2 and 0.0 in levels):
        if tail == 0.0:
            raise UnusableError("the voltage is 0 at the end: this is no start under voltage")
        return abs(tail), None, sign
    return abs(tail), voltage, 1.0


def identify(
    start: Start,
    model: tuple[str, ...] = TEXTBOOK,
    *,
    constant: float | None = None,
    simpler: Identified | None = None,
) -> Identified:
    """Fit the model to a start.

    Args:
        start: what to fit.
        model: extensions of the textbook, of `EXTENSIONS`.
        constant: K to assume where the current alone is measured, for only K^2/J and B/J can then be told.
        simpler: a fit of the same start that lacks the last extension of the model, to begin from.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    problem = _Problem(_shorter(start, _FIT_SAMPLES), model, constant)
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
    if best is None or not np.isfinite(best.cost):
        raise UnusableError("no motor model can be fitted")
    problem.reweight(best.x)
    best = least_squares(problem.residuals, best.x, bounds=problem.bounds, x_scale="jac", max_nfev=100)
    return problem.result(best.x, np.asarray(best.jac), start)


def _shorter(start: Start, count: int) -> Start:
    end = start.alignment.onset_index + count
    if end >= len(start.time_s):
        return start
    return replace(
        start,
        time_s=start.time_s[:end],
        current_a=start.current_a[:end],
        speed_rad_s=None if start.speed_rad_s is None else start.speed_rad_s[:end],
        voltage_v=None if start.voltage_v is None else start.voltage_v[:end],
    )


class _Problem:
    """Residuals of one start as a function of the vector of unknowns."""

    def __init__(self, start: Start, model: tuple[str, ...], constant: float | None) -> None:
        self.start, self.model = start, model
        self.has_speed = start.speed_rad_s is not None
        self.free = tuple(name for name in _CORE if name != "K" or self.has_speed)
        self.measured = (
            start.current_a
            if start.speed_rad_s is None
            else np.concatenate([start.current_a, start.speed_rad_s])
        )
        self.span = float(np.ptp(start.current_a))
        self.scale = np.full(len(self.measured), 0.02 * self.span)
        if start.speed_rad_s is not None:
            self.scale[len(start.time_s) :] = 0.02 * float(np.ptp(start.speed_rad_s))
        self.base = self._rough(constant)
        lag = 2.0 * start.dt_s
        until_peak = int(np.argmax(start.current_a)) - start.alignment.onset_index
        self.base_extra = {
            "supply_ramp": max(0.5 * until_peak * start.dt_s, lag),
            "coulomb": 0.3 * self.base["B"] * start.level_v / self.base["K"],
            "brush_drop": 0.05 * start.level_v,
            "sensor_lag": lag,
            "speed_lag": lag,
        }
        self.offset_sd = self.span * (
            _OFFSET_SD_WITH_QUIET if start.alignment.n_quiet else _OFFSET_SD_WITHOUT_QUIET
        )

    def _rough(self, constant: float | None) -> dict[str, float]:
        """Parameters by eye: R from the peak, J from the decay, B from the final current."""
        start = self.start
        after = start.current_a[start.alignment.onset_index :] - start.alignment.offset_a
        peak_at = int(np.argmax(after))
        peak = float(after[peak_at])
        final = float(np.clip(_mean_tail(after), 0.002 * peak, 0.8 * peak))
        below = np.flatnonzero(after[peak_at:] < final + 0.37 * (peak - final))
        decay = max(float(below[0]) if len(below) else 0.3 * len(after), 1.0) * start.dt_s
        resistance = 0.9 * start.level_v / peak
        if start.speed_rad_s is not None:
            speed = max(abs(_mean_tail(start.speed_rad_s)), 1e-9)
            k = max(start.level_v - resistance * final, 0.1 * start.level_v) / speed
        else:
            k = constant if constant is not None else 0.01 * start.level_v
        inertia = decay * k * k / resistance
        friction = max(final * k * k / max(start.level_v - resistance * final, 0.1 * start.level_v), 1e-300)
        rise = max(peak_at, 1) * start.dt_s
        return {"R": resistance, "L": resistance * 0.3 * rise, "K": k, "J": inertia, "B": friction}

    @property
    def n_core(self) -> int:
        """Number of textbook parameters that are free."""
        return len(self.free)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of the unknowns."""
        start, n = self.start, self.n_core + len(self.model)
        room = max(5.0 * start.dt_s, 0.02 * (start.time_s[-1] - start.alignment.onset_s))
        first = start.time_s[0] - 2.0 * start.dt_s
        low = [-_LARGEST_LOG] * n + [
            max(start.alignment.onset_s - room, first),
            start.alignment.offset_a - 0.5 * self.span,
        ]
        high = [_LARGEST_LOG] * n + [
            start.alignment.onset_s + room,
            start.alignment.offset_a + 0.5 * self.span,
        ]
        if start.voltage_v is not None:
            low[n], high[n] = -1.0, 1.0
        return np.array(low), np.array(high)

    def guesses(self) -> list[FloatArray]:
        """One for each of three inductances: the best of a small grid about the rough parameters."""
        onset = self.start.alignment.onset_s if self.start.voltage_v is None else 0.0
        fits = []
        for inductance in (0.1, 1.0, 4.0):
            grid = []
            for inertia, ohm in product((0.5, 1.0, 2.0), (0.7, 1.0)):
                logs = {"R": ohm, "L": inductance, "K": 1.0, "J": inertia, "B": 1.0}
                core = [math.log(logs[name]) for name in self.free]
                grid.append(np.array([*core, *[0.0] * len(self.model), onset, self.start.alignment.offset_a]))
            fits.append(min(grid, key=lambda unknowns: float(np.sum(self.residuals(unknowns) ** 2))))
        return fits

    def richer(self, simpler: FloatArray) -> list[FloatArray]:
        """A simpler fit with a weak and a strong beginning of one more extension."""
        n = self.n_core + len(self.model) - 1
        return [np.insert(simpler, n, value) for value in (-2.0, 0.0)]

    def split(self, unknowns: FloatArray) -> tuple[MotorParameters, Extension, float, float]:
        """Parameters, extension, onset and offset of a vector of unknowns."""
        value = dict(self.base)
        for name, log in zip(self.free, unknowns, strict=False):
            value[name] = self.base[name] * math.exp(log)
        extra = {
            name: self.base_extra[name] * math.exp(log)
            for name, log in zip(self.model, unknowns[self.n_core :], strict=False)
        }
        parameters = MotorParameters(value["R"], value["L"], value["K"], value["K"], value["J"], value["B"])
        extension = Extension(
            extra.get("coulomb", 0.0),
            extra.get("brush_drop", 0.0),
            extra.get("supply_ramp", 0.0),
            extra.get("sensor_lag", 0.0),
            extra.get("speed_lag", 0.0),
        )
        return parameters, extension, float(unknowns[-2]), float(unknowns[-1])

    def expected(self, unknowns: FloatArray, start: Start) -> FloatArray:
        """Current and speed that the unknowns predict, offset included."""
        parameters, extension, onset, offset = self.split(unknowns)
        if start.voltage_v is None:
            states = step_start(parameters, extension, start.time_s, onset, start.level_v)
        else:
            states = driven(parameters, extension, start.voltage_v, start.dt_s, from_rest=start.from_rest)
        if start.alignment.rectified:
            states[:, 0] = _rectified_mean(states[:, 0], start.alignment.noise_a)
        else:
            states[:, 0] += offset
        return states

    def residuals(self, unknowns: FloatArray) -> FloatArray:
        """Weighted residuals of both channels, and of the offset's prior."""
        states = self.expected(unknowns, self.start)
        predicted = states.T.ravel() if self.has_speed else states[:, 0]
        prior = (unknowns[-1] - self.start.alignment.offset_a) / self.offset_sd
        out: FloatArray = np.append((self.measured - predicted) / self.scale, prior)
        return np.nan_to_num(out, nan=1e6, posinf=1e6, neginf=-1e6)

    def reweight(self, unknowns: FloatArray) -> None:
        """Weigh each channel by what the fit leaves of it."""
        n = len(self.start.time_s)
        left = self.residuals(unknowns)[:-1] * self.scale
        for begin in range(0, len(left), n):
            self.scale[begin : begin + n] = max(float(np.std(left[begin : begin + n])), 1e-9 * self.span)

    def result(self, unknowns: FloatArray, jacobian: FloatArray, start: Start) -> Identified:
        """Put the fit into words and numbers."""
        parameters, extension, onset, offset = self.split(unknowns)
        residuals = self.residuals(unknowns)
        covariance, independent = _sandwich(jacobian, residuals, len(self.start.time_s))
        which = {"has_voltage": start.voltage_known, "has_speed": self.has_speed}
        exponents = quantities.matrix(**which)
        columns = [quantities.PARAMETERS.index(name) for name in self.free]
        core = exponents[:, columns]
        names = quantities.names(**which)
        extras = {
            name: (
                self.base_extra[name] * math.exp(unknowns[self.n_core + k]),
                self.base_extra[name]
                * math.exp(unknowns[self.n_core + k])
                * math.sqrt(max(covariance[self.n_core + k, self.n_core + k], 0.0)),
            )
            for k, name in enumerate(self.model)
        }
        expected = self.expected(unknowns, start)
        left = start.current_a - expected[:, 0]
        centred = left - left.mean()
        r2_current = _r2(start.current_a, left)
        r2_speed = None
        if start.speed_rad_s is not None:
            r2_speed = _r2(start.speed_rad_s, start.speed_rad_s - expected[:, 1])
        return Identified(
            start=start,
            model=self.model,
            parameters=parameters,
            extension=extension,
            onset_s=onset,
            offset_a=offset,
            quantity_names=names,
            log_values=exponents @ quantities.logarithms(parameters, start.level_v),
            log_covariance=core @ covariance[: self.n_core, : self.n_core] @ core.T,
            expected=expected,
            r2_current=r2_current,
            r2_speed=r2_speed,
            noise_a=difference_noise(left[start.alignment.onset_index :]),
            independent=independent,
            misfit=tuple(1.0 - r2 for r2 in (r2_current, r2_speed) if r2 is not None),
            lag_one=float(np.sum(centred[1:] * centred[:-1]) / max(np.sum(centred**2), 1e-300)),
            fitted_extension=extras,
            unknowns=unknowns,
        )


def _rectified_mean(current: FloatArray, noise_a: float) -> FloatArray:
    """Mean of max(i + noise, 0): what a sensor shows that cannot go below 0."""
    if noise_a <= 0.0:
        return np.maximum(current, 0.0)
    z = np.clip(current / noise_a, -40.0, 40.0)
    mean: FloatArray = current * ndtr(z) + noise_a * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return mean


def _r2(measured: FloatArray, left: FloatArray) -> float:
    return 1.0 - float(np.sum(left**2) / max(np.sum((measured - measured.mean()) ** 2), 1e-300))


def _sandwich(jacobian: FloatArray, residuals: FloatArray, n: int) -> tuple[FloatArray, tuple[float, ...]]:
    """Covariance of the unknowns under autocorrelated residuals, and the number of independent samples.

    Each channel's residual is taken as a stationary series with the autocovariance that it shows up to a tenth of
    the recording.
    """
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150)
    jacobian = jacobian / size
    bread = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12)
    meat = np.outer(jacobian[-1], jacobian[-1])  # the offset's prior
    independent = []
    for begin in range(0, len(residuals) - 1, n):
        series = residuals[begin : begin + n] - residuals[begin : begin + n].mean()
        lags = max(n // 10, 2)
        full = fftconvolve(series, series[::-1])[n - 1 : n - 1 + lags] / n
        taper = full * (1.0 - np.arange(lags) / lags)
        kernel = np.concatenate([taper[:0:-1], taper])
        part = jacobian[begin : begin + n]
        meat = meat + part.T @ fftconvolve(part, kernel[:, None], mode="same", axes=0)
        inflation = max(float(np.sum(kernel)) / max(float(taper[0]), 1e-300), 1.0)
        independent.append(n / inflation)
    return bread @ meat @ bread / np.outer(size, size), tuple(independent)


def evidence(simple: Identified, rich: Identified) -> float:
    """How much the richer model is preferred: the drop of the Bayesian information criterion (Schwarz 1978).

    The samples are counted as independent ones, as many as the richer model's residual leaves; above 6 is strong
    (Raftery 1995).
    """
    gain = sum(
        n * math.log(max(before, 1e-300) / max(after, 1e-300))
        for n, before, after in zip(rich.independent, simple.misfit, rich.misfit, strict=True)
    )
    return gain - (len(rich.model) - len(simple.model)) * math.log(max(sum(rich.independent), 2.0))


STRONG_EVIDENCE = 6.0


def identify_best(
    start: Start, candidates: tuple[str, ...] = EXTENSIONS, *, constant: float | None = None
) -> Identified:
    """Fit the textbook, and add the extension for which the evidence is strongest, as long as it is strong.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    best = identify(start, constant=constant)
    left = [name for name in candidates if _applies(name, start)]
    while left:
        trials = [identify(start, (*best.model, name), constant=constant, simpler=best) for name in left]
        gains = [evidence(best, trial) for trial in trials]
        top = int(np.argmax(gains))
        if gains[top] < STRONG_EVIDENCE:
            break
        best = trials[top]
        left.remove(left[top])
    return best


def _applies(name: str, start: Start) -> bool:
    """Whether a recording can tell an extension.

    A measured voltage has no ramp to find. A step cannot tell a brush drop from a lower supply, nor the lag of the
    current's sensor from a supply that rises slowly: both are the same cascade of linear systems.
    """
    match name:
        case "supply_ramp":
            return start.voltage_v is None
        case "brush_drop" | "sensor_lag":
            return start.voltage_v is not None
        case "speed_lag":
            return start.speed_rad_s is not None
        case _:
            return True
