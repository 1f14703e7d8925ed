"""Damaged and forged model files: refused with one sentence at loading, never a surprise at predicting."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.tree import DecisionTreeClassifier

from motor_classifiers.cli.main import main
from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_classifiers.model_files.persistence import FORMAT, load_model, save_model
from motor_classifiers.prediction.opinions import opinions
from motor_classifiers.scoring.unknown_faults import ForeignFault, foreign_starts
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.open_set import OpenSetClassifier
from motor_datasets import generate_arrays, generate_dataset
from motor_env.console import ExitStatus
from motor_env.errors import InputError
from motor_env.motor.faults import FaultKind
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.simulate import Timing

RECIPE = named_recipe("bench", timing=Timing(1_000.0, 0.1))
TRAIN = generate_arrays(RECIPE, 1, 200)
QUICK = {
    "posterior-network": {"steps": 5, "batch_size": 32},
    "residual-network": {"epochs": 1, "stem": 4, "width": 4},
    "physical-boosting": {"classify__estimator__max_iter": 5},
    "physical-forest": {"classify__n_estimators": 10},
}
NAMES = ("threshold", "network", "residual-qda", "physical-svm", *QUICK)


@pytest.fixture(scope="module")
def fitted() -> dict[str, BaseEstimator]:
    return {
        name: METHODS[name].train(
            make_method(name, RECIPE, 0).set_params(**QUICK.get(name, {})), TRAIN.X, TRAIN.class_name
        )
        for name in NAMES
    }


@pytest.fixture(scope="module")
def contents(fitted: dict[str, BaseEstimator], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("models")
    for name, model in fitted.items():
        save_model(model, RECIPE, name, folder / name)
    return {name: (folder / name).read_bytes() for name in NAMES}


def refusal(content: bytes, folder: Path) -> str:
    """The sentence with which a file is refused."""
    path = folder / "forged.model"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_model(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize(
    "name", ["threshold", "network", "residual-qda", "posterior-network", "residual-network"]
)
def test_any_cut_is_refused(name: str, contents: dict[str, bytes], tmp_path: Path) -> None:
    content = contents[name]
    for end in np.linspace(0, len(content) - 1, 12).astype(int):
        refusal(content[:end], tmp_path)


@pytest.mark.parametrize(
    "name", ["threshold", "network", "residual-qda", "posterior-network", "residual-network"]
)
def test_a_flipped_byte_is_refused_or_harmless(name: str, contents: dict[str, bytes], tmp_path: Path) -> None:
    """No other error than the sentence, at loading or at predicting."""
    rng = np.random.default_rng(0)
    path = tmp_path / "flipped.model"
    for position in rng.integers(min(len(contents[name]), 4000), size=25):
        damaged = bytearray(contents[name])
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            model = load_model(path)[0]
        except InputError:
            continue
        assert model.predict_proba(TRAIN.X[:2]).shape == (2, 5)


@pytest.mark.parametrize("name", ["threshold", "network", "posterior-network", "residual-network"])
def test_a_flipped_bit_is_not_taken_for_a_weight(
    name: str, contents: dict[str, bytes], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    content = contents[name]
    begin = 8 + int.from_bytes(content[:8], "little")
    for position in rng.integers(begin, len(content), size=10):
        damaged = bytearray(content)
        damaged[position] ^= 1
        assert "not what was saved" in refusal(bytes(damaged), tmp_path)


def with_head(content: bytes, changes: dict[str, Any]) -> bytes:
    """A safetensors model with another head; nested tables are merged."""
    length = int.from_bytes(content[:8], "little")
    head = json.loads(json.loads(content[8 : 8 + length])["__metadata__"][FORMAT])
    del head["sha256"]  # as a file of an older version: the checks behind the digest are what is asked
    for key, value in changes.items():
        head[key] = {**head[key], **value} if isinstance(value, dict) else value
    return save(load(content), metadata={FORMAT: json.dumps(head)})


def test_an_unchanged_head_loads(contents: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "same").write_bytes(with_head(contents["threshold"], {}))
    assert load_model(tmp_path / "same")[2] == "threshold"


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("threshold", {"rule": {"needed": "two"}}),
        ("threshold", {"rule": {"among": 99}}),
        ("threshold", {"rule": {"threshold": None}}),
        ("threshold", {"rule": {"healthy_index": 77}}),
        ("threshold", {"rule": {"edges": [0, 10**12]}}),
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
    name: str, changes: dict[str, Any], contents: dict[str, bytes], tmp_path: Path
) -> None:
    refusal(with_head(contents[name], changes), tmp_path)


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
def test_tensors_of_another_shape_are_refused(
    name: str, key: str, values: Any, contents: dict[str, bytes], tmp_path: Path
) -> None:
    content = with_head(contents[name], {})
    length = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + length])["__metadata__"][FORMAT]
    refusal(save({**load(content), key: values}, metadata={FORMAT: head}), tmp_path)


def test_a_function_in_a_pipeline_is_refused_by_name(contents: dict[str, bytes], tmp_path: Path) -> None:
    """Skops would load `os.getcwd` as a step; it is no type of ours."""
    import os

    import skops.io

    archive = io.BytesIO(skops.io.dumps(Pipeline([("call", FunctionTransformer(os.getcwd))])))
    with zipfile.ZipFile(io.BytesIO(contents["residual-qda"])) as good, zipfile.ZipFile(archive, "a") as bad:
        bad.writestr("motor.json", good.read("motor.json"))
    assert "getcwd" in refusal(archive.getvalue(), tmp_path)


def renamed(content: bytes, names: dict[str, str]) -> bytes:
    """A pipeline's archive with text replaced in its schema."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(buffer, "w") as target:
        for member in source.namelist():
            text = source.read(member)
            if member == "schema.json":
                for name, other in names.items():
                    assert name.encode() in text
                    text = text.replace(name.encode(), other.encode())
            target.writestr(member, text)
    return buffer.getvalue()


