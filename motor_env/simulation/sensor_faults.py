"""Readings of failed sensors on a healthy motor.

Before the noise, by the severity s: dead, x (1 - s); gain, x (1 + s); offset, x + s X; drift, x + s X t; polarity, -x.
X is the full scale, the blocked motor's current V / R or its ideal no-load speed V / Kb; t is the time in s since the
last onset of the fault or the record's begin. After the noise: clipped and stuck readings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.faults import Fault
from motor_env.motor.parameters import FloatArray, Floats, require

VOLTAGE = "voltage"
"""Name of the applied voltage as a channel: after the measured ones, without noise."""

SWAPPED = "swapped"
Readings = NDArray[Any]


def fail_before_noise(
    out: Readings,
    channels: Sequence[str],
    faults: Iterable[Fault],
    interval_start_s: FloatArray,
    full_scale: Mapping[str, Floats],
) -> None:
    """Apply the failures that come before the noise, in place.

    Args:
        out: shape (n_cases, n_channels, n_samples).
        channels: their names.
        faults: those of motors are ignored.
        interval_start_s: begin of each sampling interval, shape (n_samples,).
        full_scale: of current and speed, one or one a case.

    Raises:
        ValueError: the sensor is not among the channels, or the columns are those of another motor.
    """
    recorded_s = interval_start_s - interval_start_s[0]
    for column, channel, failure, fault in _failures(out, channels, faults):
        share = np.reshape(fault.severity, (-1, 1)) * fault.fraction_at(interval_start_s)
        if failure == "dead":
            column *= 1.0 - share
        elif failure == "gain":
            column *= 1.0 + share
        elif failure == "polarity":
            column *= np.where(share > 0.0, -1.0, 1.0)
        elif failure in ("offset", "drift"):
            lasted = np.clip(fault.age_at(interval_start_s), 0.0, recorded_s) if failure == "drift" else 1.0
            column += share * lasted * np.reshape(full_scale[channel], (-1, 1))


def fail_after_noise(
    out: Readings, channels: Sequence[str], faults: Iterable[Fault], interval_start_s: FloatArray
) -> None:
    """Apply the failures of converter and recorder, in place; arguments as `fail_before_noise`.

    A stuck channel repeats its first reading, over a last share of the record (the severity) or while the fault acts.
    """
    count = len(interval_start_s)
    for column, _, failure, fault in _failures(out, channels, faults):
        severity = np.reshape(fault.severity, (-1, 1))
        if failure == "clipped":
            share = severity * fault.fraction_at(interval_start_s)
            limit = (1.0 - share) * np.abs(column).max(axis=-1, keepdims=True)
            np.clip(column, -limit, limit, out=column)
        elif failure == "stuck":
            sample = np.arange(count)
            acts = fault.age_at(interval_start_s) >= 0.0
            if fault.is_constant:
                acts = sample >= count - np.round(severity * count)
            acts = np.broadcast_to(acts & (severity > 0.0), column.shape)
            sets_in = np.diff(acts, axis=1, prepend=False) & acts
            first = np.maximum.accumulate(np.where(sets_in, sample, 0), axis=1)
            np.copyto(column, np.take_along_axis(column, first, axis=1), where=acts)


def _failures(
    out: Readings, channels: Sequence[str], faults: Iterable[Fault]
) -> Iterable[tuple[Readings, str, str, Fault]]:
    """Yield column, channel, failure and fault of each failed sensor."""
    for fault in faults:
        if not fault.kind.is_sensor or not np.any(fault.severity):
            continue
        require(fault.kind != SWAPPED, "swapped needs the readings of another motor: draw it from a recipe")
        channel, _, failure = fault.kind.partition("_")
        names = [str(name) for name in channels]
        require(channel in names, f"{fault.kind} needs the {channel} among the channels {', '.join(names)}")
        yield out[:, names.index(channel)], channel, failure, fault
