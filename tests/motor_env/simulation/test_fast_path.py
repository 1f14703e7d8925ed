"""The compiled pass, of starts and of motors at work, against independent ways to the same readings."""

import re
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal
from scipy.integrate import solve_ivp

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    MotorParameters,
    Recipe,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    draw,
    simulate,
)
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.disturbances import PROFILES, Duty
from motor_env.simulation.fast_path import measure
from motor_env.simulation.named_recipes import RECIPES, named_recipe
from motor_env.simulation.nonlinear import Effects, Sampling, integrate
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.sampling import Draw, measure_draw
from motor_env.simulation.sensor import SensorChain

LATE = Scenario(PAPER_MOTOR, (Fault(FaultKind.BEARING, 0.1, onset_s=0.01),))
BOTH = SensorParameters(channels=(Channel.SPEED, Channel.CURRENT))
SILENT = SensorParameters(
    channels=(Channel.CURRENT, Channel.SPEED), current_noise_a=0.0, speed_noise_rad_s=0.0
)


@pytest.mark.parametrize("quiet_s", [0.0, 0.0013])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"load_torque_n_m": 1e-4},
        {
            "faults": (
                Fault(FaultKind.BEARING, 0.3, onset_s=0.004),
                Fault(FaultKind.NOISE, 0.5, onset_s=0.003),
            )
        },
        {"faults": (Fault(FaultKind.NOISE, 2.0),)},
        {"faults": (Fault(FaultKind.NOISE, np.linspace(0.0, 3.0, 30)),)},
        {"process_noise_std": (0.01, 0.5)},
    ],
)
def test_measure_is_simulate_in_float32(quiet_s: float, changes: dict[str, object]) -> None:
    recipe = replace(RECIPES["bench"], sensor=BOTH, timing=Timing(duration_s=0.0203, quiet_s=quiet_s))
    drawn = draw(recipe, 3, np.arange(30))
    scenario = replace(drawn.scenario, **changes)  # type: ignore[arg-type]  # fields by name
    expected = simulate(scenario, 3, drawn.cases).measurements
    got = measure(scenario, 3, drawn.cases)
    scale = np.abs(expected).max(axis=(0, 2), keepdims=True)
    assert np.abs((got - expected) / scale).max() < 3e-7


def rates(
    t: float, x: FloatArray, motor: MotorParameters, e: Any, volts: float, **load: float
) -> list[float]:
    """Derivatives of current, speed, angle and heat of a motor with effects, the equations written anew."""
    i, w, angle, heat = x
    r = motor.resistance_ohm * (1.0 + 0.00393 * e.temperature_rise_k) * (1.0 + 0.00393 * heat)
    s = 1.0 if e.ramp_s == 0.0 else min(t / e.ramp_s, 1.0)
    v = (volts + e.ripple_v * np.cos(2 * np.pi * e.ripple_hz * t)) * (3 * s**2 - 2 * s**3)
    v -= e.brush_drop_v * i / np.hypot(i, 0.02) + e.supply_resistance_ohm * i
    dry = e.coulomb_friction_n_m + e.stribeck_friction_n_m / (1 + (w / e.stribeck_speed_rad_s) ** 2)
    dry += e.load_torque_n_m + e.bearing_ripple_n_m * np.cos(e.bearing_per_turn * angle)
    dry += load.get("rise", 0.0) * t + load.get("fan", 0.0) * w * w
    flux = 1.0 - 0.001 * e.temperature_rise_k
    k = flux * (1 + e.commutation_ripple * np.cos(e.commutation_per_turn * angle))
    drag = motor.viscous_friction_n_m_s_per_rad * w + dry * w / np.hypot(w, 1.0)
    return [
        (v - r * i - flux * motor.back_emf_constant_v_s_per_rad * w) / motor.inductance_h,
        (motor.torque_constant_n_m_per_a * k * i - drag) / motor.inertia_kg_m2,
        w,
        (i * i * r - heat / e.thermal_resistance_k_per_w) / e.heat_capacity_j_per_k,
    ]


