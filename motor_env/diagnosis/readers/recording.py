"""Recordings of real motors as read from files: SI units on an even time axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import flags, instance, numbers
from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.columns import recognise
from motor_env.diagnosis.readers.headers import SI, ColumnChoice
from motor_env.diagnosis.readers.noise import filled, lone_outliers
from motor_env.diagnosis.readers.tables import read_table
from motor_env.diagnosis.readers.text_block import FEWEST_SAMPLES, Table
from motor_env.diagnosis.readers.text_numbers import MOST_ROWS
from motor_env.motor.parameters import FloatArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_SHORTEST_STEP_S, _LONGEST_STEP_S = 1e-10, 1e4
_SMALLEST_READING, _LARGEST_READING = 1e-12, 1e9
_LATEST_BEGIN_S = 1e7  # seconds of a computer's clock count from 1970
_GAP_STEPS = 100.0  # median steps without a sample: the recording is cut there
_Record = TypeVar("_Record", bound="DataclassInstance")
_AS_LONG, _ALIKE = 0.2, 0.05  # of the median step: usual ones; standard deviation of a clock's
_MOSTLY = 0.8  # of the steps: where fewer are usual, times near even ones were rounded
_HOLE = 1.75  # median steps of a clock that is not even: nearly all of its own steps are shorter
_HOLE_STEPS, _AT_BEGIN = 3.0, 0.1  # where a clock begins anew; of the time until then
_MOST_READINGS = 3  # that are told apart in a list
_CHANNELS = {"voltage_v": 0, "duty": 0, "current_a": 1, "speed_rad_s": 2}


class UnusableError(ValueError):
    """A recording that can be read but not judged; the message says why."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording, in SI units, on an even time axis.

    NaN, None or a masked value is a missing sample: it is filled in a straight line for pictures and first guesses, and
    kept as `missing`, so that no fit takes it for a reading.

    Attributes:
        path: where it was read from.
        time_s: shape (n_samples,), evenly spaced.
        current_a: shape (n_samples,).
        voltage_v: shape (n_samples,), or None where it was not recorded.
        speed_rad_s: shape (n_samples,), or None where it was not recorded.
        duty: duty cycle of the supply, shape (n_samples,), or None: a voltage of unknown scale.
        columns: how the columns were understood, for the user.
        averaged: number of samples of the file whose mean is one sample here.
        warnings: contradictions in what was said of the columns.
        missing: missing samples of voltage (or duty), current and speed, shape (n_samples, 3); None for none.

    Raises:
        ValueError: columns that are no numbers, not as long as `time_s`, or infinite.
    """

    path: Path
    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray | None = None
    speed_rad_s: FloatArray | None = None
    duty: FloatArray | None = None
    columns: tuple[str, ...] = ()
    averaged: int = 1
    warnings: tuple[str, ...] = ()
    missing: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        instance("path", self.path, (str, Path))
        object.__setattr__(self, "path", Path(self.path))
        time = numbers("time_s", self.time_s, ("n_samples",))
        object.__setattr__(self, "time_s", time)
        if self.missing is not None:
            object.__setattr__(self, "missing", flags("missing", self.missing, (len(time), 3)))
        for name, channel in _CHANNELS.items():
            if getattr(self, name) is None and name != "current_a":
                continue
            values = numbers(name, getattr(self, name), time.shape, missing=True)
            object.__setattr__(self, name, values)
            if not (lost := np.isnan(values)).any():
                continue
            missing = (
                np.zeros((len(values), 3), dtype=np.bool_) if self.missing is None else self.missing.copy()
            )
            missing[:, channel] |= lost
            object.__setattr__(self, "missing", missing)
            object.__setattr__(self, name, filled(values))

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))


def cut(record: _Record, part: slice) -> _Record:
    """Cut all arrays of a record to a part of their samples."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    arrays = {name: value[part] for name, value in values.items() if isinstance(value, np.ndarray)}
    return replace(record, **arrays)


