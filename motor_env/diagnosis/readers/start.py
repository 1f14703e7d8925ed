"""Starts of a recording: cut apart, turned and aligned, with what is known of supply and sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.alignment import Alignment, align
from motor_env.diagnosis.readers.noise import (
    FEW,
    PeriodicLine,
    hum_frequencies,
    outlier_samples,
    waves,
    without_outliers,
)
from motor_env.diagnosis.readers.recording import Recording, UnusableError, cut, stretches
from motor_env.diagnosis.readers.regime import BOUNCE_S
from motor_env.motor.parameters import FloatArray

_FEWEST_AFTER = 15
_HIGH, _LOW = 0.5, 0.25
_FEWEST = 3  # samples
_CUT = 0.5  # of the median time under voltage
_MOVING = 2.0  # times the largest deviation at rest
_WILD = 5  # samples of a long recording that may lie above all that counts
OFF = 0.05  # of the largest voltage
_BLOCKS = 50  # of the running motor's samples
_NOISE, _SPAN = 4.0, 0.002  # standard deviations, and of the largest current: so close to rest it rests
_ABRUPT = 3.0  # times that: a current that is switched off comes from further away
_BRAKED = 0.25  # of the largest current, against it: no undershoot goes so far
MOST_STARTS = 200
_CLEAR = 6.0  # -2 log likelihood


@dataclass(frozen=True, slots=True)
class Circuit:
    """Measuring circuit, as far as the user knows it.

    Attributes:
        shunt_ohm: resistance of shunt and leads in series with the motor, which is not the motor's.
        sensor_lag_s: time constant of the current sensor; it is not fitted then.
    """

    shunt_ohm: float = 0.0
    sensor_lag_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Start:
    """One start to fit, turned so that its current is positive.

    Attributes:
        time_s: shape (n_samples,).
        current_a: shape (n_samples,).
        speed_rad_s: shape (n_samples,), or None.
        voltage_v: measured voltage, shape (n_samples,), or None for a step.
        level_v: level of the step; 1 where the voltage is unknown (everything is then per volt).
        voltage_known: whether volts are volts.
        alignment: onset and quiet part.
        from_rest: whether the motor stands before; else it runs steadily under the first voltage.
        circuit: the measuring circuit.
        lines: ripple of the supply in the running motor's current.
        hum_hz: frequencies of the mains in the current: where of the supply, from the onset on.
        is_hum_of_supply: whether they are the supply's, else the probe's.
        is_coupled: whether the probe is coupled by a capacitor.
        sizes: of the shapes beside the motor.
        missing: which samples of current and speed are missing, shape (n_samples, 2); None for none.
    """

    time_s: FloatArray
    current_a: FloatArray
    speed_rad_s: FloatArray | None
    voltage_v: FloatArray | None
    level_v: float
    voltage_known: bool
    alignment: Alignment
    from_rest: bool = True
    circuit: Circuit = Circuit()
    lines: tuple[PeriodicLine, ...] = ()
    hum_hz: tuple[float, ...] = ()
    is_hum_of_supply: bool = False
    is_coupled: bool = False
    sizes: tuple[float, ...] = ()
    missing: NDArray[np.bool_] | None = None

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Samples of the current that count, shape (n_samples,): neither outliers nor missing."""
        out = np.ones(len(self.time_s), dtype=np.bool_) if self.missing is None else ~self.missing[:, 0]
        out[[k for k in self.alignment.wild if k < len(out)]] = False
        return out

    @property
    def charge_a_s(self) -> FloatArray:
        """Integral of the shown current, shape (n_samples,): a capacitor takes it off over its time constant."""
        return np.asarray(np.cumsum(self.current_a - self.alignment.offset_a) * self.dt_s)

    @property
    def beside(self) -> FloatArray:
        """Shapes that are fitted beside the motor, shape (n_samples, m): hum, and what a capacitor takes off.

        That is the charge, and a ramp: the charge of an error of the offset.
        """
        hum = waves(self.time_s, self.hum_hz)
        hum[: self.alignment.onset_index * self.is_hum_of_supply] = 0.0
        return np.column_stack([hum, self.time_s, -self.charge_a_s]) if self.is_coupled else hum

    def with_hum(self, hum_hz: tuple[float, ...], residual_a: FloatArray) -> Start:
        """Return the start with hum, by what else leaves of the current, shape (n_samples,)."""
        shapes, begin = waves(self.time_s, hum_hz), self.alignment.onset_index
        sizes = np.linalg.lstsq(shapes[begin:], residual_a[begin:])[0]
        quiet, rest = residual_a[:begin], (residual_a - shapes @ sizes)[:begin]
        of_supply = begin >= FEW and bool(np.var(rest) > (1.0 + _CLEAR / begin) * np.var(quiet))
        sizes_of_all = (*sizes.tolist(), *self.sizes[2 * len(self.hum_hz) :])
        return replace(self, hum_hz=hum_hz, sizes=sizes_of_all, is_hum_of_supply=of_supply)

    @property
    def ripple_a(self) -> FloatArray:
        """Current of the lines, from the onset on, and of the shapes beside the motor, shape (n_samples,)."""
        out: FloatArray = self.beside @ np.array(self.sizes)
        running = self.time_s >= self.alignment.onset_s
        for line in self.lines:
            out[running] += line.current_a(self.time_s[running])
        return out

    def shortened(self, count: int) -> Start:
        """Return the start with at most `count` samples after its onset."""
        return cut(self, slice(self.alignment.onset_index + count))


