"""What commands hand on, print and end with: the work behind them is put in its place by hand."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recording_csv import write_csv

from motor_env import Diagnosis, Recording, Verdict, commission, diagnose, identify, load_motor, trend, watch
from motor_env.cli import main, motors, options, verdicts as of_verdicts

# Reaches in: stand-ins are patched in where commands look their work up, and answer in its types.
from motor_env.diagnosis import file_verdicts, identification as identifying
from motor_env.diagnosis.embedded import monitor as monitors, source
from motor_env.diagnosis.embedded.monitor import CusumBank
from motor_env.diagnosis.file_verdicts import Outcome
from motor_env.diagnosis.prognosis import trend_report as trends
from motor_env.diagnosis.readers.profiles import Profile, load_profile
from motor_env.diagnosis.readers.regime import RegimeDecision
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.streaming import watch as watching
from motor_env.diagnosis.verdict.judgement import Judgement

EXAMPLES = Path(__file__).parents[3] / "examples"
MOTOR, CAPTURE = str(EXAMPLES / "motor.toml"), str(EXAMPLES / "startup_capture.csv")
START = Recording(Path("a"), np.arange(2.0), np.zeros(2))
Said = pytest.CaptureFixture[str]


class Noted:
    """In the place of a function: what it is given, and what it answers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, module: Any, name: str, answer: object) -> None:
        self.given: dict[str, Any] = {}
        self.answer = answer
        monkeypatch.setattr(module, name, self)

    def __call__(self, *places: object, **options: object) -> object:
        self.given |= options | {"places": places}
        return self.answer


def outcome(verdict: str | None, *, is_bug: bool = False) -> Outcome:
    """Of a file that was judged, or could not be read."""
    path = Path(f"{verdict}.csv")
    if verdict is None:
        return Outcome(path, None, "None.csv: is empty", is_bug=is_bug)
    judged = Judgement(Verdict(verdict), ("because",))
    found = Diagnosis(replace(START, path=path), RegimeDecision("start", "as asked"), (judged,))
    return Outcome(path, found)


