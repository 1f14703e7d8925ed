"""Whitening with S + J P J' against the dense Cholesky factor; matched tests against simulation and theory."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from motor_env import (
    Channel,
    Fault,
    FaultKind,
    KalmanFilter,
    Recipe,
    SensorParameters,
    Timing,
    draw,
    load_recipe,
    run_filter,
    simulate,
)
from motor_env.inference.whitening import MarginalWhitener, MatchedTest, StatisticLaw, innovation_slopes
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

BENCH = load_recipe("bench")
PAPER = load_recipe("paper")
BEARING_10 = Fault(FaultKind.BEARING, 0.10)
CONTACT_5 = Fault(FaultKind.WINDING_CONTACT, 0.05)


def motors_of(recipe: Recipe, fault: Fault | None, n: int, seed: int = 4) -> FloatArray:
    only = FaultClass() if fault is None else FaultClass(fault.kind, float(fault.severity))
    drawn = draw(replace(recipe, classes=(only,)), seed, np.arange(n))
    return simulate(drawn.scenario, seed, drawn.cases).measurements


def test_whitening_is_the_cholesky_factor_of_the_dense_covariance() -> None:
    rng = np.random.default_rng(5)
    slopes = rng.standard_normal((30, 2, 4)) * [0.1, 1.0, 5.0, 30.0]
    residual = rng.standard_normal((3, 30, 2)) * 10.0
    flat = slopes.reshape(60, 4)
    factor = np.linalg.cholesky(np.eye(60) + flat @ flat.T)
    expected = np.linalg.solve(factor, residual.reshape(3, 60).T).T.reshape(3, 30, 2)
    np.testing.assert_allclose(MarginalWhitener.from_slopes(slopes).whiten(residual), expected, atol=1e-9)
    residual[1, 10, 0] = residual[1, 20:25, 1] = np.nan
    seen = ~np.isnan(residual[1].ravel())
    factor = np.linalg.cholesky(np.eye(seen.sum()) + flat[seen] @ flat[seen].T)
    found = MarginalWhitener.from_slopes(slopes).whiten(residual)[1].ravel()
    expected = np.linalg.solve(factor, residual[1].ravel()[seen])
    np.testing.assert_allclose(found[seen], expected, atol=1e-9)
    assert np.isnan(found[~seen]).all()
    with pytest.raises(ValueError, match="residual must hold 60 values a case, got 58"):
        MarginalWhitener.from_slopes(slopes).whiten(residual[:, :29])


@pytest.mark.parametrize("process_noise_std", [(0.0, 0.0), (1e-3, 0.1)])
def test_innovation_slopes_are_those_of_the_filter(process_noise_std: tuple[float, float]) -> None:
    both = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)
    recipe = replace(BENCH, sensor=both, timing=Timing(1_000.0, 0.1))
    belief = KalmanFilter.from_parameters(recipe.motor, both, 1e-3, process_noise_std=process_noise_std)
    slopes = innovation_slopes(recipe, belief)
    step = 1e-4
    whitened = []
    for sign in (-1.0, 1.0):
        motor = recipe.motor.scaled(viscous_friction_n_m_s_per_rad=1.0 + sign * step)
        exact = replace(PAPER, motor=motor, sensor=replace(both, current_noise_a=0.0, speed_noise_rad_s=0.0))
        measured = motors_of(replace(exact, timing=recipe.timing), None, 1)
        whitened.append(run_filter(belief, measured[0], np.full(100, 12.0)).whitened)
    expected = (whitened[1] - whitened[0]) / (2.0 * step) * recipe.spread.friction
    np.testing.assert_allclose(slopes[..., -1], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("recipe", "fault", "one_sided", "two_sided"),
    [
        (PAPER, BEARING_10, 0.935, 0.897),
        (PAPER, Fault(FaultKind.WINDING_CONTACT, 0.005), 0.983, 0.969),
        (BENCH, BEARING_10, 0.641, 0.577),
        (BENCH, CONTACT_5, 0.960, 0.943),
    ],
)
def test_power_is_that_of_theory(recipe: Recipe, fault: Fault, one_sided: float, two_sided: float) -> None:
    test = MatchedTest.from_recipe(recipe, fault)
    if recipe is PAPER:
        assert test.threshold_for(0.01) == pytest.approx(norm.isf(0.01), abs=1e-9)
    assert test.power(0.01) == pytest.approx(one_sided, abs=0.002)
    assert test.power(0.01, two_sided=True) == pytest.approx(two_sided, abs=0.002)


@pytest.mark.parametrize("fault", [BEARING_10, CONTACT_5])
@pytest.mark.parametrize("two_sided", [True, False])
def test_tolerances_keep_the_rate_and_the_power(fault: Fault, two_sided: bool) -> None:
    recipe, n = replace(BENCH, timing=Timing(2_000.0, 0.1)), 5_000
    test = MatchedTest.from_recipe(recipe, fault)
    threshold = test.threshold_for(0.01, two_sided=two_sided)
    for known, rate in ((None, 0.01), (fault, test.power(0.01, two_sided=two_sided))):
        values = test.statistic(motors_of(recipe, known, n))
        beyond = int(((np.abs(values) if two_sided else values) > threshold).sum())
        assert binomtest(beyond, n, rate).pvalue > 0.01


def test_a_law_is_a_mixture_of_normals() -> None:
    law = StatisticLaw(np.array([-1.0, 2.0]), np.array([0.3, 0.7]), 0.5)
    above = 0.3 * norm.sf(1.5, -1.0, 0.5) + 0.7 * norm.sf(1.5, 2.0, 0.5)
    assert law.above(1.5) == pytest.approx(above, rel=1e-12)
    below = 0.3 * norm.cdf(-1.5, -1.0, 0.5) + 0.7 * norm.cdf(-1.5, 2.0, 0.5)
    assert law.beyond(1.5) == pytest.approx(above + below, rel=1e-12)


def test_bad_faults_are_named() -> None:
    with pytest.raises(ValueError, match="onset_s must be that of a fault always there"):
        MatchedTest.from_recipe(BENCH, Fault(FaultKind.BEARING, 0.1, onset_s=0.05))
    with pytest.raises(ValueError, match="fault must change the motor"):
        MatchedTest.from_recipe(BENCH, Fault(FaultKind.NOISE, 0.5))
