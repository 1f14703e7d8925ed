"""What a watch hands on and says, sample by sample: rates, borders of windows, its state, its events.

The judgement itself is put in its place by hand: that of real windows is tested in its own room.
"""

import itertools
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hostile
import numpy as np
import pytest
from output_schema import follows

from motor_env import InputError, Recording
from motor_env.cli import main
from motor_env.common.console import ExitStatus
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.operation.windows import WindowJudge, judge_of
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.streaming import watch as watching
from motor_env.diagnosis.streaming.sources import NEW_FILE, SILENCE, Notice, Piece, lines
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import Event, LearningPhase, Watch, showing

# Reaches in: the judge of windows is replaced, or is given fits made by hand, and answers in its own types.
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.hypotheses import Change, FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.sensor_diagnosis import sensor_judgement
from motor_env.motor.faults import FaultKind
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.motor.parameters import RAD_S_PER_RPM

HEADER = b"speed_rpm,t_ms,voltage_mv,current_ma\n"
WINDOWS = Windows(
    window_s=0.0995,
    terms=(),
    physical=np.zeros(index.N_VALUES),
    hold="held",
    dt_s=1e-3,
    speed_rad_s=50.0,
    rms_volts=(11.0, 13.0),
)
TAUGHT = Healthy(10, 13.0, ("R", "K", "J", "B"), np.ones(4), np.eye(4) * 1e-4, windows=WINDOWS)


def changes(*ratios: float, moved: str = "") -> tuple[Change, ...]:
    """Over R, K, J and B, of which some have moved."""
    return tuple(
        Change(name, ratio, 0.9, 1.1, "moved" if name in moved else "healthy")
        for name, ratio in zip("RKJB", ratios, strict=True)
    )


def judged(word: str, *ratios: float, begin_s: float = 0.0, **more: Any) -> Judgement:
    """A judgement on a window."""
    return Judgement(Verdict(word), ("because",), changes=changes(*ratios), begin_s=begin_s, **more)


HEALTHY = judged("healthy", 1.01, 0.98, 1.02, 1.0)


def joined(pieces: Sequence[Piece]) -> bytes:
    """As they stand in a file."""
    return b"".join(piece for piece in pieces if isinstance(piece, bytes))


def samples(count: int, first_ms: float = 0.0) -> list[Piece]:
    """Every millisecond; none of the columns stands still."""
    return [f"{500 + k % 5},{first_ms + k},{12_000 + k},{100 + k % 7}\n".encode() for k in range(count)]