def test_pipelines_with_the_old_names_of_their_classes_load(
    contents: dict[str, bytes], fitted: dict[str, BaseEstimator], tmp_path: Path
) -> None:
    """Files from before the classes moved into packages."""
    features = {"motor_classifiers.estimators.features": "motor_classifiers.features"}
    starts = {"motor_classifiers.estimators.reference_starts": "motor_classifiers.reference"}
    rules = {"motor_classifiers.estimators.features": "motor_classifiers.rule_statistics"}
    with_starts = make_pipeline(RecentredStarts(RECIPE), make_method("rules", RECIPE, 0))
    save_model(with_starts.fit(TRAIN.X, TRAIN.class_name), RECIPE, "rules", tmp_path / "new")
    for content, names, model in (
        (contents["physical-forest"], features, fitted["physical-forest"]),
        ((tmp_path / "new").read_bytes(), starts | rules, with_starts),
    ):
        old = tmp_path / "old.model"
        old.write_bytes(renamed(content, names))
        loaded = load_model(old)[0]
        np.testing.assert_array_equal(loaded.predict_proba(TRAIN.X[:9]), model.predict_proba(TRAIN.X[:9]))
    other = renamed(contents["residual-qda"], {"ResidualProjection": "whitened_residual"} | features)
    assert "motor_classifiers.features.whitened_residual" in refusal(other, tmp_path)


def test_a_step_of_another_type_is_neither_saved_nor_loaded(
    contents: dict[str, bytes], tmp_path: Path
) -> None:
    """Skops trusts all of scikit-learn; a lone tree would be followed without a look at its children."""
    import skops.io

    model = make_pipeline(StandardScaler(), DecisionTreeClassifier()).fit(
        TRAIN.X.reshape(len(TRAIN), -1), TRAIN.class_name
    )
    with pytest.raises(InputError, match="a model with a DecisionTreeClassifier cannot be saved"):
        save_model(model, RECIPE, "tree", tmp_path / "model")
    archive = io.BytesIO(skops.io.dumps(model))
    with zipfile.ZipFile(io.BytesIO(contents["residual-qda"])) as good, zipfile.ZipFile(archive, "a") as bad:
        bad.writestr("motor.json", good.read("motor.json"))
    assert "it has a DecisionTreeClassifier" in refusal(archive.getvalue(), tmp_path)


def test_a_tree_that_points_outside_is_refused(fitted: dict[str, BaseEstimator], tmp_path: Path) -> None:
    """Compiled code would read beside the arrays."""
    forged = tmp_path / "forged.model"
    model = fitted["physical-forest"]
    tree = model.steps[-1][1].estimators_[0].tree_
    kept = tree.children_left[0]
    tree.children_left[0] = 10**6
    save_model(model, RECIPE, "physical-forest", forged)
    tree.children_left[0] = kept
    assert "child that does not exist" in refusal(forged.read_bytes(), tmp_path)


def test_a_tree_of_the_boosting_that_points_outside_is_refused(
    fitted: dict[str, BaseEstimator], tmp_path: Path
) -> None:
    model = fitted["physical-boosting"]
    boosting = model.steps[-1][1].calibrated_classifiers_[0].estimator
    nodes = boosting._predictors[0][0].nodes
    for field, value, words in (
        ("left", 10**6, "child that does not exist"),
        ("feature_idx", 10**6, "asks for no feature"),
        ("is_categorical", 1, "asks for a category"),
    ):
        kept = nodes[field][0]
        nodes[field][0] = value
        save_model(model, RECIPE, "physical-boosting", tmp_path / "forged.model")
        nodes[field][0] = kept
        assert words in refusal((tmp_path / "forged.model").read_bytes(), tmp_path)


def test_support_vectors_that_are_not_there_are_refused(
    fitted: dict[str, BaseEstimator], tmp_path: Path
) -> None:
    model = fitted["physical-svm"]
    machine = model.steps[-1][1].calibrated_classifiers_[0].estimator
    kept = machine._n_support
    machine._n_support = kept + 1000
    save_model(model, RECIPE, "physical-svm", tmp_path / "forged.model")
    machine._n_support = kept
    assert "do not fit each other" in refusal((tmp_path / "forged.model").read_bytes(), tmp_path)


