"""Watching a stream: what is said of its lines and windows, and what is handed to the judge of windows.

The judge is put in its place by hand: that of real windows is tested in its own room.
"""

import itertools
import json
import math
import re
import sys
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from watched import HEADER, TAUGHT, WINDOWS, Judge, changes, joined, judged, samples

from motor_env import InputError, Recording
from motor_env.common.console import ExitStatus
from motor_env.diagnosis.operation.windows import WindowJudge, judge_of
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.streaming import watch as watching
from motor_env.diagnosis.streaming.sources import NEW_FILE, Notice, Piece, lines
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import Event, LearningPhase, Watch, showing

# Reaches in: the judge of windows is given fits made by hand, and answers in its own types.
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.hypotheses import FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.sensor_diagnosis import sensor_judgement
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import RAD_S_PER_RPM


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    return Judge(monkeypatch)


class Clock:
    """In the place of the wall clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        monkeypatch.setattr("motor_env.diagnosis.streaming.watch.time.monotonic", lambda: self.now_s)

    def spent(self, pieces: Sequence[Piece], seconds: float) -> Iterator[Piece]:
        """Pieces that come evenly in so many seconds."""
        for piece in pieces:
            self.now_s += seconds / len(pieces)
            yield piece


def watched(
    pieces: Sequence[Piece], state: State | None = None, per_year: float = 1.0, **changed: Any
) -> list[Event]:
    """Events behind a header, of windows of 0.1 s."""
    healthy = replace(TAUGHT, windows=replace(WINDOWS, **changed))
    watch = Watch(healthy, state or State(), false_alarms_per_year=per_year)
    return list(watch.events([HEADER, *pieces]))


def told(pieces: Sequence[Piece], **changed: Any) -> list[tuple[str, str]]:
    return [(event.kind, event.text) for event in watched(pieces, **changed)]


def test_the_rate_and_the_memory_are_handed_on(judge: Judge) -> None:
    state = State()
    watched(samples(202), state, per_year=2.0)
    assert state.memory == {"judged": [2.0]}
    watched([], State(memory=state.memory, header=HEADER.decode()), per_year=3.0)
    assert judge.made == [(2.0, {}), (3.0, {"judged": [2.0]})]


def test_windows_hold_the_samples_of_their_time_in_si_units(judge: Judge) -> None:
    """The first sample a window's length after its begin is its last one; the next begins with the one after it."""
    events = watched(samples(303, first_ms=5_000.0))
    assert [event.time_s for event in events] == pytest.approx([5.1, 5.201, 5.302])
    for k, found in enumerate(judge.given):
        place = 101 * k + np.arange(101)
        columns = (found.time_s, found.voltage_v, found.current_a, found.speed_rad_s)
        speed = (500.0 + place % 5) * RAD_S_PER_RPM
        expected = (5.0 + 1e-3 * place, 12.0 + 1e-3 * place, 0.1 + 1e-3 * (place % 7), speed)
        np.testing.assert_allclose(columns, expected, atol=1e-9)  # type: ignore[arg-type]  # it has all


@pytest.mark.parametrize(
    ("begins_ms", "said"),
    [
        (68.9, []),
        (69.2, [("gap", "0.0202 s without a sample")]),  # of more than twenty intervals
        (46.0, [("time_jump", "0.003 s back")]),
    ],
)
def test_gaps_and_jumps_of_the_time_are_said(
    judge: Judge, begins_ms: float, said: list[tuple[str, str]]
) -> None:
    assert told([*samples(50), *samples(25, begins_ms)]) == said
    assert judge.given == []


def stuck(count: int, volts: int = 12_000) -> list[Piece]:
    return [f"{500 + k % 3},{k},{volts},105\n".encode() for k in range(50, 50 + count)]


