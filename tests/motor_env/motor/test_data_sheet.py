"""The motor's file: units, what is refused or noted, what is read back; and what a recording can tell of a motor."""

import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hostile import refused
from strange_toml import MOTORS, STARTS, WINDOWS

from motor_env import PAPER_MOTOR, Fault, FaultKind, InputError, Motor, MotorParameters, load_motor
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Tolerance, assumptions, save_motor, usable_parameters
from motor_env.motor.faults import apply_fault, motor_kinds
from motor_env.motor.healthy import ScoreCalibration
from motor_env.motor.parameters import FloatArray

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


@pytest.mark.parametrize(
    ("line", "field", "si"),
    [
        ("", "torque_constant_n_m_per_a", 0.02352043),  # the other stands for it
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
    assert getattr(holder, field) == pytest.approx(si, rel=1e-6)
    assert motor.guesses == ()


KT_I0, VOLTS = 0.0235 * 0.0263, "nominal_voltage_v = 12.0"


@pytest.mark.parametrize(
    ("old", "new", "torque", "speed"),
    [
        ("", "", KT_I0, 4860.0),
        ("no_load_current_ma = 26.3", "no_load_current_a = 0.03", 0.0235 * 0.03, 4860.0),
        ("[motor]", "[motor]\ncoulomb_friction_n_m = 1e-4", KT_I0 - 1e-4, 4860.0),
        ("no_load_speed_rpm = 4860.0", "no_load_speed_rad_s = 500.0", KT_I0, 15000.0 / np.pi),
        ("no_load_speed_rpm = 4860.0", "nominal_voltage_v = 12.0", KT_I0, 11.942666 * 406.0),
        ("no_load_speed_rpm = 4860.0", f"{VOLTS}\nbrush_drop_v = 1.8", KT_I0, 10.142666 * 406.0),
    ],
)
def test_viscous_friction_comes_from_the_no_load_point(
    tmp_path: Path, old: str, new: str, torque: float, speed: float
) -> None:
    """Kt i0 = Tc + B w0; without a no-load speed, w0 is what the nominal voltage less brush drop and R i0 induces."""
    friction = load(tmp_path, SHEET.replace(old, new)).parameters.viscous_friction_n_m_s_per_rad
    assert friction == pytest.approx(torque / (speed * np.pi / 30.0))


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
    p, constant = motor.parameters, (12.0 - 2.4 * 0.2) / (200.0 * np.pi)
    assert p.resistance_ohm == pytest.approx(2.4)
    assert [p.torque_constant_n_m_per_a, p.back_emf_constant_v_s_per_rad] == pytest.approx([constant] * 2)
    assert p.viscous_friction_n_m_s_per_rad == pytest.approx(constant * 0.2 / (200.0 * np.pi))
    assert motor.guesses == ("inductance_h", "inertia_kg_m2")
    assert motor.tolerance == Tolerance(inductance=1.5, inertia=1.5, friction=0.3)
    assert any("the sheet does not give inertia_kg_m2 and inductance_h" in note for note in motor.notes)
    for simulated in (motor_recipe, partial(usable_parameters, needs_speed=False)):
        with pytest.raises(ValueError, match="the data sheet lacks inductance_h and inertia_kg_m2"):
            simulated(motor)
    other = replace(p, inductance_h=3.0, inertia_kg_m2=4.0, resistance_ohm=9.0)
    assert motor.with_guesses_of(other).parameters == replace(p, inductance_h=3.0, inertia_kg_m2=4.0)
    by_stall = SHOP.replace("free_speed_rpm = 6000.0\n", "viscous_friction_n_m_s_per_rad = 0.0\n")
    found = load(tmp_path, by_stall).parameters
    assert found.torque_constant_n_m_per_a == pytest.approx(0.95 * 0.0980665 / 5.0)
    save_motor(motor, tmp_path / "again.toml")
    assert load_motor(tmp_path / "again.toml").guesses == motor.guesses
    with pytest.raises(InputError, match=r"motor\.rotor_inertia_g_cm2 is missing"):
        load(tmp_path, f'kind = "identified"{SHOP}')


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
    sheet = f"{SHEET}nominal_voltage_v = 12.0\n"
    if "nominal" in old:
        sheet = sheet.replace("no_load_speed_rpm = 4860.0\n", "").replace("26.3", "1e-4")
    (note,) = load(tmp_path, sheet.replace(old, new)).notes
    assert needle in note


@pytest.mark.parametrize(
    ("old", "new", "tolerance", "spread", "source"),
    [
        ("", "", 0.3, LARGEST_SPREAD, "from a no-load current"),
        ("[motor]", "[tolerance]\nfriction = 0.05\n[motor]", 0.05, 0.05, None),
        ("no_load_current_ma = 26.3", "viscous_friction_n_m_s_per_rad = 1e-6", 0.03, 0.03, "usual"),
    ],
)
def test_friction_of_a_no_load_current_has_a_wide_tolerance_unless_the_sheet_says_otherwise(
    tmp_path: Path, old: str, new: str, tolerance: float, spread: float, source: str | None
) -> None:
    motor = load(tmp_path, SHEET.replace(old, new))
    assert motor.tolerance == Tolerance(0.01, 0.02, 0.10, 0.01, 0.02, tolerance, 10.0)  # as documented
    assert motor_recipe(replace(motor, nominal_voltage_v=12.0)).spread.friction == spread
    assert motor.usual_tolerances.get("friction", "").startswith(source or "")
    assert ("friction" in motor.usual_tolerances) == (source is not None)


def test_a_file_says_itself_what_it_assumes(tmp_path: Path) -> None:
    plain = SHEET.replace('name = "sheet"', 'kind = "identified"')
    assert load(tmp_path, f'{plain}[assumed]\nresistance_ohm = "guessed"').assumed == {
        "resistance_ohm": "guessed"
    }
    assert load(tmp_path, plain).assumed == {}


def test_a_mechanical_time_constant_must_follow_from_the_others(tmp_path: Path) -> None:
    """R J / (Kt Kb) = 2.18 * 1.07e-6 / (0.0235 * 0.02352) = 4.22 ms."""
    plain = load(tmp_path, SHEET)
    for said in ("mechanical_time_constant_ms = 4.4", "mechanical_time_constant_s = 0.0040"):
        assert load(tmp_path, f"{SHEET}{said}\n") == plain


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("resistance_ohm = 2.18", "", "motor.resistance_ohm is missing"),
        ("resistance_ohm", "resistence_ohm", "unknown key 'resistence_ohm' in motor; known are"),
        ("[motor]", "[motor]\nresistance_mohm = 2180.0", "give one of them"),
        ("no_load_current_ma = 26.3", "", "no_load_current_ma"),
        ("inductance_mh = 0.238", 'inductance_mh = "x"', "motor.inductance_mh"),
        ("[motor]", "[motor", "is not TOML"),
        ("[sensor]", '[assumed]\nfriction = "guessed"\n[sensor]', "assumed.friction is no value"),
        # Numbers that contradict each other by 30 % or more, two constants by 10 %; the unit that mends it is named.
        ("23.5", "26.2", "torque constant of 0.0262 N m/A and a back-EMF constant of 0.02352"),
        ("[motor]", "[motor]\nmechanical_time_constant_ms = 4.8", "time constant of 4.8 ms"),
        ("[motor]", "[motor]\ncoulomb_friction_n_m = 0.001", "leaves no viscous friction"),
        ("no_load_speed_rpm", "no_load_speed_rad_s", "4860 looks like no_load_speed_rpm"),
        ("no_load_current_ma", "no_load_current_a", "no_load_current_a = 26.3 looks like no_load_current_ma"),
        ("torque_constant_mnm", "torque_constant_n_m", "23.5 looks like torque_constant_mnm_per_a"),
        ("per_v = 406.0", "per_v = 0.406", "looks like speed_constant_krpm"),
        ("[motor]", "[motor]\nstall_current_a = 5.5\nstall_torque_n_m = 1.29", "stall torque over current"),
        # What healthy pieces taught.
        ("values = [2.2, 2.4e-4]", "values = [2.2]", "healthy names 2 quantities; values and log_covariance"),
        ("values = [2.2, 2.4e-4]", "values = [2.2, 0.0]", "healthy.values"),
        ("[4e-4, 0.0]", "[4e-4, 1e-4]", "symmetric and positive definite"),
        ("2.5e-3]]", "0.0]]", "symmetric and positive definite"),
        ("log_noise =", "model = ['x']\nmodel_low = [1.0, 2.0]\nlog_noise =", "one value for each"),
        (STARTS, "", "one of the tables starts and windows"),
        (STARTS, STARTS + WINDOWS, "one of the tables starts and windows"),
        ("[healthy]", "[reference]", "unknown key 'reference'"),
        ("degrees_of_freedom = 8.0", "degrees_of_freedom = 1e300", "degrees_of_freedom"),
    ],
)
def test_a_bad_file_gets_one_sentence_that_names_it(tmp_path: Path, old: str, new: str, needle: str) -> None:
    good, path = MOTORS[0], tmp_path / "motor.toml"
    assert old in good
    path.write_text(good.replace(old, new, 1), encoding="utf-8")
    assert needle in refused(lambda: load_motor(path), path)


