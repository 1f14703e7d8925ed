"""Operating conditions of a motor at work: within one the error of the model is nearly constant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.motor.healthy import OperatingCondition
from motor_env.motor.parameters import FloatArray

ALIKE, FAR = 0.12, 3.0
"""Distance of two windows up to which their conditions are alike, see `condition_distance`; and the multiple beyond
which no fault is reported."""
NEEDED = "windows of a running motor are judged only where voltage, current and speed tell of it"
_LEVELS, _HALVINGS = np.linspace(0.05, 0.95, 10), range(3, 10)


def needed_columns(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return voltage and speed.

    Raises:
        UnusableError: one of them is missing.
    """
    if recording.voltage_v is None or recording.speed_rad_s is None:
        raise UnusableError(NEEDED)
    return recording.voltage_v, recording.speed_rad_s


def rms_volts(recording: Recording) -> float:
    """Return the effective voltage."""
    return float(np.sqrt(np.mean(np.square(needed_columns(recording)[0]))))


def condition_features(part: Recording) -> FloatArray:
    """Describe how a motor is driven: 10 quantiles and 7 moves of voltage, current and speed, shape (3, 17).

    The moves are the root mean squares of the change within an eighth of the recording, a sixteenth, ... a 512th.
    """
    volts, speed = needed_columns(part)
    columns = np.array([volts, part.current_a, speed])
    lags = [max(len(volts) >> times, 1) for times in _HALVINGS]
    moves = [np.sqrt(np.mean(np.square(columns[:, lag:] - columns[:, :-lag]), axis=1)) for lag in lags]
    return np.concatenate([np.quantile(columns, _LEVELS, axis=1), moves]).T


def condition_distance(features: FloatArray, others: FloatArray) -> FloatArray:
    """Measure how far the condition of a window is from each of some others, shape (n,).

    A drive commands the voltage, the speed or the current. A fault leaves what is commanded as it is, however much it
    changes the rest. So the one that is most alike counts: the mean distance of its quantiles (Wasserstein) or that of
    its moves, whichever is larger, over the root mean square of the quantiles.

    Args:
        features: of the window, shape (3, 17).
        others: of the others, shape (n, 3, 17).
    """
    levels, off = len(_LEVELS), np.abs(others - features)
    sizes = np.sqrt(np.mean(np.square(others[..., :levels]), axis=2))
    distances = np.maximum(off[..., :levels].mean(axis=2), off[..., levels:].mean(axis=2))
    return np.asarray(np.min(distances / np.maximum(sizes, np.finfo(float).tiny), axis=1), dtype=np.float64)


def nearest(features: FloatArray, conditions: Sequence[OperatingCondition]) -> tuple[int, float]:
    """Find the condition with the window that is least apart: its place, and how far."""
    distances = [float(condition_distance(features, each.moved).min()) for each in conditions]
    place = int(np.argmin(distances))
    return place, distances[place]


def sorted_by_condition(features: FloatArray, times: float) -> tuple[NDArray[np.intp], float]:
    """Sort windows by condition: that of each, shape (n,), and up to which distance conditions are alike.

    Windows are alike if they are as near to each other as each is to the one nearest to it, or so many times as far.

    Args:
        features: of the windows, shape (n, 3, 17).
        times: how many.
    """
    distances = np.array([condition_distance(one, features) for one in features])
    others = distances + np.diag(np.full(len(features), np.inf))
    alike = times * max(ALIKE, float(others.min(axis=1).max()))
    _, condition = connected_components(distances <= alike, directed=False)
    return np.asarray(condition, dtype=np.intp), alike


def off_others(conditions: Sequence[OperatingCondition]) -> FloatArray:
    """Compare R, K, J and B of each condition with the median of the others, all logarithms, shape (n_conditions, 4).

    It is 0 for one with more windows than all others together, as these tell nothing of it, and of none at all.
    """
    off = np.zeros((max(len(conditions), 1), 4))
    logs, counts = [np.log(each.values) for each in conditions], [len(each.pieces) for each in conditions]
    for k, log in enumerate(logs):
        if 2 * counts[k] <= sum(counts):
            off[k] = log - np.median(logs[:k] + logs[k + 1 :], axis=0)
    return off
