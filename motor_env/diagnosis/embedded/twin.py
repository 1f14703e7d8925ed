"""Compute as the C source does: the same operations in the same order, in NumPy.

In single precision, sums of current and speed are compensated (Kahan 1965).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.diagnosis.embedded.monitor import DEAD_AFTER, DEADBAND, LARGE_CURRENT_SHARE, Monitor, Readings
from motor_env.motor.parameters import FloatArray, require

Values = NDArray[Any]
LARGEST = 1 << 29
_FULL_SCALE = 1 << 28
STATISTIC_BITS = 26
_MANTISSA_BITS, _MOST_SHIFT = 30, 62
_LONGEST_MEMORY = 15  # as a power of two
NOTHING_BITS, SOMETHING_BITS = 4, 1
"""A current below 2^-4 of the model's is nothing, one of half the model's is something."""


_UNITS = Readings(1.0, 1.0, 1.0)


def clamp(values: Values) -> Values:
    """Clamp values of fixed point."""
    return np.clip(values, -LARGEST, LARGEST)


def convert(values: Values, dtype: type[np.generic]) -> Values:
    """Convert values to a type."""
    return (np.rint(values) if dtype == np.int64 else values).astype(dtype)


@dataclass(frozen=True, slots=True)
class Row:
    """Factors of a sum of products, shape (k,): floats, or integers with a right shift."""

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
        is_fixed: whether they are integers.
        n_channels: number of measured channels.
        scales: factor from a reading of current, speed, voltage to its value; powers of two.
        readings: size of one count of each reading; 1 for floats.
        model: change of current and speed in a sample, by current, speed and voltage.
        drag: loss of current and speed by brushes and dry friction, and the speed below which they are 0.
        gain: corrections of current and speed from the innovations.
        white: from the current's innovation to each sum.
        halves: half the shift of each sum.
        threshold: of the statistic: 1, or 1 << STATISTIC_BITS.
        ranges: largest readings of current, speed, voltage.
        stuck_after: equal readings in a row of a stuck sensor.
        large_current: the model's current above which a zero reading shows a dead sensor.
        n_friction: number of sums for friction, the first ones.
        memory: mechanical time constant in samples, as the nearest exponent of two.
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
        ValueError: a step is not positive, or does not suit the range.
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


class SampleVerdict(IntEnum):
    """Verdict of a sample, with its number in C."""

    HEALTHY = 0
    FAULT = 1
    SENSOR_STUCK = 2
    SENSOR_RANGE = 3
    SENSOR_DEAD = 4


class TwinResult(NamedTuple):
    """Verdict and statistic after each sample, shape (n_cases, n_samples), in the units of C."""

    verdict: NDArray[np.int64]
    statistic: Values


def readings_of(numbers: Numbers, measurements: ArrayLike, voltage_v: ArrayLike) -> Values:
    """Convert measurements (n_cases, m, n_samples) and voltage (n_samples,) to the controller's readings.

    Returns:
        Shape (n_cases, m + 1, n_samples): current, speed where measured, voltage.
    """
    measured = np.asarray(measurements, dtype=np.float64)
    voltage = np.broadcast_to(voltage_v, measured[:, 0].shape)[:, None]
    sizes = np.array([*numbers.readings[: numbers.n_channels], numbers.readings.voltage_v])[:, None]
    return convert(np.concatenate([measured, voltage], axis=1) / sizes, numbers.dtype)


def run_twin(numbers: Numbers, readings: Values) -> TwinResult:
    """Run a monitor over the readings of many motors, see `readings_of`."""
    twin = _Twin(numbers, len(readings))
    steps = [(twin.step(sample), twin.statistic) for sample in np.moveaxis(readings, 2, 0)]
    return TwinResult(*(np.stack(column, axis=1) for column in zip(*steps, strict=True)))


class _Twin:
    def __init__(self, numbers: Numbers, n_cases: int) -> None:
        self.numbers = numbers
        self.state, self.lost, self.slow = np.zeros((3, 2, n_cases), numbers.dtype)
        self.voltage, self.statistic = np.zeros((2, n_cases), numbers.dtype)
        self.sums = np.zeros((2, len(numbers.halves), n_cases), numbers.dtype)
        self.last, self.same = np.zeros((2, n_cases, numbers.n_channels), numbers.dtype)
        self.hidden = np.zeros(n_cases, np.int64)

    def step(self, readings: Values) -> NDArray[np.int64]:
        """Judge a sample of each case, shape (n_cases,), by readings of shape (n_cases, m + 1)."""
        numbers, m = self.numbers, self.numbers.n_channels
        inside = np.abs(readings) <= numbers.ranges[[*range(m), 2]]
        self.voltage = np.where(inside[:, m], readings[:, m] * numbers.scales[2], self.voltage)
        measured = readings[:, :m]
        again = (measured == self.last) & (self.voltage != 0)[:, None]
        self.same = np.where(again, np.minimum(self.same + 1, numbers.stuck_after), 0)
        self.last = measured
        wrong, stuck = ~inside.all(axis=1), (self.same == numbers.stuck_after).any(axis=1)
        growth = self._growth()
        dead = self._dead(growth, measured[:, 0], wrong)
        used = ~(wrong | stuck | dead)
        forward = self._forward(growth)
        innovation = [measured[:, c] * numbers.scales[c] - self.state[c] - growth[c] for c in range(m)]
        correction = np.array([row.total(innovation) for row in numbers.gain])
        white = np.array([row.total(innovation) for row in numbers.white])
        self._add(np.where(used, growth + correction, growth))
        self.statistic = np.where(used, self._decided(white, forward, used), self.statistic)
        fault = np.where(self.statistic > numbers.threshold, SampleVerdict.FAULT, SampleVerdict.HEALTHY)
        sensor = np.where(stuck, SampleVerdict.SENSOR_STUCK, SampleVerdict.SENSOR_DEAD)
        sensor = np.where(wrong, SampleVerdict.SENSOR_RANGE, sensor)
        return np.where(used, fault, sensor)

    def _dead(self, growth: Values, reading: Values, wrong: Any) -> NDArray[np.bool_]:
        """Find dead current sensors: they read nothing while the model's current is large."""
        numbers, predicted = self.numbers, np.abs(self.state[0] + growth[0])
        predicted = clamp(predicted) if numbers.is_fixed else predicted
        shown = np.abs(reading * numbers.scales[0])

        def of(bits: int) -> Values:
            return np.asarray(predicted >> bits if numbers.is_fixed else predicted * np.float32(2.0**-bits))

        is_large = ~wrong & (predicted > numbers.large_current)
        more = np.minimum(self.hidden + 1, DEAD_AFTER)
        self.hidden = np.where(is_large & (shown < of(NOTHING_BITS)), more, self.hidden)
        self.hidden = np.where(is_large & (shown >= of(SOMETHING_BITS)), 0, self.hidden)
        return np.asarray(self.hidden == DEAD_AFTER)

    def _growth(self) -> Values:
        (current, speed), drag = self.state, self.numbers.drag
        direction = np.sign(speed) * (np.abs(speed) > drag[2])
        totals = [row.total((current, speed, self.voltage)) for row in self.numbers.model]
        return np.array([total - direction * part for total, part in zip(totals, drag, strict=False)])

    def _add(self, growth: Values) -> None:
        if self.numbers.is_fixed:
            self.state = clamp(self.state + growth)
        else:
            rest, before = growth - self.lost, self.state
            self.state = before + rest
            self.lost = (self.state - before) - rest

    def _forward(self, growth: Values) -> Values:
        """Return the signs that multiply the innovation, for windings and for friction."""
        is_fixed, predicted = self.numbers.is_fixed, self.state + growth
        predicted = clamp(predicted) if is_fixed else predicted
        shared = np.floor_divide if is_fixed else np.divide
        self.slow = self.slow + shared(predicted - self.slow, 2**self.numbers.memory)
        return np.array([predicted[0] - self.slow[0], self.slow[1]])

    def _decided(self, white: Values, forward: Values, used: NDArray[np.bool_]) -> Values:
        numbers = self.numbers
        sign = np.repeat(forward[::-1], [numbers.n_friction, len(white) - numbers.n_friction], axis=0)
        signed = np.where(sign < 0, -white, white)
        moved = self.sums + np.array([signed, -signed]) - numbers.halves[:, None]
        sums = np.clip(moved, 0, LARGEST if numbers.is_fixed else None)
        self.sums = np.where(used, sums, self.sums)
        return np.asarray(sums.max(axis=(0, 1)))
