"""A motor at work, identified: simulated by the benchmarks' own simulator, recorded by others, and with ripple."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from operation_simulator import Motor, draw_motor, simulate
from recording_csv import write_recording

from motor_env import Recording, load_motor, read_recording
from motor_env.cli import main
from motor_env.diagnosis.estimation import model_selection, parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import (
    OperationFit,
    _refuse_poor_fit,
    fit_window,
    identify_operation,
    without_lines,
)
from motor_env.diagnosis.estimation.preprocessing import from_recordings
from motor_env.diagnosis.estimation.problem import Solution

# Reaches in: what the fits of starts and of logs take for ripple.
from motor_env.diagnosis.readers.noise import constant_lines
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.motor.parameters import FloatArray

EXAMPLES = Path(__file__).parents[4] / "examples"
recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
real = pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings"
)


def work(seed: int, profile: str, load: str = "none", samples: int = 1000) -> tuple[Motor, Recording]:
    rng = np.random.default_rng(seed)
    motor = replace(draw_motor(rng), ripple=0.0, stribeck=0.0)
    return motor, simulate(motor, profile, rng, load=load, samples=samples)


@pytest.mark.parametrize(
    ("profile", "load"), [("reversals", "none"), ("prbs", "constant"), ("speed loop", "walk")]
)
def test_motor_is_found_in_any_regime(profile: str, load: str) -> None:
    motor, recording = work(3, profile, load)
    found = identify_operation([recording])
    for name, value in {"R": motor.ohm, "K": motor.constant, "J": motor.inertia}.items():
        quantity = found.quantity(name)
        assert quantity.is_determined
        assert quantity.value == pytest.approx(value, rel=0.03)
        assert abs(np.log(quantity.value / value)) < 3.5 * quantity.log_sd


def log(
    volts: FloatArray,
    dt_s: float,
    slopes: Callable[[float, float, float], tuple[float, float]],
    noise: tuple[float, float],
    rng: np.random.Generator,
) -> Recording:
    """Current and speed by small steps, under noise; the slopes are those of current and speed at a voltage."""
    i, w, parts, shown = 0.0, 0.0, 50, np.zeros((len(volts), 2))
    for k, voltage in enumerate(volts.tolist()):
        shown[k] = i, w
        for _ in range(parts):
            di, dw = slopes(i, w, voltage)
            i, w = i + dt_s / parts * di, w + dt_s / parts * dw
    current, speed = (shown + rng.standard_normal(shown.shape) * noise).T
    return Recording(Path("x"), dt_s * np.arange(float(len(volts))), current, volts, speed)


def test_a_torque_that_is_another_one_in_each_interval_hides_no_friction() -> None:
    """As of cogging, faster than the samples. Taken for a wandering load, it would leave the mean load unknown."""
    rng, dry = np.random.default_rng(6), 1.5e-3
    torque = iter(np.repeat(0.01 * rng.standard_normal(1500), 50).tolist())
    found = identify_operation(
        [
            log(
                np.repeat(rng.choice([3.0, 5.0, 8.0, 11.0], 75), 20),
                1e-3,
                lambda i, w, u: ((u - 2.0 * i - 0.03 * w) / 1e-3, (0.03 * i - dry - next(torque)) / 4e-6),
                (0.01, 0.3),
                rng,
            )
        ]
    )
    assert "noise_torque" in found.solution.names
    assert "load_walk" not in found.solution.names
    drag = found.quantity("drag")
    assert drag.value == pytest.approx(dry, rel=0.25)
    assert drag.low < dry < drag.high


def behind_brushes(drop_v: float) -> Recording:
    """A log of 8 V in both directions of a motor of 0.69 ohm and 0.029 V s/rad behind brushes with a knee at 2 A."""
    rng = np.random.default_rng(7)

    def slopes(i: float, w: float, u: float) -> tuple[float, float]:
        braked = 0.03 * math.tanh(w / 0.5) + 2e-5 * w
        return (u - 0.69 * i - 0.029 * w - drop_v * i / math.hypot(i, 2.0)) / 1e-3, (
            0.029 * i - braked
        ) / 7e-5

    volts = np.repeat(rng.choice([-8.0, -5.0, -3.0, 3.0, 5.0, 8.0], 30), 40)
    return log(volts, 0.01, slopes, (0.02, 0.3), rng)


def test_brushes_whose_voltage_sets_in_late_hide_no_resistance() -> None:
    found = identify_operation([behind_brushes(1.1)])
    for name, true in {"R": 0.69, "K": 0.029, "J": 7e-5, "brush_drop": 1.1}.items():
        assert found.quantity(name).value == pytest.approx(true, rel=0.1), name
    assert found.quantity("brush_knee").value == pytest.approx(2.0, rel=0.3)
    assert not any("physics" in note for note in found.notes)


def test_more_than_brushes_can_take_is_said_and_makes_the_resistance_less_certain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = behind_brushes(2.5)
    found = identify_operation([recording])
    drop = found.quantity("brush_drop")
    assert drop.value == pytest.approx(1.5, rel=0.01)
    assert drop.high == pytest.approx(1.5)
    assert any("brush_drop is the largest that physics allows (1.5 V in all" in note for note in found.notes)
    blind = tuple(replace(one, is_determined=False) for one in found.quantities)
    with pytest.raises(UnusableError, match="does not determine J, R, K: brush_drop is the largest"):
        _refuse_poor_fit(replace(found, quantities=blind))
    with pytest.raises(UnusableError, match="does not determine J, R, K: its voltage hardly moves"):
        _refuse_poor_fit(replace(found, quantities=blind, notes=()))
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


def test_the_loss_of_a_gear_is_found() -> None:
    geared = draw_motor(np.random.default_rng([3, 1]), ("gear",))
    rng = np.random.default_rng(4)
    found = identify_operation(
        [simulate(geared, "reversals", rng, samples=2400, dt_s=0.1 * geared.mechanical_s)]
    )
    loss = found.quantity("gear_loss")
    assert loss.low < geared.further.gear < loss.high
    assert loss.log_sd < 0.15
    assert found.quantity("J").value == pytest.approx(geared.inertia, rel=0.01)
    assert found.quantity("coulomb").value == pytest.approx(geared.coulomb, rel=0.1)


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


def test_logs_are_identified_jointly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(8)
    motor = draw_motor(rng)
    dt_s = round(motor.mechanical_s / 8.0, 5)
    logs = [
        write_recording(tmp_path / f"{kind}.csv", simulate(motor, kind, rng, samples=600, dt_s=dt_s))
        for kind in ("reversals", "prbs")
    ]
    toml = tmp_path / "motor.toml"
    assert main(["identify", *logs, "--json", "-o", str(toml), "--out", str(tmp_path)]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["taken_for"]["regime"] == "operation"
    assert found["parameters"]["K"]["value"] == pytest.approx(motor.constant, rel=0.05)
    assert load_motor(toml).parameters.resistance_ohm == pytest.approx(motor.ohm, rel=0.05)
    assert (tmp_path / "identify.html").exists()


def test_noise_is_unusable_beside_a_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both are told; the status is that of the worse, and no motor file is written."""
    columns, start = np.random.default_rng(9).standard_normal((3, 400)), EXAMPLES / "startup_capture.csv"
    noise = write_recording(tmp_path / "noise.csv", Recording(Path("x"), 1e-3 * np.arange(400.0), *columns))
    assert main(["identify", noise, str(start)]) == 3
    said = capsys.readouterr().out
    assert f"{start}: model textbook; 95 % intervals" in said
    assert f"{noise}: unusable: " in said
    assert main(["identify", noise, "-o", str(tmp_path / "motor.toml")]) == 2
    assert "no motor file: " in capsys.readouterr().err
    assert not (tmp_path / "motor.toml").exists()


