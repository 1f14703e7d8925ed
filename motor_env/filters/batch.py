"""The Kalman filter over whole transients, one or a batch, and sample by sample (paper, Table 1)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.common.arrays import numbers, real, shown, spread, whole
from motor_env.filters import kernels
from motor_env.filters.kalman import KalmanFilter, require_belief, schedule, schedules, score
from motor_env.motor.model import N_STATES, Input, propagate
from motor_env.motor.parameters import FloatArray, require

_TOO_LARGE = (
    "the filter's state left the range of numbers: measurements, voltage_v or the filter is too large"
)


class FilterResult(NamedTuple):
    """Results of the filter.

    Covariances and gain are common to all cases, shape (n_samples, ...); missing samples or several motors add the
    cases' axes in front.

    Attributes:
        innovation: z - C x-, shape (..., n_samples, n_channels); NaN where a sample is missing.
        innovation_covariance: S, shape (n_samples, n_channels, n_channels).
        whitened: innovation over S's Cholesky factor, standard normal while the model holds, of the same shape.
        nis: normalised innovation squared (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4), shape (..., n_samples); 0 where
            none was measured.
        log_likelihood: shape (...).
        state: estimate after the update, shape (..., n_samples, 2).
        covariance: its covariance P, shape (n_samples, 2, 2).
        gain: Kalman gain, shape (n_samples, 2, n_channels).
    """

    innovation: FloatArray
    innovation_covariance: FloatArray
    whitened: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray
    state: FloatArray
    covariance: FloatArray
    gain: FloatArray


class Residuals(NamedTuple):
    """Innovations of a batch.

    Attributes:
        innovation: z - C x-, shape (..., n_samples, n_channels).
        innovation_covariance: S, shape (n_samples, n_channels, n_channels), in double precision.
        nis: normalised innovation squared, shape (..., n_samples).
    """

    innovation: kernels.AnyFloat
    innovation_covariance: FloatArray
    nis: kernels.AnyFloat


def _series(
    kalman: KalmanFilter, measured: kernels.AnyFloat, voltage_v: ArrayLike, load_torque_n_m: ArrayLike
) -> tuple[kernels.AnyFloat, tuple[int, ...], FloatArray]:
    require(measured.ndim <= 3, f"measurements must have 2 or 3 axes, got shape {measured.shape}")
    n_channels, n_samples = measured.shape[-2:]
    voltage = numbers("voltage_v", voltage_v, ("...", n_samples))
    require(voltage.ndim <= 2, f"voltage_v must have 1 or 2 axes, got shape {voltage.shape}")
    batch = measured.shape[:-2]
    flat = measured.reshape(-1, n_channels, n_samples)
    inputs = np.empty((*voltage.shape, len(Input)))
    inputs[..., Input.VOLTAGE] = voltage
    inputs[..., Input.LOAD_TORQUE] = spread("load_torque_n_m", load_torque_n_m, voltage.shape)
    inputs = inputs.reshape(-1, n_samples, len(Input))
    require(len(inputs) in (1, len(flat)), f"voltage_v must have 1 or {len(flat)} rows, got {len(inputs)}")
    transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
    require(
        len(transition) in (1, len(flat)),
        f"the filter must be of 1 or {len(flat)} motors, got {len(transition)}",
    )
    nominal = np.empty((max(len(inputs), len(transition)), n_samples, N_STATES))
    gain = kalman.model.gain.reshape(-1, N_STATES, len(Input))
    begin = np.tile(kalman.initial_state, (len(nominal), 1))
    propagate(transition, gain, inputs, np.empty((0, n_samples, N_STATES)), begin, nominal)
    return flat, batch, nominal


def output_coordinates(
    transition: FloatArray, row: FloatArray, forward: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return motion (a, b, d) and gains (g, h) of a state (p, q) with output p = `row` x (Luenberger 1967).

    p <- a p + q + g e and q <- b p + d q + h e. `forward` (A K of each sample) and the gains have shape (n_samples,
    2).
    """
    basis = np.array([row, [-row[1], row[0]]])
    moved = basis @ transition @ np.linalg.inv(basis)
    gain = forward @ basis.T
    couple = moved[0, 1]
    return np.array([moved[0, 0], couple * moved[1, 0], moved[1, 1]]), gain * np.array([1.0, couple])


