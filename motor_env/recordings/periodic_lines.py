"""Ripple of constant frequency in a residual, over time or over the angle that the motor turns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from motor_env.motor.parameters import FloatArray

_FEWEST_SAMPLES = 64
_MOST_LINES = 8


@dataclass(frozen=True, slots=True)
class PeriodicLine:
    """Ripple of constant frequency: cosine_a cos(2 pi f t) + sine_a sin(2 pi f t)."""

    frequency_hz: float
    cosine_a: float
    sine_a: float

    @property
    def amplitude_a(self) -> float:
        """Amplitude."""
        return math.hypot(self.cosine_a, self.sine_a)

    def current_a(self, time_s: FloatArray) -> FloatArray:
        """Return the ripple at some times."""
        phase = 2.0 * math.pi * self.frequency_hz * time_s
        out: FloatArray = self.cosine_a * np.cos(phase) + self.sine_a * np.sin(phase)
        return out


def periodic_lines(residual: FloatArray, time_s: FloatArray) -> tuple[PeriodicLine, ...]:
    """Find lines that stand out of a residual's upper spectrum, strongest first: a converter's PWM.

    A line holds more than a third of the power above a sixteenth of the sampling rate that stronger lines leave.
    Aliased lines keep their power and lose their true frequency.
    """
    left = residual - residual.mean()
    lines: list[PeriodicLine] = []
    while len(lines) < _MOST_LINES:
        line = _strongest_line(left, time_s)
        if line is None:
            break
        lines.append(line)
        left = left - line.current_a(time_s)
    return tuple(lines)


def constant_lines(residual: FloatArray, time_s: FloatArray, speed: FloatArray) -> tuple[PeriodicLine, ...]:
    """Find lines that stand out of a current's residual.

    Where the strongest one is sharper over the angle than over time, it is the commutator's: there are none.

    Args:
        residual: shape (n,).
        time_s: evenly spaced, shape (n,).
        speed: of the fitted motor, in any unit, shape (n,).
    """
    lines = periodic_lines(residual, time_s)
    if not lines:
        return ()
    turning = over_angle(residual, time_s, speed)
    turns = turning is not None and line_share(turning[1], turning[0]) > line_share(residual, time_s)
    return () if turns else lines


def over_angle(
    values: FloatArray, time_s: FloatArray, speed: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Resample values evenly over the motor's angle, in seconds at its last speed; None where it does not turn.

    Args:
        values: shape (n,).
        time_s: shape (n,).
        speed: in any unit, shape (n,).

    Returns:
        The even axis and the values on it, each of shape (n,).
    """
    n = len(time_s)
    last = float(np.mean(speed[-max(n // 20, 1) :]))
    if last <= 0.0:
        return None
    shape = np.maximum(speed / last, 0.0)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (shape[1:] + shape[:-1]) * np.diff(time_s))])
    turned += 1e-12 * np.arange(n)  # strictly rising, where the motor stands too
    even = np.linspace(0.0, turned[-1], n)
    return even, np.interp(even, turned, values)


def line_share(residual: FloatArray, time_s: FloatArray) -> float:
    """Return the share of a residual's power in its strongest line; 0 where none stands out."""
    line = _strongest_line(residual - residual.mean(), time_s)
    return 0.0 if line is None else 0.5 * line.amplitude_a**2 / max(float(np.var(residual)), 1e-300)


def _strongest_line(residual: FloatArray, time_s: FloatArray) -> PeriodicLine | None:
    n = len(residual)
    if n < _FEWEST_SAMPLES:
        return None
    dt_s = float(time_s[-1] - time_s[0]) / (n - 1)
    window = np.hanning(n)
    power = np.abs(np.fft.rfft((residual - residual.mean()) * window)) ** 2
    power[: n // 16] = 0.0
    peak = int(np.argmax(power))
    line = float(power[max(peak - 2, 0) : peak + 3].sum())
    if line < power.sum() / 3.0:
        return None

    def fit(frequency_hz: float) -> tuple[float, FloatArray]:
        phase = 2.0 * math.pi * frequency_hz * time_s
        columns = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        amplitudes = np.linalg.lstsq(columns, residual, rcond=None)[0]
        return float(np.sum((residual - columns @ amplitudes) ** 2)), amplitudes

    near = (max(peak - 1, 0) / (n * dt_s), min((peak + 1) / n, 0.5) / dt_s)
    best = minimize_scalar(
        lambda f: fit(f)[0], bounds=near, method="bounded", options={"xatol": 1e-5 / (n * dt_s)}
    )
    frequency = float(best.x)
    cosine, sine = fit(frequency)[1]
    return PeriodicLine(frequency, float(cosine), float(sine))
