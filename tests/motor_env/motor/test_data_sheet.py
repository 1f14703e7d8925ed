from __future__ import annotations

from dataclasses import astuple, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hostile import refused

from motor_env import PAPER_MOTOR, InputError, Motor, cli, load_motor
from motor_env.motor.data_sheet import Tolerance, save_motor, usable_parameters
from motor_env.motor.healthy import Healthy, ScoreCalibration, Starts, Windows

# Reaches in: what a sheet lacks is said where a recipe is made of it.
from motor_env.simulation.named_recipes import motor_recipe
from motor_env.simulation.recipes import LARGEST_SPREAD

SHEET = """
name = "sheet"
[motor]
resistance_ohm = 2.18
inductance_mh = 0.238
torque_constant_mnm_per_a = 23.5
speed_constant_rpm_per_v = 406.0
rotor_inertia_g_cm2 = 10.7
no_load_current_ma = 26.3
no_load_speed_rpm = 4860.0
"""


def load(tmp_path: Path, text: str) -> Motor:
    path = tmp_path / "motor.toml"
    path.write_text(text, encoding="utf-8")
    return load_motor(path)


def test_data_sheet_units_become_si(tmp_path: Path) -> None:
    p = load(tmp_path, SHEET).parameters
    assert p.resistance_ohm == 2.18
    assert p.inductance_h == pytest.approx(0.238e-3)
    assert p.torque_constant_n_m_per_a == pytest.approx(0.0235)
    assert p.back_emf_constant_v_s_per_rad == pytest.approx(60.0 / (2.0 * np.pi * 406.0))
    assert p.inertia_kg_m2 == pytest.approx(1.07e-6)


def test_friction_comes_from_the_no_load_point(tmp_path: Path) -> None:
    friction = load(tmp_path, SHEET).parameters.viscous_friction_n_m_s_per_rad
    assert friction == pytest.approx(0.0235 * 0.0263 / (4860.0 * 2.0 * np.pi / 60.0))


def test_one_constant_stands_for_the_other(tmp_path: Path) -> None:
    text = SHEET.replace("torque_constant_mnm_per_a = 23.5\n", "")
    p = load(tmp_path, text).parameters
    assert p.torque_constant_n_m_per_a == p.back_emf_constant_v_s_per_rad


def test_two_constants_that_are_not_one_number_are_refused(tmp_path: Path) -> None:
    load(tmp_path, SHEET.replace("23.5", "25.8"))  # 9.7 % more than the speed constant says
    with pytest.raises(
        InputError, match=r"torque constant of 0.0262 N m/A and a back-EMF constant of 0.02352"
    ):
        load(tmp_path, SHEET.replace("23.5", "26.2"))


def test_a_mechanical_time_constant_must_follow_from_the_others(tmp_path: Path) -> None:
    """R J / (Kt Kb) = 2.18 * 1.07e-6 / (0.0235 * 0.02352) = 4.22 ms."""
    plain = load(tmp_path, SHEET)
    for said in ("mechanical_time_constant_ms = 4.4", "mechanical_time_constant_s = 0.0040"):
        assert load(tmp_path, f"{SHEET}{said}\n") == plain
    with pytest.raises(InputError, match=r"time constant of 4.8 ms, but R J / .Kt Kb. of .* is 4.22 ms"):
        load(tmp_path, f"{SHEET}mechanical_time_constant_ms = 4.8\n")


