"""A fitted start: its quantities, its commutation ripple, and whether it looks like a motor's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import orth

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.ekf import REST, STEADY
from motor_env.diagnosis.estimation.operation_fit import OperationFit
from motor_env.diagnosis.estimation.problem import Solution, r_squared
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.readers.noise import difference_noise, floor_noise, over_angle
from motor_env.diagnosis.readers.start import Start, mean_tail
from motor_env.motor import identifiable
from motor_env.motor.parameters import FloatArray, MotorParameters

_USUAL = {
    "R": (5e-3, 1e3, "ohm"),
    "L": (1e-7, 1.0, "H"),
    "K": (1e-4, 20.0, "V s/rad"),
    "L/R": (2e-6, 0.2, "s"),
    "R J/K^2": (5e-4, 30.0, "s"),
    "current": (1e-3, 5e3, "A"),
    "sampling rate": (20.0, 5e7, "Hz"),
}
"""Least and largest value (of the current: its peak) of brushed DC motors, with a margin."""
POOR_FIT = 0.75  # R2 of a start that no motor explains
_TOLD = 0.3  # standard error of a logarithm, above which a quantity is not told
UNTOLD_LOG_SD = 1.0
_RUN_UP, _STANDING = 2.0, 0.8  # time constants, after which a current has fallen to 14 %; share of its peak
NOT_TURNING = (
    "the current does not show that a motor turns: the recording ends too early, the rotor is blocked, or this is no"
    " motor (a resistor, a coil)"
)
_FEWEST_SAMPLES = 256
_FEWEST_PERIODS = 15.0
_PADDING = 4
_BACKGROUND_BINS = 401
_STRONG = 200.0  # times the background's power; the largest of 10,000 bins of white noise reaches about 14


@dataclass(frozen=True, slots=True)
class StartFit:
    """A fitted start.

    Attributes:
        start: what was fitted.
        model: terms beside the textbook's.
        solution: the fit.
        quantity_names: what this recording can tell.
        log_values: logarithms of these quantities, shape (n,).
        log_covariance: their covariance, shape (n, n).
        series_covariance: the same without what the model's error adds, shape (n, n).
        expected: fitted current and speed, shape (n_samples, 2), offset and periodic ripple included.
        independent: number of independent samples under the residual's autocorrelation, each channel.
        fitted_extension: value and standard error of each extension; of a supply curve the middle of the rise.
        inductance_off: distance of L from the typical one, in standard deviations of 30 %; 0 where none is known.
    """

    start: Start
    model: tuple[str, ...]
    solution: Solution
    quantity_names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    series_covariance: FloatArray
    expected: FloatArray
    independent: tuple[float, ...]
    fitted_extension: dict[str, tuple[float, float]]
    inductance_deviation: float = 0.0

    @property
    def physical(self) -> FloatArray:
        """Physical values, see `motor_env.diagnosis.estimation.parameter_index`."""
        return self.solution.problem.values(self.solution.theta)

    @property
    def parameters(self) -> MotorParameters:
        """Textbook parameters; absolute ones only as far as `identifiable` says."""
        r, inductance, k, j, b = self.physical[[index.R, index.L, index.K, index.J, index.B]].tolist()
        return MotorParameters(r, inductance, k, k, j, b)

    @property
    def onset_s(self) -> float:
        """Fitted onset."""
        late = self.physical[index.ONSET] + self.physical[index.DELAY] * self.start.dt_s
        return float(self.start.alignment.onset_s + late)

    @property
    def offset_a(self) -> float:
        """Fitted offset of the current."""
        return float(self.start.alignment.offset_a + self.physical[index.OFFSET_I])

    def run(self, values: FloatArray) -> FloatArray:
        """Return current and speed of a motor of other values in this start, as shown, shape (n_samples, 2)."""
        return record_of(self.start).predict(values, learn=False)[0][:, 2:4]

    @property
    def defects(self) -> tuple[str, ...]:
        """Defects of the recording, and effects beside the motor that the model shows, in words."""
        start, size = self.start, {name: value for name, (value, _) in self.fitted_extension.items()}
        defects = list(start.alignment.defects)
        for k in start.alignment.wild:
            where = f"{start.alignment.sign * start.current_a[k]:.3g} A at {start.time_s[k]:.6g} s"
            defects.append(f"an outlier of {where}, left out")
        for line in start.lines:
            where = f"{line.amplitude_a:.3g} A at {line.frequency_hz:.4g} Hz"
            defects.append(f"PWM ripple of {where} (or an alias of it)")
        for hertz, pair in zip(
            start.hum_hz, np.reshape(start.sizes[: 2 * len(start.hum_hz)], (-1, 2)), strict=True
        ):
            whose = "supply" if start.is_hum_of_supply else "probe"
            where = f"{math.hypot(*pair):.3g} A at {hertz:.4g} Hz"
            defects.append(f"hum of the mains in the {whose}'s current of {where}, fitted beside the motor")
        if "supply_ramp" in size:
            curve = ", in a curve" if "supply_curve" in self.model else ""
            defects.append(f"supply ramp: it rises in {1e3 * size['supply_ramp']:.3g} ms{curve}")
        defects += [
            f"{name.replace('_', ' ')} of {1e3 * size[name]:.3g} ms"
            for name in ("sensor_lag", "speed_lag")
            if name in size
        ]
        if "dead_zone" in size:
            defects.append(f"dead zone: the sensor hides currents below {size['dead_zone']:.3g} A")
        return tuple(defects)

    @property
    def residual_a(self) -> FloatArray:
        """Measured minus fitted current; 0 at samples that do not count."""
        return np.where(self.start.counted, self.start.current_a - self.expected[:, 0], 0.0)

    @property
    def r2_current(self) -> float:
        """Share of the current's variance, without the supply's ripple, that the fit explains."""
        counted = self.start.counted
        return r_squared((self.start.current_a - self.start.ripple_a)[counted], self.residual_a[counted])

    @property
    def r2_speed(self) -> float | None:
        """Share of the speed's variance that the fit explains; None where it was not recorded."""
        speed = self.start.speed_rad_s
        return None if speed is None else r_squared(speed, speed - self.expected[:, 1])

    @property
    def misfit(self) -> tuple[float, ...]:
        """Mean squared residual over the channel's variance, each channel."""
        return tuple(1.0 - r2 for r2 in (self.r2_current, self.r2_speed) if r2 is not None)

    @property
    def noise_a(self) -> float:
        """White noise of the current while the motor runs, beside any ripple."""
        return floor_noise(self.residual_a[self.start.alignment.onset_index :])

    @property
    def lag_one(self) -> float:
        """Autocorrelation of the current's residual at one sample; 0 for white noise."""
        centred = self.residual_a - self.residual_a.mean()
        return float(np.sum(centred[1:] * centred[:-1]) / max(np.sum(centred**2), 1e-300))

    @property
    def states(self) -> FloatArray:
        """Fitted current and speed without offset and ripple, shape (n_samples, 2)."""
        out = self.expected.copy()
        out[:, 0] -= self.start.ripple_a + self.offset_a
        return out

    @property
    def is_hidden(self) -> bool:
        """Whether the sensor hides small currents, so that its readings are not linear in the state."""
        return self.start.alignment.rectified or "dead_zone" in self.model

    @property
    def whitened(self) -> FloatArray:
        """Residual of the running motor over the sensor's noise, shape (n, 1); NaN where the sensor shows nothing.

        These are the innovations of the start's Kalman filter, as nothing disturbs its model.
        """
        is_step = self.start.voltage_v is None
        begin = int(np.searchsorted(self.start.time_s, self.onset_s, side="right")) + 1 if is_step else 1
        shown = self.start.counted & (self.states[:, 0] >= 0.5 * self.physical[index.ZONE])
        noise = max(self.noise_a, 1e-9 * float(np.ptp(self.start.current_a)))
        return np.where(shown, self.residual_a / noise, np.nan)[begin:, None]

    @property
    def white_covariance(self) -> FloatArray:
        """Covariance of the logarithms from white noise alone: what differs between starts of one motor."""
        running = self.residual_a[self.start.alignment.onset_index :]
        return self.series_covariance * min(
            difference_noise(running) ** 2 / max(float(np.var(running)), 1e-300), 1.0
        )

    @property
    def exponents(self) -> FloatArray:
        """Exponents of (R, L, K, J, B, V) in each quantity, shape (n, 6)."""
        return identifiable.matrix(self.quantity_names)

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


