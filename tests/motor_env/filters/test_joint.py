"""Joint filters against the Cramer-Rao bound and against each other."""

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    MotorParameters,
    Scenario,
    SensorParameters,
    Timing,
    discretize,
    joint_filter,
    simulate,
)
from motor_env.filters.joint import FREE, JointKind, coulomb_unit_n_m, parameter_test_threshold
from motor_env.motor.parameters import FloatArray

# Reaches in: the reference is the Runge-Kutta integrator at ten times its steps, which no public name lets choose.
from motor_env.simulation.nonlinear import Effects, Sampling, integrate, substeps

TIMING = Timing()
FAULTS = (Fault(FaultKind.WINDING_CONTACT, 0.1), Fault(FaultKind.BEARING, 0.25))


@pytest.mark.parametrize("kind", list(JointKind))
def test_estimates_are_near_the_cramer_rao_bound(kind: JointKind) -> None:
    transients = simulate(Scenario(PAPER_MOTOR, faults=FAULTS, timing=TIMING), seed=3, cases=range(120))
    result = joint_filter(
        PAPER_MOTOR,
        SensorParameters(),
        TIMING.dt_s,
        transients.measurements,
        transients.voltage_v[0],
        kind=kind,
    )
    estimate = np.exp(result.theta[:, -1])
    # Cramer-Rao bound at 20 mA, 0.1 s: 0.11 % of R, 2.6 % of B for the healthy motor; the faulty one's B shows better.
    assert estimate[:, 0].std() / 1.1 < 0.0016
    assert estimate[:, 1].std() / 1.25 < 0.030
    np.testing.assert_allclose(estimate.mean(axis=0), [1.1, 1.25], rtol=0.01)
    claimed = np.sqrt(np.diagonal(result.covariance[:, -1], axis1=1, axis2=2)).mean(axis=0)
    np.testing.assert_allclose(result.theta[:, -1].std(axis=0), claimed, rtol=0.3)


def with_ten_percent_more(name: str) -> tuple[MotorParameters, Effects]:
    """The motor with a larger parameter; dry friction is a tenth of the drag at full speed."""
    fields = {
        "resistance": ("resistance_ohm",),
        "inductance": ("inductance_h",),
        "constants": ("back_emf_constant_v_s_per_rad", "torque_constant_n_m_per_a"),
        "inertia": ("inertia_kg_m2",),
        "friction": ("viscous_friction_n_m_s_per_rad",),
    }
    if name == "coulomb":
        return PAPER_MOTOR, Effects(coulomb_friction_n_m=0.1 * coulomb_unit_n_m(PAPER_MOTOR, 12.0))
    return PAPER_MOTOR.scaled(**dict.fromkeys(fields[name], 1.1)), Effects()


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


@pytest.mark.parametrize("kind", list(JointKind))
def test_all_but_the_null_direction_are_estimated_together(kind: JointKind) -> None:
    """K with J and B is not told from the current alone; the other four together are."""
    names = ("resistance", "inductance", "inertia", "friction")
    factors = np.array([1.1, 0.9, 1.1, 1.25])
    motor = PAPER_MOTOR.scaled(
        resistance_ohm=1.1, inductance_h=0.9, inertia_kg_m2=1.1, viscous_friction_n_m_s_per_rad=1.25
    )
    scenario = Scenario(motor, sensor=SensorParameters(current_noise_a=0.005), timing=TIMING)
    transients = simulate(scenario, seed=6, cases=range(20))
    result = joint_filter(
        PAPER_MOTOR,
        scenario.sensor,
        TIMING.dt_s,
        transients.measurements,
        transients.voltage_v[0],
        names=names,
        kind=kind,
    )
    # The first samples tell of the inductance while all four are far off: the slope alone is off by a percent there.
    rtol = 0.02 if kind is JointKind.EXTENDED else 0.01
    np.testing.assert_allclose(np.exp(result.theta[:, -1]).mean(axis=0), factors, rtol=rtol)


def test_a_wrong_noise_is_adapted() -> None:
    transients = simulate(Scenario(PAPER_MOTOR, faults=FAULTS, timing=TIMING), seed=3, cases=range(40))
    wrong = SensorParameters(current_noise_a=0.05)
    given = (PAPER_MOTOR, wrong, TIMING.dt_s, transients.measurements, transients.voltage_v[0])
    fixed, adapted = joint_filter(*given), joint_filter(*given, memory=200.0)
    half = TIMING.n_samples // 2
    assert fixed.nis[:, half:].mean() < 0.2  # (20 mA / 50 mA)^2
    assert adapted.nis[:, half:].mean() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(np.exp(adapted.theta[:, -1]).mean(axis=0), [1.1, 1.25], rtol=0.02)


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


def test_healthy_motors_are_found_faulty_at_the_wanted_rate() -> None:
    transients = simulate(Scenario(PAPER_MOTOR, timing=TIMING), seed=4, cases=range(300))
    result = joint_filter(
        PAPER_MOTOR, SensorParameters(), TIMING.dt_s, transients.measurements, transients.voltage_v[0]
    )
    rate = (result.statistic[:, -1] > parameter_test_threshold(2, 0.1)).mean()
    assert 0.04 < rate < 0.17


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="names must be of resistance"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 1, 5)), np.zeros(5), names=("mass",))
    with pytest.raises(ValueError, match="measurements must have shape"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 5)), np.zeros(5))
    with pytest.raises(ValueError, match="memory must be >= 1 sample, got 0"):
        joint_filter(PAPER_MOTOR, SensorParameters(), 1e-4, np.zeros((1, 1, 5)), np.zeros(5), memory=0.0)
