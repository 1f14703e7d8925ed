"""Watching a stream: what is said of its lines, and of windows of a motor at work."""

import itertools
import json
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate

from motor_env import InputError, Recording
from motor_env.cli import main
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.streaming.sources import SILENCE, Piece
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import Watch
from motor_env.motor.healthy import Healthy, Windows

HEADER = b"t_ms,voltage_v,current_ma,speed_rad_s\n"


WINDOWS = Windows(1e6, (), np.zeros(index.N_VALUES), "held", 1e-3, 500.0, (11.0, 13.0))


def healthy(window_s: float = 1e6, dt_s: float = 1e-3) -> Healthy:
    """What ten windows have taught."""
    windows = replace(WINDOWS, window_s=window_s, dt_s=dt_s)
    return Healthy(10, 13.0, ("R", "K", "J", "B"), np.ones(4), np.eye(4) * 1e-4, windows=windows)


def kinds(lines: list[Piece], state: State | None = None) -> list[str]:
    return [
        event.kind for event in Watch(healthy(), state or State(), false_alarms_per_year=1.0).events(lines)
    ]


ABSURD = [
    *(b"1e20,12,100,500\n", b"-1e20,12,100,500\n", b"60,1e40,100,500\n", b"60,12,100,-1e300\n"),
    *(b"60,12,1_0,500\n", "60,12,100,\u0661\n".encode()),
]


def samples(count: int, first_ms: int = 0) -> list[Piece]:
    return [f"{k},12,{100 + k % 7},500\n".encode() for k in range(first_ms, first_ms + count)]


def test_what_is_wrong_with_a_stream_is_said_at_once() -> None:
    good: list[Piece] = [HEADER, *samples(50)]
    assert kinds(good) == []
    for bad in (b"x,y\n", b"60,nan,1,1\n", b"\xff\xfe\n", b"60,12,-127283000,500\n", *ABSURD):
        assert kinds([*good, bad, b"# a remark\n", HEADER]) == ["malformed"]
    assert kinds([*good, SILENCE, *samples(50, 5_000)]) == ["silence"]


def test_what_commissioning_cannot_mean_is_malformed() -> None:
    windows = replace(WINDOWS, peaks=(12.0, 0.1, 500.0))
    watch = Watch(replace(healthy(), windows=windows), State(), false_alarms_per_year=1.0)
    lines = (
        HEADER,
        *samples(50),
        b"60,2e5,100,500\n",
        b"61,12,2e6,500\n",
        b"62,12,100,6e6\n",
        *samples(9, 63),
    )
    assert [event.kind for event in watch.events(lines)] == ["malformed", "malformed"]
    assert watch.state.counts == {"malformed": 3}


def test_malformed_lines_cost_no_sample_beside_them() -> None:
    lines: list[Piece] = [HEADER]
    for line in samples(1_000):
        lines += [line, b"1;2;3\n"]
    watch = Watch(healthy(), State(), false_alarms_per_year=1.0)
    list(watch.events(lines))
    assert watch.state.counts == {"malformed": 1_000}
    assert len(watch._window) == 4 * 1_000


def test_bad_input_is_one_sentence() -> None:
    with pytest.raises(InputError, match="speed is missing"):
        kinds([b"time_s,voltage_v,current_a\n"])
    with pytest.raises(InputError, match="false-alarms-per-year must be > 0"):
        Watch(healthy(), State(), false_alarms_per_year=0.0)
    with pytest.raises(InputError, match="false-alarms-per-year must be at least 1e-12, got 1e-300"):
        Watch(healthy(), State(), false_alarms_per_year=1e-300)
    with pytest.raises(InputError, match="columns must name time, voltage, current, speed, got 'a,b'"):
        Watch(healthy(), State(header="a,b"), false_alarms_per_year=1.0)


def test_columns_may_come_late_or_from_the_user() -> None:
    assert kinds([b"0.1,500\n", HEADER, *samples(50)]) == ["malformed"]
    assert kinds(samples(50), State(header=HEADER.decode().strip())) == []
    with pytest.raises(InputError, match=r"no line names the columns .* such as --columns "):
        kinds(samples(3))


def text(recording: Recording, begin_s: float = 0.0) -> str:
    columns = [recording.time_s + begin_s, recording.voltage_v, recording.current_a, recording.speed_rad_s]
    return "".join(",".join(map(repr, map(float, row))) + "\n" for row in zip(*columns, strict=True))


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
    good = simulate(motor, "reversals", rng, samples=3700, dt_s=dt_s)
    log.write_text("time_s,voltage_v,current_a,speed_rad_s\n" + text(good), encoding="utf-8")
    told = list(itertools.islice(watched([*command, "--follow"]), 10))
    assert [event["event"] for event in told] == [*7 * ["learning"], "learned", "window", "window"]
    assert [event.get("verdict") for event in told[8:]] == ["healthy", "healthy"]

    worn = replace(motor, ohm=1.25 * motor.ohm)
    other = replace(motor, constant=0.7 * motor.constant, inertia=2.0 * motor.inertia, ohm=0.8 * motor.ohm)
    with log.open("a", encoding="utf-8") as file:
        # The fault comes with a jump of the speed, at a window's border: one with both may be called anything.
        for begin_s, one, count in ((1e3, motor, 903), (1e3 + 903 * dt_s, worn, 903), (2e3, other, 1000)):
            log_of = simulate(one, "reversals", rng, samples=count, dt_s=dt_s, usual=motor)
            file.write(text(log_of, begin_s))
    assert main(["watch", *command]) == 1
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    names = [event.get("verdict", event["event"]) for event in told]
    windows = [*3 * ["healthy"], *3 * ["winding"], "gap", *3 * ["another_motor"]]
    assert names[names.index("gap") :] == ["gap", *windows]
    counts = json.loads((tmp_path / "state.json").read_text(encoding="utf-8"))["counts"]
    assert (counts["learned"], counts["window healthy"]) == (1, 7)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_memory_stays_flat() -> None:
    """30 days at a sample every 2 s, by windows of 12 h that no motor explains."""
    state = State()
    watch = Watch(healthy(43_200.0, 2.0), state, false_alarms_per_year=1.0)
    lines = (
        f"{2000 * k},{12 * (k % 3 > 0)},{k * 7919 % 101},{500 + k % 5}\n".encode() for k in range(1_300_000)
    )
    tracemalloc.start()
    grown = [tracemalloc.get_traced_memory()[0] for _ in watch.events(itertools.chain([HEADER], lines))]
    tracemalloc.stop()
    assert len(grown) > 50
    assert max(grown[10:]) - grown[9] < 100_000