def record_of(start: Start) -> Record:
    """Return the record of a start: its current without ripple and offset, without what does not count."""
    n, alignment = len(start.time_s), start.alignment
    current = start.current_a - start.ripple_a - alignment.offset_a
    current[~start.counted] = np.nan
    speed = np.zeros(n) if start.speed_rad_s is None else start.speed_rad_s
    if start.missing is not None and start.speed_rad_s is not None:
        speed = np.where(start.missing[:, 1], np.nan, speed)
    marks = np.zeros(n)
    marks[0] = REST if start.from_rest else STEADY
    is_step, beside = start.voltage_v is None, start.beside * start.counted[:, None]
    return Record(
        dt_s=start.dt_s,
        voltage_v=np.full(n, start.level_v) if start.voltage_v is None else start.voltage_v,
        readings=np.stack([current, speed], axis=1),
        recorded=np.array([1.0, float(start.speed_rad_s is not None)]),
        marks=marks,
        onset_s=alignment.onset_s - float(start.time_s[0]) if is_step else None,
        shunt_ohm=start.circuit.shunt_ohm,
        rectified_a=alignment.noise_a if alignment.rectified else None,
        beside=orth(beside) if beside.size else None,
    )


def shows_turning(fit: StartFit) -> bool:
    """Return whether the start tells K^2/J, or K with the speed, to a factor of e."""
    pull = next(n for n, name in enumerate(fit.quantity_names) if name.startswith("K"))
    return float(fit.log_covariance[pull, pull]) < UNTOLD_LOG_SD**2


