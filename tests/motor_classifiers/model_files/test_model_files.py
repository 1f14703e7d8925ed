"""Damaged and forged model files: refused with one sentence at loading, never a surprise at predicting."""

import json
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skops.io
from hostile import archive_of, cuts, flips, members_of, refused, refused_or_same
from saved_models import RECIPE, TRAIN, content, fitted, head_of, with_changes, with_head
from sklearn.base import BaseEstimator
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC
from sklearn.tree import DecisionTreeClassifier

from motor_classifiers import (
    ConformalClassifier,
    load_model,
    predictions,
    save_model,
)
from motor_classifiers.cli.main import main
from motor_classifiers.model_files.persistence import FORMAT
from motor_datasets import generate_arrays, generate_dataset

CALLING = Pipeline([("call", FunctionTransformer(os.getcwd))])
TENSORS = ("threshold", "network", "posterior-network", "residual-network")


def refusal(file: bytes, folder: Path) -> str:
    """The sentence with which a file is refused."""
    path = folder / "forged.model"
    path.write_bytes(file)
    sentence = refused(lambda: load_model(path), path)
    assert sentence.startswith(f"{path}: ")
    return sentence


@pytest.mark.parametrize("name", [*TENSORS, "residual-qda"])
def test_any_cut_is_refused(name: str, tmp_path: Path) -> None:
    for file in cuts(content(name), 12):
        refusal(file, tmp_path)


@pytest.mark.parametrize("name", [*TENSORS, "residual-qda"])
def test_a_flipped_bit_is_refused_or_harmless(name: str, tmp_path: Path) -> None:
    """No other error than the sentence, at loading or at predicting."""
    path, file = tmp_path / "flipped.model", content(name)

    def same(found: tuple[Any, ...]) -> None:
        assert found[0].predict_proba(TRAIN.X[:2]).shape == (2, 5)

    for flipped in flips(file, np.random.default_rng(0), 25, within=range(min(len(file), 4000))):
        path.write_bytes(flipped)
        refused_or_same(lambda: load_model(path), path, same)


@pytest.mark.parametrize("name", TENSORS)
def test_a_flipped_bit_is_not_taken_for_a_weight(name: str, tmp_path: Path) -> None:
    file = content(name)
    begin = 8 + int.from_bytes(file[:8], "little")
    for flipped in flips(file, np.random.default_rng(1), 10, within=range(begin, len(file))):
        assert "not what was saved" in refusal(flipped, tmp_path)


