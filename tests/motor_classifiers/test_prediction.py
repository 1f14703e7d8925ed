"""What a model says of a recording: the start on the model's time axis, limits of what it judges, and its opinions."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sklearn.base import BaseEstimator

from motor_classifiers import (
    PosteriorNetwork,
    Prediction,
    make_method,
    predict_recording,
    prediction,
    predictions,
)

# Reaches in: stand-ins for models answer in the types of real ones, with numbers chosen by hand.
from motor_classifiers.estimators.networks.posterior_network import SeverityEstimate
from motor_classifiers.prediction import UNDECIDED, aligned_case, model_based_diagnosis
from motor_classifiers.wrappers.outlier_detector import OUTSIDE
from motor_datasets import generate_arrays
from motor_env import Channel, FaultKind, Recipe, Recording, Timing, draw, load_recipe, simulate_states
from motor_env.common.console import ExitStatus
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.inference.class_model import FEATURE_NAMES
from motor_env.motor.faults import SENSOR_KINDS, apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recovery

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
LOUD = replace(RECIPE, classes=(*RECIPE.classes, FaultClass(FaultKind.NOISE, 0.5)))
Started = Callable[..., list[FloatArray]]


def recording(rate_hz: float, n_samples: int, **more: Any) -> Recording:
    """A current that rises by 1 A a second."""
    time_s = np.arange(n_samples) / rate_hz
    return Recording(Path("made.csv"), time_s, time_s.copy(), **more)


LONG = recording(10_000.0, 2000)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Started:
    """Say where the start is, and how far each shift is off; the list holds the cases that were tried."""

    def say(onset: int = 500, *, best: int = 60, misfit: float = 1.0, **more: Any) -> list[FloatArray]:
        tried: list[FloatArray] = []

        def features(recipe: Recipe, cases: FloatArray) -> FloatArray:
            tried.append(cases)
            table = np.full((len(cases), len(FEATURE_NAMES)), 1e6)
            table[:, FEATURE_NAMES.index("reduced_chi2")] = misfit + 0.1 * abs(np.arange(len(cases)) - best)
            return table

        def align(given: Recording) -> Any:
            plain = {
                "onset_index": onset,
                "onset_s": float(given.time_s[onset]),
                "sign": 1.0,
                "offset_a": 0.0,
            }
            return SimpleNamespace(**plain | more)

        monkeypatch.setattr(prediction, "physical_features", features)
        monkeypatch.setattr(prediction, "align", align)
        return tried

    return say


def test_a_faster_recording_is_read_between_its_samples(started: Started) -> None:
    """121 shifts from -3 to 3 of the model's samples; the best one is kept, turned round and without its offset."""
    tried = started(500, best=74, sign=-1.0, offset_a=0.25)
    got = aligned_case(LONG, RECIPE)
    at = 0.05 + 1e-3 * 0.05 * np.arange(-60, 61)[:, None] + RECIPE.timing.time_s
    np.testing.assert_allclose(tried[0], -(at - 0.25)[:, None], atol=1e-12)
    np.testing.assert_allclose(got, -(at[74] - 0.25)[None, None], atol=1e-12)
    both = replace(RECIPE, sensor=replace(RECIPE.sensor, channels=(Channel.SPEED, Channel.CURRENT)))
    started(500, best=60, sign=-1.0, offset_a=0.25)
    case = aligned_case(replace(LONG, speed_rad_s=10.0 * LONG.time_s), both)[0]
    np.testing.assert_allclose(case, [-10.0 * at[60], -(at[60] - 0.25)], atol=1e-12)


