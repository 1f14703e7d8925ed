"""Recipes, named and of a motor: frozen numbers, the stream of each number, spreads, refusals."""

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    FaultKind,
    InputError,
    Motor,
    Recipe,
    SensorParameters,
    Timing,
    draw,
    load_motor,
)
from motor_env.motor.data_sheet import Tolerance
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.motor.model import discretize
from motor_env.simulation import recipes
from motor_env.simulation.disturbances import PER_MOTOR, PRIORS, Field
from motor_env.simulation.named_recipes import (
    RECIPES,
    changed_recipe,
    motor_recipe,
    named_recipe,
    recipe_from_dict,
    recipe_to_dict,
    settling_timing,
)
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FaultClass, Recovery, Shift, Spread
from motor_env.simulation.sampling import measure_draw


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_recipe_survives_its_dictionary_and_a_case_its_batch(name: str) -> None:
    recipe = RECIPES[name]
    assert recipe_from_dict(recipe_to_dict(recipe)) == recipe
    whole, part = (draw(recipe, 4, cases) for cases in (np.arange(20), [13, 7]))
    assert np.array_equal(part.class_index, whole.class_index[[13, 7]])
    assert np.array_equal(part.factors, whole.factors[[13, 7]])
    assert np.array_equal(measure_draw(part, recipe, 4), measure_draw(whole, recipe, 4)[[13, 7]])
    assert not np.array_equal(draw(recipe, 5, np.arange(20)).factors, whole.factors) or not any(
        astuple(recipe.spread)
    )


def test_the_factors_of_a_case_are_in_its_motor_and_its_supply() -> None:
    scenario, factors = (drawn := draw(RECIPES["bench"], 6, np.arange(50))).scenario, drawn.factors.T
    constants = dict.fromkeys(("back_emf_constant_v_s_per_rad", "torque_constant_n_m_per_a"), factors[2])
    names = {"resistance_ohm": 1, "inertia_kg_m2": 3, "viscous_friction_n_m_s_per_rad": 4}
    motors = PAPER_MOTOR.scaled(**constants, **{name: factors[row] for name, row in names.items()})
    for name in PAPER_MOTOR.__slots__:
        np.testing.assert_allclose(getattr(scenario.parameters, name), getattr(motors, name), rtol=1e-14)
    np.testing.assert_allclose(scenario.supply.voltage_v, 12.0 * factors[0], rtol=1e-15)


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
    by_start_alone = (
        "sensor_offset_a temperature_rise_k load_ratio ramp_s ripple_v trigger_jitter bearing_ripple_ratio"
    )
    assert PRIORS[6:] == tuple(by_start_alone.split())
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


def of_bearings(severity: float = 0.2, **more: Any) -> FaultClass:
    return FaultClass(FaultKind.BEARING, severity, **more)


