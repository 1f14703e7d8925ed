"""Recipes: class frequencies, spreads, independence of the batch, refusals."""

import hashlib
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from motor_env import PAPER_MOTOR, FaultKind, Recipe, SensorParameters, Timing, draw
from motor_env.motor.faults import apply_faults
from motor_env.motor.model import discretize
from motor_env.simulation import recipes
from motor_env.simulation.disturbances import PER_MOTOR, PRIORS, Field
from motor_env.simulation.named_recipes import (
    RECIPES,
    changed_recipe,
    named_recipe,
    recipe_from_dict,
    recipe_to_dict,
)
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FACTORS, FaultClass, Recovery, Shift, Spread
from motor_env.simulation.sampling import apply_factors, measure_draw
from motor_env.simulation.simulate import MOST_SAMPLES


def test_a_case_does_not_depend_on_its_batch() -> None:
    whole = draw(RECIPES["bench"], 4, np.arange(100))
    part = draw(RECIPES["bench"], 4, [42, 7])
    assert np.array_equal(part.class_index, whole.class_index[[42, 7]])
    assert np.array_equal(part.factors, whole.factors[[42, 7]])
    assert not np.array_equal(draw(RECIPES["bench"], 5, np.arange(100)).class_index, whole.class_index)


def test_each_case_has_its_class_and_its_factors_in_the_parameters() -> None:
    recipe = RECIPES["bench"]
    drawn = draw(recipe, 6, np.arange(50))
    faulty = apply_faults(drawn.scenario.parameters, drawn.scenario.faults)
    for n in range(50):
        fault_class = recipe.classes[drawn.class_index[n]]
        supply, resistance, constants, inertia, friction = drawn.factors[n]
        expected = apply_faults(PAPER_MOTOR, fault_class.faults).scaled(
            resistance_ohm=resistance,
            back_emf_constant_v_s_per_rad=constants,
            torque_constant_n_m_per_a=constants,
            inertia_kg_m2=inertia,
            viscous_friction_n_m_s_per_rad=friction,
        )
        motor = faulty.motor(n)
        for field in PAPER_MOTOR.__slots__:
            assert getattr(motor, field) == pytest.approx(getattr(expected, field), rel=1e-14)
        assert np.asarray(drawn.scenario.supply.voltage_v)[n] == pytest.approx(12.0 * supply, rel=1e-15)