def reference(effects: Effects, voltage: float, times: FloatArray) -> FloatArray:
    """Current and speed of the paper's motor with effects, by a stiff solver."""
    moving = partial(rates, motor=PAPER_MOTOR, e=effects, volts=voltage)
    answer = solve_ivp(
        moving,
        (0.0, float(times[-1])),
        np.zeros(4),
        "LSODA",
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
        max_step=5e-4,
    )
    states: FloatArray = answer.y[:2]
    return states


FIELD_LIKE = Effects(
    coulomb_friction_n_m=2e-4,
    stribeck_friction_n_m=6e-5,
    brush_drop_v=0.1,
    temperature_rise_k=15.0,
    supply_resistance_ohm=0.06,
    ramp_s=2.5e-4,
    ripple_v=0.05,
    ripple_hz=100.0,
    load_torque_n_m=3e-5,
    commutation_ripple=0.02,
    bearing_ripple_n_m=1e-4,
    delay_s=3.7e-5,
)


@pytest.mark.parametrize(
    ("effects", "tolerance"),
    [(FIELD_LIKE, 1e-4), (replace(FIELD_LIKE, ramp_s=0.0), 4e-4), (Effects(), 1e-3)],
    ids=["field", "hard step", "textbook motor"],
)
def test_the_nonlinear_motor_agrees_with_a_stiff_solver(effects: Effects, tolerance: float) -> None:
    """The error relative to the peak; the textbook motor's is that of a bare step, the worst for a fixed step."""
    timing = Timing(duration_s=0.02)
    expected = reference(effects, 12.0, timing.time_s - effects.delay_s)
    got = measure(Scenario(PAPER_MOTOR, sensor=SILENT, timing=timing), 0, [0], effects=effects)[0]
    for channel in range(2):
        assert np.abs(got[channel] - expected[channel]).max() < tolerance * np.abs(expected[channel]).max()


STRONG = Effects(
    coulomb_friction_n_m=4e-3,
    stribeck_friction_n_m=3e-3,
    stribeck_speed_rad_s=40.0,
    brush_drop_v=0.5,
    temperature_rise_k=40.0,
    supply_resistance_ohm=0.5,
    ramp_s=2e-3,
    ripple_v=1.0,
    ripple_hz=200.0,
    load_torque_n_m=2e-3,
    commutation_ripple=0.2,
    commutation_per_turn=5.0,
    bearing_ripple_n_m=2e-3,
    delay_s=3.7e-5,
    heat_capacity_j_per_k=0.02,
    thermal_resistance_k_per_w=2.0,
)
"""Every effect so large that a small change of any term of the equations shows."""


def test_strong_effects_in_fine_steps_are_those_of_a_stiff_solver() -> None:
    timing = Timing(duration_s=0.02)
    expected = reference(STRONG, 12.0, timing.time_s - STRONG.delay_s)
    out = np.empty((1, 2, timing.n_samples), dtype=np.float32)
    integrate(PAPER_MOTOR, STRONG, 12.0, Sampling(1e-4, 40, np.array([True, False]), out), 0)
    assert (np.abs(out[0] - expected).max(axis=1) < 2e-6 * np.abs(expected).max(axis=1)).all()


