"""A motor at work, identified: simulated by the benchmarks' own simulator, and recorded by others."""

import math
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from operation_simulator import SWITCHES, Motor, draw_motor, simulate

from motor_env import Recording, read_recording
from motor_env.diagnosis.estimation import model_selection, parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import OperationFit, _refuse_poor_fit, identify_operation
from motor_env.diagnosis.readers.recording import UnusableError

recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
real = pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings"
)


def work(seed: int, profile: str, load: str = "none", samples: int = 1000) -> tuple[Motor, Recording]:
    """A motor and a recording of it."""
    rng = np.random.default_rng(seed)
    motor = replace(draw_motor(rng), ripple=0.0, stribeck=0.0)
    return motor, simulate(motor, profile, rng, load=load, samples=samples)


@pytest.mark.parametrize(
    ("profile", "load"), [("reversals", "none"), ("prbs", "constant"), ("speed loop", "walk")]
)
def test_motor_is_found_in_any_regime(profile: str, load: str) -> None:
    motor, recording = work(3, profile, load)
    found = identify_operation([recording])
    true = {"R": motor.ohm, "K": motor.constant, "J": motor.inertia}
    for name, value in true.items():
        quantity = found.quantity(name)
        assert quantity.is_determined
        assert quantity.value == pytest.approx(value, rel=0.03)
        assert abs(np.log(quantity.value / value)) < 3.5 * quantity.log_sd


