"""The mass of normal distributions in a box, beside scipy's and beside the tail's own expansion."""

import numpy as np
import pytest
from box_mass import log_box_masses
from scipy.special import logsumexp
from scipy.stats import multivariate_normal


def test_masses_of_several_distributions_are_those_of_scipy() -> None:
    rng = np.random.default_rng(1)
    roots = rng.standard_normal((3, 5, 5))
    precision, mean = roots @ roots.swapaxes(1, 2) + np.eye(5), rng.standard_normal((3, 5))
    low, high = np.array([-np.inf, 0.0, 0.0, -0.5, 0.0]), np.array([np.inf, 1.0, 1.0, 0.5, 2.0])
    masses = log_box_masses(mean, precision, low, high, rng.random((5, 20_000)))
    got = logsumexp(masses, axis=1) - np.log(20_000)
    for each, centre, inverse in zip(got, mean, precision, strict=True):
        exact = multivariate_normal(centre, np.linalg.inv(inverse)).cdf(high, lower_limit=low)
        assert each == pytest.approx(np.log(exact), abs=0.02)
    alone = log_box_masses(mean[1:2], precision[1:2], low, high, np.full((5, 1), 0.5))
    both = log_box_masses(mean[:2], precision[:2], low, high, np.full((5, 1), 0.5))
    np.testing.assert_allclose(alone[0], both[1], rtol=1e-12)


def test_a_box_far_from_the_mean_keeps_its_digits() -> None:
    low, high = np.zeros(1), np.ones(1)
    mass = log_box_masses(np.array([[41.0]]), np.eye(1)[None], low, high, np.array([[0.5]]))
    # Mills: beyond z the mass is the density over z, but for one part in z squared.
    assert mass[0, 0] == pytest.approx(-0.5 * 40.0**2 - np.log(40.0 * np.sqrt(2.0 * np.pi)), abs=1e-3)