FROZEN = {
    "paper": ("355c11bb80fe9e2e", 4, [3.0060611, 4.0834160, 1.7064046]),
    "bench": ("7123421cb54ad0c9", 4, [2.9609051, 4.0210896, 1.7133614]),
    "bench-full": ("8a7ef59b3a23e9b4", 8, [3.2619183, 4.9620605, 1.6983169]),
    "field": ("6977fb6748f31fb6", 3, [0.1481445, 4.5364256, 1.6736329]),
    "operation": ("ac7be3c93e273e73", 4, [0.0959815, 0.8619019, 0.3125657]),
    "easy": ("156330e298a0e668", 2, [2.9952447, 4.0614142, 1.7098843]),
    "medium": ("fd52708709a2eb4e", 4, [3.0060611, 4.0834160, 1.7064046]),
    "hard": ("103432301de2d83f", 6, [3.2622778, 4.9616222, 1.6689738]),
    "small": ("ea5e9003807beb84", 5, [3.2974813, 5.0107884, 1.6883935]),
    "sensor": ("8caac7cfc3da7333", 9, [3.3046918, 5.0254264, 1.6839156]),
}
"""Of each named recipe: digest of its dictionary, and the class and three currents of one case, written in 2026.

Data sets, benchmarks and models of strangers rest on them: a change makes a new recipe and leaves the old one alone.
"""


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_named_recipes_and_their_cases_never_move(name: str) -> None:
    recipe, (digest, class_index, currents) = RECIPES[name], FROZEN[name]
    text = json.dumps(recipe_to_dict(recipe), sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest
    drawn = draw(recipe, 20, [1_234_569])
    assert drawn.class_index.tolist() == [class_index]
    read = measure_draw(drawn, recipe, 20)[0, 0, recipe.timing.n_quiet :]
    assert read[[0, 5, 50]].tolist() == pytest.approx(currents, rel=1e-5)


def test_every_number_of_a_case_comes_from_a_stream_of_its_own() -> None:
    """Classes, factors and severities belong to the motor, the supply to the start; priors to either."""
    classes = (
        FaultClass(weight=1.0),
        FaultClass(FaultKind.WINDING_SHORT, 0.1, 2.0, severity_to=0.3),
        FaultClass(FaultKind.BEARING, 0.2, 5.0, also=(FaultClass(FaultKind.NOISE, 0.5, severity_to=0.7),)),
    )
    field = named_recipe("field")
    recipe = replace(field, classes=classes, shifts=(), starts_per_motor=4, healthy_starts=1)
    cases = np.arange(40, 140)
    drawn, motor = draw(recipe, 9, cases), cases // 4
    np.testing.assert_array_equal(drawn.motor_id, motor)
    u = uniforms(9, Stream.CLASS, motor, 1)[:, 0]
    index = np.where(cases % 4 == 0, 0, np.where(u < 0.125, 0, np.where(u < 0.375, 1, 2)))
    np.testing.assert_array_equal(drawn.class_index, index)
    assert len(set(index)) == 3
    z = normals(9, Stream.MOTOR, motor, 5)
    z[:, 0] = normals(9, Stream.SUPPLY, cases, 1)[:, 0]
    np.testing.assert_allclose(drawn.factors, 1.0 + z * [0.01, 0.03, 0.02, 0.02, 0.05], rtol=1e-14)
    # Columns of the severities: bearing, contact, short, noise, magnet.
    size = uniforms(9, Stream.SEVERITY, motor, 5)
    short, noise = 0.1 + 0.2 * size[:, 2], 0.5 + 0.2 * size[:, 3]
    expected = np.where(index == 1, short, np.where(index == 2, 0.2, 0.0))
    np.testing.assert_allclose(drawn.severity, expected, rtol=1e-14)
    beside = next(fault for fault in drawn.scenario.faults if fault.kind is FaultKind.NOISE)
    np.testing.assert_allclose(beside.severity, np.where(index == 2, noise, 0.0), rtol=1e-14)
    by_motor, by_start = (
        uniforms(9, stream, numbers, 13)
        for stream, numbers in ((Stream.FIELD_MOTOR, motor), (Stream.FIELD_START, cases))
    )
    assert PRIORS[:6] == PER_MOTOR
    assert PRIORS[6:] == (
        "sensor_offset_a",
        "temperature_rise_k",
        "load_ratio",
        "ramp_s",
        "ripple_v",
        "trigger_jitter",
        "bearing_ripple_ratio",
    )
    u = np.concatenate([by_motor[:, :6], by_start[:, 6:]], axis=1)
    effects, chain = drawn.effects, drawn.chain
    assert effects is not None
    assert chain is not None
    bearing = np.where(index == 2, 0.2, 0.0)
    torque = 0.65 * 12e-7 * 12.0 / 0.02352
    for got, wanted in (
        (effects.coulomb_friction_n_m, torque * (0.3 + 0.1 * u[:, 0]) * (1.0 + bearing)),
        (effects.stribeck_friction_n_m, torque * 0.1 * u[:, 1]),
        (effects.brush_drop_v, 0.1 * u[:, 2]),
        (effects.supply_resistance_ohm, 0.02 + 0.04 * u[:, 3]),
        (effects.commutation_ripple, 0.02 * u[:, 4]),
        (chain.gain, 0.995 + 0.01 * u[:, 5]),
        (chain.offset_a, -0.0025 + 0.005 * u[:, 6]),
        (effects.temperature_rise_k, -5.0 + 20.0 * u[:, 7]),
        (effects.load_torque_n_m, torque * 0.05 * u[:, 8]),
        (effects.ramp_s, 5e-4 * u[:, 9]),
        (effects.ripple_v, 0.05 * u[:, 10]),
        (effects.delay_s, 1e-4 * 0.99 * u[:, 11]),
        (effects.bearing_ripple_n_m, torque * 0.5 * u[:, 12] * bearing),
    ):
        np.testing.assert_allclose(got, wanted, rtol=1e-12)
    assert (effects.ripple_hz, chain.lag_s, chain.range_a, chain.adc_bits) == (100.0, 2e-5, 8.2, 12)


def test_loads_of_motors_at_work() -> None:
    """Relative to the viscous torque at no-load speed; the fan's is that at this speed."""
    recipe, cases = named_recipe("operation"), np.arange(30)
    drawn = draw(recipe, 4, cases)
    assert drawn.driving is not None
    assert drawn.effects is not None
    u = uniforms(4, Stream.FIELD_START, cases, 15)
    no_load = 12.0 / 0.02352
    torque = 0.65 * 12e-7 * no_load
    np.testing.assert_allclose(drawn.effects.load_torque_n_m, torque * u[:, 8], rtol=1e-12)
    np.testing.assert_allclose(drawn.driving.load_rise_n_m, torque * (u[:, 13] - u[:, 8]), rtol=1e-12)
    np.testing.assert_allclose(drawn.driving.fan_n_m_s2 * no_load**2, torque * 0.2 * u[:, 14], rtol=1e-12)
    assert drawn.driving.resistance_ohm == 2.18
    np.testing.assert_allclose(drawn.driving.limit_v, 12.0 * drawn.factors[:, 0], rtol=1e-12)


def test_supply_factor_leaves_the_motor() -> None:
    factors = np.ones((1, 5))
    factors[0, FACTORS.index("supply")] = 2.0
    assert apply_factors(PAPER_MOTOR, factors).motor(0) == PAPER_MOTOR


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"recipe must be one of bench, .*, got 'benchh'"):
        named_recipe("benchh")
    with pytest.raises(ValueError, match=r"severity of healthy must be 0, got 0\.1"):
        FaultClass(None, 0.1)
    with pytest.raises(ValueError, match=r"severity of bearing must be a share .* got 15"):
        FaultClass(FaultKind.BEARING, 15.0)
    with pytest.raises(ValueError, match="severity of bearing must be finite and > 0, got 0"):
        FaultClass(FaultKind.BEARING)
    FaultClass(FaultKind.BEARING, 10.0)
    with pytest.raises(ValueError, match=r"severity of bearing must be a share .* got 10\.01"):
        FaultClass(FaultKind.BEARING, 0.0, severity_to=10.01)
    with pytest.raises(ValueError, match=r"severity_to of bearing must be > severity \(0\.2\), got 0\.2"):
        FaultClass(FaultKind.BEARING, 0.2, severity_to=0.2)
    with pytest.raises(ValueError, match="joint faults must be of different kinds"):
        FaultClass(FaultKind.BEARING, 0.2, also=(FaultClass(FaultKind.BEARING, 0.1),))
    with pytest.raises(TypeError, match="also must be of type FaultClass, got 3"):
        FaultClass(FaultKind.BEARING, 0.2, also=3)  # type: ignore[arg-type]  # what is refused
    Spread(friction=0.14)
    with pytest.raises(ValueError, match=r"spread of friction must be <= 0\.14, got 0\.2"):
        Spread(friction=0.2)
    with pytest.raises(ValueError, match="classes of recipe none must not be empty"):
        Recipe("none", classes=())
    with pytest.raises(ValueError, match="motor of recipe many must be one motor, got a batch"):
        Recipe("many", motor=PAPER_MOTOR.scaled(resistance_ohm=np.ones(2)))


