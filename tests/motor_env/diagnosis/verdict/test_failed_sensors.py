"""Sensors that failed: said before any fault of a motor is, and never where the motor alone is at fault."""

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
from odd_recordings import at_work, scaled, started
from scipy.signal import lfilter

from motor_env import PAPER_MOTOR, Recording, commission, diagnose, read_recording, simulate_states
from motor_env.common.errors import InputError

# Reaches in: motors that one recording teaches, and the checks by themselves.
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.report_page import VERDICT_TEXTS
from motor_env.diagnosis.verdict.sensor_diagnosis import (
    ChannelRecord,
    correlation,
    diagnose_sensors,
    find_failure,
    free_run,
    learn_signs,
    physical_values,
)
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import SENSOR_KINDS, FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import RECIPES, changed_recipe
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.sampling import draw, measure_draw

folder = os.environ.get("MOTOR_ENV_RECORDINGS")
RECORDINGS = Path(folder or "recordings")
needs_recordings = pytest.mark.skipif(
    folder is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
DT_S = 2e-3
SHEET = Motor("paper", "data_sheet", PAPER_MOTOR, 12.0)
PHYSICAL = physical_values(SHEET)
MOTORS_FAULTS = {"winding", "bearing", "magnet", "healthy"}
"""What must not be said of a recording of which a sensor failed."""
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


def kind_in(found: Judgement | None) -> FaultKind | None:
    """Kind of a failure that is found; there is one."""
    assert found is not None
    return found.kind


def failed_kind(seen: ChannelRecord, physical: FloatArray = PHYSICAL) -> FaultKind | None:
    return kind_in(find_failure(seen, physical))


def seen(recording: Recording, *, is_log: bool) -> ChannelRecord:
    assert recording.voltage_v is not None
    columns = recording.voltage_v, recording.current_a, recording.speed_rad_s
    return ChannelRecord(recording.dt_s, *columns, at_work=is_log)


@pytest.mark.parametrize("is_log", [False, True], ids=["start", "log"])
@pytest.mark.parametrize("missing", [(), ("speed_rad_s",)], ids=["speed", "no speed"])
def test_each_failure_is_named(is_log: bool, missing: tuple[str, ...]) -> None:
    rng = np.random.default_rng(2)
    recording = replace((at_work if is_log else started)(rng), **dict.fromkeys(missing))  # type: ignore[arg-type]
    for kind, failed in failures(recording):
        if kind == "swapped" and missing:
            continue  # two columns are swapped back by `diagnose`
        # Of two channels that go against each other the current is said to be reversed.
        expected = "current_polarity" if missing and kind == "voltage_polarity" else kind
        assert failed_kind(seen(failed, is_log=is_log)) == expected


def test_a_duty_is_that_share_of_the_supply() -> None:
    log = at_work(np.random.default_rng(2))
    assert log.voltage_v is not None
    chopped = replace(log, voltage_v=None, duty=log.voltage_v / 24.0)
    assert diagnose_sensors(chopped, SHEET, 24.0, at_work=True) is None
    dead = replace(chopped, current_a=np.zeros(3000))
    assert kind_in(diagnose_sensors(dead, SHEET, 24.0, at_work=True)) == "current_dead"


def test_a_shunt_is_in_the_circuit_that_sensors_are_checked_in(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []
    monkeypatch.setattr(
        "motor_env.diagnosis.verdict.sensor_diagnosis.find_failure",
        lambda _, physical: given.append(float(physical[index.R])),
    )
    for circuit in (None, Circuit(shunt_ohm=0.5)):
        assert diagnose_sensors(commanded(5), SHEET, circuit=circuit) is None
    assert given == pytest.approx([PHYSICAL[index.R], PHYSICAL[index.R] + 0.5])


def test_a_range_and_an_offset_are_named() -> None:
    log, start = at_work(np.random.default_rng(3)), started(np.random.default_rng(3))
    short = replace(start, current_a=np.clip(start.current_a, -2.5, 2.5))
    found = find_failure(seen(short, is_log=False), PHYSICAL)
    assert found is not None
    assert found.kind == "current_clipped"
    assert re.search(r"stand at 2\.5 A, where the healthy motor reaches [45]\.\d+ A$", found.reasons[0])
    # A data sheet says nothing of the sensor of a start.
    assert find_failure(seen(short, is_log=False)._replace(is_taught=False), PHYSICAL) is None
    off = replace(log, current_a=log.current_a + 1.0)
    assert failed_kind(seen(off, is_log=True)) == "current_offset"
    assert find_failure(seen(replace(log, current_a=log.current_a + 0.1), is_log=True), PHYSICAL) is None
    known = PHYSICAL.copy()
    known[9] = 1.0  # the healthy logs had that offset, too
    assert find_failure(seen(off, is_log=True), known) is None
    assert find_failure(seen(log, is_log=True), known) is None  # it is gone, and nothing contradicts that
    known[9] = -1.0
    assert failed_kind(seen(off, is_log=True), known) == "current_offset"


def high_pass(current: FloatArray, tau_s: float, dt_s: float) -> FloatArray:
    """What a probe shows that is coupled by a capacitor, charged before."""
    kept = tau_s / (tau_s + dt_s)
    shown: FloatArray = lfilter([kept, -kept], [1.0, -kept], current)
    return shown


@pytest.mark.parametrize("tau_s", [0.02, 0.1])
def test_a_log_tells_the_time_constant_of_a_coupling(tau_s: float) -> None:
    log = at_work(np.random.default_rng(2))
    coupled = replace(log, current_a=high_pass(log.current_a, tau_s, log.dt_s))
    found = find_failure(seen(coupled, is_log=True), PHYSICAL)
    assert found is not None
    assert found.verdict is Verdict.UNUSABLE
    told = re.search(r"AC-coupled: a high pass of about (\S+) s", found.reasons[0])
    assert told is not None
    assert float(told[1]) == pytest.approx(tau_s, rel=0.1)
    with pytest.raises(InputError, match="the logs cannot be used: a: the current is AC-coupled"):
        commission([replace(coupled, path=Path(name)) for name in "ab"], regime="operation")
    # A slow one shows in no single current, and is no failure: the friction tells where it matters.
    slower = replace(log, current_a=high_pass(log.current_a, 2.0, log.dt_s))
    assert find_failure(seen(slower, is_log=True), PHYSICAL) is None


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


def start_behind(friction: float, tau_s: float, seconds: float, seed: int = 3) -> Recording:
    """A start with a share of the usual friction, seen through a probe that is coupled by a capacitor."""
    motor = replace(PAPER_MOTOR, viscous_friction_n_m_s_per_rad=friction * 1.2e-6)
    dt_s = 2e-4
    time_s: FloatArray = dt_s * np.arange(round(seconds / dt_s), dtype=float)
    voltage_v = np.where(time_s >= 0.02, 12.0, 0.0)
    current = simulate_states(motor, voltage_v, dt_s)[:, 0]
    current = current if tau_s == math.inf else high_pass(current, tau_s, dt_s)
    current = current + 0.01 * np.random.default_rng(seed).standard_normal(len(current))
    return Recording(Path(f"start{seed}"), time_s, current, voltage_v)


@pytest.mark.parametrize(("friction", "tau_s"), [(0.9, 1.0), (1.8, 0.5), (1.8, 1.0)])
def test_a_machine_without_its_load_keeps_drag_of_its_own(friction: float, tau_s: float) -> None:
    """Half the drag may be a lost load; where hardly any is left, or too little to be told, it is a probe's."""
    taught = commission([start_behind(friction, math.inf, 0.3, seed) for seed in (4, 5, 6)]).motor
    assert diagnose(start_behind(friction, tau_s, 0.3), taught).verdict is Verdict.UNUSABLE
    assert diagnose(start_behind(friction, math.inf, 0.3), taught).verdict is Verdict.HEALTHY
    assert diagnose(start_behind(0.5 * friction, math.inf, 4.0), taught).verdict is not Verdict.UNUSABLE


def test_an_encoder_of_few_edges_is_not_clipped() -> None:
    """It stands at its largest value for some samples, and shows less at others where the motor is as fast."""
    volts = np.tile(np.repeat([2.0, 6.0], 40), 10)
    current, speed = free_run(PHYSICAL, volts, DT_S)
    fast = np.flatnonzero(speed > 0.5 * speed.max())
    clipped, held = np.minimum(speed, 0.8 * speed.max()), speed.copy()
    held[fast] = np.resize([0.6, 0.7, 0.75], len(fast)) * speed.max()
    held[fast[5:14]] = 0.8 * speed.max()
    assert failed_kind(ChannelRecord(DT_S, volts, current, clipped)) == "speed_clipped"
    assert find_failure(ChannelRecord(DT_S, volts, current, held), PHYSICAL) is None
    # Nor where it stands at its largest value less than half of the time that the motor is faster.
    seldom = np.minimum(speed, 0.8 * speed.max())
    seldom[fast[np.arange(len(fast)) % 16 >= 7]] *= 0.99
    assert find_failure(ChannelRecord(DT_S, volts, current, seldom), PHYSICAL) is None


def test_what_a_controller_holds_is_not_clipped() -> None:
    """A speed that is less everywhere than expected, and stands still as that of the healthy motor does."""
    volts = np.tile(np.concatenate([np.full(60, 3.0), np.full(40, 6.0), np.linspace(6.0, 3.0, 30)]), 5)
    current, speed = free_run(PHYSICAL, volts, DT_S)
    steady = np.round(speed)
    assert find_failure(ChannelRecord(DT_S, volts, current, 0.85 * steady), PHYSICAL) is None
    clipped = ChannelRecord(DT_S, volts, current, np.minimum(steady, 0.75 * steady.max()))
    assert failed_kind(clipped) == "speed_clipped"


def test_a_current_that_a_rotor_at_rest_draws_is_no_offset() -> None:
    """The current of a winding that falls slowly; more than that is an offset."""
    slow = PHYSICAL.copy()
    slow[index.L] = 0.02
    volts = np.tile(np.repeat([8.0, -8.0], 30), 20)
    current, speed = free_run(slow, volts, DT_S)
    pulses, decay = np.tile(np.repeat([5.0, 0.0], 3), 10), math.exp(-DT_S * slow[index.R] / slow[index.L])
    held = lfilter([0.0, 1.0 - decay], [1.0, -decay], pulses / slow[index.R])
    log = ChannelRecord(
        DT_S,
        np.append(volts, pulses),
        np.append(current, held),
        np.append(speed, np.zeros(len(pulses))),
    )
    assert log.current_a is not None
    assert find_failure(log, slow) is None
    off = log._replace(current_a=log.current_a + 0.4)
    assert failed_kind(off, slow) == "current_offset"
    late = log.current_a.copy()  # as that of the voltage before
    late[len(volts) + 3 :: 6] += 0.8
    assert find_failure(log._replace(current_a=late), slow) is None
    known = slow.copy()
    known[index.OFFSET_I] = 0.4
    assert find_failure(off, known) is None


@pytest.mark.parametrize(("other_volts", "kind"), [(8.0, "current_offset"), (-0.5, None)])
def test_only_a_motor_that_turns_both_ways_tells_an_offset_while_it_never_rests(
    other_volts: float, kind: str | None
) -> None:
    """A rotor that sticks under a small voltage does not turn back: what it is off by may be its friction."""
    sticking = PHYSICAL.copy()
    sticking[index.COULOMB] = 0.5 * sticking[index.K]
    volts = np.tile(np.repeat([-8.0, other_volts], 60), 20)
    current, speed = free_run(sticking, volts, DT_S)
    found = find_failure(ChannelRecord(DT_S, volts, current + 1.2, speed, at_work=True), sticking)
    assert (None if found is None else found.kind) == kind


@pytest.mark.parametrize("column", ["current_a", "speed_rad_s"])
def test_a_column_of_another_motor_is_named(column: str) -> None:
    """Two motors of one machine, each under its own voltage, and their columns exchanged."""
    one, other = (at_work(np.random.default_rng(seed)) for seed in (4, 5))
    columns: dict[str, Any] = {column: getattr(other, column)}
    found = find_failure(seen(replace(one, **columns), is_log=True), PHYSICAL)
    assert found is not None
    assert found.kind == "swapped"
    assert found.reasons[0].startswith(f"the {COLUMNS[column]} is not that of the motor")


@pytest.mark.parametrize("column", ["current_a", "speed_rad_s"])
def test_a_noisy_column_is_not_that_of_another_motor(column: str) -> None:
    """A controller moves the voltage by 1 V about 6 V: less than one count of an encoder, or step of a converter."""
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


@pytest.mark.parametrize("recipe", ["bench", "field", "operation"])
def test_no_motor_is_taken_for_a_failed_sensor(recipe: str, request: pytest.FixtureRequest) -> None:
    """350 each of healthy and faulty motors: more than a thousand, of which none is."""
    classes = (FaultClass(weight=4.0), *(FaultClass(FaultKind(name), size) for name, size in LARGE))
    drawn_from = changed_recipe(
        replace(RECIPES[recipe], classes=classes, healthy_starts=0), channels=("current", "speed")
    )
    drawn = draw(drawn_from, 3, np.arange(350))
    readings = measure_draw(drawn, drawn_from, 3).astype(np.float64)
    is_log, time_s = drawn_from.duty is not None, drawn_from.timing.time_s
    physical = physical_values(replace(SHEET, parameters=drawn_from.motor))
    step = np.where(time_s > 1e-9, 12.0, 0.0)
    for row in readings:
        volts = row[-1] if is_log else step
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
    page = diagnose(replace(log, current_a=0.0 * log.current_a), SHEET).page()
    assert "sensor shows nothing" in page
    assert "Clamp another probe" in page
    assert "where the healthy motor shows 0." in page


@cache
def learned() -> Motor:
    """Commissioned from healthy starts."""
    rngs = map(np.random.default_rng, range(3))
    return commission([replace(started(rng), path=Path(f"{n}")) for n, rng in enumerate(rngs)]).motor


@pytest.mark.parametrize(
    ("column", "factor", "kind"),
    [("current_a", 1.35, "current_gain"), ("speed_rad_s", 0.8, "speed_gain"), ("voltage_v", 1.15, "voltage_gain"),
     ("current_a", 1000.0, None), ("time_s", 2.0, None)],
)  # fmt: skip
def test_a_gain_is_the_sensors_where_the_same_sensor_taught_the_motor(
    column: str, factor: float, kind: str | None
) -> None:
    """No unit is, and no clock."""
    found = diagnose(scaled(started(np.random.default_rng(7)), **{column: factor}), learned())
    assert (found.verdict, found.kind) == ("other" if kind is None else "sensor", kind)
    if kind is not None:
        assert found.severity == pytest.approx(max(factor, 1.0 / factor) - 1.0, abs=0.05)
        assert "all of it is explained if the" in found.reasons[0]


def test_without_a_speed_current_and_voltage_may_both_be_it() -> None:
    """More than shorted turns, which lower R, L and K^2/J in other shares."""
    starts = [
        replace(started(np.random.default_rng(n)), speed_rad_s=None, path=Path(f"{n}")) for n in range(4)
    ]
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
    short = scaled(starts[3], current_a=1.02)
    assert diagnose(short, motor).verdict == "healthy"


def commanded(seed: int) -> Recording:
    """A healthy start whose voltage is a command."""
    start = started(np.random.default_rng(seed))
    return replace(start, voltage_v=np.where(start.time_s >= 0.02, 12.0, 0.0))


def test_a_unit_is_no_failed_sensor() -> None:
    log = at_work(np.random.default_rng(3))
    assert log.current_a is not None
    off = replace(log, current_a=log.current_a + 1.5)
    assert kind_in(diagnose_sensors(off, SHEET, at_work=True)) == "current_offset"
    for read in ({}, {"current_a": 1e3}, {"speed_rad_s": 0.03 / np.pi}):
        assert diagnose_sensors(scaled(log, **read), SHEET, at_work=True) is None


def test_a_probe_that_was_turned_when_the_motor_was_learned_is_no_failure() -> None:
    turned = [scaled(commanded(n), current_a=-1.0) for n in range(3)]
    motor = commission([replace(one, path=Path(f"{n}")) for n, one in enumerate(turned)]).motor
    assert motor.healthy is not None
    assert motor.healthy.starts is not None
    assert motor.healthy.starts.turned == ("current_a",)
    other = commanded(5)
    assert diagnose(scaled(other, current_a=-1.0), motor).verdict == "healthy"
    assert diagnose(other, motor).kind == "current_polarity"
    assert diagnose(scaled(other, current_a=-1.0), learned()).kind == "current_polarity"
    alone = replace(other, voltage_v=None, speed_rad_s=None)
    assert diagnose_sensors(alone, learned()) is None
    assert kind_in(diagnose_sensors(scaled(alone, current_a=-1.0), learned())) == "current_polarity"


@pytest.mark.parametrize(
    ("signs", "turned"), [((-1.0, -1.0), ("current_a",)), ((-1.0, 1.0), ()), ((1.0, 1.0), ())]
)
def test_a_probe_was_turned_only_if_it_was_in_all_healthy_starts(
    signs: tuple[float, ...], turned: tuple[str, ...]
) -> None:
    starts = [scaled(commanded(n), current_a=sign) for n, sign in enumerate(signs)]
    healthy = learn_signs(learned(), starts, None).healthy
    assert healthy is not None
    assert healthy.starts is not None
    assert healthy.starts.turned == turned


def test_a_column_that_never_moved_is_no_dead_sensor() -> None:
    """Some recorders write a column of zeros where they have no sensor."""
    start = commanded(5)
    without = replace(start, speed_rad_s=np.zeros(len(start.time_s)))
    assert diagnose_sensors(without, SHEET) is None
    assert kind_in(diagnose_sensors(without, learned())) == "speed_dead"


def of_itself(recording: Recording, voltage_v: float | None) -> Motor:
    """The healthy motor that a recording teaches by itself."""
    return commission([recording], fewest=1, voltage_v=voltage_v).motor


SOME = ("aalborg/startup_12v", "oscillo_lab/startup_F0001", "lieskjur/startup_120v")
VOLTS = {"startup_120v": 120.0, "startup_F0000": 12.3, "startup_F0001": 12.3}


def assert_no_motor_is_judged(recording: Recording, motor: Motor, voltage_v: float | None) -> None:
    own = diagnose(recording, motor, voltage_v=voltage_v).kind
    for kind, failed in failures(recording):
        if kind == own and kind.endswith("polarity"):
            continue  # turned twice is right
        found = diagnose(failed, motor, voltage_v=voltage_v)
        assert found.verdict not in MOTORS_FAULTS, (recording.path.name, kind, found.reasons)


@needs_recordings
@pytest.mark.parametrize("name", SOME)
def test_no_real_motor_is_judged_by_a_failed_sensor(name: str) -> None:
    path = RECORDINGS / f"{name}.csv"
    recording, volts = read_recording(path), VOLTS.get(path.stem)
    motor = of_itself(recording, volts)
    assert diagnose(recording, motor, voltage_v=volts).verdict == "healthy"
    assert_no_motor_is_judged(recording, motor, volts)


@needs_recordings
@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "path", sorted(RECORDINGS.glob("*/*.csv")) if RECORDINGS.is_dir() else [], ids=lambda p: p.stem
)
def test_no_recording_of_all_is_judged_by_a_failed_sensor(path: Path) -> None:
    recording, volts = read_recording(path), VOLTS.get(path.stem)
    if path.parent.name == "regbot":
        motor = sisters(path.stem.rpartition("_")[2])
    else:
        try:
            motor = of_itself(recording, volts)
        except InputError as error:
            pytest.skip(f"it teaches no healthy motor: {error}")
    assert_no_motor_is_judged(recording, motor, volts)


@cache
def sisters(side: str) -> Motor:
    """Commissioned from eight robots."""
    folder = RECORDINGS / "regbot"
    return commission([folder / f"regbot_{n:02d}_{side}.csv" for n in (1, 3, 5, 7, 9, 15, 21, 23)]).motor


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
