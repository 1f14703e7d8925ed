"""Raw pulse-width modulation: no gap is taken for a start, and no alias for a voltage."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from motor_env import InputError, Recording
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.regime import RegimeDecision, operation_evidence, refuse_aliased, taken_for
from motor_env.diagnosis.readers.start import chosen_starts
from motor_env.motor.parameters import FloatArray

FINE_S = 1e-4
OHM, CONSTANT, INERTIA, DRY = 2.0, 0.03, 2.3e-5, 3.6e-3


@cache
def pulsed(pwm_hz: float, duty: float, every: int, *, coasts: bool = True, n: int = 40_000) -> Recording:
    """A motor of 50 ms, without inductance, that pulses of 12 V start at 0.2 s; one fine step in some is recorded."""
    time_s: FloatArray = FINE_S * np.arange(n, dtype=np.float64)
    on = (time_s >= 0.2) & ((time_s - 0.2) * pwm_hz % 1.0 < duty)
    states: FloatArray = np.zeros((n, 2))
    speed = 0.0
    for k in range(n):
        current = 0.0 if coasts and not on[k] else (12.0 * on[k] - CONSTANT * speed) / OHM
        states[k] = current, speed
        speed = max(speed + FINE_S * (CONSTANT * current - DRY) / INERTIA, 0.0)
    noisy: FloatArray = states + np.random.default_rng(4).standard_normal(states.shape) * [0.01, 0.5]
    some = slice(None, None, every)
    voltage = 12.0 * on + 0.01 * np.random.default_rng(5).standard_normal(n)
    return Recording(Path("x"), time_s[some], noisy[some, 0], voltage[some], noisy[some, 1])


@pytest.mark.parametrize(("pwm_hz", "duty"), [(2.0, 0.5), (2.0, 0.95), (5.0, 0.1), (5.0, 0.5), (20.0, 0.95)])
@pytest.mark.parametrize("has_speed", [False, True])
def test_pulses_are_no_starts(pwm_hz: float, duty: float, has_speed: bool) -> None:
    recording = pulsed(pwm_hz, duty, 10)
    if not has_speed:
        recording = Recording(recording.path, recording.time_s, recording.current_a, recording.voltage_v)
    taken = taken_for(recording)
    assert taken.regime == "operation"
    assert f"{taken}" == f"a motor at work ({operation_evidence(recording)})"
    assert recording.voltage_v is not None
    refuse_aliased(recording.voltage_v, recording.current_a)


def test_a_motor_that_brakes_to_rest_starts_again() -> None:
    recording = pulsed(1.0, 0.5, 10, coasts=False)
    assert operation_evidence(recording) is None
    assert taken_for(recording) == RegimeDecision("start", "the voltage is switched on")
    assert len(chosen_starts(recording)) == 4


def test_the_user_or_the_choice_of_a_start_says_what_a_recording_is() -> None:
    at_work = pulsed(20.0, 0.95, 10, n=10_000)
    silent = Recording(at_work.path, at_work.time_s, at_work.current_a)
    assert taken_for(at_work).regime == "operation"
    for regime, start in (("start", None), ("auto", 2), ("start", 2)):
        assert taken_for(at_work, regime, start) == RegimeDecision("start", "as asked")
    assert taken_for(silent, "operation", 2) == RegimeDecision("operation", "as asked")
    assert str(taken_for(silent)) == "a start (no voltage was recorded)"
    with pytest.raises(InputError, match="regime must be one of auto, start, operation, got 'work'"):
        taken_for(silent, "work")


@pytest.mark.parametrize("pwm_hz", [500.0, 503.0, 1000.0, 1003.0])
def test_a_voltage_that_the_current_does_not_follow_is_refused(pwm_hz: float) -> None:
    fine = pulsed(pwm_hz, 0.5, 1)
    assert fine.voltage_v is not None
    mean = np.convolve(fine.current_a, np.full(40, 1.0 / 40.0), mode="same")  # as an inductance leaves it
    with pytest.raises(UnusableError, match="sampled more slowly than it switches"):
        refuse_aliased(fine.voltage_v[::20], mean[::20])


def test_a_current_that_never_moves_with_the_voltage_is_refused() -> None:
    """Not even between its jumps: a ramp, or a sensor that shows the same at each of them."""
    voltage = np.where(np.arange(2000) // 50 % 2 == 0, 0.0, 12.0)
    for current in (1e-3 * np.arange(2000.0), np.where(np.arange(2000) < 1990, 1.0, 2.0)):
        with pytest.raises(UnusableError, match="does not follow the voltage"):
            refuse_aliased(voltage, current)


def stepped(
    first_v: float, *, first_s: float = 0.2, rest_s: float = 0.0, has_speed: bool = True
) -> Recording:
    """1 s of a motor of 50 ms that a first voltage drives from rest, and 10 V after it; recorded from a moment on."""
    time_s: FloatArray = 1e-3 * np.arange(1_000.0)
    voltage = np.where(time_s + rest_s < first_s, first_v, 10.0)
    speed, shown = 0.0, []
    for volts in np.append(np.full(round(1e3 * rest_s), first_v), voltage).tolist():
        speed += 1e-3 * (volts - speed) / 0.05
        shown.append(speed)
    turned = np.array(shown)[-len(time_s) :]
    noisy = turned + 0.01 * np.random.default_rng(1).standard_normal(len(time_s))
    return Recording(Path("x"), time_s, voltage - noisy, voltage, noisy if has_speed else None)


@pytest.mark.parametrize("has_speed", [True, False])
def test_a_motor_that_starts_under_one_voltage_and_goes_on_under_another_is_at_work(has_speed: bool) -> None:
    """A start from a motor that runs steadily, or stands, under the first one is a start all the same."""
    words = "the motor starts under one voltage, and another follows"
    assert operation_evidence(stepped(3.0, has_speed=has_speed)) == words
    assert operation_evidence(stepped(1.2, has_speed=has_speed)) == words
    assert operation_evidence(stepped(3.0, first_s=0.11, has_speed=has_speed)) == words
    # One of another kind: 1 V is off, 8.5 V is on, 90 ms are no level, and a motor of 50 ms is steady after 0.3 s.
    for other in (
        stepped(1.0, has_speed=has_speed),
        stepped(8.5, has_speed=has_speed),
        stepped(3.0, first_s=0.09, has_speed=has_speed),
        stepped(3.0, first_s=0.5, rest_s=0.3, has_speed=False),
    ):
        assert operation_evidence(other) is None
    # The current still falls by 8 or by 12 % of the largest one.
    assert operation_evidence(stepped(3.0, first_s=0.5, rest_s=0.078, has_speed=False)) is None
    assert operation_evidence(stepped(3.0, first_s=0.5, rest_s=0.064, has_speed=False)) == words