def test_a_joint_fault_that_is_as_severe_is_named_by_its_kind() -> None:
    also: Any = "winding_contact"
    named = FaultClass(FaultKind.BEARING, 0.1, severity_to=0.3, also=also)
    assert named.also == (FaultClass(FaultKind.WINDING_CONTACT, 0.1, severity_to=0.3),)
    assert named == FaultClass(FaultKind.BEARING, 0.1, severity_to=0.3, also=(also,))


def test_no_factor_can_reach_zero_at_the_largest_spread() -> None:
    # The largest normal number that 32-bit words can give (Box & Muller): sqrt(-2 ln(2^-33)) = 6.76.
    assert 1.0 - recipes.LARGEST_SPREAD * np.sqrt(-2.0 * np.log(2.0**-33)) > 0.0


@pytest.mark.parametrize(
    ("good", "bad", "sentence"),
    [
        (
            {"starts_per_motor": 1},
            {"starts_per_motor": 0},
            "starts_per_motor must be a whole number in 1 .. 1000000000, got 0",
        ),
        (
            {"starts_per_motor": 10**9},
            {"starts_per_motor": 10**9 + 1},
            "starts_per_motor must be a whole number in 1 .. 1000000000",
        ),
        (
            {"starts_per_motor": 3, "healthy_starts": 3},
            {"starts_per_motor": 3, "healthy_starts": 4},
            "healthy_starts must be in 0 .. starts_per_motor",
        ),
        (
            {"classes": (FaultClass(weight=0.0), FaultClass(FaultKind.BEARING, 0.1))},
            {"classes": (FaultClass(weight=0.0),)},
            "weights of recipe bench must not all be 0",
        ),
        (
            {"classes": (FaultClass(FaultKind.BEARING, 0.1),)},
            {"classes": (FaultClass(FaultKind.BEARING, 0.1),), "starts_per_motor": 2, "healthy_starts": 1},
            "healthy_starts need a healthy class",
        ),
        ({}, {"classes": (FaultClass(), FaultClass())}, "classes of recipe bench must differ"),
        ({}, {"name": "two\nlines"}, "name must be one line"),
    ],
)
def test_bounds_of_a_recipe(good: dict[str, Any], bad: dict[str, Any], sentence: str) -> None:
    replace(RECIPES["bench"], **good)
    with pytest.raises(ValueError, match=sentence):
        replace(RECIPES["bench"], **bad)