def test_the_sensor_chain_step_by_step() -> None:
    scenario = Scenario(PAPER_MOTOR, sensor=SILENT)

    def chained(volts: float = 12.0, **chain: float) -> FloatArray:
        powered, sensed = replace(scenario, supply=SupplyParameters(volts)), SensorChain(**chain)  # type: ignore[arg-type]  # by name
        measured: FloatArray = measure(powered, 0, [0], chain=sensed)[0].astype(np.float64)
        return measured

    (true, speed), step = chained(), 8.0 / 256
    np.testing.assert_allclose(chained(gain=1.1, offset_a=0.01)[0], 1.1 * true + 0.01, atol=1e-6)
    kept = np.exp(-1e-4 / 3e-4)
    lagged = signal.lfilter([1.0 - kept], [1.0, -kept], true)
    np.testing.assert_allclose(chained(lag_s=3e-4)[0], lagged, atol=1e-5)
    coarse = np.clip(np.round(true / step) * step, -4.0, 4.0 - step)
    assert np.abs(chained(range_a=4.0, adc_bits=8)[0] - coarse).max() <= step
    assert np.mean(chained(range_a=4.0, adc_bits=8)[0] == coarse) > 0.99  # but for ties
    assert chained(-12.0, range_a=4.0, adc_bits=8)[0].min() == -4.0
    np.testing.assert_allclose(chained(range_a=4.0)[0], np.minimum(true, 4.0), atol=1e-6)
    np.testing.assert_allclose(chained(-12.0, range_a=4.0)[0], np.maximum(-true, -4.0), atol=1e-6)
    lost = uniforms(0, Stream.MISSING, [0], 1000)[0] < 0.2  # of every channel together
    np.testing.assert_array_equal(
        chained(missing_fraction=0.2), np.where(lost, np.nan, np.array([true, speed]))
    )


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: SensorChain(adc_bits=12), "range_a must be > 0"),
        (lambda: SensorChain(range_a=1.0, adc_bits=25), r"adc_bits must be in 0 \.\. 24, got 25"),
        (lambda: SensorChain(missing_fraction=1.0), r"missing_fraction must be in \[0, 1\), got 1"),
        (lambda: Effects(brush_drop_v=-1.0), "brush_drop_v must be finite and >= 0, got -1"),
        (lambda: measure(LATE, 0, [0], effects=Effects()), "faults without an onset"),
        (lambda: measure(Scenario(PAPER_MOTOR), 0, [0], effects=Effects(delay_s=1e-4)), "delay_s must be <"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make()


OPERATION = named_recipe("operation")


def solved(drawn: Draw, n: int, voltage_v: NDArray[np.float32], dt_s: float) -> FloatArray:
    """Current and speed of case n by a stiff solver: loads that never stand still."""
    assert drawn.effects is not None
    assert drawn.driving is not None
    motor = apply_faults(drawn.scenario.parameters, drawn.scenario.faults).motor(n)
    of_case = {name: np.ravel(each)[n % np.size(each)] for name, each in vars_of(drawn.effects).items()}
    rise = drawn.driving.load_rise_n_m[n] / (len(voltage_v) * dt_s)
    given, state, rows = {"rise": rise, "fan": drawn.driving.fan_n_m_s2[n]}, np.zeros(4), []
    for k, volts in enumerate(voltage_v.tolist()):
        moving = partial(rates, motor=motor, e=SimpleNamespace(**of_case), volts=volts, **given)
        state = solve_ivp(moving, (k * dt_s, (k + 1) * dt_s), state, "LSODA", rtol=1e-6, atol=1e-8).y[:, -1]
        rows.append(state[:2])
    return np.array(rows).T


def vars_of(effects: Effects) -> dict[str, Any]:
    return {field.name: getattr(effects, field.name) for field in fields(effects)}


def test_every_profile_agrees_with_a_stiff_solver() -> None:
    recipe = replace(OPERATION, sensor=SILENT, timing=Timing(1_000.0, 0.08))
    assert recipe.duty is not None
    for n, name in enumerate(PROFILES):
        one = replace(recipe, duty=replace(recipe.duty, profiles=(name,)))
        drawn = draw(one, 1, [n])
        (read,) = measure_draw(drawn, one, 1)
        expected = solved(drawn, 0, read[2], one.timing.dt_s)
        peak = np.abs(expected).max(axis=1, keepdims=True)
        assert np.abs((read[:2] - expected) / peak).max() < 3e-3, name


@pytest.mark.parametrize("channels", [("current", "speed"), ("speed", "current")])
def test_a_loop_follows_from_what_was_recorded_and_a_replay_gives_the_same(channels: tuple[str, ...]) -> None:
    sensor = SensorParameters(channels, 0.02, 5.0)  # type: ignore[arg-type]  # names are taken too
    recipe = replace(OPERATION, sensor=sensor, timing=Timing(1_000.0, 0.1))
    drawn = draw(recipe, 2, np.arange(30))
    assert drawn.driving is not None
    read, place = measure_draw(drawn, recipe, 2), channels.index("current")
    rows = np.flatnonzero(drawn.driving.is_loop)
    assert len(rows) >= 2
    for n in rows:
        limit, integral, volts = drawn.driving.limit_v[n], 0.0, drawn.driving.voltage_v[n, 0]
        for k, wanted in enumerate(drawn.driving.voltage_v[n]):
            if k > 0:
                error = wanted - (read[n, 2, k - 1] - 2.18 * read[n, place, k - 1])
                integral = np.clip(integral + 0.05 * error, -limit, limit)
                volts = np.clip(wanted + 0.5 * error + integral, -limit, limit)
            assert read[n, 2, k] == pytest.approx(volts, abs=1e-4)
    applied = drawn.driving._replace(voltage_v=read[:, 2].astype(float), is_loop=np.zeros(30, bool))
    np.testing.assert_array_equal(measure_draw(drawn._replace(driving=applied), recipe, 2), read)


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_sample_by_sample(name: str) -> None:
    """The formulas anew: pace log-uniform in hold_s, size 0.4 to 1, a level from a uniform number of its own."""
    timing = Timing(1_000.0, 2.0)
    u = np.random.default_rng(5).random((3, 68))
    share, is_loop = Duty(profiles=(name,), hold_s=(0.02, 0.05)).profile(u, timing)
    assert (is_loop == (name == "speed_loop")).all()
    for row, one in zip(share, u, strict=True):
        pace, size = 0.02 * 2.5 ** one[1], 0.4 + 0.6 * one[2]
        for k, got in enumerate(row):
            at = k * 1e-3 / pace + one[3]
            place = int(at)
            level = one[4 + place % 64]
            expected = {
                "steps": 0.2 + 0.8 * level,
                "reversals": size if place % 2 == 0 else -size,
                "staircase": size * (0.2, 0.4, 0.6, 0.8, 1.0, 0.8, 0.6, 0.4)[place % 8],
                "binary": size if level >= 0.5 else 0.3 * size,
                "sine": size * np.sin(np.pi / 2.0 * at),
                "speed_loop": np.sign(level - 0.5) * (0.2 + 0.7 * abs(2.0 * level - 1.0)),
            }[name]
            assert got == pytest.approx(expected, rel=1e-12, abs=1e-12)


def operating(**changes: Any) -> Recipe:
    return replace(OPERATION, shifts=(), **changes)


def blind() -> None:
    recipe = replace(OPERATION, sensor=SensorParameters((Channel.SPEED,)))
    measure_draw(draw(recipe, 1, np.arange(20)), recipe, 1)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: operating(field=None), "needs a table field beside it"),
        (lambda: operating(timing=Timing(1_000.0, 0.5, 0.1)), "needs a table field beside it"),
        (lambda: operating(field=named_recipe("field").field), "ramp_s and trigger_jitter of"),
        (lambda: Duty(profiles=("ramp",)), "duty.profiles must be among steps"),
        (lambda: Duty(hold_s=(0.0, 0.1)), "duty.hold_s must be > 0, got 0"),
        (lambda: Duty(fan_ratio=(1.0, 0.0)), "duty.fan_ratio must be a finite"),
        (lambda: OPERATION.nominal_voltage_v, "recipe operation has a voltage of its own in each case"),
        (blind, "a speed loop needs the current among the channels"),
    ],
)
def test_what_a_duty_cannot_be_is_refused(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        make()
