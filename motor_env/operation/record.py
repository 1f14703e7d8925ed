"""What is fitted: voltage, current and speed of one or several recordings of a motor at work, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import FloatArray
from motor_env.operation.kernel import BEGIN, DELAY, OPEN, predict
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording
from motor_env.recordings.start import Circuit

Hold = Literal["held", "straight", "late"]
HOLDS: tuple[Hold, ...] = ("held", "straight", "late")
"""The voltage of a sample lasts until the next; runs in a straight line to it; or has lasted since the one before."""
FEWEST = 40
MOST = 60_000
_SAME_DT = 0.02
_FEWEST_OPEN = 8
_COASTS = 0.1


@dataclass(frozen=True, slots=True)
class Record:
    """Recordings of one motor in a row.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,).
        readings: current and speed, shape (n, 2); zero where not recorded.
        seen: 1 where current, speed were recorded, shape (2,).
        marks: `kernel.BEGIN` at the first sample of each recording, `kernel.OPEN` where the circuit is open; (n,).
        hold: what the voltage does between two samples.
        averaged: number of samples whose mean is one sample here.
    """

    dt_s: float
    voltage_v: FloatArray
    readings: FloatArray
    seen: FloatArray
    marks: FloatArray
    hold: Hold = "held"
    averaged: int = 1

    @property
    def begins(self) -> FloatArray:
        """1 at the first sample of each recording, shape (n,)."""
        return np.where(self.marks == BEGIN, 1.0, 0.0)

    @property
    def duration_s(self) -> float:
        """Length of all recordings together."""
        return len(self.voltage_v) * self.dt_s

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest voltage, current and speed, wild samples left out."""
        columns = (self.voltage_v, self.readings[:, 0], self.readings[:, 1])
        v, i, w = (float(np.quantile(np.abs(column), 0.999)) for column in columns)
        return v, i, w

    def between(self, delay: float = 0.0) -> FloatArray:
        """Voltage at the begin and end of the interval that ends at each sample, shape (n, 2).

        Args:
            delay: how much later the voltage comes than it was logged, in samples, -1 .. 1.
        """
        now, before = _shifted(self.voltage_v, delay), _shifted(self.voltage_v, 1.0 + delay)
        pairs = {"held": (before, before), "straight": (before, now), "late": (now, now)}
        return np.ascontiguousarray(np.stack(pairs[self.hold], axis=1))

    def predict(
        self, values: FloatArray, *, learn: bool = True, load: FloatArray | None = None
    ) -> tuple[FloatArray, float]:
        """Run the filter; its table (see `kernel.predict`) and the sum of the innovations' log variances."""
        out = np.zeros((len(self.voltage_v), 6))
        if load is not None:
            out[:, 4] = load
        voltage = self.between(float(values[DELAY]))
        logs = predict(values, self.dt_s, voltage, self.readings, self.seen, self.marks, learn, out)
        return out, logs

    def only(self, *, current: bool, speed: bool) -> Record:
        """The same with some of the channels."""
        return replace(self, seen=self.seen * np.array([current, speed], dtype=np.float64))


def _shifted(values: FloatArray, samples: float) -> FloatArray:
    """Values as they were so many samples, or parts of one, before."""
    places = np.arange(len(values)) - samples
    shifted: FloatArray = np.interp(places, np.arange(len(values)), values)
    return shifted


