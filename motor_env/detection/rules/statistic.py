"""The statistic of a rule, sample by sample: what the batch, the stream and the simulations of a rule all run."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from motor_env.detection.rules.thresholds import Request, Threshold
from motor_env.motor.parameters import FloatArray, require


class Statistic(ABC):
    """A running statistic of whitened innovations, and the exact threshold on it where theory gives one."""

    __slots__ = ()

    @property
    def n_channels(self) -> int | None:
        """Channels that the rule needs, or None where it takes any number."""
        return None

    @abstractmethod
    def start(self, n_streams: int, n_channels: int) -> FloatArray:
        """State before the first sample, shape (n_streams, width)."""

    @abstractmethod
    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Statistic after each sample, shape (n_streams, n_samples); the state is carried on in place.

        Args:
            state: as `start` gives it.
            whitened: shape (n_streams, n_samples, n_channels). A channel that is NaN was not measured: the rule takes
                no notice of it.
        """

    def exact_threshold(self, request: Request, n_channels: int) -> Threshold | None:
        """Threshold by theory, None where there is none and it has to be simulated."""
        return None

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after each sample.

        Args:
            whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`.

        Returns:
            Shape (..., n_samples).
        """
        values = np.asarray(whitened, dtype=np.float64)
        require(
            values.ndim >= 2 and self.n_channels in (None, values.shape[-1]),
            f"whitened must have shape (..., n_samples, {self.n_channels or 'n_channels'}), got {values.shape}",
        )
        flat = np.ascontiguousarray(values.reshape(-1, *values.shape[-2:]))
        return self.scan(self.start(len(flat), flat.shape[-1]), flat).reshape(values.shape[:-1])
