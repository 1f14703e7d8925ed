"""Records of motors at work that a recipe does not explain are refused, and what is off in them is named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from motor_classifiers import OpenSetClassifier, OutsideDetector
from motor_classifiers.wrappers.outside import ADVICE
from motor_classifiers.wrappers.work_world import Prior, WorkCoordinates, WorkWorld
from motor_classifiers.wrappers.world import ANYWHERE, WIDER
from motor_datasets import generate_arrays
from motor_env import FaultKind, load_recipe
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

OPERATION = replace(load_recipe("operation"), starts_per_motor=1, healthy_starts=0)
assert OPERATION.field is not None
FIELD = OPERATION.field
WORLD = WorkWorld.from_recipe(OPERATION)
KNOWN = generate_arrays(OPERATION, 31, 200)


def flat(recipe: Recipe, seed: int, count: int) -> FloatArray:
    X = generate_arrays(recipe, seed, count).X
    return X.reshape(len(X), -1).astype(np.float64)


@pytest.fixture(scope="module")
def detector() -> OutsideDetector:
    return OutsideDetector(OPERATION).fit(KNOWN.X)


def test_evidence_of_a_linear_motor_is_the_normal_density_of_the_record() -> None:
    rng = np.random.default_rng(2)
    n_values, size = len(WORLD.model.noise), len(WORLD.known)
    at = WORLD.coordinates(flat(OPERATION, 5, 2))
    # A motor that is linear exactly: readings are slopes times coordinates, in units of the noise.
    slopes, left = rng.normal(size=(2, size, n_values)), rng.normal(size=(2, n_values))
    linear = at._replace(
        information=slopes @ slopes.swapaxes(1, 2),
        pull=np.einsum("njk,nk->nj", slopes, left),
        energy=np.square(left).sum(axis=1),
    )
    prior = Prior(np.log([0.3, 0.7]), rng.normal(size=(2, size)), rng.uniform(0.1, 2.0, (2, size)))
    level = 1.7
    joint = [
        np.log(
            sum(
                weight
                * np.exp(
                    multivariate_normal(
                        (mean - linear.values[n]) @ slopes[n],
                        slopes[n].T @ (variance[:, None] * slopes[n]) + level * np.eye(n_values),
                    ).logpdf(left[n])
                    + 1_000.0
                )
                for weight, mean, variance in zip([0.3, 0.7], prior.mean, prior.variance, strict=True)
            )
        )
        for n in range(2)
    ]
    got = WORLD._evidence(prior, linear, (level, level))
    assert np.diff(got) == pytest.approx(np.diff(joint), rel=1e-6)


def test_noise_may_be_as_loud_as_it_is_and_nothing_else_is_off_where_the_recipe_has_its_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[Prior, tuple[float, float]]] = []

    def evidence(_: WorkWorld, prior: Prior, at: WorkCoordinates, levels: tuple[float, float]) -> FloatArray:
        asked.append((prior, levels))
        return np.full(len(at.energy), -float(len(asked)))

    monkeypatch.setattr(WorkWorld, "_evidence", evidence)
    at = WORLD.coordinates(flat(OPERATION, 5, 2))
    assert WORLD.off(at, (0.5, 2.0)).tolist() == ["noise"] * 2
    (prior, levels), *others = asked
    assert prior is WORLD.own
    assert levels == (0.5, np.inf)
    assert [prior for prior, _ in others] == [*WORLD.departures.values()]
    assert {levels for _, levels in others} == {(0.5, 2.0)}
    asked.clear()
    assert WORLD.distance(at, (0.5, 2.0)).tolist() == [1.0, 1.0]
    assert asked == [(WORLD.anything, (0.5, np.inf)), (WORLD.own, (0.5, 2.0))]


def test_the_recipe_and_its_departures() -> None:
    names = list(WORLD.model.names)
    assert set(WORLD.departures) == {"offset", "gain", "warmth", "load", "severity", "another motor"}
    assert set(WORLD.departures) | {"noise"} <= set(ADVICE)
    # Its own motors have neither offset nor gain; healthy, and bearings of 10 and 25 % in a range up to 50 %.
    assert [name for name, known in zip(names, WORLD.known, strict=True) if not known] == [
        "sensor_gain",
        "sensor_offset_a",
    ]
    np.testing.assert_allclose(WORLD.own.mean[:3, names.index("bearing")], [0.0, 0.2, 0.5])
    extra = {name: prior.variance[0] - WORLD.own.variance[0] for name, prior in WORLD.departures.items()}
    low, high = OPERATION.priors["temperature_rise_k"]
    expected = np.zeros(len(names))
    expected[names.index("temperature_rise_k")] = (20.0 / (high - low)) ** 2
    np.testing.assert_allclose(extra["warmth"], expected, atol=1e-12)
    # Any motor: the mixture of the classes, with its variance widened, anywhere in all departures together.
    chances, own = OPERATION.class_probabilities, WORLD.own
    middle = chances @ own.mean
    mixture = chances @ (own.variance + own.mean**2) - middle**2
    np.testing.assert_allclose(WORLD.anything.mean[0], middle)
    np.testing.assert_allclose(
        WORLD.anything.variance[0], WIDER * mixture + ANYWHERE * np.sum([*extra.values()], axis=0)
    )
    # A tenth of each parameter, in standard deviations of its tolerance; none where there is no tolerance.
    np.testing.assert_allclose(extra["another motor"][:5], np.square([10.0, 10.0, 10.0, 5.0, 5.0]))
    sharp = replace(OPERATION, spread=replace(OPERATION.spread, inertia=0.0))
    other = WorkWorld.from_recipe(sharp)
    assert (other.departures["another motor"].variance - other.own.variance)[0, 3] == 0.0


def test_offsets_that_a_recipe_has_are_no_departure_of_it() -> None:
    knows = WorkWorld.from_recipe(
        replace(OPERATION, field=replace(FIELD, sensor_offset_a=(-0.05, 0.05)), shifts=())
    )
    at = list(knows.model.names).index("sensor_offset_a")
    assert knows.known[at]
    assert knows.own.variance[0, at] == pytest.approx(1.0 / 12.0)


def test_one_in_a_hundred_of_its_own_records_is_refused(detector: OutsideDetector) -> None:
    refused = detector.predict(generate_arrays(OPERATION, 91, 200).X) < 0
    # Threshold and count both scatter: four standard deviations of both.
    assert abs(refused.mean() - 0.01) < 4.0 * np.sqrt(0.01 * 0.99 * 2.0 / 200)


@pytest.mark.parametrize(
    ("off", "changes", "refused", "right"),
    [
        ("noise", {"sensor": OPERATION.sensor.with_noise(2.0)}, 1.0, 0.95),
        ("offset", {"field": replace(FIELD, sensor_offset_a=(0.02, 0.02))}, 0.95, 0.9),
        ("gain", {"field": replace(FIELD, sensor_gain=(1.03, 1.03))}, 0.95, 0.6),
        ("load", {"field": replace(FIELD, load_ratio=(1.5, 2.0))}, 0.55, 0.5),
        ("another motor", {"classes": (FaultClass(FaultKind.WINDING_SHORT, 0.10),)}, 1.0, 0.9),
    ],
    ids=lambda part: part if isinstance(part, str) else "",
)
def test_what_is_off_is_named(
    detector: OutsideDetector, off: str, changes: dict[str, Any], refused: float, right: float
) -> None:
    named = detector.what_is_off(generate_arrays(replace(OPERATION, **changes), 6, 40).X)
    assert (named != "").mean() >= refused
    assert (named == off).mean() >= right
    assert set(named.tolist()) <= {"", *ADVICE}


def test_a_third_of_the_hot_motors_are_refused_and_called_warm(detector: OutsideDetector) -> None:
    """A test trained for this very shift refuses seven tenths (docs/trust.md)."""
    named = detector.what_is_off(generate_arrays(OPERATION.shifted("hotter"), 6, 100).X)
    assert (named != "").mean() > 0.25
    assert (named[named != ""] == "warmth").mean() > 0.6


def test_the_wrapper_judges_motors_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    from sklearn.dummy import DummyClassifier

    # Its threshold from a few records: only who is refused is asked here.
    monkeypatch.setattr("motor_classifiers.wrappers.work_world._CALIBRATION", 200)
    model = OpenSetClassifier(DummyClassifier(), OPERATION).fit(KNOWN.X[:50], KNOWN.class_name[:50])
    louder = generate_arrays(replace(OPERATION, sensor=OPERATION.sensor.with_noise(3.0)), 6, 5).X
    said = model.verdicts(louder)
    assert said.is_outside.all()
    assert (said.off == "noise").all()
