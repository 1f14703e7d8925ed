"""Sensors that failed: said before any fault of a motor is, and never where the motor alone is at fault."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import at_work, by_sensors, scaled, started, without
from present import present
from scipy.signal import lfilter

from motor_env import PAPER_MOTOR, Recording, commission, diagnose, read_recording, simulate_states
from motor_env.common.errors import InputError
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference
from motor_env.diagnosis.verdict.hypotheses import NAMES, Difference, FittedWindow
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.diagnosis.verdict.report_page import VERDICT_TEXTS
from motor_env.diagnosis.verdict.scaling_errors import (
    BEYOND_WEAR,
    EXPLAINED,
    describe_scaling_errors,
    find_scaling_errors,
)
from motor_env.diagnosis.verdict.sensor_diagnosis import (
    ChannelRecord,
    correlation,
    diagnose_sensors,
    find_failure,
    free_run,
    physical_values,
)

# Reaches in: motors that one recording teaches, and the checks by themselves.
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import SENSOR_KINDS, FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import RECIPES, changed_recipe
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.sampling import draw, measure_draw

DT_S = 2e-3
SHEET = Motor("paper", "data_sheet", PAPER_MOTOR, 12.0)
PHYSICAL = physical_values(SHEET)
COLUMNS = {"current_a": "current", "speed_rad_s": "speed", "voltage_v": "voltage"}


def failures(recording: Recording) -> Iterator[tuple[str, Recording]]:
    """The recording with each failed sensor that its columns allow, by the kind."""
    rng, count = np.random.default_rng(1), len(recording.time_s)
    columns: dict[str, FloatArray] = {
        name: getattr(recording, name) for name in COLUMNS if getattr(recording, name) is not None
    }

    def changed(**to: FloatArray) -> Recording:
        given: dict[str, Any] = to
        return replace(recording, **given)

    for name, values in columns.items():
        top = float(np.max(np.abs(values)))
        half_way = int(np.argmax(np.abs(values) > 0.5 * top)) + 3
        yield f"{COLUMNS[name]}_polarity", changed(**{name: -values})
        if name == "voltage_v":
            continue
        noise = 0.002 * top * np.round(rng.standard_normal(count), 1)
        yield f"{COLUMNS[name]}_dead", changed(**{name: np.zeros(count)})
        yield f"{COLUMNS[name]}_dead", changed(**{name: noise})
        held = np.where(np.arange(count) < half_way, values, values[min(half_way, count - 1)])
        yield f"{COLUMNS[name]}_stuck", changed(**{name: held})
    names = list(columns)
    for n, one in enumerate(names):
        for other in names[n + 1 :]:
            yield "swapped", changed(**{one: columns[other], other: columns[one]})


def failed_kind(seen: ChannelRecord, physical: FloatArray = PHYSICAL) -> FaultKind | None:
    found = find_failure(seen, physical)
    return None if found is None else found.kind


def kind_of(recording: Recording, motor: Motor = SHEET, **more: Any) -> FaultKind | None:
    found = diagnose_sensors(recording, motor, **more)
    return None if found is None else found.kind


def seen(recording: Recording, *, is_log: bool) -> ChannelRecord:
    assert recording.voltage_v is not None
    columns = recording.voltage_v, recording.current_a, recording.speed_rad_s
    return ChannelRecord(recording.dt_s, *columns, at_work=is_log)


@pytest.mark.parametrize("is_log", [False, True], ids=["start", "log"])
@pytest.mark.parametrize("missing", [(), ("speed_rad_s",)], ids=["speed", "no speed"])
def test_each_failure_is_named(is_log: bool, missing: tuple[str, ...]) -> None:
    recording = without((at_work if is_log else started)(np.random.default_rng(2)), *missing)
    for kind, failed in failures(recording):
        if kind == "swapped" and missing:
            continue  # two columns are swapped back by `diagnose`
        # Of two channels that go against each other the current is said to be reversed.
        expected = "current_polarity" if missing and kind == "voltage_polarity" else kind
        assert failed_kind(seen(failed, is_log=is_log)) == expected


def test_a_range_that_is_too_small_is_named() -> None:
    start = started(np.random.default_rng(3))
    short = seen(replace(start, current_a=np.clip(start.current_a, -2.5, 2.5)), is_log=False)
    found = present(find_failure(short, PHYSICAL))
    assert found.kind == "current_clipped"
    assert re.search(r"stand at 2\.5 A, where the healthy motor reaches [45]\.\d+ A$", found.reasons[0])
    # A data sheet says nothing of the sensor of a start.
    assert find_failure(short._replace(is_taught=False), PHYSICAL) is None


@pytest.mark.parametrize(
    ("offset_a", "known_a", "kind"),
    [
        (1.0, 0.0, "current_offset"),
        (0.1, 0.0, None),
        (1.0, 1.0, None),  # the healthy logs had that offset, too
        (0.0, 1.0, None),  # it is gone, and nothing contradicts that
        (1.0, -1.0, "current_offset"),
    ],
)
def test_an_offset_is_named(offset_a: float, known_a: float, kind: str | None) -> None:
    log, known = at_work(np.random.default_rng(3)), PHYSICAL.copy()
    known[index.OFFSET_I] = known_a
    assert failed_kind(seen(replace(log, current_a=log.current_a + offset_a), is_log=True), known) == kind
    for read in ({"current_a": 1e3}, {"speed_rad_s": 0.03 / np.pi}):  # a unit is no failed sensor
        assert kind_of(scaled(log, **read), at_work=True) is None


def high_pass(current: FloatArray, tau_s: float, dt_s: float) -> FloatArray:
    """What a probe shows that is coupled by a capacitor, charged before."""
    kept = tau_s / (tau_s + dt_s)
    shown: FloatArray = lfilter([kept, -kept], [1.0, -kept], current)
    return shown


@pytest.mark.parametrize("tau_s", [0.02, 0.1])
def test_a_log_tells_the_time_constant_of_a_coupling(tau_s: float) -> None:
    log = at_work(np.random.default_rng(2))
    coupled = replace(log, current_a=high_pass(log.current_a, tau_s, log.dt_s))
    found = present(find_failure(seen(coupled, is_log=True), PHYSICAL))
    assert found.verdict is Verdict.UNUSABLE
    told = present(re.search(r"AC-coupled: a high pass of about (\S+) s", found.reasons[0]))
    assert float(told[1]) == pytest.approx(tau_s, rel=0.1)
    with pytest.raises(InputError, match=r"cannot be used: (a: )?the current is AC-coupled"):
        commission([replace(coupled, path=Path(name)) for name in "ab"], regime="operation")
    # A slow one shows in no single current, and is no failure: the friction tells where it matters.
    slower = replace(log, current_a=high_pass(log.current_a, 2.0, log.dt_s))
    assert find_failure(seen(slower, is_log=True), PHYSICAL) is None


def start_behind(friction: float, tau_s: float, seconds: float, seed: int = 3) -> Recording:
    """A start with a share of the usual friction, seen through a probe that is coupled by a capacitor."""
    motor, dt_s = replace(PAPER_MOTOR, viscous_friction_n_m_s_per_rad=friction * 1.2e-6), 4e-4
    time_s: FloatArray = dt_s * np.arange(round(seconds / dt_s), dtype=float)
    voltage_v = np.where(time_s >= 0.02, 12.0, 0.0)
    current = simulate_states(motor, voltage_v, dt_s)[:, 0]
    current = current if tau_s == math.inf else high_pass(current, tau_s, dt_s)
    current = current + 0.01 * np.random.default_rng(seed).standard_normal(len(current))
    return Recording(Path(f"start{seed}"), time_s, current, voltage_v)


@pytest.mark.parametrize(
    ("friction", "tau_s", "seconds", "verdict", "words"),
    [
        (1.0, 0.03, 0.3, Verdict.UNUSABLE, "AC-coupled: a high pass of about"),
        (1.5, 0.3, 0.3, Verdict.UNUSABLE, "AC-coupled: a high pass of about"),
        (1.0, 2.0, 0.3, Verdict.UNUSABLE, "AC-coupled (a high pass of about"),
        (0.5, math.inf, 4.0, Verdict.OTHER, "AC-coupled (a high pass of about"),
        (1.0, math.inf, 0.3, Verdict.HEALTHY, "no quantity has moved"),
    ],
)
def test_friction_that_falls_is_a_probes(
    friction: float, tau_s: float, seconds: float, verdict: Verdict, words: str
) -> None:
    """A start whose level stays for longer than the time constant is of a motor with less friction."""
    found = diagnose(start_behind(friction, tau_s, seconds), SHEET)
    assert found.verdict is verdict
    assert any(words in reason for reason in found.reasons)


@pytest.mark.parametrize(("friction", "tau_s"), [(0.9, 1.0), (1.8, 0.5)])
def test_a_machine_without_its_load_keeps_drag_of_its_own(friction: float, tau_s: float) -> None:
    """Half the drag may be a lost load; where hardly any is left, or too little to be told, it is a probe's."""
    taught = commission([start_behind(friction, math.inf, 0.3, seed) for seed in (4, 5, 6)]).motor
    assert diagnose(start_behind(friction, tau_s, 0.3), taught).verdict is Verdict.UNUSABLE
    assert diagnose(start_behind(0.5 * friction, math.inf, 3.0), taught).verdict is not Verdict.UNUSABLE


