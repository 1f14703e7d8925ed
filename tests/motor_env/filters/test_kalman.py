"""The filter against one joint Gaussian and itself: streamed, missing, batched, in float32."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

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
SENSORS = {"current": SensorParameters(), "speed": SensorParameters(channels=(Channel.SPEED,)), "both": BOTH}
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


def conditional(
    kalman: KalmanFilter, measured: FloatArray, voltage: FloatArray, until: int
) -> tuple[FloatArray, FloatArray, float]:
    """All states given the measurements before a sample, as one Gaussian: no recursion over gains.

    Returns:
        Means (n_samples, 2), the covariance of all states stacked, and the log-likelihood of the measurements.
    """
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
            covariance[here, there] = np.linalg.matrix_power(a, k - j) @ covariance[there, there]
            covariance[there, here] = covariance[here, there].T
    values = measured.T.ravel()
    seen = ~np.isnan(values) & (np.arange(len(values)) < until * len(measured))
    c = np.kron(np.eye(n), kalman.observation)[seen]
    r = np.kron(np.eye(n), kalman.measurement_covariance)[np.ix_(seen, seen)]
    joint, off = c @ covariance @ c.T + r, values[seen] - c @ mean
    gain = covariance @ c.T @ np.linalg.inv(joint)
    likelihood = -0.5 * (off @ np.linalg.solve(joint, off) + np.linalg.slogdet(2.0 * np.pi * joint)[1])
    return (mean + gain @ off).reshape(n, 2), covariance - gain @ c @ covariance, float(likelihood)


@pytest.mark.parametrize("missing", [False, True], ids=["whole", "missing"])
@pytest.mark.parametrize("name", SENSORS)
def test_filter_is_the_conditional_of_one_joint_gaussian(name: str, missing: bool) -> None:
    kalman = correlated(belief(SENSORS[name]))
    measured, voltage = random_case(len(kalman.observation), 12)
    if missing:
        measured[0, 0, 3] = measured[0, 0, 7:9] = measured[0, -1, 0] = measured[0, -1, 7] = np.nan
    result = run_filter(kalman, measured, voltage)
    covariances = result.covariance[0] if missing else result.covariance
    for k in range(12):
        states, spread, likelihood = conditional(kalman, measured[0], voltage, k + 1)
        np.testing.assert_allclose(result.state[0, k], states[k], atol=1e-9)
        np.testing.assert_allclose(covariances[k], spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], atol=1e-9)
    # A sum of many terms: relative to its size, like the rounding of the sum itself.
    assert result.log_likelihood[0] == pytest.approx(likelihood, rel=1e-12, abs=1e-9)
    if not missing:
        gain = result.covariance @ kalman.observation.T @ np.linalg.inv(kalman.measurement_covariance)
        np.testing.assert_allclose(result.gain, gain, rtol=1e-6, atol=1e-9)


def deviations(covariance: FloatArray) -> FloatArray:
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def least_correlated(covariance: FloatArray) -> float:
    """The smallest eigenvalue of the correlations; covariances are symmetric to the bit."""
    assert np.array_equal(covariance, np.swapaxes(covariance, -1, -2))
    sigma = deviations(covariance)
    return float(np.linalg.eigvalsh(covariance / (sigma[..., None] * sigma[..., None, :])).min())


def exact_update(covariance: FloatArray, observation: FloatArray, noise: FloatArray) -> FloatArray:
    """P - P C' (C P C' + R)^-1 C P of two channels, in fractions, rounded once at the end."""
    p, c, r = (
        np.array([[Fraction(float(x)) for x in row] for row in matrix], dtype=object)
        for matrix in (covariance, observation, noise)
    )
    (a, b), (_, d) = c @ p @ c.T + r
    inverse = np.array([[d, -b], [-b, a]], dtype=object) / (a * d - b * b)
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
    """Here (I - K C) P, the same but for rounding, is wrong in the second to fourth digit and not symmetric."""
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
    measured, voltage = random_case(len(kalman.observation), 12)
    if kind == "missing":
        measured[0, 0, 3] = measured[0, 0, 7:9] = measured[0, -1, 0] = measured[0, -1, 7:] = np.nan
    smoothed = smooth(kalman, run_filter(kalman, measured[0] if kind == "one case" else measured, voltage))
    model = kalman.model
    for n in range(1 if kind == "one case" else 3):
        own = (
            model._replace(transition=model.transition[n], gain=model.gain[n])
            if kind == "own motors"
            else model
        )
        states, spread, _ = conditional(replace(kalman, model=own), measured[n], voltage, 12)
        np.testing.assert_allclose(smoothed.state[() if kind == "one case" else n], states, atol=1e-8)
        given = smoothed.covariance[n] if smoothed.covariance.ndim == 4 else smoothed.covariance
        for k in range(12):
            here = slice(2 * k, 2 * k + 2)
            np.testing.assert_allclose(given[k], spread[here, here], rtol=1e-7, atol=1e-11)


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
def test_residuals_are_those_of_the_whole_filter_in_double_and_nearly_in_single_precision(name: str) -> None:
    kalman = correlated(belief(SENSORS[name]))
    measured, voltage = random_case(len(kalman.observation), 30)
    voltages, load = np.outer([1.0, -0.5, 2.0], voltage), 1e-3 * voltage[::-1]
    whole, quick = (run(kalman, measured, voltages, load) for run in (run_filter, filter_residuals))
    np.testing.assert_allclose(quick.innovation, whole.innovation, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(quick.nis, whole.nis, rtol=1e-8)
    np.testing.assert_array_equal(quick.innovation_covariance, whole.innovation_covariance)
    # 20,000 steps of 10 microseconds, 1 mA, little process noise: a plain float32 filter is off by 0.06 sigma.
    sensor = replace(SENSORS[name], current_noise_a=1e-3)
    kalman = KalmanFilter.from_parameters(PAPER_MOTOR, sensor, 1e-5, process_noise_std=(1e-6, 1e-4))
    timing = Timing(sampling_rate_hz=1e5, duration_s=0.2)
    start = simulate(Scenario(PAPER_MOTOR, sensor=sensor, timing=timing), seed=1, cases=range(4))
    double, single = (
        filter_residuals(kalman, start.measurements, start.voltage_v[0], dtype=dtype)
        for dtype in (np.float64, np.float32)
    )
    assert single.innovation.dtype == np.float32
    off = (single.innovation - double.innovation) / deviations(double.innovation_covariance)
    assert np.abs(off).max() < 1e-3


def test_residuals_do_not_depend_on_the_company() -> None:
    kalman = belief(SENSORS["current"])
    measured, voltage = random_case(1, 30, n_cases=9)
    order = np.random.default_rng(4).permutation(9)
    for dtype in (np.float32, np.float64):
        whole = filter_residuals(kalman, measured, voltage, dtype=dtype)
        for chosen in (order, np.arange(1), np.arange(3), np.arange(6)):
            some = filter_residuals(kalman, measured[chosen], voltage, dtype=dtype)
            np.testing.assert_array_equal(some.innovation, whole.innovation[chosen])
            np.testing.assert_array_equal(some.nis, whole.nis[chosen])


@pytest.mark.parametrize("name", SENSORS)
def test_covariances_stay_symmetric_and_positive_over_a_long_run(name: str) -> None:
    """50,000 samples of 10 microseconds and 1 mA, a tenth of them missing, from a vague start."""
    sensor = replace(SENSORS[name], current_noise_a=1e-3)
    kalman = KalmanFilter.from_parameters(
        PAPER_MOTOR, sensor, 1e-5, process_noise_std=(1e-6, 1e-4), initial_std=(10.0, 1e3)
    )
    generator = np.random.default_rng(5)
    measured = generator.standard_normal((1, len(sensor.channels), 50_000))
    whole = filter_residuals(kalman, measured, np.zeros(50_000))
    measured[generator.random(measured.shape) < 0.1] = np.nan
    result = run_filter(kalman, measured, np.zeros(50_000))
    for holder in (result.covariance, smooth(kalman, result).covariance):
        assert least_correlated(holder) > 1e-6
    for holder in (result.innovation_covariance, whole.innovation_covariance):
        assert least_correlated(holder) > 1e-6


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


def test_the_belief_that_is_not_told() -> None:
    """From rest, with the process noise that all thresholds and benchmarks rest on."""
    kalman = KalmanFilter.from_parameters(PAPER_MOTOR, BOTH, 1e-4)
    assert DEFAULT_PROCESS_NOISE_STD == (1e-5, 1e-3)
    np.testing.assert_allclose(kalman.process_covariance, np.diag([1e-10, 1e-6]))
    np.testing.assert_allclose(kalman.measurement_covariance, np.diag([4e-4, 4.0]))
    assert not kalman.initial_state.any()
    assert not kalman.initial_covariance.any()


@pytest.mark.parametrize(
    "hostile",
    [{"measurement": np.inf}, {"measurement": np.zeros(5)}, {"voltage_v": np.nan}, {"load_torque_n_m": "1"}],
    ids=str,
)
def test_after_a_refusal_a_stream_stands_where_it_stood(hostile: dict[str, Any]) -> None:
    stream, untouched = (FilterStream(belief(SENSORS["current"])) for _ in range(2))
    for k in range(6):
        if k == 3:
            with pytest.raises(ValueError, match=next(iter(hostile))):
                stream.update(**{"measurement": 0.1, "voltage_v": 12.0} | hostile)
        found, wanted = (each.update(0.1 * k, 12.0) for each in (stream, untouched))
        np.testing.assert_array_equal(found.state, wanted.state)
