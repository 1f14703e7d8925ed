"""Recipes and motor files of strangers: each gives finite data, or is refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from hostile import refused, refused_or_same
from strange_toml import MOTORS, PARAMETERS, RECIPES, strange

from motor_env import Channel, Recipe, Timing, draw, load_motor, load_recipe
from motor_env.simulation.named_recipes import RECIPES as NAMED, motor_recipe
from motor_env.simulation.sampling import measure_draw


def check_data(recipe: Recipe) -> None:
    for one in (recipe, *(recipe.shifted(shift.name) for shift in recipe.shifts)):
        drawn = draw(one, 1, np.arange(3))
        readings = measure_draw(drawn, one, 1)
        lost = 0.0 if one.field is None else one.field.missing_fraction
        assert np.isfinite(readings).all() or (lost > 0.0 and not np.isinf(readings).any())
        assert np.isfinite(drawn.severity).all()


def test_strange_files_give_finite_data_or_one_sentence(tmp_path: Path) -> None:
    """From reading them or from drawing of them."""
    refusals, seeds = 0, range(40)
    for path, text in zip((tmp_path / "a.toml", tmp_path / "b.toml"), MOTORS, strict=True):
        path.write_text(text, encoding="utf-8")
        check_data(motor_recipe(load_motor(path)))  # good until they are made strange
    for seed in seeds:
        is_motor, path = seed % 3 == 0, tmp_path / f"{seed}.toml"
        text = strange(MOTORS[seed % 2] if is_motor else RECIPES[seed % 2], np.random.default_rng(seed))
        path.write_text(text, encoding="utf-8")

        def drawn(path: Path = path, is_motor: bool = is_motor) -> None:
            check_data(motor_recipe(load_motor(path)) if is_motor else load_recipe(path))

        refusals += refused_or_same(drawn, path, named=False, error=ValueError) != ""
    assert 0.3 * len(seeds) < refusals < len(seeds)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('base = ["bench"]', "base must be the name of a recipe, got ['bench']"),
        (PARAMETERS.replace("2.18", "true"), "motor.resistance_ohm must be a valid number, got True"),
        (PARAMETERS.replace("1.07e-6", "1e-300"), "motor.inertia_kg_m2 must be in"),
        ("[timing]\nduration_s = 1e300\nsampling_rate_hz = 1e300", "sampling_rate_hz must be"),
        ("[field]\nripple_hz = 1e12", "must hold at most 10000 integration steps, got 1.2e+09"),
        ("[[classes]]\nkind = 'winding_short'\nseverity = 5.0", "severity of winding_short must be"),
        ("name = " + "[" * 100_000, "is not TOML: nested too deep"),
        ("starts_per_motor = " + "9" * 5000, "is not TOML"),
        ("# " + "x" * 1_000_000, "is larger than 1 MB"),
        ('motor = "/dev/zero"', "/dev/zero: is no regular file"),
        ("sampling_rate = 3", "unknown key 'sampling_rate' in the recipe"),
    ],
)
def test_a_strange_recipe_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "strange.toml"
    path.write_text(text)
    named = "/dev/zero" if "zero" in text else path.name
    assert sentence in refused(lambda: load_recipe(path), path, named=named)


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        """base = "bench"
motor = "paper"
timing = { sampling_rate_hz = 2000.0, duration_s = 0.05, quiet_s = 0.02 }
sensor.channels = ["current", "speed"]
classes = [{}, { kind = "bearing", severity = 0.1, severity_to = 0.3 }, { kind = "noise", severity = 0.5 }]
[[shifts]]
name = "hot"
field = { temperature_rise_k = [40.0, 60.0] }
"""
    )
    recipe, bench = load_recipe(tmp_path / "mine.toml"), NAMED["bench"]
    assert (recipe.name, recipe.spread, recipe.motor) == ("mine", bench.spread, bench.motor)
    assert recipe.timing == Timing(2000.0, 0.05, 0.02)
    assert recipe.sensor.channels == (Channel.CURRENT, Channel.SPEED)
    assert recipe.class_names == ("healthy", "bearing", "noise_50")
    hot = recipe.shifted("hot").field
    assert hot is not None
    assert hot.temperature_rise_k == (40.0, 60.0)
    (tmp_path / "easier.toml").write_text("base = 'medium'\nsensor.current_noise_a = 0.005")
    assert load_recipe(tmp_path / "easier.toml").classes == load_recipe("medium").classes
