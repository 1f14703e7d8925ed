"""Noise of a sensor: its size, outliers, rounding, and lines of constant frequency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import ndtr

from motor_env.motor.parameters import FloatArray

FEW = 5  # samples below which neither a mean nor a run of equal values says anything
_MAD_TO_STD = 1.4826
_INNER_SHARE = 0.75
_INNER_VARIANCE = 0.36852  # mean square of the smallest three quarters of normal numbers: |z| < 1.15035
_FEWEST_FOR_SPECTRUM, _FLOOR_SHARE = 40, 0.9
_MOST_NOISE = 0.6  # of the variance: a record of noise alone shows no motor
_FEWEST_FOR_WILD = 50
_WILD_NOISES = 10.0
_WILD_SHARE = 0.05  # of the current's range: a smaller jump of one sample spoils no fit
_AGREE = 0.2  # of the jump: the neighbours of a wild sample agree so well among themselves
_SAMPLES_PER_WILD = 1000
_OUTSIDE, _LONGEST_RUN = 2.0, 3  # times the largest of the others; samples
_FEWEST_SAMPLES = 64
_MOST_LINES = 8

_MAINS_HZ = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0)
_CLOCKS = 0.01  # error of the mains' frequency and of a logger's clock
_MEANS_HZ, _MOST_MEANS = 1000.0, 8000  # of samples, in which the mains are looked for
_STEP, _WIDTH, _PERIODS = 0.2, 1.5, 4.0  # steps, a line's width, the least frequency: over 1 / duration
_NEAR, _FAR, _BACKGROUND = 0.4, 2.0, 60  # from and to, over the line's frequency; frequencies
_STANDS_OUT = 15.0  # times the background: white noise in 3 of 10 million
_MATTERS = 25.0  # -2 log likelihood
_SHARPER = 1.25  # power of a line beside the mains, or over the motor's angle, over that at the mains


def difference_noise(values: FloatArray) -> float:
    """Return the standard deviation of white noise on a smooth curve, from its second differences (variance 6 sigma^2).

    The smallest three quarters are squared and averaged: a median would jump by a converter's steps.
    """
    if len(values) < FEW:
        return 0.0
    second = np.diff(values, n=2)
    deviation = np.sort(np.abs(second - np.median(second)))
    inner = deviation[: max(round(_INNER_SHARE * len(deviation)), 1)]
    spread = math.sqrt(float(np.mean(inner**2)) / _INNER_VARIANCE)
    return max(spread, 0.5 * float(np.std(second))) / math.sqrt(6.0)


def explainable(values: FloatArray) -> float:
    """Return the share of the variance that is not white noise; 0.4 at least."""
    noise = difference_noise(values) ** 2 / max(float(np.var(values)), 1e-300)
    return 1.0 - min(noise, _MOST_NOISE)


def floor_noise(values: FloatArray) -> float:
    """Return the standard deviation of white noise beside lines of any frequency, as a residual's ripple.

    The smallest nine tenths of the periodogram above an eighth of the sampling rate are averaged.
    """
    n = len(values)
    if n < _FEWEST_FOR_SPECTRUM:
        return difference_noise(values)
    window = np.hanning(n)
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2 / float(np.sum(window**2))
    power = np.sort(power[n // 8 :])
    count, left = round(_FLOOR_SHARE * len(power)), 1.0 - _FLOOR_SHARE
    mean = (1.0 - left * (1.0 - math.log(left))) / _FLOOR_SHARE
    return math.sqrt(float(np.mean(power[:count])) / mean)


def outlier_samples(current: FloatArray) -> tuple[int, ...]:
    """Find up to three samples in a row far off two neighbours on each side; none of too many runs."""
    if len(current) < _FEWEST_FOR_WILD:
        return ()
    second = np.diff(current, n=2)
    noise = _MAD_TO_STD * float(np.median(np.abs(second - np.median(second)))) / math.sqrt(6.0)
    level = float(np.percentile(np.abs(current - np.median(current)), 99))
    wild: dict[int, int] = {}
    for run in range(1, _LONGEST_RUN + 1):
        windows = sliding_window_view(current, run + 4)
        around = windows[:, [0, 1, -2, -1]]
        jump = np.abs(windows[:, 2:-2] - np.median(around, axis=1, keepdims=True)).min(axis=1)
        share = _WILD_SHARE if run == 1 else 1.0
        is_wild = (jump > max(_WILD_NOISES * noise, share * level)) & (np.ptp(around, axis=1) < _AGREE * jump)
        wild |= dict.fromkeys((np.flatnonzero(is_wild) + 2).tolist(), run)
    is_few = len(wild) <= len(current) / _SAMPLES_PER_WILD
    return tuple(sorted(k + n for k, run in wild.items() for n in range(run))) if is_few else ()


def lone_outliers(values: FloatArray) -> NDArray[np.bool_]:
    """Flag up to three readings in a row more than twice as large as all others, few of a thousand, shape (n,)."""
    size = np.abs(np.nan_to_num(values))
    most = _LONGEST_RUN + len(size) // _SAMPLES_PER_WILD
    if len(size) <= 2 * most:
        return np.zeros(len(size), dtype=np.bool_)
    rest = float(np.partition(size, -1 - most)[-1 - most])
    far = np.asarray((size > _OUTSIDE * rest) & (rest > 0.0))
    edges = np.flatnonzero(np.diff(far, prepend=False, append=False))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        far[first:end] = end - first <= _LONGEST_RUN
    return far


def without_outliers(current: FloatArray, wild: Sequence[int]) -> FloatArray:
    """Replace outliers by what lies between their neighbours."""
    mended = current.copy()
    mended[list(wild)] = np.nan
    return filled(mended)


def filled(values: FloatArray) -> FloatArray:
    """Interpolate over NaN; zeros where nothing else is there."""
    known = ~np.isnan(values)
    if known.all():
        return values
    if not known.any():
        return np.zeros(len(values))
    places = np.arange(len(values))
    return np.interp(places, places[known], values[known])


def quantisation_bias(quiet: FloatArray, noise: float, quantum: float) -> float:
    """Return a converter's bias of a steady current, by the quiet part, or by the noise throughout.

    Noise dithers it away: it falls as exp(-2 pi^2 (noise / step)^2) (Widrow & Kollar 2008, ch. 4).
    """
    if len(quiet) == 0:
        before = math.sqrt(max(noise**2 - quantum**2 / 12.0, 0.0))
    elif float(np.std(quiet)) > quantum:
        return 0.0
    else:
        before = _noise_before_rounding(quiet, quantum)
    return quantum / math.sqrt(12.0) * math.exp(-2.0 * (math.pi * before / quantum) ** 2)


def _noise_before_rounding(quiet: FloatArray, quantum: float) -> float:
    """Return the most likely noise before rounding, by the counts of steps; Sheppard's fails below half a step."""
    codes, counts = np.unique(np.rint((quiet - quiet.min()) / quantum), return_counts=True)
    if len(codes) == 1:
        return 0.0

    def unlikely(mean_and_log: FloatArray) -> float:
        mean, noise = mean_and_log[0], math.exp(mean_and_log[1])
        share = ndtr((codes + 0.5 - mean) / noise) - ndtr((codes - 0.5 - mean) / noise)
        return -float(counts @ np.log(np.maximum(share, 1e-300)))

    begin = np.array([float(codes @ counts) / len(quiet), math.log(0.4)])
    return quantum * math.exp(minimize(unlikely, begin, method="Nelder-Mead").x[1])


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
    """Find lines that stand out of a current's residual; none where the strongest is sharper over the angle.

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
    """Resample values evenly over the motor's angle; None where it does not turn.

    Args:
        values: shape (n,).
        time_s: shape (n,).
        speed: in any unit, shape (n,).

    Returns:
        The angle in seconds at the last speed, and the values on it, each of shape (n,).
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