@pytest.mark.parametrize("column", ["current_a", "speed_rad_s"])
def test_a_column_of_another_motor_is_named_and_a_noisy_one_is_not(column: str) -> None:
    """Two motors of one machine; or a voltage that moves by less than a count of an encoder, or a converter's step."""
    one, other = (at_work(np.random.default_rng(seed)) for seed in (4, 5))
    columns: dict[str, Any] = {column: getattr(other, column)}
    found = present(find_failure(seen(replace(one, **columns), is_log=True), PHYSICAL))
    assert found.kind == "swapped"
    assert found.reasons[0].startswith(f"the {COLUMNS[column]} is not that of the motor")
    rng = np.random.default_rng(3)
    volts = 6.0 + np.repeat(rng.uniform(-1.0, 1.0, 40), 30)
    healthy = ChannelRecord(DT_S, volts, *free_run(PHYSICAL, volts, DT_S))
    own = getattr(healthy, column)
    noise = rng.normal(0.0, np.std(own), len(volts))
    shown = healthy._replace(**{column: own + 4.0 * noise})
    assert correlation(getattr(shown, column), own) < 0.3
    assert find_failure(shown, PHYSICAL) is None
    assert failed_kind(healthy._replace(**{column: np.roll(own, 317) + 0.01 * noise})) == "swapped"


