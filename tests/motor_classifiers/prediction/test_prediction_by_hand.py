"""Limits of what a model judges, and its opinions, on made starts and made probabilities."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sklearn.base import BaseEstimator

from motor_classifiers import (
    ConformalClassifier,
    ConformalSets,
    PosteriorNetwork,
    Prediction,
    predict_recording,
    prediction,
    predictions,
)

# Reaches in: stand-ins for models answer in the types of real ones, with numbers chosen by hand.
from motor_classifiers.estimators.networks.posterior_network import SeverityEstimate
from motor_classifiers.prediction import UNDECIDED, aligned_case, model_based_diagnosis
from motor_classifiers.wrappers.outlier_detector import OUTSIDE
from motor_env import Channel, FaultKind, Recipe, Recording, Timing, load_recipe, simulate_states
from motor_env.common.console import ExitStatus
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.inference.class_model import FEATURE_NAMES
from motor_env.motor.faults import SENSOR_KINDS
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recovery

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
LOUD = replace(RECIPE, classes=(*RECIPE.classes, FaultClass(FaultKind.NOISE, 0.5)))


def recording(rate_hz: float, n_samples: int, **more: Any) -> Recording:
    """A current that rises by 1 A a second."""
    time_s = np.arange(n_samples) / rate_hz
    return Recording(Path("made.csv"), time_s, more.pop("current_a", time_s.copy()), **more)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[FloatArray]]:
    """Say where the start is, and how far each shift is off; the list holds the cases that were tried."""

    def say(onset: int = 500, *, best: int = 60, misfit: float = 1.0, **more: Any) -> list[FloatArray]:
        tried: list[FloatArray] = []

        def features(recipe: Recipe, cases: FloatArray) -> FloatArray:
            tried.append(cases)
            table = np.full((len(cases), len(FEATURE_NAMES)), 1e6)
            table[:, FEATURE_NAMES.index("reduced_chi2")] = misfit + 0.1 * np.abs(
                np.arange(len(cases)) - best
            )
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


def test_a_faster_recording_is_read_between_its_samples(started: Callable[..., list[FloatArray]]) -> None:
    """121 shifts from -3 to 3 of the model's samples; the best one is kept, turned round and without its offset."""
    tried = started(500, best=74, sign=-1.0, offset_a=0.25)
    got = aligned_case(recording(10_000.0, 2000), RECIPE)
    shifts = np.arange(-60, 61) * 0.05
    at = 0.05 + 1e-3 * shifts[:, None] + RECIPE.timing.time_s
    np.testing.assert_allclose(tried[0], -(at - 0.25)[:, None], atol=1e-12)
    assert got.shape == (1, 1, 100)
    np.testing.assert_allclose(got[0, 0], -(at[74] - 0.25), atol=1e-12)
    both = replace(RECIPE, sensor=replace(RECIPE.sensor, channels=(Channel.SPEED, Channel.CURRENT)))
    started(500, best=60, sign=-1.0, offset_a=0.25)
    fast = recording(10_000.0, 2000)
    case = aligned_case(replace(fast, speed_rad_s=10.0 * fast.time_s), both)[0]
    np.testing.assert_allclose(case, [-10.0 * at[60], -(at[60] - 0.25)], atol=1e-12)


@pytest.mark.parametrize(("recipe", "noisiest"), [(RECIPE, 1.0), (LOUD, 1.5)])
def test_a_misfit_of_more_than_five_deviations_is_another_motor(
    recipe: Recipe, noisiest: float, started: Callable[..., list[FloatArray]], monkeypatch: pytest.MonkeyPatch
) -> None:
    largest = noisiest * (1.0 + 5.0 * np.sqrt(2.0 / 100))
    started(misfit=0.999 * largest)
    aligned_case(recording(10_000.0, 2000), recipe)
    started(misfit=1.001 * largest)
    with pytest.raises(
        UnusableError, match=rf"the squared residual is {1.001 * largest:.3g} times the noise's"
    ):
        aligned_case(recording(10_000.0, 2000), recipe)
    monkeypatch.setattr(prediction, "_noise_level", lambda *_: 4.0)
    started(misfit=3.996 * largest)
    aligned_case(recording(10_000.0, 2000), recipe, (0.5, 5.0))
    started(misfit=4.004 * largest)
    with pytest.raises(UnusableError, match=rf"the squared residual is {1.001 * largest:.3g} times"):
        aligned_case(recording(10_000.0, 2000), recipe, (0.5, 5.0))