def stretches(flags: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return first sample and end of each run in which a flag is set."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return edges[::2], edges[1::2]


def read_recording(path: str | Path, choices: Sequence[ColumnChoice] = ()) -> Recording:
    """Read time, current and, where recorded, voltage and speed from a file.

    Args:
        path: .csv, .txt and the like; .mat, .h5, .npy, .npz, .parquet, .tdms, .xlsx.
        choices: columns that the user names; the others are recognised by their headers.

    Raises:
        InputError: the file is missing, empty, binary, lacks a column, or holds a value that is no finite number, or a
            time axis that does not rise.
    """
    instance("path", path, (str, Path))
    path = Path(path)
    table = read_table(path, [choice.column for choice in choices])
    columns, unused = recognise(path, table, choices)
    notes = [f"{quantity} is {column.origin}" for quantity, column in columns.items()]
    values = {quantity: column.values for quantity, column in columns.items()}
    notes += [f"{table.averaged} neighbouring samples are averaged into one"] * (table.averaged > 1)
    notes += [f"not used: {', '.join(unused)}"] * (unused != ())
    warnings = tuple(column.warning for column in columns.values() if column.warning)
    recording = _recording(path, table, values, (*notes, *table.remarks))
    return without_lone_outliers(replace(recording, warnings=warnings), ("voltage_v", "speed_rad_s"))


def recording_of(recording: Recording | str | Path, choices: Sequence[ColumnChoice] = ()) -> Recording:
    """Return a recording, or that of a file."""
    instance("recording", recording, (Recording, str, Path))
    instance("columns", choices, (tuple, list))
    if isinstance(recording, Recording):
        return without_lone_outliers(recording, ("voltage_v", "speed_rad_s"))
    return read_recording(recording, choices)


def without_lone_outliers(
    recording: Recording, names: Sequence[str] = ("voltage_v", "current_a", "speed_rad_s")
) -> Recording:
    """Return a recording whose lone outliers count as missing, with a note.

    In a start the peak of the current may be one sample: see `noise.outlier_samples`.
    """
    changed: dict[str, Any] = {}
    notes = []
    for name in names:
        values = getattr(recording, name)
        if values is not None and (lone := lone_outliers(values)).any():
            changed[name], k = np.where(lone, np.nan, values), int(np.argmax(lone))
            notes.append(f"{name} of {values[k]:.4g} at {recording.time_s[k]:.6g} s")
    if not changed:
        return recording
    words = f"lone outliers count as missing: {', '.join(notes)}"
    return replace(recording, **changed, columns=(*recording.columns[:-1], words, *recording.columns[-1:]))


def describe_reading(readings: Iterable[tuple[Path, tuple[str, ...]]]) -> list[str]:
    """Say how files were read, each way once.

    Args:
        readings: files, with the `columns` of their recordings.
    """
    files: dict[str, list[Path]] = {}
    for path, notes in readings:
        if notes:
            files.setdefault("; ".join(notes[:-1]), []).append(path)
    if len(files) < 2:
        return [f"  read: {words}" for words in files]
    lines = [
        f"  read: {paths[0]}{f' and {len(paths) - 1} more' if len(paths) > 1 else ''}: {words}"
        for words, paths in files.items()
    ]
    left = len(lines) - _MOST_READINGS
    return [*lines[:_MOST_READINGS], *([f"  read: other files in {left} more ways"] * (left > 0))]


def _recording(path: Path, table: Table, columns: dict[str, FloatArray], notes: tuple[str, ...]) -> Recording:
    """Check the time axis and even it out."""
    stated = time = columns["time"]
    if abs(time[0]) > _LATEST_BEGIN_S:
        notes, time = (*notes, f"time counts from {time[0]:.10g} s"), time - time[0]
        columns = columns | {"time": time}
    if len(time) < FEWEST_SAMPLES:
        raise InputError(f"{path}: must hold at least {FEWEST_SAMPLES} samples, got {len(time)}")
    steps = np.diff(time)
    if (anew := _clock_begins(time)).any():
        lines = [str(table.lines[k + 1]) for k in np.flatnonzero(anew)[:_MOST_READINGS].tolist()]
        notes = (
            *notes,
            f"the clock begins anew in {table.where} {', '.join(lines)}: a new part, after a gap",
        )
        on = _HOLE_STEPS * float(np.median(steps))
        time = time + np.append(0.0, np.cumsum(np.where(anew, on - steps, 0.0)))
        columns, steps = columns | {"time": time}, np.diff(time)
    if not (steps > 0.0).all():
        bad = int(np.argmax(steps <= 0.0)) + 1
        raise InputError(
            f"{path}, {table.where} {table.lines[bad]}: the column time_s must rise,"
            f" got {stated[bad]:.10g} after {stated[bad - 1]:.10g}; where the rows lie evenly, say --sampling-rate HZ"
        )
    if not _SHORTEST_STEP_S <= float(np.median(steps)) <= _LONGEST_STEP_S:
        raise InputError(f"{path}: samples {np.median(steps):.3g} s apart are no recording of a motor")
    for name, values in columns.items():
        largest = float(np.nanmax(np.abs(values)))
        if largest > _LARGEST_READING or (name != "time" and 0.0 < largest < _SMALLEST_READING):
            raise InputError(f"{path}: a {name} of {largest:.3g} is no reading of a motor")
    stretch, gap_note = _without_gaps(time, steps)
    if stretch.stop - stretch.start < FEWEST_SAMPLES:
        raise InputError(f"{path}: has gaps between all of its samples")
    columns = {name: values[stretch] for name, values in columns.items()}
    even, columns, note = resampled(columns["time"], columns)
    notes = (*notes, *gap_note, *note, _summary(even, columns))
    return Recording(
        path=path,
        time_s=even,
        current_a=columns["current"],
        voltage_v=columns.get("voltage"),
        speed_rad_s=columns.get("speed"),
        duty=columns.get("duty"),
        columns=notes,
        averaged=table.averaged,
    )


def _clock_begins(time_s: FloatArray) -> NDArray[np.bool_]:
    """Return which steps go back to the begin of a clock, shape (n - 1,); none where some go back to elsewhere."""
    back = np.diff(time_s) < 0.0
    begins = time_s[1:] <= time_s[0] + _AT_BEGIN * (time_s[:-1] - time_s[0])
    is_clock = (begins | ~back).all() and np.count_nonzero(back) * FEWEST_SAMPLES <= len(time_s)
    return np.asarray(back & is_clock, dtype=np.bool_)


def _summary(time_s: FloatArray, columns: dict[str, FloatArray]) -> str:
    """Say number, rate and ranges of the samples, which show a wrong unit."""
    rate = (len(time_s) - 1) / (time_s[-1] - time_s[0])
    ranges = [
        f"{name} {np.nanmin(values):.4g} to {np.nanmax(values):.4g} {SI[name]}"
        for name, values in columns.items()
        if name != "time"
    ]
    return f"{len(time_s)} samples at {rate:.6g} Hz, {', '.join(ranges)}"


def _without_gaps(time_s: FloatArray, steps: FloatArray) -> tuple[slice, tuple[str, ...]]:
    """Return the longest stretch without a long gap, and a note where there is one."""
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps))
    edges = [0, *(gaps + 1).tolist(), len(time_s)]
    begin, end = max(pairwise(edges), key=lambda stretch: stretch[1] - stretch[0])
    note = (
        f"a gap of {steps.max():.3g} s: only {time_s[begin]:.6g} to {time_s[end - 1]:.6g} s is read, the longest"
        " stretch"
    )
    return slice(begin, end), (note,) if len(gaps) else ()


