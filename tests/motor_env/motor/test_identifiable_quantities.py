"""What a recording can tell of a motor: exponents, directions of warmth and faults, tolerances, and what is assumed."""

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, Fault, FaultKind, Motor, MotorParameters
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Tolerance, assumptions, usable_parameters
from motor_env.motor.faults import apply_fault, motor_kinds
from motor_env.motor.parameters import FloatArray

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


def test_a_motor_without_friction_has_a_logarithm() -> None:
    still = PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=0.0)
    assert identifiable.logarithms(still, VOLTAGE)[4] == pytest.approx(np.log(1e-300))


def test_tolerances_with_temperature() -> None:
    """Temperature is one number that moves R and K together: 3 K are 1.179 % of R and -0.3 % of K."""
    tolerance = Tolerance(0.011, 0.02, 0.10, 0.012, 0.022, 0.03, 3.0)
    covariance = identifiable.tolerance_covariance(tolerance)
    expected = np.diag(np.square([0.02, 0.10, 0.012, 0.022, 0.03, 0.011]))
    heat = np.array([0.01179, 0.0, -0.003, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(covariance, expected + np.outer(heat, heat), rtol=1e-12)
    std = identifiable.tolerance_std(tolerance)
    assert std == pytest.approx(
        {
            "resistance": np.hypot(0.02, 0.01179),
            "inductance": 0.10,
            "constants": np.hypot(0.012, 0.003),
            "inertia": 0.022,
            "friction": 0.03,
            "supply": 0.011,
        }
    )


def test_a_coupled_load_imitates_a_weak_magnet_where_no_speed_is_measured() -> None:
    kinds = {
        has_speed: identifiable.nameable_kinds(
            identifiable.matrix(identifiable.names(has_voltage=True, has_speed=has_speed))
        )
        for has_speed in (True, False)
    }
    assert kinds[True] == ("bearing", "winding_contact", "winding_short", "magnet")
    assert kinds[False] == ("bearing", "winding_contact", "winding_short")


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