def test_the_noise_is_read_off_neighbours_in_the_second_half() -> None:
    """Steps of 2 a between samples: by von Neumann (1941) a variance of 2 a^2, here in units of (20 mA)^2."""

    def level(height: float, noise_range: tuple[float, float]) -> float:
        case = np.zeros((1, 100))
        case[0, :50] = 7.0  # the first half does not count, nor does a level
        case[0, 50:] = 3.0 + 0.02 * height * (-1.0) ** np.arange(50)
        return prediction._noise_level(case, RECIPE, noise_range)  # what only a noisy start shows elsewhere

    assert level(1.5, (0.1, 5.0)) == pytest.approx(2.0 * 1.5**2)
    assert level(0.2, (0.5, 5.0)) == pytest.approx(0.25)
    assert level(9.0, (0.5, 5.0)) == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (lambda: recording(4_000.0, 800), None),
        (lambda: recording(3_900.0, 800), "sampled at 3900 Hz, the model needs 1000 Hz, or four times that"),
        (lambda: recording(10_000.0, 1497), None),  # 99.6 ms after the start: half a sample may be missing
        (lambda: recording(10_000.0, 1495), "0.0994 s after the start, the model needs 0.1 s"),
        (lambda: recording(10_000.0, 2000, voltage_v=np.full(2000, 12.594)), None),
        (lambda: recording(10_000.0, 2000, voltage_v=np.full(2000, -11.406)), None),
        (
            lambda: recording(10_000.0, 2000, voltage_v=np.full(2000, 12.604)),
            "the supply is at 12.6 V, the model was",
        ),
        (
            lambda: recording(10_000.0, 2000, voltage_v=np.full(2000, 11.396)),
            "the supply is at 11.4 V, the model was",
        ),
        (lambda: recording(10_000.0, 2000, voltage_v=np.repeat([0.0, 12.0], [501, 1499])), None),
        (
            lambda: recording(10_000.0, 2000, voltage_v=np.repeat([12.0, 9.0], [501, 1499])),
            "the supply is at 9 V",
        ),
    ],
)
def test_what_cannot_be_compared_says_why(
    made: Callable[[], Recording], reason: str | None, started: Callable[..., list[FloatArray]]
) -> None:
    given = made()
    started(500 if given.dt_s < 2e-4 else 200)
    if reason is None:
        assert aligned_case(given, RECIPE).shape == (1, 1, 100)
    else:
        with pytest.raises(UnusableError, match=reason):
            aligned_case(given, RECIPE)
    both = replace(RECIPE, sensor=replace(RECIPE.sensor, channels=(Channel.CURRENT, Channel.SPEED)))
    with pytest.raises(UnusableError, match="needs the speed, which was not recorded"):
        aligned_case(given, both)