@pytest.mark.parametrize(
    ("verdicts", "status"),
    [
        (["healthy"], 0),
        (["healthy", "bearing"], 1),
        (["bearing", None], 2),
        (["healthy", "unusable"], 3),
        (["no_reference"], 3),
    ],
)
def test_diagnose_ends_with_the_status_of_its_verdicts(
    verdicts: list[str | None], status: int, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    noted = Noted(monkeypatch, file_verdicts, "diagnose_files", [outcome(verdict) for verdict in verdicts])
    command = [
        "diagnose",
        "a.csv",
        "b.csv",
        "--false-alarm-rate",
        "0.05",
        "--shunt-ohm",
        "0.3",
        "--start",
        "2",
    ]
    more = ["--temperature-c", "31", "--regime", "operation", "--healthy", "h.csv", "i.csv"]
    assert main([*command, *more]) == status
    printed = capsys.readouterr()
    said = [verdict for verdict in verdicts if verdict]
    assert [line.split(": ")[1] for line in printed.out.splitlines() if line[0] != " "] == said
    assert printed.err.count("is empty") == verdicts.count(None)
    expected = {
        "places": ([Path("a.csv"), Path("b.csv")],), "false_alarm_rate": 0.05, "circuit": Circuit(0.3, 0.0), "start": 2,
        "temperature_c": 31.0, "regime": "operation", "healthy": [Path("h.csv"), Path("i.csv")],
    }  # fmt: skip
    assert expected.items() <= noted.given.items()
    assert main([*command, "--json"]) == status
    told = [one["verdict"] for one in json.loads(capsys.readouterr().out)]
    assert told == [verdict or "unusable" for verdict in verdicts]
    noted.answer = [outcome(None, is_bug=True)]
    assert main(command) == 70


@pytest.mark.parametrize(
    ("explained", "works", "status"),
    [([True, True], None, 0), ([True, False], None, 3), ([True], 0, 0), ([], 3, 3)],
)
def test_identify_ends_with_3_where_no_motor_explains_a_start_or_the_logs(
    explained: list[bool], works: int | None, status: int, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    """Of fits that a motor explains or not, and of logs that have none (3) or one (0)."""
    logs = () if works is None else (replace(START, path=Path("b")),)
    fits = cast("Any", tuple((START, is_determined) for is_determined in explained))
    found = identifying.Identification(fits, logs, {}, None, "no motor" if works else "")
    noted = Noted(monkeypatch, identifying, "identify", found)
    monkeypatch.setattr(identifying, "explain_unusable", lambda fit: None if fit else "poor")
    monkeypatch.setattr(identifying.Identification, "text", lambda _: "words")
    monkeypatch.setattr(identifying.Identification, "to_json", lambda _: [{"start": 1}])
    assert main(["identify", "a.csv", "--ripple-periods-per-turn", "14"]) == status
    assert noted.given["places"] == ([Path("a.csv")],)
    assert (noted.given["periods_per_turn"], noted.given["regime"]) == (14.0, "auto")
    assert capsys.readouterr().out == "words\n"
    assert main(["identify", "a.csv", "--json"]) == status
    assert json.loads(capsys.readouterr().out) == [{"start": 1}]


@pytest.mark.parametrize(
    ("states", "status"),
    [(["steady", "unknown"], 0), (["steady", "trending"], 1), (["reached"], 1), (["close"], 1)],
)
def test_trend_ends_with_1_where_a_limit_matters(
    states: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    found: Any = tuple(SimpleNamespace(state=state) for state in states)
    noted = Noted(monkeypatch, trends, "trend", trends.Trends(found, ("a note",)))
    monkeypatch.setattr(trends.Trends, "page", lambda _: "<page>")
    monkeypatch.setattr(trends.Trends, "text", lambda one: " ".join(each.state for each in one.trends))
    out = tmp_path / "t.html"
    command = ["trend", "a.csv", "--limit", "R=0.9,1.1", "--level", "0.7", "--reference-count", "5"]
    assert main([*command, "--voltage", "12", "--out", str(out)]) == status
    assert capsys.readouterr() == (f"{' '.join(states)}\n{out}\n", "motor-env: a note\n")
    assert out.read_text() == "<page>"
    expected = {"level": 0.7, "reference_count": 5, "voltage_v": 12.0, "date": "name"}
    assert expected.items() <= noted.given.items()
    assert noted.given["places"][1] == {"R": (0.9, 1.1)}
    (tmp_path / "a.csv").write_text("1\n")
    assert main([*command, "--out", str(tmp_path / "a.csv")]) == 2


def test_export_c_hands_on_what_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    limits = SimpleNamespace(counts=lambda *steps: steps)
    monitor = Noted(monkeypatch, monitors, "monitor_of", SimpleNamespace(limits=limits)).given
    written = Noted(monkeypatch, source, "write_library", [tmp_path / "a.c"]).given
    command = ["export-c", MOTOR, "--out", str(tmp_path), "--rate-hz", "2000"]
    assert main(command) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'a.c'}\n"
    asked = (monitor["places"][1], monitor["voltage_v"], monitor["rule"], monitor["stuck_after"])
    assert asked == (2000.0, load_motor(MOTOR).nominal_voltage_v, CusumBank(), 100)
    assert (written["steps"], written["wanted"]) == ((None, None, None), "1 false alarms a year")
    more = ["--arithmetic", "float", "--voltage", "9", "--false-alarms-per-year", "2.5", "--stuck-after", "7"]
    assert main([*command, *more]) == 0
    assert (monitor["voltage_v"], written["steps"]) == (9.0, None)
    assert (monitor["false_alarms_per_year"], monitor["stuck_after"]) == (2.5, 7)
    assert main([*command, "--shift", "3", "--current-count", "0.01"]) == 0
    assert (monitor["rule"], written["steps"]) == (CusumBank((3.0,), ()), (0.01, None, None))


@pytest.mark.parametrize(
    ("options", "window_s", "learn_s"),
    [
        (["--learn", "10min"], 30.0, 600.0),
        (["--learn", "1h", "--window", "20s"], 20.0, 3600.0),
        (["--learn", "90", "--window", "1500ms"], 1.5, 90.0),
    ],
)
def test_watch_hands_on_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, options: list[str], window_s: float, learn_s: float
) -> None:
    asked = Noted(monkeypatch, watching, "run", 3).given
    assert main(["watch", "m.toml", "log.csv", *options, "--steady", "--false-alarms-per-year", "7"]) == 3
    lesson = asked["learning"]
    assert (lesson.window_s, lesson.learn_s, lesson.steady) == (window_s, learn_s, True)
    assert (asked["places"], asked["false_alarms_per_year"]) == ((Path("m.toml"), "log.csv"), 7.0)
    assert main(["watch", "m.toml"]) == 3
    assert (asked["learning"], asked["false_alarms_per_year"], asked["baud"]) == (None, 1.0, 1_000_000)


@pytest.mark.parametrize("command", ["commission", "identify"])
def test_no_other_file_is_written_over_and_each_motor_of_before_is_kept(
    command: str, tmp_path: Path, capsys: Said
) -> None:
    log, motor, text = tmp_path / "log.csv", tmp_path / "motor.toml", Path(MOTOR).read_text()
    log.write_text("time_s,current_a\n")
    assert main([command, "a.csv", "-o", str(log)]) == 2
    assert "is there, and is no motor file" in capsys.readouterr().err
    assert motors._move_aside(motor) == ""
    for name in ("motor.toml.before", "motor.toml.before2"):
        motor.write_text(text)
        if command == "identify":
            assert main([command, CAPTURE, "-o", str(motor)]) == 0
            assert f"is now {tmp_path / name}" in capsys.readouterr().err
            assert load_motor(motor).kind == "identified"
        else:
            assert motors._move_aside(motor).endswith(f"now {tmp_path / name}")
        assert (tmp_path / name).read_text() == text


COMMISSION = ["commission", "a.csv", "-o", "m.toml"]


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (
            ["identify", CAPTURE, "--ripple-periods-per-turn", "nan"],
            "ripple-periods-per-turn must be > 0, got",
        ),
        (["diagnose", CAPTURE, "--ripple-periods-per-turn", "0"], "ripple-periods-per-turn must be > 0"),
        (
            ["diagnose", CAPTURE, "--false-alarm-rate", "0"],
            "false-alarm-rate must lie between 0 and 0.5, got 0",
        ),
        ([*COMMISSION, "--false-alarm-rate", "0.5"], "false-alarm-rate must lie between 0 and 0.5, got 0.5"),
        ([*COMMISSION, "--torque-constant", "0"], "torque-constant must be > 0, got 0"),
        ([*COMMISSION, "--no-load-current", "-1"], "no-load-current must be > 0, got -1"),
        ([*COMMISSION, "--window", "inf"], "window must be > 0, got inf"),
        (["watch", "m.toml", "--learn", "soon"], "must be a time such as 20s or 10min, got 'soon'"),
    ],
)
def test_options_out_of_range_are_one_sentence(command: list[str], sentence: str, capsys: Said) -> None:
    assert main(command) == 2
    assert sentence in capsys.readouterr().err


