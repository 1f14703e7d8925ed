"""What is fitted: voltage, current and speed of one or several recordings of a motor at work, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr

from motor_env.fitting.kernel import BEGIN, OPEN, REST, SWITCH, predict_each
from motor_env.fitting.places import AFTER, CURVE, DELAY, NOISE_I, OFFSET_I, ONSET, RISE, ZONE, R
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut
from motor_env.recordings.regime import refuse_aliased
from motor_env.recordings.start import Circuit

Hold = Literal["held", "straight", "late"]
HOLDS: tuple[Hold, ...] = ("held", "straight", "late")
"""The voltage of a sample lasts until the next; runs in a straight line to it; or has lasted since the one before."""
CURVE_PARTS = 5
"""Parts of a supply's rise of free shape."""
_OF_SUPPLY = np.r_[DELAY, ONSET, RISE, np.arange(CURVE.start, CURVE.stop)]
_SHORTEST = 1e-6  # of an interval: from a switch to the next sample
_ZONE_EDGE = 0.1  # width of a dead zone's edge (1 sd), of the zone
FEWEST = 40
MOST = 10_000
_LOOKED_AT, _LOST, STRETCHES = 1_000_000, 0.02, 10
_SAME_DT = 0.02
_FEWEST_OPEN, _NO_CURRENT = 6, 0.95  # samples, and the share of them without current
_COASTS, _SLOWS, _ZERO = 0.02, 0.1, 0.003  # of the largest voltage, speed, current
_BESIDE_JUMP, _JUMP, _JUMP_NOISE = 5, 2.5, 6.0


