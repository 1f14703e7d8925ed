"""The filter against one joint Gaussian, filterpy and itself: streamed, missing, batched, in float32."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as FilterpyFilter
from scipy.stats import chi2, multivariate_normal

from motor_env import (
    PAPER_MOTOR,
    Channel,
    FilterStream,
    KalmanFilter,
    Scenario,
    SensorParameters,
    Timing,
    filter_residuals,
    run_filter,
    simulate,
    smooth,
)
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD, gain_and_covariance, schedule
from motor_env.filters.kernels import covariance_step
from motor_env.motor.parameters import FloatArray

BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)
SENSORS = {
    "current": SensorParameters(),
    "speed": SensorParameters(channels=(Channel.SPEED,)),
    "both": BOTH,
}
NOISE = (1e-2, 0.3)
START = (0.05, 3.0)


def belief(sensor: SensorParameters, dt_s: float = 1e-4) -> KalmanFilter:
    return KalmanFilter.from_parameters(
        PAPER_MOTOR, sensor, dt_s, process_noise_std=NOISE, initial_std=START, initial_state=(0.02, 1.0)
    )


def correlated(kalman: KalmanFilter) -> KalmanFilter:
    """The same with correlated process noise; two channels with correlated noise, and each of both states."""
    noise, observation = kalman.measurement_covariance.copy(), kalman.observation
    if len(noise) == 2:
        noise[0, 1] = noise[1, 0] = 0.5 * np.sqrt(noise[0, 0] * noise[1, 1])
        observation = np.array([[1.0, 0.02], [5.0, 1.0]])
    process = kalman.process_covariance.copy()
    process[0, 1] = process[1, 0] = 0.3 * NOISE[0] * NOISE[1]
    return replace(kalman, observation=observation, measurement_covariance=noise, process_covariance=process)


def random_case(n_channels: int, n_samples: int, n_cases: int = 3) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(7)
    measured = generator.standard_normal((n_cases, n_channels, n_samples)) * 0.1
    return measured, 0.2 * generator.standard_normal(n_samples)


def joint_gaussian(
    kalman: KalmanFilter, voltage: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of all states stacked, and C and R of all samples stacked: no recursion over gains."""
    n, size = len(voltage), 2 * len(voltage)
    a, b = kalman.model.transition, kalman.model.gain
    mean, covariance = np.empty(size), np.zeros((size, size))
    state, spread = kalman.initial_state, kalman.initial_covariance
    for k in range(n):
        state = a @ state + b @ np.array([voltage[k], 0.0])
        spread = a @ spread @ a.T + kalman.process_covariance
        here = slice(2 * k, 2 * k + 2)
        mean[here], covariance[here, here] = state, spread
        for j in range(k):
            there = slice(2 * j, 2 * j + 2)
            power = np.linalg.matrix_power(a, k - j)
            covariance[here, there] = power @ covariance[there, there]
            covariance[there, here] = covariance[here, there].T
    c = np.kron(np.eye(n), kalman.observation).astype(np.float64)
    r = np.kron(np.eye(n), kalman.measurement_covariance).astype(np.float64)
    return mean, covariance, c, r


@pytest.mark.parametrize("missing", [False, True], ids=["whole", "missing"])
@pytest.mark.parametrize("name", SENSORS)
def test_filter_is_the_conditional_of_one_joint_gaussian(name: str, missing: bool) -> None:
    kalman = correlated(belief(SENSORS[name]))
    n_channels, n_samples = len(kalman.observation), 12
    measured, voltage = random_case(n_channels, n_samples)
    if missing:
        measured[0, 0, 3] = measured[0, 0, 7:9] = measured[0, -1, 0] = measured[0, -1, 7] = np.nan
    result = run_filter(kalman, measured, voltage)
    mean, covariance, c, r = joint_gaussian(kalman, voltage)
    values = measured[0].T.ravel()
    seen = ~np.isnan(values)
    joint = c @ covariance @ c.T + r
    expected = multivariate_normal(mean=(c @ mean)[seen], cov=joint[np.ix_(seen, seen)]).logpdf(values[seen])
    # A sum of many terms: relative to its size, like the rounding of the sum itself.
    assert result.log_likelihood[0] == pytest.approx(expected, rel=1e-12, abs=1e-9)
    covariances = result.covariance[0] if missing else result.covariance
    for k in range(n_samples):
        used = seen & (np.arange(len(values)) < n_channels * (k + 1))
        cross = covariance[2 * k : 2 * k + 2] @ c[used].T
        gain = cross @ np.linalg.inv(joint[np.ix_(used, used)])
        state = mean[2 * k : 2 * k + 2] + gain @ (values[used] - (c @ mean)[used])
        spread = covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] - gain @ cross.T
        np.testing.assert_allclose(result.state[0, k], state, atol=1e-9)
        np.testing.assert_allclose(covariances[k], spread, atol=1e-9)


