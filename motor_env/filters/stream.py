"""The Kalman filter in service: one sample at a time, with the numbers of `motor_env.filters.batch.run_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.filters.batch import innovations_and_states
from motor_env.filters.kalman import KalmanFilter, schedules, score
from motor_env.motor.model import N_STATES, Input, propagate
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
        self.kalman = kalman
        self.n_streams = n_streams
        self._transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
        self._gain = np.ascontiguousarray(kalman.model.gain).reshape(-1, N_STATES, len(Input))
        self._state = np.tile(kalman.initial_state, (n_streams, 1))
        self._covariance = kalman.initial_covariance[None]

    def update(
        self, measurement: ArrayLike, voltage_v: ArrayLike, load_torque_n_m: ArrayLike = 0.0
    ) -> StreamSample:
        """Take one more sample (paper, Table 1).

        Args:
            measurement: shape (n_streams, n_channels), or anything that reshapes to it; NaN is missing.
            voltage_v: voltage held in the interval that the sample ends, scalar or shape (n_streams,).
            load_torque_n_m: load torque in that interval.
        """
        shape = (self.n_streams, len(self.kalman.observation), 1)
        measured = np.asarray(measurement, dtype=np.float64).reshape(shape)
        inputs, nominal = np.empty((self.n_streams, 1, len(Input))), np.empty((self.n_streams, 1, N_STATES))
        inputs[:, 0, Input.VOLTAGE] = voltage_v
        inputs[:, 0, Input.LOAD_TORQUE] = load_torque_n_m
        propagate(self._transition, self._gain, inputs, np.empty((0, 1, N_STATES)), self._state, nominal)
        rows = schedules(self.kalman, np.isnan(measured).swapaxes(1, 2), self._covariance)
        innovation, state = innovations_and_states(self.kalman, measured, nominal, rows.gain)
        self._state, self._covariance = state[:, 0], rows.covariance[:, 0]
        scores = score(innovation, rows.innovation_covariance)
        return StreamSample(innovation[:, 0], scores.whitened[:, 0], scores.nis[:, 0], self._state.copy())
