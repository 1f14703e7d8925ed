"""Checks of model files at their bounds: the right numbers of trees, pairs and bytes pass, one more does not."""

import hashlib
import io
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.frozen import FrozenEstimator
from sklearn.naive_bayes import GaussianNB
from sklearn.svm import SVC

from motor_classifiers import ConformalClassifier, load_model, save_model

# Reaches in: pins the bounds of a rule, without tuning a rule for each.
from motor_classifiers.estimators.confirmation import _check_rule
from motor_classifiers.model_files import containers, persistence
from motor_classifiers.model_files.pipelines import _check_boosting, _check_grown, _check_tree, _check_vectors
from motor_env import InputError, Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.01))
NAMES = np.array(sorted(RECIPE.class_names))


def cases(n_classes: int) -> tuple[Any, Any]:
    """A handful of cases of each class."""
    labels = np.arange(12 * n_classes) % n_classes
    return np.random.default_rng(0).normal(size=(len(labels), 10)) + labels[:, None], NAMES[labels]


@pytest.mark.parametrize(("n_classes", "n_trees"), [(2, 1), (3, 3), (5, 5)])
def test_boosting_has_a_tree_a_round_for_each_class_of_several(n_classes: int, n_trees: int) -> None:
    model = HistGradientBoostingClassifier(max_iter=2, min_samples_leaf=4).fit(*cases(n_classes))
    _check_boosting(model)
    assert model.n_trees_per_iteration_ == n_trees
    for wrong in (n_trees - 1, n_trees + 1):
        model.n_trees_per_iteration_ = wrong
        with pytest.raises(ValueError, match=f"must have {n_trees} trees a round"):
            _check_boosting(model)
    model.n_trees_per_iteration_ = n_trees
    model._predictors[1] = model._predictors[1] * 2
    with pytest.raises(ValueError, match="trees a round"):
        _check_boosting(model)


@pytest.mark.parametrize(("n_classes", "n_pairs"), [(2, 1), (3, 3), (4, 6)])
def test_vectors_have_an_offset_for_each_pair_of_classes(n_classes: int, n_pairs: int) -> None:
    model = SVC().fit(*cases(n_classes))
    _check_vectors(model)
    assert model._intercept_.shape == (n_pairs,)

    def refused(**changes: Any) -> None:
        other = deepcopy(model)
        for name, value in changes.items():
            setattr(other, name, value)
        with pytest.raises(ValueError, match="do not fit each other"):
            _check_vectors(other)

    for count in (n_pairs - 1, n_pairs + 1):
        refused(_intercept_=np.zeros(count))
    scaled = deepcopy(model)
    scaled._probA = scaled._probB = np.zeros(n_pairs)
    _check_vectors(scaled)
    refused(_probA=np.zeros(n_pairs))
    for count in (n_pairs - 1, n_pairs + 1) if n_pairs > 1 else (2,):
        refused(_probA=np.zeros(count), _probB=np.zeros(count))
    refused(_dual_coef_=model._dual_coef_[:, 1:])
    refused(_dual_coef_=np.vstack([model._dual_coef_, model._dual_coef_[:1]]))
    refused(_n_support=model._n_support - np.eye(n_classes, dtype=np.int32)[0])
    refused(support_=model.support_[1:])
    refused(support_vectors_=model.support_vectors_[:, 1:])
    shifted = np.zeros(n_classes, dtype=np.int32)
    shifted[:2] = len(model.support_) + 1, -1
    refused(_n_support=shifted)


def test_children_lie_behind_their_parents_and_within_the_tree() -> None:
    inner = np.array([True, False, True, False, False])  # nodes 0 and 2 have children

    def check(left: list[int], right: list[int], asked: tuple[int, int] = (0, 3)) -> None:
        _check_tree(inner, (np.array(left), np.array(right)), np.array(asked), 4)

    check([1, 3], [2, 4])
    for left in ([0, 3], [1, 2], [1, 5], [-1, 3]):
        with pytest.raises(ValueError, match="a child that does not exist"):
            check(left, [2, 4])
        with pytest.raises(ValueError, match="a child that does not exist"):
            check([2, 4], left)
    for asked in ((-1, 3), (0, 4)):
        with pytest.raises(ValueError, match="asks for no feature"):
            check([1, 3], [2, 4], asked)
    leaf = np.array([False])
    nothing = np.array([], dtype=np.int64)
    _check_tree(leaf, (nothing, nothing), nothing, 4)
    with pytest.raises(ValueError, match="has no node"):
        _check_tree(leaf[:0], (nothing, nothing), nothing, 4)


def test_the_trees_of_a_forest_are_for_its_features_and_classes() -> None:
    forest = RandomForestClassifier(2, random_state=0).fit(*cases(3))
    _check_grown(forest.estimators_[0], forest)
    for name, value in (("n_features_in_", 11), ("classes_", NAMES[:2])):
        other = deepcopy(forest)
        setattr(other, name, value)
        with pytest.raises(
            ValueError, match="a tree is for 10 features and 3 classes, and its forest is not"
        ):
            _check_grown(other.estimators_[0], other)


RULE = {
    "edges": [0, 2, 5, 10], "needed": 1, "among": 1, "healthy_index": 0, "with_spread": False, "threshold": 1.0,
    "temperature": 1.0, "slope": 1.0, "intercept": 0.0,
}  # fmt: skip


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
        ({"edges": [0, 10]}, True),
        ({"edges": [1, 10]}, False),
        ({"edges": [0, 9]}, False),
        ({"edges": [0, 5, 5, 10]}, False),
        ({"edges": [0, 6, 5, 10]}, False),
        ({"threshold": float("inf")}, False),
        ({"slope": 1}, False),
    ],
    ids=str,
)
def test_a_rule_fits_its_windows(changes: dict[str, Any], fits: bool) -> None:
    if fits:
        _check_rule(RULE | changes, RECIPE)
    else:
        with pytest.raises(ValueError, match=r"must|do not fill"):
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