def recorded(file: str) -> OperationFit:
    return identify_operation([read_recording(Path(recordings_path or "") / file)])


@real
def test_a_voltage_timed_otherwise_is_no_other_motor() -> None:
    """More likely would be one with a quarter of the inertia, which a torque disturbs so that it explains little."""
    found = recorded("regbot/regbot_85_right.csv")
    assert found.quantity("J").value > 5e-5
    assert (found.r2_speed or 0.0) > 0.99


@real
@pytest.mark.long
def test_a_motor_that_was_measured_on_the_bench() -> None:
    fits = [recorded(f"bench_measured/axem_{name}.csv") for name in ("alone", "gear")]
    for name, (least, most), (low, high) in (
        ("R", (0.55, 0.80), (0.60, 0.75)),
        ("K", (0.027, 0.0325), (0.028, 0.031)),
    ):
        found = [fit.quantity(name) for fit in fits]
        assert all(least < one.value < most and one.low < high and one.high > low for one in found)
        assert max(one.low for one in found) < min(one.high for one in found)
    assert all((fit.r2_current or 0.0) >= 0.99 for fit in fits)
    p = fits[0].solution.values
    for amps, volts in ((2.34, 2.49), (4.68, 3.99), (9.14, 7.01)):
        shown = p[index.R] * amps + p[index.DROP] * amps / math.hypot(amps, p[index.KNEE])
        assert shown == pytest.approx(volts, rel=0.15)


