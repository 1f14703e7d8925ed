"""Models on disk: the same probabilities after a round trip, and no stranger's code."""

import io
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from motor_classifiers.estimators.features import ResidualProjection
from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.reference_starts import RecentredStarts, referenced_starts
from motor_classifiers.model_files.persistence import load_model, save_model
from motor_datasets.generate import generate_arrays
from motor_env.errors import InputError
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.simulate import Timing

RECIPE = named_recipe("bench", timing=Timing(1_000.0, 0.1))
TRAIN = generate_arrays(RECIPE, 1, 200)
TEST = generate_arrays(RECIPE, 2, 20)

QUICK = {
    "posterior-network": {"steps": 5, "batch_size": 32},
    "residual-network": {"epochs": 1, "stem": 4, "width": 4},
    "physical-boosting": {"classify__estimator__max_iter": 5},
    "physical-forest": {"classify__n_estimators": 10},
}


@pytest.mark.parametrize("name", METHODS)
def test_round_trip(name: str, tmp_path: Path) -> None:
    unfitted = make_method(name, RECIPE, 0).set_params(**QUICK.get(name, {}))
    model = METHODS[name].train(unfitted, TRAIN.X, TRAIN.class_name)
    save_model(model, RECIPE, name, tmp_path / "model")
    loaded, recipe, method = load_model(tmp_path / "model")
    assert (recipe, method) == (RECIPE, name)
    np.testing.assert_array_equal(loaded.predict_proba(TEST.X), model.predict_proba(TEST.X))
    np.testing.assert_array_equal(loaded.predict(TEST.X), model.predict(TEST.X))


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
    with pytest.raises(InputError, match="200 values are no starts of its recipe"):
        load_model(tmp_path / "model")


class Poison:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return (Path.touch, (self.mark,))


def poisoned_files(folder: Path) -> dict[str, bytes]:
    """Attacks by name; none may touch the mark."""
    mark = folder / "mark"
    model = make_method("physical-lda", RECIPE, 0).fit(TRAIN.X, TRAIN.class_name)
    save_model(model, RECIPE, "physical-lda", folder / "good")
    rewritten = io.BytesIO()
    with zipfile.ZipFile(folder / "good") as source, zipfile.ZipFile(rewritten, "w") as target:
        for member in source.namelist():
            text = source.read(member)
            if member == "schema.json":
                schema = json.loads(text)
                schema |= {"__class__": "Popen", "__module__": "subprocess", "__loader__": "TypeNode"}
                text = json.dumps(schema).encode()
            target.writestr(member, text)
    zipped_pickle = io.BytesIO()
    with zipfile.ZipFile(zipped_pickle, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(Poison(mark)))
    header = b'{"a":{"dtype":"F64","shape":[1000000000],"data_offsets":[0,8]}}'
    return {
        "pickle": pickle.dumps(Poison(mark)),
        "torch archive with a pickle": zipped_pickle.getvalue(),
        "skops with a foreign type": rewritten.getvalue(),
        "safetensors that lie of their size": len(header).to_bytes(8, "little") + header + b"\0" * 8,
        "cut short": (folder / "good").read_bytes()[:1000],
        "empty": b"",
        "text": b"time_s,current_a\n0,1\n",
    }


ATTACKS = (
    "pickle", "torch archive with a pickle", "skops with a foreign type",
    "safetensors that lie of their size", "cut short", "empty", "text",
)  # fmt: skip


def test_poisoned_files_are_refused_with_one_sentence(tmp_path: Path) -> None:
    files = poisoned_files(tmp_path)
    assert set(files) == set(ATTACKS)
    for content in files.values():
        (tmp_path / "poisoned").write_bytes(content)
        with pytest.raises(InputError) as caught:
            load_model(tmp_path / "poisoned")
        assert str(caught.value).startswith(str(tmp_path / "poisoned"))
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "mark").exists()


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_model(tmp_path / "none")
