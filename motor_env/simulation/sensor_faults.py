"""Readings of failed sensors: the motor is healthy, and something else is recorded.

Dead, scaled, offset and reversed sensors act before the noise; clipped and stuck readings after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.faults import ALWAYS, Fault
from motor_env.motor.parameters import FloatArray, require

VOLTAGE = "voltage"
"""The applied voltage as a channel: after the measured ones, without noise, since the drive knows what it applies."""

SWAPPED = "swapped"
Readings = NDArray[Any]


def fail_before_noise(
    out: Readings, channels: Sequence[str], faults: Iterable[Fault], interval_start_s: FloatArray
) -> None:
    """True quantities as failed sensors show them, in place.

    Args:
        out: shape (n_cases, n_channels, n_samples).
        channels: their names.
        faults: of which the sensors' count.
        interval_start_s: begin of each sampling interval, shape (n_samples,).

    Raises:
        ValueError: a sensor that is not among the channels; columns of another motor, which is not here.
    """
    for column, failure, fault in _failures(out, channels, faults):
        share = np.reshape(fault.severity, (-1, 1)) * fault.fraction_at(interval_start_s)
        if failure == "dead":
            column *= 1.0 - share
        elif failure == "gain":
            column *= 1.0 + share
        elif failure == "polarity":
            column *= np.where(share > 0.0, -1.0, 1.0)
        elif failure == "offset":
            column += share * np.abs(column).max(axis=-1, keepdims=True)


def fail_after_noise(
    out: Readings, channels: Sequence[str], faults: Iterable[Fault], interval_start_s: FloatArray
) -> None:
    """Readings as converter and recorder leave them, in place; the arguments are those of `fail_before_noise`.

    A channel is stuck for the severity as the last share of the record, or from the onset on.
    """
    count = len(interval_start_s)
    for column, failure, fault in _failures(out, channels, faults):
        severity = np.broadcast_to(np.asarray(fault.severity, dtype=np.float64), len(column))
        if failure == "clipped":
            share = severity[:, None] * fault.fraction_at(interval_start_s)
            limit = (1.0 - share) * np.abs(column).max(axis=-1, keepdims=True)
            np.clip(column, -limit, limit, out=column)
        elif failure == "stuck":
            since = int(np.searchsorted(interval_start_s, fault.onset_s - 1e-9))
            for row, size in zip(column, severity.tolist(), strict=True):
                first = count - round(size * count) if fault.onset_s == ALWAYS else since
                if size > 0.0 and first < count:
                    row[first:] = row[first]


def _failures(
    out: Readings, channels: Sequence[str], faults: Iterable[Fault]
) -> Iterable[tuple[Readings, str, Fault]]:
    """Column, what happens to it, and the fault, for each failed sensor."""
    for fault in faults:
        if not fault.kind.is_sensor or not np.any(fault.severity):
            continue
        require(fault.kind != SWAPPED, "swapped needs the readings of another motor: draw it from a recipe")
        channel, _, failure = fault.kind.partition("_")
        names = [str(name) for name in channels]
        require(channel in names, f"{fault.kind} needs the {channel} among the channels {', '.join(names)}")
        yield out[:, names.index(channel)], failure, fault
