"""Errors of a sensor: lag, gain, offset, noise, range, converter; compiled, in float32."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.parameters import FloatArray, Floats, require, require_finite, require_positive
from motor_env.simulation.random_streams import NORMALS_AT_ONCE, Stream, fill_case, whole_blocks

MAXIMUM_BITS = 24


@dataclass(frozen=True, slots=True)
class SensorChain:
    """Errors of one current sensor or one a case: z = quantise(clip(gain lag(i) + offset + noise)).

    Attributes:
        gain: factor on the current.
        offset_a: added after the gain.
        lag_s: time constant of a first-order lag.
        range_a: the reading saturates at plus and minus this value; 0 for no limit.
        adc_bits: bits of the converter over -range .. range; 0 for none.
        missing_fraction: share of samples that read NaN, in all channels.
    """

    gain: Floats = 1.0
    offset_a: Floats = 0.0
    lag_s: Floats = 0.0
    range_a: Floats = 0.0
    adc_bits: int = 0
    missing_fraction: float = 0.0

    def __post_init__(self) -> None:
        require_positive("gain", self.gain)
        require_finite("offset_a", self.offset_a)
        require_positive("lag_s", self.lag_s, zero_allowed=True)
        require_positive("range_a", self.range_a, zero_allowed=True)
        require(
            0 <= self.adc_bits <= MAXIMUM_BITS,
            f"adc_bits must be in 0 .. {MAXIMUM_BITS}, got {self.adc_bits}",
        )
        require(
            self.adc_bits == 0 or bool((np.asarray(self.range_a) > 0.0).all()),
            "range_a must be > 0 where adc_bits is given, got 0",
        )
        require(
            0.0 <= self.missing_fraction < 1.0,
            f"missing_fraction must be in [0, 1), got {self.missing_fraction:g}",
        )

    def rows(self, n_cases: int, dt_s: float) -> FloatArray:
        """Return gain, offset, share of the lag kept over one sample, range and converter step, (n_cases, 5)."""
        lag = np.asarray(self.lag_s, dtype=np.float64)
        kept = np.exp(-dt_s / np.where(lag > 0.0, lag, 1.0)) * (lag > 0.0)
        step = 2.0 * np.asarray(self.range_a) / 2.0**self.adc_bits if self.adc_bits else np.asarray(0.0)
        columns = (self.gain, self.offset_a, kept, self.range_a, step)
        return np.stack([np.broadcast_to(np.asarray(c, float), (n_cases,)) for c in columns], axis=1)


@njit(cache=True)
def _distort(row: NDArray[np.float32], chain: FloatArray) -> None:
    gain, offset, kept = chain[0], chain[1], chain[2]
    lagged = 0.0  # the quantity was 0 before the first sample
    for k in range(len(row)):
        lagged = kept * lagged + (1.0 - kept) * float(row[k])
        row[k] = np.float32(gain * lagged + offset)


@njit(cache=True)
def _convert(row: NDArray[np.float32], limit: float, step: float) -> None:
    for k in range(len(row)):
        value = float(row[k])
        if step > 0.0:
            value = np.floor(value / step + 0.5) * step
        row[k] = np.float32(min(max(value, -limit), limit - step))


_MEASUREMENT = int(Stream.MEASUREMENT)


@njit(cache=True)
def read_sensors(
    out: NDArray[np.float32],
    is_current: NDArray[np.bool_],
    chain: FloatArray,
    noise_std: NDArray[np.float32],
    seed: np.uint64,
    cases: NDArray[np.uint64],
) -> None:
    """Turn true quantities into readings, in place.

    Args:
        out: quantities, shape (n_cases, n_channels, n_samples).
        is_current: whether a channel is the current, on which the chain acts, shape (n_channels,).
        chain: `SensorChain.rows`, shape (n_cases, 5); (0, 5) for sensors without errors.
        noise_std: shape (n_cases or 1, n_channels, n_samples or 1).
        seed: the random seed.
        cases: case numbers, shape (n_cases,).
    """
    n_cases, n_channels, n_samples = out.shape
    words = np.empty((4, NORMALS_AT_ONCE // 4), dtype=np.uint32)
    scratch = np.empty(NORMALS_AT_ONCE, dtype=np.float32)
    stride = whole_blocks(n_samples)
    for n in range(n_cases):
        stds = noise_std[n if noise_std.shape[0] > 1 else 0]
        for c in range(n_channels):
            row = out[n, c]
            distorted = is_current[c] and chain.shape[0] > 0
            if distorted:
                _distort(row, chain[n])
            std = stds[c]
            is_constant = len(std) == 1
            for k in range(0, 0 if is_constant and std[0] == 0.0 else n_samples, NORMALS_AT_ONCE):
                part = row[k : k + NORMALS_AT_ONCE]
                z = scratch[: whole_blocks(len(part))]
                fill_case(seed, np.uint32(_MEASUREMENT), cases[n], c * stride + k, words, z)
                for j in range(len(part)):
                    part[j] += std[0 if is_constant else k + j] * z[j]
            if distorted and chain[n, 3] > 0.0:
                _convert(row, chain[n, 3], chain[n, 4])