@pytest.mark.parametrize(
    ("good", "bad", "sentence"),
    [
        (
            {"trigger_jitter": (0.0, 0.999)},
            {"trigger_jitter": (0.0, 1.0)},
            "field.trigger_jitter must be < 1, got 1",
        ),
        ({"sensor_gain": (1e-3, 1.0)}, {"sensor_gain": (0.0, 1.0)}, "field.sensor_gain must be > 0, got 0"),
        (
            {"temperature_rise_k": (-250.0, 900.0)},
            {"temperature_rise_k": (-250.1, 0.0)},
            "field.temperature_rise_k must be in -250 .. 900, got",
        ),
        ({}, {"temperature_rise_k": (0.0, 900.1)}, "field.temperature_rise_k must be in -250 .. 900, got"),
        (
            {"sensor_offset_a": (-1.0, -1.0)},
            {"load_ratio": (-0.1, 1.0)},
            "field.load_ratio must be >= 0, got -0.1",
        ),
    ],
)
def test_bounds_of_a_field(good: dict[str, Any], bad: dict[str, Any], sentence: str) -> None:
    Field(**good)
    with pytest.raises(ValueError, match=sentence):
        Field(**bad)


def test_a_transient_has_a_longest_length() -> None:
    assert MOST_SAMPLES == 10_000_000
    assert Timing(1e4, 999.0, 1.0).n_samples == MOST_SAMPLES
    with pytest.raises(
        ValueError, match=r"must hold at most 10000000 samples at 10000 Hz, got 1\.00001e\+07"
    ):
        Timing(1e4, 999.0, 1.01)