def waves(time_s: FloatArray, frequencies_hz: Sequence[float] | FloatArray) -> FloatArray:
    """Return a cosine and a sine of each frequency, shape (n, 2 m)."""
    phase = 2.0 * math.pi * np.outer(time_s, frequencies_hz)
    return np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(time_s), -1)


def hum_frequencies(
    current: FloatArray, time_s: FloatArray, explained: FloatArray, speed: FloatArray | None = None
) -> tuple[float, ...]:
    """Find lines of the mains, and of twice and three times their frequency, that stand out of a current.

    Args:
        current: shape (n,).
        time_s: evenly spaced, shape (n,).
        explained: what else may be in the current, shape (n, m).
        speed: of the motor, in any unit, shape (n,): its own lines are sharper over its angle.
    """
    duration_s, clocks = float(time_s[-1] - time_s[0]), [time_s]
    if duration_s < _PERIODS / max(_MAINS_HZ):
        return ()
    dt_s = duration_s / (len(time_s) - 1)
    if speed is not None:
        clocks.append(np.cumsum(speed) * dt_s / max(float(np.mean(speed[-len(speed) // 20 :])), 1e-300))
    size = max(int(1.0 / (_MEANS_HZ * dt_s)), 1)
    table = np.column_stack([current, *clocks, explained])[: len(time_s) // size * size]
    table = table.reshape(-1, size, table.shape[1]).mean(axis=1)[:_MOST_MEANS]
    width, found = 1.0 / (len(table) * size * dt_s), list[float]()

    def powers(frequencies_hz: FloatArray, clock: int = 1) -> FloatArray:
        """Return the fall of the sum of squares by a line of each frequency alone."""
        pairs = waves(table[:, clock], frequencies_hz)
        pairs -= own @ (own.T @ pairs)
        each = (table[:, 0] @ pairs) ** 2 / np.maximum(np.sum(pairs**2, axis=0), 1e-300)
        return np.asarray(each[::2] + each[1::2])

    while True:
        own = np.linalg.qr(np.column_stack([table[:, 1 + len(clocks) :], waves(table[:, 1], found)]))[0]
        table[:, 0] -= own @ (own.T @ table[:, 0])
        heights: dict[float, float] = {}
        for mains in _MAINS_HZ:
            off = _CLOCKS * mains
            around = np.linspace(_NEAR * mains, _FAR * mains, _BACKGROUND)
            around = around[(np.abs(around - mains) > _WIDTH * width + off) & (around < 0.45 / (size * dt_s))]
            is_found = any(abs(line - mains) <= 2.0 * off for line in found)
            if is_found or mains < _PERIODS * width or not len(around) or mains > around[-1]:
                continue
            near = np.append(mains, mains + np.arange(-off, off, _STEP * width))
            others = np.arange(mains - off - _WIDTH * width, mains + off + _WIDTH * width, _STEP * width)
            power, usual = powers(near), float(np.median(powers(around))) / math.log(2.0)
            rival = max(powers(others, clock).max() for clock in range(1, 1 + len(clocks)))
            if power.max() > max(
                _STANDS_OUT * usual, rival / _SHARPER, _MATTERS * float(np.var(table[:, 0]))
            ):
                heights[float(power.max())] = float(near[np.argmax(power)])
        if not heights:
            return tuple(found)
        line, step = heights[max(heights)], _STEP * width
        bounds = (line - step, line + step)
        found.append(float(minimize_scalar(lambda f: -powers(np.array([f]))[0], bounds=bounds).x))