def test_an_unchanged_head_loads(tmp_path: Path) -> None:
    (tmp_path / "same").write_bytes(with_changes(content("threshold"), {}))
    assert load_model(tmp_path / "same")[2] == "threshold"


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("threshold", {"rule": {"needed": "two"}}),
        ("threshold", {"rule": {"threshold": None}}),
        ("threshold", {"rule": {"with_spread": 3}}),
        ("threshold", {"rule": {"unheard_of": 1}}),
        ("threshold", {"false_alarm_rate": "rare"}),
        ("threshold", {"kind": "sculpture"}),
        ("threshold", {"method": ["threshold"]}),
        ("threshold", {"classes": "healthy"}),
        ("threshold", {"classes": [1, 2]}),
        ("threshold", {"classes": ["healthy", "stolen"]}),
        ("network", {"classes": ["bearing_10", "healthy"]}),
        ("network", {"parameters": {"n_hidden": "wide"}}),
        ("network", {"parameters": {"n_hidden": 10**9}}),
        ("network", {"parameters": {"n_layers": 10**9}}),
        ("network", {"parameters": {"unheard_of": 1}}),
        ("network", {"recipe": {"timing": {"sampling_rate_hz": "fast"}}}),
        ("network", {"recipe": {"timing": {"sampling_rate_hz": 1e4, "duration_s": 1e9}}}),
        ("network", {"version": 2}),
        ("posterior-network", {"classes": ["bearing_10", "healthy"]}),
        ("posterior-network", {"parameters": {"n_hidden": 10**9}}),
        ("posterior-network", {"parameters": {"n_layers": "two"}}),
        ("posterior-network", {"parameters": {"noise_range": [1, "loud"]}}),
        ("posterior-network", {"parameters": {"noise_range": [1, 2, 3]}}),
        ("posterior-network", {"parameters": {"unheard_of": 1}}),
        ("posterior-network", {"severities": [{"kind": "rust", "smallest": 0.0, "largest": 0.3}]}),
        ("posterior-network", {"severities": [{"kind": "bearing", "smallest": 0.0, "largest": 0.3}]}),
        ("posterior-network", {"severities": [{"kind": "bearing", "smallest": 0.0, "largest": "much"}]}),
        ("posterior-network", {"severities": []}),
        ("posterior-network", {"severities": "bearing"}),
        ("posterior-network", {"sees_noise": {"classes": True}}),
        ("posterior-network", {"sees_noise": {"severity": 0}}),
        ("posterior-network", {"kind": "network"}),
        ("network", {"kind": "posterior-network"}),
        ("residual-network", {"parameters": {"width": 10**9}}),
        ("residual-network", {"parameters": {"kernel": 0}}),
        ("residual-network", {"parameters": {"stem": "long"}}),
        ("residual-network", {"recipe": {"sensor": {"channels": ["current", "speed"]}}}),
    ],
    ids=str,
)
def test_json_with_wrong_types_or_values_is_refused(
    name: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    refusal(with_changes(content(name), changes), tmp_path)


@pytest.mark.parametrize(
    ("name", "key", "values"),
    [
        ("network", "center", np.zeros(3)),
        ("network", "scale", np.full(6, np.nan)),
        ("network", "network.0.weight", np.zeros((32, 5))),
        ("posterior-network", "classes.space.noise", np.zeros(100)),
        ("posterior-network", "classes.space.noise", np.ones(3)),
        ("posterior-network", "classes.space.directions", np.ones((10, 99))),
        ("posterior-network", "classes.space.directions", np.ones(1000)),
        ("posterior-network", "classes.space.variance", np.full(10, -1.0)),
        ("posterior-network", "severity.space.center", np.full(10, np.inf)),
        ("posterior-network", "severity.network.4.bias", np.zeros(5)),
        ("posterior-network", "severity.network.4.bias", np.zeros(6, dtype=np.int64)),
        ("posterior-network", "classes.network.0.weight", np.zeros((96, 10, 2))),
        ("posterior-network", "third.network.0.weight", np.zeros(3)),
        ("residual-network", "center", np.zeros(3)),
        ("residual-network", "scale", np.zeros(100)),
        ("residual-network", "network.0.0.weight", np.zeros((4, 1, 7))),
    ],
    ids=str,
)
def test_tensors_of_another_shape_are_refused(name: str, key: str, values: Any, tmp_path: Path) -> None:
    file = content(name)
    refusal(with_head(file, head_of(file), **{key: values}), tmp_path)


def foreign(model: BaseEstimator) -> bytes:
    """A pipeline of skops under the head of one of ours."""
    head = members_of(content("residual-qda"))["motor.json"]
    return archive_of(members_of(skops.io.dumps(model)) | {"motor.json": head})


def test_a_function_in_a_pipeline_is_refused_by_name(tmp_path: Path) -> None:
    """Skops would load `os.getcwd` as a step; it is no type of ours."""
    assert "getcwd" in refusal(foreign(CALLING), tmp_path)


def test_a_step_of_another_type_is_neither_saved_nor_loaded(tmp_path: Path) -> None:
    """Skops trusts all of scikit-learn; compiled code follows a tree without a look at its children."""
    path = tmp_path / "model"
    for last in (
        DecisionTreeClassifier(),
        SVC(),
        HistGradientBoostingClassifier(max_iter=2),
    ):
        model = make_pipeline(StandardScaler(), last)
        model.fit(TRAIN.X.reshape(len(TRAIN), -1)[:, :5], TRAIN.class_name)
        sentence = refused(partial(save_model, model, RECIPE, "own", path), path, named=False)
        assert f"a model with a {type(last).__name__} cannot be saved" in sentence
        assert "which no model of ours needs" in refusal(foreign(model), tmp_path)


def test_sets_come_back(tmp_path: Path) -> None:
    known, test = generate_arrays(RECIPE, 5, 300), generate_arrays(RECIPE, 9, 50)
    sets = ConformalClassifier(FrozenEstimator(fitted("residual-qda"))).fit(known.X, known.class_name)
    save_model(sets, RECIPE, "residual-qda", tmp_path / "sets.model")
    loaded, recipe, method = load_model(tmp_path / "sets.model")
    assert (recipe, method) == (RECIPE, "residual-qda")
    np.testing.assert_array_equal(loaded.predict_set(test.X), sets.predict_set(test.X))
    given = predictions(loaded, RECIPE, test.X)
    sizes = [len(opinion.candidates) for opinion in given if opinion.candidates is not None]
    assert len(sizes) == 50
    assert 0.8 < np.mean(sizes) < 3.0
    assert json.loads(json.dumps([opinion.as_json() for opinion in given]))[0]["candidates"] is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "closed-set"},
        {"format": "another"},
        {"version": 7},
        {"coverage": 2.0, "strangeness": [[0.1]]},
        {"coverage": 0.9, "strangeness": []},
        {"coverage": 0.9, "strangeness": [[0.2, 0.1]]},
        {"coverage": 0.9, "strangeness": [[0.1], [0.1]]},
        {"coverage": 0.9, "strangeness": [["much"]]},
        {"coverage": 0.9, "strangeness": [[]]},
        {"coverage": 0.9, "strangeness": "[0.1]"},
    ],
    ids=str,
)
def test_a_forged_wrapper_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    refusal(wrapper_of(content("network"), changes), tmp_path)


