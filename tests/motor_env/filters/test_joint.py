"""Joint filters against a simulation of other equations, and written out anew."""

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, Channel, MotorParameters, SensorParameters, discretize, joint_filter
from motor_env.filters.adaptive import FREE, JointKind, coulomb_unit_n_m, parameter_test_threshold
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray

# Reaches in: the reference is the Runge-Kutta integrator at ten times its steps, which no public name lets choose.
from motor_env.simulation.nonlinear import Effects, Sampling, integrate, substeps


def with_ten_percent_more(name: str) -> tuple[MotorParameters, Effects]:
    """The motor with a larger parameter; dry friction is a tenth of the drag at full speed."""
    if name == "coulomb":
        return PAPER_MOTOR, Effects(coulomb_friction_n_m=0.1 * coulomb_unit_n_m(PAPER_MOTOR, 12.0))
    return PAPER_MOTOR.scaled(**dict.fromkeys(QUANTITY_FIELDS[name], 1.1)), Effects()


@pytest.mark.parametrize("kind", list(JointKind))
@pytest.mark.parametrize("name", FREE)
def test_each_parameter_can_be_estimated_from_the_current(name: str, kind: JointKind) -> None:
    """Against the Runge-Kutta simulation, which shares no line with the filter's discretisation."""
    motor, effects = with_ten_percent_more(name)
    out = np.empty((40, 1, 600), dtype=np.float32)
    steps = 10 * substeps(PAPER_MOTOR, 1e-4)
    integrate(motor, effects, 12.0, Sampling(1e-4, steps, np.array([True]), out), 0)
    noise = 0.005
    measured = out + noise * np.random.default_rng(6).standard_normal(out.shape)
    sensor = SensorParameters(current_noise_a=noise)
    result = joint_filter(PAPER_MOTOR, sensor, 1e-4, measured, np.full(600, 12.0), names=(name,), kind=kind)
    found = result.theta[:, -1, 0]
    claimed = float(np.sqrt(result.covariance[:, -1, 0, 0]).mean())
    truth = 0.1 if name == "coulomb" else np.log(1.1)
    # Far off the believed motor the first samples are not linear in theta: a bias of a fifth of a percent at most.
    assert abs(found.mean() - truth) < 4.0 * claimed / np.sqrt(len(found)) + 0.002
    assert 0.6 * claimed < found.std() < 1.4 * claimed
    assert claimed < 0.02


def ahead(x: FloatArray, voltage: float) -> FloatArray:
    """One sample of [current, speed, log factors of R and of both constants, dry friction]: the equations anew."""
    factors = np.exp(x[2:4])
    motor = PAPER_MOTOR.scaled(
        resistance_ohm=factors[0],
        back_emf_constant_v_s_per_rad=factors[1],
        torque_constant_n_m_per_a=factors[1],
    )
    model = discretize(motor, 1e-4)
    torque = x[4] * 12e-7 * 12.0 / 0.02352  # of the viscous torque at the speed of the highest voltage
    state = model.transition @ x[:2] + model.gain @ [voltage, torque * x[1] / np.sqrt(1.0 + x[1] ** 2)]
    return np.concatenate([state, x[2:]])


@pytest.mark.parametrize("memory", [None, 5.0])
@pytest.mark.parametrize("kind", list(JointKind))
def test_each_filter_does_what_its_name_says(kind: JointKind, memory: float | None) -> None:
    """The first samples of a start, where dry friction is least like a constant load, against both filters anew."""
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 1.0)
    voltage, rng = np.array([12.0, 11.0, -3.0, 5.0, 8.0, 2.0]), np.random.default_rng(3)
    measured = rng.standard_normal((1, 2, 6)) * np.array([[0.5], [2.0]])
    names = ("resistance", "constants", "coulomb")
    got = joint_filter(
        PAPER_MOTOR, sensor, 1e-4, measured, voltage, names=names, prior_std=0.2, kind=kind, memory=memory
    )
    x, p = np.zeros(5), np.diag([1e-12, 1e-8, 0.04, 0.04, 0.04])
    q, r, c = np.diag([1e-10, 1e-6, 0.0, 0.0, 0.0]), np.diag([4e-4, 1.0]), np.eye(2, 5)
    for k in range(6):
        if kind is JointKind.EXTENDED:
            steps = 1e-5 * np.eye(5)
            slope = [(ahead(x + s, voltage[k]) - ahead(x - s, voltage[k])) / 2e-5 for s in steps]
            x, p = ahead(x, voltage[k]), np.transpose(slope) @ p @ slope
        else:
            root = np.linalg.cholesky(5.0 * p).T
            points = [ahead(x + sign * row, voltage[k]) for sign in (1.0, -1.0) for row in root]
            x, p = np.mean(points, axis=0), np.cov(np.transpose(points), bias=True)
        s = c @ (p + q) @ c.T + r
        gain = (p + q) @ c.T @ np.linalg.inv(s)
        error = measured[0, :, k] - x[:2]
        np.testing.assert_allclose(got.innovation[0, k], error, rtol=1e-6, atol=1e-9)
        assert got.nis[0, k] == pytest.approx(error @ np.linalg.inv(s) @ error, rel=1e-6)
        x, p = x + gain @ error, p + q - gain @ s @ gain.T
        if memory is not None:  # towards what is left over after the update, a third of the way
            left = measured[0, :, k] - x[:2]
            r = r + (np.outer(left, left) + c @ p @ c.T - r) / 3.0
        np.testing.assert_allclose(got.theta[0, k], x[2:], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(got.covariance[0, k], p[2:, 2:], rtol=1e-5, atol=1e-9)
    expected = x[2:] @ np.linalg.inv(p[2:, 2:]) @ x[2:]
    assert got.statistic[0, -1] == pytest.approx(expected, rel=1e-4)


def test_what_is_estimated_unless_told_otherwise() -> None:
    measured, voltage = np.random.default_rng(5).standard_normal((1, 1, 8)), np.full(8, 12.0)
    given = (PAPER_MOTOR, SensorParameters(), 1e-4, measured, voltage)
    told = joint_filter(
        *given,
        names=("resistance", "friction"),
        prior_std=0.3,
        process_noise_std=(1e-5, 1e-3),
        kind=JointKind.EXTENDED,
        memory=None,
    )
    np.testing.assert_array_equal(joint_filter(*given).theta, told.theta)


def test_the_threshold_at_one_sample_is_chi_square() -> None:
    assert parameter_test_threshold(2, 0.1) == pytest.approx(
        -2.0 * np.log(0.1)
    )  # of two degrees: exponential


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="names must be of resistance"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 1, 5)), np.zeros(5), names=("mass",))
    with pytest.raises(ValueError, match="measurements must have shape"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 5)), np.zeros(5))
    with pytest.raises(ValueError, match="memory must be >= 1, got 0"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 1, 5)), np.zeros(5), memory=0.0)
