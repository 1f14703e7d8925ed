from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, InputError, Motor, Timing, draw, load_motor
from motor_env.motor.data_sheet import Tolerance, save_motor
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.simulation.named_recipes import motor_recipe, settling_timing
from motor_env.simulation.sampling import measure_draw

SHEET = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml")
STARTS = Starts(
    log_noise=-4.0,
    log_noise_sd=0.1,
    model=("supply_ramp", "sensor_lag"),
    model_low=(0.001, 0.0002),
    model_high=(0.002, 0.0002),
    sampling_rate_hz=6_000.0,
    duration_s=0.08,
    quiet_s=0.02,
)
HEALTHY = Healthy(
    pieces=5,
    degrees_of_freedom=8.0,
    quantities=("R", "L", "K^2/J", "B/J"),
    values=np.array([2.2, 2.4e-4, 520.0, 1.1]),
    log_covariance=np.diag(np.square([0.02, 0.05, 0.04, 0.03])),
    starts=STARTS,
)
PLAIN = replace(HEALTHY, starts=replace(STARTS, model=(), model_low=(), model_high=()))
COMMISSIONED = Motor("m", "commissioned", PAPER_MOTOR, 12.0, healthy=HEALTHY)


def test_a_data_sheet_gives_its_tolerances() -> None:
    recipe = motor_recipe(SHEET)
    assert recipe.motor == SHEET.parameters
    assert recipe.spread.resistance == pytest.approx(np.hypot(0.02, 0.0393))
    assert recipe.spread.friction == 0.03
    assert recipe.sensor.current_noise_a == 0.02
    assert recipe.field is None


def test_a_commissioned_motor_gives_the_spread_of_its_starts(tmp_path: Path) -> None:
    save_motor(COMMISSIONED, tmp_path / "m.toml")
    recipe = motor_recipe(load_motor(tmp_path / "m.toml"))
    wider = np.sqrt(8.0 / 6.0)
    assert recipe.spread.resistance == pytest.approx(0.02 * wider)
    assert recipe.spread.constants == pytest.approx(0.02 * wider)
    assert recipe.spread.friction == pytest.approx(0.03 * wider)
    assert (recipe.spread.inertia, recipe.spread.supply) == (0.0, 0.01)
    assert recipe.sensor.current_noise_a == pytest.approx(np.exp(-4.0))
    assert recipe.timing.sampling_rate_hz == 6_000.0
    assert recipe.timing.quiet_s == 0.02
    assert recipe.field is not None
    assert recipe.field.ramp_s == (0.001, 0.002)
    assert recipe.field.sensor_lag_s == pytest.approx(0.0002)


def test_drawn_starts_scatter_as_the_commissioned_ones() -> None:
    recipe = motor_recipe(replace(COMMISSIONED, healthy=PLAIN))
    drawn = draw(recipe, 1, np.arange(4000))
    resistance = drawn.factors[:, 1]
    constants = np.log(drawn.factors[:, 2] ** 2 / drawn.factors[:, 3])
    wider = np.sqrt(8.0 / 6.0)
    assert resistance.std() == pytest.approx(0.02 * wider, rel=0.05)
    assert constants.std() == pytest.approx(0.04 * wider, rel=0.05)


def test_its_starts_can_be_measured() -> None:
    readings = measure_draw(draw(motor_recipe(COMMISSIONED), 1, [0, 1]), motor_recipe(COMMISSIONED), 1)
    assert readings.shape == (2, 1, 600)
    assert np.isfinite(readings).all()


def test_a_slow_motor_without_a_noise() -> None:
    heavy = PAPER_MOTOR.scaled(inertia_kg_m2=100.0)
    recipe = motor_recipe(Motor("big one!", "data_sheet", heavy, nominal_voltage_v=12.0))
    assert recipe.name == "big_one"
    assert recipe.timing.duration_s == pytest.approx(10.0, rel=0.1)
    assert recipe.sensor.current_noise_a == pytest.approx(0.022)