CALIBRATION = ScoreCalibration(12, 2.0 / 3.0 * np.eye(4), 7.0, 1e-4 / 3.0 * np.eye(4), tails_hold=True)


@pytest.mark.parametrize("text", MOTORS)
def test_a_saved_motor_is_read_back_to_the_last_bit(tmp_path: Path, text: str) -> None:
    read = load(tmp_path, text)
    assert read.healthy is not None
    windows = read.healthy.windows and replace(read.healthy.windows, dt_s=2.0 / 3.0, calibration=CALIBRATION)
    healthy = replace(read.healthy, values=read.healthy.values / 3.0, windows=windows)
    motor = replace(read, name='with "quotes"', notes=("a", "b"), healthy=healthy, usual_tolerances={})
    save_motor(motor, tmp_path / "deep" / "m.toml")
    assert whole(load_motor(tmp_path / "deep" / "m.toml")) == whole(motor)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["m.toml"]


def whole(motor: Motor) -> str:
    """All that it holds, to the last bit."""
    return json.dumps(asdict(motor), default=lambda array: array.tolist())


VOLTAGE = 9.0


def quantities(motor: MotorParameters, voltage_v: float) -> dict[str, float]:
    """Each quantity written out, K^2 = Kt Kb."""
    p = motor
    k2 = float(p.torque_constant_n_m_per_a * p.back_emf_constant_v_s_per_rad)
    r, el, j, b = p.resistance_ohm, p.inductance_h, p.inertia_kg_m2, p.viscous_friction_n_m_s_per_rad
    values = {"R": r, "L": el, "K": k2**0.5, "J": j, "B": b, "K^2/J": k2 / j, "B/J": b / j}
    values |= {f"{name}/V": values[name] / voltage_v for name in "RLKJB"}
    return {name: float(value) for name, value in values.items()} | {"K^2/(J V)": float(k2 / j / voltage_v)}