def from_recordings(
    recordings: Sequence[Recording], *, voltage_v: float | None = None, most: int = MOST
) -> Record:
    """Recordings of one motor as one record, averaged where they hold more samples than are needed.

    Args:
        recordings: of one motor, with the same columns and the same sampling interval.
        voltage_v: supply, for a voltage that was recorded as a duty cycle.
        most: number of samples beyond which neighbours are averaged.

    Raises:
        UnusableError: no voltage, neither current nor speed, other columns or sampling from one to the next.
    """
    parts = [_columns(at_terminals(recording, voltage_v)) for recording in recordings]
    steps = np.array([recording.dt_s for recording in recordings])
    if np.ptp(steps) > _SAME_DT * steps.mean():
        raise UnusableError("the recordings differ in their sampling interval: identify them one by one")
    if len({(part[1] is None, part[2] is None) for part in parts}) > 1:
        raise UnusableError("the recordings hold different columns: identify them one by one")
    factor = max(math.ceil(sum(len(part[0]) for part in parts) / most), 1)
    columns: list[list[FloatArray]] = [[], [], [], []]
    for part in parts:
        voltage = block_means(part[0], factor)
        columns[0].append(voltage)
        for place in (1, 2):
            column = part[place]
            columns[place].append(np.zeros(len(voltage)) if column is None else block_means(column, factor))
        columns[3].append(np.eye(1, len(voltage))[0])
    volts, current, speed, begins = (np.concatenate(each) for each in columns)
    seen = np.array([float(parts[0][1] is not None), float(parts[0][2] is not None)])
    if len(volts) < FEWEST:
        raise UnusableError(f"only {len(volts)} samples; at least {FEWEST} are needed")
    readings = np.ascontiguousarray(np.stack([current, speed], axis=1))
    if seen[0]:
        begins = np.where(open_circuit(volts, readings) & (begins == 0.0), OPEN, begins)
    return Record(
        dt_s=float(steps.mean()) * factor,
        voltage_v=volts,
        readings=readings,
        seen=seen,
        marks=begins,
        hold="held" if factor == 1 else "straight",
        averaged=factor,
    )


def open_circuit(voltage_v: FloatArray, readings: FloatArray) -> NDArray[np.bool_]:
    """Where a motor coasts with an open circuit: no current for a while, though speed or voltage fall, shape (n,)."""
    current, moving = readings[:, 0], readings[:, 1] if readings[:, 1].any() else voltage_v
    slack = 0.01 * float(np.quantile(np.abs(current), 0.99)) + 3.0 * noise_of(current)
    none = np.concatenate([[False], np.abs(current) < slack, [False]])
    edges = np.flatnonzero(np.diff(none.astype(int)))
    out = np.zeros(len(current), dtype=np.bool_)
    least = _COASTS * float(np.quantile(np.abs(moving), 0.99))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        falls = abs(moving[first]) - abs(moving[end - 1]) > least
        if end - first >= _FEWEST_OPEN and falls and abs(float(current[first:end].mean())) < 0.5 * slack:
            out[first:end] = True
    return out


def noise_of(column: FloatArray) -> float:
    """Standard deviation of white noise: the median second difference, no less than a converter's step."""
    second, moved = np.abs(np.diff(column, 2)), np.abs(np.diff(column))
    steps = moved[moved > 0.0]
    quantum = float(np.min(steps)) / math.sqrt(12.0) if len(steps) else 0.0
    largest = float(np.max(np.abs(column)))
    white = 1.4826 * float(np.median(second)) / math.sqrt(6.0)
    return max(white, min(quantum, 0.02 * largest), 1e-6 * largest, 1e-12)


def block_means(values: FloatArray, factor: int) -> FloatArray:
    """Means of neighbours, the last incomplete block left out."""
    if factor == 1:
        return values
    whole = len(values) // factor * factor
    means: FloatArray = values[:whole].reshape(-1, factor).mean(axis=1)
    return means


def at_terminals(
    recording: Recording, voltage_v: float | None = None, circuit: Circuit | None = None
) -> Recording:
    """The recording with the voltage at the motor's terminals: a duty cycle in volts, what is in series taken off."""
    voltage = recording.voltage_v
    if voltage is None and recording.duty is not None and voltage_v is not None:
        voltage = recording.duty * voltage_v
    if voltage is not None and circuit is not None:
        voltage = voltage - circuit.shunt_ohm * recording.current_a
    return replace(recording, voltage_v=voltage)


def _columns(recording: Recording) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """Voltage, current, speed; a channel that never moves counts as not recorded."""
    voltage = recording.voltage_v
    if voltage is None:
        raise UnusableError("a motor at work can be identified only where the voltage was recorded")
    if float(np.ptp(voltage)) == 0.0 and float(np.ptp(recording.current_a)) == 0.0:
        raise UnusableError("neither voltage nor current ever changes")
    current = recording.current_a if float(np.ptp(recording.current_a)) > 0.0 else None
    speed = recording.speed_rad_s
    if speed is not None and float(np.ptp(speed)) == 0.0:
        speed = None
    if current is None and speed is None:
        raise UnusableError("neither the current nor the speed ever changes")
    return voltage, current, speed
