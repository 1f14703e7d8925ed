"""Record of a motor to fit: voltage, current and speed of one or several recordings in a row."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from motor_env.diagnosis.estimation.ekf import (
    BEGIN,
    FOUND,
    LOST,
    OPEN,
    REST,
    SWITCH,
    are_simple,
    predict_each,
    predict_simple_each,
    room_of_simple,
    room_to_work,
)
from motor_env.diagnosis.estimation.parameter_index import (
    AFTER,
    CURVE,
    DELAY,
    NOISE_I,
    OFFSET_I,
    ONSET,
    RISE,
    SOURCE,
    ZONE,
    R,
)
from motor_env.motor.parameters import FloatArray

Hold = Literal["held", "straight", "late"]
HOLDS: tuple[Hold, ...] = ("held", "straight", "late")
"""The voltage of a sample lasts until the next, runs straight to it, or has lasted since the one before."""
CURVE_PARTS = 5
"""Parts of a supply's rise of free shape."""
_OF_SUPPLY = np.r_[DELAY, ONSET, RISE, np.arange(CURVE.start, CURVE.stop)]
_SHORTEST = 1e-6  # of an interval: from a switch to the next sample
_ZONE_EDGE = 0.1  # width of a dead zone's edge (1 sd), of the zone
_DUST = 1e-9  # of the largest reading: steps of floating-point numbers
STRETCHES = 10


