"""How a motor at work is driven: what the model lacks of a motor errs much the same in all windows of one drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from motor_env.motor.healthy import Drive
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.recording import Recording, UnusableError

ALIKE, FAR = 0.12, 3.0
"""Distance of two windows up to which they are driven alike, see `apart`; and how many times that tells no fault."""
NEEDED = "windows of a running motor are judged only where voltage, current and speed tell of it"
_LEVELS, _HALVINGS = np.linspace(0.05, 0.95, 10), range(3, 10)


def needed_columns(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Voltage and speed.

    Raises:
        UnusableError: one of them is missing.
    """
    if recording.voltage_v is None or recording.speed_rad_s is None:
        raise UnusableError(NEEDED)
    return recording.voltage_v, recording.speed_rad_s


def rms_volts(recording: Recording) -> float:
    """Effective voltage."""
    return float(np.sqrt(np.mean(np.square(needed_columns(recording)[0]))))


def driven(part: Recording) -> FloatArray:
    """How a motor is driven: voltage, current and speed by 10 quantiles and by their moves, shape (3, 17).

    The moves are the root mean squares of the change within an eighth of the recording, a sixteenth, ... a 512th.
    """
    volts, speed = needed_columns(part)
    columns = np.array([volts, part.current_a, speed])
    lags = [max(len(volts) >> times, 1) for times in _HALVINGS]
    moves = [np.sqrt(np.mean(np.square(columns[:, lag:] - columns[:, :-lag]), axis=1)) for lag in lags]
    return np.concatenate([np.quantile(columns, _LEVELS, axis=1), moves]).T


def apart(one: FloatArray, others: FloatArray) -> FloatArray:
    """How far a window is from being driven like each of some others, shape (n,).

    A drive commands the voltage, the speed or the current. A fault leaves what is commanded as it is, however much it
    changes the rest. So the one that is most alike counts: the mean distance of its quantiles (Wasserstein) or that of
    its moves, whichever is larger, over the root mean square of the quantiles.

    Args:
        one: how it is driven, shape (3, 17).
        others: how they are, shape (n, 3, 17).
    """
    levels, off = len(_LEVELS), np.abs(others - one)
    sizes = np.sqrt(np.mean(np.square(others[..., :levels]), axis=2))
    distances = np.maximum(off[..., :levels].mean(axis=2), off[..., levels:].mean(axis=2))
    return np.asarray(np.min(distances / np.maximum(sizes, np.finfo(float).tiny), axis=1), dtype=np.float64)


def nearest(one: FloatArray, drives: Sequence[Drive]) -> tuple[int, float]:
    """Place of the drive with the window that is least apart, and how far."""
    distances = [float(apart(one, drive.moved).min()) for drive in drives]
    place = int(np.argmin(distances))
    return place, distances[place]


def sorted_by_drive(moved: FloatArray, times: float) -> tuple[NDArray[np.intp], float]:
    """Drive of each of some windows, shape (n,), and up to which distance windows are driven alike.

    A window is driven like another one if it is as near to it as each of these is to the one nearest to it, or so many
    times as far.

    Args:
        moved: how they are driven, shape (n, 3, 17).
        times: how many.
    """
    distances = np.array([apart(one, moved) for one in moved])
    others = distances + np.diag(np.full(len(moved), np.inf))
    alike = times * max(ALIKE, float(others.min(axis=1).max()))
    _, drive = connected_components(distances <= alike, directed=False)
    return np.asarray(drive, dtype=np.intp), alike


def off_others(drives: Sequence[Drive]) -> FloatArray:
    """How far R, K, J and B of each drive are off the median of the others, all logarithms, shape (n_drives, 4).

    It is 0 for a drive with more windows than all others together, as these tell nothing of it, and of none at all.
    """
    off = np.zeros((max(len(drives), 1), 4))
    logs, counts = [np.log(drive.values) for drive in drives], [len(drive.pieces) for drive in drives]
    for k, log in enumerate(logs):
        if 2 * counts[k] <= sum(counts):
            off[k] = log - np.median(logs[:k] + logs[k + 1 :], axis=0)
    return off
