"""Models on disk: the same probabilities after a round trip, wrapped or not, and by the commands."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from saved_models import QUICK, RECIPE, TEST, TRAIN, fitted
from sklearn.base import BaseEstimator
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.frozen import FrozenEstimator
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline

from motor_classifiers import (
    METHODS,
    ConformalClassifier,
    PosteriorNetwork,
    ResidualProjection,
    load_model,
    make_method,
    predictions,
    save_model,
)
from motor_classifiers.cli.main import main

# Reaches in: the step that centres starts on a motor's own has no public name, but stands in files.
from motor_classifiers.estimators.reference_starts import RecentredStarts, referenced_starts
from motor_classifiers.model_files import containers
from motor_classifiers.model_files.persistence import check_saveable
from motor_datasets import generate_arrays, generate_dataset, load
from motor_env import InputError, Recipe

UNSAVED = ("physical-svm", "physical-boosting", "physical-forest")
TWO = replace(RECIPE, classes=RECIPE.classes[:2])


def assert_comes_back(
    model: BaseEstimator, X: np.ndarray, path: Path, recipe: Recipe = RECIPE
) -> BaseEstimator:
    save_model(model, recipe, "a method", path)
    loaded, of, method = load_model(str(path))
    assert (of, method) == (recipe, "a method")
    np.testing.assert_array_equal(loaded.predict_proba(X), model.predict_proba(X))
    np.testing.assert_array_equal(loaded.predict(X), model.predict(X))
    return loaded


@pytest.mark.parametrize("name", [name for name in METHODS if name not in UNSAVED])
def test_a_method_comes_back(name: str, tmp_path: Path) -> None:
    assert_comes_back(fitted(name), TEST.X, tmp_path / "model")


@pytest.mark.parametrize("name", ["residual-qda", "physical-logistic", "rules", *QUICK])
def test_models_of_two_classes_come_back(name: str, tmp_path: Path) -> None:
    """Their parts are of other types than those of more classes."""
    train, model = generate_arrays(TWO, 1, 100), make_method(name, TWO, 0).set_params(**QUICK.get(name, {}))
    assert_comes_back(model.fit(train.X, train.class_name), TEST.X, tmp_path / "model", TWO)


@pytest.mark.parametrize("name", UNSAVED)
def test_methods_of_compiled_steps_are_refused_before_the_training(name: str) -> None:
    with pytest.raises(InputError, match="cannot be saved: a file may hold FeatureUnion, GaussianNB"):
        check_saveable(make_method(name, RECIPE, 0))


def test_models_with_reference_starts_come_back(tmp_path: Path) -> None:
    train, test = (referenced_starts(RECIPE, seed, np.arange(150), 2) for seed in (1, 2))
    for model in (
        make_pipeline(RecentredStarts(RECIPE), ResidualProjection(RECIPE, 6), LinearDiscriminantAnalysis()),
        PosteriorNetwork(RECIPE, n_references=2, steps=5, batch_size=32, random_state=0),
    ):
        assert_comes_back(model.fit(train.X, train.class_name), test.X, tmp_path / type(model).__name__)


def test_two_wrappers_come_back_and_three_do_not(tmp_path: Path) -> None:
    model: BaseEstimator = GaussianNB().fit(TRAIN.X[:, 0], TRAIN.class_name)
    for depth in range(3):
        assert_comes_back(model, TRAIN.X[:, 0], tmp_path / str(depth))
        model = ConformalClassifier(FrozenEstimator(model)).fit(TRAIN.X[:, 0], TRAIN.class_name)
    save_model(model, RECIPE, "nested", tmp_path / "3")
    with pytest.raises(InputError, match="too many classifiers are nested in it"):
        load_model(tmp_path / "3")


def test_sets_come_back(tmp_path: Path) -> None:
    known = generate_arrays(RECIPE, 5, 300)
    sets = ConformalClassifier(FrozenEstimator(fitted("residual-qda"))).fit(known.X, known.class_name)
    loaded = assert_comes_back(sets, TEST.X, tmp_path / "model")
    np.testing.assert_array_equal(loaded.predict_set(TEST.X), sets.predict_set(TEST.X))
    told = [json.loads(json.dumps(opinion.as_json())) for opinion in predictions(loaded, RECIPE, TEST.X)]
    assert [len(each["candidates"]) for each in told] == sets.predict_set(TEST.X).sum(axis=1).tolist()


def test_a_digest_is_that_of_head_names_types_shapes_and_bytes() -> None:
    """Files of all versions carry it."""
    arrays = {"b": np.array([[1.0, 2.0]]), "a": np.array([3], dtype=np.int64)}
    content = b"{}\na <i8 (1,)\n" + arrays["a"].tobytes() + b"\nb <f8 (1, 2)\n" + arrays["b"].tobytes()
    assert containers.digest("{}", arrays) == hashlib.sha256(content).hexdigest()


def test_train_evaluate_predict_and_no_overwriting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, model = tmp_path / "bench", tmp_path / "qda.model"
    generate_dataset(RECIPE, 500, 4, data)
    assert main(["train", str(data), "--out", str(model), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"method": "residual-qda", "n_train": len(load(data, "train")), "out": str(model)}
    before = model.read_bytes()
    assert main(["train", str(data), "--out", str(model)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert model.read_bytes() == before

    test = load(data, "test")
    counts, names = np.zeros((5, 5), dtype=int), list(RECIPE.class_names)
    for true, decided in zip(test.class_name, load_model(model)[0].predict(test.X), strict=True):
        counts[names.index(true), names.index(decided)] += 1
    assert main(["evaluate", str(model), str(data)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()[-5:]]
    assert [line[1:] for line in lines] == [
        [name, *map(str, row)] for name, row in zip(RECIPE.class_names, counts, strict=True)
    ]
    for place in (str(data), data.as_uri()):
        assert main(["evaluate", str(model), place, "--json"]) == 0
        scored = json.loads(capsys.readouterr().out)
        assert (scored["dataset"], scored["confusion"]) == (place, counts.tolist())
        assert scored["accuracy"] == pytest.approx(np.trace(counts) / len(test))
        assert 0.6 < scored["bayes_accuracy"] < 0.95

    missing = str(tmp_path / "missing.csv")
    options = ["--model", str(model), "--split", "test"]
    assert main(["predict", str(data), missing, *options, "--json"]) == 2
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == len(test) + 1
    assert rows[-1]["error"].startswith(missing)
    assert sum(rows[0]["probabilities"].values()) == pytest.approx(1.0)
    assert main(["predict", str(data), *options]) == 1
