"""`motor-env watch`: what it reads, keeps in its state and ends with; the judge of windows is put in its place."""

import itertools
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hostile
import numpy as np
import pytest
from operation_simulator import draw_motor, simulate
from recording_csv import QUANTITIES, csv_text
from watched import HEADER, TAUGHT, Judge, joined, judged, samples

from motor_env import Recording
from motor_env.cli import main
from motor_env.diagnosis.streaming import watch as watching
from motor_env.diagnosis.streaming.state import State
from motor_env.motor.healthy import Starts


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    return Judge(monkeypatch)


def told(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.fixture
def run(judge: Judge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A command that has judged one window of a log, and kept its state."""
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(150)]))
    (tmp_path / "m.toml").write_text("this motor", encoding="utf-8")
    monkeypatch.setattr(watching, "load_motor", lambda _: SimpleNamespace(healthy=TAUGHT))
    motor, log, state = (str(tmp_path / name) for name in ("m.toml", "log.csv", "state.json"))
    command = ["watch", motor, log, "--state", state]
    assert main(command) == 0
    return command


def test_the_command_goes_on_where_it_was(
    run: list[str], judge: Judge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What follows the last judged window is read again."""
    log, state = tmp_path / "log.csv", tmp_path / "state.json"
    kept = json.loads(state.read_text())
    assert kept["counts"] == {"window healthy": 1}
    assert kept["offset"] == len(b"".join(log.read_bytes().splitlines(keepends=True)[:102]))
    assert State.load(state, kept["motor"], kept["source"]).header == HEADER.decode().strip()
    with log.open("ab") as file:
        file.write(joined(samples(60, 150.0)))
    judge.verdicts = [judged("bearing", 1.0, 1.0, 1.0, 1.5)]
    capsys.readouterr()
    assert main(run) == 1
    assert [one["verdict"] for one in told(capsys)] == ["bearing"]
    np.testing.assert_allclose(judge.given[-1].time_s[[0, -1]], [0.101, 0.201])
    assert json.loads(state.read_text())["counts"] == {"window healthy": 1, "window bearing": 1}
    assert State.load(tmp_path / "none.json", "m", "log") == State.load(None, "m", "log") == State("m", "log")


@pytest.mark.parametrize(
    ("kind", "taught", "origin"),
    [
        ("data_sheet", None, "is a data sheet"),
        ("commissioned", replace(TAUGHT, windows=None, starts=Starts(-3.0, 0.1)), "was learned from starts"),
    ],
)
def test_only_a_motor_that_was_learned_from_logs_can_be_watched(
    run: list[str],
    kind: str,
    taught: Any,
    origin: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    known = SimpleNamespace(name="m", kind=kind, healthy=taught)
    monkeypatch.setattr(watching, "load_motor", lambda _: known)
    assert main(run) == 2
    said = capsys.readouterr().err
    assert f"m: {origin}" in said
    assert "learned from logs: motor-env commission log1.csv log2.csv -o" in said


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["paper", "--follow"], "--follow needs a log"),
        (["none.toml", "log.csv"], "none.toml: no such motor file"),
    ],
)
def test_what_cannot_be_watched_is_one_sentence(
    command: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", *command]) == 2
    assert words in capsys.readouterr().err


def test_columns_that_the_user_names_count_more_than_those_that_were_kept(
    run: list[str], judge: Judge, tmp_path: Path
) -> None:
    with (tmp_path / "log.csv").open("ab") as file:
        file.write(joined(samples(60, 150.0)))
    assert main([*run, "--columns", "speed_rpm,t_ms,voltage_mv,current_a"]) == 0
    kept, named = (recording.current_a.min() for recording in judge.given)
    assert named == pytest.approx(1e3 * kept)


def test_the_state_of_another_motor_or_source_is_refused(
    run: list[str], judge: Judge, tmp_path: Path
) -> None:
    state, log = tmp_path / "state.json", tmp_path / "log.csv"
    other = tmp_path / "other.csv"
    other.write_bytes(log.read_bytes())
    said = hostile.refused(lambda: main([*run[:2], str(other), *run[3:]]), state)
    assert f"is the state of another source, '{log}', and not of '{other}'; give another --state" in said
    (tmp_path / "m.toml").write_text("another motor", encoding="utf-8")
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
    run: list[str], judge: Judge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another content under the same name: read from its begin, however long it is, and said."""
    capsys.readouterr()
    (tmp_path / "log.csv").write_bytes(joined([HEADER, *samples(250, 3_000.0)]))
    judge.verdicts = [judged("bearing", 1.0, 1.0, 1.0, 1.5)]
    assert main(run) == 1
    new, *windows = told(capsys)
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
        assert main(run) == 1
        assert [one["event"] for one in told(capsys)] == events


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("offset", float("inf"), "offset must be a valid integer"),
        ("offset", -1, "offset and counts must be >= 0"),
        ("offset", 2**64, "a file as long as the offset"),
        ("offset", 3, "last_read must be"),
        ("counts", {"window marvellous": 1}, "'marvellous' is not a valid Verdict"),
        ("header", hostile.DEEP, "nested too deep"),
        ("header", "nonsense", "columns must name time"),
        ("strange", 1, "it must hold motor, source, offset,"),
    ],
)
def test_a_forged_state_is_refused(run: list[str], tmp_path: Path, key: str, value: Any, words: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(hostile.json_of(json.loads(path.read_text()) | {key: value}), encoding="utf-8")
    assert words in hostile.refused(lambda: main(run), path, named=value != "nonsense")


def test_a_hostile_state_is_refused_or_read(run: list[str], tmp_path: Path) -> None:
    path, rng = tmp_path / "state.json", np.random.default_rng(5)
    good = json.loads(path.read_text())

    def load() -> State:
        return State.load(path, good["motor"], good["source"])

    for content in ("", "[]", "3", "{}", hostile.deep(), "nul", "\x00" * 99):
        path.write_text(content, encoding="utf-8")
        hostile.refused(load, path)
    for _ in range(300):
        path.write_text(hostile.json_of(hostile.forged(good, rng)), encoding="utf-8")
        hostile.refused_or_same(load, path, lambda state: state.exit_status)
    for odd in hostile.odd_places(path):
        hostile.refused(partial(main, [*run[:4], str(odd)]), odd)


def text(recording: Recording, begin_s: float = 0.0, *, header: bool = False) -> str:
    columns = {name: getattr(recording, name) + begin_s * (name == "time_s") for name in QUANTITIES}
    return csv_text(columns).split("\n", 1 - header)[-1] if not header else csv_text(columns)


def watched(command: list[str]) -> Iterator[dict[str, Any]]:
    """Events of a command that is killed with kill -9 as soon as no more of them are wanted."""
    with subprocess.Popen(
        [sys.executable, "-m", "motor_env", "watch", *command], stdout=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        try:
            yield from map(json.loads, running.stdout)
        finally:
            running.kill()


@pytest.mark.long
@pytest.mark.timeout(600)
def test_it_learns_by_itself_and_goes_on_after_it_was_killed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng([77, 2])
    motor = draw_motor(rng)
    dt_s = motor.mechanical_s / 10.0
    toml, log = str(tmp_path / "motor.toml"), tmp_path / "log.csv"
    command = [toml, str(log), "--state", str(tmp_path / "state.json"), "--window", f"{300 * dt_s}"]
    command += ["--learn", f"{2400 * dt_s}", "--false-alarms-per-year", "1e4"]
    log.write_text(text(simulate(motor, "reversals", rng, samples=3700, dt_s=dt_s), header=True))
    events = list(itertools.islice(watched([*command, "--follow"]), 10))
    assert [event["event"] for event in events] == [*7 * ["learning"], "learned", "window", "window"]
    assert [event.get("verdict") for event in events[8:]] == ["healthy", "healthy"]

    worn = replace(motor, ohm=1.25 * motor.ohm)
    other = replace(motor, constant=0.7 * motor.constant, inertia=2.0 * motor.inertia, ohm=0.8 * motor.ohm)
    with log.open("a", encoding="utf-8") as file:
        # The fault comes with a jump of the speed, at a window's border: one with both may be called anything.
        for begin_s, one, count in ((1e3, motor, 903), (1e3 + 903 * dt_s, worn, 903), (2e3, other, 1000)):
            log_of = simulate(one, "reversals", rng, samples=count, dt_s=dt_s, usual=motor)
            file.write(text(log_of, begin_s))
    assert main(["watch", *command]) == 1
    names = [event.get("verdict", event["event"]) for event in told(capsys)]
    windows = [*3 * ["healthy"], *3 * ["winding"], "gap", *3 * ["another_motor"]]
    assert names[names.index("gap") :] == ["gap", *windows]
    counts = json.loads((tmp_path / "state.json").read_text(encoding="utf-8"))["counts"]
    assert (counts["learned"], counts["window healthy"]) == (1, 7)