def exact_update(covariance: FloatArray, observation: FloatArray, noise: FloatArray) -> FloatArray:
    """P - P C' (C P C' + R)^-1 C P of two channels, in fractions, rounded once at the end."""
    p, c, r = (
        np.array([[Fraction(float(x)) for x in row] for row in matrix], dtype=object)
        for matrix in (covariance, observation, noise)
    )
    (a, b), (_, d) = s = c @ p @ c.T + r
    inverse = np.array([[d, -b], [-b, a]], dtype=object) / (a * d - b * b)
    assert (s @ inverse == np.eye(2)).all()
    return np.asarray(p - p @ c.T @ inverse @ c @ p, dtype=np.float64)


@pytest.mark.parametrize(
    ("covariance", "observation", "noise"),
    [
        ([[1e6, 9.9e5], [9.9e5, 1e6]], [[1.0, 0.0], [0.0, 0.0]], [[1e-8, 0.0], [0.0, 1.0]]),
        ([[1e6, 1e3], [1e3, 1e2]], [[1.0, 0.0], [0.0, 1.0]], [[1e-8, 0.0], [0.0, 1e-6]]),
        ([[1e8, 3e7], [3e7, 1e8]], [[1.0, 0.3], [0.7, 1.0]], [[1e-6, 2e-7], [2e-7, 1e-6]]),
    ],
)
def test_a_sharp_measurement_of_what_is_vague_leaves_a_right_covariance(
    covariance: list[list[float]], observation: list[list[float]], noise: list[list[float]]
) -> None:
    """Here (I - K C) P, which is the same but for rounding, is wrong in the second to fourth digit and not symmetric.

    The compiled step of the batches is tested beside it: it does the same update for two states.
    """
    p, c, r = np.array(covariance), np.array(observation), np.array(noise)
    expected = exact_update(p, c, r)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    updated = gain_and_covariance(p, c, r)[2]
    np.testing.assert_allclose(updated / scale, expected / scale, atol=1e-9)
    assert abs(updated[0, 1] - updated[1, 0]) < 1e-12 * scale[0, 1]
    *_, u00, u01, u11 = covariance_step(np.eye(2), np.zeros((2, 2)), c, r, p[0, 0], p[0, 1], p[1, 1])
    np.testing.assert_allclose(np.array([[u00, u01], [u01, u11]]) / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("kind", ["whole", "missing", "own motors", "one case", "no process noise"])
@pytest.mark.parametrize("name", SENSORS)
def test_smoother_is_the_conditional_on_all_samples(name: str, kind: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    if kind == "own motors":
        motors = PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, 1.2, 0.9]))
        models = KalmanFilter.from_parameters(motors, SENSORS[name], 1e-4).model
        kalman = replace(kalman, model=models)
    if kind == "no process noise":
        kalman = replace(kalman, process_covariance=np.zeros((2, 2)))
    n_channels, n_samples = len(kalman.observation), 12
    measured, voltage = random_case(n_channels, n_samples)
    if kind == "missing":
        measured[0, 0, 3] = measured[0, 0, 7:9] = measured[0, -1, 0] = measured[0, -1, 7:] = np.nan
    smoothed = smooth(kalman, run_filter(kalman, measured[0] if kind == "one case" else measured, voltage))
    own = kalman.model.transition.ndim > 2
    for n in range(1 if kind == "one case" else 3):
        model = kalman.model
        alone = model._replace(transition=model.transition[n], gain=model.gain[n]) if own else model
        mean, covariance, c, r = joint_gaussian(replace(kalman, model=alone), voltage)
        values = measured[n].T.ravel()
        seen = ~np.isnan(values)
        cross = covariance @ c[seen].T
        gain = cross @ np.linalg.inv((c @ covariance @ c.T + r)[np.ix_(seen, seen)])
        state = (mean + gain @ (values[seen] - (c @ mean)[seen])).reshape(n_samples, 2)
        spread = covariance - gain @ cross.T
        np.testing.assert_allclose(smoothed.state[() if kind == "one case" else n], state, atol=1e-8)
        given = smoothed.covariance[n] if smoothed.covariance.ndim == 4 else smoothed.covariance
        for k in range(n_samples):
            here = slice(2 * k, 2 * k + 2)
            np.testing.assert_allclose(given[k], spread[here, here], rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize("process_noise_std", [(0.0, 0.0), (1e-5, 1e-3), (1e-2, 0.3)])
@pytest.mark.parametrize("name", SENSORS)
def test_smoothing_is_stable_over_a_long_run(name: str, process_noise_std: tuple[float, float]) -> None:
    scenario = Scenario(
        PAPER_MOTOR,
        sensor=SENSORS[name],
        timing=Timing(duration_s=0.5),
        process_noise_std=process_noise_std,
    )
    transients = simulate(scenario, seed=2, cases=range(2))
    kalman = KalmanFilter.from_parameters(
        PAPER_MOTOR, SENSORS[name], 1e-4, process_noise_std=process_noise_std, initial_std=START
    )
    result = run_filter(kalman, transients.measurements, transients.voltage_v[0])
    smoothed = smooth(kalman, result)
    filtered = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    sigma = np.sqrt(np.diagonal(smoothed.covariance, axis1=1, axis2=2))
    assert (sigma <= filtered * (1.0 + 1e-6)).all()
    assert np.array_equal(smoothed.covariance, np.swapaxes(smoothed.covariance, 1, 2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    # Without process noise what is left unknown lies on the slow mode alone: a correlation of 1.
    assert np.linalg.eigvalsh(smoothed.covariance / scale).min() > (0.0 if process_noise_std[0] else -1e-15)
    error = np.abs(smoothed.state - transients.states)
    assert (error < 6.0 * sigma + 1e-9).all()


@pytest.mark.parametrize("name", SENSORS)
def test_filter_agrees_with_filterpy(name: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    m = len(kalman.observation)
    measured, voltage = random_case(m, 40)
    result = run_filter(kalman, measured, voltage)
    peer = FilterpyFilter(dim_x=2, dim_z=m, dim_u=2)
    peer.F, peer.B, peer.H = kalman.model.transition, kalman.model.gain, kalman.observation
    peer.Q, peer.R = kalman.process_covariance, kalman.measurement_covariance
    peer.x, peer.P = kalman.initial_state.copy(), kalman.initial_covariance.copy()
    for k in range(40):
        peer.predict(u=np.array([voltage[k], 0.0]))
        peer.update(measured[1, :, k])
        np.testing.assert_allclose(result.innovation[1, k], np.ravel(peer.y), atol=1e-10)
        np.testing.assert_allclose(result.innovation_covariance[k], peer.S, rtol=1e-9)
        np.testing.assert_allclose(result.state[1, k], peer.x, atol=1e-10)
        np.testing.assert_allclose(result.covariance[k], peer.P, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(result.gain[k], peer.K, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", SENSORS)
def test_stream_gives_what_the_batch_gives(name: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    measured, voltage = random_case(len(kalman.observation), 50)
    measured[1, 0, 20:23] = np.nan
    voltages = np.outer([1.0, -0.5, 2.0], voltage)
    load = 1e-3 * voltages[:, ::-1]
    result = run_filter(kalman, measured, voltages, load)
    stream = FilterStream(kalman, n_streams=3)
    for k in range(50):
        sample = stream.update(measured[:, :, k], voltages[:, k], load[:, k])
        np.testing.assert_allclose(sample.innovation, result.innovation[:, k], atol=1e-11)
        np.testing.assert_allclose(sample.whitened, result.whitened[:, k], atol=1e-9)
        np.testing.assert_allclose(sample.nis, result.nis[:, k], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(sample.state, result.state[:, k], atol=1e-11)


@pytest.mark.parametrize("name", SENSORS)
def test_a_motor_for_each_case_is_as_many_filters(name: str) -> None:
    motors = PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, 1.1, 0.8]))
    measured, voltage = random_case(len(SENSORS[name].channels), 25)
    each = KalmanFilter.from_parameters(motors, SENSORS[name], 1e-4)
    together, stream = run_filter(each, measured, voltage), FilterStream(each, n_streams=3)
    streamed = [stream.update(measured[..., k], voltage[k]).whitened for k in range(25)]
    np.testing.assert_allclose(np.stack(streamed, axis=1), together.whitened, atol=1e-9)
    for n in range(3):
        alone = KalmanFilter.from_parameters(motors.motor(n), SENSORS[name], 1e-4)
        one = run_filter(alone, measured[n], voltage)
        np.testing.assert_allclose(together.innovation[n], one.innovation, atol=1e-11)
        np.testing.assert_allclose(together.innovation_covariance[n], one.innovation_covariance, rtol=1e-12)
        assert together.log_likelihood[n] == pytest.approx(float(one.log_likelihood), rel=1e-10)


@pytest.mark.parametrize("name", SENSORS)
def test_residuals_are_those_of_the_whole_filter(name: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    measured, voltage = random_case(len(kalman.observation), 30)
    voltages, load = np.outer([1.0, -0.5, 2.0], voltage), 1e-3 * voltage[::-1]
    whole, quick = (run(kalman, measured, voltages, load) for run in (run_filter, filter_residuals))
    np.testing.assert_allclose(quick.innovation, whole.innovation, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(quick.nis, whole.nis, rtol=1e-8)
    np.testing.assert_array_equal(quick.innovation_covariance, whole.innovation_covariance)


@pytest.mark.parametrize("n_cases", [1, 3, 4, 6])
def test_residuals_do_not_depend_on_the_company(n_cases: int) -> None:
    kalman = belief(SENSORS["current"])
    measured, voltage = random_case(1, 30, n_cases=9)
    some = filter_residuals(kalman, measured[:n_cases], voltage)
    np.testing.assert_array_equal(
        some.innovation, filter_residuals(kalman, measured, voltage).innovation[:n_cases]
    )
    np.testing.assert_allclose(some.nis, run_filter(kalman, measured[:n_cases], voltage).nis, rtol=1e-12)
    order = np.random.default_rng(n_cases).permutation(9)
    for dtype in (np.float32, np.float64):
        whole = filter_residuals(kalman, measured, voltage, dtype=dtype)
        mixed = filter_residuals(kalman, measured[order], voltage, dtype=dtype)
        np.testing.assert_array_equal(mixed.innovation, whole.innovation[order])
        np.testing.assert_array_equal(mixed.nis, whole.nis[order])


@pytest.mark.parametrize("name", SENSORS)
def test_single_precision_stays_near_double(name: str) -> None:
    """20,000 steps of 10 microseconds, 1 mA, little process noise: a plain float32 filter is off by 0.06 sigma."""
    sensor = replace(SENSORS[name], current_noise_a=1e-3)
    timing = Timing(sampling_rate_hz=1e5, duration_s=0.2)
    transients = simulate(Scenario(PAPER_MOTOR, sensor=sensor, timing=timing), seed=1, cases=range(4))
    kalman = KalmanFilter.from_parameters(PAPER_MOTOR, sensor, timing.dt_s, process_noise_std=(1e-6, 1e-4))
    double = filter_residuals(kalman, transients.measurements, transients.voltage_v[0])
    single = filter_residuals(kalman, transients.measurements, transients.voltage_v[0], dtype=np.float32)
    assert single.innovation.dtype == np.float32
    sigma = np.sqrt(np.diagonal(double.innovation_covariance, axis1=1, axis2=2))
    assert np.abs((single.innovation - double.innovation) / sigma).max() < 1e-3
    plan = schedule(kalman, timing.n_samples)
    assert np.array_equal(plan.covariance, np.swapaxes(plan.covariance, 1, 2))
    assert np.linalg.eigvalsh(plan.covariance[1:]).min() > 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", SENSORS)
def test_covariances_stay_symmetric_and_positive_over_a_long_run(
    name: str, dtype: type[np.float32 | np.float64]
) -> None:
    """50,000 samples of 10 microseconds and 1 mA, a tenth of them missing, from a vague start."""
    sensor = replace(SENSORS[name], current_noise_a=1e-3)
    kalman = KalmanFilter.from_parameters(
        PAPER_MOTOR, sensor, 1e-5, process_noise_std=(1e-6, 1e-4), initial_std=(10.0, 1e3)
    )
    generator = np.random.default_rng(5)
    measured = generator.standard_normal((1, len(sensor.channels), 50_000)).astype(dtype)
    whole = filter_residuals(kalman, measured, np.zeros(50_000), dtype=dtype)
    measured[generator.random(measured.shape) < 0.1] = np.nan
    result = run_filter(kalman, measured, np.zeros(50_000))
    smoothed = smooth(kalman, result)
    spreads = (
        result.covariance,
        smoothed.covariance,
        result.innovation_covariance,
        whole.innovation_covariance,
    )
    for covariance in spreads:
        assert covariance.dtype == np.float64
        assert np.array_equal(covariance, np.swapaxes(covariance, -1, -2))
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        assert np.linalg.eigvalsh(covariance / (sigma[..., None] * sigma[..., None, :])).min() > 1e-6


@pytest.mark.parametrize("name", SENSORS)
def test_the_converged_gain_is_detected_and_held(name: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    plan = schedule(kalman, 4000)
    assert 1 < plan.held_from < 4000
    np.testing.assert_array_equal(
        plan.gain[plan.held_from :], plan.gain[[plan.held_from - 1]].repeat(4000 - plan.held_from, 0)
    )
    a, covariance = kalman.model.transition, kalman.initial_covariance
    for _ in range(4000):
        predicted = a @ covariance @ a.T + kalman.process_covariance
        *_, covariance = gain_and_covariance(predicted, kalman.observation, kalman.measurement_covariance)
    np.testing.assert_allclose(plan.covariance[-1], covariance, rtol=1e-9)


@pytest.mark.parametrize("name", SENSORS)
def test_innovations_of_the_true_belief_are_white(name: str) -> None:
    scenario = Scenario(
        PAPER_MOTOR, sensor=SENSORS[name], timing=Timing(duration_s=0.03), process_noise_std=NOISE
    )
    transients = simulate(scenario, seed=3, cases=range(300))
    kalman = KalmanFilter.from_parameters(PAPER_MOTOR, SENSORS[name], 1e-4, process_noise_std=NOISE)
    result = run_filter(kalman, transients.measurements, transients.voltage_v[0])
    values = result.whitened
    count = values.size
    total = float(result.nis.sum())
    assert chi2.ppf(1e-4, count) < total < chi2.isf(1e-4, count)
    for lag in (1, 2, 5):
        correlation = (values[:, lag:] * values[:, :-lag]).mean()
        assert abs(correlation) < 4.0 / np.sqrt(values[:, lag:].size)


def test_all_samples_missing_is_the_prediction() -> None:
    kalman = belief(BOTH)
    result = run_filter(kalman, np.full((2, 10), np.nan), np.full(10, 12.0))
    assert result.log_likelihood == 0.0
    assert not result.nis.any()
    state = kalman.initial_state
    for _ in range(10):
        state = kalman.model.transition @ state + kalman.model.gain @ np.array([12.0, 0.0])
    np.testing.assert_allclose(result.state[-1], state, atol=1e-12)


def test_the_belief_that_is_not_told() -> None:
    """From rest, with the process noise that all thresholds and benchmarks rest on."""
    kalman = KalmanFilter.from_parameters(PAPER_MOTOR, BOTH, 1e-4)
    assert DEFAULT_PROCESS_NOISE_STD == (1e-5, 1e-3)
    np.testing.assert_allclose(kalman.process_covariance, np.diag([1e-10, 1e-6]))
    np.testing.assert_allclose(kalman.measurement_covariance, np.diag([4e-4, 4.0]))
    assert not kalman.initial_state.any()
    assert not kalman.initial_covariance.any()


def test_bad_measurements_are_refused_in_one_sentence() -> None:
    kalman = belief(SENSORS["current"])
    infinite = np.zeros((1, 10))
    infinite[0, 4] = np.inf
    with pytest.raises(ValueError, match=r"measurements must be finite, got inf at \[0, 4\]"):
        run_filter(kalman, infinite, np.zeros(10))
    infinite[0, 4] = np.nan
    with pytest.raises(ValueError, match="measurements must be finite"):
        filter_residuals(kalman, infinite, np.zeros(10))
    with pytest.raises(ValueError, match="dtype must be float32 or float64, got the type float16"):
        filter_residuals(kalman, np.zeros((1, 10)), np.zeros(10), dtype=np.float16)  # type: ignore[arg-type]  # refused
    with pytest.raises(ValueError, match="measurements must have shape"):
        run_filter(kalman, np.zeros((2, 10)), np.zeros(10))
    with pytest.raises(ValueError, match="voltage_v must have shape"):
        run_filter(kalman, np.zeros((1, 10)), np.zeros(9))
    with pytest.raises(ValueError, match="voltage_v must have 1 or 2 rows, got 3"):
        run_filter(kalman, np.zeros((2, 1, 10)), np.zeros((3, 10)))
    batch = KalmanFilter.from_parameters(
        PAPER_MOTOR.scaled(inertia_kg_m2=np.ones(3)), SensorParameters(), 1e-4
    )
    with pytest.raises(ValueError, match="the filter must be of 1 or 2 motors, got 3"):
        run_filter(batch, np.zeros((2, 1, 10)), np.zeros(10))
    with pytest.raises(ValueError, match="filter of one motor"):
        schedule(batch, 10)
