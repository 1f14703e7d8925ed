"""Watching a stream: what is said of its lines, and of windows of a motor at work."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate

from motor_env.cli import main
from motor_env.diagnosis.watch import STUCK_AFTER, State, Watch
from motor_env.errors import InputError
from motor_env.motor.data_sheet import WindowReference
from motor_env.recordings.recording import Recording

HEADER = b"t_ms,voltage_v,current_ma,speed_rad_s\n"
REFERENCE = WindowReference(
    windows=10,
    window_s=1e6,
    degrees_of_freedom=13.0,
    values=np.ones(4),
    log_covariance=np.eye(4) * 1e-4,
    terms=(),
    physical=np.zeros(1),
    hold="held",
    dt_s=1e-3,
    rms_volts=(11.0, 13.0),
)


def kinds(lines: list[bytes | None], state: State | None = None) -> list[str]:
    return [
        event.kind for event in Watch(REFERENCE, state or State(), false_alarms_per_year=1.0).lines(lines)
    ]


def samples(count: int, first_ms: int = 0) -> list[bytes | None]:
    return [f"{k},12,{100 + k % 7},500\n".encode() for k in range(first_ms, first_ms + count)]


def test_what_is_wrong_with_a_stream_is_said_at_once() -> None:
    good: list[bytes | None] = [HEADER, *samples(50)]
    assert kinds(good) == []
    assert kinds([*good, b"x,y\n", b"60,nan,1,1\n", b"\xff\xfe\n", b"# a remark\n", HEADER]) == 3 * [
        "malformed"
    ]
    assert kinds([*good, *samples(50, 500)]) == ["gap"]
    assert kinds([*good, *samples(50, 10)]) == ["time_jump"]
    assert kinds([*good, None, *samples(50, 5_000)]) == ["silence"]
    stuck: list[bytes | None] = [f"{k},12,100,500\n".encode() for k in range(50, 100 + STUCK_AFTER)]
    assert kinds([*good, *stuck]) == ["stuck_sensor"]
    still: list[bytes | None] = [f"{k},0,0,0\n".encode() for k in range(50, 100 + STUCK_AFTER)]
    assert kinds([*good, *still]) == []


def test_malformed_lines_cost_no_sample_beside_them() -> None:
    lines: list[bytes | None] = [HEADER]
    for line in samples(1_000):
        lines += [line, b"1;2;3\n"]
    watch = Watch(REFERENCE, State(), false_alarms_per_year=1.0)
    assert sum(event.kind == "malformed" for event in watch.lines(lines)) == 1_000
    assert len(watch._window) == 1_000


def test_bad_input_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="speed is missing"):
        kinds([b"time_s,voltage_v,current_a\n"])
    with pytest.raises(InputError, match="false-alarms-per-year must be > 0"):
        Watch(REFERENCE, State(), false_alarms_per_year=0.0)
    (tmp_path / "state.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="is no state of watch"):
        State.load(tmp_path / "state.json")


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_watched_motor_goes_on_after_it_was_killed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng([77, 2])
    motor = draw_motor(rng)
    dt_s = motor.mechanical_s / 10.0

    def write(name: str, recording: Recording, begin: str = "") -> str:
        columns = [recording.time_s, recording.voltage_v, recording.current_a, recording.speed_rad_s]
        rows = "\n".join(",".join(map(repr, map(float, row))) for row in zip(*columns, strict=True))
        (tmp_path / name).write_text(
            f"{begin}time_s,voltage_v,current_a,speed_rad_s\n{rows}\n", encoding="utf-8"
        )
        return str(tmp_path / name)

    logs = [write(name, simulate(motor, "reversals", rng, samples=1200, dt_s=dt_s)) for name in "ab"]
    toml, state = str(tmp_path / "motor.toml"), str(tmp_path / "state.json")
    assert main(["commission", *logs, "--window", str(300 * dt_s), "-o", toml]) == 0
    log = write("log.csv", simulate(motor, "reversals", rng, samples=1000, dt_s=dt_s))
    capsys.readouterr()
    assert main(["watch", toml, log, "--state", state]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["verdict"] for event in events] == ["healthy"] * 3
    worn = simulate(replace(motor, ohm=1.25 * motor.ohm), "reversals", rng, samples=1000, dt_s=dt_s)
    write("log.csv", replace(worn, time_s=worn.time_s + 1e3), begin=Path(log).read_text(encoding="utf-8"))
    assert main(["watch", toml, log, "--state", state]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event.get("verdict", event["event"]) for event in events] == ["gap"] + 3 * ["winding_contact"]
    assert json.loads(Path(state).read_text(encoding="utf-8"))["counts"]["window healthy"] == 3
