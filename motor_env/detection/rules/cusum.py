"""Rules for an onset in mid-run: CUSUM, Shiryaev-Roberts, Wald's test, and a bank of models.

They read the first channel of the whitened innovations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from motor_env.common.arrays import instance, number, numbers
from motor_env.detection.rules import kernels
from motor_env.detection.rules.base import ExactRule, Rule, checked_shift
from motor_env.detection.rules.calibration import Request, Threshold
from motor_env.detection.run_length import RunLaw, TwoSided, cusum_chain, shiryaev_roberts_chain, sprt_chain
from motor_env.motor.parameters import FloatArray, require

_SMALLEST_SHIFT, _LARGEST_SHIFT = 1e-6, 1e3  # in standard deviations: others are no question


def first_channel(whitened: FloatArray) -> FloatArray:
    """Return standard normal samples, shape (n_streams, n_samples); NaN where nothing was measured."""
    return np.ascontiguousarray(whitened[..., 0])


def _keep_shift(rule: Rule, shift: float) -> None:
    found = number("shift", shift, least=_SMALLEST_SHIFT, most=_LARGEST_SHIFT)
    object.__setattr__(rule, "shift", found)


@dataclass(frozen=True, slots=True)
class Cusum(ExactRule):
    """CUSUM: S = max(0, S + r - d/2), for a shift d of the mean from an unknown time on (Page 1954).

    With the true shift it has the least worst-case delay for its ARL0 (Moustakides 1986). Thresholds are exact (Goel &
    Wu 1971).

    Attributes:
        shift: d, in standard deviations of the innovation; > 0.
        two_sided: whether a fall counts, too.
    """

    shift: float
    two_sided: bool = False

    def __post_init__(self) -> None:
        _keep_shift(self, self.shift)
        instance("two_sided", self.two_sided, (bool, np.bool_))

    def start(self, n_streams: int) -> FloatArray:
        """Return sums of 0."""
        return np.zeros((n_streams, 2 if self.two_sided else 1))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the larger sum."""
        statistic: FloatArray = kernels.cusum(first_channel(whitened), 0.5 * self.shift, state)
        return statistic

    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """Return the law by integral equation from S = 0; a `shift` of d gives the worst-case delay."""
        up = cusum_chain(0.5 * self.shift, threshold, shift)
        if not self.two_sided:
            return up
        return TwoSided(up, cusum_chain(0.5 * self.shift, threshold, -shift) if shift else up)


@dataclass(frozen=True, slots=True)
class ShiryaevRoberts(ExactRule):
    """Shiryaev-Roberts: R = (1 + R) L, with L the likelihood ratio of a shift d; the statistic is log R.

    Optimal on average over onsets long after the start (Shiryaev 1963, Roberts 1966, Pollak & Tartakovsky 2009).

    Attributes:
        shift: d, > 0.
    """

    shift: float

    def __post_init__(self) -> None:
        _keep_shift(self, self.shift)

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return log R, a bank of one model."""
        with np.errstate(over="ignore"):  # the odds have a largest value
            return kernels.mixture(first_channel(whitened), np.array([self.shift]), np.ones(1), state)

    @property
    def lowest(self) -> tuple[float, float]:
        """Return a threshold on log R that is surely too low, and the first step upwards from there."""
        return -self.shift * (0.5 * self.shift + 8.0), 1.0

    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """Return the law by integral equation from R = 0."""
        return shiryaev_roberts_chain(self.shift, threshold, shift)


@dataclass(frozen=True, slots=True)
class Sprt(ExactRule):
    """Wald's sequential probability ratio test of a shift d from the start on (Wald 1945).

    The statistic is the log-likelihood ratio; at `lower` the motor is accepted as healthy.

    Attributes:
        shift: d, > 0.
        lower: log(missed / (1 - false alarms)) in Wald's approximation; < 0.
        restart: whether an accepted test restarts; else it stays silent.
    """

    shift: float
    lower: float = -4.6
    restart: bool = False

    def __post_init__(self) -> None:
        _keep_shift(self, self.shift)
        object.__setattr__(self, "lower", number("lower", self.lower, below=0.0))
        instance("restart", self.restart, (bool, np.bool_))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the log-likelihood ratio; minus infinity once accepted, or 0 at a restart."""
        series = first_channel(whitened)
        statistic: FloatArray = kernels.sprt(series, self.shift, self.lower, self.restart, state)
        return statistic

    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """Return the law by integral equation from ratio 1."""
        return sprt_chain(self.shift, self.lower, threshold, restart=self.restart, shift=shift)

    def average_run_length(self, threshold: float, shift: float = 0.0) -> float:
        """Return the average samples to the alarm with restarts, for samples of mean `shift`; infinite without."""
        threshold, shift = number("threshold", threshold), checked_shift(shift)
        return ExactRule.average_run_length(self, threshold, shift) if self.restart else np.inf

    def exact_threshold(self, request: Request, n_channels: int) -> Threshold:
        """Return an exact upper bound (integral equation)."""
        require(
            request.arl0 is None or self.restart,
            "arl0 needs restart=True: a test that stays silent has no average run length",
        )
        return ExactRule.exact_threshold(self, request, n_channels)


