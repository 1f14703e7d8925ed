"""The fits against theory: the Cramer-Rao bound, the covariance of the estimates, an independent least-squares."""

from typing import Any

import numpy as np
import pytest
from limits import cramer_rao_bound
from scipy.optimize import least_squares

from motor_env import (
    PAPER_MOTOR,
    Channel,
    MotorParameters,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    draw,
    load_recipe,
    simulate,
    simulate_states,
)
from motor_env.inference.class_model import FEATURE_FREE, FEATURE_NAMES, physical_features
from motor_env.inference.fit import Prior, fit
from motor_env.inference.sensitivities import (
    QUANTITIES,
    Coordinates,
    NormalEquations,
    Observed,
    common_equations,
    jacobian,
    normal_equations,
)
from motor_env.motor.parameters import FloatArray

TIMING = Timing(10_000.0, 0.1)
SENSOR = SensorParameters()
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)
VOLTAGE = TIMING.step(12.0)
FREE = ("supply", "resistance", "inductance", "constants", "inertia", "friction")


def healthy(
    n: int, sensor: SensorParameters = SENSOR, parameters: MotorParameters = PAPER_MOTOR
) -> FloatArray:
    scenario = Scenario(parameters, supply=SupplyParameters(12.0), sensor=sensor, timing=TIMING)
    return simulate(scenario, 3, np.arange(n)).measurements


@pytest.mark.parametrize("logarithmic", [True, False])
def test_jacobian_is_the_slope_of_the_simulated_response(logarithmic: bool) -> None:
    motor = PAPER_MOTOR.scaled(inductance_h=10.0, viscous_friction_n_m_s_per_rad=10.0)  # so that both show
    coordinates = Coordinates(motor, QUANTITIES, (0.5, 0.01, 0.02, 1.0, 0.1, 0.3), logarithmic)

    def response(values: FloatArray) -> FloatArray:
        motor, supply = coordinates.motors(values)
        return simulate_states(motor, VOLTAGE * supply, TIMING.dt_s).T

    got_response, got = jacobian(coordinates, VOLTAGE, BOTH, TIMING.dt_s)
    np.testing.assert_allclose(got_response, response(np.zeros(6)), rtol=1e-10, atol=1e-12)
    for j, scale in enumerate(coordinates.scales):
        side = 1e-4 / scale * np.eye(6)[j]
        expected = (response(side) - response(-side)) / (2.0 * side[j])
        np.testing.assert_allclose(got[..., j], expected, atol=1e-6 * np.abs(expected).max())


def test_normal_equations_are_squares_and_their_derivatives() -> None:
    rng = np.random.default_rng(2)
    volts = 12.0 + rng.standard_normal(25)
    measured = rng.standard_normal((3, 2, 25)) * np.array([[1.0], [50.0]])
    coordinates = Coordinates(PAPER_MOTOR, FREE, (0.5, 0.2, 0.3, 1.0, 0.4, 0.6))
    values = 0.3 * rng.standard_normal((3, 6))

    def residuals(case: int, at: FloatArray) -> FloatArray:
        motor, supply = coordinates.motors(at)
        states = simulate_states(motor, supply * volts, 1e-4)
        return np.asarray((measured[case] - states.T) / np.array([[0.02], [2.0]])).ravel()

    def check(equations: NormalEquations, row: int, case: int, at: FloatArray) -> None:
        chi2, gradient, information = (part[row] for part in equations)
        left, steps = residuals(case, at), 1e-4 * np.eye(6)
        slopes = np.stack([(residuals(case, at + s) - residuals(case, at - s)) / 2e-4 for s in steps], axis=1)
        scale, size = np.linalg.norm(slopes, axis=0), float(np.linalg.norm(left))
        assert chi2 == pytest.approx(size**2, rel=1e-9)
        np.testing.assert_allclose(gradient / scale, -slopes.T @ left / scale, atol=1e-5 * size)
        unit = np.outer(scale, scale)
        np.testing.assert_allclose(information / unit, slopes.T @ slopes / unit, atol=1e-5)

    each = Observed.from_measurements(measured, volts, BOTH, 1e-4)
    got = normal_equations(each, coordinates, values)
    some = normal_equations(each, coordinates, values[1:], np.array([1, 2]))
    together = common_equations(each, coordinates, values[1])
    for n in range(3):
        check(got, n, n, values[n])
        check(together, n, n, values[1])
    check(some, 1, 2, values[2])
    chi2 = np.array([np.square(residuals(n, np.zeros(6))).sum() for n in range(3)])
    fitted = fit(each, coordinates, Prior.from_std(np.full(6, 0.5)), max_iterations=0)
    np.testing.assert_allclose(fitted.chi2, chi2, rtol=1e-9)
    likelihood = -0.5 * chi2 - 25.0 * np.log(2.0 * np.pi * 0.02 * 2.0)
    np.testing.assert_allclose(each.log_normaliser - 0.5 * fitted.chi2, likelihood, rtol=1e-9)
    wider = each.with_variance(4.0)
    np.testing.assert_allclose(normal_equations(wider, coordinates, values).chi2, got.chi2 / 4.0, rtol=1e-12)
    assert wider.log_normaliser == pytest.approx(each.log_normaliser - 50.0 * np.log(2.0))


