"""Recipes and motor files of strangers: each gives finite data, or is refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hostile import refused, refused_or_same
from strange_toml import MOTORS, PARAMETERS, RECIPES, strange

from motor_env import Recipe, draw, load_motor, load_recipe
from motor_env.simulation.named_recipes import changed_recipe, motor_recipe
from motor_env.simulation.sampling import measure_draw

N_MUTATIONS = 300
N_QUICK = 40


def check_data(recipe: Recipe) -> None:
    for one in (recipe, *(recipe.shifted(shift.name) for shift in recipe.shifts)):
        drawn = draw(one, 1, np.arange(3))
        readings = measure_draw(drawn, one, 1)
        lost = 0.0 if one.field is None else one.field.missing_fraction
        assert np.isfinite(readings).all() or (lost > 0.0 and not np.isinf(readings).any())
        assert np.isfinite(drawn.severity).all()


def check_mutations(folder: Path, seeds: range) -> None:
    """Each file gives finite data, or a sentence, from reading it or from drawing of it."""
    refusals = 0
    for seed in seeds:
        is_motor, path = seed % 3 == 0, folder / f"{seed}.toml"
        text = strange(MOTORS[seed % 2] if is_motor else RECIPES[seed % 2], np.random.default_rng(seed))
        path.write_text(text, encoding="utf-8")

        def drawn(path: Path = path, is_motor: bool = is_motor) -> None:
            check_data(motor_recipe(load_motor(path)) if is_motor else load_recipe(path))

        refusals += refused_or_same(drawn, path, named=False, error=ValueError) != ""
    assert 0.3 * len(seeds) < refusals < len(seeds)


@pytest.mark.parametrize("text", MOTORS)
def test_the_motor_files_are_good_until_they_are_made_strange(tmp_path: Path, text: str) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(text, encoding="utf-8")
    check_data(motor_recipe(load_motor(path)))


def test_strange_files_give_finite_data_or_one_sentence(tmp_path: Path) -> None:
    check_mutations(tmp_path, range(N_QUICK))


@pytest.mark.long
def test_all_strange_files_give_finite_data_or_one_sentence(tmp_path: Path) -> None:
    check_mutations(tmp_path, range(N_MUTATIONS))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('base = ["bench"]', "base must be the name of a recipe, got ['bench']"),
        (PARAMETERS.replace("2.18", "true"), "motor.resistance_ohm must be a valid number, got True"),
        (
            PARAMETERS.replace("1.07e-6", "1e-300"),
            "motor.inertia_kg_m2 must be in 1e-15 .. 1e+12, got 1e-300",
        ),
        ("[supply]\nvoltage_v = 1e300", "voltage_v must be finite and at most 1e+100, got 1e+300"),
        ("[sensor]\ncurrent_noise_a = 1e39", "sensor.current_noise_a must be in -1e+12 .. 1e+12"),
        ("[field]\ntemperature_rise_k = [0.0, 1e308]", "field.temperature_rise_k must be in -250 .. 900"),
        ("starts_per_motor = 1000000000000000000000", "starts_per_motor must be a whole number in"),
        ("[timing]\nduration_s = 1e6", "must hold at most 10000000 samples at 10000 Hz, got 1e+10"),
        (
            "[timing]\nduration_s = 1e300\nsampling_rate_hz = 1e300",
            "sampling_rate_hz must be finite and > 0 and at most 1e+100, got 1e+300",
        ),
        ("[field]\nripple_hz = 1e12", "must hold at most 10000 integration steps, got 1.2e+09"),
        (
            "[[classes]]\nkind = 'winding_short'\nseverity = 5.0",
            "severity of winding_short must be < 1, got 5",
        ),
        ("name = " + "[" * 100_000, "is not TOML: nested too deep"),
        ("starts_per_motor = " + "9" * 5000, "is not TOML"),
        ("# " + "x" * 1_000_000, "is larger than 1 MB"),
        ('motor = "/dev/zero"', "/dev/zero: is no regular file"),
        ("sampling_rate = 3", "unknown key 'sampling_rate' in the recipe"),
        ("[timing]\nrate = 3", "unknown key 'rate' in timing"),
        ("[timing]\nduration_s = 'long'", "timing.duration_s must be a valid number, got 'long'"),
        ("[timing]\nduration_s = -1", "duration_s must be finite and > 0, got -1"),
        ("[[classes]]\nkind = 'rust'", "classes[0].kind: kind must be one of bearing"),
        ("[spread]\nsupply = 3.0", "spread of supply must be <= 0.14, got 3"),
        ("[field]\nramp_s = [2.0, 1.0]", "field.ramp_s must be a finite [low, high]"),
        ("[field]\nramp_s = 2.0", "field.ramp_s must be a valid array, got 2.0"),
        ("healthy_starts = 2", "healthy_starts must be in 0 .. starts_per_motor (1)"),
        ("base = 'nope'", "recipe must be one of"),
        ("a = [", "is not TOML"),
    ],
)
def test_a_strange_recipe_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "strange.toml"
    path.write_text(text)
    named = "/dev/zero" if "zero" in text else path.name
    assert sentence in refused(lambda: load_recipe(path), path, named=named)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("resistance_ohm = 2.18", "resistance_ohm = true"),
        ("torque_constant_mnm_per_a = 23.5", "torque_constant_mnm_per_a = 1e300"),
        ("rotor_inertia_g_cm2 = 10.7", "rotor_inertia_g_cm2 = 1e-310"),
        ("pieces = 5", "pieces = true"),
        ("pieces = 5", "pieces = 5.5"),
        ("values = [2.2, 2.4e-4]", "values = [2.2]"),
        ("[4e-4, 0.0]", "[4e-4]"),
        ("degrees_of_freedom = 8.0", "degrees_of_freedom = 1e300"),
    ],
)
def test_a_strange_motor_is_one_sentence(tmp_path: Path, old: str, new: str) -> None:
    path, good = tmp_path / "strange.toml", MOTORS[0]
    assert old in good
    path.write_text(good.replace(old, new))
    refused(lambda: load_motor(path), path)


def test_an_option_is_held_to_the_same_bounds() -> None:
    with pytest.raises(ValueError, match=r"voltage_v must be finite and at most 1e\+100, got 1e\+300"):
        changed_recipe(load_recipe("bench"), voltage_v=1e300)