def wrapper_of(inner: bytes, changes: dict[str, Any] | None = None) -> bytes:
    """A wrapper's file."""
    own = {"coverage": 0.9, "strangeness": [[0.1, 0.2]]}
    head = {"format": FORMAT, "version": 1, "kind": "conformal", **own}
    return archive_of({"wrapper.json": json.dumps(head | (changes or {})).encode(), "model": inner})


def test_a_poisoned_model_inside_a_wrapper_is_refused(tmp_path: Path) -> None:
    good = wrapper_of(content("network"))
    (tmp_path / "good").write_bytes(good)
    assert isinstance(load_model(tmp_path / "good")[0], ConformalClassifier)
    for inner in (skops.io.dumps(CALLING), b"", content("threshold")[:200]):
        refusal(wrapper_of(inner), tmp_path)
    for cut in cuts(good, 8):
        refusal(cut, tmp_path)


def test_train_evaluate_predict_and_no_overwriting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset, model = str(tmp_path / "bench"), tmp_path / "qda.model"
    generate_dataset(RECIPE, 300, 4, Path(dataset))
    assert main(["train", dataset, "--out", str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "method": "residual-qda",
        "n_train": 210,
        "out": str(model),
    }
    before = model.read_bytes()
    assert main(["train", dataset, "--out", str(model)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert model.read_bytes() == before

    assert main(["evaluate", str(model), dataset, "--json"]) == 0
    scored = json.loads(capsys.readouterr().out)
    assert scored["n_test"] == 45 == np.sum(scored["confusion"])
    assert scored["accuracy"] == np.trace(scored["confusion"]) / 45
    assert 0.6 < scored["bayes_accuracy"] < 0.95

    missing = str(tmp_path / "missing.csv")
    assert main(["predict", dataset, missing, "--model", str(model), "--split", "test", "--json"]) == 2
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 46
    assert rows[-1]["error"].startswith(missing)
    assert sum(rows[0]["probabilities"].values()) == pytest.approx(1.0)
    assert main(["predict", dataset, "--model", str(model), "--split", "test"]) == 1
