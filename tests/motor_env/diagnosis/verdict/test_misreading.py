"""Numbers of what was read wrongly: which factor is which unit, and how far wear may go."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from motor_env.diagnosis.estimation import parameter_index as index

# Reaches in: a log that is read wrongly is judged by its windows.
from motor_env.diagnosis.operation import log_diagnosis as judging
from motor_env.diagnosis.operation.windows import WindowJudge
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference
from motor_env.diagnosis.verdict.hypotheses import NAMES, Difference, FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.scaling_errors import (
    BEYOND_WEAR,
    EXPLAINED,
    describe_scaling_errors,
    find_scaling_errors,
)
from motor_env.motor.healthy import Windows

FULL, CURRENT = ("R", "L", "K", "J", "B"), ("R", "L", "K^2/J", "B/J")
POWERS = {
    "current": (-1.0, -1.0, 0.0, 1.0, 1.0),
    "voltage": (1.0, 1.0, 1.0, 1.0, 1.0),
    "speed": (0.0, 0.0, -1.0, -2.0, -2.0),
    "time": (0.0, 1.0, 0.0, 1.0, 0.0),
}
"""Of R, L, K, J and B, from the equations of the motor."""
EXPONENTS = {
    FULL: np.eye(6)[:5],
    CURRENT: np.array(
        [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, -1, 0, 0], [0, 0, 0, -1, 1, 0]], dtype=float
    ),
}


BRUSHES = ", and at the brushes, whose drop may act alike"


def told(names: tuple[str, ...], column: str, factor: float, sd: float = 0.01, off: float = 0.0) -> str:
    exponents = EXPONENTS[names]
    moved = exponents @ [*POWERS[column], 0.0] * math.log(factor)
    moved[0] += off
    difference = Difference(moved, sd**2 * np.eye(len(names)), exponents, 1e6)
    sentence = describe_scaling_errors(find_scaling_errors(difference, names, 3.0, 0.01))
    assert sentence == "" or sentence.startswith(f"{EXPLAINED} if the ")
    return sentence.removeprefix(f"{EXPLAINED} if the ")


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("speed", 9.549, "in rpm, and was read in rad/s"),
        ("speed", 57.30, "in degrees a second, and was read in rad/s"),
        ("speed", 0.1592, "in turns a second, and was read in rad/s"),
        ("speed", 9.549e-3, "in thousands of rpm, and was read in rad/s"),
        ("speed", 1.3, "1.3 times too large (look at pulses a turn, gear and unit)"),
        ("current", 1000.0, "in mA, and was read in A"),
        ("current", 1e-3, "in kA, and was read in A"),
        ("current", 1.03 * 10.0, "10 times too large (look at the scale of its probe or shunt)"),
        ("current", 1.07 * 10.0, "10.7 times too large (look at the scale of its probe or shunt)"),
        ("voltage", 0.01, "100 times too small (look at the scale of its probe or divider)"),
        ("voltage", 0.8, "1.25 times too small (look at the scale of its probe or divider)"),
        ("voltage", 1.6, "1.6 times too large (look at the scale of its probe or divider)"),
        (
            "voltage",
            1.4,
            f"1.4 times too large (look at the scale of its probe or divider{BRUSHES})",
        ),
        ("voltage", 1000.0, "in mV, and was read in V"),
        ("voltage", 1e-3, "in kV, and was read in V"),
        ("time", 0.5, "2 times too small (look at the sampling rate)"),
        ("time", 1e3, "in ms, and was read in s"),
        ("time", 1e6, "in microseconds, and was read in s"),
        ("time", 1.0 / 60.0, "in minutes, and was read in s"),
    ],
)
def test_a_factor_is_named_by_its_column_and_unit(column: str, factor: float, words: str) -> None:
    assert told(FULL, column, factor) == f"{column} is {words}"


def test_what_a_wrong_scale_does_not_explain_is_not_put_down_to_one() -> None:
    assert told(FULL, "current", 2.0, off=0.03).startswith("current is 2 times")
    assert told(FULL, "current", 2.0, off=0.06) == ""
    assert told(FULL, "current", 1.02) == ""  # no quantity has moved by three standard deviations
    assert told(FULL, "current", 1.04).startswith("current is 1.04 times")


def test_without_a_speed_a_larger_current_is_a_smaller_voltage() -> None:
    probe = "(look at the scale of its probe or shunt)"
    both = f"current is 2 times too large {probe}, or if the voltage is 2 times too small"
    assert told(CURRENT, "current", 2.0).startswith(both)
    assert told(CURRENT, "voltage", 0.5).startswith(both)
    per_volt = Difference(
        -math.log(2.0) * np.array([1.0, 1.0, 1.0, 0.0]), 1e-4 * np.eye(4), EXPONENTS[CURRENT], 1e6
    )
    alone = describe_scaling_errors(
        find_scaling_errors(per_volt, ("R/V", "L/V", "K^2/(J V)", "B/J"), 3.0, 0.01)
    )
    assert "current is 2 times" in alone
    assert "voltage" not in alone


def test_an_inertia_that_moved_alone_is_put_down_to_the_clock_only_by_a_round_factor() -> None:
    exponents, moved = EXPONENTS[FULL][[0, 2, 3, 4]], np.zeros(4)
    for factor, sd, words in (
        (2.0, 0.01, "time is 2 times"),
        (2.3, 0.01, ""),
        (1.96, 0.1, "2 times"),
        (1.7, 0.1, ""),
    ):
        moved[2] = math.log(factor)
        difference = Difference(moved, sd**2 * np.eye(4), exponents, 1e6)
        sentence = describe_scaling_errors(find_scaling_errors(difference, NAMES, 3.0, 0.01))
        assert (words in sentence) is bool(words or not sentence)
        assert bool(sentence) is bool(words)


@pytest.mark.parametrize(("friction", "is_named"), [(1.0, True), (1.9, True), (9.0, False)])
def test_a_whole_log_that_was_read_wrongly_need_not_fit_to_a_percent(
    friction: float, is_named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A speed in degrees a second, and windows that scatter by 1 %; the friction is not all viscous."""
    motor, by = {"R": 2.0, "K": 0.03, "J": 4e-6, "B": 2e-6}, 180.0 / math.pi
    windows = Windows(0.5, (), np.zeros(index.N_VALUES), "held", 1e-3, 100.0)
    reference = Reference("it", NAMES, np.log(list(motor.values())), 1e-4 * np.eye(4))
    read = np.zeros(index.N_VALUES)
    read[[index.R, index.K, index.J]] = 1.02 * motor["R"], motor["K"] / by, 0.97 * motor["J"] / by**2
    read[index.B] = friction * motor["B"] / by**2
    monkeypatch.setattr(judging, "from_recordings", lambda _: None)
    joint = SimpleNamespace(solution=SimpleNamespace(values=read), expected=np.ones((2, 2)))
    monkeypatch.setattr(judging, "identify_record", lambda _: joint)
    log: Any = Recording(Path("log"), np.arange(2.0), np.zeros(2))
    said = Judgement(Verdict.OTHER, (BEYOND_WEAR,))
    (found,) = judging._as_a_whole([said], log, WindowJudge(windows, reference))
    named = f"{EXPLAINED} if the speed is in degrees a second, and was read in rad/s"
    assert found.reasons == (named if is_named else BEYOND_WEAR,)