@pytest.mark.parametrize(("recipe", "noisiest"), [(RECIPE, 1.0), (LOUD, 1.5)])
def test_a_misfit_of_more_than_five_deviations_is_another_motor(
    recipe: Recipe, noisiest: float, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    largest = noisiest * (1.0 + 5.0 * np.sqrt(2.0 / 100))
    monkeypatch.setattr(prediction, "_noise_level", lambda *_: 4.0)
    for noise_range, level in ((None, 1.0), ((0.5, 5.0), 4.0)):
        started(misfit=0.999 * level * largest)
        aligned_case(LONG, recipe, noise_range)
        started(misfit=1.001 * level * largest)
        with pytest.raises(
            UnusableError, match=rf"squared residual is {1.001 * largest:.3g} times the noise's"
        ):
            aligned_case(LONG, recipe, noise_range)


@pytest.mark.parametrize(("height", "level"), [(1.5, 2.0 * 1.5**2), (0.2, 0.25), (9.0, 25.0)])
def test_the_noise_is_read_off_neighbours_in_the_second_half(height: float, level: float) -> None:
    """Steps of 2 a between samples: by von Neumann (1941) a variance of 2 a^2, here in units of (20 mA)^2."""
    case = np.full((1, 100), 7.0)  # the first half does not count, nor does a level
    case[0, 50:] = 3.0 + 0.02 * height * (-1.0) ** np.arange(50)
    assert prediction._noise_level(case, RECIPE, (0.5, 5.0)) == pytest.approx(level)


def supplied(*parts: tuple[float, int]) -> Recording:
    levels, counts = zip(*parts, strict=True)
    return replace(LONG, voltage_v=np.repeat(np.array(levels), np.array(counts)))


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (recording(4_000.0, 800), ""),
        (recording(3_900.0, 800), "sampled at 3900 Hz"),
        (recording(10_000.0, 1497), ""),  # 99.6 ms after the start: half a sample may be missing
        (recording(10_000.0, 1495), "0.0994 s after the start"),
        (supplied((12.594, 2000)), ""),
        (supplied((-11.406, 2000)), ""),
        (supplied((12.604, 2000)), "the supply is at 12.6 V, the model was"),
        (supplied((11.396, 2000)), "the supply is at 11.4 V, the model was"),
        (supplied((0.0, 501), (12.0, 1499)), ""),
        (supplied((12.0, 501), (9.0, 1499)), "the supply is at 9 V"),
    ],
)
def test_what_cannot_be_compared_says_why(given: Recording, reason: str, started: Started) -> None:
    started(500 if given.dt_s < 2e-4 else 200)
    if reason:
        with pytest.raises(UnusableError, match=reason):
            aligned_case(given, RECIPE)
    else:
        assert aligned_case(given, RECIPE).shape == (1, 1, 100)
    both = replace(RECIPE, sensor=replace(RECIPE.sensor, channels=(Channel.CURRENT, Channel.SPEED)))
    with pytest.raises(UnusableError, match="needs the speed, which was not recorded"):
        aligned_case(given, both)


BENCH, N_STARTS, FINE = load_recipe("bench"), 10, 10


@pytest.fixture(scope="module")
def model() -> BaseEstimator:
    training = generate_arrays(BENCH, 3, 1400)
    return make_method("residual-qda", BENCH, 0).fit(training.X, training.class_name)


def start(n: int, position: float, *, with_voltage: bool) -> tuple[Recording, str]:
    """A start whose supply steps `position` of a sample after a sample, and its class."""
    drawn, dt_s = draw(BENCH, 77, np.arange(N_STARTS)), BENCH.timing.dt_s
    fault_class = BENCH.classes[int(drawn.class_index[n])]
    voltage = np.zeros(2300 * FINE)
    voltage[1000 * FINE + round(position * FINE) :] = np.asarray(drawn.scenario.supply.voltage_v)[n]
    motor = apply_faults(drawn.scenario.parameters.motor(n), fault_class.faults)
    current = simulate_states(motor, voltage, dt_s / FINE)[FINE - 1 :: FINE, 0]
    noise = np.random.default_rng(n).standard_normal((2, len(current)))
    seen = voltage[FINE - 1 :: FINE] + 0.02 * noise[1] if with_voltage else None
    current += BENCH.sensor.current_noise_a * noise[0]
    time_s: FloatArray = dt_s * np.arange(float(len(current)))
    return Recording(Path("a.csv"), time_s, current, seen), fault_class.name