@dataclass(frozen=True, slots=True)
class Record:
    """Recordings of one motor in a row.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,).
        readings: current and speed, shape (n, 2); zero where not recorded, NaN where a sample does not count.
        seen: 1 where current, speed were recorded, shape (2,).
        marks: `kernel.BEGIN` at the first sample of each recording, `kernel.OPEN` where the circuit is open; (n,). A
            start begins with `kernel.REST` or `kernel.STEADY`.
        hold: what the voltage does between two samples; in a start it changes once between them, in the middle where
            there is no delay.
        averaged: number of samples whose mean is one sample here.
        share: of the recordings that is here, its liveliest stretches.
        onset_s: from the first sample to the step of a supply that is switched on once, about; None for any other.
        shunt_ohm: resistance in series with the motor.
        rectified_a: noise of a current's sensor that shows none below 0; None for any other.
    """

    dt_s: float
    voltage_v: FloatArray
    readings: FloatArray
    seen: FloatArray
    marks: FloatArray
    hold: Hold = "held"
    averaged: int = 1
    share: float = 1.0
    onset_s: float | None = None
    shunt_ohm: float = 0.0
    rectified_a: float | None = None

    @property
    def is_start(self) -> bool:
        """Whether the state at the first sample is known."""
        return bool(self.marks[0] >= REST)

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
        v, i, w = (float(np.nanquantile(np.abs(column), 0.999)) for column in columns)
        return v, i, w

    def between(self, delay: float = 0.0) -> FloatArray:
        """Voltage at the begin and end of the interval that ends at each sample, shape (n, 2).

        Args:
            delay: how much later the voltage comes than it was logged, in samples, -1 .. 1.
        """
        if self.is_start:
            whole = round(delay)
            at = np.clip(np.arange(len(self.voltage_v)) - whole, 0, len(self.voltage_v) - 1)
            mean = self.voltage_v[at]
            mean[1:] = mean[:-1] + (0.5 - (delay - whole)) * np.diff(mean)
            mean[0] = self.voltage_v[0]
            return np.stack([mean, mean], axis=1)
        now, before = _shifted(self.voltage_v, delay), _shifted(self.voltage_v, 1.0 + delay)
        pairs = {"held": (before, before), "straight": (before, now), "late": (now, now)}
        return np.ascontiguousarray(np.stack(pairs[self.hold], axis=1))

    def supply(self, values: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Voltage over each interval, see `between`; marks; seconds from a switch to the sample after it."""
        if self.onset_s is None:
            return self.between(float(values[DELAY])), self.marks, 0.0
        since = self.dt_s * np.arange(len(self.voltage_v)) - (self.onset_s + values[ONSET])
        first = int(np.searchsorted(since, 0.0, side="right"))
        marks, mean = self.marks.copy(), np.zeros(len(since))
        if first == len(since):
            return np.stack([mean, mean], axis=1), marks, 0.0
        marks[first] = SWITCH
        ends = np.maximum(since[first:], _SHORTEST * self.dt_s)
        begins = np.append(0.0, ends[:-1])
        mean[first:] = self.voltage_v[first:] * mean_rise(values, begins, ends)
        return np.stack([mean, mean], axis=1), marks, float(ends[0])

    def predict(
        self, values: FloatArray, *, learn: bool = True, load: FloatArray | None = None
    ) -> tuple[FloatArray, float]:
        """Run the filter; its table (see `kernel.predict`) and the sum of the innovations' log variances."""
        out = np.zeros((1, len(self.voltage_v), 6))
        if load is not None:
            out[0, :, 4] = load
        return out[0], float(self._run(values[None], out, learn=learn)[0])

    def predict_each(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same for several vectors of values, shape (m, N_VALUES): tables, and the sums."""
        out = np.zeros((len(values), len(self.voltage_v), 6))
        return out, self._run(values, out, learn=True)

    def _run(self, values: FloatArray, out: FloatArray, *, learn: bool) -> FloatArray:
        p, which = values.copy(), []
        supplies: list[tuple[FloatArray, FloatArray, float]] = []
        p[:, R] += self.shunt_ohm
        known: dict[bytes, int] = {}
        for one in p:
            key = one[_OF_SUPPLY].tobytes()
            if key not in known:
                known[key] = len(supplies)
                supplies.append(self.supply(one))
            which.append(known[key])
            one[AFTER] = supplies[known[key]][2]
        voltage, marks = (np.stack([each[n] for each in supplies]) for n in (0, 1))
        logs: FloatArray = predict_each(
            p, self.dt_s, voltage, marks, np.array(which), self.readings, self.seen, learn, out
        )
        for one, table in zip(p, out, strict=True):
            if one[ZONE] > 0.0 or self.rectified_a is not None:
                self._hide(one, table)
        return logs

    def _hide(self, p: FloatArray, table: FloatArray) -> None:
        """What a sensor shows that has a dead zone or no current below 0."""
        current, zone = table[:, 2] - p[OFFSET_I], p[ZONE]
        if zone > 0.0:
            # Nothing below the zone is shown and all above it; the commutation carries the current across its edge.
            current = current * ndtr((current - zone) / (_ZONE_EDGE * zone))
        if self.rectified_a is not None:
            current = rectified_mean(current, self.rectified_a)
        table[:, 2] = current + p[OFFSET_I]
        table[:, 0] = np.nan_to_num((self.readings[:, 0] - table[:, 2]) / p[NOISE_I])

    def closed(self) -> Record:
        """The same without open circuits."""
        return replace(self, marks=np.where(self.marks == OPEN, 0.0, self.marks))

    def sample(self, count: int) -> Record:
        """So many of its samples: stretches of equal length, evenly spread."""
        begins = np.arange(STRETCHES) * (len(self.voltage_v) // STRETCHES)
        some = (begins[:, None] + np.arange(count // STRETCHES)).ravel()
        marks = self.marks[some]
        marks[:: count // STRETCHES] = BEGIN
        return replace(self, voltage_v=self.voltage_v[some], readings=self.readings[some], marks=marks)

    def part(self, first: int, count: int) -> Record:
        """So many of its samples from one on, as a recording of its own."""
        some = slice(first, first + count)
        marks = self.marks[some].copy()
        marks[0] = BEGIN
        return replace(self, voltage_v=self.voltage_v[some], readings=self.readings[some], marks=marks)

    def only(self, *, current: bool, speed: bool) -> Record:
        """The same with some of the channels."""
        return replace(self, seen=self.seen * np.array([current, speed], dtype=np.float64))


def mean_rise(values: FloatArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Mean over the intervals [begin, end] of a supply that rises to 1, part by part in straight lines."""
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
    """Mean of max(i + noise, 0): what a sensor shows that cannot go below 0."""
    if noise_a <= 0.0:
        return np.maximum(current, 0.0)
    z = np.clip(current / noise_a, -40.0, 40.0)
    mean: FloatArray = current * ndtr(z) + noise_a * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return mean


def joined(parts: Sequence[Record]) -> Record:
    """Records in a row, which are alike in all but their samples."""
    columns = [(part.voltage_v, part.readings, part.marks) for part in parts]
    voltage_v, readings, marks = (np.concatenate(column) for column in zip(*columns, strict=True))
    return replace(parts[0], voltage_v=voltage_v, readings=readings, marks=marks)


def _shifted(values: FloatArray, samples: float) -> FloatArray:
    """Values as they were so many samples, or parts of one, before."""
    places = np.arange(len(values), dtype=np.float64)
    shifted: FloatArray = values if samples == 0.0 else np.interp(places - samples, places, values)
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
    steps = np.array([recording.dt_s for recording in recordings])
    if np.ptp(steps) > _SAME_DT * steps.mean():
        raise UnusableError("the recordings differ in their sampling interval: identify them one by one")
    whole = [at_terminals(recording, voltage_v) for recording in recordings]
    if len({_seen(recording) for recording in whole}) > 1:
        raise UnusableError("the recordings hold different columns: identify them one by one")
    wanted = max(math.ceil(sum(len(recording.time_s) for recording in whole) / most), 1)
    factor = min(_averageable(whole[0], wanted), wanted)
    share = 1.0
    if factor < wanted:
        share = most * factor / sum(len(recording.time_s) for recording in whole)
        count = math.ceil(STRETCHES / len(whole))
        whole = [part for recording in whole for part in liveliest(recording, share, count)]
    parts = [_columns(recording) for recording in whole]
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
        begins = np.where(open_circuit(volts, readings, begins) & (begins == 0.0), OPEN, begins)
    return Record(
        dt_s=float(steps.mean()) * factor,
        voltage_v=volts,
        readings=readings,
        seen=seen,
        marks=begins,
        hold="held" if factor * recordings[0].averaged == 1 else "straight",
        averaged=factor * recordings[0].averaged,
        share=share,
    )


def open_circuit(voltage_v: FloatArray, readings: FloatArray, begins: FloatArray) -> NDArray[np.bool_]:
    """Where a motor coasts with an open circuit, shape (n,).

    The voltage jumps where the circuit opens and where it closes. A diode may carry the current until it is gone. Then
    there is none, and the voltage at the terminals moves with the speed, not by steps; or the voltage is recorded as
    none, and the speed moves. Without a recorded speed a motor that stands counts as well, to which it is all one.
    """
    current, peak = readings[:, 0], float(np.quantile(np.abs(voltage_v), 0.999))
    noise, largest = noise_of(current), float(np.quantile(np.abs(current), 0.99))
    none = np.abs(current) < 3.0 * noise + 0.01 * largest
    edges = np.union1d(np.flatnonzero(_jumps(voltage_v) | (begins > 0.0)), [0, len(current)])
    out = np.zeros(len(current), dtype=np.bool_)
    fastest = float(np.quantile(np.abs(readings[:, 1]), 0.99))
    for jump, last in pairwise(edges.tolist()):
        # Where the circuit closes at the voltage that the motor has, only the current shows it.
        back = np.append(np.flatnonzero(~none[jump : last - 1] & ~none[jump + 1 : last]), 0)[0]
        end = jump + int(back) if back >= _FEWEST_OPEN else last
        is_off = float(np.abs(voltage_v[jump:end]).max()) < _COASTS * peak
        first = jump + int(np.argmax(none[jump:end]))
        if not is_off or (current[jump:first] * current[jump - 1] <= 0.0).any():  # no diode
            first = jump
        n, shown = end - first, current[first:end]
        if n < _FEWEST_OPEN or float(np.mean(none[first:end])) < _NO_CURRENT:
            continue
        is_none = abs(float(shown.mean())) < 3.5 * noise / math.sqrt(n) + _ZERO * largest
        is_noise = float(shown.std()) < noise * (1.0 + 3.0 / math.sqrt(n))
        volts, speed = voltage_v[first:end], readings[first:end, 1]
        slows = np.ptp(speed) > _SLOWS * fastest if fastest > 0.0 else begins[jump] == 0.0
        falls = slows if is_off else np.ptp(volts) > max(_COASTS * peak, 2.0 * np.abs(np.diff(volts)).max())
        if is_none and is_noise and falls:
            out[first:end] = True
            if end < len(current) and begins[end] == 0.0:
                out[end] = none[end]  # the current has not risen yet where the circuit has just closed
    return out


def _jumps(voltage_v: FloatArray) -> NDArray[np.bool_]:
    """Samples at which the voltage has moved much more than it does before and after, shape (n,)."""
    moved = np.abs(np.diff(voltage_v, prepend=voltage_v[0]))
    beside = _BESIDE_JUMP
    medians = np.median(sliding_window_view(np.pad(moved, beside, mode="edge"), beside), axis=1)
    usual = np.maximum(medians[: len(moved)], medians[-len(moved) :])
    found: NDArray[np.bool_] = (moved > _JUMP * usual) & (moved > _JUMP_NOISE * noise_of(voltage_v))
    return found


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


def _averageable(recording: Recording, wanted: int) -> int:
    """Number of neighbours whose means keep nearly all that the current, beyond its noise, or the speed tells."""
    column = (
        recording.current_a if _seen(recording)[0] or recording.speed_rad_s is None else recording.speed_rad_s
    )
    column, factor = column[:_LOOKED_AT], 1
    noise, variance = (noise_of(column) ** 2, float(np.var(column))) if wanted > 1 else (0.0, 0.0)
    while factor < wanted:
        kept = float(np.var(block_means(column, 2 * factor))) + noise * (1.0 - 0.5 / factor)
        if kept < (1.0 - _LOST) * variance:
            break
        factor *= 2
    return factor


def liveliest(recording: Recording, share: float, count: int = STRETCHES) -> list[Recording]:
    """A share of a recording: of each of some equal parts the stretch in which the voltage moves most."""
    n = len(recording.time_s)
    volts = recording.current_a if recording.voltage_v is None else recording.voltage_v
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(volts)))])
    part, length, found = n // count, int(share * n / count), []
    for first in range(0, part * count, part):
        ends = moved[first + length : first + part] - moved[first : first + part - length]
        begin = first + int(np.argmax(ends))
        found.append(cut(recording, slice(begin, begin + length)))
    return found


def _seen(recording: Recording) -> tuple[bool, bool]:
    """Whether current and speed were recorded: a channel that never moves counts as not recorded."""
    speed = recording.speed_rad_s
    return float(np.ptp(recording.current_a)) > 0.0, speed is not None and float(np.ptp(speed)) > 0.0


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
    """Voltage, current, speed."""
    voltage, (has_current, has_speed) = recording.voltage_v, _seen(recording)
    if voltage is None:
        raise UnusableError("a motor at work can be identified only where the voltage was recorded")
    if float(np.ptp(voltage)) == 0.0 and not has_current:
        raise UnusableError("neither voltage nor current ever changes")
    if not has_current and not has_speed:
        raise UnusableError("neither the current nor the speed ever changes")
    if has_current:
        refuse_aliased(voltage, recording.current_a)
    return voltage, recording.current_a if has_current else None, recording.speed_rad_s if has_speed else None
