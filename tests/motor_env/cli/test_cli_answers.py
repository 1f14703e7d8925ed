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

from motor_env import (
    Diagnosis,
    Recording,
    Verdict,
    commission,
    diagnose,
    identify,
    load_motor,
    trend,
    watch,
)
from motor_env.cli import main, motors, options, verdicts as of_streams, verdicts as of_verdicts

# Reaches in: stand-ins are patched in where commands look their work up, and answer in its types.
from motor_env.diagnosis import identification as identifying
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
MOTOR = str(EXAMPLES / "motor.toml")


def outcome(verdict: str | None, *, is_bug: bool = False) -> Outcome:
    """Of a file that was judged, or could not be read."""
    path = Path(f"{verdict}.csv")
    if verdict is None:
        return Outcome(path, None, "None.csv: is empty", is_bug=is_bug)
    recording = Recording(path, SAMPLES, SAMPLES)
    judged = Judgement(Verdict(verdict), ("because",))
    return Outcome(path, Diagnosis(recording, RegimeDecision("start", "as asked"), (judged,)))


SAMPLES = np.arange(2.0)


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
    verdicts: list[str | None],
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given: dict[str, Any] = {}

    def diagnosed(files: list[Path], **more: Any) -> list[Outcome]:
        given.update(more, files=files)
        return [outcome(verdict) for verdict in verdicts]

    monkeypatch.setattr("motor_env.diagnosis.file_verdicts.diagnose_files", diagnosed)
    command = ["diagnose", "a.csv", "b.csv", "--false-alarm-rate", "0.05", "--shunt-ohm", "0.3"]
    more = ["--temperature-c", "31", "--start", "2", "--regime", "operation"]
    assert main([*command, *more, "--healthy", "h.csv", "i.csv"]) == status
    printed = capsys.readouterr()
    said = [verdict for verdict in verdicts if verdict]
    assert [line.split(": ")[1] for line in printed.out.splitlines() if line[0] != " "] == said
    assert printed.err.count("is empty") == verdicts.count(None)
    assert given["files"] == [Path("a.csv"), Path("b.csv")]
    assert (given["false_alarm_rate"], given["temperature_c"], given["start"]) == (0.05, 31.0, 2)
    assert given["regime"] == "operation"
    assert (given["healthy"], given["circuit"]) == ([Path("h.csv"), Path("i.csv")], Circuit(0.3, 0.0))
    assert main([*command, "--json"]) == status
    assert [one["verdict"] for one in json.loads(capsys.readouterr().out)] == [
        v or "unusable" for v in verdicts
    ]
    monkeypatch.setattr(
        "motor_env.diagnosis.file_verdicts.diagnose_files", lambda *_, **__: [outcome(None, is_bug=True)]
    )
    assert main(command) == 70