@pytest.mark.parametrize(
    ("line", "field", "si"),
    [
        ("resistance_mohm = 2180.0", "resistance_ohm", 2.18),
        ("inductance_h = 0.00025", "inductance_h", 2.5e-4),
        ("inductance_uh = 238.0", "inductance_h", 0.238e-3),
        ("torque_constant_n_m_per_a = 0.024", "torque_constant_n_m_per_a", 0.024),
        ("torque_constant_oz_in_per_a = 3.25", "torque_constant_n_m_per_a", 3.25 * 7.0615518333e-3),
        ("speed_constant_krpm_per_v = 0.4", "back_emf_constant_v_s_per_rad", 0.15 / (2.0 * np.pi)),
        ("kv_rpm_per_v = 400.0", "back_emf_constant_v_s_per_rad", 0.15 / (2.0 * np.pi)),
        ("back_emf_constant_v_s_per_rad = 0.024", "back_emf_constant_v_s_per_rad", 0.024),
        ("back_emf_constant_v_per_krpm = 2.5", "back_emf_constant_v_s_per_rad", 2.5 * 0.06 / (2.0 * np.pi)),
        ("back_emf_constant_mv_per_rpm = 2.5", "back_emf_constant_v_s_per_rad", 2.5 * 0.06 / (2.0 * np.pi)),
        ("rotor_inertia_kg_m2 = 0.000005", "inertia_kg_m2", 5e-6),
        ("rotor_inertia_kg_cm2 = 0.5", "inertia_kg_m2", 0.5e-4),
        ("rotor_inertia_oz_in_s2 = 0.0006", "inertia_kg_m2", 4.2369311e-6),
        ("rotor_inertia_oz_in2 = 0.5", "inertia_kg_m2", 0.5 * 1.82899783e-5),
        ("mechanical_time_constant_ms = 5.0", "inertia_kg_m2", 5e-3 * 0.0235 / 2.18 * 60.0 / 812.0 / np.pi),
        ("electrical_time_constant_ms = 0.2", "inductance_h", 4.36e-4),
        ("viscous_friction_n_m_s_per_rad = 0.5", "viscous_friction_n_m_s_per_rad", 0.5),
        ("viscous_friction_mnm_per_krpm = 3.0", "viscous_friction_n_m_s_per_rad", 9e-5 / np.pi),
        ("nominal_voltage_v = 12.5", "nominal_voltage_v", 12.5),
        ("coulomb_friction_n_m = 0.0001", "coulomb_friction_n_m", 1e-4),
        ("coulomb_friction_kg_cm = 0.001", "coulomb_friction_n_m", 9.80665e-5),
        ("brush_drop_v = 0.3", "brush_drop_v", 0.3),
    ],
)
def test_every_unit_becomes_si(tmp_path: Path, line: str, field: str, si: float) -> None:
    """1 V/krpm = 0.06 / (2 pi) V s/rad; 1 mN m/krpm = 0.001 * 0.06 / (2 pi) N m s/rad."""
    replaced = {
        "resistance_ohm": "resistance_ohm = 2.18",
        "inductance_h": "inductance_mh = 0.238",
        "torque_constant_n_m_per_a": "torque_constant_mnm_per_a = 23.5",
        "back_emf_constant_v_s_per_rad": "speed_constant_rpm_per_v = 406.0",
        "inertia_kg_m2": "rotor_inertia_g_cm2 = 10.7",
    }
    sheet = SHEET.replace(replaced[field], line) if field in replaced else f"{SHEET}{line}\n"
    motor = load(tmp_path, sheet)
    holder = motor if hasattr(motor, field) else motor.parameters
    assert getattr(holder, field) == pytest.approx(si, rel=1e-7)
    assert motor.guesses == ()


def test_dry_friction_is_no_part_of_the_viscous_one(tmp_path: Path) -> None:
    """Kt i0 = Tc + B w0; without a no-load speed, w0 is what the nominal voltage less brush drop and R i0 induces."""
    sheet = f"{SHEET}coulomb_friction_n_m = 0.0001\n"
    friction = load(tmp_path, sheet).parameters.viscous_friction_n_m_s_per_rad
    assert friction == pytest.approx((0.0235 * 0.0263 - 1e-4) / (4860.0 * np.pi / 30.0))
    sheet = SHEET.replace("no_load_speed_rpm = 4860.0", "nominal_voltage_v = 12.0")
    speed = (12.0 - 2.18 * 0.0263) * 406.0 * np.pi / 30.0
    friction = load(tmp_path, sheet).parameters.viscous_friction_n_m_s_per_rad
    assert friction == pytest.approx(0.0235 * 0.0263 / speed)
    friction = load(tmp_path, f"{sheet}brush_drop_v = 1.8\n").parameters.viscous_friction_n_m_s_per_rad
    assert friction == pytest.approx(0.0235 * 0.0263 / (speed - 1.8 * 406.0 * np.pi / 30.0))
    with pytest.raises(InputError, match="no-load point leaves no viscous friction, got -"):
        load(tmp_path, f"{SHEET}coulomb_friction_n_m = 0.001\n")