def is_blocked(fit: StartFit, time_constant_s: float) -> bool:
    """Return whether the current hardly falls while a healthy motor runs up, and no motor is seen to turn."""
    if shows_turning(fit) or fit.start.alignment.saturation or fit.r2_current < POOR_FIT:
        return False
    lasts, current = float(fit.start.time_s[-1]) - fit.onset_s, fit.states[:, 0]
    return lasts > _RUN_UP * time_constant_s and mean_tail(current) > _STANDING * float(current.max())


def implausible(fit: StartFit | OperationFit) -> list[str]:
    """Return a sentence for each value outside what motors have; none for a poorly determined quantity."""
    if isinstance(fit, StartFit):
        current, dt_s = fit.start.current_a, fit.start.dt_s
        errors = dict(zip(fit.quantity_names, np.sqrt(np.diag(fit.log_covariance)).tolist(), strict=True))
        logs = dict(zip(fit.quantity_names, fit.log_values.tolist(), strict=True))
    else:
        current, dt_s = fit.record.readings[:, 0], fit.record.dt_s
        errors = {quantity.name: quantity.log_sd for quantity in fit.quantities if quantity.value > 0.0}
        logs = {
            quantity.name: math.log(quantity.value) for quantity in fit.quantities if quantity.name in errors
        }

    def log_of(letters: str) -> float:
        """Return the logarithm of a quantity, whatever it is divided by; NaN where it is not determined."""
        name = next((quantity for quantity in logs if quantity.split("/")[0] == letters), "")
        return logs[name] if errors.get(name, math.inf) < _TOLD else math.nan

    pull = log_of("K^2") if "K" not in logs and "K/V" not in logs else 2.0 * log_of("K") - log_of("J")
    measured = {
        "current": float(np.nanmax(np.abs(current))) or math.nan,  # 0 where only the speed was recorded
        "sampling rate": 1.0 / dt_s,
        "L/R": math.exp(log_of("L") - log_of("R")),
        "R J/K^2": math.exp(log_of("R") - pull),
    } | {name: math.exp(log_of(name)) for name in ("R", "L", "K") if name in logs}
    sentences = [] if isinstance(fit, OperationFit) or shows_turning(fit) else [NOT_TURNING]
    for name, value in measured.items():
        low, high, unit = _USUAL[name]
        if value < low or value > high:
            usual = f"{low:g} to {high:g} {unit}"
            sentences.append(
                f"{name} of {value:.3g} {unit} lies outside what motors have ({usual}): check units, scale and rate of"
                " the recording"
            )
    return sentences


