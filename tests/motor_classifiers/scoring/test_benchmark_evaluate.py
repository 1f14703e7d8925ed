"""`motor-classifiers evaluate`: scores, comparison in pairs with the limit, confusion matrix; from a URL too."""

import json
from pathlib import Path

import numpy as np
import pytest

from motor_classifiers import load_model, make_method, save_model
from motor_classifiers.cli.main import main
from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets import generate_dataset, load
from motor_env import Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))


@pytest.fixture(scope="module")
def model_and_data(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A trained model and the data set it was trained on."""
    folder = tmp_path_factory.mktemp("evaluate")
    generate_dataset(RECIPE, 500, 3, folder / "data")
    train = load(folder / "data", "train")
    model = make_method("residual-qda", RECIPE, 0).fit(train.X, train.class_name)
    save_model(model, RECIPE, "residual-qda", folder / "qda.model")
    return folder / "qda.model", folder / "data"


def test_text_tells_confusion_and_the_check(
    model_and_data: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = model_and_data
    assert main(["evaluate", str(model), str(data)]) == 0
    told = capsys.readouterr().out
    fitted, recipe, _ = load_model(model)
    test = load(data, "test")
    decided = in_recipe_order(fitted, fitted.predict_proba(test.X), recipe).argmax(axis=1)
    counts = np.zeros((5, 5), dtype=int)
    np.add.at(counts, (test.class_index, decided), 1)
    rows = [line.split() for line in told.splitlines()[-5:]]
    assert [row[1] for row in rows] == list(RECIPE.class_names)
    np.testing.assert_array_equal([[int(count) for count in row[2:]] for row in rows], counts)
    assert "paired" in told
    assert "Bayes limit accuracy" in told


def test_a_url_is_as_good_as_a_folder(
    model_and_data: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = model_and_data
    answers = []
    for place in (str(data), data.as_uri()):
        assert main(["evaluate", str(model), place, "--json"]) == 0
        answers.append(json.loads(capsys.readouterr().out))
    here, there = answers
    assert here["dataset"] != there["dataset"]
    assert {**here, "dataset": ""} == {**there, "dataset": ""}
    assert here["only_method_right"] <= here["n_test"]
    assert sum(map(sum, here["confusion"])) == here["n_test"]
