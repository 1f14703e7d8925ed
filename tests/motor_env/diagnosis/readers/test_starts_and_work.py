"""Starts or a motor at work, by the voltage; starts of a recording, cut apart; the supply of a start."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from judged_by_hand import SHEET, start

from motor_env import Fault, FaultKind, InputError, Recording, diagnose
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.regime import RegimeDecision, operation_evidence, refuse_aliased, taken_for
from motor_env.diagnosis.readers.start import (
    Circuit,
    chosen_starts,
    end_of_supply,
    mean_tail,
    prepare,
    split_starts,
)
from motor_env.motor.parameters import FloatArray

LEVELS, FAST = "the voltage takes several levels", "the voltage is switched faster than a motor stops"
REVERSES, BACK = "the voltage reverses", "the voltage comes back before the motor stands"
TURNS = "the motor turns already"
GOES_ON = "the motor starts under one voltage, and another follows"


def driven(
    voltage: FloatArray, *, current: FloatArray | None = None, speed: FloatArray | None = None
) -> Recording:
    """At 1 kHz."""
    shown = 0.1 * voltage if current is None else current
    return Recording(Path("x"), 1e-3 * np.arange(float(len(voltage))), shown, voltage, speed)


def off_on(*lengths: int) -> FloatArray:
    return np.concatenate([np.full(n, 12.0 * (k % 2)) for k, n in enumerate(lengths)])


def waves(period: float, low: float, high: float, *, n: int = 6000) -> FloatArray:
    """A voltage that goes up and down between two shares of 12 V without a jump; the period in samples."""
    phase = 2.0 * np.pi * np.arange(n) / period
    return np.asarray(12.0 * (0.5 * (low + high) - 0.5 * (high - low) * np.cos(phase)))


def with_parts(level: float, length: int, count: int = 4) -> FloatArray:
    """A start of 10 s, in which the voltage takes another level for so many samples, some times."""
    volts = off_on(1000, 9000)
    for k in range(count):
        volts[2000 + 2000 * k : 2000 + 2000 * k + length] = 12.0 * level
    return volts


def spiked(count: int) -> FloatArray:
    volts = np.tile(np.repeat([12.0, -12.0], 500), 10)
    volts[100 : 100 + count] = 120.0
    return volts


@pytest.mark.parametrize(
    ("voltage", "said"),
    [
        (off_on(100, 900), None),
        (off_on(100, 5, 4, 900), None),  # a switch that bounces
        (off_on(100, 900, 900, 900, 900, 900), None),  # three starts
        (np.zeros(100), None),
        (with_parts(-1.0, 51, 1), REVERSES),
        (with_parts(0.4, 250), None),  # a tenth of the time
        (with_parts(0.4, 251), LEVELS),
        (np.repeat([0.0, 5.0, 12.0], [1000, 3000, 6000]), None),  # two changes
        (waves(600.0, 0.0, 1.0, n=1200), None),  # two slow rises
        (waves(600.0, 0.0, 1.0, n=1900), LEVELS),
        (np.tile(off_on(99, 300), 6), FAST),
        (np.tile(off_on(101, 300), 6), None),
        (spiked(8), REVERSES),
    ],
)
def test_what_a_voltage_shows(voltage: FloatArray, said: str | None) -> None:
    speed = np.where(np.abs(voltage) > 1.2, 1.0, 0.0)
    speed[0] = 0.0
    still = speed if said == FAST or len(voltage) == 2406 else None
    assert operation_evidence(driven(voltage, speed=still)) == said
    if still is None:
        by_duty = replace(driven(voltage), voltage_v=None, duty=voltage / 12.0)
        assert operation_evidence(by_duty) == said
    assert operation_evidence(replace(driven(voltage), voltage_v=None)) is None


@pytest.mark.parametrize(("pause", "left", "said"), [(200, 9.9, None), (200, 10.1, BACK), (19, 100.0, None)])
def test_a_motor_whose_speed_is_left_when_it_is_switched_on_is_at_work(
    pause: int, left: float, said: str | None
) -> None:
    """A tenth of the largest; a contact that bounces is no pause."""
    volts = off_on(100, 400, pause, 400, pause, 400)
    speed = np.where(volts > 0.0, 100.0, left)
    assert operation_evidence(driven(volts, speed=speed)) == said


@pytest.mark.parametrize(
    ("turning", "begun", "said"), [(9.9, 12.0, None), (10.1, 12.0, TURNS), (10.1, 1.19, None)]
)
def test_a_motor_that_turns_when_the_recording_begins_is_at_work(
    turning: float, begun: float, said: str | None
) -> None:
    """By the median of its first three speeds, a tenth of the largest, and a tenth of the largest voltage."""
    volts, speed = np.full(2000, 12.0), np.full(2000, -100.0)
    volts[0], speed[:3] = begun, [0.0, turning, turning]
    recording = driven(volts, speed=speed)
    assert operation_evidence(recording) == said
    assert operation_evidence(replace(recording, voltage_v=None, duty=volts / 12.0)) is None


def stepped(first_v: float, first_s: float, rest_s: float, *, has_speed: bool) -> Recording:
    """1 s of a motor of 50 ms that a first voltage drives from rest, and 10 V after it; recorded from a moment on."""
    time_s: FloatArray = 1e-3 * np.arange(1_000.0)
    voltage = np.where(time_s + rest_s < first_s, first_v, 10.0)
    speed, shown = 0.0, []
    for volts in np.append(np.full(round(1e3 * rest_s), first_v), voltage).tolist():
        speed += 1e-3 * (volts - speed) / 0.05
        shown.append(speed)
    noisy = np.array(shown)[-len(time_s) :] + 0.01 * np.random.default_rng(1).standard_normal(len(time_s))
    return Recording(Path("x"), time_s, voltage - noisy, voltage, noisy if has_speed else None)


@pytest.mark.parametrize("has_speed", [True, False])
@pytest.mark.parametrize(
    ("first_v", "first_s", "rest_s", "said"),
    [
        (3.0, 0.2, 0.0, GOES_ON),
        (1.0, 0.2, 0.0, None),  # off
        (3.0, 0.09, 0.0, None),  # no level
        (3.0, 0.5, 0.3, None),  # a motor that runs steadily
    ],
)
def test_a_motor_that_starts_under_one_voltage_and_goes_on_under_another_is_at_work(
    first_v: float, first_s: float, rest_s: float, said: str | None, has_speed: bool
) -> None:
    if rest_s == 0.0 or not has_speed:
        assert operation_evidence(stepped(first_v, first_s, rest_s, has_speed=has_speed)) == said


@cache
def pulsed(pwm_hz: float, duty: float, every: int, *, coasts: bool = True, n: int = 40_000) -> Recording:
    """A motor of 50 ms, without inductance, that pulses of 12 V start at 0.2 s; one fine step in some is recorded."""
    fine_s, ohm, constant, inertia, dry = 1e-4, 2.0, 0.03, 2.3e-5, 3.6e-3
    time_s: FloatArray = fine_s * np.arange(n, dtype=np.float64)
    on = (time_s >= 0.2) & ((time_s - 0.2) * pwm_hz % 1.0 < duty)
    states: FloatArray = np.zeros((n, 2))
    speed = 0.0
    for k in range(n):
        current = 0.0 if coasts and not on[k] else (12.0 * on[k] - constant * speed) / ohm
        states[k] = current, speed
        speed = max(speed + fine_s * (constant * current - dry) / inertia, 0.0)
    noisy: FloatArray = states + np.random.default_rng(4).standard_normal(states.shape) * [0.01, 0.5]
    voltage = 12.0 * on + 0.01 * np.random.default_rng(5).standard_normal(n)
    some = slice(None, None, every)
    return Recording(Path("x"), time_s[some], noisy[some, 0], voltage[some], noisy[some, 1])


@pytest.mark.parametrize(("pwm_hz", "duty"), [(2.0, 0.5), (5.0, 0.1), (20.0, 0.95)])
@pytest.mark.parametrize("has_speed", [False, True])
def test_pulses_are_no_starts(pwm_hz: float, duty: float, has_speed: bool) -> None:
    recording = pulsed(pwm_hz, duty, 10)
    if not has_speed:
        recording = replace(recording, speed_rad_s=None)
    taken = taken_for(recording)
    assert taken.regime == "operation"
    assert f"{taken}" == f"a motor at work ({operation_evidence(recording)})"
    assert recording.voltage_v is not None
    refuse_aliased(recording.voltage_v, recording.current_a)


def test_the_user_or_the_choice_of_a_start_says_what_a_recording_is() -> None:
    at_work = pulsed(20.0, 0.95, 10, n=10_000)
    silent = replace(at_work, voltage_v=None, speed_rad_s=None)
    for regime, number in (("start", None), ("auto", 2), ("start", 2)):
        assert taken_for(at_work, regime, number) == RegimeDecision("start", "as asked")
    assert taken_for(silent, "operation", 2) == RegimeDecision("operation", "as asked")
    assert str(taken_for(silent)) == "a start (no voltage was recorded)"
    with pytest.raises(InputError, match="regime must be one of auto, start, operation, got 'work'"):
        taken_for(silent, "work")


@pytest.mark.parametrize("pwm_hz", [500.0, 1003.0])
def test_a_voltage_that_the_current_does_not_follow_is_refused(pwm_hz: float) -> None:
    fine = pulsed(pwm_hz, 0.5, 1)
    assert fine.voltage_v is not None
    mean = np.convolve(fine.current_a, np.full(40, 1.0 / 40.0), mode="same")  # as an inductance leaves it
    with pytest.raises(UnusableError, match="sampled more slowly than it switches"):
        refuse_aliased(fine.voltage_v[::20], mean[::20])


@pytest.mark.parametrize(("count", "is_refused"), [(7, False), (8, True)])
def test_eight_jumps_of_the_voltage_must_show_in_the_current(count: int, is_refused: bool) -> None:
    noise = np.random.default_rng(7).standard_normal(400)
    refusal = pytest.raises(UnusableError, match="does not follow the voltage")
    with refusal if is_refused else nullcontext():
        refuse_aliased(off_on(*[20] * count, 400 - 20 * count), noise)


def begins(parts: list[Recording]) -> list[tuple[int, int]]:
    """First and last sample of each part."""
    return [(round(part.time_s[0] * 1e3), round(part.time_s[-1] * 1e3)) for part in parts]


def test_starts_are_cut_where_the_motor_is_switched_off() -> None:
    volts = off_on(150, 300, 200, 300, 250, 300)
    parts = split_starts(driven(volts))
    assert begins(parts) == [(0, 449), (450, 949), (950, 1499)]
    assert [part.path.name for part in parts] == ["x#1", "x#2", "x#3"]
    assert parts[1].columns == ("start 2 of 3 in the file",)
    assert begins(split_starts(driven(-volts))) == begins(parts)  # a supply of either sign rises from rest
    current = np.where(volts > 0.0, 0.5, 0.0)
    for first in (150, 650, 1200):
        current[first : first + 60] += 5.0 * np.exp(-np.arange(60.0) / 20.0)
    assert begins(split_starts(replace(driven(volts, current=current), voltage_v=None))) == begins(parts)
    assert split_starts(driven(off_on(150, 300)))[0].path.name == "x"
    assert [part.path.name for part in chosen_starts(driven(volts), 2)] == ["x#2"]


@pytest.mark.parametrize("rate_hz", [1_000.0, 100_000.0])
@pytest.mark.parametrize("has_voltage", [True, False])
def test_a_switch_that_bounces_for_milliseconds_makes_one_start(rate_hz: float, has_voltage: bool) -> None:
    time_s = np.arange(round(0.4 * rate_hz)) / rate_hz
    on = (time_s > 0.1) & ~((time_s > 0.106) & (time_s < 0.114)) & ~((time_s > 0.120) & (time_s < 0.126))
    volts = np.where(on, 12.0, 0.0) if has_voltage else None
    assert len(split_starts(Recording(Path("x"), time_s, np.where(on, 2.0, 0.0), volts))) == 1


def test_a_sine_is_not_a_thousand_starts() -> None:
    time_s = np.linspace(0.0, 20.0, 200_000, endpoint=False)
    sine = Recording(Path("sine"), time_s, np.sin(2.0 * np.pi * 12.0 * time_s))
    with pytest.raises(InputError, match="at most 200 starts"):
        chosen_starts(sine)
    assert len(chosen_starts(sine, 3)) == 1


@pytest.mark.parametrize(
    ("volts", "names"),
    [
        (off_on(0, 300, 200, 300, 200, 300), ["x#2", "x#3"]),  # the first had begun
        (off_on(0, 300), ["x"]),  # the only one
        # The last ends too soon: half as long under voltage as the others are in the median, 300 samples.
        (off_on(100, 300, 200, 250, 200, 900, 200, 149), ["x#1", "x#2", "x#3"]),
        (off_on(100, 300, 200, 250, 200, 900, 200, 150), ["x#1", "x#2", "x#3", "x#4"]),
        (off_on(100, 300, 200, 149), ["x#1", "x#2"]),  # which of two is whole, nobody knows
    ],
)
def test_of_several_starts_those_that_lie_in_the_recording_are_chosen(
    volts: FloatArray, names: list[str]
) -> None:
    recording = driven(volts)
    assert [part.path.name for part in chosen_starts(recording)] == names
    assert len(chosen_starts(recording, len(split_starts(recording)))) == 1  # who asks for one gets it


@pytest.mark.parametrize("has_speed", [False, True])
@pytest.mark.parametrize("has_voltage", [False, True])
def test_a_start_has_the_rest_before_it_and_no_braking(has_speed: bool, has_voltage: bool) -> None:
    """The current of a motor that is braked decays, and so does its speed, which may end later."""
    volts, noise = off_on(100, 300, 400, 300), np.random.default_rng(3).uniform(-0.01, 0.01, 1100)
    current, speed = np.where(volts > 0.0, 2.0, 0.0) + noise, np.where(volts > 0.0, 50.0, 0.0)
    current[400:500] -= np.linspace(1.5, 0.1, 100)
    speed[400:650] += np.linspace(50.0, 1.0, 250)
    recording = driven(volts, speed=speed if has_speed else None, current=current)
    parts = chosen_starts(recording if has_voltage else replace(recording, voltage_v=None))
    assert begins(parts) == [(0, 399), (650 if has_speed else 500, 1099)]


def started(voltage: FloatArray | None) -> Recording:
    """A start at sample 200."""
    since = np.maximum(np.arange(1000) - 199.0, 0.0)
    current = 5.0 * (np.exp(-since / 300.0) - np.exp(-since / 3.0)) + 0.05 * (since > 0.0)
    noise = 0.02 * np.random.default_rng(1).standard_normal(1000)
    return Recording(Path("start"), 1e-4 * np.arange(1000.0), current + noise, voltage)


STEP = np.where(np.arange(1000) >= 200, 9.0, 0.0)
MEASURED = STEP + 0.01 * np.random.default_rng(8).standard_normal(1000)


def test_the_supply_of_a_start() -> None:
    command = prepare(started(STEP))
    assert (command.level_v, command.voltage_v, command.voltage_known) == (9.0, None, True)
    measured = prepare(started(MEASURED))
    assert measured.voltage_v is not None
    assert measured.level_v == pytest.approx(np.median(MEASURED[-250:]))
    duty = prepare(replace(started(None), duty=STEP / 9.0 * 0.5), 24.0)
    assert (duty.level_v, duty.voltage_known) == (12.0, True)
    unknown = prepare(started(None))
    assert (unknown.level_v, unknown.voltage_known) == (1.0, False)
    assert prepare(started(None), 12.0, Circuit(shunt_ohm=0.1)).circuit.shunt_ohm == 0.1
    assert (mean_tail(np.arange(100.0)), mean_tail(np.arange(5.0))) == (94.5, 4.0)
    backwards = prepare(replace(started(None), speed_rad_s=-np.arange(1000.0)))
    assert backwards.speed_rad_s is not None
    assert backwards.speed_rad_s[-1] == 999.0


@pytest.mark.parametrize(
    ("voltage", "circuit", "words"),
    [
        (9.0 + 0.03 * STEP + 0.1 * (MEASURED - STEP), None, "V in the first sample already"),
        (9.0 - STEP, None, "the voltage is 0 at the end"),
        (None, Circuit(shunt_ohm=0.1), "a shunt in series"),
    ],
)
def test_a_start_whose_supply_cannot_be_used_is_unusable(
    voltage: FloatArray | None, circuit: Circuit | None, words: str
) -> None:
    with pytest.raises(UnusableError, match=words):
        prepare(started(voltage), None, circuit)
    assert not prepare(started(9.0 + 0.3 * STEP + 0.1 * (MEASURED - STEP))).from_rest


QUIET, ON, OFF = 100, 400, 300
END = QUIET + ON
ZEROS: FloatArray = np.zeros(OFF)


def shown(after: FloatArray, *, steady_a: float = 1.0, noise_a: float = 0.02, seed: int = 2) -> Recording:
    """A start of 5 A that decays in 40 samples, and what follows when it is switched off; the current alone."""
    running: FloatArray = steady_a + (5.0 - steady_a) * np.exp(-np.arange(float(ON)) / 40.0)
    current = np.concatenate([np.zeros(QUIET), running, after])
    current = current + noise_a * np.random.default_rng(seed).standard_normal(len(current))
    return Recording(Path("x"), 1e-3 * np.arange(float(len(current))), current)


def end_of(recording: Recording) -> int:
    return end_of_supply(recording, align(recording))


def decay(first_a: float, samples: float) -> FloatArray:
    return np.asarray(first_a * np.exp(-np.arange(OFF) / samples))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset_a", [0.0, 0.3])
@pytest.mark.parametrize(
    "after", [ZEROS, decay(0.7, 3.0), decay(-2.0, 40.0), np.append(0.5, decay(-3.0, 40.0))]
)
def test_a_current_that_is_switched_off_ends_the_start(
    after: FloatArray, offset_a: float, sign: float
) -> None:
    """At once, over the winding's L/R, or by a brake that turns it round."""
    recording = shown(after)
    # The last sample may have been taken while it fell.
    assert end_of(replace(recording, current_a=sign * (recording.current_a + offset_a))) == END - 1