class Judge:
    """In the place of the monitor: notes what it is given, and says what it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *verdicts: Judgement | Exception) -> None:
        self.given: list[Recording] = []
        self.verdicts = list(verdicts)
        self.made: list[tuple[float, dict[str, list[float]] | None]] = []
        monkeypatch.setattr(watching, "judge_of", lambda healthy: SimpleNamespace(windows=healthy.windows))
        monkeypatch.setattr(watching, "SequentialMonitor", self.monitor())

    def monitor(self) -> Any:
        outer = self

        class FakeMonitor:
            def __init__(self, judge: Any, _: Healthy, *, false_alarms_per_year: float, state: Any) -> None:
                self.judge = judge
                outer.made.append((false_alarms_per_year, state))

            def diagnose(self, window: Recording) -> Judgement:
                outer.given.append(window)
                verdict = outer.verdicts.pop(0) if outer.verdicts else HEALTHY
                if isinstance(verdict, Exception):
                    raise verdict
                return verdict

            def describe_false_alarm_rate(self) -> str:
                return "one an hour"

            @property
            def state_dict(self) -> dict[str, list[float]]:
                return {"judged": [float(len(outer.given))]}

        return FakeMonitor


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    return Judge(monkeypatch)


def watched(
    pieces: Sequence[Piece], state: State | None = None, per_year: float = 1.0, **changed: Any
) -> list[Event]:
    healthy = replace(TAUGHT, windows=replace(WINDOWS, **changed))
    watch = Watch(healthy, state or State(), false_alarms_per_year=per_year)
    return list(watch.events([HEADER, *pieces]))


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
    for k, recording in enumerate(judge.given):
        place = 101 * k + np.arange(101)
        np.testing.assert_allclose(recording.time_s, 5.0 + 1e-3 * place, atol=1e-9)
        assert recording.voltage_v is not None
        assert recording.speed_rad_s is not None
        np.testing.assert_allclose(recording.voltage_v, 12.0 + 1e-3 * place)
        np.testing.assert_allclose(recording.current_a, 0.1 + 1e-3 * (place % 7))
        np.testing.assert_allclose(recording.speed_rad_s, (500.0 + place % 5) * RAD_S_PER_RPM)


def test_a_pause_of_more_than_twenty_intervals_is_a_gap(judge: Judge) -> None:
    assert watched([*samples(50), *samples(25, 68.9)]) == []
    (event,) = watched([*samples(50), *samples(60, 69.2)])
    assert (event.kind, event.text) == ("gap", "0.0202 s without a sample")
    assert event.time_s == pytest.approx(0.0692)
    (event,) = watched([*samples(50), *samples(50, 46.0)])
    assert (event.kind, event.text) == ("time_jump", "0.003 s back")
    (event,) = watched([*samples(50), *samples(50, 49.0)])
    assert (event.kind, event.text) == ("time_jump", "0 s back")
    assert judge.given == []
    assert [e.kind for e in watched([*samples(90), *samples(101, 500.0)])] == ["gap", "window"]


def stuck(count: int, volts: int = 12_000, first: int = 50) -> list[Piece]:
    return [f"{500 + k % 3},{k},{volts},105\n".encode() for k in range(first, first + count)]


def test_two_hundred_equal_currents_are_a_stuck_sensor(judge: Judge) -> None:
    assert watched([*samples(50), *stuck(200)], window_s=10.0) == []
    for more in (0, 50):
        (event,) = watched([*samples(50), *stuck(201 + more)], window_s=10.0)
        assert (event.kind, event.text) == ("stuck_sensor", "200 times the current 0.105 A")
        assert event.time_s == pytest.approx(0.25)
    assert watched([*samples(50), *stuck(300, volts=0)], window_s=10.0) == []
    events = watched([*samples(50), *stuck(230), *samples(101, 280.0)])
    assert [event.kind for event in events] == ["window", "stuck_sensor", "stuck_sensor", "window"]
    np.testing.assert_allclose(judge.given[-1].time_s[[0, -1]], [0.28, 0.38])


@pytest.mark.parametrize(("name", "row"), [("current", "{s},{k},12000,105"), ("speed", "480,{k},12000,{c}")])
def test_a_window_with_a_sensor_that_stands_still_is_not_judged(judge: Judge, name: str, row: str) -> None:
    still: list[Piece] = [(row.format(k=k, s=500 + k % 3, c=100 + k % 7) + "\n").encode() for k in range(101)]
    (event,) = watched(still)
    value = {"current": 0.105, "speed": 480.0 * RAD_S_PER_RPM}[name]
    assert (event.kind, event.text) == ("stuck_sensor", f"the {name} of a whole window is {value:.6g}")
    assert judge.given == []
    rest: list[Piece] = [f"0,{k},0,0\n".encode() for k in range(101)]
    assert [event.kind for event in watched(rest)] == ["window"]


def test_a_stream_of_another_rate_is_judged_as_it_comes(judge: Judge) -> None:
    """Its interval is no hole in that of the healthy windows: the judge says whether it may differ so much."""
    watched(samples(303), dt_s=0.7e-3)
    assert [recording.dt_s for recording in judge.given] == pytest.approx([1e-3] * 3)
    assert [recording.missing for recording in judge.given] == [None] * 3


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
    told = [json.loads(event.as_json()) for event in watched(samples(8 * 101), state)]
    failed = told.pop()
    assert (failed["verdict"], failed["kind"]) == ("sensor", "current_dead")
    assert (failed["reason"], state.counts.pop("window sensor")) == ("the current shows nothing", 1)
    assert told[0] == {
        "time_s": pytest.approx(0.1),
        "event": "window",
        "verdict": "bearing",
        "ratios": {"R": 1.0, "K": 1.0, "J": 1.0, "B": 1.3457},
    }
    assert [one["event"] for one in told[1:]] == ["another_motor", *(5 * ["window"])]
    assert [one.get("verdict") for one in told[2:]] == ["other", "winding", "winding", *(2 * ["unusable"])]
    assert [one.get("kind") for one in told] == [*(4 * [None]), "winding_contact", None, None]
    assert [one.get("also") for one in told] == [*(4 * [None]), ["bearing"], None, None]
    assert [one.get("reason") for one in told[2:]] == ["because", None, None, "the motor stands", "too short"]
    assert dict(state.counts) == {
        "window bearing": 1,
        "another_motor": 1,
        "window other": 1,
        "window winding": 2,
        "window unusable": 2,
    }
    assert json.loads(Event(0.0, "gap", "3 s").as_json()) == {"time_s": 0.0, "event": "gap", "reason": "3 s"}


def test_ratios_are_those_of_the_fit_whatever_the_temperature_may_explain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fitted = np.array([1.25, 1.0, 1.0, 1.0])
    fit = FittedWindow(np.log(fitted), 1e-6 * np.eye(4))
    monkeypatch.setattr(WindowJudge, "fitted", lambda *_: fit)
    (event,) = watched(samples(101), per_year=1e4)
    assert (event.text, event.fault_kind) == ("winding", "winding_contact")
    assert list(event.ratios.values()) == pytest.approx(fitted, rel=1e-12)
    judged = decide(fit, judge_of(TAUGHT).reference, 0.01)
    assert judged.severity == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize(
    ("counts", "status"),
    [
        ({"window healthy": 3}, ExitStatus.HEALTHY),
        ({"window healthy": 3, "gap": 2, "malformed": 1}, ExitStatus.HEALTHY),
        ({"window healthy": 3, "window unusable": 1}, ExitStatus.UNDECIDED),
        ({"gap": 1}, ExitStatus.UNDECIDED),
        ({}, ExitStatus.UNDECIDED),
        ({"window healthy": 3, "window unusable": 1, "window bearing": 1}, ExitStatus.FAULT),
        ({"window bearing": 0, "window healthy": 1}, ExitStatus.HEALTHY),
    ],
)
def test_exit_status_of_what_was_seen(counts: dict[str, int], status: ExitStatus) -> None:
    state = State()
    state.counts.update(counts)
    assert state.exit_status == status


def test_a_watch_goes_on_where_it_was(judge: Judge, tmp_path: Path) -> None:
    """After a restart the offset, the counts and the names of the columns are those of before."""
    first, path = State("m", "log"), tmp_path / "state.json"
    pieces = samples(101)
    watched(pieces, first)
    assert first.offset == len(joined([HEADER, *pieces]))
    first.save(path)
    again = State.load(path, "m", "log")
    assert again == first
    assert again.header == HEADER.decode().strip()
    watch = Watch(TAUGHT, again, false_alarms_per_year=1.0)
    assert [event.name for event in watch.events(samples(101, 101.0))] == ["window healthy"]
    assert again.counts == {"window healthy": 2}
    list(watch.events([Notice(NEW_FILE, "shrunk"), b"1,2,3,4\n"]))
    assert again.offset == len(b"1,2,3,4\n")
    assert again.last_read == "1,2,3,4\n"
    assert State.load(tmp_path / "none.json", "m", "log") == State.load(None, "m", "log") == State("m", "log")


def test_headers_may_be_said_again_and_remarks_are_no_samples(judge: Judge) -> None:
    swapped = b"current_a,time_s,voltage_v,speed_rad_s\n"
    rows: list[Piece] = [f"{0.1 + k % 7},{k / 1e3},12,{k % 5}\n".encode() for k in range(101)]
    watched([b"#1,2,3,4\n", b"\n", swapped, *rows])
    np.testing.assert_allclose(judge.given[0].current_a, 0.1 + np.arange(101) % 7)
    (event,) = watched([b"x" * 100 + b"\n"])
    assert (event.kind, event.text) == ("malformed", "x" * 60)


def test_a_lesson_takes_as_many_windows_as_were_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def learn(recordings: list[Recording], window_s: float, *, steady: bool) -> tuple[Healthy, list[Any]]:
        given.append((len(recordings), window_s, steady))
        if len(given) == 1:
            raise UnusableError("it stands still")
        return TAUGHT, []

    monkeypatch.setattr(watching, "learn_windows", learn)
    judge = Judge(monkeypatch)
    watch = Watch(LearningPhase(0.0995, 0.4975, steady=True), State(), false_alarms_per_year=1.0)
    events = list(watch.events([HEADER, *samples(11 * 101)]))
    assert watch.healthy is TAUGHT
    assert [event.text for event in events[:4]] == [f"{0.0995 * n:g} of 0.4975 s" for n in (1, 2, 3, 4)]
    four = 4 * ["learning"]
    assert [event.kind for event in events] == [*four, "not_learned", *four, "learned", "window"]
    assert events[4].text == "it stands still"
    assert given == [(5, 0.0995, True)] * 2
    assert len(judge.given) == 1
    for window_s, learn_s in ((0.1, 0.399), (0.0, 1.0), (1.0, math.inf)):
        words = f"learn must be at least 4 windows of {window_s:g} s, got {learn_s:g} s"
        with pytest.raises(InputError, match=words):
            LearningPhase(window_s, learn_s)


def test_silence_is_said_after_five_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    came = ((0.0, b"a\n"), (4.99, b""), (5.01, b""), (9.0, b""), (9.5, b"b\n"), (14.4, b""), (14.6, b""))
    monkeypatch.setattr("motor_env.diagnosis.streaming.sources.time.monotonic", lambda: now[0])

    def pieces() -> Any:
        for at, piece in came:
            now[0] = at
            yield piece

    told = [(now[0], piece) for piece in lines(pieces())]
    assert told == [(0.0, b"a\n"), (5.01, SILENCE), (9.5, b"b\n"), (14.6, SILENCE)]
    assert SILENCE.text == "no line for 5 s: is the cable plugged in?"


@pytest.fixture
def watching_a_log(judge: Judge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A command that has judged one window of a log, and kept its state."""
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(150)]))
    (tmp_path / "m.toml").write_text("this motor", encoding="utf-8")
    monkeypatch.setattr(watching, "load_motor", lambda _: SimpleNamespace(healthy=TAUGHT))
    run = [str(tmp_path / name) for name in ("m.toml", "log.csv", "state.json")]
    run = ["watch", *run[:2], "--state", run[2]]
    assert main(run) == 0
    return run


