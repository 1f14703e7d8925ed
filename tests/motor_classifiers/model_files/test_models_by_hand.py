"""Checks of model files at their bounds: the right numbers pass, one more does not."""

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.frozen import FrozenEstimator
from sklearn.naive_bayes import GaussianNB

from motor_classifiers import ConformalClassifier, load_model, save_model

# Reaches in: pins the bounds of a rule, without tuning a rule for each.
from motor_classifiers.estimators.confirmation import _check_rule
from motor_classifiers.model_files import containers, persistence
from motor_env import InputError, Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.01))
NAMES = np.array(sorted(RECIPE.class_names))


def cases(n_classes: int) -> tuple[Any, Any]:
    """A handful of cases of each class."""
    labels = np.arange(12 * n_classes) % n_classes
    return np.random.default_rng(0).normal(size=(len(labels), 10)) + labels[:, None], NAMES[labels]


RULE: dict[str, Any] = {
    "windows": np.array([[0, 2], [1, 5], [6, 10]]), "bank_windows": np.array([[0, 5], [5, 10]]),
    "needed": 1, "among": 1, "healthy_index": 0, "with_spread": False, "healthy_center": np.zeros((3, 1)),
    "healthy_scale": np.ones((3, 1)), "lower": -np.ones((3, 1)), "upper": np.ones((3, 1)),
    "own_scale": np.ones((2, 1)), "prior": np.full(5, 0.2), "temperature": 1.0, "slope": 1.0, "intercept": 0.0,
}  # fmt: skip


def pairs(*windows: tuple[int, int]) -> Any:
    """Windows as arrays have them."""
    return np.array(windows, dtype=np.int64)


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        ({}, True),
        ({"needed": 3, "among": 3}, True),
        ({"needed": 3, "among": 4}, False),
        ({"needed": 2, "among": 1}, False),
        ({"needed": 0}, False),
        ({"healthy_index": 4}, True),
        ({"healthy_index": 5}, False),
        ({"healthy_index": -1}, False),
        ({"windows": pairs((3, 4), (3, 4), (3, 4))}, True),
        ({"windows": pairs((-1, 2), (1, 5), (6, 10))}, False),
        ({"windows": pairs((0, 2), (1, 5), (6, 11))}, False),
        ({"windows": pairs((0, 2), (5, 5), (6, 10))}, False),
        ({"windows": pairs((0, 2), (6, 10), (1, 5))}, False),
        ({"windows": pairs((0, 2), (1, 5))}, False),
        ({"windows": np.array([[0.0, 2.0], [1.0, 5.0], [6.0, 10.0]])}, False),
        ({"windows": np.zeros((0, 2), dtype=np.int64)}, False),
        ({"windows": pairs((0, 2), (1, 5), (6, 10)).T}, False),
        ({"bank_windows": pairs((0, 5), (6, 7))}, True),
        ({"bank_windows": pairs((0, 5), (6, 11))}, False),
        ({"bank_windows": pairs((0, 5))}, False),
        ({"with_spread": True}, False),
        ({"with_spread": 1}, False),
        ({"healthy_center": np.full((3, 1), -7.0)}, True),
        ({"healthy_center": np.zeros(3)}, False),
        ({"healthy_scale": np.zeros((3, 1))}, False),
        ({"lower": np.zeros((3, 1))}, False),
        ({"upper": np.zeros((3, 1))}, False),
        ({"upper": np.ones((3, 2))}, False),
        ({"own_scale": np.zeros((2, 1))}, False),
        ({"prior": np.array([0.0, 0.0, 0.0, 0.5, 0.5])}, True),
        ({"prior": np.array([-0.1, 0.1, 0.0, 0.5, 0.5])}, False),
        ({"temperature": float("inf")}, False),
        ({"slope": 1}, False),
    ],
    ids=lambda value: str(value).replace("\n", ""),
)
def test_a_rule_fits_its_windows(changes: dict[str, Any], fits: bool) -> None:
    if fits:
        _check_rule(RULE | changes, RECIPE)
    else:
        with pytest.raises(ValueError, match=r"must"):
            _check_rule(RULE | changes, RECIPE)


def test_two_wrappers_come_back_and_three_do_not(tmp_path: Path) -> None:
    X, y = cases(3)
    model: Any = GaussianNB().fit(X, y)
    for depth in range(4):
        save_model(model, RECIPE, "nested", tmp_path / str(depth))
        if depth < 3:
            loaded = load_model(tmp_path / str(depth))[0]
            np.testing.assert_array_equal(loaded.predict_proba(X), model.predict_proba(X))
        else:
            with pytest.raises(InputError, match="too many classifiers are nested in it"):
                load_model(tmp_path / str(depth))
        model = ConformalClassifier(FrozenEstimator(model)).fit(X, y)


@pytest.mark.parametrize("name", ["LARGEST_DATA_BYTES", "LARGEST_TEXT_BYTES", "MOST_MEMBERS"])
def test_sizes_at_their_bounds(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    X, y = cases(2)
    path = tmp_path / "model"
    save_model(GaussianNB().fit(X, y), RECIPE, "bayes", path)
    with zipfile.ZipFile(path) as archive:
        texts = [one.file_size for one in archive.infolist() if one.filename.endswith(".json")]
        members = len(archive.infolist())
    size = {
        "LARGEST_DATA_BYTES": path.stat().st_size,
        "LARGEST_TEXT_BYTES": max(texts),
        "MOST_MEMBERS": members,
    }[name]
    module = persistence if name == "LARGEST_DATA_BYTES" else containers
    monkeypatch.setattr(module, name, size)
    assert load_model(path)[2] == "bayes"
    monkeypatch.setattr(module, name, size - 1)
    with pytest.raises(InputError, match=r"is larger than|is longer than|has more than"):
        load_model(path)


def test_an_archive_unpacks_to_no_more_than_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    members = {"a": b"x" * 60, "b": b"y" * 40}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    monkeypatch.setattr(containers, "LARGEST_DATA_BYTES", 100)
    assert containers.unpacked(buffer.getvalue()) == members
    monkeypatch.setattr(containers, "LARGEST_DATA_BYTES", 99)
    with pytest.raises(ValueError, match="it unpacks to more than"):
        containers.unpacked(buffer.getvalue())


def test_a_case_has_a_million_values_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_model(GaussianNB().fit(*cases(2)), RECIPE, "bayes", tmp_path / "model")
    monkeypatch.setattr(persistence, "MOST_FEATURES", 10)
    load_model(tmp_path / "model")
    monkeypatch.setattr(persistence, "MOST_FEATURES", 9)
    with pytest.raises(InputError, match="a case has more than 9 values"):
        load_model(tmp_path / "model")


def test_a_digest_is_that_of_head_names_types_shapes_and_bytes() -> None:
    """Files of all versions carry it."""
    arrays = {"b": np.array([[1.0, 2.0]]), "a": np.array([3], dtype=np.int64)}
    content = b"{}\na <i8 (1,)\n" + arrays["a"].tobytes() + b"\nb <f8 (1, 2)\n" + arrays["b"].tobytes()
    assert containers.digest("{}", arrays) == hashlib.sha256(content).hexdigest()