SHOP = """
[motor]
nominal_voltage_v = 12.0
stall_current_a = 5.0
stall_torque_kg_cm = 0.95
free_speed_rpm = 6000.0
free_current_a = 0.2
"""


def test_a_sheet_of_a_shop(tmp_path: Path) -> None:
    """R is V / 5 A, K (V - R i0) / w0; the stall torque of 0.93 N cm agrees. Without L and J both are guesses."""
    motor = load(tmp_path, SHOP)
    p = motor.parameters
    constant = (12.0 - 2.4 * 0.2) / (200.0 * np.pi)
    assert p.resistance_ohm == pytest.approx(2.4)
    assert [p.torque_constant_n_m_per_a, p.back_emf_constant_v_s_per_rad] == pytest.approx([constant] * 2)
    assert p.viscous_friction_n_m_s_per_rad == pytest.approx(constant * 0.2 / (200.0 * np.pi))
    assert motor.guesses == ("inductance_h", "inertia_kg_m2")
    assert (motor.tolerance.inductance, motor.tolerance.inertia, motor.tolerance.friction) == (1.5, 1.5, 0.3)
    assert [note.partition(":")[0] for note in motor.notes] == [
        "the sheet does not give inertia_kg_m2 and inductance_h"
    ]
    for simulated in (motor_recipe, partial(usable_parameters, needs_speed=False)):
        with pytest.raises(ValueError, match="the data sheet lacks inductance_h and inertia_kg_m2"):
            simulated(motor)
    assert (
        cli.main(["export-c", str(tmp_path / "motor.toml"), "--rate-hz", "1000", "--out", str(tmp_path)]) == 2
    )
    other = replace(p, inductance_h=3.0, inertia_kg_m2=4.0, resistance_ohm=9.0)
    assert motor.with_guesses_of(other).parameters == replace(p, inductance_h=3.0, inertia_kg_m2=4.0)
    by_stall = SHOP.replace("free_speed_rpm = 6000.0\n", "viscous_friction_n_m_s_per_rad = 0.0\n")
    found = load(tmp_path, by_stall)
    assert found.parameters.torque_constant_n_m_per_a == pytest.approx(0.95 * 0.0980665 / 5.0)
    assert any("friction is 0" in note for note in found.notes)
    save_motor(motor, tmp_path / "again.toml")
    assert load_motor(tmp_path / "again.toml").guesses == motor.guesses
    with pytest.raises(InputError, match=r"motor\.rotor_inertia_g_cm2 is missing"):
        load(tmp_path, f'kind = "identified"{SHOP}')


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("4860.0", "3000.0", "no-load point where (V - R i0) / w0 is 0.03801 V s/rad"),
        ("no_load_speed_rpm", "no_load_speed_rad_s", "no_load_speed_rad_s = 4860 looks like no_load_speed_rpm"),
        ("no_load_current_ma", "no_load_current_a", "no_load_current_a = 26.3 looks like no_load_current_ma"),
        ("torque_constant_mnm", "torque_constant_n_m", "23.5 looks like torque_constant_mnm_per_a"),
        ("speed_constant_rpm_per_v = 406.0", "speed_constant_rpm_per_v = 0.406", "looks like speed_constant_krpm"),
        ("[motor]", "[motor]\nstall_current_a = 5.5\nstall_torque_n_m = 1.29", "stall torque over current"),
    ],
)  # fmt: skip
def test_points_that_contradict_the_constants_are_refused(
    tmp_path: Path, old: str, new: str, needle: str
) -> None:
    """By 30 % or more; the unit that mends it is named."""
    sheet = f"{SHEET}nominal_voltage_v = 12.0\n"
    assert old in sheet
    assert load(tmp_path, sheet).notes == ()
    with pytest.raises(InputError) as error:
        load(tmp_path, sheet.replace(old, new))
    assert needle in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("4860.0", "4300.0", "(V - R i0) / w0 is 0.02652 V s/rad"),
        ("inductance_mh = 0.238", "inductance_uh = 238000.0", "L / R is 0.109 s"),
        ("no_load_current_ma = 26.3", "viscous_friction_n_m_s_per_rad = 0.0", "friction is 0"),
        ("nominal_voltage_v = 12.0", "nominal_voltage_v = 0.1", "V / K is 40.6 rpm"),
    ],
)
def test_odd_numbers_are_noted(tmp_path: Path, old: str, new: str, needle: str) -> None:
    """A disagreement from 10 % on, and what no usual motor has."""
    sheet = f"{SHEET}nominal_voltage_v = 12.0\n"
    if "nominal" in old:
        sheet = sheet.replace("no_load_speed_rpm = 4860.0\n", "").replace("26.3", "1e-4")
    (note,) = load(tmp_path, sheet.replace(old, new)).notes
    assert needle in note