def filter_residuals(
    kalman: KalmanFilter,
    measurements: ArrayLike,
    voltage_v: ArrayLike,
    load_torque_n_m: ArrayLike = 0.0,
    *,
    dtype: type[np.float32 | np.float64] = np.float64,
) -> Residuals:
    """Compute only innovations and NIS of many transients, faster than `run_filter` (Kalman 1960).

    Args:
        kalman: for one motor.
        measurements: shape (n_channels, n_samples) or (n_cases, n_channels, n_samples); float32 is read as it is.
        voltage_v: assumed voltage in each interval, shape (n_samples,) or (n_cases, n_samples).
        load_torque_n_m: assumed load, scalar or the shape of `voltage_v`.
        dtype: precision of innovations and NIS.

    Raises:
        ValueError: shapes do not fit, a sample is not finite (`run_filter` takes NaN), or another dtype.
    """
    require(
        dtype is np.float32 or dtype is np.float64,
        f"dtype must be float32 or float64, got {shown(dtype)}",
    )
    require_belief(kalman)
    n_channels = len(kalman.observation)
    checked = real if n_channels == 1 else numbers
    given = checked("measurements", measurements, ("...", n_channels, "n_samples"), single=True)
    measured, batch, nominal = _series(kalman, given, voltage_v, load_torque_n_m)
    plan = schedule(kalman, measured.shape[-1])
    n_cases, _, n_samples = measured.shape
    # One block for both: two arrays of some megabytes would go back to the system after each call, and their pages
    # be zeroed anew in the next one, which took longer than to filter.
    block = np.empty(n_cases * n_samples * (n_channels + 1), dtype=dtype)
    innovation = block[: -n_cases * n_samples].reshape(n_cases, n_samples, n_channels)
    nis = block[-n_cases * n_samples :].reshape(n_cases, n_samples)
    transition, observation = kalman.model.transition, kalman.observation
    forward = transition @ plan.gain
    expected = nominal @ observation.T
    if n_channels == 1:
        a, gain = output_coordinates(transition, observation[0], forward[:, :, 0])
        kernels.filter_one_channel(
            a.astype(dtype),
            gain.astype(dtype),
            (1.0 / plan.innovation_covariance[:, 0, 0]).astype(dtype),
            expected[:, :, 0],
            measured[:, 0],
            innovation[:, :, 0],
            nis,
        )
    else:
        kernels.filter_two_channels(
            transition.astype(dtype),
            observation.astype(dtype),
            forward.astype(dtype),
            np.linalg.inv(plan.innovation_covariance).astype(dtype),
            expected,
            measured,
            innovation,
            nis,
        )
    # A sample that is not finite makes all later innovations of its case not finite.
    if not np.isfinite(innovation[:, -1]).all():
        numbers("measurements", measurements)
        raise ValueError(_TOO_LARGE)
    return Residuals(
        innovation.reshape(*batch, n_samples, n_channels),
        plan.innovation_covariance,
        nis.reshape(*batch, n_samples),
    )


