"""The Kalman filter in service: one sample at a time, with the numbers of `motor_env.filters.batch.run_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.filters.kalman import KalmanFilter, measurement_update, score
from motor_env.motor.model import N_STATES, Input
from motor_env.motor.parameters import FloatArray


class StreamSample(NamedTuple):
    """The filter's results for one sample of each stream.

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
        kalman, a = self.kalman, self._transition
        measured = np.asarray(measurement, dtype=np.float64).reshape(self.n_streams, len(kalman.observation))
        inputs = np.empty((self.n_streams, len(Input)))
        inputs[:, Input.VOLTAGE] = voltage_v
        inputs[:, Input.LOAD_TORQUE] = load_torque_n_m
        updated = measurement_update(
            (a @ self._state[:, :, None] + self._gain @ inputs[:, :, None])[:, :, 0],
            a @ self._covariance @ np.swapaxes(a, 1, 2) + kalman.process_covariance,
            measured,
            observation=kalman.observation,
            noise=kalman.measurement_covariance,
        )
        self._state, self._covariance = updated.state, updated.covariance
        scores = score(updated.innovation[:, None], updated.innovation_covariance[:, None])
        return StreamSample(updated.innovation, scores.whitened[:, 0], scores.nis[:, 0], self._state.copy())