@pytest.fixture(scope="module")
def wrapped(fitted: dict[str, BaseEstimator]) -> BaseEstimator:
    """Both wrappers around the discriminant analysis."""
    known = generate_arrays(RECIPE, 5, 300)
    sets = ConformalClassifier(FrozenEstimator(fitted["residual-qda"])).fit(known.X, known.class_name)
    return OpenSetClassifier(FrozenEstimator(sets), RECIPE, false_alarm_rate=0.02).fit(
        known.X, known.class_name
    )


def test_wrappers_come_back(wrapped: OpenSetClassifier, tmp_path: Path) -> None:
    save_model(wrapped, RECIPE, "residual-qda", tmp_path / "open.model")
    loaded, recipe, method = load_model(tmp_path / "open.model")
    assert (recipe, method) == (RECIPE, "residual-qda")
    test = generate_arrays(RECIPE, 9, 50)
    for got, expected in zip(loaded.verdicts(test.X), wrapped.verdicts(test.X), strict=True):
        np.testing.assert_array_equal(got, expected)
    sets, own = loaded.wrapped_model, wrapped.wrapped_model
    np.testing.assert_array_equal(sets.predict_set(test.X), own.predict_set(test.X))

    heavier = ForeignFault("inertia +25 %", inertia=1.25)
    stiff = generate_arrays(replace(RECIPE, classes=(FaultClass(FaultKind.BEARING, 0.9),)), 9, 5)
    (known, foreign, beyond) = (
        opinions(loaded, RECIPE, X)
        for X in (test.X, foreign_starts(RECIPE, heavier, 9, np.arange(5)), stiff.X)
    )
    assert np.mean([opinion.verdict == "other" for opinion in known]) < 0.2
    for opinion in foreign:
        assert opinion.verdict == "other"
        assert opinion.status is ExitStatus.FAULT
    for opinion in beyond:
        assert (opinion.verdict, opinion.out_of_range) == ("bearing", True)
        assert opinion.severity == pytest.approx(0.9, abs=0.35)
    sizes = [len(opinion.candidates) for opinion in known if opinion.candidates is not None]
    assert sizes
    assert 0.8 < np.mean(sizes) < 3.0
    assert json.loads(json.dumps([opinion.as_json() for opinion in known]))[0]["candidates"] is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "closed-set"},
        {"format": "another"},
        {"version": 7},
        {"offset": "low"},
        {"offset": float("nan")},
        {"false_alarm_rate": 1.5},
        {"false_alarm_rate": [0.01]},
        {"kind": "conformal"},
        {"kind": "conformal", "coverage": 2.0, "strangeness": [[0.1]]},
        {"kind": "conformal", "coverage": 0.9, "strangeness": []},
        {"kind": "conformal", "coverage": 0.9, "strangeness": [[0.2, 0.1]]},
        {"kind": "conformal", "coverage": 0.9, "strangeness": [[0.1], [0.1]]},
        {"kind": "conformal", "coverage": 0.9, "strangeness": [["much"]]},
        {"kind": "conformal", "coverage": 0.9, "strangeness": [[]]},
        {"kind": "conformal", "coverage": 0.9, "strangeness": "[0.1]"},
    ],
    ids=str,
)
def test_a_forged_wrapper_is_refused(
    changes: dict[str, Any], contents: dict[str, bytes], tmp_path: Path
) -> None:
    head = {"format": FORMAT, "version": 1, "kind": "open-set", "false_alarm_rate": 0.01, "offset": -9.0}
    refusal(archive_of(head | changes, contents["network"]), tmp_path)


def archive_of(head: dict[str, Any], inner: bytes) -> bytes:
    """A wrapper's file."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("wrapper.json", json.dumps(head))
        archive.writestr("model", inner)
    return buffer.getvalue()


def test_a_poisoned_model_inside_a_wrapper_is_refused(contents: dict[str, bytes], tmp_path: Path) -> None:
    head = {"format": FORMAT, "version": 1, "kind": "open-set", "false_alarm_rate": 0.01, "offset": -9.0}
    good = archive_of(head, contents["network"])
    (tmp_path / "good").write_bytes(good)
    assert isinstance(load_model(tmp_path / "good")[0], OpenSetClassifier)
    import os

    import skops.io

    poison = skops.io.dumps(Pipeline([("call", FunctionTransformer(os.getcwd))]))
    for inner in (poison, b"", contents["threshold"][:200]):
        refusal(archive_of(head, inner), tmp_path)
    nested = archive_of(head, archive_of(head, good))
    assert "too many classifiers" in refusal(nested, tmp_path)
    for end in np.linspace(0, len(good) - 1, 8).astype(int):
        refusal(good[:end], tmp_path)


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
