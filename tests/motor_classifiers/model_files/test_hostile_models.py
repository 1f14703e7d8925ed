"""Damaged, forged and exploding model files: refused with one sentence at loading, never a surprise at predicting.

A crash of compiled code would end the tests: what might crash it is read by a process of its own.
"""

import json
import os
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import skops.io
from hostile import (
    Child,
    archive_of,
    cuts,
    damaged,
    deep,
    flips,
    forged,
    json_of,
    members_of,
    odd_places,
    places,
    poison,
    refused,
    refused_or_same,
    zip_bombs,
)
from safetensors.numpy import load
from saved_models import QUICK, RECIPE, TEST, TRAIN, content, head_of, with_changes, with_head
from sklearn.base import BaseEstimator
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC
from sklearn.tree import DecisionTreeClassifier

from motor_classifiers import ConformalClassifier, ResidualProjection, load_model, save_model

# Reaches in: the bounds of a rule, without tuning a rule for each; answers of a benchmark are read by the same code.
from motor_classifiers.estimators.confirmation import _check_rule
from motor_classifiers.model_files import containers, persistence
from motor_classifiers.model_files.persistence import FORMAT
from motor_classifiers.scoring.judging import load_answer
from motor_classifiers.scoring.task import class_task
from motor_env import Timing, load_recipe
from motor_env.common.files import LARGEST_DATA_BYTES

TENSORS = ("threshold", "network", "posterior-network", "residual-network")
NAMES = ("threshold", "residual-qda", "physical-logistic", "rules", *QUICK)
SEED, N_MUTATED = 21, 1_030
READ = """
import hashlib
import numpy as np
from motor_classifiers.model_files.persistence import load_model
X = np.load({!r})
def read(path):
    probabilities = load_model(path)[0].predict_proba(X)
    if len(probabilities) != len(X) or not np.isfinite(probabilities).all():
        return "nonsense"
    return hashlib.sha256(np.ascontiguousarray(probabilities).tobytes()).hexdigest()
"""


def refusal(file: bytes, folder: Path) -> str:
    """The sentence with which a file is refused."""
    path = folder / "forged.model"
    path.write_bytes(file)
    sentence = refused(lambda: load_model(path), path)
    assert sentence.startswith(f"{path}: ")
    return sentence


@pytest.mark.parametrize("name", [*TENSORS, "residual-qda"])
def test_cuts_are_refused_and_flipped_bits_are_harmless(name: str, tmp_path: Path) -> None:
    """No other error than the sentence, at loading or at predicting; no flipped bit is taken for a weight."""
    path, file = tmp_path / "flipped.model", content(name)
    for cut in cuts(file, 12):
        refusal(cut, tmp_path)

    def same(found: tuple[Any, ...]) -> None:
        assert found[0].predict_proba(TRAIN.X[:2]).shape == (2, 5)

    for flipped in flips(file, np.random.default_rng(0), 25, within=range(min(len(file), 4000))):
        path.write_bytes(flipped)
        refused_or_same(lambda: load_model(path), path, same)
    if name in TENSORS:
        tensors = range(8 + int.from_bytes(file[:8], "little"), len(file))
        for flipped in flips(file, np.random.default_rng(1), 10, within=tensors):
            assert "not what was saved" in refusal(flipped, tmp_path)


