"""Is a filter consistent with what it sees? To be asked before any rule on its residual is trusted.

If the belief holds, whitened innovations are independent standard normal: their mean is 0, the sum of their squares is
chi-square, their correlation from sample to sample is none (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4; portmanteau
test: Ljung & Box 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.stats import chi2, norm

from motor_env.filters.kalman import KalmanFilter, run_filter
from motor_env.motor.parameters import FloatArray, MotorParameters, SensorParameters, require


@dataclass(frozen=True, slots=True)
class Consistency:
    """Three tests of whitened innovations; each p-value is two-sided where that makes sense.

    Attributes:
        n_values: innovations tested.
        mean_p: that their mean is 0.
        nis_p: that their mean square is 1.
        whiteness_p: that they are uncorrelated over the lags (Ljung & Box 1978).
        mean_square: what the mean square is.
        coverage: share of the innovations within 1.96 standard deviations; 0.95 while the belief holds.
        level: false-alarm rate of all three together.
    """

    n_values: int
    mean_p: float
    nis_p: float
    whiteness_p: float
    mean_square: float
    coverage: float
    level: float = 0.01

    @property
    def holds(self) -> bool:
        """Whether none of the three tests rejects at a third of the level (Bonferroni 1936)."""
        return min(self.mean_p, self.nis_p, self.whiteness_p) >= self.level / 3.0

    @property
    def warning(self) -> str:
        """One sentence that says what is not consistent; empty where all is."""
        if self.holds:
            return ""
        found = []
        if self.mean_p < self.level / 3.0:
            found.append("their mean is not 0")
        if self.nis_p < self.level / 3.0:
            found.append(f"their mean square is {self.mean_square:.3g} instead of 1")
        if self.whiteness_p < self.level / 3.0:
            found.append("they are correlated in time")
        return (
            f"the recording is not consistent with the model: of {self.n_values} whitened innovations "
            + ", ".join(found)
            + "; thresholds that assume a consistent filter do not keep their false-alarm rate"
        )


def check_consistency(whitened: ArrayLike, *, lags: int = 20, level: float = 0.01) -> Consistency:
    """Test whitened innovations of one or many transients (Bar-Shalom, Li & Kirubarajan 2001; Ljung & Box 1978).

    Args:
        whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`; NaN is missing.
        lags: lags of the whiteness test.
        level: false-alarm rate of the three tests together.

    Raises:
        ValueError: not more samples than lags, or none measured.
    """
    values = np.asarray(whitened, dtype=np.float64)
    require(
        values.ndim >= 2 and values.shape[-2] > lags,
        f"whitened must have shape (..., n_samples > {lags}, n_channels), got {values.shape}",
    )
    seen = ~np.isnan(values)
    count = int(seen.sum())
    require(count > 0, "whitened must hold a measured sample, got none")
    known = np.where(seen, values, 0.0)
    squares = float(np.square(known).sum())
    tail = float(chi2.cdf(squares, count))
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = float((seen[..., lag:, :] & seen[..., :-lag, :]).sum())
        # With the variance 1 that the belief claims each lag's sum has variance `pairs`.
        if pairs:
            statistic += float((known[..., lag:, :] * known[..., :-lag, :]).sum()) ** 2 / pairs
    return Consistency(
        n_values=count,
        mean_p=float(2.0 * norm.sf(abs(known.sum()) / np.sqrt(count))),
        nis_p=2.0 * min(tail, float(chi2.sf(squares, count))),
        whiteness_p=float(chi2.sf(statistic, lags)),
        mean_square=squares / count,
        coverage=float((np.abs(values[seen]) < norm.ppf(0.975)).mean()),
        level=level,
    )


def signature_energy(
    healthy: MotorParameters,
    faulty: MotorParameters,
    sensor: SensorParameters,
    dt_s: float,
    voltage_v: FloatArray,
    process_noise_std: tuple[float, float],
) -> float:
    """Separation d' of a fault in the filter's whitened innovations: what the best rule on them could use.

    The root of the sum of squares of the signature, that is of the whitened innovations of the faulty motor without
    noise (matched filter: Turin 1960). It is the separation of the whole record where the noise is that of the belief;
    a process noise that the motor does not have only takes from it what a rule can see.
    """
    belief = KalmanFilter.from_parameters(healthy, sensor, dt_s, process_noise_std=process_noise_std)
    model = KalmanFilter.from_parameters(faulty, sensor, dt_s, process_noise_std=(0.0, 0.0))
    states = np.empty((len(voltage_v), 2))
    state = np.zeros(2)
    for k, voltage in enumerate(voltage_v):
        state = model.model.transition @ state + model.model.gain @ np.array([voltage, 0.0])
        states[k] = state
    whitened = run_filter(belief, sensor.observation @ states.T, voltage_v).whitened
    return float(np.sqrt(np.square(whitened).sum()))


def matched_power(separation: float, false_alarm_probability: float) -> float:
    """Share of faults that the best one-sided test of a known fault finds (Neyman & Pearson 1933).

    It holds where the noise is that of the belief, as `choose_process_noise` sees to.
    """
    return float(norm.sf(norm.isf(false_alarm_probability) - separation))


@dataclass(frozen=True, slots=True)
class NoiseDesign:
    """A choice of process noise, and what it costs.

    Attributes:
        process_noise_std: chosen, in [A, rad/s] an interval.
        scale: factor on the given directions that it is.
        consistency: of the healthy data under it.
        separation: d' of each faulty motor under it, see `signature_energy`; `matched_power` makes it a power.
        separation_without: the same without process noise: what was there to be found.
    """

    process_noise_std: tuple[float, float]
    scale: float
    consistency: Consistency
    separation: tuple[float, ...]
    separation_without: tuple[float, ...]


def choose_process_noise(
    motor: MotorParameters,
    sensor: SensorParameters,
    dt_s: float,
    measurements: ArrayLike,
    voltage_v: ArrayLike,
    *,
    faulty: Sequence[MotorParameters] = (),
    direction: tuple[float, float] = (1e-2, 1.0),
    smallest: float = 1e-6,
    largest: float = 10.0,
) -> NoiseDesign:
    """Least process noise that healthy data support: by likelihood over its scale (Mehra 1970, Abbeel et al. 2005).

    Process noise absorbs faults (`signature_energy` falls with it), so among scales whose likelihood is not
    significantly lower than the best one (by less than 1.92, the 95 % interval) the smallest is taken. The answer says
    whether healthy data are consistent under it, and what it leaves of the faults that one wants to see.

    Args:
        motor: believed motor.
        sensor: its sensor.
        dt_s: sampling interval.
        measurements: healthy transients, shape (n_cases, n_channels, n_samples).
        voltage_v: shape (n_samples,) or (n_cases, n_samples).
        faulty: motors with the faults to be found; the first case's voltage drives them.
        direction: standard deviations in [A, rad/s] that the scale multiplies.
        smallest: least scale tried.
        largest: greatest scale tried.
    """

    def log_likelihood(log_scale: float) -> float:
        scale = float(np.exp(log_scale))
        belief = KalmanFilter.from_parameters(
            motor, sensor, dt_s, process_noise_std=(scale * direction[0], scale * direction[1])
        )
        return float(run_filter(belief, measurements, voltage_v).log_likelihood.sum())

    grid = np.linspace(np.log(smallest), np.log(largest), 33)
    values = np.array([log_likelihood(x) for x in grid])
    at = int(values.argmax())
    bounds = (float(grid[max(at - 1, 0)]), float(grid[min(at + 1, len(grid) - 1)]))
    best = minimize_scalar(lambda x: -log_likelihood(x), bounds=bounds, method="bounded")
    top = max(float(values[at]), -float(best.fun))
    good = [float(x) for x, value in zip(grid, values, strict=True) if value >= top - 1.92]
    scale = float(np.exp(min([*good, float(best.x)])))
    chosen = (scale * direction[0], scale * direction[1])
    belief = KalmanFilter.from_parameters(motor, sensor, dt_s, process_noise_std=chosen)
    whitened = run_filter(belief, measurements, voltage_v).whitened
    voltage = np.asarray(voltage_v, dtype=np.float64)
    drive = voltage.reshape(-1, voltage.shape[-1])[0]
    separation, without = (
        tuple(signature_energy(motor, other, sensor, dt_s, drive, std) for other in faulty)
        for std in (chosen, (0.0, 0.0))
    )
    return NoiseDesign(chosen, scale, check_consistency(whitened), separation, without)
