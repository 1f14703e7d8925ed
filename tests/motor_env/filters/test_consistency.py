"""Consistency checks keep their level and see what is wrong."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from motor_env import check_consistency
from motor_env.filters.consistency import Consistency


def test_the_three_tests_value_by_value() -> None:
    """Sums written out over the values measured; a lag's sum has as many terms as it has pairs of neighbours."""
    values = 0.9 * np.random.default_rng(4).standard_normal((2, 25, 2))
    values[0, 7:9, 1] = values[1, 20, 0] = np.nan
    seen = values[~np.isnan(values)]
    statistic = 0.0
    for lag in range(1, 21):
        products = [
            values[n, k, c] * values[n, k - lag, c] for n in range(2) for k in range(lag, 25) for c in (0, 1)
        ]
        known = [product for product in products if not np.isnan(product)]
        statistic += sum(known) ** 2 / len(known)
    got = check_consistency(values)
    assert got.n_values == 97
    assert got.mean_p == pytest.approx(2.0 * norm.sf(abs(seen.sum()) / np.sqrt(97.0)))
    squares = np.square(seen).sum()
    assert got.nis_p == pytest.approx(2.0 * min(chi2.cdf(squares, 97), chi2.sf(squares, 97)))
    assert got.whiteness_p == pytest.approx(chi2.sf(statistic, 20))
    assert got.mean_square == pytest.approx(squares / 97.0)


@pytest.mark.parametrize("place", range(3))
def test_each_test_rejects_at_a_third_of_one_per_cent(place: int) -> None:
    words = ["mean is not 0", "mean square is 1.2 instead of 1", "correlated in time"]
    for p_value, holds in ((0.00334, True), (0.00333, False)):
        p_values = [0.5, 0.5, 0.5]
        p_values[place] = p_value
        mean_p, nis_p, whiteness_p = p_values
        found = Consistency(100, mean_p, nis_p, whiteness_p, mean_square=1.2)
        assert found.holds == holds
        assert [word in found.warning for word in words] == [n == place and not holds for n in range(3)]


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"n_samples > 20"):
        check_consistency(np.zeros((20, 1)))
    with pytest.raises(ValueError, match="must hold a measured sample"):
        check_consistency(np.full((30, 1), np.nan))