def test_what_is_named_changes_and_nothing_else() -> None:
    bench = named_recipe("bench")
    changed = changed_recipe(
        bench,
        voltage_v=6.0,
        sampling_rate_hz=500.0,
        duration_s=0.3,
        quiet_s=0.1,
        current_noise_a=0.5,
        channels=("speed",),
    )
    assert (changed.supply.voltage_v, changed.timing) == (6.0, Timing(500.0, 0.3, 0.1))
    assert (changed.sensor.current_noise_a, changed.sensor.channels) == (0.5, ("speed",))
    back = replace(changed, supply=bench.supply, timing=bench.timing, sensor=bench.sensor)
    assert back == bench == changed_recipe(bench)


def test_a_shift_changes_each_thing_that_it_names() -> None:
    changes: dict[str, Any] = {
        "classes": (FaultClass(), FaultClass(FaultKind.NOISE, 0.5)),
        "sensor": SensorParameters(current_noise_a=0.1),
        "spread": Spread(inertia=0.1),
        "field": Field(load_ratio=(0.1, 0.2)),
    }
    whole = Shift("whole", **changes)
    recipe = replace(named_recipe("bench"), shifts=(whole, *(Shift(n, **{n: changes[n]}) for n in changes)))
    assert recipe.shifted("whole") == replace(recipe, **changes)
    for name, value in changes.items():
        assert recipe.shifted(name) == replace(recipe, **{name: value})


LOOSE = Recovery(mean_duration_s=0.004, mean_pause_s=0.002)


def acts_by_hand(seed: int, case: int, count: int) -> list[bool]:
    """Whether the fault of a case of `LOOSE` acts in each interval of 0.1 ms: times of 40 and 20 in the mean."""
    u, acts = uniforms(seed, Stream.RECOVERY, [case], count)[0], []
    for m in range(count):
        lasts = 1 + math.floor(math.log(u[m]) / math.log(1.0 - 1.0 / (20 if m % 2 else 40)))
        acts += [m % 2 == 0] * lasts
    return acts[:count]


def test_a_loose_contact_comes_and_goes() -> None:
    classes = (
        FaultClass(),
        FaultClass(FaultKind.WINDING_CONTACT, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.25, recovery=LOOSE),
        FaultClass(FaultKind("current_dead"), 1.0, recovery=LOOSE),
    )
    recipe = replace(RECIPES["bench"], classes=classes, sensor=SensorParameters(current_noise_a=0.0))
    assert recipe.class_names[2] == "winding_contact_25_recovers"
    assert recipe_from_dict(recipe_to_dict(recipe)) == recipe
    drawn = draw(recipe, 6, np.arange(30))
    found = measure_draw(drawn, recipe, 6)[:, 0]
    share: list[bool] = []
    for n, which in enumerate(drawn.class_index.tolist()):
        motor, volts = (
            drawn.scenario.parameters.motor(n),
            float(np.asarray(drawn.scenario.supply.voltage_v)[n]),
        )
        worse = discretize(motor.scaled(resistance_ohm=1.25), 1e-4)
        acts, state = acts_by_hand(6, n, 1000) if which > 1 else [which == 1] * 1000, np.zeros(2)
        for k, reading in enumerate(found[n]):
            model = worse if acts[k] and which in (1, 2) else discretize(motor, 1e-4)
            state = model.transition @ state + model.gain[:, 0] * volts
            assert reading == pytest.approx(0.0 if acts[k] and which == 3 else state[0], rel=2e-5, abs=1e-5)
        share += acts if which > 1 else []
    assert np.mean(share) == pytest.approx(2.0 / 3.0, abs=0.03)
    with pytest.raises(ValueError, match="a fault of the motor cannot have a recovery beside a table field"):
        replace(RECIPES["field"], classes=classes[:3])
    with pytest.raises(ValueError, match="faults that stay for this, got winding_contact_25_recovers"):
        replace(recipe, classes=classes[:3]).require_motor_faults()