@pytest.mark.parametrize(
    ("quantity", "factor", "verdict"),
    [("B", 9.8, "bearing"), ("B", 10.3, "other"), ("R", 9.8, "winding"), ("R", 10.3, "other"),
     ("K", 1.0 / 2.94, "magnet"), ("K", 1.0 / 3.1, "other")],
)  # fmt: skip
def test_no_wear_goes_further_than_ten_times_in_friction_and_resistance_and_three_times_in_all_else(
    quantity: str, factor: float, verdict: str
) -> None:
    shape = 1e-4 * np.eye(4)
    reference = Reference("it", NAMES, np.zeros(4), shape, 1e6, includes_fit_error=True)
    moved = np.where(np.array(NAMES) == quantity, math.log(factor), 0.0)
    found = decide(FittedWindow(moved, 1e-6 * np.eye(4)), reference, 0.01)
    assert found.verdict == verdict
    assert (BEYOND_WEAR in found.reasons) is (verdict == "other")
    assert (found.severity is None) is (verdict == "other")


def test_a_gain_that_explains_as_much_as_a_fault_does_is_told_beside_it() -> None:
    """Twice the drag, where R and J are hardly told: a bearing, or a current that reads twice too large."""
    shape = np.diag(np.square([0.8, 0.03, 0.8, 0.03]))
    window = FittedWindow(np.array([0.0, 0.0, 0.0, math.log(2.0)]), 1e-6 * np.eye(4))
    taught = Reference("it", NAMES, np.zeros(4), shape, 1e6, includes_fit_error=True, is_taught=True)
    found = decide(window, taught, 0.01)
    assert found.verdict == "bearing"
    assert found.reasons[-1].startswith(f"{EXPLAINED} if the current is 2 times too large")
    share = re.search(r"\(probability (\d+)%, of bearing (\d+)%\)$", found.reasons[-1])
    assert share is not None
    gain, bearing = map(int, share.groups())
    assert 5 < gain < bearing
    assert gain + bearing <= 100
    assert found.confidence == pytest.approx(bearing / 100.0, abs=0.006)  # the gain counts in it, too
    sheet = decide(window, replace(taught, is_taught=False), 0.01)
    assert "probability" not in sheet.reasons[-1]
