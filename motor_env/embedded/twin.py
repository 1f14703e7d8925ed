"""The twin of the C source: the same operations in the same order, on NumPy's floats or integers."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.embedded.arithmetic import LARGEST, STATISTIC_BITS, Numbers, Values
from motor_env.motor.parameters import require


class SampleVerdict(IntEnum):
    """Verdict of a sample, with the number that it has in C."""

    HEALTHY = 0
    FAULT = 1
    SENSOR_STUCK = 2
    SENSOR_RANGE = 3


class Answers(NamedTuple):
    """Verdict and statistic after each sample, shape (n_cases, n_samples); the statistic as C counts it."""

    verdict: NDArray[np.int64]
    statistic: Values


def readings_of(numbers: Numbers, measurements: ArrayLike, voltage_v: ArrayLike) -> Values:
    """What the controller reads: measurements (n_cases, m, n_samples) and voltage (n_samples,) as floats or counts.

    Returns:
        Shape (n_cases, m + 1, n_samples): current, speed where measured, voltage.
    """
    measured = np.asarray(measurements, dtype=np.float64)
    voltage = np.broadcast_to(np.asarray(voltage_v, dtype=np.float64), (len(measured), measured.shape[2]))
    columns = np.concatenate([measured, voltage[:, None]], axis=1)
    sizes = np.array([*numbers.readings[: numbers.n_channels], numbers.readings.voltage_v])[:, None]
    counts = columns / sizes
    readings: Values = (np.rint(counts) if numbers.dtype == np.int64 else counts).astype(numbers.dtype)
    return readings


def answers(numbers: Numbers, readings: Values) -> Answers:
    """Run a monitor from its begin over the readings of many motors, as `readings_of` gives them."""
    n_cases, columns, n_samples = readings.shape
    m = numbers.n_channels
    require(columns == m + 1, f"readings must have {m + 1} columns, got {columns}")
    twin = _Twin(numbers, n_cases)
    verdict = np.empty((n_cases, n_samples), dtype=np.int64)
    statistic = np.empty((n_cases, n_samples), dtype=numbers.dtype)
    for k in range(n_samples):
        verdict[:, k] = twin.step(readings[:, :m, k], readings[:, m, k])
        statistic[:, k] = twin.statistic
    return Answers(verdict, statistic)


class _Twin:
    def __init__(self, numbers: Numbers, n_cases: int) -> None:
        self.numbers, self.sample = numbers, 0
        self.state = np.zeros((2, n_cases), numbers.dtype)
        self.lost = np.zeros_like(self.state)
        self.voltage, self.statistic = (np.zeros(n_cases, numbers.dtype) for _ in range(2))
        self.slow = np.zeros_like(self.state)
        self.sums = np.zeros((2, len(numbers.halves), n_cases), numbers.dtype)
        self.last = np.zeros((n_cases, numbers.n_channels), numbers.dtype)
        self.same = np.zeros((n_cases, numbers.n_channels), np.int64)

    def step(self, measured: Values, voltage: Values) -> NDArray[np.int64]:
        numbers, m = self.numbers, self.numbers.n_channels
        wrong = ~(np.abs(measured) <= numbers.ranges[:m]).all(axis=1) | ~(
            np.abs(voltage) <= numbers.ranges[2]
        )
        self.voltage = np.where(
            np.abs(voltage) <= numbers.ranges[2], voltage * numbers.scales[2], self.voltage
        )
        again = (measured == self.last) & (self.voltage != 0)[:, None]
        self.same = np.where(again, np.minimum(self.same + 1, numbers.stuck_after), 0)
        self.last = measured
        stuck = (self.same == numbers.stuck_after).any(axis=1)
        used = ~(wrong | stuck)
        growth = self._growth()
        forward = self._forward(growth)
        scaled = measured * np.array(numbers.scales[:m], numbers.dtype)
        innovation = [scaled[:, c] - self.state[c] - growth[c] for c in range(m)]
        correction = np.array([row.total(self.sample, innovation) for row in numbers.gain])
        self._add(np.where(used, growth + correction, growth))
        white = np.array([row.total(self.sample, innovation) for row in numbers.white])
        self._decide(white, forward, used)
        self.sample += 1
        fault = np.where(self.statistic > numbers.threshold, SampleVerdict.FAULT, SampleVerdict.HEALTHY)
        sensor = np.where(wrong, SampleVerdict.SENSOR_RANGE, SampleVerdict.SENSOR_STUCK)
        return np.where(used, fault, sensor)

    def _growth(self) -> Values:
        numbers = self.numbers
        current, speed, slow = *self.state, numbers.drag[2]
        direction = (speed > slow).astype(numbers.dtype) - (speed < -slow).astype(numbers.dtype)
        totals = [row.total(self.sample, (current, speed, self.voltage)) for row in numbers.model]
        return np.array([total - direction * part for total, part in zip(totals, numbers.drag, strict=False)])

    def _add(self, growth: Values) -> None:
        if self.numbers.dtype == np.int64:
            self.state = np.clip(self.state + growth, -LARGEST, LARGEST)
            return
        rest = growth - self.lost
        after = self.state + rest
        self.lost = (after - self.state) - rest
        self.state = after

    def _forward(self, growth: Values) -> Values:
        """Whose signs the innovation is taken with, for windings and for friction."""
        numbers, predicted = self.numbers, self.state + growth
        if numbers.dtype == np.int64:
            predicted = np.clip(predicted, -LARGEST, LARGEST)
            self.slow = self.slow + ((predicted - self.slow) >> numbers.memory)
        else:
            share = np.asarray(2.0**-numbers.memory, numbers.dtype)
            self.slow = self.slow + (predicted - self.slow) * share
        return np.array([predicted[0] - self.slow[0], self.slow[1]])

    def _decide(self, white: Values, forward: Values, used: NDArray[np.bool_]) -> None:
        numbers, is_fixed = self.numbers, self.numbers.dtype == np.int64
        if numbers.halves.size:
            sign = np.repeat(forward[::-1], [numbers.n_friction, len(white) - numbers.n_friction], axis=0)
            signed = np.where(sign < 0, -white, white)
            moved = self.sums + np.array([signed, -signed]) - numbers.halves[:, None]
            sums = np.clip(moved, 0, LARGEST if is_fixed else None)
            self.sums = np.where(used, sums, self.sums)
            statistic = sums.max(axis=(0, 1))
        else:
            squares = white * white
            if is_fixed:
                squares = np.minimum((squares + (1 << (STATISTIC_BITS - 1))) >> STATISTIC_BITS, LARGEST)
            statistic = np.add.reduce(squares)
        self.statistic = np.where(used, statistic, self.statistic)
