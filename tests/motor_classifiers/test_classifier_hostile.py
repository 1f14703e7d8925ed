"""Hostile arguments of `motor_classifiers`: the right answer, or one sentence."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Cell, Row, complaint, public_names

import motor_classifiers
from motor_classifiers import (
    ConformalClassifier,
    ConformalSets,
    EarlyClassifier,
    OutsideDetector,
    PerceptronClassifier,
    PhysicalFeatures,
    PosteriorNetwork,
    ResidualProjection,
    ResNetClassifier,
    RuleStatistics,
    ThresholdConfirmationClassifier,
    TorchClassifier,
    evaluate_model,
    export_onnx,
    load_model,
    load_task,
    make_method,
    predict,
    predict_recording,
    predictions,
    save_model,
)

# Reaches in: the names of the tasks.
from motor_classifiers.scoring.frozen_tasks import TASKS
from motor_datasets import generate_arrays
from motor_env import Channel, SensorParameters, Timing, load_recipe

BOTH = SensorParameters(channels=(Channel.CURRENT, Channel.SPEED))
RECIPE = replace(load_recipe("bench"), sensor=BOTH, timing=Timing(2000.0, 0.02))
TRAIN, TEST = generate_arrays(RECIPE, 1, 100), generate_arrays(RECIPE, 2, 3)
X = TEST.X.astype(np.float64)
NETWORKS: dict[str, Any] = {"random_state": 0, "n_hidden": 4, "n_layers": 1, "batch_size": 50}
SHARES, TRUTH = np.array([[0.5, 0.3, 0.2], [0.1, 0.6, 0.3], [0.2, 0.1, 0.7]]), np.array([0, 1, 2])
SETS = ConformalSets.calibrate(SHARES, TRUTH, label_conditional=True)

MAKE: dict[type, Callable[..., Any]] = {
    PhysicalFeatures: partial(PhysicalFeatures, RECIPE),
    ResidualProjection: partial(ResidualProjection, RECIPE, n_components=4, n_draws=50),
    RuleStatistics: partial(RuleStatistics, RECIPE),
    ThresholdConfirmationClassifier: partial(ThresholdConfirmationClassifier, RECIPE),
    OutsideDetector: partial(OutsideDetector, RECIPE),
    PerceptronClassifier: partial(PerceptronClassifier, RECIPE, 4, epochs=1, **NETWORKS),
    ResNetClassifier: partial(ResNetClassifier, RECIPE, 2, epochs=1, batch_size=50, random_state=0),
    TorchClassifier: partial(TorchClassifier, RECIPE, epochs=1, batch_size=50, random_state=0),
    PosteriorNetwork: partial(PosteriorNetwork, RECIPE, 4, steps=2, **NETWORKS),
    ConformalClassifier: partial(
        ConformalClassifier, ThresholdConfirmationClassifier(RECIPE), random_state=0
    ),
    EarlyClassifier: partial(EarlyClassifier, ThresholdConfirmationClassifier(RECIPE), samples=(20, 40)),
}


@cache
def fitted(kind: type) -> Any:
    return MAKE[kind]().fit(TRAIN.X, TRAIN.class_name)


def says(kind: type, cases: Any) -> Any:
    model = fitted(kind)
    return model.predict(cases) if hasattr(model, "predict") else model.transform(cases)


def trained(kind: type, name: str, value: Any) -> Any:
    made = MAKE[kind](**{name: value}).fit(TRAIN.X, TRAIN.class_name)
    return made.predict(X) if hasattr(made, "predict") else made.transform(X)


class Cases(Row):
    """A row without the cells of less than two axes, which scikit-learn refuses in its own words."""

    def cells(self) -> Iterator[Cell]:
        """As those of every row."""
        return (cell for cell in super().cells() if cell[0] not in ("0-d", "empty"))


ROWS = [
    *(Cases.of(kind.__name__, "X", partial(says, kind), X, "tiny", "large") for kind in MAKE),
    *(
        Row.of(kind.__name__, name, partial(trained, kind, name), good, *allows, also=also)
        for kind, name, good, allows, also in (
            (ResidualProjection, "n_components", 4, (), (0, -1)),
            (ResidualProjection, "n_draws", 50, (), (0, -1)),
            (PerceptronClassifier, "epochs", 1, (), (0, -1)),
            (PerceptronClassifier, "batch_size", 50, (), (0, -1)),
            (PerceptronClassifier, "n_hidden", 4, (), (0, -1)),
            (PosteriorNetwork, "steps", 2, (), (0, -1)),
            (PosteriorNetwork, "noise_range", (1.0, 2.0), ("None",), ((1.0,), (2.0, 1.0), (np.nan, 1.0))),
            (OutsideDetector, "noise_range", (1.0, 2.0), ("None",), ((1.0,), (2.0, 1.0), (-1.0, 1.0))),
            (OutsideDetector, "false_alarm_rate", 0.1, (), (0.0, 1.0)),
            (ThresholdConfirmationClassifier, "false_alarm_rate", 0.2, ("None",), (0.0, 1.0)),
            (ConformalClassifier, "coverage", 0.9, (), (0.0, 1.0)),
            (ConformalClassifier, "calibration_share", 0.3, (), (0.0, 1.0)),
            (EarlyClassifier, "error", 0.05, (), (0.0, 1.0)),
            (EarlyClassifier, "samples", (20, 40), ("None",), ((0,), (1.5,), (41,))),
        )
    ),
    Row.of(
        "RuleStatistics",
        "recipe",
        lambda v: RuleStatistics(v).fit(TRAIN.X).transform(X),
        RECIPE,
        "None",
        also=("bench",),
    ),
    Row.of(
        "ConformalSets",
        "probabilities",
        lambda v: ConformalSets.calibrate(v, TRUTH).sets(SHARES),
        SHARES,
        "one short",
        also=(-SHARES,),
    ),
    Row.of("ConformalSets", "probabilities", SETS.p_values, SHARES, also=(SHARES[:, :2],)),
    Row.of(
        "ConformalSets",
        "truth",
        lambda v: ConformalSets.calibrate(SHARES, v).sets(SHARES),
        TRUTH,
        also=([0, 1, 3],),
    ),
    Row.of("ConformalSets", "coverage", lambda v: SETS.sets(SHARES, v), 0.9, also=(0.0, 1.0)),
    Row.of(
        "ConformalSets",
        "nonconformity",
        lambda v: ConformalSets((v,)).sets(SHARES),
        np.array([0.1, 0.2, 0.3, 0.4]),
        "one short",
        also=([2.0, 1.0],),
    ),
    Row.of(
        "make_method", "name", lambda v: str(make_method(v, RECIPE, 0)), "threshold", also=("bogus", ["a"])
    ),
    Row.of("make_method", "recipe", lambda v: str(make_method("threshold", v, 0)), RECIPE),
    Row.of("make_method", "random_state", lambda v: str(make_method("network", RECIPE, v)), 1, also=(-1,)),
    Row.of(
        "predictions", "model", lambda v: predictions(v, RECIPE, X), fitted(ThresholdConfirmationClassifier)
    ),
    Row.of(
        "predictions", "recipe", lambda v: predictions(fitted(ThresholdConfirmationClassifier), v, X), RECIPE
    ),
    Row.of("predictions", "X", lambda v: predictions(fitted(ThresholdConfirmationClassifier), RECIPE, v), X),
    Row.of(
        "evaluate_model",
        "test",
        lambda v: evaluate_model(fitted(ThresholdConfirmationClassifier), RECIPE, v, 1)["n_test"],
        TEST,
        also=(X,),
    ),
    Row.of("load_task", "name", lambda v: load_task(v).name, next(iter(TASKS)), also=("bogus", ["a"])),
]


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_hostile_arguments_of_classifiers(row: Row) -> None:
    assert row.defects() == []


def test_other_axes_than_at_the_fit_are_refused_without_a_recipe() -> None:
    model = ThresholdConfirmationClassifier().fit(TRAIN.X, TRAIN.class_name)
    with pytest.raises(ValueError, match=r"X must have \(2, 40\) values a case as at the fit, got \(40, 2\)"):
        model.predict(X.swapaxes(1, 2))


@pytest.mark.parametrize(
    "call",
    [
        load_model,
        predict,
        lambda v: predict_recording(fitted(ThresholdConfirmationClassifier), RECIPE, v),
        lambda v: save_model(fitted(ThresholdConfirmationClassifier), RECIPE, "threshold", v),
        lambda v: save_model(v, RECIPE, "threshold", "never"),
        lambda v: export_onnx(v, RECIPE, Path("never")),
        lambda v: evaluate_model(v, RECIPE, TEST, 1),
    ],
)
def test_what_is_no_model_and_no_file_is_refused(call: Callable[[Any], Any]) -> None:
    for nothing in (None, 3, b"x", ["a"]):
        with pytest.raises(TypeError, match="must be of type") as raised:
            call(nothing)
        assert complaint(raised.value) == ""
    assert not Path("never").exists()


def test_every_public_name_has_a_row() -> None:
    public = public_names(Path(motor_classifiers.__file__).with_name("__init__.pyi"))
    functions = {"load_model", "predict", "predict_recording", "save_model", "export_onnx"}
    elsewhere = {"METHODS", "Prediction", "score_answers"}
    assert public == {row.name for row in ROWS} | functions | elsewhere