def test_two_hundred_equal_currents_are_a_stuck_sensor(judge: Judge) -> None:
    said = ("stuck_sensor", "200 times the current 0.105 A")
    for count, volts, expected in (
        (200, 12_000, []),
        (201, 12_000, [said]),
        (251, 12_000, [said]),
        (300, 0, []),
    ):
        assert told([*samples(50), *stuck(count, volts)], window_s=10.0) == expected
    kinds = [kind for kind, _ in told([*samples(50), *stuck(230), *samples(101, 280.0)])]
    assert kinds == ["window", "stuck_sensor", "stuck_sensor", "window"]
    np.testing.assert_allclose(judge.given[-1].time_s[[0, -1]], [0.28, 0.38])


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("{s},{k},12000,105", "the current of a whole window is 0.105"),
        ("480,{k},12000,{c}", f"the speed of a whole window is {480.0 * RAD_S_PER_RPM:.6g}"),
        ("0,{k},0,0", None),  # at rest
    ],
)
def test_a_window_with_a_sensor_that_stands_still_is_not_judged(
    judge: Judge, row: str, said: str | None
) -> None:
    still: list[Piece] = [(row.format(k=k, s=500 + k % 3, c=100 + k % 7) + "\n").encode() for k in range(101)]
    assert told(still) == [("window", "healthy") if said is None else ("stuck_sensor", said)]
    assert len(judge.given) == (said is None)


def test_verdicts_become_events(monkeypatch: pytest.MonkeyPatch) -> None:
    other = judged("other", 1.0, 1.4, 1.8, 1.0)
    unsure = judged(
        "winding", 1.2, 1.0, 1.0, 1.0, fault_kind=FaultKind.WINDING_CONTACT, kind_probability=0.949
    )
    verdicts: list[Judgement | Exception] = [
        judged("bearing", 1.0, 1.0, 1.0, 1.34567),
        replace(other, changes=changes(1.0, 1.4, 1.8, 1.0, moved="RKJB")),
        replace(other, changes=changes(1.0, 1.4, 1.8, 1.0, moved="RJB")),
        unsure,
        replace(unsure, kind_probability=0.951, also=(judged("bearing", 1.0, 1.0, 1.0, 1.3),)),
        Judgement(Verdict.UNUSABLE, ("the motor stands", "all the time")),
        UnusableError("too short"),
        sensor_judgement("current_dead", "the current shows nothing"),
    ]
    Judge(monkeypatch, *verdicts)
    state = State()
    found = [json.loads(event.as_json()) for event in watched(samples(8 * 101), state)]
    ratios = {"R": 1.0, "K": 1.0, "J": 1.0, "B": 1.3457}
    assert found[0] == {
        "time_s": pytest.approx(0.1), "event": "window", "verdict": "bearing", "ratios": ratios
    }  # fmt: skip
    assert [tuple(one.get(name) for name in ("event", "verdict", "kind", "also")) for one in found] == [
        ("window", "bearing", None, None),
        ("another_motor", None, None, None),
        ("window", "other", None, None),
        ("window", "winding", None, None),
        ("window", "winding", "winding_contact", ["bearing"]),
        ("window", "unusable", None, None),
        ("window", "unusable", None, None),
        ("window", "sensor", "current_dead", None),
    ]
    assert [one.get("reason") for one in found[2:]] == [
        "because", None, None, "the motor stands", "too short", "the current shows nothing"
    ]  # fmt: skip
    assert dict(state.counts) == {
        "window bearing": 1, "another_motor": 1, "window other": 1, "window winding": 2, "window unusable": 2,
        "window sensor": 1,
    }  # fmt: skip


def test_ratios_are_those_of_the_fit_whatever_the_temperature_may_explain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fitted = np.array([1.25, 1.0, 1.0, 1.0])
    fit = FittedWindow(np.log(fitted), 1e-6 * np.eye(4))
    monkeypatch.setattr(WindowJudge, "fitted", lambda *_: fit)
    (event,) = watched(samples(101), per_year=1e4)
    assert (event.text, event.fault_kind) == ("winding", "winding_contact")
    assert list(event.ratios.values()) == pytest.approx(fitted, rel=1e-12)
    assert decide(fit, judge_of(TAUGHT).reference, 0.01).severity == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize(
    ("counts", "status"),
    [
        ({"window healthy": 3, "gap": 2, "malformed": 1}, ExitStatus.HEALTHY),
        ({"window healthy": 3, "window unusable": 1}, ExitStatus.UNDECIDED),
        ({"window healthy": 3, "window unusable": 1, "window bearing": 1}, ExitStatus.FAULT),
    ],
)
def test_exit_status_of_what_was_seen(counts: dict[str, int], status: ExitStatus) -> None:
    state = State()
    state.counts.update(counts)
    assert state.exit_status == status


