"""Recipes to dictionaries and back, and from TOML."""

from pathlib import Path

import pytest
from hostile import refused

from motor_env import Channel, FaultKind, load_recipe
from motor_env.simulation.named_recipes import RECIPES, recipe_from_dict, recipe_to_dict

EXAMPLE = """
base = "bench"
motor = "paper"
starts_per_motor = 3
healthy_starts = 1
[timing]
sampling_rate_hz = 2000
quiet_s = 0.02
[sensor]
channels = ["current", "speed"]
speed_noise_rad_s = 0.5
[field]
temperature_rise_k = [0.0, 30.0]
missing_fraction = 0.01
[[classes]]
[[classes]]
kind = "bearing"
severity = 0.05
severity_to = 0.3
weight = 2.0
[[classes.also]]
kind = "noise"
severity = 0.5
[[shifts]]
name = "hot"
field = { temperature_rise_k = [40.0, 60.0] }
"""


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_recipe_survives_its_dictionary(name: str) -> None:
    assert recipe_from_dict(recipe_to_dict(RECIPES[name])) == RECIPES[name]


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(EXAMPLE)
    recipe = load_recipe(tmp_path / "mine.toml")
    assert recipe.name == "mine"
    assert recipe.spread == RECIPES["bench"].spread
    assert recipe.timing.sampling_rate_hz == 2000.0
    assert recipe.timing.duration_s == RECIPES["bench"].timing.duration_s
    assert recipe.sensor.channels == (Channel.CURRENT, Channel.SPEED)
    assert recipe.sensor.speed_noise_rad_s == 0.5
    assert recipe.class_names == ("healthy", "bearing+noise_50")
    assert recipe.classes[1].also[0].kind is FaultKind.NOISE
    hot = recipe.shifted("hot").field
    assert hot is not None
    assert hot.temperature_rise_k == (40.0, 60.0)
    (tmp_path / "easier.toml").write_text("base = 'medium'\nsensor.current_noise_a = 0.005")
    assert load_recipe(tmp_path / "easier.toml").classes == load_recipe("medium").classes


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    assert "no such recipe file" in refused(lambda: load_recipe(path), path)