@pytest.mark.parametrize("has_voltage", [True, False])
@pytest.mark.parametrize("has_speed", [True, False])
def test_quantities_are_products_of_powers(has_voltage: bool, has_speed: bool) -> None:
    names = identifiable.names(has_voltage=has_voltage, has_speed=has_speed)
    assert len(names) == (5 if has_speed else 4)
    logs = identifiable.matrix(names) @ identifiable.logarithms(PAPER_MOTOR, VOLTAGE)
    known = quantities(PAPER_MOTOR, VOLTAGE)
    np.testing.assert_allclose(logs, np.log([known[name] for name in names]), rtol=1e-13)


def moved(motor: MotorParameters, names: tuple[str, ...]) -> FloatArray:
    """Logarithms of the quantities of one motor less those of the paper's."""
    exponents = identifiable.matrix(names)
    both = [identifiable.logarithms(each, VOLTAGE) for each in (motor, PAPER_MOTOR)]
    difference: FloatArray = exponents @ (both[0] - both[1])
    return difference


@pytest.mark.parametrize("kind", motor_kinds())
@pytest.mark.parametrize("has_speed", [True, False])
def test_a_fault_moves_the_quantities_along_its_direction(kind: FaultKind, has_speed: bool) -> None:
    names = identifiable.names(has_voltage=True, has_speed=has_speed)
    expected = moved(apply_fault(PAPER_MOTOR, Fault(kind, 0.2)), names) / kind.log_size(0.2)
    got = identifiable.visible_direction(kind, identifiable.matrix(names))
    np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize("own", [1.0, 0.4])