def test_headers_may_be_said_again_and_remarks_are_no_samples(judge: Judge) -> None:
    swapped = b"current_a,time_s,voltage_v,speed_rad_s\n"
    rows: list[Piece] = [f"{0.1 + k % 7},{k / 1e3},12,{k % 5}\n".encode() for k in range(101)]
    watched([b"#1,2,3,4\n", b"\n", swapped, *rows])
    np.testing.assert_allclose(judge.given[0].current_a, 0.1 + np.arange(101) % 7)
    assert told([b"x" * 100 + b"\n"]) == [("malformed", "x" * 60)]
    mark = b"\xef\xbb\xbf"  # of an encoding
    assert told([mark + HEADER, *samples(50), mark + HEADER, *samples(51, 50.0)]) == [("window", "healthy")]


@pytest.mark.parametrize(
    "line",
    [
        b"x,y\n", b"1,nan,12000,1\n", b"\xff\xfe\n", b"500,60,12000,-127283000\n", b"500,1e23,12000,100\n",
        b"500,60,1e43,100\n", b"-1e300,60,12000,100\n", b"500,60,12000,1_0\n", "500,60,12000,\u0661\n".encode(),
    ],
)  # fmt: skip
def test_what_is_no_sample_is_malformed_and_costs_none_beside_it(judge: Judge, line: bytes) -> None:
    assert [kind for kind, _ in told([*samples(50), line, *samples(51, 50.0)])] == ["malformed", "window"]


