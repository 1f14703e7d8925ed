"""Onset of a start, and what the quiet part before it tells of the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from motor_env.diagnosis.readers.noise import (
    FEW,
    difference_noise,
    outlier_samples,
    quantisation_bias,
    without_outliers,
)
from motor_env.diagnosis.readers.recording import Recording, UnusableError, stretches
from motor_env.motor.parameters import FloatArray

_HEAD_PARTS = 50  # the first fiftieth of a recording shows the level before the start ...
_QUIET_SPAN = 0.1  # ... where it moves by less than a tenth of the whole current,
_QUIET_NOISES = 8.0  # or by no more than the range of some hundred normal numbers
_CROSSING_SHARE = 0.08  # of the peak: above the creep of a filtered supply, early in the inrush
_CROSSING_NOISES = 6.0  # three samples in a row never lie so high by chance
_LARGEST_CROSSING = 0.5  # of the peak, however noisy
_SMOOTHED_BELOW = 20.0  # noises: a peak so low is smoothed over three samples before its onset is looked for
_FOOT_SHARE, _FOOT_NOISES = 0.005, 2.0  # the start's foot: of the peak, of the noise
_GUARD = 2  # samples before the onset that may belong to it already
_COARSE_STEP = 0.02  # of the span: above it the steps are what is seen, not the motor
_SEEN_STEP = 0.002  # of the span: above it the steps are part of the noise
_QUANTISED_STEP = 0.005  # of the span: above it the steps are worth a note
_RECTIFIED_SHARE = 0.2  # of the samples before the start are 0 behind a rectifier: half, less the offset
_CLIPPED_DROP = 4.5  # steps: a round peak in steps leaves its top slowly, a clipped one drops


@dataclass(frozen=True, slots=True)
class Alignment:
    """Alignment of a start in its recording.

    Attributes:
        onset_index: first sample that clearly belongs to the start.
        onset_s: its time, the first guess of the onset that the fit refines.
        n_quiet: quiet samples before it.
        sign: +1, or -1 where the current goes negative (it is turned round for the fit).
        offset_a: mean current of the quiet part; 0 without one.
        noise_a: standard deviation of a current sample, from its differences.
        quantum_a: smallest step of the current.
        unseen_level_a: standard deviation of the converter's error in a steady current.
        rectified: the sensor shows no current below 0.
        saturation: that the current is clipped, in words; else empty.
        defects: of the recording, in words, the saturation among them.
        wild: outliers, single samples that do not count.
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
    saturation: str = ""
    defects: tuple[str, ...] = ()
    wild: tuple[int, ...] = ()


def align(recording: Recording) -> Alignment:
    """Find the start.

    Raises:
        UnusableError: the current is constant, or never leaves its noise.
    """
    wild = outlier_samples(recording.current_a)
    current = without_outliers(recording.current_a, wild)
    span = float(np.ptp(current))
    if span == 0.0:
        raise UnusableError(f"the current is constant at {current[0]:g} A")
    deviation = current - _level_before(current, span)
    sign = 1.0 if deviation.max() >= -deviation.min() else -1.0
    noise = difference_noise(current)
    onset = _onset(sign * deviation, noise)
    there = current if recording.missing is None else current[~recording.missing[:, 1]]
    steps = np.abs(np.diff(there))
    quantum = float(np.min(steps, where=steps > 0.0, initial=span))
    rectified = _is_rectified(current, onset, quantum)
    quiet = current[: max(onset - _GUARD, 0)]
    quiet = quiet if len(quiet) >= FEW else quiet[:0]
    offset, spread = 0.0, noise
    if rectified:
        # Half of a rectified normal number's second moment is left; its mean is no offset.
        spread = math.sqrt(2.0 * float(np.mean(current[: max(onset - _GUARD, 1)] ** 2)))
    elif len(quiet):
        offset, spread = float(np.mean(quiet)), float(np.std(quiet, ddof=1))
    saturation = _saturation(current, quantum)
    defects = {
        saturation: saturation != "",
        f"quantisation: the current moves in steps of {quantum:.3g} A": quantum > _QUANTISED_STEP * span,
        "rectification: no current lies below 0": rectified,
    }
    return Alignment(
        onset_index=onset,
        onset_s=float(recording.time_s[onset]) - 0.5 * recording.dt_s,
        n_quiet=len(quiet),
        sign=sign,
        offset_a=offset,
        noise_a=max(spread or noise, quantum / math.sqrt(12.0) if quantum > _SEEN_STEP * span else 0.0),
        quantum_a=quantum,
        unseen_level_a=quantisation_bias(quiet, noise, quantum),
        rectified=rectified,
        saturation=saturation,
        defects=tuple(words for words, is_shown in defects.items() if is_shown),
        wild=wild,
    )


def _level_before(current: FloatArray, span: float) -> float:
    """Return the sensor's level before the start; 0 where the recording begins with it."""
    head = current[: max(FEW, len(current) // _HEAD_PARTS)]
    is_quiet = float(np.ptp(head)) < max(_QUIET_SPAN * span, _QUIET_NOISES * difference_noise(head))
    return float(np.median(head)) if is_quiet else 0.0


def _onset(rise: FloatArray, noise: float) -> int:
    """Return the first sample of the start: the foot of the first clear rise."""
    peak = float(np.max(rise))
    if peak < _CROSSING_NOISES * noise:
        raise UnusableError(
            f"no start was found: the current never rises above its noise ({peak:.3g} A against {noise:.3g} A)"
        )
    if peak < _SMOOTHED_BELOW * noise:
        rise = np.convolve(rise, np.ones(3) / 3.0, mode="same")
    above = rise > max(_CROSSING_SHARE * peak, min(_CROSSING_NOISES * noise, _LARGEST_CROSSING * peak))
    sustained = above[:-2] & above[1:-1] & above[2:]
    onset = int(np.argmax(sustained if sustained.any() else above))
    foot = max(_FOOT_NOISES * noise, _FOOT_SHARE * peak)
    while onset > 0 and rise[onset - 1] > foot:
        onset -= 1
    return onset


def _is_rectified(current: FloatArray, onset: int, quantum: float) -> bool:
    """Return whether the sensor shows none below 0: no negative sample, and many zeros before the start."""
    if onset == 0 or np.any(current < 0.0) or float(np.mean(current[:onset] == 0.0)) <= _RECTIFIED_SHARE:
        return False
    return quantum < min(_COARSE_STEP * float(np.ptp(current)), difference_noise(current[onset:]))


def _saturation(current: FloatArray, quantum: float) -> str:
    """Say that the current is clipped; empty where it is not."""
    if quantum >= _COARSE_STEP * float(np.ptp(current)) or not (run := clipped_run(current, quantum)):
        return ""
    return f"saturation: {run} samples in a row stand at {np.max(np.abs(current)):.4g} A"


def clipped_run(current: FloatArray, quantum: float) -> int:
    """Return the longest run at the top of a clipped channel; 0 where it is not clipped."""
    top = float(np.max(np.abs(current)))
    at_top = np.abs(np.abs(current) - top) <= 1e-9 * top
    firsts, ends = stretches(at_top)
    longest = int(np.argmax(ends - firsts))
    first, run = int(firsts[longest]), int(ends[longest] - firsts[longest])
    # Half a run beyond its end a round peak has fallen by 4 steps at most. How fast it rose tells as much only where
    # the recording ends before.
    beyond = first + run + run // 2
    if beyond >= len(current):
        beyond = max(first - run // 2, 0)
    return run if run >= FEW and top - abs(current[beyond]) > _CLIPPED_DROP * quantum else 0