@pytest.mark.parametrize(
    ("explained", "works", "status"),
    [([True, True], None, 0), ([True, False], None, 3), ([True], 0, 0), ([], 3, 3), ([False], 0, 3)],
)
def test_identify_ends_with_3_where_no_motor_explains_a_start_or_the_logs(
    explained: list[bool],
    works: int | None,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of fits that a motor explains or not, and of logs that have none (3) or one (0)."""
    given: dict[str, Any] = {}
    start = Recording(Path("a"), np.arange(2.0), np.zeros(2))
    trouble = "no motor" if works else ""
    logs = () if works is None else (replace(start, path=Path("b")),)
    fits = cast("Any", tuple((start, is_determined) for is_determined in explained))
    found = identifying.Identification(fits, logs, {}, None, trouble)

    def fitted(files: list[Path], **more: Any) -> identifying.Identification:
        given.update(more, files=files)
        return found

    monkeypatch.setattr(identifying, "identify", fitted)
    monkeypatch.setattr(identifying, "explain_unusable", lambda fit: None if fit else "poor")
    monkeypatch.setattr(identifying.Identification, "text", lambda _: "words")
    monkeypatch.setattr(identifying.Identification, "to_json", lambda _: [{"start": 1}])
    assert main(["identify", "a.csv", "--ripple-periods-per-turn", "14"]) == status
    assert (given["files"], given["periods_per_turn"], given["regime"]) == ([Path("a.csv")], 14.0, "auto")
    assert capsys.readouterr().out == "words\n"
    assert main(["identify", "a.csv", "--json"]) == status
    assert json.loads(capsys.readouterr().out) == [{"start": 1}]


@pytest.mark.parametrize("periods", ["-1", "0", "inf", "nan"])
def test_identify_refuses_periods_that_are_not_positive(
    periods: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = str(EXAMPLES / "startup_capture.csv")
    assert main(["identify", capture, "--ripple-periods-per-turn", periods]) == 2
    assert f"ripple-periods-per-turn must be > 0, got {periods}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("states", "status"),
    [
        (["steady", "unknown"], 0),
        (["steady", "trending"], 1),
        (["reached"], 1),
        (["close"], 1),
        (["unknown"], 0),
    ],
)
def test_trend_ends_with_1_where_a_limit_matters(
    states: list[str],
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given: dict[str, Any] = {}

    def judged(paths: list[Path], limits: Any, **more: Any) -> trends.Trends:
        given.update(more, paths=paths, limits=limits)
        found = tuple(SimpleNamespace(state=state) for state in states)
        return trends.Trends(cast("Any", found), ("a note",))

    monkeypatch.setattr(trends, "trend", judged)
    monkeypatch.setattr(trends.Trends, "page", lambda _: "<page>")
    monkeypatch.setattr(trends.Trends, "text", lambda one: " ".join(each.state for each in one.trends))
    out = tmp_path / "t.html"
    command = ["trend", "a.csv", "--limit", "R=0.9,1.1", "--level", "0.7", "--reference-count", "5"]
    assert main([*command, "--voltage", "12", "--out", str(out)]) == status
    printed = capsys.readouterr()
    assert printed.out == f"{' '.join(states)}\n{out}\n"
    assert printed.err == "motor-env: a note\n"
    assert out.read_text() == "<page>"
    (tmp_path / "a.csv").write_text("1\n")
    assert main([*command, "--out", str(tmp_path / "a.csv")]) == 2
    assert (given["level"], given["reference_count"], given["voltage_v"]) == (0.7, 5, 12.0)
    assert (given["limits"], given["date"]) == ({"R": (0.9, 1.1)}, "name")


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """What `export-c` asks for."""
    found: dict[str, Any] = {}

    def monitor_of(known: Any, rate_hz: float, **more: Any) -> Any:
        found.update(more, rate_hz=rate_hz)
        return SimpleNamespace(limits=SimpleNamespace(counts=lambda *given: given))

    def write_library(_: Any, out: Path, **more: Any) -> list[Path]:
        found.update(more)
        return [out / "a.c"]

    monkeypatch.setattr(monitors, "monitor_of", monitor_of)
    monkeypatch.setattr(source, "write_library", write_library)
    return found


def test_export_c_hands_on_what_was_asked_for(
    exported: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export-c", MOTOR, "--out", str(tmp_path), "--rate-hz", "2000"]
    assert main(command) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'a.c'}\n"
    known = load_motor(MOTOR)
    assert (exported["rate_hz"], exported["voltage_v"]) == (2000.0, known.nominal_voltage_v)
    assert (exported["rule"], exported["stuck_after"]) == (CusumBank(), 100)
    assert exported["steps"] == (None, None, None)
    assert exported["wanted"] == "1 false alarms a year"
    more = ["--arithmetic", "float", "--voltage", "9"]
    assert main([*command, *more, "--false-alarms-per-year", "2.5", "--stuck-after", "7"]) == 0
    assert (exported["voltage_v"], exported["steps"]) == (9.0, None)
    assert (exported["false_alarms_per_year"], exported["stuck_after"]) == (2.5, 7)
    assert main([*command, "--shift", "3", "--current-count", "0.01"]) == 0
    shifted: Any = CusumBank((3.0,), ())
    assert exported["rule"] == shifted
    assert exported["steps"] == (0.01, None, None)


@pytest.mark.parametrize("command", ["commission", "identify"])
def test_no_other_file_is_written_over_and_each_motor_of_before_is_kept(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, motor = tmp_path / "log.csv", tmp_path / "motor.toml"
    log.write_text("time_s,current_a\n")
    assert main([command, "a.csv", "-o", str(log)]) == 2
    assert "is there, and is no motor file" in capsys.readouterr().err
    assert motors._kept(motor) == ""
    capture = Path(__file__).parents[3] / "examples" / "startup_capture.csv"
    text = (capture.parent / "motor.toml").read_text()
    for name in ("motor.toml.before", "motor.toml.before2"):
        motor.write_text(text)
        if command == "identify":
            assert main([command, str(capture), "-o", str(motor)]) == 0
            assert f"is now {tmp_path / name}" in capsys.readouterr().err
        else:
            assert motors._kept(motor).endswith(f"now {tmp_path / name}")
        assert (motor.exists(), (tmp_path / name).read_text()) == (command == "identify", text)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--false-alarm-rate", "0.5"], "false-alarm-rate must lie between 0 and 0.5, got 0.5"),
        (["--false-alarm-rate", "0"], "false-alarm-rate must lie between 0 and 0.5, got 0"),
        (["--torque-constant", "0"], "torque-constant must be > 0, got 0"),
        (["--no-load-current", "-1"], "no-load-current must be > 0, got -1"),
        (["--no-load-current", "inf"], "no-load-current must be > 0, got inf"),
        (["--window", "0"], "window must be > 0, got 0"),
        (["--window", "inf"], "window must be > 0, got inf"),
    ],
)
def test_options_of_commission_are_checked(
    more: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["commission", "a.csv", "-o", "m.toml", *more]) == 2
    assert sentence in capsys.readouterr().err


@pytest.fixture
def recordings(tmp_path: Path) -> dict[str, str]:
    """Of a start, and of a motor at work."""
    time_s = np.arange(400) * 1e-3
    volts = {"start": 12.0 * (time_s > 0.02), "work": 12.0 * np.sign(np.sin(40.0 * time_s) + 0.01)}
    for name, voltage in volts.items():
        measured = voltage / 3.0 + 1e-3 * np.sin(1e4 * time_s)
        columns = {"time_s": time_s, "current_a": measured, "voltage_v": voltage}
        write_csv(tmp_path / f"{name}.csv", columns)
    return {name: str(tmp_path / f"{name}.csv") for name in volts}


@pytest.mark.parametrize(
    ("files", "more", "sentence"),
    [
        ("start", ["--steady"], "--steady and --window belong to logs of a motor at work"),
        ("start", ["--regime", "start", "--window", "2"], "--steady and --window belong to logs"),
        ("work", ["--regime", "start", "--steady"], "--steady and --window belong to logs"),
        ("work", ["--regime", "operation", "--start", "1"], "--start belongs to starts, and these are logs"),
        ("work", ["--sensor-lag", "0.1"], "--sensor-lag belongs to starts"),
        ("work", ["--torque-constant", "0.1"], "--torque-constant belongs to starts"),
        ("work", ["--no-load-current", "0.1"], "--no-load-current belongs to starts"),
        ("start", ["--window", "0.1", "--no-load-current", "0.1"], "--no-load-current belongs to starts"),
        ("start start", [], "a healthy start is given twice"),
        ("start work", [], "some are starts, and some logs of a motor at work"),
        ("work", ["--regime", "both"], "regime must be one of auto, start, operation, got 'both'"),
        ("work", ["--temperature-c", "20", "--window", "0.2"], "cannot be used: 2 windows of 0.2 s"),
        ("work", ["--start", "1"], "commissioning needs at least 3 healthy starts, got 1"),
    ],
)
def test_options_of_commission_that_do_not_belong_to_these_recordings_are_refused(
    recordings: dict[str, str],
    files: str,
    more: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    paths = [recordings[name] for name in files.split()]
    assert main(["commission", *paths, "-o", "m.toml", *more]) == 2
    assert sentence in capsys.readouterr().err


def test_choices_of_a_command_are_kept_and_come_before_those_of_a_profile(tmp_path: Path) -> None:
    kept = tmp_path / "p.toml"
    said = options.Measurement(column=["current=2:mA"], sampling_rate=5e3, voltage=12.0, save_profile=kept)
    said.keep()
    assert load_profile(kept) == Profile(("current=2:mA",), 5e3, 12.0)
    again = options.Measurement(profile=kept, voltage=24.0, shunt_ohm=0.1, sensor_lag=1e-3, start=3)
    assert again.options["voltage_v"] == 24.0
    assert again.options["circuit"] == Circuit(0.1, 1e-3)
    assert again.options["start"] == 3
    assert [one.quantity for one in again.options["columns"]] == ["current", "time"]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the command hands to `watch.run`."""
    found: dict[str, Any] = {}

    def run(*places: Any, **options: Any) -> int:
        found.update(options, places=places)
        return 3

    monkeypatch.setattr(watching, "run", run)
    return found


@pytest.mark.parametrize(
    ("options", "window_s", "learn_s"),
    [
        (["--learn", "10min"], 30.0, 600.0),
        (["--learn", "1h", "--window", "20s"], 20.0, 3600.0),
        (["--learn", "90", "--window", "1500ms"], 1.5, 90.0),
    ],
)
def test_durations_of_the_command(
    asked: dict[str, Any], options: list[str], window_s: float, learn_s: float
) -> None:
    assert main(["watch", "m.toml", "log.csv", *options, "--steady", "--false-alarms-per-year", "7"]) == 3
    lesson = asked["learning"]
    assert (lesson.window_s, lesson.learn_s, lesson.steady) == (window_s, learn_s, True)
    assert asked["places"] == (Path("m.toml"), "log.csv")
    assert asked["false_alarms_per_year"] == 7.0
    assert main(["watch", "m.toml"]) == 3
    assert (asked["learning"], asked["false_alarms_per_year"], asked["baud"]) == (None, 1.0, 1_000_000)


def test_a_time_that_is_none_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "m.toml", "--learn", "soon"]) == 2
    assert "must be a time such as 20s or 10min, got 'soon'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked_for", "verb"),
    [
        (motors.identify, identify),
        (motors.commission, commission),
        (of_verdicts.diagnose, diagnose),
        (of_verdicts.trend, trend),
        (of_streams.watch, watch),
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