@dataclass(frozen=True, slots=True)
class CommutationRipple:
    """The strongest line of the current over the angle.

    Attributes:
        frequency_hz: of the ripple at the last sample's speed.
        standard_error_hz: of that frequency, from the line's height over its background.
        amplitude_a: of the line.
        strength: power over the background's.
    """

    frequency_hz: float
    standard_error_hz: float
    amplitude_a: float
    strength: float


def find_ripple(fit: StartFit) -> CommutationRipple | None:
    """Find the commutation ripple of a start from rest; None where no line stands out, or it is a converter's."""
    start = fit.start
    begin = int(np.searchsorted(start.time_s, fit.onset_s, side="right"))
    n = len(start.time_s) - begin
    if n < _FEWEST_SAMPLES or not start.from_rest:
        return None
    time_s, residual = start.time_s[begin:], fit.residual_a[begin:]
    turning = over_angle(residual, time_s, fit.states[begin:, 1])
    if turning is None:
        return None
    even, resampled = turning
    window = np.hanning(n)
    power = np.abs(np.fft.rfft((resampled - resampled.mean()) * window, _PADDING * n)) ** 2
    frequency = np.fft.rfftfreq(_PADDING * n, even[1])
    in_band = (frequency > _FEWEST_PERIODS / even[-1]) & (frequency < 0.45 / start.dt_s)
    if not in_band.any():
        return None
    from scipy.ndimage import median_filter  # it takes long to import, and few need it

    # The median of the power of noise is log 2 of its mean.
    background = median_filter(power, _BACKGROUND_BINS, mode="nearest") / math.log(2.0)
    strength = np.where(in_band, power / np.maximum(background, 1e-300), 0.0)
    peak = int(np.argmax(np.where(strength > _STRONG, power, 0.0)))
    if strength[peak] <= _STRONG:
        return None
    left, middle, right = np.log(power[peak - 1 : peak + 2])
    offset = 0.5 * (left - right) / (left - 2.0 * middle + right)
    frequency_hz = float(frequency[peak] + offset * (frequency[1] - frequency[0]))
    return CommutationRipple(
        frequency_hz=frequency_hz,
        # Cramer-Rao for a windowed line: sqrt(6 / (4 pi^2 SNR)) / T, with the window's loss.
        standard_error_hz=math.sqrt(6.0 / strength[peak]) / (math.pi * float(even[-1])),
        amplitude_a=2.0 * math.sqrt(float(power[peak])) / float(window.sum()),
        strength=float(strength[peak]),
    )


def ripple_quantities(fit: StartFit) -> tuple[float, float] | None:
    """Return the ripple's frequency at the last speed, and K times the periods a turn, V s (or s)."""
    ripple = find_ripple(fit)
    if ripple is None:
        return None
    return ripple.frequency_hz, back_emf_v(fit) / (2.0 * math.pi * ripple.frequency_hz)


def constants_at(fit: StartFit, speed_rad_s: float) -> dict[str, float]:
    """Return K, J and B by name at a known last speed, over volt where the voltage is unknown.

    There V = R i + K w; with K, J follows from K^2/J and B from B/J.
    """
    constant, p = back_emf_v(fit) / speed_rad_s, fit.parameters
    # The fit's K^2/J and B/J hold whatever K it believed.
    factor = float(constant / np.max(p.back_emf_constant_v_s_per_rad)) ** 2
    inertia = factor * float(np.max(p.inertia_kg_m2))
    friction = factor * float(np.max(p.viscous_friction_n_m_s_per_rad))
    per_volt = "" if fit.start.voltage_known else "/V"
    return {f"K{per_volt}": constant, f"J{per_volt}": inertia, f"B{per_volt}": friction}


def back_emf_v(fit: StartFit) -> float:
    """Return the back-EMF at the end of the start: what R leaves of the voltage (1 V where it is unknown)."""
    tail = slice(-max(len(fit.states) // 20, 1), None)
    ohm = float(np.max(fit.parameters.resistance_ohm)) + fit.start.circuit.shunt_ohm
    return float(fit.start.level_v - ohm * np.mean(fit.states[tail, 0]))