@dataclass(frozen=True, slots=True)
class Record:
    """Recordings of one motor in a row.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,); a guess where it is not known.
        readings: current and speed, shape (n, 2); zero where not recorded, NaN where a sample does not count.
        recorded: 1 where current, speed were recorded, shape (2,).
        marks: see `ekf.BEGIN`, shape (n,); a recording that begins is marked until all channels are read.
        hold: what the voltage does between two samples; in a start it changes once between them.
        averaged: number of samples whose mean is one sample here.
        share: of the recordings that is here, its liveliest stretches.
        onset_s: from the first sample to the step of a supply that is switched on once, about; None for any other.
        shunt_ohm: resistance in series with the motor.
        rectified_a: noise of a current sensor that shows none below 0; None for any other.
        beside: orthonormal shapes in the current that are fitted beside the motor, shape (n, m); None for none.
        brush_drop_v: voltage of the brushes by the motor's file: a fit allows for as much.
    """

    dt_s: float
    voltage_v: FloatArray
    readings: FloatArray
    recorded: FloatArray
    marks: FloatArray
    hold: Hold = "held"
    averaged: int = 1
    share: float = 1.0
    onset_s: float | None = None
    shunt_ohm: float = 0.0
    rectified_a: float | None = None
    beside: FloatArray | None = None
    brush_drop_v: float = 0.0

    @property
    def is_start(self) -> bool:
        """Whether the state at the first sample is known."""
        return bool(self.marks[0] >= REST)

    @property
    def begins(self) -> FloatArray:
        """1 at the first sample of each recording, shape (n,)."""
        return np.where(self.marks == BEGIN, 1.0, 0.0)

    @property
    def informative(self) -> NDArray[np.bool_]:
        """Whether a reading informs the fit, shape (n, 2): recorded, and not behind a hole of the voltage."""
        informative: NDArray[np.bool_] = np.isfinite(self.readings) & np.outer(
            (self.marks != LOST) & (self.marks != FOUND), self.recorded > 0.0
        )
        return informative

    @property
    def visible_step_share(self) -> float:
        """Share of the voltage's squared changes that no hole hides: these determine L and the hold."""
        if LOST not in self.marks:
            return 1.0
        changes = np.square(np.diff(self.voltage_v)) * (self.marks[1:] != BEGIN)
        return float(np.sum(changes[self.marks[1:] != LOST])) / max(float(np.sum(changes)), 1e-300)

    @property
    def count(self) -> int:
        """Number of `informative` readings, without those that a recording begins with."""
        return int(self.informative[self.marks != BEGIN].sum())

    @property
    def duration_s(self) -> float:
        """Length of all recordings together."""
        return len(self.voltage_v) * self.dt_s

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest voltage, current and speed, without outliers."""
        columns = (self.voltage_v, self.readings[:, 0], self.readings[:, 1])
        v, i, w = (float(np.nanquantile(np.abs(column), 0.999)) for column in columns)
        return v, i, w

    @property
    def steps(self) -> FloatArray:
        """Smallest step of current and speed, shape (2,); 0 where they never change."""
        moves = np.abs(np.diff(self.readings, axis=0, prepend=np.nan))
        moves[~(moves > _DUST * np.nanmax(np.abs(self.readings), axis=0, initial=0.0))] = np.inf
        least = moves.min(axis=0)
        return np.where(np.isfinite(least), least, 0.0)

    def between(self, delay: float = 0.0) -> FloatArray:
        """Return the voltage at begin and end of the interval that ends at each sample, shape (n, 2).

        Args:
            delay: of a start's voltage behind its log, in samples.
        """
        if self.is_start:
            whole = round(delay)
            at = np.clip(np.arange(len(self.voltage_v)) - whole, 0, len(self.voltage_v) - 1)
            mean = self.voltage_v[at]
            mean[1:] = mean[:-1] + (0.5 - (delay - whole)) * np.diff(mean)
            mean[0] = self.voltage_v[0]
            return np.stack([mean, mean], axis=1)
        now, before = self.voltage_v, np.append(self.voltage_v[:1], self.voltage_v[:-1])
        pairs = {"held": (before, before), "straight": (before, now), "late": (now, now)}
        return np.ascontiguousarray(np.stack(pairs[self.hold], axis=1))

    def supply(self, values: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the voltage over each interval, see `between`; marks; seconds from a switch to the next sample."""
        if self.onset_s is None:
            return self.between(float(values[DELAY])), self.marks, 0.0
        since = self.dt_s * np.arange(len(self.voltage_v)) - (self.onset_s + values[ONSET])
        first = int(np.searchsorted(since, 0.0, side="right"))
        marks, mean = self.marks.copy(), np.zeros(len(since))
        if first == len(since):
            return np.stack([mean, mean], axis=1), marks, 0.0
        marks[first] = SWITCH
        risen = max(int(np.searchsorted(since, values[RISE])), first) + 1
        ends = np.maximum(since[first:risen], _SHORTEST * self.dt_s)
        mean[first:] = self.voltage_v[first:]
        mean[first:risen] *= mean_rise(values, np.append(0.0, ends[:-1]), ends)
        return np.stack([mean, mean], axis=1), marks, float(ends[0])

    def predict(
        self, values: FloatArray, *, learn: bool = True, load: FloatArray | None = None
    ) -> tuple[FloatArray, float]:
        """Run the filter; return its table, see `ekf.predict_each`, and the sum of the innovations' log variances."""
        tables, logs = self.predict_each(values[None], learn=learn, load=load)
        return tables[0], float(logs[0])

    def predict_each(
        self, values: FloatArray, *, learn: bool = True, load: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Do `predict` for several vectors of values, shape (m, N_VALUES)."""
        out, p = np.zeros((len(values), len(self.voltage_v), 5)), values.copy()
        if load is not None:
            out[:, :, 4] += load
        p[:, R] += self.shunt_ohm + p[:, SOURCE]
        keys = [row[_OF_SUPPLY].tobytes() for row in p]
        supplies: dict[bytes, tuple[FloatArray, FloatArray, float]] = {}
        for key, row in zip(keys, p, strict=True):
            if key not in supplies:
                supplies[key] = self.supply(row)
            row[AFTER] = supplies[key][2]
        voltage, marks = (np.stack([each[n] for each in supplies.values()]) for n in (0, 1))
        which = np.array([list(supplies).index(key) for key in keys])
        logs, read = np.zeros(len(p)), (self.readings, self.recorded)
        if are_simple(p, marks):
            predict_simple_each(p, self.dt_s, voltage, marks, which, *read, out, logs, room_of_simple())
        else:
            reach = 1e-9 + np.abs(voltage).max((1, 2))
            predict_each(p, self.dt_s, voltage, marks, reach, which, *read, learn, out, logs, room_to_work())
        for row, table in zip(p, out, strict=True):
            if row[ZONE] > 0.0 or self.rectified_a is not None:
                self._hide(row, table)
        return out, logs

    def _hide(self, p: FloatArray, table: FloatArray) -> None:
        """Replace what a sensor with a dead zone, or none below 0, shows."""
        current, zone = table[:, 2] - p[OFFSET_I], p[ZONE]
        if zone > 0.0:
            # Nothing below the zone is shown and all above it; the commutation carries the current across its edge.
            current = current * ndtr((current - zone) / (_ZONE_EDGE * zone))
        if self.rectified_a is not None:
            current = rectified_mean(current, self.rectified_a)
        table[:, 2] = current + p[OFFSET_I]
        table[:, 0] = np.nan_to_num((self.readings[:, 0] - table[:, 2]) / p[NOISE_I])

    def closed(self) -> Record:
        """Return the record without open circuits."""
        return replace(self, marks=np.where(self.marks == OPEN, 0.0, self.marks))

    def sample(self, count: int) -> Record:
        """Return `count` of its samples in evenly spread stretches."""
        firsts = np.arange(STRETCHES) * (len(self.voltage_v) // STRETCHES)
        some = (firsts[:, None] + np.arange(count // STRETCHES)).ravel()
        marks, readings = self.marks[some], self.readings[some]
        marks[:: count // STRETCHES] = BEGIN
        marks = with_begins(marks, readings, self.recorded)
        return replace(self, voltage_v=self.voltage_v[some], readings=readings, marks=marks)

    def only(self, *, current: bool, speed: bool) -> Record:
        """Return the record with some of its channels."""
        return replace(self, recorded=self.recorded * np.array([current, speed], dtype=np.float64))


def with_begins(marks: FloatArray, readings: FloatArray, recorded: FloatArray) -> FloatArray:
    """Mark recordings as begun until the voltage is known and each channel is read twice."""
    marks = marks.copy()
    is_read: NDArray[np.bool_] = np.all(np.isfinite(readings[:, recorded > 0.0]), axis=1)
    known = is_read[:-1] & is_read[1:] & (marks[1:] != LOST)
    for begin in np.flatnonzero(marks == BEGIN).tolist():
        while begin < len(known) and not known[begin]:
            begin += 1
            marks[begin] = BEGIN
    return marks


def with_holes(
    marks: FloatArray, missing: NDArray[np.bool_], readings: FloatArray, recorded: FloatArray
) -> FloatArray:
    """Mark a record whose voltage has missing samples.

    It is unknown for two intervals before and after such a sample, as it may be held either way and come late. LOST
    lasts until each channel is read, FOUND until each is read once more.
    """
    unknown = np.pad(missing, 2)
    lost: NDArray[np.bool_] = unknown[:-4] | unknown[1:-3] | unknown[2:-2] | unknown[3:-1]
    marks, is_read = np.where(lost & (marks != BEGIN), LOST, marks), np.isfinite(readings) | (recorded == 0.0)
    for last in np.flatnonzero(lost & ~np.append(lost[1:], False)).tolist():
        k, waiting, mark = last, ~is_read[last], LOST
        while k + 1 < len(lost) and not lost[k + 1] and (waiting.any() or mark == LOST):
            k += 1
            if not waiting.any():
                waiting, mark = np.ones(2, dtype=np.bool_), FOUND
            if marks[k] != BEGIN:
                marks[k] = mark
            waiting &= ~is_read[k]
    return marks


def mean_rise(values: FloatArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Return the mean over intervals of a supply that rises to 1 in straight parts."""
    if values[RISE] <= 0.0:
        return np.ones_like(begin_s)
    shares = np.append(1.0, values[CURVE])
    times = values[RISE] * np.linspace(0.0, 1.0, CURVE_PARTS + 1)
    levels = np.append(0.0, np.cumsum(shares) / shares.sum())
    areas = np.append(0.0, np.cumsum(0.5 * (levels[1:] + levels[:-1]) * np.diff(times)))

    def integral(time_s: FloatArray) -> FloatArray:
        part = np.clip(np.searchsorted(times, time_s) - 1, 0, CURVE_PARTS - 1)
        since, level = time_s - times[part], levels[part]
        slope = (levels[part + 1] - level) / (times[1] - times[0])
        inside = areas[part] + level * since + 0.5 * slope * since**2
        beyond: FloatArray = np.where(time_s > times[-1], areas[-1] + time_s - times[-1], inside)
        return beyond

    mean: FloatArray = (integral(end_s) - integral(begin_s)) / (end_s - begin_s)
    return mean


def rectified_mean(current: FloatArray, noise_a: float) -> FloatArray:
    """Return the mean of max(i + noise, 0): what a sensor shows that cannot go below 0."""
    if noise_a <= 0.0:
        return np.maximum(current, 0.0)
    z = np.clip(current / noise_a, -40.0, 40.0)
    mean: FloatArray = current * ndtr(z) + noise_a * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return mean
