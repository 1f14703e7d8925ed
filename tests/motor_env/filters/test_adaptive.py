"""The adaptive and the joint filters, sample by sample against the same written out anew."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from motor_env import (
    PAPER_MOTOR,
    Channel,
    KalmanFilter,
    SensorParameters,
    adaptive_filter,
    discretize,
    joint_filter,
)
from motor_env.filters.adaptive import FREE, JointKind, parameter_test_threshold
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray

BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)


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


def ahead(x: FloatArray, voltage: float) -> FloatArray:
    """One sample of current, speed, the logarithms of all factors and the dry friction: the equations anew."""
    factors = dict(zip(FREE, np.exp(x[2:]), strict=True))
    own = {field: factors[name] for name, fields in QUANTITY_FIELDS.items() for field in fields}
    model = discretize(PAPER_MOTOR.scaled(**own), 1e-4)
    torque = x[-1] * 12e-7 * 12.0 / 0.02352  # of the viscous torque at the speed of the highest voltage
    state = model.transition @ x[:2] + model.gain @ [voltage, torque * x[1] / np.sqrt(1.0 + x[1] ** 2)]
    return np.concatenate([state, x[2:]])


@pytest.mark.parametrize("memory", [None, 5.0])
@pytest.mark.parametrize("kind", list(JointKind))
def test_each_filter_does_what_its_name_says(kind: JointKind, memory: float | None) -> None:
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 1.0)
    voltage, rng = np.array([12.0, 11.0, -3.0, 5.0, 8.0, 2.0]), np.random.default_rng(3)
    measured = rng.standard_normal((1, 2, 6)) * np.array([[0.5], [2.0]])
    given = (PAPER_MOTOR, sensor, 1e-4, measured, voltage)
    got = joint_filter(*given, names=FREE, prior_std=0.2, kind=kind, memory=memory)
    size = 2 + len(FREE)
    x, p = np.zeros(size), np.diag([1e-12, 1e-8, *[0.04] * len(FREE)])
    q, r, c = np.diag([1e-10, 1e-6, *[0.0] * len(FREE)]), np.diag([4e-4, 1.0]), np.eye(2, size)
    for k in range(6):
        if kind is JointKind.EXTENDED:
            steps = 1e-5 * np.eye(size)
            slope = [(ahead(x + s, voltage[k]) - ahead(x - s, voltage[k])) / 2e-5 for s in steps]
            x, p = ahead(x, voltage[k]), np.transpose(slope) @ p @ slope
        else:
            root = np.linalg.cholesky(size * p).T
            points = [ahead(x + sign * row, voltage[k]) for sign in (1.0, -1.0) for row in root]
            x, p = np.mean(points, axis=0), np.cov(np.transpose(points), bias=True)
        s = c @ (p + q) @ c.T + r
        gain = (p + q) @ c.T @ np.linalg.inv(s)
        error = measured[0, :, k] - x[:2]
        np.testing.assert_allclose(got.innovation[0, k], error, rtol=1e-5, atol=1e-9)
        assert got.nis[0, k] == pytest.approx(error @ np.linalg.inv(s) @ error, rel=1e-5)
        x, p = x + gain @ error, p + q - gain @ s @ gain.T
        if memory is not None:  # towards what is left over after the update, a third of the way
            left = measured[0, :, k] - x[:2]
            r = r + (np.outer(left, left) + c @ p @ c.T - r) / 3.0
        np.testing.assert_allclose(got.theta[0, k], x[2:], rtol=1e-5, atol=5e-6)
        np.testing.assert_allclose(got.covariance[0, k], p[2:, 2:], rtol=1e-5, atol=1e-6)
    expected = x[2:] @ np.linalg.inv(p[2:, 2:]) @ x[2:]
    assert got.statistic[0, -1] == pytest.approx(expected, rel=1e-4)


def test_the_threshold_at_one_sample_is_chi_square() -> None:
    exponential = -2.0 * np.log(0.1)  # the law of two degrees
    assert parameter_test_threshold(2, 0.1) == pytest.approx(exponential)


def test_a_sample_that_takes_the_estimate_away_is_named() -> None:
    wild = np.full((1, 1, 5), 1e99)
    with pytest.raises(ValueError, match=r"at sample \d+: the largest measurements there are"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, wild, np.zeros(5))
