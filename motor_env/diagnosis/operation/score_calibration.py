"""Scores of windows, calibrated on healthy windows of the same motor.

A window's distance along a direction is compared with what healthy windows scatter (Student's t, whose tail is fitted
by moments). A slow healthy drift is allowed for as a bias, never learned as noise: noise averages away over time.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from motor_env.diagnosis.operation.windows import WARMTH
from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.verdict.hypotheses import EXPONENTS, NAMES
from motor_env.motor import identifiable as quantities
from motor_env.motor.healthy import ScoreCalibration
from motor_env.motor.parameters import FloatArray

_P = len(NAMES)
_FARTHER = (0.005, 0.1)  # least and largest probability of a healthy drift beyond the allowed bias
_LEAST_EXCESS = 1e-3  # of the kurtosis
_NAMED_WEIGHT = 4.0  # of a fault with a name, over that of any other change


def fault_directions() -> tuple[FloatArray, FloatArray]:
    """Return unit vectors along which faults move the logarithms of R, K, J and B, and their weights, which sum to 1.

    Those of the faults with a name, and up and down each quantity; each once. Shapes (n, 4) and (n,).
    """
    named = [quantities.visible_direction(kind, EXPONENTS) for kind in quantities.nameable_kinds(EXPONENTS)]
    rows = np.array([*named, *np.eye(_P), *-np.eye(_P)])
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    first = [n for n, row in enumerate(unit) if not np.isclose(unit[:n], row).all(axis=1).any()]
    weights = np.where(np.array(first) < len(named), _NAMED_WEIGHT, 1.0)
    return unit[first], weights / weights.sum()


def learn_calibration(
    logs: FloatArray, errors: FloatArray, prior_sd: FloatArray, *, temperature_k: float
) -> ScoreCalibration:
    """Learn how healthy windows scatter, and how far a healthy motor may drift.

    Of Student's t with f degrees of freedom the kurtosis is 3 + 6 / (f - 4). It is taken one standard error larger than
    it is.

    Args:
        logs: of R, K, J and B over the healthy ones, shape (n, 4).
        errors: their covariances as the fits believe them, shape (n, 4, 4).
        prior_sd: how far each logarithm may drift for no known reason, shape (4,); 0 where only a fault moves it.
        temperature_k: how much warmer or colder the motor may be, one standard deviation.
    """
    off, count = logs - logs.mean(axis=0), len(logs)
    white = np.linalg.solve(np.linalg.cholesky(errors), off[..., None])[..., 0]
    white -= white.mean(axis=0)
    scatter = white.T @ white
    alike = max(float(np.trace(scatter)) / _P / (count - 1), 1e-12) * np.eye(_P)
    covariance = (scatter + PRIOR_WEIGHT * alike) / (count - 1 + PRIOR_WEIGHT)
    unit = np.linalg.solve(np.linalg.cholesky(covariance), white.T)
    kurtosis = float(np.mean(unit**4) / np.mean(unit**2) ** 2) + math.sqrt(24.0 / unit.size)
    drift = np.diag(np.square(prior_sd)) + temperature_k**2 * np.outer(WARMTH, WARMTH)
    return ScoreCalibration(
        windows=count,
        covariance=covariance,
        degrees_of_freedom=4.0 + 6.0 / max(kurtosis - 3.0, _LEAST_EXCESS),
        drift_covariance=drift + np.cov(off.T) / count,
    )


def believed_calibration(log_covariance: FloatArray, freedom: float, windows: int) -> ScoreCalibration:
    """Return the calibration of a motor whose windows were not compared: their spread counts as a drift."""
    return ScoreCalibration(max(windows, 2), np.eye(_P), max(freedom, 2.0), log_covariance)


def normal_scores(
    calibration: ScoreCalibration,
    logs: FloatArray,
    error: FloatArray,
    directions: FloatArray,
    windows_between_alarms: float,
) -> FloatArray:
    """Score a window along directions, shape (n,): standard normal or less while the motor is healthy.

    Each is the linear combination of R, K, J and B that tells that fault best from scatter and drift. With few windows
    to learn from, a distance by a sample's inverse covariance is that of a t with fewer degrees and a larger scale
    (Hotelling).

    Args:
        calibration: of the healthy windows.
        logs: of the window's R, K, J and B over the healthy ones, shape (4,).
        error: their covariance as the fit believes it, shape (4, 4).
        directions: unit vectors, shape (n, 4).
        windows_between_alarms: the more, the farther a healthy motor may drift.
    """
    root = np.linalg.cholesky(error)
    spread, drift = root @ calibration.covariance @ root.T, calibration.drift_covariance
    slopes = np.linalg.solve(spread + drift, directions.T)
    slopes /= np.sqrt(np.einsum("pd,pq,qd->d", slopes, spread, slopes))
    probability = min(max(1.0 / windows_between_alarms, _FARTHER[0]), _FARTHER[1])
    allowed = -float(stdtrit(calibration.windows - 1, probability))
    bias = allowed * np.sqrt(np.einsum("pd,pq,qd->d", slopes, drift, slopes))
    taught = calibration.windows + PRIOR_WEIGHT - 1.0
    left = max(taught - _P + 1.0, 1.0)
    freedom = min(left, calibration.degrees_of_freedom)
    tails = stdtr(freedom, (bias - logs @ slopes) / math.sqrt(taught / left))
    scores: FloatArray = -ndtri(tails)
    return np.where(np.isnan(scores), 0.0, scores)