BEARING = {"kind": "bearing", "smallest": 0.0, "largest": 0.3}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("threshold", {"rule": {"needed": "two"}}),
        ("threshold", {"rule": {"unheard_of": 1}}),
        ("threshold", {"false_alarm_rate": "rare"}),
        ("threshold", {"kind": "sculpture"}),
        ("threshold", {"method": ["threshold"]}),
        ("threshold", {"classes": ["healthy", "stolen"]}),
        ("network", {"classes": ["bearing_10", "healthy"]}),
        ("network", {"kind": "posterior-network"}),
        ("network", {"parameters": {"n_hidden": "wide"}}),
        ("network", {"parameters": {"n_hidden": 10**9}}),
        ("network", {"parameters": {"n_layers": 10**9}}),
        ("network", {"parameters": {"unheard_of": 1}}),
        ("network", {"recipe": {"timing": {"sampling_rate_hz": 1e4, "duration_s": 1e9}}}),
        ("network", {"version": 2}),
        ("posterior-network", {"parameters": {"noise_range": [1, 2, 3]}}),
        ("posterior-network", {"severities": [BEARING | {"kind": "rust"}]}),
        ("posterior-network", {"severities": [BEARING]}),
        ("posterior-network", {"severities": [BEARING | {"largest": "much"}]}),
        ("posterior-network", {"sees_noise": {"classes": True}}),
        ("residual-network", {"parameters": {"width": 10**9}}),
        ("residual-network", {"parameters": {"kernel": 0}}),
        ("residual-network", {"recipe": {"sensor": {"channels": ["current", "speed"]}}}),
    ],
    ids=str,
)
def test_a_head_with_wrong_types_or_values_is_refused(
    name: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "same").write_bytes(with_changes(content(name), {}))
    assert load_model(tmp_path / "same")[2] == name
    refusal(with_changes(content(name), changes), tmp_path)


@pytest.mark.parametrize(
    ("name", "key", "values"),
    [
        ("network", "center", np.zeros(3)),
        ("network", "scale", np.full(6, np.nan)),
        ("network", "network.0.weight", np.zeros((32, 5))),
        ("posterior-network", "classes.space.noise", np.zeros(100)),
        ("posterior-network", "classes.space.directions", np.ones((10, 99))),
        ("posterior-network", "classes.space.variance", np.full(10, -1.0)),
        ("posterior-network", "severity.space.center", np.full(10, np.inf)),
        ("posterior-network", "severity.network.4.bias", np.zeros(6, dtype=np.int64)),
        ("posterior-network", "third.network.0.weight", np.zeros(3)),
        ("residual-network", "scale", np.zeros(100)),
    ],
)
def test_tensors_of_another_shape_are_refused(name: str, key: str, values: Any, tmp_path: Path) -> None:
    file = content(name)
    refusal(with_head(file, head_of(file), **{key: values}), tmp_path)


TEN = load_recipe("bench", timing=Timing(1_000.0, 0.01))
RULE: dict[str, Any] = {
    "windows": np.array([[0, 2], [1, 5], [6, 10]]), "bank_windows": np.array([[0, 5], [5, 10]]),
    "needed": 1, "among": 1, "healthy_index": 0, "with_spread": False, "healthy_center": np.zeros((3, 1)),
    "healthy_scale": np.ones((3, 1)), "lower": -np.ones((3, 1)), "upper": np.ones((3, 1)),
    "own_scale": np.ones((2, 1)), "prior": np.full(5, 0.2), "temperature": 1.0, "slope": 1.0, "intercept": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("healthy_index", 5),
        ("healthy_index", -1),
        ("windows", [[-1, 2], [1, 5], [6, 10]]),
        ("windows", [[0, 2], [1, 5], [6, 11]]),
        ("windows", [[0, 2], [5, 5], [6, 10]]),
        ("windows", [[0, 2], [6, 10], [1, 5]]),
        ("windows", [[0.0, 2.0], [1.0, 5.0], [6.0, 10.0]]),
        ("bank_windows", [[0, 5], [6, 11]]),
        ("needed", 0),
        ("needed", 2),
        ("among", 4),
        ("with_spread", True),
        ("healthy_center", np.zeros(3)),
        ("healthy_scale", np.zeros((3, 1))),
        ("lower", np.zeros((3, 1))),
        ("upper", np.zeros((3, 1))),
        ("own_scale", np.zeros((2, 1))),
        ("prior", np.array([-0.1, 0.1, 0.0, 0.5, 0.5])),
        ("temperature", float("inf")),
    ],
)
def test_a_rule_fits_its_windows(name: str, value: Any) -> None:
    most = {"healthy_index": 4, "needed": 3, "among": 3, "prior": np.array([0.0, 0.0, 0.0, 0.5, 0.5])}
    _check_rule(RULE | most, TEN)
    with pytest.raises(ValueError, match=r"must"):
        _check_rule(RULE | {name: np.array(value) if isinstance(value, list) else value}, TEN)


