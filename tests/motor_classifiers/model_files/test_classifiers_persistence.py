"""Models on disk: the same probabilities after a round trip, and no stranger's code."""

import json
from pathlib import Path

import numpy as np
import pytest
from hostile import archive_of, members_of, poison, refused
from saved_models import RECIPE, TEST, TRAIN, content, fitted
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from motor_classifiers import (
    METHODS,
    PosteriorNetwork,
    ResidualProjection,
    load_model,
    make_method,
    save_model,
)

# Reaches in: the step that centres starts on a motor's own has no public name, but stands in files.
from motor_classifiers.estimators.reference_starts import RecentredStarts, referenced_starts
from motor_classifiers.model_files.persistence import check_saveable
from motor_env import InputError

UNSAVED = ("physical-svm", "physical-boosting", "physical-forest")


@pytest.mark.parametrize("name", [name for name in METHODS if name not in UNSAVED])
def test_round_trip(name: str, tmp_path: Path) -> None:
    model = fitted(name)
    path = tmp_path / "model"
    save_model(model, RECIPE, name, str(path) if name == "threshold" else path)
    loaded, recipe, method = load_model(str(path) if name == "threshold" else path)
    assert (recipe, method) == (RECIPE, name)
    np.testing.assert_array_equal(loaded.predict_proba(TEST.X), model.predict_proba(TEST.X))
    np.testing.assert_array_equal(loaded.predict(TEST.X), model.predict(TEST.X))


@pytest.mark.parametrize("name", UNSAVED)
def test_methods_of_compiled_steps_are_refused_before_the_training(name: str) -> None:
    with pytest.raises(InputError, match="cannot be saved: a file may hold FeatureUnion, GaussianNB"):
        check_saveable(make_method(name, RECIPE, 0))


def test_round_trip_with_reference_starts(tmp_path: Path) -> None:
    train, test = (referenced_starts(RECIPE, seed, np.arange(150), 2) for seed in (1, 2))
    models = (
        make_pipeline(RecentredStarts(RECIPE), ResidualProjection(RECIPE, 6), LinearDiscriminantAnalysis()),
        PosteriorNetwork(RECIPE, n_references=2, steps=5, batch_size=32, random_state=0),
    )
    for n, model in enumerate(models):
        model.fit(train.X, train.class_name)
        save_model(model, RECIPE, "referenced", tmp_path / str(n))
        loaded = load_model(tmp_path / str(n))[0]
        np.testing.assert_array_equal(loaded.predict_proba(test.X), model.predict_proba(test.X))


def test_a_case_that_is_no_start_of_the_recipe_is_refused(tmp_path: Path) -> None:
    model = make_pipeline(ResidualProjection(None, 6), LinearDiscriminantAnalysis())
    save_model(model.fit(np.tile(TRAIN.X, 2), TRAIN.class_name), RECIPE, "longer", tmp_path / "model")
    sentence = refused(lambda: load_model(tmp_path / "model"), tmp_path / "model")
    assert "200 values are no starts of its recipe" in sentence


def poisoned_files(mark: Path) -> dict[str, bytes]:
    """Attacks by name; none may touch the mark."""
    members = members_of(content("physical-lda"))
    schema = json.loads(members["schema.json"])
    schema |= {"__class__": "Popen", "__module__": "subprocess", "__loader__": "TypeNode"}
    header = b'{"a":{"dtype":"F64","shape":[1000000000],"data_offsets":[0,8]}}'
    return {
        "pickle": poison(mark),
        "torch archive with a pickle": archive_of({"archive/data.pkl": poison(mark)}),
        "skops with a foreign type": archive_of(members | {"schema.json": json.dumps(schema).encode()}),
        "safetensors that lie of their size": len(header).to_bytes(8, "little") + header + b"\0" * 8,
        "cut short": content("physical-lda")[:1000],
        "empty": b"",
        "text": b"time_s,current_a\n0,1\n",
    }


def test_poisoned_files_are_refused_with_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "poisoned"
    for file in poisoned_files(tmp_path / "mark").values():
        path.write_bytes(file)
        assert refused(lambda: load_model(path), path).startswith(str(path))
    assert not (tmp_path / "mark").exists()