def test_maximum_likelihood_reaches_the_bound_and_its_intervals_cover() -> None:
    n = 4000
    observed = Observed.from_measurements(healthy(n), VOLTAGE, SENSOR, TIMING.dt_s)
    fitted = fit(observed, Coordinates.from_names(PAPER_MOTOR, ("resistance", "friction")))
    assert fitted.converged.all()
    bound = np.sqrt(np.diag(cramer_rao_bound(PAPER_MOTOR, SENSOR, TIMING)))
    np.testing.assert_allclose(fitted.values.std(axis=0), bound, rtol=0.05)
    coverage = (np.abs(fitted.values) < 1.6449 * fitted.std).mean(axis=0)
    assert ((coverage > 0.88) & (coverage < 0.92)).all()
    # Two fitted parameters take two degrees of freedom.
    assert fitted.chi2.mean() == pytest.approx(
        TIMING.n_samples - 2, abs=5 * np.sqrt(2 * TIMING.n_samples / n)
    )


@pytest.mark.parametrize("sensor", [SENSOR, BOTH])
def test_fit_finds_the_minimum_that_scipy_finds(sensor: SensorParameters) -> None:
    true = PAPER_MOTOR.scaled(resistance_ohm=1.4, inertia_kg_m2=0.7, viscous_friction_n_m_s_per_rad=2.5)
    measured, std = healthy(2, sensor, parameters=true), np.array([0.01, 0.5, 0.2, 0.01, 0.5, 0.8])
    coordinates = Coordinates.from_names(PAPER_MOTOR, FREE)
    observed = Observed.from_measurements(measured, VOLTAGE, sensor, TIMING.dt_s)
    fitted = fit(observed, coordinates, Prior.from_std(std))
    assert fitted.converged.all()

    def residuals(values: FloatArray, case: int) -> FloatArray:
        motor, supply = coordinates.motors(values)
        states = simulate_states(motor, VOLTAGE * supply, TIMING.dt_s)
        error = (measured[case] - sensor.observation @ states.T) / sensor.noise_std[:, None]
        return np.concatenate([error.ravel(), values / std])

    for case in range(2):
        best = least_squares(residuals, np.zeros(6), args=(case,), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert fitted.objective[case] == pytest.approx(2.0 * best.cost, abs=1e-6)
        np.testing.assert_allclose(fitted.values[case], best.x, atol=1e-3 * fitted.std[case].min())
    alone = fit(observed.rows(slice(1, 2)), coordinates, Prior.from_std(std))
    np.testing.assert_allclose(alone.values[0], fitted.values[1], rtol=0, atol=1e-9)


def test_the_null_direction_of_current_alone_is_refused_and_speed_opens_it() -> None:
    free = ("resistance", "constants", "inertia", "friction")
    with pytest.raises(ValueError, match="cannot all be determined"):
        cramer_rao_bound(PAPER_MOTOR, SENSOR, TIMING, free=free)
    observed = Observed.from_measurements(healthy(2), VOLTAGE, SENSOR, TIMING.dt_s)
    with pytest.raises(ValueError, match="cannot all be determined"):
        fit(observed, Coordinates.from_names(PAPER_MOTOR, free))
    assert np.isfinite(cramer_rao_bound(PAPER_MOTOR, BOTH, TIMING, free)).all()
    # A prior on K of 1 % goes to J and B doubled: both scale with its square.
    std = np.sqrt(
        np.diag(cramer_rao_bound(PAPER_MOTOR, SENSOR, TIMING, free, [np.inf, 0.01, np.inf, np.inf]))
    )
    np.testing.assert_allclose(std[2:], np.hypot(0.02, [0.00114, 0.0267]), rtol=0.02)


def test_physical_features_see_the_faults() -> None:
    recipe = load_recipe("bench")
    drawn = draw(recipe, 5, np.arange(200))
    measured = simulate(drawn.scenario, 5, drawn.cases).measurements
    features = physical_features(recipe, measured)
    assert features.shape == (200, len(FEATURE_NAMES))
    column = dict(zip(FEATURE_NAMES, features.T, strict=True))
    coordinates = Coordinates.from_names(recipe.motor, FEATURE_FREE)
    motors, supply = coordinates.motors(features[:, :5])
    left = (measured[:, 0] - simulate_states(motors, supply[:, None] * VOLTAGE, TIMING.dt_s)[..., 0]) / 0.02
    observed = Observed.from_measurements(measured, VOLTAGE, SENSOR, TIMING.dt_s)
    std = fit(observed, coordinates, Prior.from_std([0.3, 0.3, 0.01, 0.01, 0.02])).std
    for name, expected in {
        "log_std_resistance": np.log(std[:, 0]),
        "log_std_friction": np.log(std[:, 1]),
        "residual_mean": left.mean(axis=1),
        "residual_late_mean": left[:, 800:].mean(axis=1),
        "residual_lag1": (left[:, 1:] * left[:, :-1]).sum(axis=1) / 999.0,
        "residual_largest": np.abs(left).max(axis=1),
        "reduced_chi2": np.square(left).mean(axis=1),
    }.items():
        np.testing.assert_allclose(column[name], expected, rtol=1e-5, atol=1e-9, err_msg=name)
    truth = np.array([fault_class.severity for fault_class in recipe.classes])[drawn.class_index]
    for kind, name, tolerance in (("winding", "log_resistance", 0.02), ("bearing", "log_friction", 0.06)):
        members = np.array([c.label_kind.startswith(kind) for c in recipe.classes])[drawn.class_index]
        error = column[name][members] - np.log1p(truth[members])
        assert abs(error.mean()) < tolerance
        assert error.std() < 1.5 * tolerance


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"measurements": np.zeros((2, 3, 10))}, r"must have shape \(..., 1, n_samples\)"),
        ({"measurements": np.full((1, 1, 10), np.nan)}, "measurements must be finite"),
        ({"voltage_v": np.zeros(9)}, "voltage_v must have shape"),
        ({"sensor": SensorParameters(current_noise_a=0.0)}, "noise of each channel must be > 0"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], sentence: str) -> None:
    good: dict[str, Any] = {"voltage_v": np.zeros(10), "sensor": SENSOR, "dt_s": 1e-4}
    with pytest.raises(ValueError, match=sentence):
        Observed.from_measurements(**({"measurements": np.zeros((2, 1, 10))} | good | change))
    with pytest.raises(ValueError, match=r"free must be among .*, got 'mass'"):
        Coordinates.from_names(PAPER_MOTOR, ("resistance", "mass"))
