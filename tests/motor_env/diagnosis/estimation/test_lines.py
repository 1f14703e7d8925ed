"""Ripple of constant frequency in the current of a motor at work: taken off, whatever it is called."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate

from motor_env import Recording
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import fit_window, identify_operation, without_lines
from motor_env.diagnosis.estimation.preprocessing import from_recordings
from motor_env.diagnosis.estimation.problem import Solution

# Reaches in: what the fits of starts and of logs take for ripple.
from motor_env.diagnosis.readers.noise import constant_lines
from motor_env.motor.parameters import FloatArray


def work(seed: int, profile: str, samples: int) -> Recording:
    """A recording of a motor whose torque does not ripple."""
    rng = np.random.default_rng(seed)
    motor = replace(draw_motor(rng), ripple=0.0, stribeck=0.0)
    return simulate(motor, profile, rng, load="none", samples=samples)


def with_hum(recording: Recording, amplitude_a: float, cycles_a_sample: float) -> Recording:
    """A recording whose current's sensor picks a line up."""
    phase = 2.0 * math.pi * cycles_a_sample / recording.dt_s * recording.time_s + 1.0
    return replace(recording, current_a=recording.current_a + amplitude_a * np.sin(phase))


@cache
def fitted() -> tuple[Recording, Solution]:
    """A motor at work, and its fit."""
    clean = work(11, "prbs", samples=800)
    return clean, identify_operation([clean]).solution


def test_hum_changes_neither_motor_nor_noise() -> None:
    """Terms that were chosen while the hum was there would stay: the motor is fitted anew without it."""
    clean = work(11, "sine", samples=800)
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


def test_each_recording_has_lines_of_its_own() -> None:
    """The phase is another in each of two recordings; of a window the fit does the same."""
    clean, plain = fitted()
    first = with_hum(clean, 0.5, 0.23)
    later = replace(clean, current_a=clean.current_a + (first.current_a - clean.current_a)[::-1])
    record = from_recordings([first, later])
    cleaned, lines = without_lines(replace(plain, problem=replace(plain.problem, record=record)), record)
    assert [line.amplitude_a for line in lines] == pytest.approx([0.5, 0.5], rel=0.05)
    left = cleaned.readings[:, 0] - from_recordings([clean, clean]).readings[:, 0]
    assert float(np.std(left)) < 0.05 * 0.5
    known = plain.values
    known[index.DRAG] = 1.0
    quiet, loud = (fit_window(from_recordings([one]), known, plain.names) for one in (clean, first))
    assert np.diag(loud.covariance) == pytest.approx(np.diag(quiet.covariance), rel=0.2)
    assert float(np.std(loud.whitened[:, 0])) == pytest.approx(1.0, abs=0.1)


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
    """Ripple that speeds up with the motor is left; of constant frequency it is found."""
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
    """Of R, K and J; eight rounds from the healthy motor would leave J off by 2 to 7 %."""
    clean, plain = fitted()
    known, motor = plain.values, [index.R, index.K, index.J]
    known[index.DRAG] = 1.0
    true = np.log(known[motor])
    known[motor] /= factors
    found = fit_window(from_recordings([clean]), known, plain.names)
    np.testing.assert_allclose(found.logs[:3], true, atol=0.003)
