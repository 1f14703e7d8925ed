"""Initial values of a motor at work: linear regressions in integrated signals, over windows of several lengths.

Integrated over a window the equations need no derivative of a noisy signal. With current and speed they are linear in
all unknowns; with the current alone for each of several resistances; with the speed alone the motor is a gain, a time
constant and a dead voltage.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.preprocessing import median_noise
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.readers.noise import filled
from motor_env.motor.parameters import FloatArray

_WINDOWS = (2, 5, 12, 30, 80, 200)
_RESISTANCES = np.geomspace(0.04, 2.0, 9)
_LEAST = 1e-9
_LEAST_LAG = 0.3  # of R dt


def initial_values(record: Record) -> list[FloatArray]:
    """Return values to begin a fit from, each of shape (parameter_index.N_VALUES,)."""
    guesses = []
    for window in _WINDOWS:
        if len(record.voltage_v) < 12 * window:
            break
        if record.seen.all():
            guesses += [_from_current_and_speed(record, window, loaded=loaded) for loaded in (False, True)]
        elif record.seen[0]:
            guesses += [
                _from_current(record, window, share, loaded=loaded)
                for share in _RESISTANCES
                for loaded in (False, True)
            ]
        else:
            guesses.append(_from_speed(record, window))
    return [values for values in guesses if values is not None]


def _changes(sums: FloatArray, record: Record, width: int) -> FloatArray:
    """Return the change of a series over each window within one recording."""
    counted, starts = np.cumsum(record.begins), np.arange(0, len(sums) - width, max(width // 2, 1))
    starts = starts[counted[starts + width] == counted[starts]]
    return np.asarray(sums[starts + width] - sums[starts], dtype=np.float64)


def _means(column: FloatArray, record: Record, width: int) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (column[1:] + column[:-1]))])
    return _changes(sums, record, width) / width


def _slopes(column: FloatArray, record: Record, width: int) -> FloatArray:
    return _changes(column, record, width) / (width * record.dt_s)


def _volts(record: Record, width: int) -> FloatArray:
    """Return the mean voltage of each window; it may be held between samples."""
    sums = np.concatenate([[0.0], np.cumsum(record.between()[1:].mean(axis=1))])
    return _changes(sums, record, width) / width


def _solve(columns: list[FloatArray], target: FloatArray) -> FloatArray:
    matrix = np.stack(columns, axis=1)
    size = np.sqrt(np.mean(matrix**2, axis=0)) + 1e-300
    solution: FloatArray = nnls(matrix / size, target)[0] / size
    return solution


def _torques(
    columns: list[FloatArray], torque: FloatArray, *, loaded: bool
) -> tuple[float, float, float, float]:
    """Solve for inertia, viscous and dry friction, and a constant load of either sign if `loaded`."""
    ones = np.ones(len(torque))
    solution = _solve([*columns, ones, -ones] if loaded else columns, torque).tolist()
    load = solution[3] - solution[4] if loaded else 0.0
    return solution[0], solution[1], solution[2], load


def _values(record: Record, **given: float) -> FloatArray:
    """Return physical values with noises out of a regression's."""
    values = np.zeros(index.N_VALUES)
    for name, value in given.items():
        values[getattr(index, name)] = value
    values[index.L] = max(values[index.L], _LEAST_LAG * values[index.R] * record.dt_s)
    values[index.NOISE_I] = median_noise(filled(record.readings[:, 0])) if record.seen[0] else 1.0
    values[index.NOISE_W] = median_noise(filled(record.readings[:, 1])) if record.seen[1] else 1.0
    return values


def _from_current_and_speed(record: Record, window: int, *, loaded: bool) -> FloatArray | None:
    """Regress current and speed: V = R i + L di/dt + K w + drop, K i = J dw/dt + B w + Tc sign(w)."""
    i, w = filled(record.readings[:, 0]), filled(record.readings[:, 1])
    mean_i, mean_w, direction = (_means(column, record, window) for column in (i, w, _sign(w)))
    slope_i, slope_w = (_slopes(column, record, window) for column in (i, w))
    r, inductance, k = _solve([mean_i, slope_i, mean_w], _volts(record, window))
    if k <= 0.0 or r <= 0.0:
        return None
    inertia, drag, dry, load = _torques([slope_w, mean_w, direction], k * mean_i, loaded=loaded)
    if inertia <= 0.0:
        return None
    return _values(record, R=r, L=inductance, K=k, J=inertia, B=drag, COULOMB=dry, LOAD=load)


def _from_current(record: Record, window: int, share: float, *, loaded: bool) -> FloatArray | None:
    """Regress the current alone, with K = 1: the speed is what R leaves of the voltage."""
    volts, amps, _ = record.peaks
    r, mean_i = share * volts / amps, _means(filled(record.readings[:, 0]), record, window)
    w = _volts(record, window) - r * mean_i
    slope = (w[2:] - w[:-2]) / (2.0 * max(window // 2, 1) * record.dt_s)
    inertia, drag, dry, load = _torques([slope, w[1:-1], _sign(w)[1:-1]], mean_i[1:-1], loaded=loaded)
    if inertia <= 0.0:
        return None
    return _values(record, R=r, K=1.0, J=inertia, B=drag, COULOMB=dry, LOAD=load)


def _from_speed(record: Record, window: int) -> FloatArray | None:
    """Regress the speed alone, with R = 1 and B = 0: V = K w + J/K dw/dt + Tc/K sign(w)."""
    w = filled(record.readings[:, 1])
    columns = [_means(w, record, window), _slopes(w, record, window), _means(_sign(w), record, window)]
    k, lag, dead = _solve(columns, _volts(record, window))
    if k <= 0.0 or lag <= 0.0:
        return None
    return _values(record, R=1.0, K=k, J=lag * k, COULOMB=dead * k)


def _sign(w: FloatArray) -> FloatArray:
    slow = 0.01 * float(np.quantile(np.abs(w), 0.99)) + _LEAST
    direction: FloatArray = w / np.maximum(np.abs(w), slow)
    return direction
