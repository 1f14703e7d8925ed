"""Compiled loops of the fits: states of the linear motor, their slopes, and normal equations case by case.

`motor_env.inference.sensitivities` calls them. Motors begin at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.model import N_STATES
from motor_env.motor.parameters import FloatArray


@njit(cache=True)
def fill_sensitivities(
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    states: FloatArray,
    slopes: FloatArray,
) -> None:
    """One motor's states, (2, n_samples), and their derivatives, (size, 2, n_samples), by the exact recursion.

    s[k+1] = A s[k] + A' x[k] + B' u[k], from rest and without a load.
    """
    a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    b0, b1 = gain[0, 0], gain[1, 0]
    x0, x1 = 0.0, 0.0
    for k in range(states.shape[1]):
        x0, x1 = a00 * x0 + a01 * x1 + b0 * voltage[k], a10 * x0 + a11 * x1 + b1 * voltage[k]
        states[0, k], states[1, k] = x0, x1
    for j in range(slopes.shape[0]):
        d00, d01 = transition_slope[j, 0, 0], transition_slope[j, 0, 1]
        d10, d11 = transition_slope[j, 1, 0], transition_slope[j, 1, 1]
        e0, e1 = gain_slope[j, 0, 0], gain_slope[j, 1, 0]
        x0, x1, s0, s1 = 0.0, 0.0, 0.0, 0.0
        for k in range(states.shape[1]):
            f0 = d00 * x0 + d01 * x1 + e0 * voltage[k]
            f1 = d10 * x0 + d11 * x1 + e1 * voltage[k]
            s0, s1 = a00 * s0 + a01 * s1 + f0, a10 * s0 + a11 * s1 + f1
            slopes[j, 0, k], slopes[j, 1, k] = s0, s1
            x0, x1 = states[0, k], states[1, k]


@njit(cache=True)
def fill_normal_equations(
    rows: NDArray[np.int64],
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    measurements: FloatArray,
    observation: FloatArray,
    chi2: FloatArray,
    gradient: FloatArray,
    information: FloatArray,
) -> None:
    """Weighted squares, J'r and J'J of each row; `observation` is C divided by the noise, as `measurements` are."""
    n_channels, n_samples, size = measurements.shape[1], measurements.shape[2], gradient.shape[1]
    states, slopes = np.empty((N_STATES, n_samples)), np.empty((size, N_STATES, n_samples))
    residual = np.empty(n_samples)
    jacobian = np.empty((size, n_samples))
    for n in range(rows.shape[0]):
        row = rows[n]
        fill_sensitivities(
            transition[n], gain[n], transition_slope[n], gain_slope[n], voltage, states, slopes
        )
        chi2[n] = 0.0
        gradient[n] = 0.0
        information[n] = 0.0
        for m in range(n_channels):
            c0, c1 = observation[m, 0], observation[m, 1]
            for k in range(n_samples):
                residual[k] = measurements[row, m, k] - c0 * states[0, k] - c1 * states[1, k]
            for j in range(size):
                for k in range(n_samples):
                    jacobian[j, k] = c0 * slopes[j, 0, k] + c1 * slopes[j, 1, k]
            chi2[n] += np.dot(residual, residual)
            gradient[n] += np.dot(jacobian, residual)
            information[n] += np.dot(jacobian, jacobian.T)
