"""Parameters: what is refused and with which sentence, what is derived, how batches read."""

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, Channel, MotorParameters, SensorParameters, SupplyParameters, load_recipe
from motor_env.motor.parameters import (
    CATALOGUE,
    COPPER_PER_KELVIN,
    FRICTION_PER_KELVIN,
    MAGNET_PER_KELVIN,
    PAPER_MATRICES_DT_S,
    PAPER_MATRICES_MOTOR,
    RAD_S_PER_RPM,
    require_plausible,
)

FIELDS = (
    "resistance_ohm",
    "inductance_h",
    "back_emf_constant_v_s_per_rad",
    "torque_constant_n_m_per_a",
    "inertia_kg_m2",
    "viscous_friction_n_m_s_per_rad",
)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("factor", [-0.1, float("nan"), float("inf")])
def test_bad_value_names_field_bound_and_value(field: str, factor: float) -> None:
    with pytest.raises(ValueError, match=rf"^{field} must be finite and >=? 0, got (-|nan|inf)"):
        PAPER_MOTOR.scaled(**{field: factor})


def test_only_friction_may_be_zero() -> None:
    assert PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=0.0).viscous_friction_n_m_s_per_rad == 0.0
    for field in FIELDS[:-1]:
        with pytest.raises(ValueError, match=f"{field} must be finite and > 0, got 0"):
            PAPER_MOTOR.scaled(**{field: 0.0})


def test_one_bad_entry_of_a_batch_is_found() -> None:
    with pytest.raises(ValueError, match=r"resistance_ohm must be finite and > 0, got -2\.18"):
        PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, -1.0, 2.0]))


def test_parameters_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        PAPER_MOTOR.resistance_ohm = 1.0  # type: ignore[misc]  # the point of the test


def test_scaled_changes_the_named_fields_alone() -> None:
    scaled = PAPER_MOTOR.scaled(inertia_kg_m2=2.0)
    assert scaled.inertia_kg_m2 == 2.0 * PAPER_MOTOR.inertia_kg_m2
    assert [getattr(scaled, f) for f in FIELDS if f != "inertia_kg_m2"] == [
        getattr(PAPER_MOTOR, f) for f in FIELDS if f != "inertia_kg_m2"
    ]


def test_batch_shape_and_motor() -> None:
    batch = PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, 1.5, 2.0]))
    assert (PAPER_MOTOR.batch_shape, batch.batch_shape) == ((), (3,))
    assert batch.motor(1) == PAPER_MOTOR.scaled(resistance_ohm=1.5)


def test_time_constants_of_the_paper_motor() -> None:
    # 2.18 ohm and 0.238 mH; J R / (Kt Kb + R B) by hand.
    assert PAPER_MOTOR.electrical_time_constant_s == pytest.approx(0.238e-3 / 2.18)
    assert PAPER_MOTOR.mechanical_time_constant_s == pytest.approx(
        1.07e-6 * 2.18 / (0.0235 * 0.02352 + 2.18 * 1.2e-6)
    )


def test_sensor_rows_follow_the_channels() -> None:
    sensor = SensorParameters((Channel.SPEED, Channel.CURRENT), current_noise_a=0.02, speed_noise_rad_s=3.0)
    assert sensor.observation.tolist() == [[0.0, 1.0], [1.0, 0.0]]
    assert sensor.noise_std.tolist() == [3.0, 0.02]
    assert SensorParameters().observation.tolist() == [[1.0, 0.0]]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"channels": ()}, "channels must name at least one of current, speed, got none"),
        ({"channels": ("current", "current")}, "channels must be distinct, got current, current"),
        ({"channels": ("torque",)}, "channels must be of current, speed, got"),
        ({"current_noise_a": -1.0}, "current_noise_a must be finite and >= 0, got -1"),
    ],
)
def test_bad_sensor(arguments: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SensorParameters(**arguments)  # type: ignore[arg-type]  # bad on purpose


def test_bad_supply() -> None:
    with pytest.raises(ValueError, match="voltage_v must be finite, got nan"):
        SupplyParameters(float("nan"))


def test_catalogue() -> None:
    assert CATALOGUE == {"paper": PAPER_MOTOR, "paper-matrices": PAPER_MATRICES_MOTOR}


def test_the_papers_motor_and_the_constants_of_physics_stand_as_printed() -> None:
    """The paper's table (part 2B), what its printed matrices come from, IEC 60028, and round numbers for the rest."""
    printed = (2.18, 0.238e-3, 0.02352, 0.0235, 1.07e-6, 12e-7)
    assert MotorParameters(*printed) == PAPER_MOTOR
    assert PAPER_MATRICES_MOTOR.resistance_ohm == pytest.approx(2.06, rel=1e-12)
    assert PAPER_MATRICES_MOTOR.inductance_h == pytest.approx(2.38e-3, rel=1e-12)
    assert replace(PAPER_MATRICES_MOTOR, resistance_ohm=2.18, inductance_h=0.238e-3) == PAPER_MOTOR
    assert PAPER_MATRICES_DT_S == 0.01
    assert (COPPER_PER_KELVIN, MAGNET_PER_KELVIN, FRICTION_PER_KELVIN) == (0.00393, -0.001, -0.003)
    assert pytest.approx(math.tau) == 60.0 * RAD_S_PER_RPM
    sensor = SensorParameters()
    assert (sensor.current_noise_a, sensor.speed_noise_rad_s) == (0.02, 1.0)
    assert SupplyParameters().voltage_v == 12.0
    assert sensor.with_noise(3.0) == SensorParameters(current_noise_a=0.06, speed_noise_rad_s=3.0)


@pytest.mark.parametrize("field", FIELDS)
def test_numbers_beyond_every_motor_are_refused(field: str) -> None:
    recipe = load_recipe("paper")
    for value in (1e-15, 1e12):
        require_plausible(replace(PAPER_MOTOR, **{field: value}), "motor")
    for value in (0.999e-15, 1.001e12):
        wrong = replace(PAPER_MOTOR, **{field: value})
        with pytest.raises(ValueError, match=rf"^motor\.{field} must be in 1e-15 .. 1e\+12, got "):
            replace(recipe, motor=wrong)
    with pytest.raises(ValueError, match=r"^supply\.voltage_v must be in -1e\+12 .. 1e\+12, got -2"):
        replace(recipe, supply=SupplyParameters(-2e12))
    with pytest.raises(ValueError, match=r"^classes\[1\]\.weight must be in "):
        replace(recipe, classes=(recipe.classes[0], replace(recipe.classes[1], weight=1e13)))
