"""Mutated, forged and exploding model files: refused with one sentence, or the same prediction.

A crash of compiled code would end the tests: so each batch of files is loaded by a process of its own, which says of
each file how it went, and dies of a hang.
"""

import copy
import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import skops.io
from safetensors.numpy import load, save
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler

from motor_classifiers.estimators.features import ResidualProjection
from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.model_files.containers import LARGEST_FILE_BYTES
from motor_classifiers.model_files.persistence import FORMAT, load_model, save_model
from motor_datasets import generate_arrays
from motor_env.errors import InputError
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.simulate import Timing

RECIPE = named_recipe("bench", timing=Timing(1_000.0, 0.1))
TWO = replace(RECIPE, classes=RECIPE.classes[:2])
TRAIN, TEST = generate_arrays(RECIPE, 1, 150), generate_arrays(RECIPE, 2, 5)
QUICK: dict[str, dict[str, Any]] = {
    "posterior-network": {"steps": 3, "batch_size": 32},
    "residual-network": {"epochs": 1, "stem": 4, "width": 4},
    "network": {"epochs": 2},
    "physical-boosting": {"classify__estimator__max_iter": 2},
    "physical-forest": {"classify__n_estimators": 3},
}
NAMES = ("threshold", "residual-qda", "physical-svm", "rules", *QUICK)
N_MUTATED = 1_030
SEED = 21

CHILD = """
import hashlib, json, resource, signal, sys, warnings
from pathlib import Path
import numpy as np
from motor_classifiers.model_files.persistence import load_model
from motor_env.errors import InputError
warnings.simplefilter("ignore")
X = np.load(sys.argv[2])
for path in sorted(Path(sys.argv[1]).iterdir()):
    print(json.dumps({"begins": path.name}), flush=True)
    signal.alarm(60)
    try:
        probabilities = load_model(path)[0].predict_proba(X)
        outcome = hashlib.sha256(np.ascontiguousarray(probabilities).tobytes()).hexdigest()
        if len(probabilities) != len(X) or not np.isfinite(probabilities).all():
            outcome = "nonsense"
    except InputError as error:
        sentence = str(error)
        outcome = "refused" if sentence.startswith(str(path)) and chr(10) not in sentence else sentence
    except BaseException as error:
        outcome = f"{type(error).__name__}: {error}"
    signal.alarm(0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"name": path.name, "outcome": outcome, "peak_kb": peak}), flush=True)
"""


def outcomes(files: dict[str, bytes], folder: Path) -> dict[str, str]:
    """How each file went: `refused`, a digest of the predictions, or what went wrong."""
    (folder / "files").mkdir()
    for name, content in files.items():
        (folder / "files" / name).write_bytes(content)
    np.save(folder / "X.npy", TEST.X)
    arguments = [sys.executable, "-c", CHILD, str(folder / "files"), str(folder / "X.npy")]
    child = subprocess.run(arguments, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in child.stdout.splitlines()]
    assert child.returncode == 0, f"ended by {child.returncode} at {lines[-1:]}: {child.stderr[-300:]}"
    ends = {line["name"]: line for line in lines if "name" in line}
    assert set(ends) == set(files)
    assert max(line["peak_kb"] for line in ends.values()) < 2_000_000
    return {name: line["outcome"] for name, line in ends.items()}


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("models")
    for name in NAMES:
        model = make_method(name, RECIPE, 0).set_params(**QUICK.get(name, {}))
        save_model(METHODS[name].train(model, TRAIN.X, TRAIN.class_name), RECIPE, name, folder / name)
    return {name: (folder / name).read_bytes() for name in NAMES}


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """What disks and networks do: flipped bits, a cut, bytes overwritten, put in, left out or swapped."""
    data = bytearray(content)
    # Half of the damage in the first bytes, where the header of a tensor file is.
    at = int(rng.integers(len(data) if rng.random() < 0.5 else min(len(data), 3000)))
    size = int(rng.integers(1, 64))
    kind = int(rng.integers(6))
    if kind == 0:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[at:]
    elif kind == 2:
        data[at : at + size] = rng.bytes(size)
    elif kind == 3:
        data[at:at] = rng.bytes(size)
    elif kind == 4:
        del data[at : at + size]
    else:
        data[at : at + size], data[:size] = data[:size], data[at : at + size]
    return bytes(data)


