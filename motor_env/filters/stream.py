"""The Kalman filter in service: one sample at a time, with the numbers of `motor_env.filters.batch.run_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.common.arrays import numbers, spread, whole
from motor_env.filters.batch import innovations_and_states
from motor_env.filters.kalman import KalmanFilter, require_belief, schedules, score
from motor_env.motor.model import N_STATES, Input, propagate
from motor_env.motor.parameters import FloatArray, require

MOST_STREAMS = 10_000_000
"""Motors side by side: some gigabytes of memory."""


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
        require_belief(kalman)
        n_streams = whole("n_streams", n_streams, 1, MOST_STREAMS)
        self.kalman = kalman
        self.n_streams = n_streams
        self._transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
        motors = len(self._transition)
        require(
            motors in (1, n_streams), f"n_streams must be {motors} as the belief's motors, got {n_streams}"
        )
        self._gain = kalman.model.gain.reshape(-1, N_STATES, len(Input))
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

        Raises:
            ValueError: shapes do not fit, a measurement is infinite, or voltage or load are not finite; the stream
                stands where it stood.
        """
        n, n_channels = self.n_streams, len(self.kalman.observation)
        measured = numbers("measurement", measurement, missing=True)
        require(
            measured.size == n * n_channels,
            f"measurement must have shape ({n}, {n_channels}), got {measured.shape}",
        )
        measured = measured.reshape(n, n_channels, 1)
        voltage_v = spread("voltage_v", voltage_v, (n,))
        load_torque_n_m = spread("load_torque_n_m", load_torque_n_m, (n,))
        inputs, nominal = np.empty((self.n_streams, 1, len(Input))), np.empty((self.n_streams, 1, N_STATES))
        inputs[:, 0, Input.VOLTAGE] = voltage_v
        inputs[:, 0, Input.LOAD_TORQUE] = load_torque_n_m
        propagate(self._transition, self._gain, inputs, np.empty((0, 1, N_STATES)), self._state, nominal)
        rows = schedules(self.kalman, np.isnan(measured).swapaxes(1, 2), self._covariance)
        innovation, state = innovations_and_states(self.kalman, measured, nominal, rows.gain)
        self._state, self._covariance = state[:, 0], rows.covariance[:, 0]
        scores = score(innovation, rows.innovation_covariance)
        return StreamSample(innovation[:, 0], scores.whitened[:, 0], scores.nis[:, 0], self._state.copy())
