"""How well one real start tells what was fitted to it.

The residual of a real motor is not white: the model is never complete. The covariance of the estimates is therefore
the sandwich (J'J)^-1 J' W J (J'J)^-1 with W the autocovariance of the residual (Bartlett window; Newey & West 1987),
never the textbook one from white noise.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from motor_env.identification.residuals import Problem
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.noise import difference_noise

_ANYTHING_LOG_SD = 3.0


def unknowns_covariance(
    problem: Problem, unknowns: FloatArray, jacobian: FloatArray
) -> tuple[FloatArray, tuple[float, ...]]:
    """Covariance of the unknowns under autocorrelated residuals, and the number of independent samples.

    Each channel's residual is taken as a stationary series with the autocovariance that it shows up to a tenth of
    the recording, and with no less power at any frequency than its white noise. A coarse converter adds an error that
    is the same in every sample of the running motor. What no sample tells has a standard deviation of 3 in its
    logarithm, a prior that is too weak to matter elsewhere, and the onset is known to half an interval and half the
    current's rise: between two samples far apart, the fit's slope at one place does not see their bounds.
    """
    n, residuals = len(problem.start.time_s), problem.residuals(unknowns)
    n_measured = len(problem.measured)
    parameters, extension, *_ = problem.split(unknowns)
    rise = (
        parameters.inductance_h / parameters.resistance_ohm + extension.supply_rise_s + extension.sensor_lag_s
    )
    weak = np.full(jacobian.shape[1], _ANYTHING_LOG_SD)
    weak[-2:] = 0.5 * (problem.start.dt_s + rise), np.inf
    jacobian = np.concatenate([jacobian, np.diag(1.0 / weak)])
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150)
    jacobian = jacobian / size
    bread = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12)
    meat = jacobian[n_measured:].T @ jacobian[n_measured:]  # the priors
    independent = []
    for begin in range(0, n_measured, n):
        series = residuals[begin : begin + n] - residuals[begin : begin + n].mean()
        lags = max(n // 10, 2)
        length = fft.next_fast_len(2 * n - 1, real=True)
        spectrum = fft.rfft(series, length) * fft.rfft(series[::-1], length)
        full = fft.irfft(spectrum, length)[n - 1 : n - 1 + lags] / n
        taper = full * (1.0 - np.arange(lags) / lags)
        part = jacobian[begin : begin + n]
        meat = meat + part.T @ _coloured(
            part, taper, difference_noise(series[problem.start.alignment.onset_index :])
        )
        inflation = max(float(2.0 * np.sum(taper) - taper[0]) / max(float(taper[0]), 1e-300), 1.0)
        independent.append(n / inflation)
    running = slice(problem.start.alignment.onset_index, n)
    level = problem.start.alignment.unseen_level_a / problem.scale[0] * jacobian[running].sum(axis=0)
    meat = meat + np.outer(level, level)
    # Rounding may leave a direction that hardly matters a negative variance.
    values, vectors = np.linalg.eigh(0.5 * (meat + meat.T))
    spread = bread @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return spread @ spread.T / np.outer(size, size), tuple(independent)


def _coloured(columns: FloatArray, covariance: FloatArray, noise: float) -> FloatArray:
    """Covariance matrix of a stationary series times columns.

    A spectrum from one short series scatters by a third at each frequency; what it shows below the white noise is
    chance, and would make a steady level look better known than its noise allows.

    Args:
        columns: shape (n, m).
        covariance: of samples 0, 1, ... apart, shape (lags,).
        noise: standard deviation of the white noise in it.

    Returns:
        Shape (n, m).
    """
    n, lags = len(columns), len(covariance)
    size = n + 2 * lags
    kernel = np.concatenate([covariance, np.zeros(size - 2 * lags + 1), covariance[:0:-1]])
    spectrum = np.maximum(np.fft.rfft(kernel).real, noise**2)
    out: FloatArray = np.fft.irfft(spectrum[:, None] * np.fft.rfft(columns, size, axis=0), size, axis=0)[:n]
    return out


def capped(covariance: FloatArray) -> FloatArray:
    """A covariance of logarithms with no standard deviation above 10: what is not told to e^10 is not told."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    out: FloatArray = (vectors * np.clip(values, 1e-12, 100.0)) @ vectors.T
    return out
