"""The Kalman filter in service: one sample at a time, with the numbers of `motor_env.filters.kalman.run_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.filters.kalman import KalmanFilter, whitened_innovation
from motor_env.motor.model import N_STATES, Input
from motor_env.motor.parameters import FloatArray


class StreamSample(NamedTuple):
    """What one sample told, for each of the streams.

    Attributes:
        innovation: shape (n_streams, n_channels).
        whitened: the same, white and standard normal while the belief holds.
        nis: shape (n_streams,).
        state: updated estimate, shape (n_streams, 2).
    """

    innovation: FloatArray
    whitened: FloatArray
    nis: FloatArray
    state: FloatArray


class FilterStream:
    """A filter in service: `update(sample)` gives what `run_filter` gives at that sample.

    It filters each sample as a batch of one from the state where the last one left it.

    Attributes:
        kalman: the belief, from which it began.
        n_streams: motors followed side by side.
    """

    def __init__(self, kalman: KalmanFilter, n_streams: int = 1) -> None:
        shape = (n_streams, N_STATES, N_STATES)
        self.kalman = kalman
        self.n_streams = n_streams
        self._transition = np.broadcast_to(kalman.model.transition, shape)
        self._gain = np.broadcast_to(kalman.model.gain, (n_streams, N_STATES, len(Input)))
        self._state = np.broadcast_to(kalman.initial_state, (n_streams, N_STATES)).copy()
        self._covariance = np.broadcast_to(kalman.initial_covariance, shape).copy()

    def update(
        self, measurement: ArrayLike, voltage_v: ArrayLike, load_torque_n_m: ArrayLike = 0.0
    ) -> StreamSample:
        """Take one more sample (paper, Table 1).

        Args:
            measurement: shape (n_streams, n_channels), or anything that reshapes to it; NaN is missing.
            voltage_v: voltage held in the interval that the sample ends, scalar or shape (n_streams,).
            load_torque_n_m: load torque in that interval.
        """
        m = len(self.kalman.observation)
        measured = np.asarray(measurement, dtype=np.float64).reshape(self.n_streams, m)
        missing = np.isnan(measured)
        inputs = np.empty((self.n_streams, len(Input)))
        inputs[:, Input.VOLTAGE] = voltage_v
        inputs[:, Input.LOAD_TORQUE] = load_torque_n_m
        a = self._transition
        state = (a @ self._state[:, :, None] + self._gain @ inputs[:, :, None])[:, :, 0]
        covariance = a @ self._covariance @ np.swapaxes(a, 1, 2) + self.kalman.process_covariance
        c = np.where(missing[:, :, None], 0.0, self.kalman.observation)
        off = missing[:, :, None] ^ missing[:, None, :]
        noise = np.where(off, 0.0, self.kalman.measurement_covariance)
        spread = c @ covariance @ np.swapaxes(c, 1, 2) + noise
        gain = np.swapaxes(np.linalg.solve(spread, c @ covariance), 1, 2)
        left = np.eye(N_STATES) - gain @ c
        innovation = measured - state @ self.kalman.observation.T
        known = np.where(missing, 0.0, innovation)
        self._state = state + (gain @ known[:, :, None])[:, :, 0]
        self._covariance = left @ covariance @ np.swapaxes(left, 1, 2) + gain @ noise @ np.swapaxes(
            gain, 1, 2
        )
        whitened, _, _ = whitened_innovation(innovation, spread)
        nis = np.square(np.where(missing, 0.0, whitened)).sum(axis=-1)
        return StreamSample(innovation, whitened, nis, self._state.copy())
