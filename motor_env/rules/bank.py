"""Bank of models as a rule: which of several faults has begun, if any, and with what probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from motor_env.parameters import FloatArray, require
from motor_env.rules.base import Threshold, Wanted
from motor_env.rules.calibration import CALIBRATION_SEED, simulated_threshold
from motor_env.rules.cusum import DirectedRule, projected


@dataclass(frozen=True, slots=True)
class ModelBank(DirectedRule):
    """Multiple models with an onset: each model j is a shift d_j of the whitened innovation that begins at any sample.

    With a hazard rho of an onset in each sample the odds of model j against health obey
    O_j = (O_j + rho w_j) L_j / (1 - rho) (Shiryaev 1963; multiple models: Magill 1965, Willsky 1976). The statistic is
    the log of the summed odds over rho for rho -> 0, a mixture of Shiryaev-Roberts statistics; `probabilities` gives
    the posterior for a chosen hazard. Each model has the same weight.

    Attributes:
        shifts: d_j in standard deviations of the innovation; either sign.
        direction: over the channels; by default the first one.
    """

    shifts: tuple[float, ...]
    direction: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        require(len(self.shifts) > 0 and all(self.shifts), f"shifts must be other than 0, got {self.shifts}")

    def start(self, n_streams: int, n_channels: int) -> FloatArray:
        """Odds over rho of each model; none so far."""
        return np.zeros((n_streams, len(self.shifts)))

    def step(self, state: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log of the summed odds over rho."""
        value = projected(whitened, self.direction)
        value[np.isnan(whitened).all(axis=1)] = np.nan
        odds, answer = state.copy(), np.empty((len(state), 1))
        _mixture(value[:, None], np.asarray(self.shifts), odds, answer)
        return odds, answer[:, 0]

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after each sample, shape (..., n_samples): as the stream gives it."""
        values = np.asarray(whitened, dtype=np.float64)
        require(
            values.ndim >= 2 and self.n_channels in (None, values.shape[-1]),
            f"whitened must have shape (..., n_samples, {self.n_channels or 'n_channels'}), got {values.shape}",
        )
        flat = values.reshape(-1, values.shape[-1])
        series = projected(flat, self.direction)
        series[np.isnan(flat).all(axis=1)] = np.nan
        series = series.reshape(-1, values.shape[-2])
        answer = np.empty_like(series)
        _mixture(series, np.asarray(self.shifts), self.start(len(series), values.shape[-1]), answer)
        return answer.reshape(values.shape[:-1])

    def probabilities(self, whitened: FloatArray, hazard: float) -> FloatArray:
        """Posterior of health and of each model after each sample.

        Args:
            whitened: shape (..., n_samples, n_channels).
            hazard: rho, the probability of an onset in a sample, between 0 and 1.

        Returns:
            Shape (..., n_samples, 1 + n_models), health first.
        """
        require(0.0 < hazard < 1.0, f"hazard must lie between 0 and 1, got {hazard:g}")
        values = np.asarray(whitened, dtype=np.float64)
        flat = values.reshape(-1, *values.shape[-2:])
        shifts = np.asarray(self.shifts)
        start = np.log(hazard / len(shifts))
        log_odds = np.full((len(flat), len(shifts)), -np.inf)
        answer = np.empty((*flat.shape[:2], 1 + len(shifts)))
        for k in range(flat.shape[1]):
            value = projected(flat[:, k], self.direction)[:, None]
            ratio = np.where(
                np.isnan(flat[:, k]).all(axis=1, keepdims=True), 0.0, shifts * (value - 0.5 * shifts)
            )
            log_odds = np.logaddexp(log_odds, start) - np.log1p(-hazard) + ratio
            stacked = np.concatenate([np.zeros((len(flat), 1)), log_odds], axis=1)
            answer[:, k] = np.exp(stacked - logsumexp(stacked, axis=1, keepdims=True))
        return answer.reshape(*values.shape[:-1], 1 + len(shifts))

    def threshold_for(
        self,
        *,
        arl0: float | None = None,
        false_alarm_probability: float | None = None,
        n_samples: int | None = None,
        n_channels: int = 1,
        runs: int | None = None,
        seed: int = CALIBRATION_SEED,
    ) -> Threshold:
        """Threshold by simulation, with its standard error; by default 20,000 runs, 2,000 for an average run length."""
        wanted = Wanted.checked(arl0, false_alarm_probability, n_samples)
        count = runs if runs is not None else (2_000 if wanted.arl0 is not None else 20_000)
        return simulated_threshold(self, wanted, runs=count, n_channels=n_channels, seed=seed)


_LARGEST_ODDS = 1e250


@njit(cache=True)
def _mixture(series: FloatArray, shifts: FloatArray, odds: FloatArray, answer: FloatArray) -> None:
    """O_j <- (O_j + 1/n) L_j; the answer is log sum O. Odds are held below a number that cannot overflow."""
    count = len(shifts)
    for n in range(series.shape[0]):
        for k in range(series.shape[1]):
            value = series[n, k]
            total = 0.0
            for j in range(count):
                if not np.isnan(value):
                    ratio = np.exp(shifts[j] * (value - 0.5 * shifts[j]))
                    odds[n, j] = min((odds[n, j] + 1.0 / count) * ratio, _LARGEST_ODDS)
                total += odds[n, j]
            answer[n, k] = np.log(total) if total > 0.0 else -np.inf
