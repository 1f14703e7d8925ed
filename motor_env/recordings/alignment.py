"""Where a start begins, and what the quiet part before it tells of the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import ndtr

from motor_env.motor.parameters import FloatArray
from motor_env.recordings.recording import Recording

_FEW = 5
_FEWEST_FOR_RIPPLE = 64
_CROSSING_SHARE = 0.08
_QUANTISED_SHARE = 0.005
_NOISE_MULTIPLE = 6.0
_MAD_TO_STD = 1.4826
_INNER_SHARE = 0.75
_INNER_VARIANCE = 0.36852  # mean square of the smallest three quarters of normal numbers: |z| < 1.15035
_FEWEST_FOR_WILD = 50
_WILD_NOISES = 10.0
_WILD_SHARE = 0.05
_MOST_LINES = 8


class UnusableError(ValueError):
    """A recording that can be read but not judged; the message says why."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """The start of the motor in a recording.

    Attributes:
        onset_index: first sample that clearly belongs to the start.
        onset_s: its time, the first guess of the onset that the fit refines.
        n_quiet: quiet samples before it.
        sign: +1, or -1 where the current goes negative (it is turned round for the fit).
        offset_a: mean current of the quiet part; 0 without one.
        noise_a: standard deviation of a current sample, from its differences.
        quantum_a: smallest step of the current.
        unseen_level_a: standard deviation of the error that the converter's steps leave in a steady current, however
            long it is.
        rectified: the sensor shows no current below 0.
        defects: what is wrong with the recording, in words.
        wild: single samples far off both neighbours; they do not count.
    """

    onset_index: int
    onset_s: float
    n_quiet: int
    sign: float
    offset_a: float
    noise_a: float
    quantum_a: float = 0.0
    unseen_level_a: float = 0.0
    rectified: bool = False
    defects: tuple[str, ...] = ()
    wild: tuple[int, ...] = ()


def difference_noise(values: FloatArray) -> float:
    """Standard deviation of white noise on a smooth curve, from its second differences; outliers do not count.

    The second difference of white noise has the variance 6 sigma^2. Its smallest three quarters are squared and
    averaged: a median of a converter's few steps would jump from one step to the next, by a half of the noise.
    """
    if len(values) < _FEW:
        return 0.0
    second = np.diff(values, n=2)
    off = np.sort(np.abs(second - np.median(second)))
    inner = off[: max(round(_INNER_SHARE * len(off)), 1)]
    spread = math.sqrt(float(np.mean(inner**2)) / _INNER_VARIANCE)
    return max(spread, 0.5 * float(np.std(second))) / math.sqrt(6.0)


def wild_samples(current: FloatArray) -> tuple[int, ...]:
    """Single samples that stand far off two neighbours on each side, which agree among themselves.

    Where there are more than one in a thousand they are the nature of the signal, and none is called wild.
    """
    if len(current) < _FEWEST_FOR_WILD:
        return ()
    around = np.stack([current[:-4], current[1:-3], current[3:-1], current[4:]])
    off = np.abs(current[2:-2] - np.median(around, axis=0))
    second = np.diff(current, n=2)
    noise = _MAD_TO_STD * float(np.median(np.abs(second - np.median(second)))) / math.sqrt(6.0)
    threshold = max(
        _WILD_NOISES * noise, _WILD_SHARE * float(np.percentile(np.abs(current - np.median(current)), 99))
    )
    found = np.flatnonzero((off > threshold) & (np.ptp(around, axis=0) < 0.2 * off)) + 2
    return tuple(found.tolist()) if len(found) <= len(current) / 1000 else ()


def align(recording: Recording) -> Alignment:
    """Find the start.

    Raises:
        UnusableError: the current is constant, or never leaves its noise.
    """
    current = recording.current_a
    wild = wild_samples(current)
    if wild:
        current = current.copy()
        for k in wild:
            current[k] = 0.5 * (current[k - 1] + current[k + 1])
    span = float(np.ptp(current))
    if span == 0.0:
        raise UnusableError(f"the current is constant at {current[0]:g} A")
    head = current[: max(_FEW, len(current) // 50)]
    # A head that already moves belongs to the start: there is no quiet part, and the sensor is believed.
    base = (
        float(np.median(head)) if float(np.ptp(head)) < max(0.1 * span, 8.0 * difference_noise(head)) else 0.0
    )
    deviation = current - base
    sign = 1.0 if deviation.max() >= -deviation.min() else -1.0
    peak = float(np.max(sign * deviation))
    noise = difference_noise(current)
    if peak < _NOISE_MULTIPLE * noise:
        raise UnusableError(
            f"no start was found: the current never rises above its noise ({peak:.3g} A against {noise:.3g} A)"
        )
    smooth = (
        np.convolve(sign * deviation, np.ones(3) / 3.0, mode="same")
        if peak < 20.0 * noise
        else sign * deviation
    )
    threshold = max(_CROSSING_SHARE * peak, min(_NOISE_MULTIPLE * noise, 0.5 * peak))
    above = smooth > threshold
    sustained = above[:-2] & above[1:-1] & above[2:]
    onset = int(np.argmax(sustained)) if sustained.any() else int(np.argmax(above))
    quiet_level = max(2.0 * noise, 0.005 * peak)
    while onset > 0 and smooth[onset - 1] > quiet_level:
        onset -= 1
    quiet = current[: max(onset - 2, 0)]
    if len(quiet) >= _FEW:
        base, sigma = float(np.mean(quiet)), float(np.std(quiet, ddof=1))
    else:
        quiet, base, sigma = quiet[:0], 0.0, 0.0
    steps = np.abs(np.diff(current))
    quantum = float(steps[steps > 0.0].min()) if (steps > 0.0).any() else span
    rectified = onset > 0 and not np.any(current < 0.0) and float(np.mean(current[:onset] == 0.0)) > 0.2
    # Where the steps are as large as the noise, no current below 0 is none that was thrown away.
    rectified = rectified and quantum < min(0.02 * span, difference_noise(current[onset:]))
    if rectified:
        # Half of a rectified normal number's second moment is left; its mean is no offset.
        base, sigma = 0.0, float(np.sqrt(2.0 * np.mean(current[: max(onset - 2, 1)] ** 2)))
    return Alignment(
        onset_index=onset,
        onset_s=float(recording.time_s[onset]) - 0.5 * recording.dt_s,
        n_quiet=len(quiet),
        sign=sign,
        offset_a=base,
        noise_a=max(
            sigma if sigma > 0.0 else noise, quantum / math.sqrt(12.0) if quantum > 0.002 * span else 0.0
        ),
        quantum_a=quantum,
        unseen_level_a=_unseen_level(quiet, noise, quantum),
        rectified=rectified,
        defects=(
            *_defects(current, quantum),
            *(["rectification: no current lies below 0"] if rectified else []),
        ),
        wild=wild,
    )


def _unseen_level(quiet: FloatArray, noise: float, quantum: float) -> float:
    """What a converter's steps hide of a steady current, given the quiet part, or without one the noise all through.

    Noise dithers it away: the bias falls as exp(-2 pi^2 (noise / step)^2) (Widrow & Kollar 2008, ch. 4).
    """
    if len(quiet) == 0:
        before = math.sqrt(max(noise**2 - quantum**2 / 12.0, 0.0))
    elif float(np.std(quiet)) > quantum:
        return 0.0
    else:
        before = _noise_before_rounding(quiet, quantum)
    return quantum / math.sqrt(12.0) * math.exp(-2.0 * (math.pi * before / quantum) ** 2)


def _noise_before_rounding(quiet: FloatArray, quantum: float) -> float:
    """Standard deviation of the noise that a converter then rounds: most likely, from the counts of its steps.

    The variance less step^2 / 12 (Sheppard) is too small where the noise is below half a step.
    """
    codes, counts = np.unique(np.rint((quiet - quiet.min()) / quantum), return_counts=True)
    if len(codes) == 1:
        return 0.0

    def unlikely(mean_and_log: FloatArray) -> float:
        mean, noise = mean_and_log[0], math.exp(mean_and_log[1])
        share = ndtr((codes + 0.5 - mean) / noise) - ndtr((codes - 0.5 - mean) / noise)
        return -float(counts @ np.log(np.maximum(share, 1e-300)))

    begin = np.array([float(codes @ counts) / len(quiet), math.log(0.4)])
    return quantum * math.exp(minimize(unlikely, begin, method="Nelder-Mead").x[1])


def _defects(current: FloatArray, quantum: float) -> tuple[str, ...]:
    """Saturation and quantisation, in words."""
    found = []
    span = float(np.ptp(current))
    top = float(np.max(np.abs(current)))
    at_top = np.abs(np.abs(current) - top) <= 1e-9 * top
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at_top.astype(np.int8), [0]])))
    runs = edges[1::2] - edges[::2]
    if quantum < 0.02 * span and len(runs) and runs.max() >= _FEW:
        first, run = int(edges[::2][np.argmax(runs)]), int(runs.max())
        # A round peak in steps leaves its top step slowly: half a run beyond it is 4 steps down at most. A clipped one
        # drops. How fast it rose tells as much only where the recording ends before.
        beyond = first + run + run // 2
        if beyond >= len(current):
            beyond = max(first - run // 2, 0)
        if top - abs(current[beyond]) > 4.5 * quantum:
            found.append(f"saturation: {run} samples in a row stand at {top:.4g} A")
    if quantum > _QUANTISED_SHARE * span:
        found.append(f"quantisation: the current moves in steps of {quantum:.3g} A")
    return tuple(found)


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
        """The ripple at some times."""
        phase = 2.0 * math.pi * self.frequency_hz * time_s
        out: FloatArray = self.cosine_a * np.cos(phase) + self.sine_a * np.sin(phase)
        return out


def periodic_lines(residual: FloatArray, time_s: FloatArray) -> tuple[PeriodicLine, ...]:
    """Lines that stand out of the upper spectrum of a residual, the strongest first: a converter's PWM.

    A line is called so where it holds more than a third of the power above a sixteenth of the sampling rate, what
    the stronger lines leave. Aliased lines keep their power and lose their true frequency.
    """
    left = residual - residual.mean()
    found: list[PeriodicLine] = []
    while len(found) < _MOST_LINES:
        line = _strongest_line(left, time_s)
        if line is None:
            break
        found.append(line)
        left = left - line.current_a(time_s)
    return tuple(found)


def over_angle(
    values: FloatArray, time_s: FloatArray, speed: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Values evenly over the angle that the motor turns, in seconds at its last speed; None where it does not turn.

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
    """Share of a residual's power that its strongest line holds; 0 where none stands out."""
    line = _strongest_line(residual - residual.mean(), time_s)
    return 0.0 if line is None else 0.5 * line.amplitude_a**2 / max(float(np.var(residual)), 1e-300)


def _strongest_line(residual: FloatArray, time_s: FloatArray) -> PeriodicLine | None:
    n = len(residual)
    if n < _FEWEST_FOR_RIPPLE:
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