def prepare(recording: Recording, voltage_v: float | None = None, circuit: Circuit | None = None) -> Start:
    """Align a recording, leave out what follows the end of its supply, and find its voltage.

    Args:
        recording: as read.
        voltage_v: level of the supply, for a recording without a voltage.
        circuit: the measuring circuit.

    Raises:
        UnusableError: no start, or too few samples after it; a shunt without a known voltage; a voltage that is on
            before the recording begins; missing samples where voltage or current rise.
    """
    missing, end = recording.missing, len(recording.time_s)
    hum_hz = hum_frequencies(recording.current_a, recording.time_s, np.ones((end, 1)))
    shapes = np.column_stack([waves(recording.time_s, hum_hz), np.ones(end)])
    hum = shapes[:, :-1] @ np.linalg.lstsq(shapes, recording.current_a)[0][:-1]
    bare = replace(recording, current_a=recording.current_a - hum)
    try:
        alignment = align(bare)
        end = end_of_supply(bare, alignment)
    except UnusableError:
        if not hum_hz:
            raise
        alignment = align(recording)  # nothing but hum: the fit will say so
    if end < len(recording.time_s) and end - alignment.onset_index >= _FEWEST_AFTER:
        return prepare(cut(recording, slice(end)), voltage_v, circuit)
    sign, after = alignment.sign, len(recording.time_s) - alignment.onset_index
    if missing is not None:
        after -= int(missing[alignment.onset_index :, 1].sum())
        _refuse_lost_onset(missing[:, 1], alignment.onset_index)
    if after < _FEWEST_AFTER:
        raise UnusableError(f"only {after} samples follow the start; at least {_FEWEST_AFTER} are needed")
    supply, measured, level = recording.voltage_v, None, 1.0 if voltage_v is None else abs(voltage_v)
    known = supply is not None or voltage_v is not None
    if supply is None and recording.duty is not None:
        supply = level * recording.duty
    if supply is not None:
        level, measured, sign = _supply(supply, sign, None if missing is None else missing[:, 0])
    if circuit is not None and circuit.shunt_ohm > 0.0 and not known:
        raise UnusableError("a shunt in series can be subtracted only where the voltage is known")
    speed = None
    if recording.speed_rad_s is not None and np.ptp(recording.speed_rad_s) > 0.0:
        speed = recording.speed_rad_s * (1.0 if mean_tail(recording.speed_rad_s) >= 0.0 else -1.0)
    from_rest = measured is None or abs(float(measured[0])) < OFF * float(np.max(np.abs(measured)))
    alignment = replace(alignment, sign=sign, offset_a=sign * alignment.offset_a)
    if measured is not None and not from_rest:
        _refuse_begun(sign * recording.current_a, measured)
        alignment = replace(alignment, offset_a=0.0, n_quiet=0)
    current = sign * recording.current_a
    start = Start(
        recording.time_s,
        current,
        speed,
        measured,
        level,
        known,
        alignment,
        from_rest,
        circuit or Circuit(),
        missing=None if missing is None else missing[:, 1:],
    )
    return start.with_hum(hum_hz, current - current.mean()) if hum_hz else start


