"""Compute as the C source does: the same operations in the same order, on NumPy's floats or integers.

Current and speed grow by small amounts. In single precision what is lost when an amount is added is kept for the next
one (Kahan 1965); without that the statistics drift off by more than the noise of the sum.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.diagnosis.embedded.arithmetic import (
    LARGEST,
    NOTHING_BITS,
    SOMETHING_BITS,
    Numbers,
    Values,
    clamp,
    convert,
)
from motor_env.diagnosis.embedded.monitor import DEAD_AFTER


class SampleVerdict(IntEnum):
    """Verdict of a sample, with the number that it has in C."""

    HEALTHY = 0
    FAULT = 1
    SENSOR_STUCK = 2
    SENSOR_RANGE = 3
    SENSOR_DEAD = 4


class TwinResult(NamedTuple):
    """Verdict and statistic after each sample, shape (n_cases, n_samples); the statistic as C counts it."""

    verdict: NDArray[np.int64]
    statistic: Values


def readings_of(numbers: Numbers, measurements: ArrayLike, voltage_v: ArrayLike) -> Values:
    """Convert measurements (n_cases, m, n_samples) and voltage (n_samples,) to what the controller reads.

    Returns:
        Shape (n_cases, m + 1, n_samples): current, speed where measured, voltage.
    """
    measured = np.asarray(measurements, dtype=np.float64)
    voltage = np.broadcast_to(voltage_v, measured[:, 0].shape)[:, None]
    sizes = np.array([*numbers.readings[: numbers.n_channels], numbers.readings.voltage_v])[:, None]
    return convert(np.concatenate([measured, voltage], axis=1) / sizes, numbers.dtype)


def run_twin(numbers: Numbers, readings: Values) -> TwinResult:
    """Run a monitor from its begin over the readings of many motors, as `readings_of` gives them."""
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
        """Judge a sample of each case, shape (n_cases,); its readings are (n_cases, m + 1)."""
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
        """Find where the current reads nothing whenever the model has much; so it stays until one is read."""
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
        """Return values by whose signs the innovation is multiplied, for windings and for friction."""
        is_fixed, predicted = self.numbers.is_fixed, self.state + growth
        predicted = clamp(predicted) if is_fixed else predicted
        shared = np.floor_divide if is_fixed else np.divide
        self.slow = self.slow + shared(predicted - self.slow, 2**self.numbers.memory)
        return np.array([predicted[0] - self.slow[0], self.slow[1]])

    def _decided(self, white: Values, forward: Values, used: NDArray[np.bool_]) -> Values:
        """Update the statistic, where the sample is used."""
        numbers = self.numbers
        sign = np.repeat(forward[::-1], [numbers.n_friction, len(white) - numbers.n_friction], axis=0)
        signed = np.where(sign < 0, -white, white)
        moved = self.sums + np.array([signed, -signed]) - numbers.halves[:, None]
        sums = np.clip(moved, 0, LARGEST if numbers.is_fixed else None)
        self.sums = np.where(used, sums, self.sums)
        return np.asarray(sums.max(axis=(0, 1)))