@pytest.mark.parametrize(
    ("lines", "state", "per_year", "words"),
    [
        ([b"time_s,voltage_v,current_a\n"], State(), 1.0, "speed is missing"),
        (samples(3), State(), 1.0, r"no line names the columns .* such as --columns "),
        ([], State(), 0.0, "false-alarms-per-year must be > 0"),
        ([], State(), 1e-300, "false-alarms-per-year must be at least 1e-12, got 1e-300"),
        ([], State(header="a,b"), 1.0, "columns must name time, voltage, current, speed, got 'a,b'"),
    ],
)
def test_bad_input_is_one_sentence(
    judge: Judge, lines: list[Piece], state: State, per_year: float, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        list(Watch(TAUGHT, state, false_alarms_per_year=per_year).events(lines))


def test_a_lesson_takes_as_many_windows_as_were_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def learn(recordings: list[Recording], window_s: float, *, steady: bool) -> tuple[Any, list[Any]]:
        given.append((len(recordings), window_s, steady))
        if len(given) == 1:
            raise UnusableError("it stands still")
        return TAUGHT, []

    monkeypatch.setattr(watching, "learn_windows", learn)
    judge = Judge(monkeypatch)
    watch = Watch(LearningPhase(0.0995, 0.4975, steady=True), State(), false_alarms_per_year=1.0)
    events = list(watch.events([HEADER, *samples(11 * 101)]))
    assert watch.healthy is TAUGHT
    assert [event.text for event in events[:5]] == [
        *(f"{0.0995 * n:g} of 0.4975 s" for n in (1, 2, 3, 4)), "it stands still"
    ]  # fmt: skip
    four = 4 * ["learning"]
    assert [event.kind for event in events] == [*four, "not_learned", *four, "learned", "window"]
    assert given == [(5, 0.0995, True)] * 2
    assert len(judge.given) == 1


@pytest.mark.parametrize(("window_s", "learn_s"), [(0.1, 0.399), (0.0, 1.0), (1.0, math.inf)])
def test_a_lesson_is_at_least_four_windows_long(window_s: float, learn_s: float) -> None:
    with pytest.raises(InputError, match=f"at least 4 windows of {window_s:g} s, got {learn_s:g} s"):
        LearningPhase(window_s, learn_s)


def test_garbage_is_counted_and_said_once_a_second(judge: Judge, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, state = Clock(monkeypatch), State()
    garbage: list[Piece] = [b"g%d\n" % k for k in range(1_000)]
    watch = Watch(TAUGHT, state, false_alarms_per_year=1.0)
    events = list(watch.events(itertools.chain([HEADER], clock.spent(garbage, 3.5), samples(101))))
    said = [(event.text, event.count) for event in events if event.kind == "malformed"]
    assert said == [("g0", 1), ("g286", 286), ("g572", 286), ("g858", 286), ("g999", 141)]
    assert state.counts == {"malformed": 1_000, "window healthy": 1}
    assert [json.loads(event.as_json()).get("count") for event in events[:2]] == [None, 286]


def test_a_line_that_is_too_long_is_one_malformed_event_and_the_rest_of_it_nothing(
    judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    Clock(monkeypatch)
    state, long = State(), b"0.1,12," * 30_000
    pieces = [HEADER, long + b"\n1,2,3,4\n", b",".join([b""] * 500_000), b"\n", *samples(101)]
    events = list(Watch(TAUGHT, state, false_alarms_per_year=1.0).events(lines(iter(pieces))))
    assert [event.name for event in events] == ["malformed", "time_jump", "window healthy", "malformed"]
    assert events[0].text == "longer than 65536 bytes: " + long[:60].decode()
    assert state.counts == {"malformed": 2, "time_jump": 1, "window healthy": 1}
    assert state.offset == len(joined(pieces))


def test_behind_a_notice_a_line_begins_and_a_new_file_is_counted_from_its_begin(judge: Judge) -> None:
    state = State()
    cut: list[Piece] = [b"x" * 70_000, Notice("unplugged", "gone"), HEADER, *samples(101)]
    assert [event.name for event in watched(cut, state)] == ["malformed", "unplugged", "window healthy"]
    assert state.offset == len(joined([HEADER, *cut]))
    watched([Notice(NEW_FILE, "shrunk"), b"1,2,3,4\n"], state)
    assert (state.offset, state.last_read) == (len(b"1,2,3,4\n"), "1,2,3,4\n")


def test_a_terminal_shows_the_last_events_and_all_counts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "dumb")
    state = State()
    state.counts.update({"window healthy": 11, "gap": 2})
    with showing(state.counts) as show:
        for n in range(9):
            show(Event(float(n), "window", "bearing", {"R": 1.0, "B": 1.25}, "odd"))
    said = capsys.readouterr().out
    assert "R +0.0%, B +25.0%" in said
    assert "11 window healthy, 2 gap" in said
    assert said.count("bearing odd") == 8
    with showing(state.counts) as show:
        show(Event(7.25, "window", "worn", {}, "", count=2))
    assert " 7.25 2 window worn " in " ".join(re.split(r"[\s│]+", capsys.readouterr().out))


@pytest.mark.long
@pytest.mark.timeout(600)
def test_memory_stays_flat() -> None:
    """30 days at a sample every 2 s, by windows of 12 h that no motor explains."""
    windows = replace(WINDOWS, window_s=43_200.0, dt_s=2.0, speed_rad_s=500.0)
    watch = Watch(replace(TAUGHT, windows=windows), State(), false_alarms_per_year=1.0)
    rows = (
        f"{500 + k % 5},{2000 * k},{12_000 * (k % 3 > 0)},{k * 7919 % 101}\n".encode()
        for k in range(1_300_000)
    )
    tracemalloc.start()
    grown = [tracemalloc.get_traced_memory()[0] for _ in watch.events(itertools.chain([HEADER], rows))]
    tracemalloc.stop()
    assert len(grown) > 50
    assert max(grown[10:]) - grown[9] < 100_000