def test_a_warmer_motor_moves_the_quantities(own: float) -> None:
    """For a small rise: copper up by 0.393 % a kelvin, flux down by 0.1 %, the motor's own friction by 0.3 %."""
    names, rise = identifiable.names(has_voltage=True, has_speed=True), 1e-4
    warm = PAPER_MOTOR.scaled(
        resistance_ohm=1.0 + 0.00393 * rise,
        back_emf_constant_v_s_per_rad=1.0 - 0.001 * rise,
        torque_constant_n_m_per_a=1.0 - 0.001 * rise,
        viscous_friction_n_m_s_per_rad=1.0 - 0.003 * own * rise,
    )
    got = identifiable.warmth_direction(identifiable.matrix(names), own)
    np.testing.assert_allclose(got, moved(warm, names) / rise, atol=1e-8)


def test_tolerances_with_temperature() -> None:
    """Temperature is one number that moves R and K together: 3 K are 1.179 % of R and -0.3 % of K."""
    tolerance = Tolerance(0.011, 0.02, 0.10, 0.012, 0.022, 0.03, 3.0)
    heat = np.array([0.01179, 0.0, -0.003, 0.0, 0.0, 0.0])
    expected = np.diag(np.square([0.02, 0.10, 0.012, 0.022, 0.03, 0.011])) + np.outer(heat, heat)
    np.testing.assert_allclose(identifiable.tolerance_covariance(tolerance), expected, rtol=1e-12)
    names = ("resistance", "inductance", "constants", "inertia", "friction", "supply")
    std = dict(zip(names, np.sqrt(np.diag(expected)).tolist(), strict=True))
    assert identifiable.tolerance_std(tolerance) == pytest.approx(std)


@pytest.mark.parametrize("has_speed", [True, False])
def test_a_coupled_load_imitates_a_weak_magnet_where_no_speed_is_measured(has_speed: bool) -> None:
    exponents = identifiable.matrix(identifiable.names(has_voltage=True, has_speed=has_speed))
    kinds = ("bearing", "winding_contact", "winding_short", *["magnet"] * has_speed)
    assert identifiable.nameable_kinds(exponents) == kinds


CURRENT_ALONE = ("R", "L", "K^2/J", "B/J")
GUESSED = (
    "torque_constant_n_m_per_a",
    "back_emf_constant_v_s_per_rad",
    "rotor_inertia_kg_m2",
    "viscous_friction_n_m_s_per_rad",
)


@pytest.mark.parametrize(
    ("names", "has_voltage", "expected"),
    [
        (("R", "L", "K", "J", "B"), True, ()),
        (CURRENT_ALONE, True, GUESSED),
        (("R/V", "L/V", "K/V", "J/V", "B/V"), False, ("nominal_voltage_v",)),
        (("R/V", "L/V", "K^2/(J V)", "B/J"), False, (*GUESSED, "nominal_voltage_v")),
    ],
)
def test_what_is_assumed_is_what_the_starts_do_not_tell(
    names: tuple[str, ...], has_voltage: bool, expected: tuple[str, ...]
) -> None:
    assert tuple(assumptions(names, has_voltage=has_voltage)) == expected


def test_a_guess_is_refused_where_it_spoils_a_simulation() -> None:
    known = Motor("m", "identified", PAPER_MOTOR)
    assert usable_parameters(known, needs_speed=True) is PAPER_MOTOR
    guessed = Motor("m", "identified", PAPER_MOTOR, assumed=assumptions(CURRENT_ALONE, has_voltage=True))
    with pytest.warns(UserWarning, match="Currents are right, speeds and torques are not"):
        assert usable_parameters(guessed, needs_speed=False) is PAPER_MOTOR
    with pytest.raises(ValueError, match="torque constant, inertia and friction are assumed"):
        usable_parameters(guessed, needs_speed=True)
    unknown = Motor("m", "identified", PAPER_MOTOR, assumed=assumptions(("R/V", "K/V"), has_voltage=False))
    with pytest.raises(ValueError, match="its voltage is unknown"):
        usable_parameters(unknown, needs_speed=False)