LARGE = (("bearing", 3.0), ("winding_contact", 2.0), ("winding_short", 0.5), ("magnet", 0.5))


@pytest.mark.parametrize("count", [60, pytest.param(350, marks=pytest.mark.long)])
@pytest.mark.parametrize("recipe", ["bench", "field", "operation"])
def test_no_motor_is_taken_for_a_failed_sensor(recipe: str, count: int) -> None:
    """Half of the motors have large faults."""
    classes = (FaultClass(weight=4.0), *(FaultClass(FaultKind(name), size) for name, size in LARGE))
    drawn_from = changed_recipe(
        replace(RECIPES[recipe], classes=classes, healthy_starts=0), channels=("current", "speed")
    )
    readings = measure_draw(draw(drawn_from, 3, np.arange(count)), drawn_from, 3).astype(np.float64)
    is_log, time_s = drawn_from.duty is not None, drawn_from.timing.time_s
    physical = physical_values(replace(SHEET, parameters=drawn_from.motor))
    for row in readings:
        volts = row[-1] if is_log else np.where(time_s > 1e-9, 12.0, 0.0)
        for speed in (row[1], None):
            one = ChannelRecord(drawn_from.timing.dt_s, volts, row[0], speed, at_work=is_log)
            assert find_failure(one, physical) is None
            assert find_failure(one._replace(has_sign=False), physical) is None