def mean_tail(values: FloatArray) -> float:
    """Return the mean of the last tenth."""
    return float(np.mean(values[-max(len(values) // 10, 1) :]))


def _supply(
    voltage: FloatArray, sign: float, missing: NDArray[np.bool_] | None
) -> tuple[float, FloatArray | None, float]:
    """Return the level of a commanded step, or the measured curve: a command takes at most two values."""
    levels = np.unique(voltage if missing is None else voltage[~missing])
    tail = float(np.median(voltage[-max(len(voltage) // 4, 1) :]))
    if len(levels) == 1 or (len(levels) == 2 and 0.0 in levels):
        if tail == 0.0:
            raise UnusableError("the voltage is 0 at the end: this is no start under voltage")
        return abs(tail), None, sign
    # An even square wave has the median 0.
    largest = float(np.max(np.abs(voltage)))
    if missing is not None and missing.any():
        _refuse_lost_rise(voltage, missing, largest)
    return abs(tail) if abs(tail) > OFF * largest else largest, voltage, 1.0


def _refuse_begun(current: FloatArray, voltage: FloatArray) -> None:
    """Refuse a start that began before its recording: its voltage is on at once, and the current does not follow."""
    peak = int(np.argmax(np.abs(current - current[0])))
    moved = np.sign(current[peak] - current[0]) * (voltage[: peak + 1] - voltage[0])
    if moved.max() < OFF * np.max(np.abs(voltage)):
        raise UnusableError(
            f"the voltage is {voltage[0]:.3g} V in the first sample already: record from at least 1 ms before the"
            " motor is switched on"
        )


def _refuse_lost_onset(missing: NDArray[np.bool_], onset: int) -> None:
    """Refuse a hole of several samples where the current begins to rise: it hides the onset and L."""
    for first, end in zip(*stretches(missing), strict=True):
        if first - 1 <= onset <= end and end - first > 1:
            raise UnusableError(
                f"{end - first} samples of the current are missing where it begins to rise: when it did is not known"
            )


def _refuse_lost_rise(voltage: FloatArray, missing: NDArray[np.bool_], largest: float) -> None:
    """Refuse a measured voltage with a hole in which it changes."""
    firsts, ends = stretches(missing)
    before, after = np.maximum(firsts - 1, 0), np.minimum(ends, len(voltage) - 1)
    change = np.where(ends < len(voltage), np.abs(voltage[after] - voltage[before]), 0.0)
    if change.max() > OFF * largest:
        n = int(np.argmax(change))
        raise UnusableError(
            f"samples of the voltage are missing where it goes from {voltage[before[n]]:.3g} to"
            f" {voltage[after[n]]:.3g} V: the start cannot be fitted without them"
        )


def split_starts(recording: Recording) -> list[Recording]:
    """Split a recording into its starts, each with the rest before it; one with one start is returned as it is.

    A start is the rise of the recorded voltage from rest, else the inrush: a rise beyond half of the largest current
    after less than a quarter of it. Parts are named after the file, with #2.
    """
    if recording.voltage_v is not None:
        voltage = without_outliers(recording.voltage_v, outlier_samples(recording.voltage_v))
        begins = _rises_from_rest(np.abs(voltage), recording.dt_s, rest=OFF)
    else:
        current = without_outliers(recording.current_a, outlier_samples(recording.current_a))
        current = current - np.median(current[: max(len(current) // 50, 5)])
        rising = current if current.max() >= -current.min() else -current
        begins = _rises_from_rest(rising, recording.dt_s, rest=_LOW)
    if len(begins) < 2:
        return [recording]
    ends = [*(_switched_off(recording, a, b) for a, b in pairwise(begins)), len(recording.time_s)]
    firsts = [0, *(_rest_begin(recording, a, b) for a, b in zip(ends, begins[1:], strict=False))]
    parts = []
    for number, (first, last) in enumerate(zip(firsts, ends, strict=True), 1):
        notes = (*recording.columns, f"start {number} of {len(begins)} in the file")
        path = Path(f"{recording.path}#{number}")
        parts.append(replace(cut(recording, slice(first, last)), path=path, columns=notes))
    return parts


def chosen_starts(recording: Recording, number: int | None = None) -> list[Recording]:
    """Return the starts in a recording, or the one with a number.

    Raises:
        InputError: there is no such start, or there are more than 200 of them and none is chosen.
    """
    parts = split_starts(recording)
    if number is None and len(parts) > MOST_STARTS:
        raise InputError(
            f"{recording.path}: it rises from rest {len(parts)} times; at most {MOST_STARTS} starts are judged at"
            " once: is it one? Else name one of them with --start"
        )
    if number is not None and not 1 <= number <= len(parts):
        raise InputError(f"{recording.path}: --start must lie in 1 .. {len(parts)}, got {number}")
    if number is not None:
        return [parts[number - 1]]
    return _whole(parts) if len(parts) > 1 else parts


def _whole(parts: list[Recording]) -> list[Recording]:
    """Return the starts that lie in the recording as a whole."""
    volts = [np.abs(part.voltage_v) for part in parts if part.voltage_v is not None]
    if not volts:
        return parts
    is_on = [series > _HIGH * np.max(series) for series in volts]
    begin = int(is_on[0][0])
    lengths = [np.count_nonzero(series) for series in is_on[begin:]]
    is_cut = len(lengths) > 2 and lengths[-1] < _CUT * np.median(lengths[:-1])
    return parts[begin : len(parts) - is_cut]


def _rises_from_rest(values: FloatArray, dt_s: float, *, rest: float) -> list[int]:
    """Return samples where the values rise beyond half of their largest, after rest."""
    top = float(np.sort(values)[-1 - (_WILD if len(values) > 2000 else 0)])
    shortest = max(_FEWEST, round(BOUNCE_S / dt_s))
    high = np.flatnonzero(values > _HIGH * top)
    moving = np.flatnonzero(values >= rest * top)
    after_rest = moving[1:][np.diff(moving) > shortest]
    # The first rise needs no rest before it; a rest without a rise after it ends no start.
    firsts = np.unique(np.append(0, np.searchsorted(high, after_rest)))
    begins: list[int] = high[firsts[firsts < len(high)]].tolist()
    return begins


def _switched_off(recording: Recording, begin: int, following: int) -> int:
    """Return where the motor is switched off between two starts."""
    if recording.voltage_v is not None:
        is_off = np.abs(recording.voltage_v[begin:following]) < OFF * np.abs(recording.voltage_v).max()
        firsts, ends = stretches(is_off)  # a switch may bounce before
        return begin + int(firsts[np.argmax(ends - firsts)]) if len(firsts) else following
    stretch = recording.current_a[begin + (following - begin) // 3 : following - 3]
    return following - 3 - len(stretch) + _change_of_level(stretch)


def _rest_begin(recording: Recording, end: int, begin: int) -> int:
    """Return from where the motor rests before a start, by the last quarter of the pause."""
    first = end
    for shown in (recording.current_a, recording.speed_rad_s):
        if shown is not None:
            pause = shown[end:begin]
            rest = pause[-max(len(pause) // 4, 1) :]
            deviation = np.abs(pause - np.median(rest))
            moving = np.flatnonzero(deviation > _MOVING * np.max(deviation[-len(rest) :], initial=0.0))
            first = max(first, end + int(moving[-1]) + 1 if len(moving) else end)
    return first


def end_of_supply(recording: Recording, alignment: Alignment) -> int:
    """Return the first sample after which a start's supply is off for good; the number of samples where it stays on.

    Without voltage and duty, the current falls to that of the quiet part at once, or a brake turns it round.
    """
    n, begin = len(recording.time_s), alignment.onset_index
    supply = recording.voltage_v if recording.voltage_v is not None else recording.duty
    if supply is not None:
        is_on = np.abs(supply) >= OFF * np.max(np.abs(supply))
        end = n - int(np.argmax(is_on[::-1]))
        return end if begin < end <= n - _FEWEST else n
    size = (n - begin) // _BLOCKS
    if not alignment.n_quiet or size == 0:
        return n
    current = without_outliers(recording.current_a, alignment.wild)
    running = alignment.sign * (current[begin:] - alignment.offset_a)
    against = np.flatnonzero(running < -_BRAKED * running.max())
    if len(against):
        return begin + _fall_begin(running, int(against[0]), alignment.noise_a)
    means = running[: len(running) // size * size].reshape(-1, size).mean(axis=1)
    error = alignment.noise_a * math.sqrt(1.0 / size + 1.0 / alignment.n_quiet) + alignment.unseen_level_a
    near = max(_NOISE * error, _SPAN * float(running.max()))
    last = max(np.flatnonzero(np.abs(means) > near).tolist(), default=0)
    if not 0 < last < len(means) - _FEWEST or means[last - 1] < _ABRUPT * near:
        return n  # it does not end, or has decayed
    some = slice((last - 1) * size, (last + 2) * size)
    return begin + _fall_begin(running, some.start + _change_of_level(running[some]), alignment.noise_a)


def _fall_begin(running: FloatArray, end: int, noise_a: float) -> int:
    """Return where a fall begins that has ended."""
    while end > 0 and running[end - 1] > running[end] + _NOISE * noise_a:
        end -= 1
    return end


def _change_of_level(values: FloatArray) -> int:
    """Return the first sample of the second level, by least squares; 0 for fewer than two samples."""
    if len(values) < 2:
        return 0
    n = np.arange(1, len(values))
    sums = np.cumsum(values)
    before, after = sums[:-1] / n, (sums[-1] - sums[:-1]) / (len(values) - n)
    gain: FloatArray = n * (len(values) - n) * np.square(before - after)
    return int(np.argmax(gain)) + 1
