"""Choice of a filter's process noise from healthy data, and its price in faults that no longer show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, ndtri

from motor_env.filters.batch import run_filter
from motor_env.filters.consistency import Consistency, check_consistency
from motor_env.filters.kalman import KalmanFilter
from motor_env.motor.parameters import FloatArray, MotorParameters, SensorParameters
from motor_env.simulation.simulate import simulate_states

_INTERVAL_95 = 1.92  # fall of the log-likelihood at the ends of a 95 % interval of one parameter


def signature_energy(
    belief: KalmanFilter, faulty: MotorParameters, voltage_v: FloatArray, dt_s: float
) -> float:
    """Separation d' of a fault in a filter's whitened innovations: the most that a rule on them can use.

    The root of the sum of squares of the signature, that is of the whitened innovations of the faulty motor without
    noise (matched filter: Turin 1960). It is the separation of the whole record where the noise is that of the belief;
    a process noise that the motor does not have only takes from it what a rule can see.

    Args:
        belief: filter of the healthy motor.
        faulty: motor with the fault.
        voltage_v: shape (n_samples,).
        dt_s: sampling interval.
    """
    states = simulate_states(faulty, voltage_v, dt_s)
    return float(np.linalg.norm(run_filter(belief, belief.observation @ states.T, voltage_v).whitened))


def matched_power(separation: float, false_alarm_probability: float) -> float:
    """Share of faults that the best one-sided test of a known fault finds (Neyman & Pearson 1933).

    It holds where the noise is that of the belief, as `choose_process_noise` sees to.
    """
    return float(ndtr(separation + ndtri(false_alarm_probability)))


@dataclass(frozen=True, slots=True)
class NoiseDesign:
    """A choice of process noise, and what it costs.

    Attributes:
        process_noise_std: chosen, in [A, rad/s] an interval.
        scale: factor on the given directions that it is.
        consistency: of the healthy data under it.
        separation: d' of each faulty motor under it, see `signature_energy`; `matched_power` makes it a power.
        separation_without: the same without process noise.
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

    def belief(scale: float) -> KalmanFilter:
        std = (scale * direction[0], scale * direction[1])
        return KalmanFilter.from_parameters(motor, sensor, dt_s, process_noise_std=std)

    def log_likelihood(log_scale: float) -> float:
        return float(run_filter(belief(np.exp(log_scale)), measurements, voltage_v).log_likelihood.sum())

    grid = np.linspace(np.log(smallest), np.log(largest), 33)
    values = np.array([log_likelihood(x) for x in grid])
    at = int(values.argmax())
    bounds = (float(grid[max(at - 1, 0)]), float(grid[min(at + 1, len(grid) - 1)]))
    best = minimize_scalar(lambda x: -log_likelihood(x), bounds=bounds, method="bounded")
    lowest = max(values[at], -float(best.fun)) - _INTERVAL_95
    scale = float(np.exp(min([*grid[values >= lowest], float(best.x)])))
    chosen, voltage = belief(scale), np.asarray(voltage_v, dtype=np.float64)
    drive = voltage.reshape(-1, voltage.shape[-1])[0]
    separation, without = (
        tuple(signature_energy(filtering, other, drive, dt_s) for other in faulty)
        for filtering in (chosen, belief(0.0))
    )
    return NoiseDesign(
        process_noise_std=(scale * direction[0], scale * direction[1]),
        scale=scale,
        consistency=check_consistency(run_filter(chosen, measurements, voltage_v).whitened),
        separation=separation,
        separation_without=without,
    )
