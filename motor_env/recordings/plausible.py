"""What a column cannot be, by its numbers: a current that is computed, or larger than any; times that were rounded."""

from __future__ import annotations

import numpy as np

from motor_env.motor.parameters import FloatArray

LARGEST_CURRENT_A = 1_000.0
LARGE_CURRENT_A = 100.0
"""Beyond it a current that the user named is warned of."""
_MANY_WHOLE = 20
"""Different whole numbers: counts of a converter or of a clock, not a voltage that is 0 or 12."""
_FEWEST_LEVELS = 50  # of numbers whose rounding can be told from noise
_MOST_COMPARED = 20_000  # samples
_DENSEST = 0.9  # of a step of the rounding: times further apart hardly repeat


def has_counts(values: FloatArray, averaged: int = 1) -> bool:
    """Whether numbers are those of a converter or of a clock; their means times `averaged` are whole, too."""
    sums = values * averaged
    is_whole = np.abs(sums - np.round(sums)) <= 1e-6 * (averaged > 1)
    return bool(np.all(is_whole)) and len(np.unique(sums)) > _MANY_WHOLE


@np.errstate(over="ignore", invalid="ignore")  # of numbers that nobody measured
def follows(values: FloatArray, other: FloatArray, of: str) -> bool:
    """Whether numbers are a linear function of others, to rounding: computed from them, not measured.

    Args:
        values: those of the current.
        other: those of another quantity.
        of: which. A current that falls as the speed rises may be that of an ideal motor.
    """
    each = -(-len(values) // _MOST_COMPARED)
    values, other = values[::each], other[::each]
    span, other_span = float(np.ptp(values)), float(np.ptp(other))
    if not span or not other_span:
        return False
    y, x = (values - values.mean()) / span, (other - other.mean()) / other_span
    slope = float(x @ y / (x @ x))
    off = float(np.max(np.abs(y - slope * x)))
    if not off <= 0.05 or off > 1e-6 + 0.6 * (_step(y) + _step(x)):  # the slope is 1 or -1 then
        return False
    sizes = np.abs(values) - np.abs(values).mean(), np.abs(other) - np.abs(other).mean()
    return of != "speed" or float(sizes[0] @ sizes[1]) > 0.0


def _step(values: FloatArray) -> float:
    """The step to which numbers are rounded; 0 for few levels."""
    levels = np.unique(values)
    return float(np.min(np.diff(levels))) if len(levels) >= _FEWEST_LEVELS else 0.0


@np.errstate(over="ignore", invalid="ignore")
def evenly_rounded(time_s: FloatArray) -> tuple[FloatArray, float, float] | None:
    """Times that repeat because they were rounded, spread evenly again.

    Returns:
        times, rate in Hz, and the step to which they were rounded; None where they do not repeat, or not by rounding.
    """
    steps = np.diff(time_s)
    rising = steps[steps > 0.0]
    if not len(rising) or (steps < 0.0).any() or (steps > 0.0).all():
        return None
    rounding_s = float(np.min(rising))
    count = np.arange(len(time_s), dtype=np.float64) - 0.5 * (len(time_s) - 1)
    middle_s = float(np.mean(time_s))
    interval_s = float(count @ (time_s - middle_s) / (count @ count))
    if interval_s > _DENSEST * rounding_s or float(np.max(rising)) > 1.01 * rounding_s:
        return None

    def spread(dt_s: float) -> float:
        return float(np.ptp(time_s - count * dt_s)) / rounding_s

    if spread(interval_s) > 1.1:
        return None
    rates = (float(f"{1.0 / interval_s:.{digits}g}") for digits in range(1, 6))
    rate_hz = next((rate for rate in rates if spread(1.0 / rate) <= 1.001), 1.0 / interval_s)
    return middle_s + count / rate_hz, rate_hz, rounding_s