def innovations_and_states(
    kalman: KalmanFilter, measured: kernels.AnyFloat, nominal: FloatArray, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return innovations (n_cases, n_samples, n_channels) and states (n_cases, n_samples, 2).

    `measured` is (n_cases, n_channels, n_samples), `nominal` the states without measurements; one gain, or one a case.
    """
    n_cases, n_channels, n_samples = measured.shape
    innovation = np.empty((n_cases, n_samples, n_channels))
    state = np.empty((n_cases, n_samples, N_STATES))
    transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
    kernels.filter_states(transition, kalman.observation, gain, nominal, measured, innovation, state)
    return innovation, state


def run_filter(
    kalman: KalmanFilter, measurements: ArrayLike, voltage_v: ArrayLike, load_torque_n_m: ArrayLike = 0.0
) -> FilterResult:
    """Filter one or many measured transients (Kalman 1960; paper, Table 1).

    Args:
        kalman: for one motor, or one for each case.
        measurements: shape (n_channels, n_samples) or (n_cases, n_channels, n_samples). NaN is missing and updates
            nothing.
        voltage_v: assumed voltage in each interval, shape (n_samples,) or (n_cases, n_samples).
        load_torque_n_m: assumed load, scalar or the shape of `voltage_v`.

    Raises:
        ValueError: shapes do not fit, or a measurement is infinite.
    """
    require_belief(kalman)
    shape = ("...", len(kalman.observation), "n_samples")
    given = numbers("measurements", measurements, shape, missing=True, single=True)
    measured, batch, nominal = _series(kalman, given, voltage_v, load_torque_n_m)
    lost = np.isnan(measured)
    missing = lost.swapaxes(1, 2)
    own_covariance = kalman.model.transition.ndim > 2 or bool(lost.any())
    rows = schedules(kalman, missing if own_covariance else np.zeros((1, *missing.shape[1:]), np.bool_))
    innovation, state = innovations_and_states(kalman, measured, nominal, rows.gain)
    last = state[:, -1]
    require(math.isfinite(np.vdot(last, last)), _TOO_LARGE)
    whitened, nis, log_likelihood = score(innovation, rows.innovation_covariance)
    lead = batch if own_covariance else ()
    _, n_samples, n_channels = innovation.shape
    return FilterResult(
        innovation=innovation.reshape(*batch, n_samples, n_channels),
        innovation_covariance=rows.innovation_covariance.reshape(*lead, n_samples, n_channels, n_channels),
        whitened=whitened.reshape(*batch, n_samples, n_channels),
        nis=nis.reshape(*batch, n_samples),
        log_likelihood=log_likelihood.reshape(batch),
        state=state.reshape(*batch, n_samples, N_STATES),
        covariance=rows.covariance.reshape(*lead, n_samples, N_STATES, N_STATES),
        gain=rows.gain.reshape(*lead, n_samples, N_STATES, n_channels),
    )


MOST_STREAMS = 10_000_000
"""Most motors side by side: some gigabytes of memory."""


class StreamSample(NamedTuple):
    """The filter's results for one sample of each stream.

    Attributes:
        innovation: shape (n_streams, n_channels).
        whitened: the same, white and standard normal while the model holds.
        nis: shape (n_streams,).
        state: updated estimate, shape (n_streams, 2).
    """

    innovation: FloatArray
    whitened: FloatArray
    nis: FloatArray
    state: FloatArray


class FilterStream:
    """Running filter: `update(sample)` gives what `run_filter` gives at that sample."""

    def __init__(self, kalman: KalmanFilter, n_streams: int = 1) -> None:
        require_belief(kalman)
        n_streams = whole("n_streams", n_streams, 1, MOST_STREAMS)
        self.kalman = kalman
        self.n_streams = n_streams
        self._transition = kalman.model.transition.reshape(-1, N_STATES, N_STATES)
        motors = len(self._transition)
        require(
            motors in (1, n_streams),
            f"n_streams must be {motors}, as many as the filter's motors, got {n_streams}",
        )
        self._gain = kalman.model.gain.reshape(-1, N_STATES, len(Input))
        self._state = np.tile(kalman.initial_state, (n_streams, 1))
        self._covariance = kalman.initial_covariance[None]

    def update(
        self, measurement: ArrayLike, voltage_v: ArrayLike, load_torque_n_m: ArrayLike = 0.0
    ) -> StreamSample:
        """Process one more sample (paper, Table 1).

        Args:
            measurement: shape (n_streams, n_channels) after a reshape; NaN is missing.
            voltage_v: voltage of the interval that ends at the sample, scalar or shape (n_streams,).
            load_torque_n_m: load torque in that interval.

        Raises:
            ValueError: shapes do not fit or a number is not finite; the stream stays as it was.
        """
        n, n_channels = self.n_streams, len(self.kalman.observation)
        measured = numbers("measurement", measurement, missing=True)
        if measured.size != n * n_channels:
            raise ValueError(f"measurement must have shape ({n}, {n_channels}), got {measured.shape}")
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
