"""The adaptive filter finds the noise that is there, repairs a wrong belief, and is else the plain filter."""

from dataclasses import replace

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    Channel,
    KalmanFilter,
    Scenario,
    SensorParameters,
    Timing,
    adaptive_filter,
    run_filter,
    simulate,
)
from motor_env.filters.adaptive import MEMORY, adapted_noise
from motor_env.motor.parameters import FloatArray

TIMING = Timing(duration_s=0.2)
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)


def starts(sensor: SensorParameters, process_noise_std: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    scenario = Scenario(PAPER_MOTOR, sensor=sensor, timing=TIMING, process_noise_std=process_noise_std)
    transients = simulate(scenario, seed=2, cases=range(30))
    return transients.measurements, transients.voltage_v[0]


@pytest.mark.parametrize("wrong", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("sensor", [SensorParameters(), BOTH], ids=["current", "both"])
def test_the_measurement_noise_is_found(sensor: SensorParameters, wrong: float) -> None:
    measured, voltage = starts(sensor, (1e-5, 1e-3))
    right = KalmanFilter.from_parameters(PAPER_MOTOR, sensor, 1e-4)
    belief = replace(right, measurement_covariance=wrong**2 * right.measurement_covariance)
    result = adaptive_filter(belief, measured, voltage)
    late = slice(TIMING.n_samples // 2, None)
    found = result.measurement_covariance[:, late].mean(axis=(0, 1))
    sigma = sensor.noise_std
    np.testing.assert_allclose(found / np.outer(sigma, sigma), np.eye(len(sigma)), atol=0.05)
    assert result.nis[:, late].mean() == pytest.approx(len(sigma), rel=0.05)
    # From so many samples a variance is known to sqrt(2 / memory).
    spread = result.measurement_covariance[:, late, 0, 0].std() / sigma[0] ** 2
    assert 0.6 < spread / np.sqrt(2.0 / MEMORY) < 1.4


def test_a_process_noise_that_is_believed_is_kept() -> None:
    true_std = (5e-3, 0.5)
    measured, voltage = starts(SensorParameters(), true_std)
    belief = KalmanFilter.from_parameters(PAPER_MOTOR, SensorParameters(), 1e-4, process_noise_std=true_std)
    result = adaptive_filter(belief, measured, voltage)
    late = slice(TIMING.n_samples // 2, None)
    assert result.nis[:, late].mean() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(
        np.sqrt(result.process_variance[:, late].mean(axis=(0, 1))), true_std, rtol=0.2
    )


@pytest.mark.parametrize("sensor", [SensorParameters(), BOTH], ids=["current", "both"])
def test_with_an_endless_memory_it_is_the_plain_filter(sensor: SensorParameters) -> None:
    measured, voltage = starts(sensor, (1e-3, 0.1))
    belief = KalmanFilter.from_parameters(PAPER_MOTOR, sensor, 1e-4, process_noise_std=(1e-3, 0.1))
    plain, endless = (
        run_filter(belief, measured, voltage),
        adaptive_filter(belief, measured, voltage, memory=1e15),
    )
    np.testing.assert_allclose(endless.whitened, plain.whitened, atol=1e-8)
    np.testing.assert_allclose(endless.state, plain.state, atol=1e-8)
    np.testing.assert_allclose(endless.log_likelihood, plain.log_likelihood, rtol=1e-9)


def test_sample_by_sample_it_is_the_filter_with_the_noise_so_far() -> None:
    """One case of two channels, written out; the process noise ends at 0 and never below."""
    memory, noise_std = 4.0, (5e-3, 0.5)
    kalman = KalmanFilter.from_parameters(
        PAPER_MOTOR, BOTH, 1e-4, process_noise_std=noise_std, initial_std=(1.0, 20.0)
    )
    measured = np.random.default_rng(8).standard_normal((2, 12)) * np.array([[0.02], [2.0]])
    voltage = np.linspace(1.0, -1.0, 12)
    result = adaptive_filter(kalman, measured[None], voltage, memory=memory)
    a, b, share = kalman.model.transition, kalman.model.gain, 2.0 / (memory + 1.0)
    x, p = np.zeros(2), np.diag([1.0, 400.0])
    r, q = np.diag([4e-4, 4.0]), np.square(noise_std)
    for k in range(12):
        x, carried = a @ x + b[:, 0] * voltage[k], a @ p @ a.T
        ahead = carried + np.diag(q)
        gain = ahead @ np.linalg.inv(ahead + r)
        error = measured[:, k] - x
        np.testing.assert_allclose(result.innovation[0, k], error, rtol=1e-9, atol=1e-12)
        nis = error @ np.linalg.inv(ahead + r) @ error
        assert result.nis[0, k] == pytest.approx(nis, rel=1e-9)
        x, p = x + gain @ error, ahead - gain @ ahead
        left = measured[:, k] - x
        r = (1.0 - share) * r + share * (np.outer(left, left) + p)
        q = np.maximum((1.0 - share) * q + share * (np.square(gain @ error) + np.diag(p - carried)), 0.0)
        np.testing.assert_allclose(result.state[0, k], x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(result.measurement_covariance[0, k], r, rtol=1e-9)
        np.testing.assert_allclose(result.process_variance[0, k], q, rtol=1e-6, atol=1e-12)
    assert (result.process_variance.min(axis=(0, 1)) == 0.0).all()
    assert (result.process_variance.max(axis=(0, 1)) > 0.0).all()


def test_noise_moves_by_its_share() -> None:
    assert MEMORY == 200.0
    moved = adapted_noise(np.array([[[4.0]]]), np.array([[3.0]]), np.array([[[1.0]]]), memory=3.0)
    assert moved.item() == pytest.approx(4.0 + 0.5 * (9.0 + 1.0 - 4.0))


def test_bad_input_is_refused() -> None:
    belief = KalmanFilter.from_parameters(PAPER_MOTOR, SensorParameters(), 1e-4)
    with pytest.raises(ValueError, match="measurements must have shape"):
        adaptive_filter(belief, np.zeros((1, 5)), np.zeros(5))
    with pytest.raises(ValueError, match="measurements must be finite"):
        adaptive_filter(belief, np.full((1, 1, 5), np.nan), np.zeros(5))
    adaptive_filter(belief, np.zeros((1, 1, 5)), np.zeros(5), memory=1.0)
    with pytest.raises(ValueError, match=r"memory must be >= 1 sample, got 0\.5"):
        adaptive_filter(belief, np.zeros((1, 1, 5)), np.zeros(5), memory=0.5)
    batch = KalmanFilter.from_parameters(
        PAPER_MOTOR.scaled(inertia_kg_m2=np.ones(3)), SensorParameters(), 1e-4
    )
    with pytest.raises(ValueError, match="belief of one motor"):
        adaptive_filter(batch, np.zeros((3, 1, 5)), np.zeros(5))
