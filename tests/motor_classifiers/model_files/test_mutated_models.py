"""Mutated, forged and exploding model files: refused with one sentence, or the same prediction.

A crash of compiled code would end the tests: so the files are read by a process of its own.
"""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
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
    deep,
    json_of,
    members_of,
    odd_places,
    places,
    refused,
    zip_bombs,
)
from mutated_models import NAMES, mutated
from safetensors.numpy import load
from saved_models import QUICK, RECIPE, TEST, TRAIN, content, head_of, with_head
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline

from motor_classifiers import ResidualProjection, load_model, make_method, save_model
from motor_datasets import generate_arrays

# Reaches in: bombs are larger than what is read.
from motor_env.common.files import LARGEST_DATA_BYTES

TWO = replace(RECIPE, classes=RECIPE.classes[:2])
N_MUTATED = 1_030

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


@pytest.fixture(scope="module")
def child(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    """Tells of a file the digest of its predictions."""
    path = tmp_path_factory.mktemp("starts") / "X.npy"
    np.save(path, TEST.X[:5])
    with Child(READ.format(str(path))) as process:
        yield process


def check(child: Child, numbers: range, folder: Path) -> None:
    went = child.outcomes([(name, content(name)) for name in NAMES], folder)
    for name, outcome in child.outcomes(map(mutated, numbers), folder).items():
        right = {"refused", went[name.split("-", 2)[2]]} if "-damaged-" in name else {"refused"}
        is_digest = len(outcome) == 64 and " " not in outcome
        assert outcome in right or ("-damaged-" not in name and is_digest), f"{name}: {outcome}"


def test_mutated_models_are_refused_or_the_same(child: Child, tmp_path: Path) -> None:
    check(child, range(30), tmp_path)


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(30, N_MUTATED, 100))
def test_many_mutated_models_are_refused_or_the_same(first: int, child: Child, tmp_path: Path) -> None:
    check(child, range(first, first + 100), tmp_path)


def with_sparse_weights() -> bytes:
    """A logistic regression whose weights are a sparse matrix: compiled code believes its indices."""
    model = make_pipeline(ResidualProjection(None, 6), LogisticRegression()).fit(TRAIN.X, TRAIN.class_name)
    model.steps[-1][1].coef_ = scipy.sparse.csr_matrix(model.steps[-1][1].coef_)
    other = members_of(content("residual-qda"))["motor.json"]
    return archive_of(members_of(skops.io.dumps(model)) | {"motor.json": other})


def with_nodes(file: bytes, name: str, **changes: Any) -> bytes:
    """An archive whose schema says something else of each object of a name."""
    members = members_of(file)
    schema = json.loads(members["schema.json"])
    found = [node[key] for node, key in list(places(schema)) if key == name and isinstance(node[key], dict)]
    for number, one in enumerate(found):
        one |= changes | {"__id__": 10**9 + number}  # two of one number are one object
    assert found
    return archive_of(members | {"schema.json": json.dumps(schema).encode()})


def assert_refused(child: Child, files: dict[str, bytes], folder: Path) -> None:
    went = child.outcomes(files.items(), folder)
    assert {name: outcome for name, outcome in went.items() if outcome != "refused"} == {}


def test_what_no_model_of_ours_holds_is_refused(child: Child, tmp_path: Path) -> None:
    files = {
        "workers": with_nodes(content("physical-logistic"), "n_jobs", content="100000"),
        "a method": with_nodes(
            content("residual-qda"), "means_", __loader__="MethodNode", content={"func": "all"}
        ),
        "sparse weights": with_sparse_weights(),
    }
    assert_refused(child, files, tmp_path)


def bombs() -> Iterator[tuple[str, bytes]]:
    good = members_of(content("residual-qda"))
    yield from zip_bombs(good, LARGEST_DATA_BYTES)
    long = b"[" + b"[]," * 30_000_000 + b"[]]"
    yield "a long schema", archive_of(good | {"schema.json": long}, zipfile.ZIP_DEFLATED)
    yield "a deep schema", archive_of(good | {"schema.json": deep(200_000).encode()})
    threshold = content("threshold")
    head = head_of(threshold)
    yield "a deep head", with_head(threshold, deep(200_000))
    for name in ("needed", "threshold", "healthy_index"):
        for digits in (400, 5000):
            text = json_of(head | {"rule": head["rule"] | {name: "digits"}})
            yield f"{digits} digits in {name}", with_head(threshold, text.replace('"digits"', "9" * digits))
    for scale in ("healthy_scale", "own_scale"):
        zeros = np.zeros_like(load(threshold)[scale])
        yield f"{scale} of 0", with_head(threshold, head, **{scale: zeros})


def test_bombs_and_absurd_numbers_are_refused(child: Child, tmp_path: Path) -> None:
    assert_refused(child, dict(bombs()), tmp_path)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    for path in odd_places(tmp_path / "model"):
        assert "no regular file" in refused(partial(load_model, path), path)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("threshold", "network")])
def test_models_of_two_classes_come_back(name: str, tmp_path: Path) -> None:
    """Their parts are of other types than those of more classes."""
    train = generate_arrays(TWO, 1, 100)
    model = make_method(name, TWO, 0).set_params(**QUICK.get(name, {}))
    save_model(model.fit(train.X, train.class_name), TWO, name, tmp_path / "model")
    loaded = load_model(tmp_path / "model")[0]
    np.testing.assert_array_equal(loaded.predict_proba(TEST.X), model.predict_proba(TEST.X))