@pytest.mark.parametrize(
    ("position", "with_voltage"), [(0.0, False), (0.2, False), (0.5, False), (0.8, False), (0.2, True)]
)
def test_the_step_may_fall_between_samples(position: float, with_voltage: bool, model: BaseEstimator) -> None:
    """Without the shift onto a sample three quarters are wrong at 0.2 and all are refused at 0.5 (docs/limits.md)."""
    made = [start(n, position, with_voltage=with_voltage) for n in range(N_STARTS)]
    found = [predict_recording(model, BENCH, given) for given, _ in made]
    assert UNDECIDED not in {opinion.verdict for opinion in found}
    assert (
        np.mean([opinion.class_name == name for opinion, (_, name) in zip(found, made, strict=True)]) >= 0.7
    )


@pytest.mark.parametrize(("quiet", "length", "fits"), [(21, 119, True), (22, 119, False), (21, 120, False)])
def test_at_equal_rates_the_residual_is_put_on_the_fitted_start(
    quiet: int, length: int, fits: bool, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit's onset is nearest to sample 20 of 140; the model's first sample after the step is sample 21."""
    fit = SimpleNamespace(
        start=SimpleNamespace(time_s=np.arange(140) * 1e-3, level_v=11.5, speed_rad_s=None), onset_s=0.0203,
        parameters=RECIPE.motor, residual_a=np.arange(140.0),
    )  # fmt: skip
    monkeypatch.setattr(prediction, "prepare", lambda given, level_v: level_v)
    monkeypatch.setattr(prediction, "replace", lambda level_v, voltage_v: (level_v, voltage_v))
    # A measured voltage would pin the onset to its samples.
    monkeypatch.setattr(prediction, "identify", {(12.0, None): fit}.__getitem__)
    monkeypatch.setattr(prediction, "_check_comparable", lambda *_: None)
    recipe = replace(RECIPE, timing=Timing(1_000.0, 1e-3 * length, 1e-3 * quiet + 1e-9))
    started(20, best=0)
    if fits:
        voltage = np.where(np.arange(length + quiet) < quiet, 0.0, 11.5)
        expected = simulate_states(RECIPE.motor, voltage, 1e-3)[:, 0] + np.arange(21 - quiet, 21 + length)
        np.testing.assert_allclose(aligned_case(recording(1_000.0, 140), recipe)[0, 0], expected)
        return
    with pytest.raises(UnusableError, match=f"{recipe.timing.quiet_s:g} s before the start and"):
        aligned_case(recording(1_000.0, 140), recipe)


class Told(BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Gives the probabilities that stand in its cases."""

    classes_ = np.array(sorted(RECIPE.class_names))
    n_features_in_ = 100

    def predict_proba(self, X: Any) -> FloatArray:
        return np.asarray(X, dtype=np.float64).reshape(len(X), 5)


# In the order of Told: bearing_10, bearing_25, healthy, winding_contact_10, winding_contact_25.
GIVEN = np.array(
    [
        [0.25, 0.375, 0.25, 0.125, 0.0],
        [0.125, 0.0625, 0.5, 0.25, 0.0625],
        [0.0, 0.0, 0.25, 0.25, 0.5],
        [0.1875, 0.25, 0.24, 0.1825, 0.14],
    ]
)


def test_an_opinion_adds_up_the_classes_of_its_verdict() -> None:
    opinions = predictions(Told(), RECIPE, GIVEN)
    assert [(one.verdict, one.probability) for one in opinions[:3]] == [
        ("bearing", 0.625), ("healthy", 0.5), ("winding", 0.75),
    ]  # fmt: skip
    severities = [(0.25 * 0.10 + 0.375 * 0.25) / 0.625, 0.0, (0.25 * 0.10 + 0.5 * 0.25) / 0.75]
    assert [one.severity for one in opinions[:3]] == pytest.approx(severities)
    assert opinions[0].probabilities == {
        "healthy": 0.25, "bearing_10": 0.25, "bearing_25": 0.375, "winding_contact_10": 0.125,
        "winding_contact_25": 0.0,
    }  # fmt: skip
    # Half is enough to be decided; less is not.
    fault, undecided = ExitStatus.FAULT, ExitStatus.UNDECIDED
    assert [one.status for one in opinions] == [fault, ExitStatus.HEALTHY, fault, undecided]
    told = opinions[0].as_json()
    assert (told["class"], told["undecided"], told["reason"]) == ("bearing_25", False, None)
    intervals = [
        one.as_json()["severity_interval"] for one in (opinions[0], Prediction("x", severity_interval=(1, 2)))
    ]
    assert intervals == [None, [1, 2]]


@pytest.mark.parametrize("off", ["", "warmth"])
def test_a_start_of_another_world_has_no_verdict(off: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def detector(recipe: Recipe, noise_range: Any) -> Any:
        asked.append((recipe, noise_range))
        return SimpleNamespace(likely_shift=lambda case: np.array([off] * len(case), dtype=object))

    monkeypatch.setattr(prediction, "aligned_case", lambda *_: GIVEN[:1])
    monkeypatch.setattr(prediction, "_detector", detector)
    got, inside = predict_recording(Told(), RECIPE, LONG), predictions(Told(), RECIPE, GIVEN[:1])[0]
    if off:
        assert (got.verdict, got.status, got.probability) == (OUTSIDE, ExitStatus.UNDECIDED, 0.0)
        assert got.reason.startswith("most likely warmth: winding and magnets")
        assert got.probabilities == inside.probabilities
    else:
        assert got == inside
    # A fault of the sensor itself, or one that recovers, has no detector: the opinion stands.
    loose = FaultClass(RECIPE.kinds[0], 0.123, recovery=Recovery(0.01, 0.01))
    for without in (FaultClass(min(SENSOR_KINDS), 0.2), loose):
        changed = replace(RECIPE, classes=(*RECIPE.classes, without))
        assert predict_recording(Told(), changed, LONG).verdict == inside.verdict
    assert asked == [(RECIPE, None)]


class Network(PosteriorNetwork):
    """Made probabilities, and severities that tell their kind."""

    def __init__(self) -> None:
        super().__init__(RECIPE, noise_range=(0.25, 4.0))
        self.classes_, self.n_features_in_ = Told.classes_, 100
        self.severity_: Any = object()

    def predict_proba(self, X: Any) -> FloatArray:
        return Told().predict_proba(X)

    def predict_severity(self, X: Any, kind: str | None = None, coverage: float = 0.9) -> SeverityEstimate:
        at = np.arange(len(X)) / 16.0 + {"bearing": 1.0, "winding_contact": 2.0}[str(kind)]
        return SeverityEstimate(np.full(len(X), kind), at, at - 0.5, at + 0.25)


def test_a_network_tells_the_severity_of_the_most_probable_kind() -> None:
    got = predictions(Network(), RECIPE, GIVEN)
    assert [one.severity for one in got] == [1.0, 0.0, 2.125, 1.1875]
    assert [one.severity_interval for one in got] == [(0.5, 1.25), None, (1.625, 2.375), (0.6875, 1.4375)]


def test_what_is_unusable_has_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def refuse(given: Recording, recipe: Recipe, noise_range: Any) -> FloatArray:
        asked.append(noise_range)
        raise UnusableError("too short")

    monkeypatch.setattr(prediction, "aligned_case", refuse)
    for model in (Network(), Told()):
        assert predict_recording(model, RECIPE, LONG) == Prediction(UNDECIDED, reason="too short")
    assert asked == [(0.25, 4.0), None]
    several = Told()
    several.n_features_in_ = 300
    got = predict_recording(several, RECIPE, LONG)
    assert (got.verdict, got.status) == (UNDECIDED, ExitStatus.UNDECIDED)
    assert "2 healthy starts of the same motor" in got.reason


def test_the_diagnosis_beside_it_has_the_recipes_tolerances(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    kept = {"verdict": "bearing", "kind": "bearing", "severity": 0.2, "severity_interval": [0.1, 0.3]}
    kept |= {"confidence": 0.9, "reasons": ["r"]}
    monkeypatch.setattr(prediction, "diagnose", lambda _, motor: asked.append(motor))
    monkeypatch.setattr(prediction, "as_json", lambda _: kept | {"left": "out"})
    assert model_based_diagnosis(LONG, RECIPE) == kept
    (motor,) = asked
    assert (motor.parameters, motor.nominal_voltage_v) == (RECIPE.motor, 12.0)
    tolerance = motor.tolerance
    assert (tolerance.supply, tolerance.resistance, tolerance.friction) == (0.01, 0.01, 0.02)
    assert tolerance.temperature_k == 0.0