def test_the_command_reads_keeps_and_ends_with_its_status(
    watching_a_log: list[str],
    judge: Judge,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log, state, run = tmp_path / "log.csv", tmp_path / "state.json", watching_a_log
    # What follows the last judged window is read again.
    kept = json.loads(state.read_text())
    assert kept["counts"] == {"window healthy": 1}
    assert kept["offset"] == len(b"".join(log.read_bytes().splitlines(keepends=True)[:102]))
    with log.open("ab") as file:
        file.write(joined(samples(60, 150.0)))
    judge.verdicts = [judged("bearing", 1.0, 1.0, 1.0, 1.5)]
    assert main(run) == 1
    assert json.loads(capsys.readouterr().out)["verdict"] == "bearing"
    np.testing.assert_allclose(judge.given[-1].time_s[[0, -1]], [0.101, 0.201])
    assert json.loads(state.read_text())["counts"] == {"window healthy": 1, "window bearing": 1}
    assert main([*run[:2], "--follow"]) == 2
    assert "--follow needs a log" in capsys.readouterr().err
    starts = replace(TAUGHT, windows=None, starts=Starts(-3.0, 0.1))
    for kind, taught, origin in (
        ("data_sheet", None, "is a data sheet"),
        ("identified", None, "was identified"),
        ("commissioned", starts, "was learned from starts"),
    ):
        known = SimpleNamespace(name="m", kind=kind, healthy=taught)
        monkeypatch.setattr(watching, "load_motor", lambda _, known=known: known)
        assert main(run) == 2
        said = capsys.readouterr().err
        assert f"m: {origin}" in said
        assert "learned from logs: motor-env commission log1.csv log2.csv -o" in said


def test_columns_that_the_user_names_count_more_than_those_that_were_kept(
    watching_a_log: list[str], judge: Judge, tmp_path: Path
) -> None:
    with (tmp_path / "log.csv").open("ab") as file:
        file.write(joined(samples(60, 150.0)))
    assert main([*watching_a_log, "--columns", "speed_rpm,t_ms,voltage_mv,current_a"]) == 0
    kept, named = (recording.current_a.min() for recording in judge.given)
    assert named == pytest.approx(1e3 * kept)


def test_a_motor_file_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "none.toml", "log.csv"]) == 2
    said = capsys.readouterr().err
    assert "none.toml: no such motor file" in said
    assert "`motor-env commission` writes one from logs" in said


