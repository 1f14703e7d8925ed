"""Consistency checks keep their level and see what is wrong; process noise absorbs faults."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2, norm

from motor_env import (
    PAPER_MOTOR,
    Cusum,
    Fault,
    FaultKind,
    KalmanFilter,
    Scenario,
    SensorParameters,
    Timing,
    check_consistency,
    run_filter,
    simulate,
)
from motor_env.filters.consistency import Consistency
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.parameters import FloatArray

SENSOR = SensorParameters()


def test_white_innovations_are_rejected_at_the_level() -> None:
    noise = np.random.default_rng(1).standard_normal((1500, 300, 1))
    rejected = sum(not check_consistency(row, level=0.05).holds for row in noise)
    assert 0.02 * 1500 < rejected < 0.08 * 1500
    everything = check_consistency(noise)
    assert everything.holds
    assert everything.warning == ""


def test_the_three_tests_value_by_value() -> None:
    """Sums written out over the values measured; a lag's sum has as many terms as it has pairs of neighbours."""
    values = 0.9 * np.random.default_rng(4).standard_normal((2, 25, 2))
    values[0, 7:9, 1] = values[1, 20, 0] = np.nan
    seen = values[~np.isnan(values)]
    statistic = 0.0
    for lag in (1, 2, 3):
        products = [
            values[n, k, c] * values[n, k - lag, c] for n in range(2) for k in range(lag, 25) for c in (0, 1)
        ]
        known = [product for product in products if not np.isnan(product)]
        statistic += sum(known) ** 2 / len(known)
    got = check_consistency(values, lags=3, level=0.2)
    assert (got.n_values, got.level) == (97, 0.2)
    assert got.mean_p == pytest.approx(2.0 * norm.sf(abs(seen.sum()) / np.sqrt(97.0)))
    squares = np.square(seen).sum()
    assert got.nis_p == pytest.approx(2.0 * min(chi2.cdf(squares, 97), chi2.sf(squares, 97)))
    assert got.whiteness_p == pytest.approx(chi2.sf(statistic, 3))
    assert got.mean_square == pytest.approx(squares / 97.0)
    assert check_consistency(values).level == 0.01


@pytest.mark.parametrize("place", range(3))
def test_each_test_rejects_at_a_third_of_the_level(place: int) -> None:
    words = ["mean is not 0", "mean square is 1.2 instead of 1", "correlated in time"]
    for p_value, holds in ((0.01001, True), (0.00999, False)):
        p_values = [0.5, 0.5, 0.5]
        p_values[place] = p_value
        mean_p, nis_p, whiteness_p = p_values
        found = Consistency(100, mean_p, nis_p, whiteness_p, mean_square=1.2, level=0.03)
        assert found.holds == holds
        assert [word in found.warning for word in words] == [n == place and not holds for n in range(3)]


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda x: x + 0.3, "mean is not 0"),
        (lambda x: 1.3 * x, "mean square is"),
        (lambda x: (x + 0.5 * np.roll(x, 1, axis=0)) / np.sqrt(1.25), "correlated in time"),
    ],
)
def test_each_kind_of_inconsistency_is_named(spoil: Callable[[FloatArray], FloatArray], word: str) -> None:
    noise = np.random.default_rng(2).standard_normal((1000, 1))
    noise[100:110] = np.nan
    spoiled = check_consistency(np.where(np.isnan(noise), np.nan, spoil(np.nan_to_num(noise))))
    assert not spoiled.holds
    assert word in spoiled.warning
    assert spoiled.n_values == 990


def test_too_much_process_noise_blinds_a_cusum() -> None:
    """A residual against a threshold from healthy transients, at 1 % false alarms."""
    timing, fault = Timing(), Fault(FaultKind.BEARING, 0.1)
    healthy = simulate(Scenario(PAPER_MOTOR, timing=timing), seed=1, cases=range(500))
    faulty = simulate(Scenario(PAPER_MOTOR, faults=(fault,), timing=timing), seed=2, cases=range(200))
    rule, found = Cusum(shift=0.13, two_sided=True), []
    for std in (DEFAULT_PROCESS_NOISE_STD, (1e-2, 0.316)):
        belief = KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, timing.dt_s, process_noise_std=std)
        largest = [
            rule.statistic(run_filter(belief, t.measurements, t.voltage_v[0]).whitened).max(axis=1)
            for t in (healthy, faulty)
        ]
        found.append((largest[1] > np.quantile(largest[0], 0.99)).mean())
    assert found[0] > 0.65
    assert found[1] < 0.08


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"n_samples > 20"):
        check_consistency(np.zeros((20, 1)))
    with pytest.raises(ValueError, match="must hold a measured sample"):
        check_consistency(np.full((30, 1), np.nan))