def test_every_failure_says_what_to_do_first() -> None:
    for kind in SENSOR_KINDS:
        title, *first = VERDICT_TEXTS[kind]
        assert len(first) >= 2
        assert min(map(len, (kind.finding, title, *first))) > 15
    log = at_work(np.random.default_rng(1))
    page = diagnose(scaled(log, current_a=0.0), SHEET).page()
    for words in ("sensor shows nothing", "Clamp another probe", "where the healthy motor shows 0."):
        assert words in page


def test_without_a_speed_current_and_voltage_may_both_be_it() -> None:
    """More than shorted turns, which lower R, L and K^2/J in other shares."""
    starts = [without(started(np.random.default_rng(n)), "speed_rad_s") for n in range(4)]
    motor = commission(starts[:3]).motor
    found = diagnose(scaled(starts[3], current_a=1.25), motor)
    assert found.verdict == "sensor"
    assert "if the current is 1.25 times too large" in found.reasons[0]
    assert "or if the voltage is 1.25 times too small" in found.reasons[0]
    # Both are as likely, and this one comes first.
    assert found.reasons[1].startswith("the current's scale is wrong")
    assert re.search(r"\(probability \d+%, of winding_short \d%\)$", found.reasons[0])
    assert found.confidence is not None
    assert found.confidence > 0.9
    assert diagnose(scaled(starts[3], current_a=1.02), motor).verdict == "healthy"


def commanded(seed: int) -> Recording:
    """A healthy start whose voltage is a command."""
    start = started(np.random.default_rng(seed))
    return replace(start, path=Path(f"{seed}"), voltage_v=np.where(start.time_s >= 0.02, 12.0, 0.0))


def test_a_probe_that_was_turned_when_the_motor_was_learned_is_no_failure() -> None:
    motor = commission([scaled(commanded(n), current_a=-1.0) for n in range(3)]).motor
    other = commanded(5)
    turned = scaled(other, current_a=-1.0)
    assert diagnose(turned, motor).verdict == "healthy"
    assert diagnose(other, motor).kind == "current_polarity"
    assert diagnose(turned, by_sensors()).kind == "current_polarity"
    alone = without(other, "voltage_v", "speed_rad_s")
    assert kind_of(alone, by_sensors()) is None
    assert kind_of(scaled(alone, current_a=-1.0), by_sensors()) == "current_polarity"


def test_a_column_that_never_moved_is_no_dead_sensor() -> None:
    """Some recorders write a column of zeros where they have no sensor."""
    still = scaled(commanded(5), speed_rad_s=0.0)
    assert (kind_of(still), kind_of(still, by_sensors())) == (None, "speed_dead")