def test_the_state_of_another_motor_or_source_is_refused(
    watching_a_log: list[str], judge: Judge, tmp_path: Path
) -> None:
    run, state, (_, motor, log, *_) = watching_a_log, tmp_path / "state.json", watching_a_log
    (tmp_path / "other.csv").write_bytes((tmp_path / "log.csv").read_bytes())
    run[2] = str(tmp_path / "other.csv")
    said = hostile.refused(lambda: main(run), state)
    assert f"is the state of another source, {log!r}, and not of {run[2]!r}; give another --state" in said
    run[2] = log
    Path(motor).write_text("another motor", encoding="utf-8")
    said = hostile.refused(lambda: main(run), state)
    assert "is the state of another motor file than this one; give another --state" in said
    assert len(judge.given) == 1


def test_the_state_is_that_of_the_motor_which_was_learned(
    judge: Judge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(6 * 101)]))
    monkeypatch.setattr(watching, "learn_windows", lambda *_, **__: (TAUGHT, []))
    monkeypatch.setattr(watching, "load_motor", lambda _: SimpleNamespace(healthy=TAUGHT))
    monkeypatch.setattr(watching, "motor_of_windows", lambda *_: None)
    monkeypatch.setattr(watching, "save_motor", lambda _, path: path.write_text("learned"))
    motor, log, state = (str(tmp_path / name) for name in ("m.toml", "log.csv", "state.json"))
    run = ["watch", motor, log, "--learn", "0.4975", "--window", "0.0995", "--state", state]
    assert main(run) == 0
    assert len(judge.given) == 1
    assert main(run) == 0  # it goes on
    (tmp_path / "m.toml").unlink()
    assert "another motor file" in hostile.refused(lambda: main(run), tmp_path / "state.json")