@dataclass(frozen=True, slots=True)
class ModelBank(Rule):
    """Bank of models: model j is a shift d_j of the whitened innovation from any sample on.

    With a hazard rho of an onset in each sample the odds of model j against health obey O_j = (O_j + rho w_j) L_j / (1
    - rho) (Shiryaev 1963; multiple models: Magill 1965, Willsky 1976). The statistic is the log of the summed odds over
    rho for rho -> 0, a mixture of Shiryaev-Roberts statistics of equal weight.

    Attributes:
        shifts: d_j in standard deviations of the innovation; either sign.
    """

    shifts: tuple[float, ...]

    def __post_init__(self) -> None:
        shifts = numbers("shifts", self.shifts, ("n_models",))
        require(
            bool(((shifts != 0.0) & (np.abs(shifts) <= _LARGEST_SHIFT)).all()),
            f"shifts must be other than 0 and at most {_LARGEST_SHIFT:g}, got {shifts.tolist()}",
        )
        object.__setattr__(self, "shifts", tuple(shifts.tolist()))

    def start(self, n_streams: int) -> FloatArray:
        """Return the odds over rho of each model, 0."""
        return np.zeros((n_streams, len(self.shifts)))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the log of the summed odds over rho."""
        weights = np.full(len(self.shifts), 1.0 / len(self.shifts))
        with np.errstate(over="ignore"):
            return kernels.mixture(first_channel(whitened), np.asarray(self.shifts), weights, state)

    def probabilities(self, whitened: FloatArray, hazard: float) -> FloatArray:
        """Return the posterior of health and of each model, shape (..., n_samples, 1 + n_models), health first.

        Args:
            whitened: shape (..., n_samples, n_channels).
            hazard: rho, the probability of an onset in a sample, between 0 and 1.
        """
        hazard = number("hazard", hazard, above=0.0, below=1.0)
        values = numbers("whitened", whitened, ("...", "n_samples", "n_channels"), missing=True)
        flat = values.reshape(-1, *values.shape[-2:])
        shifts = np.asarray(self.shifts)
        start = np.log(hazard / len(shifts))
        log_odds = np.full((len(flat), len(shifts)), -np.inf)
        answer = np.empty((*flat.shape[:2], 1 + len(shifts)))
        series = first_channel(flat)[..., None]
        ratios = np.where(np.isnan(series), 0.0, shifts * (series - 0.5 * shifts))
        for k in range(flat.shape[1]):
            log_odds = np.logaddexp(log_odds, start) - np.log1p(-hazard) + ratios[:, k]
            stacked = np.concatenate([np.zeros((len(flat), 1)), log_odds], axis=1)
            answer[:, k] = np.exp(stacked - logsumexp(stacked, axis=1, keepdims=True))
        return answer.reshape(*values.shape[:-1], 1 + len(shifts))