def test_friction_of_a_no_load_current_has_a_wide_tolerance_unless_the_sheet_says_otherwise(
    tmp_path: Path,
) -> None:
    plain, told = load(tmp_path, SHEET), load(tmp_path, f"{SHEET}[tolerance]\nfriction = 0.05\n")
    given = load(
        tmp_path, SHEET.replace("no_load_current_ma = 26.3", "viscous_friction_n_m_s_per_rad = 1e-6")
    )
    assert [motor.tolerance.friction for motor in (plain, told, given)] == [0.3, 0.05, 0.03]
    assert [
        motor_recipe(replace(motor, nominal_voltage_v=12.0)).spread.friction for motor in (plain, told)
    ] == [LARGEST_SPREAD, 0.05]
    assert plain.usual_tolerances["friction"].startswith("from a no-load current")
    assert "friction" not in told.usual_tolerances
    assert (
        set(given.usual_tolerances.values())
        == set(load_motor("paper").usual_tolerances.values())
        == {"usual"}
    )


def test_the_default_tolerances_are_those_of_the_documentation() -> None:
    """A file without them is judged by these, so they cannot move."""
    assert Tolerance() == Tolerance(0.01, 0.02, 0.10, 0.01, 0.02, 0.03, 10.0)


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("resistance_ohm = 2.18", "resistance_ohm = -2.18", "motor.resistance_ohm"),
        ("resistance_ohm = 2.18", "resistance_ohm = nan", "motor.resistance_ohm"),
        ("resistance_ohm = 2.18", "", "motor.resistance_ohm is missing"),
        (
            "resistance_ohm = 2.18",
            "resistence_ohm = 2.18",
            "unknown key 'resistence_ohm' in motor; known are",
        ),
        ("resistance_ohm = 2.18", "resistance_ohm = 2.18\nresistance_mohm = 2180.0", "give one of them"),
        ("no_load_current_ma = 26.3", "", "no_load_current_ma"),
        ("[motor]", "[motor]\nback_emf_constant_v_per_krpm = 2.46", "give one of them"),
        ("inductance_mh = 0.238", 'inductance_mh = "x"', "motor.inductance_mh"),
        ("[motor]", "[motor", "is not TOML"),
    ],
)
def test_a_bad_file_gets_one_sentence_that_names_it(tmp_path: Path, old: str, new: str, needle: str) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(SHEET.replace(old, new), encoding="utf-8")
    assert needle in refused(lambda: load_motor(path), path)


def test_a_file_says_itself_what_it_assumes(tmp_path: Path) -> None:
    """Nothing is guessed from its kind."""
    told = f"""{SHEET.replace('name = "sheet"', 'kind = "identified"')}
[assumed]
resistance_ohm = "guessed"
"""
    assert load(tmp_path, told).assumed == {"resistance_ohm": "guessed"}
    assert load(tmp_path, told.partition("[assumed]")[0]).assumed == {}
    with pytest.raises(InputError, match=r"assumed\.inductance_h is no value of the table motor"):
        load(tmp_path, told.replace('resistance_ohm = "guessed', 'inductance_h = "guessed'))


