"""The shipped network, the command that trains such networks, and opinions beside the model-based verdict."""

import json
from pathlib import Path

import numpy as np
import pytest
from trust_figures import severity_figures

from motor_classifiers import PosteriorNetwork, evaluate_model, load_model
from motor_classifiers.cli.main import main

# Reaches in: pins the recipe that `train --motor` makes of a data sheet; training on it takes minutes.
from motor_classifiers.cli.training import network_recipe
from motor_classifiers.model_files.persistence import PRETRAINED
from motor_datasets import generate_arrays
from motor_env import load_motor, load_recipe

ROOT = Path(__file__).resolve().parents[3]
CAPTURE = str(ROOT / "examples" / "startup_capture.csv")
SHEET = str(ROOT / "examples" / "motor.toml")


def test_the_shipped_network_is_small_and_near_the_limit() -> None:
    assert PRETRAINED.stat().st_size < 300_000
    model, recipe, method = load_model(PRETRAINED)
    assert isinstance(model, PosteriorNetwork)
    assert (recipe, method) == (load_recipe("bench"), "posterior-network")
    scored = evaluate_model(model, recipe, generate_arrays(recipe, 4, 1000), 0)
    assert scored["below_bayes_low"] < 0.003
    assert scored["p_above_bayes"] > 0.001
    assert scored["log_loss"] < 1.02 * scored["bayes_log_loss"]
    for prior in model.severity_priors_:
        told = severity_figures(model, recipe, prior, 4, 100)
        assert told["network"]["rmse"] < 1.05 * told["limit"]["rmse"]


def test_predict_needs_no_model_and_tells_both_verdicts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", CAPTURE]) == 1
    first, second = capsys.readouterr().out.strip().splitlines()
    assert first.startswith(f"{CAPTURE}: bearing, probability ")
    assert second.strip().startswith("motor-env diagnose: bearing, confidence ")
    assert main(["predict", CAPTURE, "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)
    assert row["verdict"] == row["model_based"]["verdict"] == "bearing"
    low, high = row["severity_interval"]
    assert 0.0 <= low < row["severity"] < high <= 0.3
    assert row["model_based"]["severity_interval"][0] < row["model_based"]["severity"]


def test_training_for_a_motor_is_one_command_and_repeats_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ["--steps", "4", "--duration-s", "0.01", "--sampling-rate-hz", "10000"]
    for name in ("first", "second"):
        assert main(["train", "--motor", SHEET, "--out", str(tmp_path / name), *quick, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told == {"method": "posterior-network", "n_train": 7168, "out": str(tmp_path / name)}
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()
    model, recipe, _ = load_model(tmp_path / "first")
    assert model.classes_.tolist() == ["bearing", "healthy", "winding_contact", "winding_short"]
    assert model.noise_range == (0.15, 5.0)
    assert recipe.timing.duration_s == 0.01


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give one of a data set, --motor and --recipe"),
        (["--motor", "paper", "--recipe", "bench"], "give one of"),
        (["--motor", "paper"], "gives no nominal_voltage_v; say --voltage"),
        (["--motor", "none.toml"], "no such motor file"),
        (["--recipe", "none"], "recipe must be one of"),
        (["--recipe", "bench", "--noise-range", "1"], "must be two factors"),
        (["--recipe", "bench", "--noise-range", "2,1"], "noise_range must be 0 < low < high"),
        (["--recipe", "bench-full", "--noise-range", "1,2"], "they look the same"),
        (["--recipe", "bench", "--method", "residual-qda"], "learns from a data set"),
        (["--recipe", "bench", "--current-noise-a", "-1"], "current_noise_a must be"),
    ],
)
def test_wrong_training_is_one_sentence(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *arguments, "--out", "model"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_recipe_of_a_data_sheet() -> None:
    motor = load_motor(SHEET)
    recipe = network_recipe(motor)
    # The temperature moves the copper by 3.9 % and the magnets by 1 %.
    assert recipe.spread.resistance == pytest.approx(np.hypot(0.02, 0.0393))
    assert recipe.spread.constants == pytest.approx(np.hypot(0.01, 0.01))
    assert (recipe.spread.friction, recipe.spread.supply) == (0.03, 0.01)
    assert recipe.supply.voltage_v == 12.0
    assert recipe.sensor.current_noise_a == 0.02
    assert recipe.timing.duration_s == pytest.approx(25.0 * 4.09e-3, rel=0.1)
    assert recipe.timing.n_samples == pytest.approx(1000, abs=2)
    assert recipe.class_names == ("healthy", "bearing", "winding_contact", "winding_short")
    assert {(c.severity, c.severity_to) for c in recipe.classes[1:]} == {(0.05, 0.30)}
    np.testing.assert_allclose(recipe.class_probabilities, 0.25)
    assert (recipe.channels, recipe.field) == (("current",), None)