CALLING = Pipeline([("call", FunctionTransformer(os.getcwd))])


def foreign(model: BaseEstimator) -> bytes:
    """A pipeline of skops under the head of one of ours."""
    head = members_of(content("residual-qda"))["motor.json"]
    return archive_of(members_of(skops.io.dumps(model)) | {"motor.json": head})


def test_a_step_of_another_type_is_neither_saved_nor_loaded(tmp_path: Path) -> None:
    """Skops would load `os.getcwd` as a step; compiled code follows a tree without a look at its children."""
    assert "getcwd" in refusal(foreign(CALLING), tmp_path)
    for last in (DecisionTreeClassifier(), SVC()):
        model = make_pipeline(StandardScaler(), last).fit(TRAIN.X[:, 0, :5], TRAIN.class_name)
        path = tmp_path / "model"
        sentence = refused(partial(save_model, model, RECIPE, "own", path), path, named=False)
        assert f"a model with a {type(last).__name__} cannot be saved" in sentence
        assert "which no model of ours needs" in refusal(foreign(model), tmp_path)


def wrapper_of(inner: bytes, **changes: Any) -> bytes:
    """A wrapper's file."""
    head = {"format": FORMAT, "version": 1, "kind": "conformal", "coverage": 0.9, "strangeness": [[0.1, 0.2]]}
    return archive_of({"wrapper.json": json.dumps(head | changes).encode(), "model": inner})


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "closed-set"},
        {"format": "another"},
        {"version": 7},
        {"coverage": 2.0},
        *({"strangeness": s} for s in ([], [[0.2, 0.1]], [[0.1], [0.1]], [["much"]], "[0.1]")),
    ],
    ids=str,
)
def test_a_forged_wrapper_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    refusal(wrapper_of(content("network"), **changes), tmp_path)


def test_a_poisoned_model_is_refused_in_a_wrapper_too(tmp_path: Path) -> None:
    header = b'{"a":{"dtype":"F64","shape":[1000000000],"data_offsets":[0,8]}}'
    for file in (
        poison(tmp_path / "mark"),
        archive_of({"archive/data.pkl": poison(tmp_path / "mark")}),  # as torch writes it
        len(header).to_bytes(8, "little") + header + b"\0" * 8,  # safetensors that lie of their size
        skops.io.dumps(CALLING),
        b"time_s,current_a\n0,1\n",
    ):
        refusal(file, tmp_path)
        refusal(wrapper_of(file), tmp_path)
    assert not (tmp_path / "mark").exists()
    (tmp_path / "good").write_bytes(wrapper_of(content("network")))
    assert isinstance(load_model(tmp_path / "good")[0], ConformalClassifier)


@pytest.mark.timeout(30)
def test_only_regular_files_are_read(tmp_path: Path) -> None:
    for path in odd_places(tmp_path / "model"):
        assert "no regular file" in refused(partial(load_model, path), path)
        assert "is no regular file" in refused(partial(containers.read_arrays, path), path)
        assert load_answer(path, class_task(RECIPE, 50, 50)) is None


