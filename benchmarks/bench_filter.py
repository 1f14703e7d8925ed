"""The filter over many transients, 2,000 x 1,000 samples, beside libraries and a hand-written jitted JAX scan.

All have the same belief with a start that is not known, so that the gain varies. What a peer does not take as input
(the voltage, a prediction before the first sample) is taken out of its numbers beforehand and costs it nothing.
filterpy, fast-kalman and the scan return innovations and NIS, as we do; simdkalman and dynamax return filtered states
and covariances, from which the innovations are computed afterwards, to check them.
"""

import os
from collections.abc import Callable
from typing import Any, NamedTuple

# Before jax is imported: one thread for it as for all others.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax
import jax.numpy as jnp
import kalman as fast_kalman
import numpy as np
import simdkalman
from dynamax.linear_gaussian_ssm import inference as dynamax
from filterpy.kalman import KalmanFilter as FilterpyFilter
from run import Result, best_rate

from motor_env.filters.batch import filter_residuals
from motor_env.filters.kalman import KalmanFilter, schedule
from motor_env.motor.model import Input
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray, SensorParameters
from motor_env.simulation.simulate import Scenario, Timing, simulate

jax.config.update("jax_enable_x64", True)

N_CASES = 2000
N_SAMPLES = 1000
FEWER = 5
"""Cases for filterpy, because it is slow; its rate does not depend on their number."""
SOME = 200
"""Cases for libraries that keep every state and covariance, or make a dictionary of each sample."""


class Work(NamedTuple):
    """What all filter."""

    belief: KalmanFilter
    measurements: FloatArray
    voltage_v: FloatArray
    nominal: FloatArray
    """The state without noise, shape (n_samples, 2)."""

    def deviations(self, cases: int) -> FloatArray:
        """Measurements without what the known voltage makes of them, shape (cases, n_samples)."""
        return self.measurements[:cases, 0] - self.nominal[:, 0]

    def first_covariance(self) -> FloatArray:
        """Of the state at the first sample, before it."""
        transition = self.belief.model.transition
        moved: FloatArray = transition @ self.belief.initial_covariance @ transition.T
        return moved + self.belief.process_covariance


def make_work() -> Work:
    """Noisy starts of the paper's motor, and the belief that it is healthy."""
    timing = Timing(sampling_rate_hz=10_000.0, duration_s=N_SAMPLES / 10_000.0)
    transients = simulate(Scenario(PAPER_MOTOR, timing=timing), seed=1, cases=range(N_CASES))
    belief = KalmanFilter.from_parameters(
        PAPER_MOTOR, SensorParameters(), timing.dt_s, initial_std=(1e-2, 1.0)
    )
    voltage = transients.voltage_v[0]
    nominal = np.empty((N_SAMPLES, 2))
    state = belief.initial_state
    for k in range(N_SAMPLES):
        state = belief.model.transition @ state + belief.model.gain @ np.array([voltage[k], 0.0])
        nominal[k] = state
    return Work(belief, transients.measurements, voltage, nominal)


def jax_scan(work: Work, dtype: Any) -> Callable[[], Any]:
    """A hand-written jitted scan over time, all cases side by side; the gains are computed beforehand.

    The fastest of the ways tried: deviations from the nominal trajectory, each sample a fused operation on a row of
    cases, measurements laid out with time first (the transposition is not counted).
    """
    belief = work.belief
    plan = schedule(belief, N_SAMPLES)
    a = [[dtype(x) for x in row] for row in belief.model.transition]
    gains = jnp.asarray(plan.gain[:, :, 0], dtype=dtype)
    weight = jnp.asarray(1.0 / plan.innovation_covariance[:, 0, 0], dtype=dtype)
    deviations = jnp.asarray((work.measurements[:, 0] - work.nominal[:, 0]).T, dtype=dtype)

    def step(carry: Any, given: Any) -> Any:
        d0, d1 = carry
        sample, gain, w = given
        innovation = sample - d0
        u0, u1 = d0 + gain[0] * innovation, d1 + gain[1] * innovation
        after = (a[0][0] * u0 + a[0][1] * u1, a[1][0] * u0 + a[1][1] * u1)
        return after, (innovation, innovation * innovation * w)

    @jax.jit
    def run(samples: Any) -> Any:
        start = jnp.zeros(N_CASES, dtype=dtype)
        return jax.lax.scan(step, (start, start), (samples, gains, weight), unroll=4)[1]

    return lambda: jax.block_until_ready(run(deviations))


def with_filterpy(work: Work) -> tuple[FloatArray, FloatArray]:
    """Innovations and NIS of the first cases."""
    belief = work.belief
    innovation, nis = np.empty((FEWER, N_SAMPLES)), np.empty((FEWER, N_SAMPLES))
    for n, measured in enumerate(work.measurements[:FEWER, 0]):
        peer = FilterpyFilter(dim_x=2, dim_z=1, dim_u=len(Input))
        peer.F, peer.B, peer.H = belief.model.transition, belief.model.gain, belief.observation
        peer.Q, peer.R = belief.process_covariance, belief.measurement_covariance
        peer.x, peer.P = belief.initial_state.copy(), belief.initial_covariance.copy()
        for k, value in enumerate(measured):
            peer.predict(u=np.array([work.voltage_v[k], 0.0]))
            peer.update(value)
            innovation[n, k] = peer.y.item()
            nis[n, k] = innovation[n, k] ** 2 * peer.SI.item()
    return innovation, nis


