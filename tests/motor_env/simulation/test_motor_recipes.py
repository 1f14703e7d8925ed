from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_env import PAPER_MOTOR
from motor_env.motor.data_sheet import MotorFile, StartReference, load_motor, save_motor
from motor_env.simulation.motor_recipes import recipe_of
from motor_env.simulation.recipes import draw, measure_draw

SHEET = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml")
REFERENCE = StartReference(
    starts=5,
    degrees_of_freedom=8.0,
    quantities=("R", "L", "K^2/J", "B/J"),
    values=np.array([2.2, 2.4e-4, 520.0, 1.1]),
    log_covariance=np.diag(np.square([0.02, 0.05, 0.04, 0.03])),
    log_noise=-4.0,
    log_noise_sd=0.1,
    model=("supply_ramp", "sensor_lag"),
    model_low=(0.001, 0.0002),
    model_high=(0.002, 0.0002),
    sampling_rate_hz=6_000.0,
    duration_s=0.08,
    quiet_s=0.02,
)
COMMISSIONED = MotorFile("m", "commissioned", PAPER_MOTOR, 12.0, reference=REFERENCE)


def test_a_data_sheet_gives_its_tolerances() -> None:
    recipe = recipe_of(SHEET)
    assert recipe.motor == SHEET.parameters
    assert recipe.spread.resistance == pytest.approx(np.hypot(0.02, 0.0393))
    assert recipe.spread.friction == 0.03
    assert recipe.sensor.current_noise_a == 0.02
    assert recipe.field is None


def test_a_commissioned_motor_gives_the_spread_of_its_starts(tmp_path: Path) -> None:
    save_motor(COMMISSIONED, tmp_path / "m.toml")
    recipe = recipe_of(load_motor(tmp_path / "m.toml"))
    wider = np.sqrt(8.0 / 6.0)
    assert recipe.spread.resistance == pytest.approx(0.02 * wider)
    assert recipe.spread.constants == pytest.approx(0.02 * wider)
    assert recipe.spread.friction == pytest.approx(0.03 * wider)
    assert recipe.spread.inertia == 0.0
    assert recipe.sensor.current_noise_a == pytest.approx(np.exp(-4.0))
    assert recipe.timing.sampling_rate_hz == 6_000.0
    assert recipe.timing.quiet_s == 0.02
    assert recipe.field is not None
    assert recipe.field.ramp_s == (0.001, 0.002)
    assert recipe.field.sensor_lag_s == pytest.approx(0.0002)


def test_drawn_starts_scatter_as_the_commissioned_ones() -> None:
    recipe = recipe_of(
        replace(COMMISSIONED, reference=replace(REFERENCE, model=(), model_low=(), model_high=()))
    )
    drawn = draw(recipe, 1, np.arange(4000))
    resistance = drawn.factors[:, 1]
    constants = np.log(drawn.factors[:, 2] ** 2 / drawn.factors[:, 3])
    wider = np.sqrt(8.0 / 6.0)
    assert resistance.std() == pytest.approx(0.02 * wider, rel=0.05)
    assert constants.std() == pytest.approx(0.04 * wider, rel=0.05)


def test_its_starts_can_be_measured() -> None:
    readings = measure_draw(draw(recipe_of(COMMISSIONED), 1, [0, 1]), recipe_of(COMMISSIONED), 1)
    assert readings.shape == (2, 1, 600)
    assert np.isfinite(readings).all()