folder = os.environ.get("MOTOR_ENV_RECORDINGS")
RECORDINGS = Path(folder or "recordings")
needs_recordings = pytest.mark.skipif(
    folder is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
SOME = ("aalborg/startup_12v", "oscillo_lab/startup_F0001", "lieskjur/startup_120v")
VOLTS = {"startup_120v": 120.0, "startup_F0000": 12.3, "startup_F0001": 12.3}
ALL = sorted(RECORDINGS.glob("*/*.csv")) if RECORDINGS.is_dir() else []


@cache
def sisters(side: str) -> Motor:
    """Commissioned from eight robots."""
    robots = RECORDINGS / "regbot"
    return commission([robots / f"regbot_{n:02d}_{side}.csv" for n in (1, 3, 5, 7, 9, 15, 21, 23)]).motor


def check_failures(path: Path) -> Verdict:
    """No motor is judged by a failed sensor; the healthy one is taught by the recording itself, or by sisters."""
    recording, volts = read_recording(path), VOLTS.get(path.stem)
    if path.parent.name == "regbot":
        motor = sisters(path.stem.rpartition("_")[2])
    else:
        try:
            motor = commission([recording], fewest=1, voltage_v=volts).motor
        except InputError as error:
            pytest.skip(f"it teaches no healthy motor: {error}")
    own = diagnose(recording, motor, voltage_v=volts)
    for kind, failed in failures(recording):
        if kind == own.kind and kind.endswith("polarity"):
            continue  # turned twice is right
        found = diagnose(failed, motor, voltage_v=volts)
        told = (path.name, kind, found.reasons)
        assert found.verdict not in {"winding", "bearing", "magnet", "healthy"}, told
    return own.verdict


@needs_recordings
@pytest.mark.parametrize("name", SOME)
def test_no_real_motor_is_judged_by_a_failed_sensor(name: str) -> None:
    assert check_failures(RECORDINGS / f"{name}.csv") is Verdict.HEALTHY


@needs_recordings
@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("path", ALL, ids=lambda p: p.stem)
def test_no_recording_of_all_is_judged_by_a_failed_sensor(path: Path) -> None:
    check_failures(path)


@needs_recordings
@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_failed_sensors_of_a_fleet_are_found() -> None:
    """Dead channels, a reversed current, and currents at the end of their range; nothing else."""
    found: dict[str, str] = {}
    for path in sorted((RECORDINGS / "regbot").glob("*.csv")):
        failed = diagnose_sensors(read_recording(path), sisters("left"), at_work=True)
        if failed is not None:
            found[path.stem.removeprefix("regbot_")] = str(failed.fault_kind)
    clipped = dict.fromkeys(("61_right", "79_right", "81_right", "86_dagmar_right"), "current_clipped")
    dead = dict.fromkeys(("13_left", "13_right", "17_left"), "current_dead")
    assert found == {"11_right": "current_polarity", **clipped, **dead}


POWERS = {
    "current": (-1.0, -1.0, 0.0, 1.0, 1.0),
    "voltage": (1.0, 1.0, 1.0, 1.0, 1.0),
    "speed": (0.0, 0.0, -1.0, -2.0, -2.0),
    "time": (0.0, 1.0, 0.0, 1.0, 0.0),
}
"""Of R, L, K, J and B, from the equations of the motor."""
BRUSHES = ", and at the brushes, whose drop may act alike"


def told(column: str, factor: float, off: float = 0.0) -> str:
    """What is said of a column that was read by a factor too large, each quantity known to 1 %."""
    moved = np.array(POWERS[column]) * math.log(factor)
    moved[0] += off
    difference = Difference(moved, 1e-4 * np.eye(5), np.eye(6)[:5], 1e6)
    sentence = describe_scaling_errors(find_scaling_errors(difference, tuple("RLKJB"), 3.0, 0.01))
    assert sentence == "" or sentence.startswith(f"{EXPLAINED} if the ")
    return sentence.removeprefix(f"{EXPLAINED} if the ")


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("speed", 9.549, "in rpm, and was read in rad/s"),
        ("speed", 9.549e-3, "in thousands of rpm, and was read in rad/s"),
        ("speed", 1.3, "1.3 times too large (look at pulses a turn, gear and unit)"),
        ("current", 1000.0, "in mA, and was read in A"),
        ("current", 1.03 * 10.0, "10 times too large (look at the scale of its probe or shunt)"),
        ("current", 1.07 * 10.0, "10.7 times too large (look at the scale of its probe or shunt)"),
        ("voltage", 1.6, "1.6 times too large (look at the scale of its probe or divider)"),
        ("voltage", 1.4, f"1.4 times too large (look at the scale of its probe or divider{BRUSHES})"),
        ("time", 0.5, "2 times too small (look at the sampling rate)"),
        ("time", 1e3, "in ms, and was read in s"),
    ],
)
def test_a_factor_is_named_by_its_column_and_unit(column: str, factor: float, words: str) -> None:
    assert told(column, factor) == f"{column} is {words}"


def test_what_a_wrong_scale_does_not_explain_is_not_put_down_to_one() -> None:
    assert told("current", 2.0, off=0.03).startswith("current is 2 times")
    assert told("current", 2.0, off=0.06) == ""
    assert told("current", 1.02) == ""  # no quantity has moved by three standard deviations
    assert told("current", 1.04).startswith("current is 1.04 times")


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
    share = present(re.search(r"\(probability (\d+)%, of bearing (\d+)%\)$", found.reasons[-1]))
    gain, bearing = map(int, share.groups())
    assert 5 < gain < bearing
    assert gain + bearing <= 100
    assert found.confidence == pytest.approx(bearing / 100.0, abs=0.006)  # the gain counts in it, too
    sheet = decide(window, replace(taught, is_taught=False), 0.01)
    assert "probability" not in sheet.reasons[-1]