@pytest.mark.parametrize(
    ("module", "name", "size", "sentence"),
    [
        (persistence, "LARGEST_DATA_BYTES", len, "is larger than"),
        (persistence, "MOST_FEATURES", lambda _: 100, "a case has more than 99 values"),
        (
            containers,
            "LARGEST_DATA_BYTES",
            lambda file: sum(map(len, members_of(file).values())),
            "unpacks to more",
        ),
        (
            containers,
            "LARGEST_TEXT_BYTES",
            lambda file: len(members_of(file)["schema.json"]),
            "is longer than",
        ),
        (containers, "MOST_MEMBERS", lambda file: len(members_of(file)), "has more than"),
    ],
)
def test_sizes_at_their_bounds(
    module: Any, name: str, size: Any, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model"
    path.write_bytes(archive_of(members_of(content("residual-qda")), zipfile.ZIP_DEFLATED))
    largest = size(path.read_bytes())
    monkeypatch.setattr(module, name, largest)
    load_model(path)
    monkeypatch.setattr(module, name, largest - 1)
    assert sentence in refused(partial(load_model, path), path)


@pytest.fixture(scope="module")
def child(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    """Tells of a file the digest of its predictions."""
    path = tmp_path_factory.mktemp("starts") / "X.npy"
    np.save(path, TEST.X[:5])
    with Child(READ.format(str(path))) as process:
        yield process


def forged_model(file: bytes, rng: np.random.Generator) -> bytes:
    """What a stranger does: a file that is whole, and says something else in a head or a schema."""
    if file[:2] != b"PK":
        return with_head(file, forged(head_of(file), rng))
    members = members_of(file)
    name = str(rng.choice([name for name in members if name.endswith(".json")]))
    return archive_of(members | {name: json_of(forged(json.loads(members[name]), rng)).encode()})


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "numbers",
    [
        range(30),
        *(pytest.param(range(n, n + 100), marks=pytest.mark.long) for n in range(30, N_MUTATED, 100)),
    ],
)
def test_mutated_models_are_refused_or_the_same(numbers: range, child: Child, tmp_path: Path) -> None:
    went = child.outcomes([(name, content(name)) for name in NAMES], tmp_path)
    for number in numbers:
        rng, name = np.random.default_rng([SEED, number]), NAMES[number % len(NAMES)]
        file, is_damaged = content(name), number % 2 == 1
        # Half of the damage in the first bytes, where the header of a tensor file is.
        changed = damaged(file, rng, focus=range(3000)) if is_damaged else forged_model(file, rng)
        (outcome,) = child.outcomes([(f"{number}-{name}", changed)], tmp_path).values()
        is_digest = len(outcome) == 64 and " " not in outcome
        assert outcome in ("refused", went[name]) or (is_digest and not is_damaged), (
            f"{number} {name}: {outcome}"
        )


def with_nodes(file: bytes, name: str, **changes: Any) -> bytes:
    """An archive whose schema says something else of each object of a name."""
    members = members_of(file)
    schema = json.loads(members["schema.json"])
    found = [node[key] for node, key in list(places(schema)) if key == name and isinstance(node[key], dict)]
    assert found
    for number, one in enumerate(found):
        one |= changes | {"__id__": 10**9 + number}  # two of one number are one object
    return archive_of(members | {"schema.json": json.dumps(schema).encode()})


def bombs() -> Iterator[tuple[str, bytes]]:
    """What no model of ours holds, and what is larger than any."""
    good, threshold = members_of(content("residual-qda")), content("threshold")
    yield "workers", with_nodes(content("physical-logistic"), "n_jobs", content="100000")
    func = {"__loader__": "MethodNode", "content": {"func": "all"}}
    yield "a method", with_nodes(content("residual-qda"), "means_", **func)
    sparse = make_pipeline(ResidualProjection(None, 6), LogisticRegression()).fit(TRAIN.X, TRAIN.class_name)
    sparse.steps[-1][1].coef_ = scipy.sparse.csr_matrix(
        sparse.steps[-1][1].coef_
    )  # whose indices are believed
    yield "sparse weights", foreign(sparse)
    yield from zip_bombs(good, LARGEST_DATA_BYTES)
    long = b"[" + b"[]," * 30_000_000 + b"[]]"
    yield "a long schema", archive_of(good | {"schema.json": long}, zipfile.ZIP_DEFLATED)
    yield "a deep schema", archive_of(good | {"schema.json": deep(200_000).encode()})
    yield "a deep head", with_head(threshold, deep(200_000))
    head = head_of(threshold)
    for name, digits in (("needed", 400), ("threshold", 5000), ("healthy_index", 5000)):
        text = json_of(head | {"rule": head["rule"] | {name: "digits"}})
        yield f"{digits} digits in {name}", with_head(threshold, text.replace('"digits"', "9" * digits))
    zeros = np.zeros_like(load(threshold)["healthy_scale"])
    yield "scales of 0", with_head(threshold, head, healthy_scale=zeros)


def test_bombs_and_absurd_numbers_are_refused(child: Child, tmp_path: Path) -> None:
    went = child.outcomes(bombs(), tmp_path)
    assert {name: outcome for name, outcome in went.items() if outcome != "refused"} == {}