@pytest.mark.parametrize(
    ("recording", "is_end"),
    [
        (shown(np.full(OFF, 1.0)), False),
        (shown(np.append(np.full(100, -1.3), np.full(200, 1.0))), True),  # a quarter of 5 A
        (shown(np.zeros(24)), True),  # three of fifty blocks
        (shown(ZEROS, steady_a=0.15, noise_a=0.04), True),  # from three times a block's error
        (shown(ZEROS, steady_a=0.05, noise_a=0.04), False),  # a current that decays into the noise
    ],
)
def test_what_is_no_end(recording: Recording, is_end: bool) -> None:
    assert (end_of(recording) < len(recording.time_s)) is is_end


@pytest.mark.parametrize(
    ("off", "left_v", "end"),
    [(3, 0.0, END + OFF - 3), (2, 0.0, END + OFF), (OFF, 0.51, END + OFF), (OFF, 0.49, END)],
)
def test_a_voltage_that_goes_off_for_good_ends_the_start(off: int, left_v: float, end: int) -> None:
    """For three samples or more, to less than a twentieth."""
    recording = shown(np.full(OFF, 1.0))
    volts: FloatArray = np.repeat([0.0, 10.0, left_v], [QUIET, ON + OFF - off, off])
    volts[200:240] = 0.0  # a contact that bounces
    assert end_of(replace(recording, voltage_v=volts)) == end
    assert end_of(replace(recording, duty=volts / 12.0)) == end


@pytest.mark.parametrize("brake_a", [0.0, 2.0])
@pytest.mark.parametrize("has_voltage", [False, True])
def test_a_motor_that_is_switched_off_is_judged_by_its_start(has_voltage: bool, brake_a: float) -> None:
    begun, rng = start(Fault(FaultKind.BEARING, 3.0)), np.random.default_rng(8)
    whole = begun if has_voltage else replace(begun, voltage_v=None)
    longer = replace(
        whole,
        time_s=whole.dt_s * np.arange(len(whole.time_s) + OFF) + whole.time_s[0],
        current_a=np.append(whole.current_a, decay(-brake_a, 100.0) + 0.02 * rng.standard_normal(OFF)),
        voltage_v=None if whole.voltage_v is None else np.append(whole.voltage_v, np.zeros(OFF)),
    )
    expected, found = (diagnose(one, SHEET, voltage_v=12.0) for one in (whole, longer))
    assert (expected.verdict, found.verdict) == ("bearing", "bearing")
    assert [c.ratio for c in found.changes] == pytest.approx([c.ratio for c in expected.changes], rel=0.01)