HEALTHY = """
[healthy]
pieces = 3
degrees_of_freedom = 5.0
quantities = ["R", "L"]
values = [1.0, 1.0]
log_covariance = [[1.0, 0.5], [0.5, 1.0]]
"""
STARTS = """
[healthy.starts]
log_noise = -3.0
log_noise_sd = 0.1
model = ["supply_ramp"]
model_low = [0.001]
"""
WINDOWS = """
[healthy.windows]
window_s = 1.0
terms = []
physical = [1.0]
hold = "held"
dt_s = 0.001
speed_rad_s = 100.0
"""


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("values = [1.0, 1.0]", "values = [1.0]", "healthy names 2 quantities; values and log_covariance"),
        ("values = [1.0, 1.0]", "values = [1.0, 0.0]", "healthy.values"),
        ("[[1.0, 0.5], [0.5, 1.0]]", "[[1.0]]", "healthy names 2 quantities; values and log_covariance"),
        ("[[1.0, 0.5], [0.5, 1.0]]", "[[1.0, 0.5], [0.4, 1.0]]", "symmetric and positive definite"),
        ("[[1.0, 0.5], [0.5, 1.0]]", "[[1.0, 1.0], [1.0, 1.0]]", "symmetric and positive definite"),
        ("model_low = [0.001]", "model_low = [0.001, 0.002]", "one value for each of healthy.starts.model"),
        (STARTS, "", "one of the tables starts and windows"),
        (STARTS, STARTS + WINDOWS, "one of the tables starts and windows"),
        ("[healthy]", "[reference]", "unknown key 'reference'"),
        ("pieces = 3", "pieces = 0", "healthy.pieces"),
    ],
)
def test_what_healthy_pieces_taught_must_hold_together(
    tmp_path: Path, old: str, new: str, needle: str
) -> None:
    good = SHEET + HEALTHY + STARTS
    assert old in good
    assert load(tmp_path, good).healthy is not None
    path = tmp_path / "motor.toml"
    path.write_text(good.replace(old, new), encoding="utf-8")
    assert needle in refused(lambda: load_motor(path), path)


def test_unknown_motor_lists_the_presets() -> None:
    with pytest.raises(InputError, match="presets are paper"):
        load_motor("no-such-motor")


def test_catalogue_motor_by_name() -> None:
    assert load_motor("paper").parameters == PAPER_MOTOR


CALIBRATION = ScoreCalibration(12, 2.0 / 3.0 * np.eye(4), 7.0, 1e-4 / 3.0 * np.eye(4), tails_hold=True)


@pytest.mark.parametrize(
    "taught",
    [
        Starts(log_noise=-3.2, log_noise_sd=0.1, model=("supply_ramp",)),
        Windows(
            2.0 / 3.0,
            ("drag",),
            np.array([1e-4, 2.0 / 3.0]),
            "late",
            1e-3,
            300.0,
            window_excess=1.1,
            calibration=CALIBRATION,
        ),
    ],
)
def test_a_saved_motor_is_read_back_to_the_last_bit(tmp_path: Path, taught: Starts | Windows) -> None:
    healthy = Healthy(
        pieces=5,
        degrees_of_freedom=8.0,
        quantities=("R", "L"),
        values=np.array([2.0 / 3.0, 1e-4]),
        log_covariance=np.array([[1e-4, 2e-5], [2e-5, 3e-4]]),
        starts=taught if isinstance(taught, Starts) else None,
        windows=taught if isinstance(taught, Windows) else None,
    )
    motor = Motor('with "quotes"', "commissioned", PAPER_MOTOR, 12.0, healthy=healthy, notes=("a", "b"))
    save_motor(motor, tmp_path / "deep" / "m.toml")
    back = load_motor(tmp_path / "deep" / "m.toml")
    assert back.parameters == motor.parameters
    assert (back.name, back.kind, back.notes, back.tolerance) == (
        motor.name,
        motor.kind,
        motor.notes,
        motor.tolerance,
    )
    assert back.healthy is not None
    np.testing.assert_array_equal(back.healthy.log_covariance, healthy.log_covariance)
    np.testing.assert_array_equal(back.healthy.values, healthy.values)
    assert back.healthy.starts == healthy.starts
    if healthy.windows is not None and back.healthy.windows is not None:
        np.testing.assert_array_equal(back.healthy.windows.physical, healthy.windows.physical)
        assert back.healthy.windows.calibration is not None
        for ours, theirs in zip(astuple(back.healthy.windows.calibration), astuple(CALIBRATION), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        same = replace(back.healthy.windows, physical=healthy.windows.physical, calibration=CALIBRATION)
        assert same == healthy.windows
    assert (back.healthy.windows is None) == (healthy.windows is None)
    assert list(tmp_path.glob("deep/.*")) == []