def test_a_joint_fault_that_is_as_severe_is_named_by_its_kind() -> None:
    joint = (FaultClass(FaultKind.WINDING_CONTACT, 0.2, severity_to=0.3),)
    for also in ("winding_contact", ("winding_contact",), joint):
        assert of_bearings(severity_to=0.3, also=also).also == joint


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: of_bearings(10.01), r"severity of bearing must be a share .* got 10\.01"),
        (lambda: of_bearings(severity_to=0.2), "severity_to of bearing must be > severity"),
        (lambda: of_bearings(also=(of_bearings(),)), "joint faults must be of different kinds"),
        (lambda: Spread(friction=0.2), r"spread of friction must be <= 0\.14, got 0\.2"),
        (lambda: changed(motor=PAPER_MOTOR.scaled(resistance_ohm=np.ones(2))), "must be one motor"),
        (lambda: changed(starts_per_motor=3, healthy_starts=4), "healthy_starts must be in"),
        (lambda: changed(classes=(FaultClass(weight=0.0),)), "weights of recipe bench must not all be 0"),
        (lambda: changed(classes=(of_bearings(),), starts_per_motor=2, healthy_starts=1), "a healthy class"),
        (lambda: changed(classes=(FaultClass(), FaultClass())), "classes of recipe bench must differ"),
        (lambda: Field(temperature_rise_k=(-250.1, 0.0)), "field.temperature_rise_k must be in -250 .. 900"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make()


def changed(**changes: Any) -> Recipe:
    return replace(RECIPES["bench"], **changes)


def test_no_factor_can_reach_zero_at_the_largest_spread() -> None:
    # The largest normal number that 32-bit words can give (Box & Muller): sqrt(-2 ln(2^-33)) = 6.76.
    assert 1.0 - recipes.LARGEST_SPREAD * np.sqrt(-2.0 * np.log(2.0**-33)) > 0.0


def test_what_is_named_changes_and_nothing_else() -> None:
    bench = named_recipe("bench")
    timing = {"sampling_rate_hz": 500.0, "duration_s": 0.3, "quiet_s": 0.1}
    found = changed_recipe(bench, voltage_v=6.0, current_noise_a=0.5, channels=("speed",), **timing)
    assert (found.supply.voltage_v, found.timing) == (6.0, Timing(500.0, 0.3, 0.1))
    assert (found.sensor.current_noise_a, found.sensor.channels) == (0.5, ("speed",))
    back = replace(found, supply=bench.supply, timing=bench.timing, sensor=bench.sensor)
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
    recipe = changed(classes=classes, sensor=SensorParameters(current_noise_a=0.0))
    assert recipe.class_names[2] == "winding_contact_25_recovers"
    assert recipe_from_dict(recipe_to_dict(recipe)) == recipe
    drawn = draw(recipe, 6, np.arange(12))
    share: list[bool] = []
    assert set(drawn.class_index.tolist()) == {0, 1, 2, 3}
    volts = np.asarray(drawn.scenario.supply.voltage_v)
    for n, (which, found) in enumerate(
        zip(drawn.class_index, measure_draw(drawn, recipe, 6)[:, 0], strict=True)
    ):
        motor = drawn.scenario.parameters.motor(n)
        models = [discretize(motor.scaled(resistance_ohm=ohm), 1e-4) for ohm in (1.0, 1.25)]
        acts, state = acts_by_hand(6, n, 1000) if which > 1 else [which == 1] * 1000, np.zeros(2)
        for now, reading in zip(acts, found.tolist(), strict=True):
            model = models[int(now and which in (1, 2))]
            state = model.transition @ state + model.gain[:, 0] * volts[n]
            wanted = 0.0 if now and which == 3 else state[0]
            assert abs(reading - wanted) < 2e-5 * abs(wanted) + 1e-5
        share += acts if which > 1 else []
    assert np.mean(share) == pytest.approx(2.0 / 3.0, abs=0.05)
    with pytest.raises(ValueError, match="a fault of the motor cannot have a recovery beside a table field"):
        replace(RECIPES["field"], classes=classes[:3])
    with pytest.raises(ValueError, match="faults that stay for this, got winding_contact_25_recovers"):
        replace(recipe, classes=classes[:3]).require_motor_faults()


SHEET = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml")
TAUGHT = Starts(
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
    starts=TAUGHT,
)
PLAIN = replace(HEALTHY, starts=replace(TAUGHT, model=(), model_low=(), model_high=()))
COMMISSIONED = Motor("m", "commissioned", PAPER_MOTOR, 12.0, healthy=HEALTHY)


def test_a_data_sheet_gives_its_tolerances() -> None:
    recipe = motor_recipe(SHEET)
    assert (recipe.motor, recipe.spread.friction, recipe.field) == (SHEET.parameters, 0.03, None)
    assert recipe.spread.resistance == pytest.approx(np.hypot(0.02, 0.0393))
    assert recipe.sensor.current_noise_a == 0.02


@pytest.mark.parametrize(("degrees", "wider"), [(8.0, np.sqrt(8.0 / 6.0)), (2.0, np.sqrt(3.0))])
def test_a_commissioned_motor_gives_the_spread_of_its_starts(degrees: float, wider: float) -> None:
    """Of a Student t; one of two or fewer degrees has no variance, and counts as one of three."""
    recipe = motor_recipe(replace(COMMISSIONED, healthy=replace(HEALTHY, degrees_of_freedom=degrees)))
    # K^2/J scatters by 0.04, of which K bears half.
    assert recipe.spread.std / wider == pytest.approx([0.01 / wider, 0.02, 0.02, 0.0, 0.03])
    assert recipe.sensor.current_noise_a == pytest.approx(np.exp(-4.0))
    assert recipe.timing == Timing(6_000.0, 0.08, 0.02)
    assert recipe.field is not None
    assert recipe.field.ramp_s == (0.001, 0.002)
    assert recipe.field.sensor_lag_s == pytest.approx(0.0002)
    assert np.isfinite(measure_draw(draw(recipe, 1, [0, 1]), recipe, 1)).all()


def test_dry_friction_brushes_and_a_lag_become_a_field() -> None:
    """Dry friction relative to the viscous torque at no-load speed, the lag in the geometric middle of its range."""
    healthy = replace(HEALTHY, starts=replace(TAUGHT, model_low=(0.001, 0.0001), model_high=(0.002, 0.0004)))
    motor = replace(COMMISSIONED, healthy=healthy, coulomb_friction_n_m=1e-4, brush_drop_v=0.3)
    field = motor_recipe(motor).field
    assert field is not None
    ratio = 1e-4 / (12e-7 * 12.0 / 0.02352)
    assert field.coulomb_ratio == pytest.approx((ratio, ratio))
    assert field.brush_drop_v == (0.3, 0.3)
    assert field.ramp_s == (0.001, 0.002)
    assert field.trigger_jitter == (0.0, 0.99)
    assert field.sensor_lag_s == pytest.approx(2e-4)


def test_what_cannot_be_drawn_of_a_motor_is_refused() -> None:
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