def with_fast_kalman(work: Work) -> list[Any]:
    """Innovation, NIS and more of each sample of some cases."""
    belief, rows = work.belief, []
    matrices = {
        "P": belief.initial_covariance,
        "F": belief.model.transition,
        "Q": belief.process_covariance,
        "H": belief.observation,
        "R": belief.measurement_covariance,
    }
    flat = {name: matrix.ravel().tolist() for name, matrix in matrices.items()}
    for deviations in work.deviations(SOME):
        peer = fast_kalman.LinearKalmanFilter(2, 1, x=[0.0, 0.0], **flat)
        rows.append(peer.update_many(deviations, return_stats=True)["stats"])
    return rows


def with_simdkalman(work: Work) -> FloatArray:
    """Filtered states of some cases; it keeps their covariances, too."""
    belief = work.belief
    peer = simdkalman.KalmanFilter(
        state_transition=belief.model.transition,
        process_noise=belief.process_covariance,
        observation_model=belief.observation,
        observation_noise=belief.measurement_covariance,
    )
    found = peer.compute(
        work.deviations(SOME),
        0,
        initial_value=np.zeros(2),
        initial_covariance=work.first_covariance(),
        smoothed=False,
        filtered=True,
        observations=False,
    )
    states: FloatArray = found.filtered.states.mean
    return states


def with_dynamax(work: Work) -> Callable[[], Any]:
    """A jitted filter of some cases side by side: filtered states; it keeps their covariances, too."""
    belief = work.belief
    begin = dynamax.ParamsLGSSMInitial(mean=jnp.zeros(2), cov=jnp.asarray(work.first_covariance()))
    moves = dynamax.ParamsLGSSMDynamics(
        weights=jnp.asarray(belief.model.transition),
        bias=jnp.zeros(2),
        input_weights=jnp.zeros((2, 0)),
        cov=jnp.asarray(belief.process_covariance),
    )
    shows = dynamax.ParamsLGSSMEmissions(
        weights=jnp.asarray(belief.observation),
        bias=jnp.zeros(1),
        input_weights=jnp.zeros((1, 0)),
        cov=jnp.asarray(belief.measurement_covariance),
    )
    parameters = dynamax.ParamsLGSSM(initial=begin, dynamics=moves, emissions=shows)
    filtered = jax.jit(jax.vmap(lambda one: dynamax.lgssm_filter(parameters, one)))
    samples = jnp.asarray(work.deviations(SOME))[:, :, None]
    return lambda: jax.block_until_ready(filtered(samples))


def innovations_of(work: Work, states: FloatArray) -> FloatArray:
    """Innovations that belong to filtered states, shape (cases, n_samples, 2)."""
    before = np.zeros_like(states)
    before[:, 1:] = states[:, :-1] @ work.belief.model.transition.T
    innovations: FloatArray = work.deviations(len(states)) - before[:, :, 0]
    return innovations


def run() -> list[Result]:
    """Check that all agree, then measure them. Rates are samples filtered a second."""
    work = make_work()
    ours = filter_residuals(work.belief, work.measurements, work.voltage_v)
    scans = {kind: jax_scan(work, kind) for kind in (np.float64, np.float32)}
    in_time = [np.asarray(part).T for part in scans[np.float64]()]
    samples = with_fast_kalman(work)
    by_sample = [
        np.array([[np.ravel(one[name])[0] for one in row] for row in samples])
        for name in ("innovation", "nis")
    ]
    for innovation, nis in (with_filterpy(work), by_sample, in_time):
        shown = len(innovation)
        np.testing.assert_allclose(innovation, ours.innovation[:shown, :, 0], atol=1e-8)
        np.testing.assert_allclose(nis, ours.nis[:shown], rtol=1e-5, atol=1e-8)
    vectors = with_dynamax(work)
    for states in (with_simdkalman(work), np.asarray(vectors().filtered_means)):
        np.testing.assert_allclose(innovations_of(work, states), ours.innovation[:SOME, :, 0], atol=1e-6)

    amount = N_CASES * N_SAMPLES
    single = work.measurements.astype(np.float32)
    rate = best_rate(lambda: filter_residuals(work.belief, work.measurements, work.voltage_v), amount)
    rate_32 = best_rate(
        lambda: filter_residuals(work.belief, single, work.voltage_v, dtype=np.float32), amount
    )
    name = f"filter, {N_CASES} transients x {N_SAMPLES} samples"
    peers = [
        ("filterpy", best_rate(lambda: with_filterpy(work), FEWER * N_SAMPLES, rounds=3), 1000.0),
        ("fast-kalman", best_rate(lambda: with_fast_kalman(work), SOME * N_SAMPLES, rounds=3), 2.0),
        ("simdkalman", best_rate(lambda: with_simdkalman(work), SOME * N_SAMPLES, rounds=3), 2.0),
        ("dynamax, vmap", best_rate(vectors, SOME * N_SAMPLES, rounds=3), 2.0),
        ("jitted JAX scan", best_rate(scans[np.float64], amount), 0.8),
    ]
    results = [Result(name, ours=rate, peer=peer, peer_name=who, bar=bar) for who, peer, bar in peers]
    scan_32 = best_rate(scans[np.float32], amount)
    return [
        *results,
        Result(f"{name}, float32", ours=rate_32, peer=scan_32, peer_name="jitted JAX scan", bar=0.8),
    ]
