"""Hostile arguments of `motor_classifiers`: the right answer, or one sentence."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Cell, Row, complaint, public_names

import motor_classifiers as ours
from motor_datasets import generate_arrays
from motor_env import Channel, SensorParameters, Timing, load_recipe

BOTH = SensorParameters(channels=(Channel.CURRENT, Channel.SPEED))
RECIPE = replace(load_recipe("bench"), sensor=BOTH, timing=Timing(2000.0, 0.02))
TRAIN, TEST = generate_arrays(RECIPE, 1, 100), generate_arrays(RECIPE, 2, 3)
X = TEST.X.astype(np.float64)
SHARES, TRUTH = np.array([[0.5, 0.3, 0.2], [0.1, 0.6, 0.3], [0.2, 0.1, 0.7]]), np.array([0, 1, 2])
SETS = ours.ConformalSets.calibrate(SHARES, TRUTH, label_conditional=True)
RULE = ours.ThresholdConfirmationClassifier(RECIPE)
SMALL: dict[str, Any] = {"recipe": RECIPE, "epochs": 1, "batch_size": 50, "random_state": 0}
LAYERS: dict[str, Any] = {"recipe": RECIPE, "n_components": 4, "batch_size": 50, "n_hidden": 4, "n_layers": 1}
KINDS: dict[str, dict[str, Any]] = {
    "PhysicalFeatures": {"recipe": RECIPE},
    "ResidualProjection": {"recipe": RECIPE, "n_components": 4, "n_draws": 50},
    "RuleStatistics": {"recipe": RECIPE},
    "ThresholdConfirmationClassifier": {"recipe": RECIPE},
    "OutsideDetector": {"recipe": RECIPE},
    "PerceptronClassifier": LAYERS | {"epochs": 1, "random_state": 0},
    "ResNetClassifier": SMALL | {"width": 2},
    "TorchClassifier": SMALL,
    "PosteriorNetwork": LAYERS | {"steps": 2, "random_state": 0},
    "ConformalClassifier": {"estimator": RULE, "random_state": 0},
    "EarlyClassifier": {"estimator": RULE, "samples": (20, 40)},
}


def trained(kind: str, **parameters: Any) -> Any:
    return getattr(ours, kind)(**KINDS[kind] | parameters).fit(TRAIN.X, TRAIN.class_name)


@cache
def fitted(kind: str = "ThresholdConfirmationClassifier") -> Any:
    return trained(kind)


def says(model: Any, cases: Any) -> Any:
    return model.predict(cases) if hasattr(model, "predict") else model.transform(cases)


class Cases(Row):
    """A row without the cells of less than two axes, which scikit-learn refuses in its own words."""

    def cells(self) -> Iterator[Cell]:
        return (cell for cell in super().cells() if cell[0] not in ("0-d", "empty"))


def parameter(kind: str, name: str, good: Any, *allows: str, also: Any = ()) -> Row:
    return Row.of(kind, name, lambda value: says(trained(kind, **{name: value}), X), good, *allows, also=also)


def sets(argument: str, call: Callable[[Any], Any], good: Any, *allows: str, also: Any = ()) -> Row:
    return Row.of("ConformalSets", argument, call, good, *allows, also=also)


def calibrated(shares: Any, truth: Any) -> Any:
    return ours.ConformalSets.calibrate(shares, truth).sets(SHARES)


ROWS = [
    *(Cases.of(kind, "X", partial(says, fitted(kind)), X, "tiny", "large") for kind in KINDS),
    parameter("ResidualProjection", "n_components", 4, also=(0, -1)),
    parameter("ResidualProjection", "n_draws", 50, also=(0, -1)),
    parameter("PerceptronClassifier", "epochs", 1, also=(0, -1)),
    parameter("PerceptronClassifier", "batch_size", 50, also=(0, -1)),
    parameter("PerceptronClassifier", "n_hidden", 4, also=(0, -1)),
    parameter("PosteriorNetwork", "steps", 2, also=(0, -1)),
    parameter(
        "PosteriorNetwork", "noise_range", (1.0, 2.0), "None", also=((1.0,), (2.0, 1.0), (np.nan, 1.0))
    ),
    parameter("OutsideDetector", "noise_range", (1.0, 2.0), "None", also=((1.0,), (2.0, 1.0), (-1.0, 1.0))),
    parameter("OutsideDetector", "false_alarm_rate", 0.1, also=(0.0, 1.0)),
    parameter("ThresholdConfirmationClassifier", "false_alarm_rate", 0.2, "None", also=(0.0, 1.0)),
    parameter("ConformalClassifier", "coverage", 0.9, also=(0.0, 1.0)),
    parameter("ConformalClassifier", "calibration_share", 0.3, also=(0.0, 1.0)),
    parameter("EarlyClassifier", "error", 0.05, also=(0.0, 1.0)),
    parameter("EarlyClassifier", "samples", (20, 40), "None", also=((0,), (1.5,), (41,))),
    parameter("RuleStatistics", "recipe", RECIPE, "None", also=("bench",)),
    sets("probabilities", lambda v: calibrated(v, TRUTH), SHARES, "one short", also=(-SHARES,)),
    sets("probabilities", SETS.p_values, SHARES, also=(SHARES[:, :2],)),
    sets("truth", lambda v: calibrated(SHARES, v), TRUTH, also=([0, 1, 3],)),
    sets("coverage", lambda v: SETS.sets(SHARES, v), 0.9, also=(0.0, 1.0)),
    sets(
        "nonconformity",
        lambda v: ours.ConformalSets((v,)).sets(SHARES),
        SHARES[0, ::-1],
        "one short",
        also=([2, 1],),
    ),
    Row.of(
        "make_method", "name", lambda v: str(ours.make_method(v, RECIPE, 0)), "threshold", also=("no", ["a"])
    ),
    Row.of("make_method", "recipe", lambda v: str(ours.make_method("threshold", v, 0)), RECIPE),
    Row.of(
        "make_method", "random_state", lambda v: str(ours.make_method("network", RECIPE, v)), 1, also=(-1,)
    ),
    Row.of("predictions", "model", lambda v: ours.predictions(v, RECIPE, X), fitted()),
    Row.of("predictions", "recipe", lambda v: ours.predictions(fitted(), v, X), RECIPE),
    Row.of("predictions", "X", lambda v: ours.predictions(fitted(), RECIPE, v), X),
    Row.of(
        "evaluate_model",
        "test",
        lambda v: ours.evaluate_model(fitted(), RECIPE, v, 1)["n_test"],
        TEST,
        also=(X,),
    ),
    Row.of("load_task", "name", lambda v: ours.load_task(v).name, "bench", also=("no", ["a"])),
]


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_hostile_arguments_of_classifiers(row: Row) -> None:
    assert row.defects() == []


def test_other_axes_than_at_the_fit_are_refused_without_a_recipe() -> None:
    model = trained("ThresholdConfirmationClassifier", recipe=None)
    with pytest.raises(ValueError, match=r"X must have \(2, 40\) values a case as at the fit, got \(40, 2\)"):
        model.predict(X.swapaxes(1, 2))


CALLS: list[Callable[[Any], Any]] = [
    ours.load_model,
    ours.predict,
    lambda v: ours.predict_recording(fitted(), RECIPE, v),
    lambda v: ours.save_model(fitted(), RECIPE, "threshold", v),
    lambda v: ours.save_model(v, RECIPE, "threshold", "never"),
    lambda v: ours.export_onnx(v, RECIPE, Path("never")),
    lambda v: ours.evaluate_model(v, RECIPE, TEST, 1),
]


@pytest.mark.parametrize("nothing", [None, 3, b"x", ["a"]])
@pytest.mark.parametrize("call", CALLS)
def test_what_is_no_model_and_no_file_is_refused(call: Callable[[Any], Any], nothing: Any) -> None:
    with pytest.raises(TypeError, match="must be of type") as raised:
        call(nothing)
    assert complaint(raised.value) == ""
    assert not Path("never").exists()


def test_every_public_name_has_a_row() -> None:
    public = public_names(Path(ours.__file__).with_name("__init__.pyi"))
    functions = {"load_model", "predict", "predict_recording", "save_model", "export_onnx"}
    elsewhere = {"METHODS", "Prediction", "score_answers"}
    assert public == {row.name for row in ROWS} | functions | elsewhere
