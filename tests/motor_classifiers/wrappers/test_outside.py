"""Starts that the recipe does not explain are refused, and the likely shift is named."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from motor_classifiers import OutsideDetector

# Reaches in: starts of other motors and surroundings than any recipe has by name.
from motor_classifiers.scoring.frozen_tasks import ForeignFault, foreign_starts
from motor_classifiers.wrappers.outlier_detector import ADVICE, GaussianMixture, StartDensity
from motor_datasets import generate_arrays
from motor_env import Timing, load_recipe
from motor_env.simulation.disturbances import Field
from motor_env.simulation.recipes import Recipe

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELD = replace(
    load_recipe("field", timing=Timing(1_000.0, 0.05, 0.01)), starts_per_motor=1, healthy_starts=0
)


@cache
def fitted(recipe: Recipe) -> OutsideDetector:
    return OutsideDetector(recipe).fit()


def test_a_cloud_is_a_normal_distribution_of_whole_starts() -> None:
    """Differences of log densities, noise given, are those of the joint normal of all values."""
    rng = np.random.default_rng(4)
    directions = np.linalg.qr(rng.normal(size=(7, 3)))[0].T
    factor, mean = rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 3))
    covariance = factor @ factor.swapaxes(1, 2)
    noise, nominal = rng.uniform(0.5, 2.0, 7), rng.normal(size=7)
    mixture = GaussianMixture(np.log([0.3, 0.7]), mean, covariance, np.array([1.0, 1.5]))
    density = StartDensity(BENCH, nominal, noise, directions, mixture, mixture, {})
    X = nominal + noise * rng.normal(size=(5, 7))
    level = 2.0
    joint = [
        weight
        * multivariate_normal(
            nominal + noise * (centre @ directions),
            np.outer(noise, noise) * (directions.T @ spread @ directions + level * own * np.eye(7)),
        ).pdf(X)
        for weight, centre, spread, own in zip([0.3, 0.7], mean, covariance, mixture.noise, strict=True)
    ]
    got = mixture.log_density(density.coordinates(X), density.freedom, (level, level))
    np.testing.assert_allclose(np.diff(got), np.diff(np.log(np.sum(joint, axis=0))), rtol=1e-9)


@pytest.mark.parametrize("recipe", [BENCH, FIELD], ids=lambda recipe: recipe.name)
def test_one_in_a_hundred_of_its_own_starts_is_refused(recipe: Recipe) -> None:
    detector = fitted(recipe)
    refused = detector.predict(generate_arrays(recipe, 91, 4_000).X) < 0
    # Threshold and count both scatter: four standard deviations of both.
    assert abs(refused.mean() - 0.01) < 4.0 * np.sqrt(0.01 * 0.99 * (1 / 4_000 + 1 / 10_000))


@pytest.mark.parametrize(
    ("off", "recipe", "moved"),
    [
        ("offset", BENCH, replace(BENCH, field=Field(sensor_offset_a=(0.05, 0.05)))),
        ("load", FIELD, FIELD.shifted("loaded")),
        ("noise", BENCH, replace(BENCH, sensor=BENCH.sensor.with_noise(2.0))),
        ("another motor", BENCH, None),
    ],
    ids=lambda part: part if isinstance(part, str) else "",
)
def test_the_likely_shift_is_named(off: str, recipe: Recipe, moved: Recipe | None) -> None:
    if moved is None:
        X = foreign_starts(recipe, ForeignFault("heavy", inertia=1.25), 6, np.arange(200))
    else:
        X = generate_arrays(moved, 6, 200).X
    named = fitted(recipe).likely_shift(X)
    assert (named == off).mean() > 0.7
    assert set(named.tolist()) <= {"", *ADVICE}


def test_half_of_the_hot_motors_are_refused() -> None:
    """A test trained for this very shift refuses four fifths (docs/trust-method.md)."""
    hot = BENCH.motor.scaled(
        resistance_ohm=1.0786, back_emf_constant_v_s_per_rad=0.98, torque_constant_n_m_per_a=0.98
    )
    detector = fitted(BENCH)
    assert (detector.predict(generate_arrays(replace(BENCH, motor=hot), 6, 1_000).X) < 0).mean() > 0.45
    hotter = FIELD.shifted("loaded")
    assert (fitted(FIELD).predict(generate_arrays(hotter, 6, 1_000).X) < 0).mean() > 0.7


def test_a_noise_that_is_read_off_is_not_refused_within_its_range() -> None:
    detector = OutsideDetector(BENCH, noise_range=(0.25, 4.0)).fit()
    refused = [
        (detector.predict(generate_arrays(replace(BENCH, sensor=BENCH.sensor.with_noise(k)), 5, 2_000).X) < 0)
        for k in (0.3, 1.0, 3.5, 8.0)
    ]
    assert max(each.mean() for each in refused[:3]) < 0.02
    assert refused[3].mean() > 0.99
    few = OutsideDetector(BENCH)
    assert OutsideDetector(BENCH, false_alarm_rate=0.2).fit().offset_ > few.fit().offset_
    X = generate_arrays(BENCH, 8, 500).X
    assert few.fit(X).offset_ == pytest.approx(np.quantile(few.score_samples(X), 0.01))
    with pytest.raises(ValueError, match="false_alarm_rate must be > 0 and < 1, got 1"):
        OutsideDetector(BENCH, 1.0).fit()
    with pytest.raises(ValueError, match="fit needs starts or a recipe"):
        OutsideDetector().fit()
