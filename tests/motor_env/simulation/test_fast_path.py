"""The compiled pass against independent ways to the same transient."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    draw,
    simulate,
)
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.fast_path import measure
from motor_env.simulation.named_recipes import RECIPES
from motor_env.simulation.nonlinear import Effects, Sampling, integrate, substeps
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.sampling import measure_draw
from motor_env.simulation.sensor import SensorChain

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


def test_effects_that_are_not_told() -> None:
    """Recipes do not name them, so every case in the field rests on them."""
    e = Effects()
    told = (e.stribeck_speed_rad_s, e.commutation_per_turn, e.bearing_per_turn)
    assert told == (5.0, 14.0, 3.1)
    assert (e.heat_capacity_j_per_k, e.thermal_resistance_k_per_w) == (3.87, 3.1)


def reference(effects: Effects, voltage: float, times: FloatArray) -> FloatArray:
    """Current and speed of the paper's motor with effects: the equations written anew, a stiff solver."""
    e, m = effects, PAPER_MOTOR
    cold, hot = float(m.resistance_ohm), 1.0 + 0.00393 * e.temperature_rise_k
    flux = 1.0 - 0.001 * e.temperature_rise_k

    def rates(t: float, x: FloatArray) -> list[float]:
        i, w, angle, heat = x
        r = cold * hot * (1.0 + 0.00393 * heat)
        s = 1.0 if e.ramp_s == 0.0 else min(t / e.ramp_s, 1.0)
        v = (voltage + e.ripple_v * np.cos(2 * np.pi * e.ripple_hz * t)) * (3 * s**2 - 2 * s**3)
        v -= e.brush_drop_v * i / np.hypot(i, 0.02) + e.supply_resistance_ohm * i
        sign = w / np.hypot(w, 1.0)
        dry = e.coulomb_friction_n_m + e.stribeck_friction_n_m / (1 + (w / e.stribeck_speed_rad_s) ** 2)
        dry += e.load_torque_n_m + e.bearing_ripple_n_m * np.cos(e.bearing_per_turn * angle)
        k = flux * (1 + e.commutation_ripple * np.cos(e.commutation_per_turn * angle))
        torque = m.torque_constant_n_m_per_a * k * i - m.viscous_friction_n_m_s_per_rad * w - dry * sign
        return [
            (v - r * i - flux * m.back_emf_constant_v_s_per_rad * w) / m.inductance_h,
            torque / m.inertia_kg_m2,
            w,
            (i * i * r - heat / e.thermal_resistance_k_per_w) / e.heat_capacity_j_per_k,
        ]

    last = float(times[-1])
    answer = solve_ivp(
        rates, (0.0, last), np.zeros(4), method="LSODA", t_eval=times, rtol=1e-9, atol=1e-11, max_step=5e-4
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


@pytest.mark.parametrize("count", [1, 4, 17])
def test_steps_of_the_integration_follow_from_the_fastest_process(count: int) -> None:
    """4.3 an electrical time constant and 12 a period of the ripple: one less just below, one more just above."""
    constant = 0.238e-3 / 2.18
    for largest, ripple_hz in ((constant / 4.3, 0.0), (1.0 / (12.0 * 5e4), 5e4)):
        assert substeps(PAPER_MOTOR, 0.999 * count * largest, ripple_hz) == count
        assert substeps(PAPER_MOTOR, 1.001 * count * largest, ripple_hz) == count + 1
    assert substeps(PAPER_MOTOR, 9_999.5 * constant / 4.3) == 10_000
    with pytest.raises(ValueError, match="must hold at most 10000 integration steps, got 10001"):
        substeps(PAPER_MOTOR, 10_000.5 * constant / 4.3)


def test_a_field_case_does_not_depend_on_its_batch() -> None:
    recipe = RECIPES["field"]
    together = measure_draw(draw(recipe, 4, np.arange(20)), recipe, 4)
    alone = measure_draw(draw(recipe, 4, [13]), recipe, 4)
    assert np.array_equal(together[13:14], alone)


def test_the_sensor_chain_step_by_step() -> None:
    timing = Timing()
    scenario = Scenario(PAPER_MOTOR, sensor=replace(SILENT, channels=(Channel.CURRENT,)), timing=timing)
    true = measure(scenario, 0, [0])[0, 0].astype(np.float64)
    gained = measure(scenario, 0, [0], chain=SensorChain(gain=1.1, offset_a=0.01))[0, 0]
    np.testing.assert_allclose(gained, 1.1 * true + 0.01, atol=1e-6)
    lagged = measure(scenario, 0, [0], chain=SensorChain(lag_s=3e-4))[0, 0]
    kept, value = np.exp(-1e-4 / 3e-4), 0.0
    for k, current in enumerate(true):
        value = kept * value + (1.0 - kept) * current
        assert lagged[k] == pytest.approx(value, abs=1e-5)
    coarse = measure(scenario, 0, [0], chain=SensorChain(range_a=4.0, adc_bits=8))[0, 0]
    step = 8.0 / 256
    assert np.array_equal(coarse, (coarse / step).round() * step)
    inside = true < 3.9
    assert np.abs(coarse - true)[inside].max() <= step / 2 + 1e-6
    assert coarse.max() == pytest.approx(4.0 - step)
    back = replace(scenario, supply=SupplyParameters(-12.0))
    assert measure(back, 0, [0], chain=SensorChain(range_a=4.0, adc_bits=8))[0, 0].min() == -4.0
    clipped = measure(back, 0, [0], chain=SensorChain(range_a=4.0))[0, 0]
    np.testing.assert_allclose(clipped, np.maximum(-true, -4.0), atol=1e-6)
    np.testing.assert_allclose(
        measure(scenario, 0, [0], chain=SensorChain(range_a=4.0))[0, 0], np.minimum(true, 4.0), atol=1e-6
    )
    lost = measure(scenario, 0, [0], chain=SensorChain(missing_fraction=0.2))[0, 0]
    assert np.array_equal(np.isnan(lost), uniforms(0, Stream.MISSING, [0], timing.n_samples)[0] < 0.2)
    assert np.array_equal(lost[~np.isnan(lost)], true[~np.isnan(lost)].astype(np.float32))
    two = replace(scenario, sensor=SensorParameters((Channel.CURRENT, Channel.SPEED), 0.0, 0.0))
    both = measure(two, 0, [0], chain=SensorChain(missing_fraction=0.2))[0]
    assert np.array_equal(np.isnan(both), np.isnan([lost, lost]))  # of every channel together


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="range_a must be > 0"):
        SensorChain(adc_bits=12)
    SensorChain(range_a=1.0, adc_bits=24)
    with pytest.raises(ValueError, match=r"adc_bits must be in 0 \.\. 24, got 25"):
        SensorChain(range_a=1.0, adc_bits=25)
    with pytest.raises(ValueError, match=r"missing_fraction must be in \[0, 1\), got 1"):
        SensorChain(missing_fraction=1.0)
    with pytest.raises(ValueError, match="brush_drop_v must be finite and >= 0, got -1"):
        Effects(brush_drop_v=-1.0)
    onset = Scenario(PAPER_MOTOR, faults=(Fault(FaultKind.BEARING, 0.1, onset_s=0.01),))
    with pytest.raises(ValueError, match="faults without an onset"):
        measure(onset, 0, [0], effects=Effects())
    with pytest.raises(ValueError, match="delay_s must be <"):
        measure(Scenario(PAPER_MOTOR), 0, [0], effects=Effects(delay_s=1e-4))
