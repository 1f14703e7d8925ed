"""Speed from the commutation ripple of the current: order tracking on the angle that the fitted start turns.

Over time the ripple's frequency rises with the speed; over the angle it is a line. The residual of a fit is resampled
evenly over the fitted angle (computed order tracking: Fyfe & Munck 1997); its strongest line gives the frequency at the
last speed. The start's shape comes from the fit, its scale from the ripple alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.readers.noise import over_angle

_FEWEST_SAMPLES = 256
_FEWEST_PERIODS = 15.0
_PADDING = 4
_BACKGROUND_BINS = 401
_STRONG = 200.0  # times the background's power; the largest of 10,000 bins of white noise reaches about 14


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
    """Find the commutation ripple of a start; None where no line stands out, or the ripple is a converter's.

    Args:
        fit: a fitted start from rest; a ripple of constant frequency has been taken off it.
    """
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
    """Return the frequency at the last speed, and K times the periods a turn, V s (s where the voltage is unknown)."""
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
