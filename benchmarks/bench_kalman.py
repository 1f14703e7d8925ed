"""The filter over many transients, against filterpy (one at a time) and simdkalman (vectorised over cases).

Ours returns states, covariances, innovations, NIS and log-likelihoods; the peers are asked for filtered states
only, simdkalman from measurements whose known input has been taken out beforehand, since it has none.
"""

from typing import NamedTuple

import numpy as np
import simdkalman
from filterpy.kalman import KalmanFilter as FilterpyFilter
from result import Result
from timing import best_rate

from motor_env.kalman import KalmanFilter, run_filter
from motor_env.model import Input
from motor_env.parameters import PAPER_MOTOR, FloatArray, SensorParameters
from motor_env.simulation import Scenario, Timing, simulate

N_CASES = 200
N_SAMPLES = 1000
N_CASES_FILTERPY = 5
"""So few because it is slow; its rate does not depend on their number."""


class Work(NamedTuple):
    """What all three filter."""

    belief: KalmanFilter
    measurements: FloatArray
    inputs: FloatArray
    nominal: FloatArray
    """The state without noise, shape (n_samples, 2)."""


def make_work() -> Work:
    """200 noisy starts of the paper's motor, and the belief that it is healthy."""
    timing = Timing(sampling_rate_hz=10_000.0, duration_s=N_SAMPLES / 10_000.0)
    scenario = Scenario(PAPER_MOTOR, timing=timing)
    transients = simulate(scenario, seed=1, cases=range(N_CASES))
    belief = KalmanFilter.from_parameters(
        PAPER_MOTOR, SensorParameters(), timing.dt_s, initial_std=(1e-2, 1.0)
    )
    inputs = np.zeros((N_SAMPLES, len(Input)))
    inputs[:, Input.VOLTAGE] = transients.voltage_v[0]
    nominal = np.empty((N_SAMPLES, 2))
    state = belief.initial_state
    for k in range(N_SAMPLES):
        state = belief.model.transition @ state + belief.model.gain @ inputs[k]
        nominal[k] = state
    return Work(belief, transients.measurements, inputs, nominal)


def with_motor_env(work: Work) -> FloatArray:
    """Filtered states of all cases."""
    return run_filter(work.belief, work.measurements, work.inputs[:, Input.VOLTAGE]).state


def with_filterpy(work: Work) -> FloatArray:
    """Filtered states of the first cases."""
    belief = work.belief
    states = np.empty((N_CASES_FILTERPY, N_SAMPLES, 2))
    for n, measured in enumerate(work.measurements[:N_CASES_FILTERPY, 0]):
        peer = FilterpyFilter(dim_x=2, dim_z=1, dim_u=len(Input))
        peer.F, peer.B, peer.H = belief.model.transition, belief.model.gain, belief.observation
        peer.Q, peer.R = belief.process_covariance, belief.measurement_covariance
        peer.x, peer.P = belief.initial_state.copy(), belief.initial_covariance.copy()
        for k, value in enumerate(measured):
            peer.predict(u=work.inputs[k])
            peer.update(value)
            states[n, k] = peer.x
    return states


def with_simdkalman(work: Work) -> FloatArray:
    """Filtered deviations of all cases from the nominal state."""
    belief = work.belief
    transition = belief.model.transition
    peer = simdkalman.KalmanFilter(
        transition, belief.process_covariance, belief.observation, belief.measurement_covariance
    )
    answer = peer.compute(
        work.measurements[:, 0] - work.nominal[:, 0],
        n_test=0,
        initial_value=np.zeros(2),
        initial_covariance=transition @ belief.initial_covariance @ transition.T + belief.process_covariance,
        filtered=True,
        smoothed=False,
        covariances=False,
        observations=False,
    )
    deviations: FloatArray = answer.filtered.states.mean
    return deviations


def run() -> list[Result]:
    """Check that the three agree, then measure them. Rates are samples filtered a second."""
    work = make_work()
    states = with_motor_env(work)
    np.testing.assert_allclose(with_filterpy(work), states[:N_CASES_FILTERPY], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(with_simdkalman(work) + work.nominal, states, rtol=1e-6, atol=1e-8)

    ours = best_rate(lambda: with_motor_env(work), N_CASES * N_SAMPLES)
    filterpy = best_rate(lambda: with_filterpy(work), N_CASES_FILTERPY * N_SAMPLES, rounds=3)
    vectorised = best_rate(lambda: with_simdkalman(work), N_CASES * N_SAMPLES, rounds=3)
    name = f"filter, {N_CASES} transients x {N_SAMPLES} samples"
    return [
        Result(name, ours=ours, peer=filterpy, peer_name="filterpy", bar=1000.0),
        Result(name, ours=ours, peer=vectorised, peer_name="simdkalman", bar=50.0),
    ]
