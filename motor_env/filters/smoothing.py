"""The fixed-interval smoother (Rauch, Tung & Striebel 1965).

Rauch's recursion inverts the predicted covariance, which fades without process noise. So states come from the adjoint
of the filter (Bryson & Frazier 1963; Bierman 1973), covariances from the information of the later samples (Fraser &
Potter 1969).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from motor_env.common.arrays import instance, numbers
from motor_env.filters.batch import FilterResult
from motor_env.filters.kalman import KalmanFilter, masked_sensor, require_belief
from motor_env.motor.compiled import compiled, inlined, njit
from motor_env.motor.model import N_STATES
from motor_env.motor.parameters import FloatArray, require


class Smoothed(NamedTuple):
    """Estimates from all samples.

    Attributes:
        state: shape (..., n_samples, 2).
        covariance: shape (n_samples, 2, 2), or (..., n_samples, 2, 2) where the filter's has the cases' axes.
    """

    state: FloatArray
    covariance: FloatArray


# Written out: a product of arrays of four numbers would take ten times as long.


@inlined
def _congruence(x: FloatArray, y: FloatArray, out: FloatArray) -> None:
    """Compute x y x' of a symmetric y."""
    t00, t01 = x[0, 0] * y[0, 0] + x[0, 1] * y[0, 1], x[0, 0] * y[0, 1] + x[0, 1] * y[1, 1]
    t10, t11 = x[1, 0] * y[0, 0] + x[1, 1] * y[0, 1], x[1, 0] * y[0, 1] + x[1, 1] * y[1, 1]
    u01 = t00 * x[1, 0] + t01 * x[1, 1]
    out[0, 0], out[1, 1] = t00 * x[0, 0] + t01 * x[0, 1], t10 * x[1, 0] + t11 * x[1, 1]
    out[0, 1] = out[1, 0] = u01