DEEP = "deep-list"
WILD: tuple[Any, ...] = (
    0, 1, -1, 7, 2**31, -(2**63), 10**400, 0.5, -0.0, 1e308, float("nan"), float("inf"), None, True, "", "healthy",
    [], {}, [[]], DEEP,
)  # fmt: skip


def text_of(value: Any) -> str:
    return json.dumps(value).replace(json.dumps(DEEP), "[" * 100_000 + "]" * 100_000)


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Each table or list of a JSON value, and each key in it."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield node, key
        if isinstance(value, dict | list):
            yield from places(value)


def forged_json(text: bytes | str, rng: np.random.Generator) -> str:
    """A JSON text with one value replaced or one key left out."""
    value = json.loads(text)
    found = list(places(value))
    node, key = found[int(rng.integers(len(found)))]
    wild = WILD[int(rng.integers(len(WILD)))]
    if rng.random() < 0.1:
        del node[key]
    elif key == "content" and isinstance(node[key], str):
        node[key] = json.dumps(wild)  # a number within a schema
    else:
        node[key] = wild
    return text_of(value)


def forged_array(values: Any, rng: np.random.Generator) -> Any:
    """An array of another size, type or content."""
    kind = int(rng.integers(5))
    if kind == 0:
        return values[: len(values) // 2] if values.ndim else np.zeros(3)
    if kind == 1:
        return np.concatenate([values, values]) if values.ndim else values[None]
    if kind == 2 and values.dtype.kind in "fiub":
        return values.astype(rng.choice(["float32", "int64", "int32", "uint8", "float64"]))
    if kind == 3:
        return values.reshape(-1)[::-1].reshape(values.shape)
    changed = values.copy().reshape(-1)
    field = changed if values.dtype.names is None else changed[str(rng.choice(list(values.dtype.names)))]
    if field.size:
        wild = rng.choice(np.array([0.0, -1.0, 1e6, 2.0**31 - 1.0, np.nan, np.inf]))
        with np.errstate(invalid="ignore"):
            field[int(rng.integers(field.size))] = np.array(wild).astype(field.dtype)
    return changed.reshape(values.shape)


def forged(content: bytes, rng: np.random.Generator) -> bytes:
    """What a stranger does: a file that is whole, and says something else."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        tensors = load(content)
        head = head_of(content)
        if rng.random() < 0.5:
            return save(tensors, metadata={FORMAT: forged_json(head, rng)})
        name = str(rng.choice(sorted(tensors)))
        return save(tensors | {name: forged_array(tensors[name], rng).copy()}, metadata={FORMAT: head})
    members = members_of(content)
    name = str(rng.choice(sorted(members))) if rng.random() < 0.5 else "schema.json"
    if name.endswith(".json"):
        members[name] = forged_json(members[name], rng).encode()
    else:
        buffer = io.BytesIO()
        np.save(buffer, forged_array(np.load(io.BytesIO(members[name])), rng))
        members[name] = buffer.getvalue()
    return archive_of(members)


def head_of(content: bytes) -> str:
    length = int.from_bytes(content[:8], "little")
    head = json.loads(json.loads(content[8 : 8 + length])["__metadata__"][FORMAT])
    del head["sha256"]  # a stranger leaves the digest out, or makes a new one
    return json.dumps(head)


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def mutated(contents: dict[str, bytes], numbers: range) -> dict[str, bytes]:
    """Files by number; each follows from the seed and its number alone."""
    files = {}
    for number in numbers:
        rng = np.random.default_rng([SEED, number])
        name = NAMES[number % len(NAMES)]
        kind: Callable[[bytes, np.random.Generator], bytes] = damaged if number % 2 else forged
        files[f"{number:03d}-{kind.__name__}-{name}"] = kind(contents[name], rng)
    return files


def check(contents: dict[str, bytes], numbers: range, folder: Path) -> None:
    went = outcomes(contents | mutated(contents, numbers), folder)
    for name, outcome in went.items():
        right = {"refused", went[name.split("-", 2)[2]]} if "-damaged-" in name else {"refused"}
        is_digest = len(outcome) == 64 and " " not in outcome
        assert outcome in right or ("-damaged-" not in name and is_digest), f"{name}: {outcome}"


def test_mutated_models_are_refused_or_the_same(contents: dict[str, bytes], tmp_path: Path) -> None:
    check(contents, range(30), tmp_path)


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(30, N_MUTATED, 100))
def test_many_mutated_models_are_refused_or_the_same(
    first: int, contents: dict[str, bytes], tmp_path: Path
) -> None:
    check(contents, range(first, first + 100), tmp_path)


def with_value(content: bytes, key: str, value: Any, *, of: str = "") -> bytes:
    """An archive whose schema has another number under a key, in each object of a class, or in all."""
    members = members_of(content)
    schema = json.loads(members["schema.json"])
    number = {"__class__": "str", "__module__": "builtins", "__loader__": "JsonNode", "is_json": True}
    changed = 0
    for node, name in list(places(schema)):
        child = node[name]
        if of and isinstance(child, dict) and child.get("__class__") == of:
            state = child["content"]
            if key not in state["content"]:
                types = state["key_types"]["content"]
                types.append(types[0])
            # A number of its own: two of one number are one object.
            state["content"][key] = number | {"content": json.dumps(value), "__id__": 10**9 + changed}
            changed += 1
        elif not of and name == key and isinstance(child, dict) and "content" in child:
            child |= {"content": json.dumps(value), "__id__": 10**9 + changed}
            changed += 1
    assert changed
    return archive_of(members | {"schema.json": json.dumps(schema).encode()})


def with_sparse_weights(content: bytes) -> bytes:
    """A logistic regression whose weights are a sparse matrix: compiled code believes its indices."""
    model = make_pipeline(ResidualProjection(None, 6), LogisticRegression()).fit(TRAIN.X, TRAIN.class_name)
    model.steps[-1][1].coef_ = scipy.sparse.csr_matrix(model.steps[-1][1].coef_)
    return archive_of(members_of(skops.io.dumps(model)) | {"motor.json": members_of(content)["motor.json"]})


def with_method(content: bytes) -> bytes:
    """A method under the name of a tree: older versions of skops look at the name alone."""
    members = members_of(content)
    schema = json.loads(members["schema.json"])
    trees = [node[key] for node, key in list(places(schema)) if key == "tree_"]
    for tree in trees:
        tree["__loader__"] = "MethodNode"
        tree["content"] = {"func": "__init__", "obj": copy.deepcopy(tree["content"])}
    assert trees
    return archive_of(members | {"schema.json": json.dumps(schema).encode()})


def test_what_compiled_code_believes_is_checked(contents: dict[str, bytes], tmp_path: Path) -> None:
    forest, svm, boosting = (contents[f"physical-{name}"] for name in ("forest", "svm", "boosting"))
    boosted = "HistGradientBoostingClassifier"
    files = {
        "fewer nodes": with_value(forest, "node_count", 1),
        "workers": with_value(forest, "n_jobs", 100_000, of="RandomForestClassifier"),
        "a method": with_method(forest),
        "not fitted": with_value(boosting, "_in_fit", True, of=boosted),
        "rounds": with_value(boosting, "n_trees_per_iteration_", 2, of=boosted),
        "precomputed kernel": with_value(svm, "kernel", "precomputed", of="SVC"),
        "another machine": with_value(svm, "_impl", "nu_svr", of="SVC"),
        "sparse machine": with_value(svm, "_sparse", True, of="SVC"),
        "sparse weights": with_sparse_weights(contents["residual-qda"]),
    }
    assert_refused(files, tmp_path)


def assert_refused(files: dict[str, bytes], folder: Path) -> None:
    went = outcomes(files, folder)
    assert {name: outcome for name, outcome in went.items() if outcome != "refused"} == {}


def with_head(content: bytes, text: str) -> bytes:
    return save(load(content), metadata={FORMAT: text})


def bombs(contents: dict[str, bytes]) -> Iterator[tuple[str, bytes]]:
    good = members_of(contents["residual-qda"])
    zeros = {"zeros": bytes(LARGEST_FILE_BYTES)}
    for name, method in (("deflated", zipfile.ZIP_DEFLATED), ("bzip2", zipfile.ZIP_BZIP2)):
        bomb = archive_of(good | zeros, method)
        yield name, bomb
        # The size that the archive states is what is looked at first: a bomb states a small one.
        yield (
            f"{name} lying",
            bomb.replace(LARGEST_FILE_BYTES.to_bytes(4, "little"), (9).to_bytes(4, "little")),
        )
    long = b"[" + b"[]," * 30_000_000 + b"[]]"
    yield "a long schema", archive_of(good | {"schema.json": long}, zipfile.ZIP_DEFLATED)
    yield "a deep schema", archive_of(good | {"schema.json": b"[" * 200_000 + b"]" * 200_000})
    head = head_of(contents["threshold"])
    yield "a deep head", with_head(contents["threshold"], "[" * 200_000 + "]" * 200_000)
    for name in ("needed", "threshold", "healthy_index"):
        changed = json.loads(head)
        changed["rule"][name] = 10**400
        yield f"400 digits in {name}", with_head(contents["threshold"], json.dumps(changed))
        changed["rule"][name] = "digits"
        text = json.dumps(changed).replace('"digits"', "9" * 5000)
        yield f"5000 digits in {name}", with_head(contents["threshold"], text)
    for scale in ("healthy_scale", "own_scale"):
        tensors = load(contents["threshold"])
        tensors[scale] = np.zeros_like(tensors[scale])
        yield f"{scale} of 0", save(tensors, metadata={FORMAT: head})


def test_bombs_and_absurd_numbers_are_refused(contents: dict[str, bytes], tmp_path: Path) -> None:
    assert_refused(dict(bombs(contents)), tmp_path)


@pytest.mark.parametrize("kind", ["endless", "pipe", "folder"])
def test_only_regular_files_are_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "model"
    if kind == "endless":
        path = Path("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(InputError, match="no regular file"):
        load_model(path)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("threshold", "network")])
def test_models_of_two_classes_come_back(name: str, tmp_path: Path) -> None:
    """Their parts are of other types than those of more classes."""
    train = generate_arrays(TWO, 1, 100)
    model = make_method(name, TWO, 0).set_params(**QUICK.get(name, {}))
    save_model(METHODS[name].train(model, train.X, train.class_name), TWO, name, tmp_path / "model")
    loaded = load_model(tmp_path / "model")[0]
    np.testing.assert_array_equal(loaded.predict_proba(TEST.X), model.predict_proba(TEST.X))


@pytest.mark.parametrize("scaler", [MinMaxScaler(), RobustScaler()])
def test_other_steps_come_back(scaler: Any, tmp_path: Path) -> None:
    model = make_pipeline(ResidualProjection(RECIPE, 6), scaler, GaussianNB()).fit(TRAIN.X, TRAIN.class_name)
    save_model(model, RECIPE, "other", tmp_path / "model")
    loaded = load_model(tmp_path / "model")[0]
    np.testing.assert_array_equal(loaded.predict_proba(TEST.X), model.predict_proba(TEST.X))