@pytest.mark.parametrize(
    ("quiet", "length", "fits"), [(21, 100, True), (22, 100, False), (0, 120, False), (0, 119, True)]
)
def test_at_equal_rates_the_residual_is_put_on_the_fitted_start(
    quiet: int,
    length: int,
    fits: bool,
    started: Callable[..., list[FloatArray]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The fit's onset is nearest to sample 20 of 140; the model's first sample after the step is sample 21."""
    time_s = np.arange(140) * 1e-3
    fitted = SimpleNamespace(
        start=SimpleNamespace(time_s=time_s, level_v=11.5, speed_rad_s=None),
        onset_s=0.0203, parameters=RECIPE.motor, residual_a=np.arange(140.0),
    )  # fmt: skip
    asked: list[Any] = []
    prepared = SimpleNamespace()

    def noted(given: Any, *level: float, **changes: Any) -> Any:
        asked.extend([*level, *([changes] if changes else [])])
        return prepared

    monkeypatch.setattr(prediction, "prepare", noted)
    monkeypatch.setattr(prediction, "replace", noted)
    monkeypatch.setattr(prediction, "identify", lambda _: fitted)
    timing = Timing(1_000.0, 1e-3 * length, 1e-3 * quiet + 1e-9 if quiet else 0.0)
    recipe = replace(RECIPE, timing=timing)
    assert (timing.n_samples, timing.n_quiet) == (length + quiet, quiet)
    started(20, best=0)
    if not fits:
        monkeypatch.setattr(prediction, "_check_comparable", lambda *_: None)
        with pytest.raises(
            UnusableError, match=f"needs {timing.quiet_s:g} s before the start and {timing.duration_s:g} s"
        ):
            aligned_case(recording(1_000.0, 140), recipe)
        return
    got = aligned_case(recording(1_000.0, 140), recipe)
    assert asked == [12.0, {"voltage_v": None}]
    voltage = np.where(np.arange(length + quiet) < quiet, 0.0, 11.5)
    expected = simulate_states(RECIPE.motor, voltage, 1e-3)[:, 0] + np.arange(21 - quiet, 21 + length)
    np.testing.assert_allclose(got[0, 0], expected)


class Told(BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Gives the probabilities that stand in its cases."""

    classes_ = np.array(sorted(RECIPE.class_names))
    n_features_in_ = 100

    def predict_proba(self, X: Any) -> FloatArray:
        values: FloatArray = np.asarray(X, dtype=np.float64).reshape(len(X), 5)
        return values


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
    bearing, healthy, winding, unsure = predictions(Told(), RECIPE, GIVEN)
    assert (bearing.verdict, bearing.class_name, bearing.probability) == ("bearing", "bearing_25", 0.625)
    assert bearing.severity == pytest.approx((0.25 * 0.10 + 0.375 * 0.25) / 0.625)
    assert (healthy.verdict, healthy.probability, healthy.severity) == ("healthy", 0.5, 0.0)
    assert (winding.verdict, winding.probability) == ("winding", 0.75)
    assert winding.severity == pytest.approx((0.25 * 0.10 + 0.5 * 0.25) / 0.75)
    assert bearing.probabilities == {
        "healthy": 0.25, "bearing_10": 0.25, "bearing_25": 0.375, "winding_contact_10": 0.125,
        "winding_contact_25": 0.0,
    }  # fmt: skip
    # Half is enough to be decided; less is not.
    assert [one.status for one in (bearing, healthy, winding, unsure)] == [
        ExitStatus.FAULT, ExitStatus.HEALTHY, ExitStatus.FAULT, ExitStatus.UNDECIDED,
    ]  # fmt: skip
    told = bearing.as_json()
    assert (told["class"], told["undecided"], told["reason"], told["severity_interval"]) == (
        "bearing_25",
        False,
        None,
        None,
    )
    assert Prediction("bearing", severity_interval=(0.1, 0.2)).as_json()["severity_interval"] == [0.1, 0.2]


@pytest.mark.parametrize(("off", "words"), [("", ""), ("warmth", "most likely warmth: winding and magnets")])
def test_a_start_of_another_world_has_no_verdict(
    off: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def detector(recipe: Recipe, noise_range: Any) -> Any:
        asked.append((recipe, noise_range))
        return SimpleNamespace(likely_shift=lambda case: np.array([off] * len(case), dtype=object))

    monkeypatch.setattr(prediction, "aligned_case", lambda *_: GIVEN[:1])
    monkeypatch.setattr(prediction, "_detector", detector)
    got = predict_recording(Told(), RECIPE, recording(10_000.0, 20))
    inside = predictions(Told(), RECIPE, GIVEN[:1])[0]
    if off:
        assert (got.verdict, got.class_name, got.probability) == (OUTSIDE, "", 0.0)
        assert got.reason.startswith(words)
        assert (got.probabilities, got.status) == (inside.probabilities, ExitStatus.UNDECIDED)
    else:
        assert got == inside
    assert asked == [(RECIPE, None)]
    # A fault of the sensor itself, or one that recovers, has no detector: the opinion stands.
    loose = FaultClass(RECIPE.kinds[0], 0.123, recovery=Recovery(0.01, 0.01))
    for without in (FaultClass(min(SENSOR_KINDS), 0.2), loose):
        changed = replace(RECIPE, classes=(*RECIPE.classes, without))
        assert predict_recording(Told(), changed, recording(10_000.0, 20)).verdict == inside.verdict
    assert len(asked) == 1


def test_a_conformal_model_names_its_candidates() -> None:
    model = ConformalClassifier(Told(), 0.75)
    model._take_over(Told())
    model.n_features_in_ = 5
    model.sets_ = ConformalSets((np.array([0.5, 0.625, 0.75]),))
    # p > 1/4 where a strangeness of 0.75 or more was seen: classes with a probability of a quarter and more.
    assert [one.candidates for one in predictions(model, RECIPE, GIVEN)] == [
        tuple(name for name, share in zip(Told.classes_, row, strict=True) if share >= 0.25) for row in GIVEN
    ]


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


def test_a_network_tells_the_severity_of_the_most_probable_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    got = predictions(Network(), RECIPE, GIVEN)
    assert [one.severity for one in got] == [1.0, 0.0, 2.125, 1.1875]
    assert [one.severity_interval for one in got] == [(0.5, 1.25), None, (1.625, 2.375), (0.6875, 1.4375)]
    asked: list[Any] = []

    def refuse(given: Recording, recipe: Recipe, noise_range: Any) -> FloatArray:
        asked.append(noise_range)
        raise UnusableError("too short")

    monkeypatch.setattr(prediction, "aligned_case", refuse)
    for model in (Network(), Told()):
        assert predict_recording(model, RECIPE, recording(10_000.0, 20)) == Prediction(
            UNDECIDED, reason="too short"
        )
    assert asked == [(0.25, 4.0), None]


def test_a_model_with_references_cannot_judge_a_recording_alone() -> None:
    class Several(Told):
        n_features_in_ = 300

    got = predict_recording(Several(), RECIPE, recording(10_000.0, 2000))
    assert (got.verdict, got.reason) == (
        UNDECIDED,
        "the model needs 2 healthy starts of the same motor beside each",
    )
    assert got.status is ExitStatus.UNDECIDED


def test_the_diagnosis_beside_it_has_the_recipes_tolerances(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    kept = {"verdict": "bearing", "kind": "bearing", "severity": 0.2, "severity_interval": [0.1, 0.3]}
    more = {"confidence": 0.9, "reasons": ["r"], "left": "out"}
    monkeypatch.setattr(prediction, "diagnose", lambda _, motor: asked.append(motor))
    monkeypatch.setattr(prediction, "as_json", lambda _: kept | more)
    assert model_based_diagnosis(recording(1_000.0, 9), RECIPE) == kept | {
        "confidence": 0.9,
        "reasons": ["r"],
    }
    (motor,) = asked
    assert (motor.name, motor.parameters, motor.nominal_voltage_v) == (
        "of the recipe bench",
        RECIPE.motor,
        12.0,
    )
    tolerance = motor.tolerance
    assert (tolerance.supply, tolerance.resistance, tolerance.friction) == (0.01, 0.01, 0.02)
    assert tolerance.temperature_k == 0.0
