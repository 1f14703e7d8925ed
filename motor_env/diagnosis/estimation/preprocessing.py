"""Preprocessing of recordings of a motor at work to one record, with averages and open circuits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from motor_env.diagnosis.estimation.ekf import BEGIN, OPEN
from motor_env.diagnosis.estimation.record import STRETCHES, Record, with_begins, with_holes
from motor_env.diagnosis.readers.recording import Recording, UnusableError, cut, without_lone_outliers
from motor_env.diagnosis.readers.regime import refuse_aliased
from motor_env.diagnosis.readers.start import Circuit
from motor_env.motor.parameters import FloatArray

FEWEST = 40
MOST = 10_000
_LOOKED_AT, _LOST, _MISSING = 1_000_000, 0.02, 0.1
_SAME_DT = 0.02
_FEWEST_OPEN, _NO_CURRENT = 6, 0.95  # samples, and the share of them without current
_COASTS, _SLOWS, _ZERO = 0.02, 0.1, 0.003  # of the largest voltage, speed, current
_BESIDE_JUMP, _JUMP, _JUMP_NOISE = 5, 2.5, 6.0


def from_recordings(recordings: Sequence[Recording], *, most: int = MOST) -> Record:
    """Join recordings of one motor to a record, averaged where they hold more samples than are needed.

    Args:
        recordings: of one motor, with the same columns and sampling interval.
        most: number of samples beyond which neighbours are averaged.

    Raises:
        UnusableError: no voltage, neither current nor speed, other columns or sampling from one to the next.
    """
    steps = np.array([recording.dt_s for recording in recordings])
    if np.ptp(steps) > _SAME_DT * steps.mean():
        raise UnusableError("the recordings differ in their sampling interval: identify them one by one")
    if len({_recorded_channels(recording) for recording in recordings}) > 1:
        raise UnusableError("the recordings hold different columns: identify them one by one")
    total = sum(len(recording.time_s) for recording in recordings)
    wanted = max(math.ceil(total / most), 1)
    factor = min(_averageable(recordings[0], wanted), wanted)
    share, parts = 1.0, list(recordings)
    if factor < wanted:
        share = most * factor / total
        count = math.ceil(STRETCHES / len(recordings))
        parts = [part for recording in recordings for part in liveliest_stretches(recording, share, count)]
    columns = [_columns(part, factor) for part in parts]
    volts, current, speed, begins = (np.concatenate(each) for each in zip(*columns, strict=True))
    missing = np.concatenate([missing_blocks(part, factor) for part in parts])
    recorded = np.array(_recorded_channels(parts[0]), dtype=np.float64)
    if len(volts) < FEWEST:
        raise UnusableError(f"only {len(volts)} samples; at least {FEWEST} are needed")
    readings = np.stack([current, speed], axis=1)
    if recorded[0]:
        begins = np.where(open_circuit(volts, readings, begins) & (begins == 0.0), OPEN, begins)
    if missing.any():
        readings[missing[:, 1:] & (recorded > 0.0)] = np.nan
        begins = with_begins(with_holes(begins, missing[:, 0], readings, recorded), readings, recorded)
    record = Record(
        dt_s=float(steps.mean()) * factor,
        voltage_v=volts,
        readings=readings,
        recorded=recorded,
        marks=begins,
        hold="held" if factor * recordings[0].averaged == 1 else "straight",
        averaged=factor * recordings[0].averaged,
        share=share,
    )
    n_counted = int(record.informative[begins != BEGIN][:, recorded > 0.0].sum(axis=0).min())
    if missing.any() and n_counted < FEWEST:
        raise UnusableError(
            f"only {n_counted} of {len(volts)} samples are there, and follow others {record.dt_s:.4g} s apart without a"
            f" hole; at least {FEWEST} are needed"
        )
    return record


def open_circuit(voltage_v: FloatArray, readings: FloatArray, begins: FloatArray) -> NDArray[np.bool_]:
    """Find where a motor coasts with an open circuit, shape (n,).

    The voltage jumps where the circuit opens and closes; a diode may carry the current until it is gone. Then there is
    none, and the terminals' voltage follows the speed, or is recorded as none while the speed moves.
    """
    current, peak = readings[:, 0], float(np.quantile(np.abs(voltage_v), 0.999))
    noise, largest = median_noise(current), float(np.quantile(np.abs(current), 0.99))
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
    """Find samples at which the voltage moves much more than before and after, shape (n,)."""
    moved = np.abs(np.diff(voltage_v, prepend=voltage_v[0]))
    beside = _BESIDE_JUMP
    medians = np.median(sliding_window_view(np.pad(moved, beside, mode="edge"), beside), axis=1)
    usual = np.maximum(medians[: len(moved)], medians[-len(moved) :])
    is_jump: NDArray[np.bool_] = (moved > _JUMP * usual) & (moved > _JUMP_NOISE * median_noise(voltage_v))
    return is_jump


def median_noise(column: FloatArray) -> float:
    """Return white noise's standard deviation by the median second difference; a converter's step at least."""
    second, moved = np.abs(np.diff(column, 2)), np.abs(np.diff(column))
    steps = moved[moved > 0.0]
    quantum = float(np.min(steps)) / math.sqrt(12.0) if len(steps) else 0.0
    largest = float(np.max(np.abs(column)))
    white = 1.4826 * float(np.median(second)) / math.sqrt(6.0)
    return max(white, min(quantum, 0.02 * largest), 1e-6 * largest, 1e-12)


def block_means(values: FloatArray, factor: int) -> FloatArray:
    """Return means of neighbours, without the last incomplete block."""
    if factor == 1:
        return values
    whole = len(values) // factor * factor
    means: FloatArray = values[:whole].reshape(-1, factor).mean(axis=1)
    return means


def missing_blocks(recording: Recording, factor: int) -> NDArray[np.bool_]:
    """Return which means of neighbours lack more than a tenth, shape (n, 3)."""
    if recording.missing is None:
        return np.zeros((len(recording.time_s) // factor, 3), dtype=np.bool_)
    whole = len(recording.time_s) // factor * factor
    shares = recording.missing[:whole].reshape(-1, factor, 3).mean(axis=1)
    missing: NDArray[np.bool_] = shares > _MISSING
    return missing


def _averageable(recording: Recording, wanted: int) -> int:
    """Return how many neighbours can be averaged and keep nearly all that current or speed tell."""
    column = (
        recording.current_a
        if _recorded_channels(recording)[0] or recording.speed_rad_s is None
        else recording.speed_rad_s
    )
    column, factor = column[:_LOOKED_AT], 1
    noise, variance = (median_noise(column) ** 2, float(np.var(column))) if wanted > 1 else (0.0, 0.0)
    while factor < wanted:
        kept = float(np.var(block_means(column, 2 * factor))) + noise * (1.0 - 0.5 / factor)
        if kept < (1.0 - _LOST) * variance:
            break
        factor *= 2
    return factor


def liveliest_stretches(recording: Recording, share: float, count: int = STRETCHES) -> list[Recording]:
    """Return a share of a recording: the liveliest stretch of each of `count` equal parts."""
    n = len(recording.time_s)
    volts = recording.current_a if recording.voltage_v is None else recording.voltage_v
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(volts)))])
    part, length, chosen = n // count, int(share * n / count), []
    for first in range(0, part * count, part):
        ends = moved[first + length : first + part] - moved[first : first + part - length]
        begin = first + int(np.argmax(ends))
        chosen.append(cut(recording, slice(begin, begin + length)))
    return chosen


def _recorded_channels(recording: Recording) -> tuple[bool, bool]:
    """Return whether current and speed were recorded: a channel that never moves was not."""
    speed = recording.speed_rad_s
    return float(np.ptp(recording.current_a)) > 0.0, speed is not None and float(np.ptp(speed)) > 0.0


def at_terminals(
    recording: Recording, voltage_v: float | None = None, circuit: Circuit | None = None
) -> Recording:
    """Return the recording with the voltage at the motor's terminals: duty in volts, less that of the shunt."""
    recording = without_lone_outliers(recording)
    voltage = recording.voltage_v
    if voltage is None and recording.duty is not None and voltage_v is not None:
        voltage = recording.duty * voltage_v
    if voltage is not None and circuit is not None:
        voltage = voltage - circuit.shunt_ohm * recording.current_a
        if recording.missing is not None and circuit.shunt_ohm > 0.0:
            voltage = np.where(recording.missing[:, 1], np.nan, voltage)
    return replace(recording, voltage_v=voltage)


def _columns(recording: Recording, factor: int) -> list[FloatArray]:
    """Return means of voltage, current, speed (zeros where not recorded), and 1 where the recording begins."""
    voltage, (has_current, has_speed) = recording.voltage_v, _recorded_channels(recording)
    if voltage is None:
        raise UnusableError("a motor at work can be identified only where the voltage was recorded")
    if float(np.ptp(voltage)) == 0.0 and not has_current:
        raise UnusableError("neither voltage nor current ever changes")
    if not has_current and not has_speed:
        raise UnusableError("neither the current nor the speed ever changes")
    if has_current:
        refuse_aliased(voltage, recording.current_a)
    shown = (recording.current_a if has_current else None, recording.speed_rad_s if has_speed else None)
    columns = (voltage, *(np.zeros(len(voltage)) if column is None else column for column in shown))
    means = [block_means(column, factor) for column in columns]
    return [*means, np.eye(1, len(means[0]))[0]]
