"""What a current probe adds to a start: hum of the mains. It is linear, so a fit takes its least squares off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation.problem import Solution
from motor_env.diagnosis.readers.noise import PeriodicLine
from motor_env.diagnosis.readers.start import Start, mean_tail
from motor_env.motor.parameters import FloatArray

_MAINS_HZ = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0)
_CLOCKS = 0.01  # error of the mains' frequency and of a logger's clock
_RATE_HZ = 1000.0  # of the means of samples in which lines are looked for
_STEP, _WIDTH = 0.25, 1.5  # of frequencies, and a line's width, over 1 / duration
_NEAR, _FAR, _FEWEST, _MOST = (
    0.4,
    2.0,
    6,
    60,
)  # a background: from and to, over the line's frequency; frequencies
_STANDS_OUT = 15.0  # times the background: white noise in 3 of 10 million
_SHARPER = 1.25  # power of a line at another frequency, or over the motor's angle, over that at the mains'


def waves(time_s: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
    """Return a cosine and a sine of each frequency, shape (n, 2 m)."""
    phase = 2.0 * math.pi * np.outer(time_s, frequencies_hz)
    return np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(time_s), -1)


def shapes(start: Start) -> FloatArray:
    """Return what a probe may add to a start's current, shape (n, m): waves of the hum, charge of its capacitor."""
    added = waves(start.time_s, np.array([line.frequency_hz for line in start.hum]))
    return added if start.coupling_per_s is None else np.column_stack([added, -start.charge_a_s])


def with_sizes(start: Start, residual_a: FloatArray) -> Start:
    """Return a start with what a residual, shape (n,), still has of the shapes."""
    counted = start.counted
    more = np.linalg.lstsq(shapes(start)[counted], residual_a[counted])[0].tolist()
    pairs = zip(start.hum, more[::2], more[1::2], strict=False)
    hum = tuple(
        PeriodicLine(line.frequency_hz, line.cosine_a + cosine, line.sine_a + sine)
        for line, cosine, sine in pairs
    )
    coupling = start.coupling_per_s
    return replace(start, hum=hum, coupling_per_s=None if coupling is None else coupling + more[-1])


def find_hum(best: Solution, time_s: FloatArray) -> tuple[PeriodicLine, ...]:
    """Find lines of the mains that stand out of a start's current beside what the fit's unknowns explain.

    Args:
        best: the fit.
        time_s: of its samples, shape (n,).

    Returns:
        The lines, without amplitudes yet.
    """
    base = best.problem.residuals(best.theta)
    slopes = best.problem.jacobian(best.theta, base)
    dt_s, channels, speed = (
        best.problem.record.dt_s,
        int(best.problem.record.recorded.sum()),
        best.free[1][:, 3],
    )
    size = max(int(1.0 / (_RATE_HZ * dt_s)), 1)
    # The motor's own lines are sharper over its angle, in seconds at the last speed.
    turned_s = np.cumsum(speed) * dt_s / max(mean_tail(speed), 1e-300)
    current = np.column_stack([base, slopes])[: len(time_s) * channels : channels]
    means = np.column_stack([time_s, turned_s, current])[: len(time_s) // size * size]
    means = means.reshape(-1, size, means.shape[1]).mean(axis=1)
    clocks_s, left, found = means[:, :2].T, means[:, 2], list[float]()
    width, highest = 1.0 / (len(time_s) * dt_s), 0.45 / (size * dt_s)

    def powers(clock_s: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
        """Return the fall of the sum of squares by a line of each frequency alone."""
        each = []
        for frequency in frequencies_hz:
            shapes = waves(clock_s, np.array([frequency]))
            shapes = np.linalg.qr(shapes - own @ (own.T @ shapes))[0]
            each.append(float(np.sum((left @ shapes) ** 2)))
        return np.array(each)

    def strength(mains: float) -> tuple[float, float, float]:
        """Return how far a line stands out, the mains, and its frequency."""
        count = min(_MOST, int(2.0 * (_FAR - _NEAR) * mains / width))
        beside = mains * np.linspace(_NEAR, min(_FAR, highest / mains), count)
        beside = beside[np.abs(beside - mains) > max(_WIDTH * width, _CLOCKS * mains)]
        if mains > highest or len(beside) < _FEWEST:
            return 0.0, mains, mains
        usual, off = float(np.median(powers(clocks_s[0], beside))) / math.log(2.0), _CLOCKS * mains
        near = np.arange(mains - off, mains + 1.001 * off, min(_STEP * width, off))
        power = powers(clocks_s[0], near)
        if power.max() < _STANDS_OUT * usual:
            return 0.0, mains, mains
        others = np.arange(near[0] - _WIDTH * width, near[-1] + _WIDTH * width, _STEP * width)
        if max(powers(clock_s, others).max() for clock_s in clocks_s) > _SHARPER * power.max():
            return 0.0, mains, mains
        return float(power.max() / usual), mains, float(near[np.argmax(power)])

    mains_left = set(_MAINS_HZ)
    while mains_left:
        own = np.linalg.qr(np.column_stack([means[:, 3:], waves(clocks_s[0], np.array(found))]))[0]
        left = left - own @ (own.T @ left)
        height, mains, frequency = max(strength(mains) for mains in mains_left)
        if height == 0.0:
            break
        mains_left.remove(mains)
        found.append(frequency)
    return tuple(PeriodicLine(frequency, 0.0, 0.0) for frequency in found)