def test_a_torque_that_is_another_one_in_each_interval_hides_no_friction() -> None:
    """As of cogging, faster than the samples. Taken for a wandering load, it would leave the mean load unknown."""
    rng, n = np.random.default_rng(6), 1500
    ohm, constant, inertia, dry, dt_s = 2.0, 0.03, 4e-6, 1.5e-3, 1e-3
    volts = np.repeat(rng.choice([3.0, 5.0, 8.0, 11.0], n // 20 + 1), 20)[:n]
    i, w, shown = 0.0, 0.0, np.zeros((n, 2))
    for k in range(n):
        shown[k] = i, w
        disturbing = 0.01 * rng.standard_normal()
        for _ in range(50):
            i += dt_s / 50.0 * (volts[k] - ohm * i - constant * w) / 1e-3
            w += dt_s / 50.0 * (constant * i - dry - disturbing) / inertia
    current, speed = (shown + rng.standard_normal((n, 2)) * [0.01, 0.3]).T
    found = identify_operation([Recording(Path("x"), dt_s * np.arange(float(n)), current, volts, speed)])
    assert "noise_torque" in found.solution.names
    assert "load_walk" not in found.solution.names
    drag = found.quantity("drag")
    assert drag.value == pytest.approx(dry, rel=0.25)
    assert drag.low < dry < drag.high


def behind_brushes(drop_v: float, knee_a: float) -> Recording:
    """A log of 8 V in both directions of a motor of 0.69 ohm and 0.029 V s/rad behind brushes, at 100 Hz."""
    rng, n, parts, dt_s = np.random.default_rng(7), 1200, 40, 0.01
    ohm, henry, constant, inertia, dry, viscous = 0.69, 1e-3, 0.029, 7e-5, 0.03, 2e-5
    volts = np.repeat(rng.choice([-8.0, -5.0, -3.0, 3.0, 5.0, 8.0], n // 40), 40)
    i, w, shown = 0.0, 0.0, np.zeros((n, 2))
    for k in range(n):
        shown[k] = i, w
        for _ in range(parts):
            lost = ohm * i + constant * w + drop_v * i / math.hypot(i, knee_a)
            i += dt_s / parts * (volts[k] - lost) / henry
            w += dt_s / parts * (constant * i - dry * math.tanh(w / 0.5) - viscous * w) / inertia
    current, speed = (shown + rng.standard_normal((n, 2)) * [0.02, 0.3]).T
    return Recording(Path("x"), dt_s * np.arange(float(n)), current, volts, speed)


def test_brushes_whose_voltage_sets_in_late_hide_no_resistance() -> None:
    found = identify_operation([behind_brushes(drop_v=1.1, knee_a=2.0)])
    for name, true in {"R": 0.69, "K": 0.029, "J": 7e-5, "brush_drop": 1.1}.items():
        assert found.quantity(name).value == pytest.approx(true, rel=0.1), name
    assert found.quantity("brush_knee").value == pytest.approx(2.0, rel=0.3)
    assert not any("physics" in note for note in found.notes)


def test_more_than_brushes_can_take_is_said_and_makes_the_resistance_less_certain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = behind_brushes(drop_v=2.5, knee_a=2.0)
    found = identify_operation([recording])
    drop = found.quantity("brush_drop")
    assert drop.value == pytest.approx(1.5, rel=0.01)
    assert drop.high == pytest.approx(1.5)
    assert any("brush_drop is the largest that physics allows (1.5 V in all" in note for note in found.notes)
    monkeypatch.setattr(model_selection, "_with_less_brush_drop", lambda best: best)
    assert found.quantity("R").log_sd > 1.2 * identify_operation([recording]).quantity("R").log_sd


def test_a_supply_that_sags_within_a_sample_is_told_from_the_motor() -> None:
    """Of a tenth of its resistance. Its voltage is read before the current that it then gives."""
    rng = np.random.default_rng([78, 1])
    motor = replace(draw_motor(rng), drop=0.0)
    found = identify_operation([simulate(motor, "reversals", rng, samples=2000, supply_ohm=0.1 * motor.ohm)])
    assert found.quantity("supply_resistance").value == pytest.approx(0.1 * motor.ohm, rel=0.1)
    for name, true in (("R", motor.ohm), ("K", motor.constant), ("J", motor.inertia)):
        assert found.quantity(name).value == pytest.approx(true, rel=5e-3)


def test_current_alone_tells_ratios() -> None:
    motor, recording = work(4, "reversals")
    found = identify_operation([replace(recording, speed_rad_s=None)])
    assert found.quantity("R").value == pytest.approx(motor.ohm, rel=0.03)
    assert found.quantity("J/K^2").value == pytest.approx(motor.inertia / motor.constant**2, rel=0.03)
    assert any("K, J and B" in note for note in found.notes)
    blind = tuple(replace(one, is_determined=one.name != "J/K^2") for one in found.quantities)
    with pytest.raises(UnusableError, match="not determine J/K"):
        _refuse_poor_fit(replace(found, quantities=blind))


def test_a_motor_behind_a_diode_is_found() -> None:
    # 12 V in pulses of 5 Hz, on in 95 % of the time: the diode lets no current turn in the pauses.
    ohm, henry, constant, inertia, dry, fine_s = 2.0, 2e-3, 0.03, 2.3e-5, 3.6e-3, 1e-4
    recorded, rng = np.zeros((2000, 2)), np.random.default_rng(4)
    i = w = 0.0
    for k in range(20_000):
        on = k >= 3000 and fine_s * (k - 3000) * 5.0 % 1.0 < 0.95
        if on or i > 0.0:
            i += fine_s * (12.0 * on - ohm * i - constant * w) / henry
        i = i if on else max(i, 0.0)
        w = max(w + fine_s * (constant * i - dry) / inertia, 0.0)
        recorded[k // 10] = 12.0 * on, i
    volts, current = (recorded + 0.01 * rng.standard_normal(recorded.shape)).T
    found = identify_operation([Recording(Path("x"), 1e-3 * np.arange(2000.0), current, volts)])
    assert found.quantity("R").value == pytest.approx(ohm, rel=0.02)
    assert found.quantity("J/K^2").value == pytest.approx(inertia / constant**2, rel=0.05)


@pytest.mark.long
def test_two_recordings_tell_more_than_one() -> None:
    rng = np.random.default_rng(5)
    motor = replace(draw_motor(rng), ripple=0.0, stribeck=0.0)
    first = simulate(motor, "reversals", rng, samples=800, dt_s=motor.mechanical_s / 10.0)
    second = simulate(motor, "prbs", rng, samples=800, dt_s=motor.mechanical_s / 10.0)
    one, both = identify_operation([first]), identify_operation([first, second])
    for name in ("J", "K", "B"):
        assert both.quantity(name).log_sd < one.quantity(name).log_sd
    assert both.quantity("R").value == pytest.approx(motor.ohm, rel=0.03)


def test_noise_is_no_motor() -> None:
    rng = np.random.default_rng(6)
    n = 800
    noise = Recording(
        Path("x"), 1e-3 * np.arange(n, dtype=np.float64), rng.standard_normal(n), rng.standard_normal(n)
    )
    with pytest.raises(UnusableError, match="motor"):
        identify_operation([noise])


def recorded(file: str) -> OperationFit:
    return identify_operation([read_recording(Path(recordings_path or "") / file)])


@real
def test_a_voltage_timed_otherwise_is_no_other_motor() -> None:
    """More likely would be one with a quarter of the inertia, which a torque disturbs so that it explains little."""
    found = recorded("regbot/regbot_85_right.csv")
    assert found.quantity("J").value > 5e-5
    assert found.r2_speed is not None
    assert found.r2_speed > 0.99


@real
@pytest.mark.long
def test_a_current_that_is_all_noise_is_said_to_tell_nothing() -> None:
    found = recorded("operating/shield_aprbs.csv")
    assert found.r2_current is None
    assert found.r2_speed is not None
    assert found.r2_speed >= 0.96
    assert any("not determined" in note for note in found.notes)


@real
@pytest.mark.long
def test_a_motor_that_was_measured_on_the_bench() -> None:
    """Alone and behind its gear; with the rotor locked, and a lever (raphaelcasimir/kord-stk)."""
    fits = [recorded(f"bench_measured/axem_{name}.csv") for name in ("alone", "gear")]
    for name, (least, most), (low, high) in (
        ("R", (0.55, 0.80), (0.60, 0.75)),
        ("K", (0.027, 0.0325), (0.028, 0.031)),
    ):
        found = [fit.quantity(name) for fit in fits]
        assert all(least < one.value < most and one.low < high and one.high > low for one in found)
        assert max(one.low for one in found) < min(one.high for one in found)
    assert all(fit.r2_current is not None and fit.r2_current >= 0.99 for fit in fits)
    p = fits[0].solution.values
    for amps, volts in ((2.34, 2.49), (4.68, 3.99), (9.14, 7.01)):
        shown = p[index.R] * amps + p[index.DROP] * amps / math.hypot(amps, p[index.KNEE])
        assert shown == pytest.approx(volts, rel=0.15)


@real
@pytest.mark.long
def test_a_growing_square_wave() -> None:
    found = recorded("aalborg/square_growing.csv")
    assert found.r2_current is not None
    assert found.r2_current >= 0.98
    assert found.quantity("brush_drop").value == pytest.approx(1.6, abs=0.6)


def test_a_controller_of_a_coarse_current_makes_no_certain_resistance() -> None:
    """Of six steps of current. The voltage follows the current, so that the fit is 70 % off in R."""
    motor = draw_motor(np.random.default_rng([0, 10]), SWITCHES)
    log = simulate(motor, "current loop", np.random.default_rng([0, 10, 6]), samples=2000)
    found = identify_operation([log]).quantity("R")
    assert abs(math.log(found.value / motor.ohm)) < 3.0 * found.log_sd


@pytest.mark.parametrize(
    ("notes", "reason"),
    [
        ((), "its voltage hardly moves"),
        (("brush_drop is the largest that physics allows (1.5 V)", "other"), "brush_drop is the largest"),
    ],
)
def test_what_is_not_determined_says_which_term_is_at_its_bound(notes: tuple[str, ...], reason: str) -> None:
    untold = SimpleNamespace(name="R", value=1.0, is_determined=False)
    fitted = SimpleNamespace(
        r2_current=None,
        r2_speed=None,
        quantities=[untold],
        notes=notes,
        record=SimpleNamespace(recorded=(True, True)),
    )
    with pytest.raises(UnusableError, match=f"does not determine R: {reason}"):
        _refuse_poor_fit(cast("Any", fitted))