@pytest.fixture
def recordings(tmp_path: Path) -> dict[str, str]:
    """Of a start, and of a motor at work."""
    time_s = np.arange(400) * 1e-3
    volts = {"start": 12.0 * (time_s > 0.02), "work": 12.0 * np.sign(np.sin(40.0 * time_s) + 0.01)}
    for name, voltage in volts.items():
        measured = voltage / 3.0 + 1e-3 * np.sin(1e4 * time_s)
        write_csv(tmp_path / f"{name}.csv", {"time_s": time_s, "current_a": measured, "voltage_v": voltage})
    return {name: str(tmp_path / f"{name}.csv") for name in volts}


@pytest.mark.parametrize(
    ("files", "more", "sentence"),
    [
        ("start", ["--steady"], "--steady and --window belong to logs of a motor at work"),
        ("work", ["--regime", "start", "--window", "2"], "--steady and --window belong to logs"),
        ("work", ["--regime", "operation", "--start", "1"], "--start belongs to starts, and these are logs"),
        ("work", ["--sensor-lag", "0.1"], "--sensor-lag belongs to starts"),
        ("start", ["--window", "0.1", "--no-load-current", "0.1"], "--no-load-current belongs to starts"),
        ("start start", [], "a healthy start is given twice"),
        ("start work", [], "some are starts, and some logs of a motor at work"),
        ("work", ["--regime", "both"], "regime must be one of auto, start, operation, got 'both'"),
        ("work", ["--temperature-c", "20", "--window", "0.2"], "cannot be used: 2 windows of 0.2 s"),
        ("work", ["--start", "1"], "commissioning needs at least 3 healthy starts, got 1"),
    ],
)
def test_options_of_commission_that_do_not_belong_to_these_recordings_are_refused(
    recordings: dict[str, str], files: str, more: list[str], sentence: str, capsys: Said
) -> None:
    paths = [recordings[name] for name in files.split()]
    assert main(["commission", *paths, "-o", "m.toml", *more]) == 2
    assert sentence in capsys.readouterr().err


def test_choices_of_a_command_are_kept_and_come_before_those_of_a_profile(tmp_path: Path) -> None:
    kept = tmp_path / "p.toml"
    said = options.Measurement(column=["current=2:mA"], sampling_rate=5e3, voltage=12.0, save_profile=kept)
    said.keep()
    assert load_profile(kept) == Profile(("current=2:mA",), 5e3, 12.0)
    again = options.Measurement(profile=kept, voltage=24.0, shunt_ohm=0.1, sensor_lag=1e-3, start=3).options
    assert (again["voltage_v"], again["circuit"], again["start"]) == (24.0, Circuit(0.1, 1e-3), 3)
    assert [one.quantity for one in again["columns"]] == ["current", "time"]


@pytest.mark.parametrize(
    ("asked_for", "verb"),
    [
        (motors.identify, identify),
        (motors.commission, commission),
        (of_verdicts.diagnose, diagnose),
        (of_verdicts.trend, trend),
        (of_verdicts.watch, watch),
    ],
)
def test_a_command_has_the_defaults_of_its_verb(
    asked_for: Callable[..., int], verb: Callable[..., object]
) -> None:
    """The command repeats them, so that it starts without loading what it calls."""
    of_command, of_verb = (inspect.signature(each).parameters for each in (asked_for, verb))
    both = of_command.keys() & of_verb.keys()
    assert both
    assert {name: of_command[name].default for name in both} == {name: of_verb[name].default for name in both}
