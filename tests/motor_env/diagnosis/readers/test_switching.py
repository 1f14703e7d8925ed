"""Where a motor is switched off: at rest, by a relay or a brake; and what is no such end.

Reaches in: where a supply ends stands in no result.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judged_by_hand import SHEET, start

from motor_env import Fault, FaultKind, Recording, diagnose
from motor_env.diagnosis.readers.alignment import align
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import end_of_supply, prepare, split_starts
from motor_env.motor.parameters import FloatArray

QUIET, ON, OFF = 100, 400, 300
END = QUIET + ON


def shown(after: FloatArray, *, steady_a: float = 1.0, noise_a: float = 0.02, seed: int = 2) -> Recording:
    """A start of 5 A that decays in 40 samples, and what follows when it is switched off; the current alone."""
    running: FloatArray = steady_a + (5.0 - steady_a) * np.exp(-np.arange(float(ON)) / 40.0)
    current = np.concatenate([np.zeros(QUIET), running, after])
    current = current + noise_a * np.random.default_rng(seed).standard_normal(len(current))
    return Recording(Path("x"), 1e-3 * np.arange(float(len(current))), current)


def end_of(recording: Recording) -> int:
    return end_of_supply(recording, align(recording))


def decay(first_a: float, samples: float, n: int = OFF) -> FloatArray:
    return np.asarray(first_a * np.exp(-np.arange(n) / samples))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset_a", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_a_current_that_is_switched_off_ends_the_start(sign: float, offset_a: float, seed: int) -> None:
    """At once, over the winding's L/R, or by a brake that turns it round; 400 samples are 25 whole blocks."""
    braked = np.append(0.5, decay(-3.0, 40.0))
    for after in (np.zeros(OFF), np.zeros(ON), decay(0.7, 3.0), decay(-2.0, 40.0), braked):
        recording = shown(after, seed=seed)
        # The last sample may have been taken while it fell.
        assert end_of(replace(recording, current_a=sign * (recording.current_a + offset_a))) == END - 1


def test_what_is_no_end() -> None:
    n = END + OFF
    assert end_of(shown(np.full(OFF, 1.0))) == n
    assert end_of(shown(np.full(OFF, 0.3))) == n  # another load
    for against, end in ((-1.2, n), (-1.3, END - 1)):  # a quarter of 5 A
        assert end_of(shown(np.append(np.full(100, against), np.full(200, 1.0)))) == end
    for pause, is_end in ((23, False), (24, True)):  # three of fifty blocks
        assert (end_of(shown(np.zeros(pause))) < END + pause) is is_end
    # A current that decays into the noise has no end; one that falls to rest from three times a block's error has.
    for steady, is_end in ((0.0, False), (0.12, False), (0.15, True)):
        assert (end_of(shown(np.zeros(OFF), steady_a=steady, noise_a=0.04)) < n) is is_end
    # The offset is known as well as the quiet part allows, and no better than the converter's steps.
    for steady, is_end in ((0.15, False), (0.5, True)):
        whole = shown(np.zeros(OFF), steady_a=steady, noise_a=0.04)
        brief = replace(whole, time_s=whole.time_s[QUIET - 12 :], current_a=whole.current_a[QUIET - 12 :])
        assert (end_of(brief) < 12 + ON + OFF) is is_end
    for steady, is_end in ((0.2, False), (0.6, True)):
        whole = shown(np.zeros(OFF), steady_a=steady, noise_a=0.005)
        coarse = replace(whole, current_a=0.1 * np.round(whole.current_a / 0.1))
        assert (end_of(coarse) < n) is is_end
    begun = shown(np.zeros(OFF))
    without_quiet = replace(begun, time_s=begun.time_s[QUIET:], current_a=begun.current_a[QUIET:])
    assert end_of(without_quiet) == ON + OFF


def test_a_current_that_is_hardly_one_has_no_end() -> None:
    """A short pulse in noise: the mean of no stretch stands out."""
    pulse = shown(np.zeros(OFF), noise_a=0.05)
    quiet = replace(pulse, current_a=pulse.current_a - shown(np.zeros(OFF), noise_a=0.0).current_a)
    quiet.current_a[QUIET : QUIET + 2] += 1.0
    assert end_of(quiet) == END + OFF


def test_a_voltage_that_goes_off_for_good_ends_the_start() -> None:
    recording = shown(np.full(OFF, 1.0))
    on = np.arange(END + OFF) >= QUIET
    volts: FloatArray
    for off, end in ((3, END + OFF - 3), (2, END + OFF)):
        volts = 12.0 * (on & (np.arange(END + OFF) < END + OFF - off)).astype(float)
        volts[200:240] = 0.0  # a contact that bounces
        assert end_of(replace(recording, voltage_v=volts)) == end
        assert end_of(replace(recording, duty=volts / 12.0)) == end
    for left, end in ((0.51, END + OFF), (0.49, END)):  # less than a twentieth is off
        volts = np.where(np.arange(END + OFF) < END, 10.0 * on, left)
        assert end_of(replace(recording, voltage_v=volts)) == end


def test_what_follows_is_left_out_of_a_start() -> None:
    recording = shown(decay(-2.0, 40.0))
    found = prepare(recording, 12.0)
    np.testing.assert_array_equal(found.current_a, recording.current_a[: END - 1])
    # No start is left where too few samples are.
    brief: FloatArray = np.zeros(END + OFF)
    brief[QUIET : QUIET + 12] = 12.0
    short = replace(recording, voltage_v=brief)
    with pytest.raises(UnusableError, match="the voltage is 0 at the end"):
        prepare(short)


@pytest.mark.parametrize("has_voltage", [False, True])
def test_a_motor_that_is_switched_off_is_judged_by_its_start(has_voltage: bool) -> None:
    """A healthy one had less friction, where a current of 0 A counted as a motor's that turns."""
    begun, rng = start(Fault(FaultKind.BEARING, 3.0)), np.random.default_rng(8)
    whole = begun if has_voltage else replace(begun, voltage_v=None)
    expected = diagnose(whole, SHEET, voltage_v=12.0)
    assert expected.verdict == "bearing"
    for brake_a in (0.0, 2.0):
        after = decay(-brake_a, 100.0) + 0.02 * rng.standard_normal(OFF)
        longer = replace(
            whole,
            time_s=whole.dt_s * np.arange(len(whole.time_s) + OFF) + whole.time_s[0],
            current_a=np.append(whole.current_a, after),
            voltage_v=None if whole.voltage_v is None else np.append(whole.voltage_v, np.zeros(OFF)),
        )
        found = diagnose(longer, SHEET, voltage_v=12.0)
        assert found.verdict == "bearing"
        assert [c.ratio for c in found.changes] == pytest.approx(
            [c.ratio for c in expected.changes], rel=0.01
        )


def test_a_switch_that_bounces_cuts_no_start_of_several() -> None:
    """The longest pause is the one between two starts, whatever disturbs its end."""
    lengths = (100, 5, 4, 300, 200, 5, 4, 300)
    volts = np.concatenate([np.full(n, 12.0 * (k % 2)) for k, n in enumerate(lengths)])
    volts[580] = 1.0
    recording = Recording(Path("x"), 1e-3 * np.arange(float(len(volts))), 0.1 * volts, volts)
    assert [len(part.time_s) for part in split_starts(recording)] == [409, 509]
