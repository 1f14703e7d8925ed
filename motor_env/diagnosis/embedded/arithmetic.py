"""Convert a monitor's numbers to a controller's arithmetic: single precision, or fixed point.

Fixed point: a value is an integer times a unit. The unit of a state is one count of the sensor over a power of two, so
that a reading needs one multiplication. A sum of products is made in 64 bits, rounded, and clamped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_env.diagnosis.embedded.monitor import DEADBAND, LARGE_CURRENT_SHARE, Monitor, Readings
from motor_env.motor.parameters import FloatArray, require

Values = NDArray[Any]
LARGEST = 1 << 29
_FULL_SCALE = 1 << 28
STATISTIC_BITS = 26
_MANTISSA_BITS, _MOST_SHIFT = 30, 62
_LONGEST_MEMORY = 15  # as a power of two
NOTHING_BITS, SOMETHING_BITS = 4, 1
"""A current below the model's over 2^4 is nothing, one of half the model's is something."""


_UNITS = Readings(1.0, 1.0, 1.0)


def clamp(values: Values) -> Values:
    """Clamp values of fixed point."""
    return np.clip(values, -LARGEST, LARGEST)


def convert(values: Values, dtype: type[np.generic]) -> Values:
    """Convert values to a type."""
    return (np.rint(values) if dtype == np.int64 else values).astype(dtype)


@dataclass(frozen=True, slots=True)
class Row:
    """Factors of a sum of products, shape (k,): floats, or integers whose sum is shifted right."""

    factors: Values
    shift: int | None = None

    def total(self, values: Sequence[Values]) -> Values:
        """Sum over the first values, from left to right."""
        products = (factor * value for factor, value in zip(self.factors, values, strict=False))
        total = np.asarray(sum(products))
        return total if self.shift is None else clamp(((total >> (self.shift - 1)) + 1) >> 1)


@dataclass(frozen=True, slots=True)
class Numbers:
    """A monitor's numbers in one arithmetic.

    Attributes:
        dtype: of all numbers: float32, float64 or int64.
        is_fixed: whether they are whole numbers.
        n_channels: number of measured channels.
        scales: factor from a reading of current, speed, voltage to its value; powers of two.
        readings: size of one count of each reading; 1 for floats.
        model: what current and speed grow by in a sample, from current, speed and voltage.
        drag: what brushes and dry friction take from current and speed, and the speed below which they do not count.
        gain: corrections of current and speed from the innovations.
        white: what the current's innovation adds to each sum.
        halves: half the shift of each sum.
        threshold: of the statistic: 1, or 1 << STATISTIC_BITS.
        ranges: largest readings of current, speed, voltage.
        stuck_after: so many equal readings in a row are no readings.
        large_current: the model's current above which a reading of nothing is that of a dead sensor.
        n_friction: how many of the sums look for friction; they are the first.
        memory: of the slow current and speed: the mechanical time constant in samples, as the nearest power of two.
    """

    dtype: type[np.generic]
    is_fixed: bool
    n_channels: int
    scales: tuple[int, ...]
    readings: Readings
    model: tuple[Row, Row]
    drag: tuple[Values, Values, Values]
    gain: tuple[Row, Row]
    white: tuple[Row, ...]
    halves: Values
    threshold: Values
    ranges: Values
    stuck_after: int
    large_current: Values
    n_friction: int
    memory: int


def floating(monitor: Monitor, dtype: type[np.float32 | np.float64] = np.float32) -> Numbers:
    """Convert to floating point."""
    return _numbers(monitor, dtype, _UNITS, unit=1.0, row=lambda rows: Row(rows.astype(dtype)), steps=_UNITS)


def fixed_point(monitor: Monitor, steps: Readings) -> Numbers:
    """Convert to fixed point, for readings that are counts of `steps`.

    Raises:
        ValueError: a step is not positive, or so small or large that the range does not fit.
    """
    units = []
    for name, step, most in zip(Readings._fields, steps, monitor.limits, strict=True):
        counts = most / step if 0.0 < step < math.inf else math.inf
        require(2.0 <= counts <= _FULL_SCALE, f"step of {name} must suit {most:g}, got {step:g}")
        units.append(step / 2.0 ** math.floor(math.log2(_FULL_SCALE / counts)))

    def row(factors: FloatArray) -> Row:
        largest = float(np.abs(factors).max())
        shift = min(_MANTISSA_BITS - math.ceil(math.log2(largest)), _MOST_SHIFT) if largest > 0.0 else 1
        require(shift >= 1, f"a factor of {largest:g} is too large for fixed point")
        return Row(np.rint(np.ldexp(factors, shift)).astype(np.int64), shift)

    return _numbers(monitor, np.int64, units, unit=2.0**-STATISTIC_BITS, row=row, steps=steps)


def _numbers(
    monitor: Monitor,
    dtype: type[np.generic],
    units: Sequence[float],
    *,
    unit: float,
    row: Callable[[FloatArray], Row],
    steps: Readings,
) -> Numbers:
    states, m, limits = np.array(units[:2]), len(monitor.kalman.observation), monitor.limits
    transition, inputs = monitor.kalman.model.transition, monitor.kalman.model.gain
    model = np.hstack([transition - np.eye(2), inputs[:, :1]]) * np.array(units) / states[:, None]
    gain, white = monitor.gains()
    gain, white = gain * states[:m] / states[:, None], white * states[0] / unit
    together = row(white)  # one shift for all: C takes them in turn
    halves = 0.5 * np.array(monitor.rule.shifts) / np.array(monitor.thresholds)
    # What brushes and dry friction take in a sample, for a motion forwards.
    drag = convert(inputs @ [monitor.motor.brush_drop_v, -monitor.motor.coulomb_friction_n_m] / states, dtype)
    slowest = float(np.abs(np.linalg.eigvals(transition)).max())
    memory = round(-math.log2(max(1.0 - slowest, 2.0**-_LONGEST_MEMORY)))
    ranges = np.array(limits) / np.array(steps)
    return Numbers(
        dtype=dtype,
        is_fixed=dtype == np.int64,
        n_channels=m,
        scales=tuple(round(step / unit) for step, unit in zip(steps, units, strict=True)),
        readings=steps,
        model=(row(model[0]), row(model[1])),
        drag=(drag[0], drag[1], convert(np.array(DEADBAND * limits.speed_rad_s / 2.0 / units[1]), dtype)),
        gain=(row(gain[0]), row(gain[1])),
        white=tuple(replace(together, factors=part) for part in together.factors),
        halves=convert(halves / unit, dtype),
        threshold=convert(np.array(1.0 / unit), dtype),
        ranges=(np.floor(ranges) if dtype == np.int64 else ranges).astype(dtype),
        stuck_after=monitor.stuck_after,
        large_current=convert(np.array(LARGE_CURRENT_SHARE * limits.current_a / 2.0 / units[0]), dtype),
        n_friction=len(monitor.rule.friction),
        memory=max(memory, 0),
    )
