"""Motors at work: their equations solved anew, the speed loop from what was recorded, profiles, and refusals."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from motor_env import Channel, SensorParameters, Timing, draw
from motor_env.motor.faults import apply_faults
from motor_env.simulation.disturbances import N_UNIFORMS, PROFILES, Duty
from motor_env.simulation.named_recipes import named_recipe, recipe_to_dict
from motor_env.simulation.sampling import Draw, measure_draw

OPERATION = named_recipe("operation")
SILENT = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.0, 0.0)


def solved(drawn: Draw, n: int, voltage_v: NDArray[np.float32], dt_s: float) -> NDArray[np.float64]:
    """Current and speed of case n: the equations written anew, a stiff solver, loads that never stand still."""
    assert drawn.effects is not None
    assert drawn.driving is not None
    motor = apply_faults(drawn.scenario.parameters, drawn.scenario.faults).motor(n)
    rise, fan = drawn.driving.load_rise_n_m[n], drawn.driving.fan_n_m_s2[n]
    warm, drop, coulomb, load = (
        np.asarray(getattr(drawn.effects, name))[n]
        for name in ("temperature_rise_k", "brush_drop_v", "coulomb_friction_n_m", "load_torque_n_m")
    )
    flux = 1.0 - 0.001 * warm

    def rates(t: float, x: NDArray[np.float64], volts: float) -> list[float]:
        i, w, heat = x
        ohm = motor.resistance_ohm * (1.0 + 0.00393 * warm) * (1.0 + 0.00393 * heat)
        back = flux * motor.back_emf_constant_v_s_per_rad * w + drop * i / np.hypot(i, 0.02)
        dry = coulomb + load + rise * t / (len(voltage_v) * dt_s) + fan * w * w
        against = motor.viscous_friction_n_m_s_per_rad * w + dry * w / np.hypot(w, 1.0)
        return [
            (volts - ohm * i - back) / motor.inductance_h,
            (flux * motor.torque_constant_n_m_per_a * i - against) / motor.inertia_kg_m2,
            (i * i * ohm - heat / 3.1) / 3.87,
        ]

    state, rows = np.zeros(3), []
    for k, volts in enumerate(voltage_v):
        state = solve_ivp(
            rates, (k * dt_s, (k + 1) * dt_s), state, "LSODA", args=(float(volts),), rtol=1e-6, atol=1e-8
        ).y[:, -1]
        rows.append(state[:2])
    return np.array(rows).T


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


def test_a_loop_follows_from_what_was_recorded_and_a_replay_gives_the_same() -> None:
    drawn = draw(OPERATION, 2, np.arange(60))
    assert drawn.driving is not None
    read = measure_draw(drawn, OPERATION, 2)
    (rows,) = np.nonzero(drawn.driving.is_loop)
    assert 3 <= len(rows) <= 20
    for n in rows:
        limit, integral, volts = drawn.driving.limit_v[n], 0.0, drawn.driving.voltage_v[n, 0]
        for k, wanted in enumerate(drawn.driving.voltage_v[n]):
            if k > 0:
                error = wanted - (read[n, 1, k - 1] - 2.18 * read[n, 0, k - 1])
                integral = np.clip(integral + 0.05 * error, -limit, limit)
                volts = np.clip(wanted + 0.5 * error + integral, -limit, limit)
            assert read[n, 1, k] == pytest.approx(volts, abs=1e-4)
    applied = drawn.driving._replace(voltage_v=read[:, 1].astype(float), is_loop=np.zeros(60, bool))
    np.testing.assert_array_equal(measure_draw(drawn._replace(driving=applied), OPERATION, 2), read)
    np.testing.assert_array_equal(measure_draw(draw(OPERATION, 2, [41]), OPERATION, 2)[0], read[41])


def test_a_loop_hears_the_noise_of_the_current_wherever_its_channel_stands() -> None:
    assert OPERATION.duty is not None
    recipe = replace(
        OPERATION,
        sensor=SensorParameters((Channel.SPEED, Channel.CURRENT), 0.02, 5.0),
        timing=Timing(1_000.0, 0.05),
        duty=replace(OPERATION.duty, profiles=("speed_loop",)),
    )
    drawn = draw(recipe, 2, np.arange(3))
    assert drawn.driving is not None
    _, current, applied = np.moveaxis(measure_draw(drawn, recipe, 2), 1, 0)
    for n, limit in enumerate(drawn.driving.limit_v.tolist()):
        integral = 0.0
        for k, wanted in enumerate(drawn.driving.voltage_v[n]):
            if k > 0:
                error = wanted - (applied[n, k - 1] - 2.18 * current[n, k - 1])
                integral = np.clip(integral + 0.05 * error, -limit, limit)
                volts = np.clip(wanted + 0.5 * error + integral, -limit, limit)
                assert applied[n, k] == pytest.approx(volts, abs=1e-4)


def test_profiles_hold_their_levels_within_the_supply() -> None:
    u = np.random.default_rng(3).random((600, N_UNIFORMS))
    share, is_loop = Duty(hold_s=(0.02, 0.05)).profile(u, OPERATION.timing)
    assert np.abs(share).max() <= 1.0
    kind = (u[:, 0] * len(PROFILES)).astype(int)
    np.testing.assert_array_equal(is_loop, kind == PROFILES.index("speed_loop"))
    held = kind != PROFILES.index("sine")
    changes = [np.flatnonzero(np.diff(row)) for row in share[held]]
    assert min(np.diff(places).min() for places in changes if len(places) > 1) >= 19
    assert (share.min(axis=1) < 0.0)[kind == PROFILES.index("reversals")].all()
    assert (share > 0.0)[np.isin(kind, [0, 2, 3])].all()


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_sample_by_sample(name: str) -> None:
    """The formulas anew: pace log-uniform in hold_s, size 0.4 to 1, a level from a uniform number of its own."""
    timing = Timing(1_000.0, 2.0)
    u = np.random.default_rng(5).random((3, 68))
    share, _ = Duty(profiles=(name,), hold_s=(0.02, 0.05)).profile(u, timing)
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


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"field": None}, "a duty needs a table field beside it, and quiet_s = 0"),
        ({"timing": Timing(1_000.0, 0.5, 0.1)}, "a duty needs a table field beside it, and quiet_s = 0"),
        (
            {"field": named_recipe("field").field},
            "ramp_s and trigger_jitter of a recipe with a duty must be 0",
        ),
    ],
)
def test_what_a_duty_cannot_be_with(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        replace(OPERATION, shifts=(), **changes)


def test_refusals_and_old_files() -> None:
    with pytest.raises(ValueError, match=r"duty\.profiles must be among steps, .*, got ramp"):
        Duty(profiles=("ramp",))
    assert Duty().hold_s == (0.02, 0.1)
    with pytest.raises(ValueError, match=r"duty\.hold_s must be > 0, got 0"):
        Duty(hold_s=(0.0, 0.1))
    with pytest.raises(ValueError, match=r"duty\.fan_ratio must be a finite .*, got \[1, 0\]"):
        Duty(fan_ratio=(1.0, 0.0))
    with pytest.raises(ValueError, match="recipe operation has a voltage of its own in each case"):
        _ = OPERATION.nominal_voltage_v
    blind = replace(OPERATION, sensor=SensorParameters((Channel.SPEED,)))
    drawn = draw(blind, 1, np.arange(20))
    with pytest.raises(ValueError, match="a speed loop needs the current among the channels"):
        measure_draw(drawn, blind, 1)
    assert "duty" not in recipe_to_dict(named_recipe("field"))  # as it always was: files keep their bytes
