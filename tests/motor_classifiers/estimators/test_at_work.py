"""Classifiers and data sets of motors at work."""

from pathlib import Path

import numpy as np
import pytest

from motor_classifiers import METHODS, PhysicalFeatures, evaluate_model, load_model, make_method, save_model
from motor_classifiers.estimators.methods import AT_WORK
from motor_datasets import generate_arrays, generate_dataset, load
from motor_env import load_recipe

OPERATION = load_recipe("operation")


def test_a_data_set_is_written_learned_from_and_judged(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    generate_dataset(OPERATION, 400, 3, folder)
    assert "where measured, `speed_rad_s`, and `applied_voltage_v`" in (folder / "README.md").read_text(
        "utf-8"
    )
    train, test = (load(str(folder), split) for split in ("train", "test"))
    np.testing.assert_array_equal(test.X, generate_arrays(OPERATION, 3, test.case_id).X)
    assert test.X.shape[1:] == (2, 500)
    assert np.ptp(test.parameters["fan_n_m_s2"]) > 0.0
    model = make_method("physical-logistic", OPERATION, 0).fit(train.X, train.class_name)
    save_model(model, OPERATION, "physical-logistic", tmp_path / "a.model")
    scored = evaluate_model(load_model(tmp_path / "a.model")[0], OPERATION, test, 0)
    assert scored["accuracy"] > 0.6
    assert scored["bayes_accuracy"] > 0.6
    assert scored["bayes_is_estimate"]


def test_columns_have_names() -> None:
    X = generate_arrays(OPERATION, 1, 3).X
    features = PhysicalFeatures(OPERATION).fit(X)
    assert features.transform(X).shape == (3, len(features.get_feature_names_out()))


@pytest.mark.parametrize("name", [name for name in METHODS if name not in AT_WORK])
def test_what_needs_a_step_says_so(name: str) -> None:
    cases = generate_arrays(OPERATION, 1, 40)
    method = METHODS[name]
    with pytest.raises(ValueError, match="recipe operation has a voltage of its own in each case"):
        method.make(OPERATION, 0).fit(cases.X, cases.class_name)