def resampled(
    time_s: FloatArray, columns: dict[str, FloatArray], step_s: float | None = None
) -> tuple[FloatArray, dict[str, FloatArray], tuple[str, ...]]:
    """Put columns on an even time axis; note where they had to be changed.

    An uneven clock is interpolated. Where an even one left samples out or changed its rate, values between two samples
    are NaN, one at least: an interpolated voltage would step at another time than the motor's.

    Args:
        time_s: rising.
        columns: their values at these times.
        step_s: the usual interval, by default that of most samples.
    """
    count, steps = len(time_s), np.diff(time_s)
    even = np.linspace(time_s[0], time_s[-1], count)
    shift = float(np.max(np.abs(even - time_s)) / (even[1] - even[0]))
    is_other = step_s is not None and abs(even[1] - even[0] - step_s) > _AS_LONG * step_s
    if shift <= 0.02 and not is_other:
        return even, columns, ()
    step_s, is_usual, is_clock = _usual_step(steps, step_s, is_other=is_other)
    if is_clock and not is_usual.all() and (shift >= 0.5 or is_other or float(np.mean(is_usual)) > _MOSTLY):
        samples, places = _placed_samples(time_s, step_s, is_usual)
        if places[-1] < max(4 * count, MOST_ROWS):
            even = time_s[0] + step_s * np.arange(places[-1] + 1)
            whole = {name: np.full(len(even), np.nan) for name in columns}
            for name, values in columns.items():
                whole[name][places] = values[samples]
            words = f"{count} samples, most of them {step_s:.6g} s apart: what lies between others counts as missing"
            return even, whole, (words,)
    if shift >= 0.5:  # evenly at the median step
        many = int(min((time_s[-1] - time_s[0]) / np.median(steps), 4 * count))
        even = np.linspace(time_s[0], time_s[-1], max(many, 1) + 1)
    columns = {name: np.interp(even, time_s, values) for name, values in columns.items()}
    if not is_clock:
        after = np.clip(np.searchsorted(time_s, even), 1, count - 1)
        is_hole = (
            (steps[after - 1] > _HOLE * np.median(steps))
            & (even < time_s[after])
            & (even > time_s[after - 1])
        )
        columns = {name: np.where(is_hole, np.nan, values) for name, values in columns.items()}
    return even, columns, ("the time axis is uneven: interpolated to an even one",)


def _usual_step(
    steps: FloatArray, before_s: float | None, *, is_other: bool
) -> tuple[float, NDArray[np.bool_], bool]:
    """Return the usual step, which steps are as long, and whether they are alike enough for a clock."""
    about = float(np.median(steps))
    if before_s is not None and (is_other or (np.abs(steps - before_s) <= _AS_LONG * before_s).any()):
        about = before_s
    is_usual = np.abs(steps - about) <= _AS_LONG * about
    usual = steps[is_usual] if is_usual.any() else np.array([about])
    return float(usual.mean()), is_usual, float(usual.std()) < _ALIKE * about


def _placed_samples(
    time_s: FloatArray, step_s: float, is_usual: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return samples and their places on an even axis; samples too close to those before are left out."""
    firsts = np.append(0, np.flatnonzero(~is_usual) + 1)
    samples, places, end = [], [], -2
    for first, last in pairwise([*firsts.tolist(), len(time_s)]):
        place = round((time_s[first] - time_s[0]) / step_s)
        begin = first + max(end + 2 - place, 0)
        if begin < last:
            place += begin - first
            end = place + last - 1 - begin
            samples.append(np.arange(begin, last))
            places.append(np.arange(place, end + 1))
    return np.concatenate(samples), np.concatenate(places)