def with_hum(recording: Recording, amplitude_a: float, cycles_a_sample: float) -> Recording:
    phase = 2.0 * math.pi * cycles_a_sample / recording.dt_s * recording.time_s + 1.0
    return replace(recording, current_a=recording.current_a + amplitude_a * np.sin(phase))


@cache
def fitted() -> tuple[Recording, Solution]:
    clean = work(11, "prbs", samples=800)[1]
    return clean, identify_operation([clean]).solution


def test_hum_changes_neither_motor_nor_noise() -> None:
    """Terms that were chosen while the hum was there would stay: the motor is fitted anew without it."""
    clean = work(11, "sine", samples=800)[1]
    hum_a = 0.1 * float(np.abs(clean.current_a).max())
    plain, found = (identify_operation([one]) for one in (clean, with_hum(clean, hum_a, 0.23)))
    for name in ("R", "K", "J"):
        before, after = plain.quantity(name), found.quantity(name)
        assert abs(math.log(after.value / before.value)) < 0.5 * before.log_sd
        assert after.log_sd == pytest.approx(before.log_sd, rel=0.35)
    noises = [one.solution.values[index.NOISE_I] for one in (plain, found)]
    assert noises[1] == pytest.approx(noises[0], rel=0.05)
    assert not any("ripple" in note for note in plain.notes)
    (note,) = (note for note in found.notes if "ripple" in note)
    assert f"{0.23 / clean.dt_s:.3g}" in note
    assert float(note.split()[3]) == pytest.approx(hum_a, rel=0.05)


def test_what_the_voltage_has_too_is_the_motors_answer() -> None:
    """A voltage that is a fast sine: where the fit does not quite explain the current, that is no ripple."""
    _, plain = fitted()
    record, values = plain.problem.record, plain.values
    rng, sine = np.random.default_rng(5), 10.0 * np.sin(0.2 * math.pi * np.arange(800))
    record = replace(record, voltage_v=sine, marks=np.eye(1, 800)[0])
    answer = record.predict(values * np.where(np.arange(len(values)) == index.R, 1.1, 1.0), learn=False)[0]
    noise = values[index.NOISE_I] * rng.standard_normal(800)
    record = replace(record, readings=np.stack([answer[:, 2] + noise, answer[:, 3]], axis=1))
    found = replace(plain, problem=replace(plain.problem, record=record))
    residual = record.readings[:, 0] - found.free[1][:, 2]
    assert constant_lines(residual, np.linspace(0.0, 799.0 * record.dt_s, 800), np.abs(answer[:, 3]))
    assert without_lines(found, record) == (record, ())
    blind = record.only(current=False, speed=True)
    assert without_lines(found, blind) == (blind, ())


def test_a_line_over_the_angle_is_the_commutators() -> None:
    time_s = np.linspace(0.0, 1.999, 2000)
    speed: FloatArray = 100.0 * (1.0 - 0.3 * np.exp(-time_s / 0.7))
    angle = np.cumsum(speed) * 1e-3
    noise = 0.02 * np.random.default_rng(3).standard_normal(2000)
    assert constant_lines(noise + np.sin(14.0 * angle), time_s, speed) == ()
    (line,) = constant_lines(noise + np.sin(2.0 * math.pi * 210.0 * time_s), time_s, speed)
    assert line.frequency_hz == pytest.approx(210.0, abs=0.05)
    assert line.amplitude_a == pytest.approx(1.0, abs=0.01)
    assert constant_lines(noise, time_s, speed) == ()


@pytest.mark.parametrize("factors", [(3.0, 1.0, 1.0), (1.0, 3.0, 1.0), (1.0, 1.0, 4.0)])
def test_the_fit_of_a_window_arrives_however_far_it_is_from_the_healthy_motor(
    factors: tuple[float, float, float],
) -> None:
    clean, plain = fitted()
    known, motor = plain.values, [index.R, index.K, index.J]
    known[index.DRAG] = 1.0
    true = np.log(known[motor])
    known[motor] /= factors
    found = fit_window(from_recordings([clean]), known, plain.names)
    np.testing.assert_allclose(found.logs[:3], true, atol=0.003)