@inlined
def _less(x: FloatArray, y: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """Compute (I + x y)^-1 x: a covariance x given an information y, or the reverse."""
    p00, p01 = 1.0 + x[0, 0] * y[0, 0] + x[0, 1] * y[1, 0], x[0, 0] * y[0, 1] + x[0, 1] * y[1, 1]
    p10, p11 = x[1, 0] * y[0, 0] + x[1, 1] * y[1, 0], 1.0 + x[1, 0] * y[0, 1] + x[1, 1] * y[1, 1]
    scale = 1.0 / (p00 * p11 - p01 * p10)
    w[0, 0], w[0, 1], w[1, 0], w[1, 1] = p11 * scale, -p01 * scale, -p10 * scale, p00 * scale
    _congruence(x, y, out)
    for r in range(2):
        for c in range(2):
            out[r, c] += x[r, c]
    _congruence(w, out, out)


@compiled
def _smoothed_covariance(
    forward: FloatArray,
    q: FloatArray,
    information: FloatArray,
    covariance: FloatArray,
    smoothed: FloatArray,
    room: FloatArray,
) -> None:
    later, now, w = room[0], room[1], room[2]
    for k in range(len(covariance) - 1, -1, -1):
        _less(covariance[k], later, w, smoothed[k])
        for r in range(2):
            for c in range(2):
                now[r, c] = information[k, r, c] + later[r, c]
        _less(now, q, w, later)
        _congruence(forward, later, later)


@njit(cache=True)
def _smoothed_states(
    a: FloatArray,
    c: FloatArray,
    weighted: FloatArray,
    gain: FloatArray,
    covariance: FloatArray,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Compute states x - P l of cases with one covariance, backwards: l <- A' (l - C' (S^-1 e + K' l))."""
    for n in range(len(state)):
        l0 = l1 = 0.0
        for k in range(state.shape[1] - 1, -1, -1):
            p, g = covariance[k], gain[k]
            out[n, k, 0] = state[n, k, 0] - (p[0, 0] * l0 + p[0, 1] * l1)
            out[n, k, 1] = state[n, k, 1] - (p[1, 0] * l0 + p[1, 1] * l1)
            t0, t1 = l0, l1
            for m in range(weighted.shape[2]):
                take = weighted[n, k, m] + g[0, m] * l0 + g[1, m] * l1
                t0, t1 = t0 - c[m, 0] * take, t1 - c[m, 1] * take
            l0, l1 = a[0, 0] * t0 + a[1, 0] * t1, a[0, 1] * t0 + a[1, 1] * t1


def _checked(result: FilterResult, n_channels: int, motors: tuple[int, ...]) -> FilterResult:
    """Return the result with the shapes that the compiled loops rely on."""
    innovation = numbers(
        "result.innovation", result.innovation, ("...", "n_samples", n_channels), missing=True
    )
    batch, n_samples = innovation.shape[:-2], innovation.shape[-2]
    covariance = numbers("result.covariance", result.covariance)
    lead = covariance.shape[:-3]
    require(
        lead in ((), batch) and motors in ((), (1,), batch),
        f"result must be of the filter's motors {motors}, got innovations of shape {innovation.shape} and covariances"
        f" of {covariance.shape}",
    )
    shapes = {
        "innovation_covariance": (*lead, n_samples, n_channels, n_channels),
        "state": (*batch, n_samples, N_STATES),
        "covariance": (*lead, n_samples, N_STATES, N_STATES),
        "gain": (*lead, n_samples, N_STATES, n_channels),
    }
    checked = {
        name: numbers(f"result.{name}", getattr(result, name), shape) for name, shape in shapes.items()
    }
    return result._replace(innovation=innovation, **checked)


def smooth(kalman: KalmanFilter, result: FilterResult) -> Smoothed:
    """Return smoothed states and covariances (Rauch, Tung & Striebel 1965; Bierman 1973; Fraser & Potter 1969).

    Args:
        kalman: the filter.
        result: of `run_filter`.

    Raises:
        ValueError: the result is of another filter.
    """
    require_belief(kalman)
    instance("result", result, FilterResult)
    result = _checked(result, len(kalman.observation), kalman.model.transition.shape[:-2])
    n_samples, n_channels = result.innovation.shape[-2:]
    known = np.nan_to_num(result.innovation)
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            weighted = np.linalg.solve(result.innovation_covariance, known[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise ValueError("result.innovation_covariance must be positive definite") from None
    weighted = np.ascontiguousarray(weighted).reshape(-1, n_samples, n_channels)
    state = result.state.reshape(-1, n_samples, N_STATES)
    covariance = result.covariance.reshape(-1, n_samples, N_STATES, N_STATES)
    gain = result.gain.reshape(-1, n_samples, N_STATES, n_channels)
    transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
    q, c = kalman.process_covariance, kalman.observation
    missing = np.isnan(result.innovation).reshape(weighted.shape)[: len(covariance)]
    # The information of a sample depends only on which channels are missing: one table of all cases, (2, ..., 2, 2).
    patterns = np.moveaxis(np.indices((2,) * n_channels), 0, -1) == 1
    rows, noise = masked_sensor(c, kalman.measurement_covariance, patterns)
    table = rows.swapaxes(-1, -2) @ np.linalg.solve(noise, rows)
    information = table[tuple(np.moveaxis(missing.astype(np.intp), -1, 0))]
    spread, out = np.empty_like(covariance), np.empty_like(state)
    for n, filtered in enumerate(covariance):
        cases = slice(None) if len(covariance) == 1 else slice(n, n + 1)
        a = transition[min(n, len(transition) - 1)]
        forward, room = np.ascontiguousarray(a.T), np.zeros((3, 2, 2))
        _smoothed_covariance(forward, q, information[n], filtered, spread[n], room)
        _smoothed_states(a, c, weighted[cases], gain[n], filtered, state[cases], out[cases])
    numbers("states of the result", out)
    numbers("covariances of the result", spread)
    return Smoothed(out.reshape(result.state.shape), spread.reshape(result.covariance.shape))
