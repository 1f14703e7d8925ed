"""The shipped network: opinions beside the model-based verdict, its training, its graph."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from motor_classifiers import PosteriorNetwork, load_model, save_model
from motor_classifiers.cli.main import main

# Reaches in: the recipe that `train --motor` makes of a data sheet; training on it takes minutes.
from motor_classifiers.cli.training import network_recipe
from motor_classifiers.model_files.onnx_export import INPUT, OUTPUTS, Deployed
from motor_classifiers.model_files.persistence import PRETRAINED
from motor_datasets import generate_arrays
from motor_env import Timing, diagnose, load_motor, load_recipe

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
CAPTURE, SHEET = str(EXAMPLES / "startup_capture.csv"), str(EXAMPLES / "motor.toml")


def test_predict_needs_no_model_and_tells_both_verdicts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", CAPTURE]) == 1
    first, second = capsys.readouterr().out.strip().splitlines()
    assert first.startswith(f"{CAPTURE}: bearing, probability ")
    assert second.strip().startswith("motor-env diagnose: bearing, confidence ")


def test_predict_with_a_motor_file_has_the_diagnosis_of_motor_env(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", CAPTURE, "--motor", SHEET, "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)
    low, high = row["severity_interval"]
    assert row["verdict"] == "bearing"
    assert 0.0 <= low < row["severity"] < high <= 0.3
    found, told = diagnose(Path(CAPTURE), Path(SHEET)), row["model_based"]
    assert (told["verdict"], told["severity"]) == ("bearing", pytest.approx(found.severity))
    assert told["severity_interval"] == pytest.approx(list(found.severity_interval or ()))


def test_training_for_a_motor_is_one_command_and_repeats_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ["--steps", "4", "--duration-s", "0.01", "--sampling-rate-hz", "10000", "--json"]
    for name in ("first", "second"):
        assert main(["train", "--motor", SHEET, "--out", str(tmp_path / name), *quick]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told == {"method": "posterior-network", "n_train": 7168, "out": str(tmp_path / name)}
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()
    model, recipe, _ = load_model(tmp_path / "first")
    assert model.classes_.tolist() == ["bearing", "healthy", "winding_contact", "winding_short"]
    assert model.noise_range == (0.15, 5.0)
    assert recipe.timing.duration_s == 0.01


def test_recipe_of_a_data_sheet() -> None:
    recipe = network_recipe(load_motor(SHEET))
    # The temperature moves the copper by 3.9 % and the magnets by 1 %.
    assert recipe.spread.resistance == pytest.approx(np.hypot(0.02, 0.0393))
    assert recipe.spread.constants == pytest.approx(np.hypot(0.01, 0.01))
    assert (recipe.spread.friction, recipe.spread.supply) == (0.03, 0.01)
    assert (recipe.supply.voltage_v, recipe.sensor.current_noise_a) == (12.0, 0.02)
    assert recipe.timing.duration_s == pytest.approx(25.0 * 4.09e-3, rel=0.1)
    assert recipe.timing.n_samples == pytest.approx(1000, abs=2)
    assert recipe.class_names == ("healthy", "bearing", "winding_contact", "winding_short")
    assert {(c.severity, c.severity_to) for c in recipe.classes[1:]} == {(0.05, 0.30)}
    np.testing.assert_allclose(recipe.class_probabilities, 0.25)
    assert (recipe.channels, recipe.field) == (("current",), None)


SHORT = load_recipe("bench-full", timing=Timing(1_000.0, 0.02))


def test_the_graph_agrees_with_torch_and_the_estimator(tmp_path: Path) -> None:
    path = tmp_path / "paper.onnx"
    assert main(["export", "-o", str(path)]) == 0
    assert list(tmp_path.iterdir()) == [path]
    graph, session = onnx.load(path), onnxruntime.InferenceSession(str(path))
    onnx.checker.check_model(graph, full_check=True)
    model, recipe, _ = load_model(PRETRAINED)
    assert isinstance(model, PosteriorNetwork)
    for n_cases in (1, 300):
        X = generate_arrays(recipe, 3, n_cases).X
        found = session.run(list(OUTPUTS), {INPUT: X})
        with torch.inference_mode():
            expected = [value.numpy() for value in Deployed(model)(torch.from_numpy(X))]
        kinds = [model.predict_severity(X, str(prior.kind))[1:] for prior in model.severity_priors_]
        of_estimator = [
            model.predict_proba(X),
            *(np.stack(each, axis=1) for each in zip(*kinds, strict=True)),
        ]
        for value, one, other in zip(found, expected, of_estimator, strict=True):
            np.testing.assert_allclose(value, one, rtol=0.0, atol=1e-5)
            np.testing.assert_allclose(value, other, rtol=0.0, atol=1e-5)
    words = {entry.key: json.loads(entry.value) for entry in graph.metadata_props}
    assert words["classes"] == model.classes_.tolist()
    assert words["kinds"] == ["bearing", "winding_contact", "winding_short"]
    assert words["recipe"]["name"] == recipe.name


@pytest.mark.long
def test_a_network_that_looks_at_the_noise(tmp_path: Path) -> None:
    """Its graph has one more coordinate, and a kind whose range is not 30 %."""
    model = PosteriorNetwork(SHORT, steps=20, batch_size=64, n_components=6, random_state=0).fit_stream()
    save_model(model, SHORT, "posterior-network", tmp_path / "model")
    assert main(["export", str(tmp_path / "model"), "-o", str(tmp_path / "graph.onnx")]) == 0
    X = generate_arrays(SHORT, 3, 50).X
    probabilities, severity, *_ = onnxruntime.InferenceSession(str(tmp_path / "graph.onnx")).run(
        None, {INPUT: X}
    )
    np.testing.assert_allclose(probabilities, model.predict_proba(X), rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(severity[:, 3], model.predict_severity(X, "noise").mean, rtol=0.0, atol=1e-5)
