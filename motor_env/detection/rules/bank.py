"""Bank of models as a rule: which of several faults has begun, if any, and with what probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from motor_env.detection.rules import kernels
from motor_env.detection.rules.cusum import DirectedRule
from motor_env.motor.parameters import FloatArray, require


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

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Log of the summed odds over rho."""
        weights = np.full(len(self.shifts), 1.0 / len(self.shifts))
        return kernels.mixture(self.series(whitened), np.asarray(self.shifts), weights, state)

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
        series = self.series(flat)[..., None]
        ratios = np.where(np.isnan(series), 0.0, shifts * (series - 0.5 * shifts))
        for k in range(flat.shape[1]):
            log_odds = np.logaddexp(log_odds, start) - np.log1p(-hazard) + ratios[:, k]
            stacked = np.concatenate([np.zeros((len(flat), 1)), log_odds], axis=1)
            answer[:, k] = np.exp(stacked - logsumexp(stacked, axis=1, keepdims=True))
        return answer.reshape(*values.shape[:-1], 1 + len(shifts))