def test_a_rotated_log_goes_on_with_its_own_state(
    watching_a_log: list[str], judge: Judge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another content under the same name: read from its begin, however long it is, and said."""
    capsys.readouterr()
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(250, 3_000.0)]))
    judge.verdicts = [judged("bearing", 1.0, 1.0, 1.0, 1.5)]
    assert main(watching_a_log) == 1
    new, *windows = map(json.loads, capsys.readouterr().out.splitlines())
    assert new["event"] == "new_file"
    offset = len(joined([HEADER, *samples(101)]))
    assert f"read from its beginning; what followed byte {offset} may be lost" in new["reason"]
    assert [one["verdict"] for one in windows] == ["bearing", "healthy"]
    np.testing.assert_allclose(judge.given[1].time_s[0], 3.0)
    kept = json.loads((tmp_path / "state.json").read_text())
    assert kept["offset"] == len(joined([HEADER, *samples(202, 3_000.0)]))
    assert kept["counts"] == {"window healthy": 2, "window bearing": 1, "new_file": 1}
    # A new file is kept before its first window, too: a new start finds no hole.
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(50, 9_000.0)]))
    for events in (["new_file"], []):
        assert main(watching_a_log) == 1
        assert [json.loads(line)["event"] for line in capsys.readouterr().out.splitlines()] == events


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("offset", "12", "offset must be a valid integer"),
        ("offset", float("inf"), "offset must be a valid integer"),
        ("offset", -1, "offset and counts must be >= 0"),
        ("offset", 2**64, "a file as long as the offset"),
        ("offset", 3, "last_read must be"),
        ("last_read", "\u0416" * 512, "last_read must be"),
        ("counts", {"window healthy": "many"}, "must be a valid integer"),
        ("counts", {"window healthy": -1}, "offset and counts must be >= 0"),
        ("counts", {"window marvellous": 1}, "'marvellous' is not a valid Verdict"),
        ("counts", 3, "counts must be"),
        ("header", hostile.DEEP, "nested too deep"),
        ("strange", 1, "it must hold motor, source, offset,"),
        ("header", "nonsense", "columns must name time"),
    ],
)
def test_a_forged_state_is_refused(
    watching_a_log: list[str], tmp_path: Path, key: str, value: Any, words: str
) -> None:
    path = tmp_path / "state.json"
    path.write_text(hostile.json_of(json.loads(path.read_text()) | {key: value}), encoding="utf-8")
    assert words in hostile.refused(
        lambda: main(watching_a_log), path, named=key != "header" or value == hostile.DEEP
    )


def test_a_hostile_state_is_refused_or_read(watching_a_log: list[str], tmp_path: Path) -> None:
    path, rng = tmp_path / "state.json", np.random.default_rng(5)
    good = json.loads(path.read_text())

    def load() -> State:
        return State.load(path, good["motor"], good["source"])

    for content in ("", "[]", "3", "{}", '"offset"', hostile.deep(), "nul", "\x00" * 99):
        path.write_text(content, encoding="utf-8")
        hostile.refused(load, path)
    for _ in range(300):
        path.write_text(hostile.json_of(hostile.forged(good, rng)), encoding="utf-8")
        hostile.refused_or_same(load, path, lambda state: state.exit_status)
    for odd in hostile.odd_places(path):
        hostile.refused(partial(main, [*watching_a_log[:4], str(odd)]), odd)


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


def test_garbage_is_counted_and_said_once_a_second(judge: Judge, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, state = Clock(monkeypatch), State()
    garbage: list[Piece] = [b"g%d\n" % k for k in range(1_000)]
    watch = Watch(TAUGHT, state, false_alarms_per_year=1.0)
    events = list(watch.events(itertools.chain([HEADER], clock.spent(garbage, 3.5), samples(101))))
    said = [(event.text, event.count) for event in events if event.kind == "malformed"]
    assert [count for _, count in said] == [1, 286, 286, 286, 141]
    assert said[1][0] == "g286"
    assert state.counts == {"malformed": 1_000, "window healthy": 1}
    assert json.loads(events[1].as_json())["count"] == 286
    assert "count" not in json.loads(events[0].as_json())


def test_a_log_with_garbage_is_told_the_same_way_however_fast(
    judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second of the stream's own time counts, whatever the clock on the wall says; gaps count for none."""
    Clock(monkeypatch)
    lines = [each for k, line in enumerate(samples(2_500)) for each in (line, b"g%d\n" % k)]
    told = [event for event in watched(lines, window_s=100.0) if event.kind == "malformed"]
    assert [event.count for event in told] == [1, 1_000, 1_000, 499]
    assert [event.text for event in told] == ["g0", "g1000", "g2000", "g2499"]
    state = State()
    jumps: list[Piece] = [piece for k in range(300) for piece in samples(2, 1_000.0 * (k % 2))]
    said = watched(jumps, state)
    assert [(event.kind, event.count) for event in said] == [
        ("gap", 1), ("time_jump", 1), ("gap", 149), ("time_jump", 148),
    ]  # fmt: skip
    assert state.counts == {"gap": 150, "time_jump": 149}


def test_what_was_held_back_is_said_when_it_is_due_and_not_with_the_next(
    judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    heard = clock.spent([HEADER, b"a\n", b"b\n", b"c\n", SILENCE], 5.0 * 0.3)
    events = Watch(TAUGHT, State(), false_alarms_per_year=1.0).events(heard)
    said = [(event.kind, event.count) for event in events]
    assert said == [("malformed", 1), ("silence", 1), ("malformed", 2)]
    heard = clock.spent([HEADER, b"a\n", b"b\n", *samples(3)], 6.0 * 0.5)
    kinds = [event.text for event in Watch(TAUGHT, State(), false_alarms_per_year=1.0).events(heard)]
    assert kinds == ["a", "b"]


def test_a_line_that_is_too_long_is_one_malformed_event_and_the_rest_of_it_nothing(
    judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    Clock(monkeypatch)
    state = State()
    long = b"0.1,12," * 30_000
    pieces = [HEADER, long + b"\n1,2,3,4\n", b",".join([b""] * 5_000_000), b"\n", *samples(101)]
    watch = Watch(TAUGHT, state, false_alarms_per_year=1.0)
    events = list(watch.events(lines(iter(pieces))))
    assert [event.name for event in events] == ["malformed", "time_jump", "window healthy", "malformed"]
    assert events[0].text == "longer than 65536 bytes: " + long[:60].decode()
    assert state.counts == {"malformed": 2, "time_jump": 1, "window healthy": 1}
    assert state.offset == len(joined(pieces))


def test_behind_a_notice_a_line_begins(judge: Judge) -> None:
    cut: list[Piece] = [b"x" * 70_000, Notice("unplugged", "gone"), HEADER, *samples(101)]
    watch = Watch(TAUGHT, State(), false_alarms_per_year=1.0)
    assert [event.name for event in watch.events(cut)] == ["malformed", "unplugged", "window healthy"]


def test_marks_of_an_encoding_are_no_part_of_a_line(judge: Judge) -> None:
    mark = b"\xef\xbb\xbf"
    watch = Watch(TAUGHT, State(), false_alarms_per_year=1.0)
    (event,) = watch.events([mark + HEADER, *samples(50), mark + HEADER, *samples(51, 50.0)])
    assert event.text == "healthy"


def test_what_is_no_number_is_null() -> None:
    told = Event(math.nan, "window", "healthy", {"R": math.inf, "K": 1.0, "J": -math.inf, "B": math.nan})
    assert told.as_json().count("null") == 4
    assert "\n" not in told.as_json()
    follows("motor-env watch", told.as_json())


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
    for count, kind in ((1, "window"), (2, "2 window")):
        with showing(state.counts) as show:
            show(Event(7.25, "window", "worn", {}, "", count=count))
        assert f" 7.25 {kind} worn " in " ".join(re.split(r"[\s│]+", capsys.readouterr().out))
