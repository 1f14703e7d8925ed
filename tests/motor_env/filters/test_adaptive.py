"""The adaptive filter finds the noise that is there, and is sample by sample the filter with the noise so far."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from motor_env import (
    PAPER_MOTOR,
    Channel,
    KalmanFilter,
    Scenario,
    SensorParameters,
    Timing,
    adaptive_filter,
    simulate,
)
from motor_env.filters.adaptive import MEMORY, adapted_noise

BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)


def test_the_measurement_noise_is_found() -> None:
    scenario = Scenario(
        PAPER_MOTOR, sensor=BOTH, timing=Timing(duration_s=0.2), process_noise_std=(1e-5, 1e-3)
    )
    start = simulate(scenario, seed=2, cases=range(30))
    right = KalmanFilter.from_parameters(PAPER_MOTOR, BOTH, 1e-4)
    belief = replace(right, measurement_covariance=4.0 * right.measurement_covariance)
    result = adaptive_filter(belief, start.measurements, start.voltage_v[0])
    found, sigma = result.measurement_covariance[:, 1000:], BOTH.noise_std
    np.testing.assert_allclose(found.mean(axis=(0, 1)) / np.outer(sigma, sigma), np.eye(2), atol=0.05)
    assert result.nis[:, 1000:].mean() == pytest.approx(2.0, rel=0.05)
    # From so many samples a variance is known to sqrt(2 / memory).
    spread = found[..., 0, 0].std() / sigma[0] ** 2
    assert 0.6 < spread / np.sqrt(2.0 / MEMORY) < 1.4


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
    r, q, likelihood = np.diag([4e-4, 4.0]), np.square(noise_std), 0.0
    for k in range(12):
        x, carried = a @ x + b[:, 0] * voltage[k], a @ p @ a.T
        ahead = carried + np.diag(q)
        gain = ahead @ np.linalg.inv(ahead + r)
        error = measured[:, k] - x
        np.testing.assert_allclose(result.innovation[0, k], error, rtol=1e-9, atol=1e-12)
        white = np.linalg.solve(np.linalg.cholesky(ahead + r), error)
        np.testing.assert_allclose(result.whitened[0, k], white, rtol=1e-9)
        assert result.nis[0, k] == pytest.approx(white @ white, rel=1e-9)
        likelihood += multivariate_normal.logpdf(error, cov=ahead + r)
        x, p = x + gain @ error, ahead - gain @ ahead
        left = measured[:, k] - x
        r = (1.0 - share) * r + share * (np.outer(left, left) + p)
        q = np.maximum((1.0 - share) * q + share * (np.square(gain @ error) + np.diag(p - carried)), 0.0)
        np.testing.assert_allclose(result.state[0, k], x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(result.measurement_covariance[0, k], r, rtol=1e-9)
        np.testing.assert_allclose(result.process_variance[0, k], q, rtol=1e-6, atol=1e-12)
    assert result.log_likelihood[0] == pytest.approx(likelihood, rel=1e-9)
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
    with pytest.raises(ValueError, match=r"memory must be >= 1, got 0\.5"):
        adaptive_filter(belief, np.zeros((1, 1, 5)), np.zeros(5), memory=0.5)
    batch = KalmanFilter.from_parameters(
        PAPER_MOTOR.scaled(inertia_kg_m2=np.ones(3)), SensorParameters(), 1e-4
    )
    with pytest.raises(ValueError, match="filter of one motor"):
        adaptive_filter(batch, np.zeros((3, 1, 5)), np.zeros(5))