def test_defaults_to_two_digits() -> None:
    """0.4 % of the stall current and 25 mechanical time constants, just below where the next digit begins."""
    volts = 2.18 * 0.02249 / 0.004
    sheet = Motor("m", "data_sheet", PAPER_MOTOR, volts)
    assert motor_recipe(sheet).sensor.current_noise_a == 0.022
    assert motor_recipe(sheet, voltage_v=volts * 1.001).sensor.current_noise_a == 0.023
    slow = PAPER_MOTOR.scaled(inertia_kg_m2=2.49 / 25.0 / PAPER_MOTOR.mechanical_time_constant_s)
    timing = settling_timing(Motor("m", "data_sheet", slow))
    assert timing == Timing(400.0, 2.5)
    slower = slow.scaled(inertia_kg_m2=2.551 / 2.49)
    assert settling_timing(Motor("m", "data_sheet", slower)).duration_s == 2.6
    assert settling_timing(sheet, 0.3) == Timing(3333.0, 0.3)


def test_dry_friction_brushes_and_a_lag_become_a_field() -> None:
    """Dry friction relative to the viscous torque at no-load speed, the lag in the geometric middle of its range."""
    healthy = replace(HEALTHY, starts=replace(STARTS, model_low=(0.001, 0.0001), model_high=(0.002, 0.0004)))
    motor = replace(COMMISSIONED, healthy=healthy, coulomb_friction_n_m=1e-4, brush_drop_v=0.3)
    field = motor_recipe(motor).field
    assert field is not None
    ratio = 1e-4 / (12e-7 * 12.0 / 0.02352)
    assert field.coulomb_ratio == pytest.approx((ratio, ratio))
    assert field.brush_drop_v == (0.3, 0.3)
    assert field.ramp_s == (0.001, 0.002)
    assert field.trigger_jitter == (0.0, 0.99)
    assert field.sensor_lag_s == pytest.approx(2e-4)


def test_few_degrees_of_freedom_have_the_spread_of_three() -> None:
    """A Student t of two or fewer has no variance."""
    few = motor_recipe(replace(COMMISSIONED, healthy=replace(PLAIN, degrees_of_freedom=2.0)))
    assert few.spread.resistance == pytest.approx(0.02 * np.sqrt(3.0))


def test_what_cannot_be_drawn_is_refused() -> None:
    loose = Motor("loose", "data_sheet", PAPER_MOTOR, 12.0, Tolerance(friction=0.2))
    with pytest.raises(InputError, match=r"a tolerance of 0\.2 on friction"):
        motor_recipe(loose)
    with pytest.raises(InputError, match=r"gives no nominal_voltage_v; say --voltage"):
        motor_recipe(replace(loose, nominal_voltage_v=None))


def test_ratios_per_volt_hold_the_scatter_of_the_supply() -> None:
    scatter = np.array([0.003, 0.1, 0.001, 0.004, 0.02])
    names = ("R/V", "L/V", "K/V", "J/V", "B/V")
    healthy = replace(PLAIN, quantities=names, values=np.ones(5), log_covariance=np.diag(scatter**2))
    spread = motor_recipe(replace(COMMISSIONED, healthy=healthy)).spread
    assert spread.std / np.sqrt(8.0 / 6.0) == pytest.approx([0.0, 0.003, 0.001, 0.004, 0.02])


def test_windows_teach_the_spread_and_nothing_of_starts() -> None:
    windows = Windows(1.0, (), np.ones(1), "held", 1e-3, 300.0)
    names, scatter = ("R", "K", "J", "B"), np.array([0.03, 0.01, 0.02, 0.05])
    taught = Healthy(9, 8.0, names, np.ones(4), np.diag(scatter**2), windows=windows)
    motor = replace(COMMISSIONED, healthy=taught)
    recipe, sheet = motor_recipe(motor), replace(COMMISSIONED, healthy=None)
    assert recipe.spread.std / np.sqrt(8.0 / 6.0) == pytest.approx([0.01 / np.sqrt(8.0 / 6.0), *scatter])
    assert recipe.timing == settling_timing(motor)
    assert (recipe.sensor, recipe.field) == (motor_recipe(sheet).sensor, None)
