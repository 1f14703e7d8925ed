"""Logs and starts with missing samples, and logs that change their rate: no fault of the motor."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from captures import bearing, contact, taught_by_windows
from numpy.typing import NDArray
from present import present
from recording_csv import csv_text, write_csv

from motor_env import PAPER_MOTOR, InputError, Recording, Verdict, diagnose, simulate_states, watch
from motor_env.diagnosis.commission import commission
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

FINE_S, EACH_S = 5e-4, 0.05  # of the simulation; how long a voltage lasts
KINDS = {"healthy": (), "bearing": (bearing(1.0),), "winding": (contact(0.25),)}
MOTOR = taught_by_windows()
Columns = dict[str, FloatArray]
Holes = NDArray[np.bool_]


@cache
def simulated(kind: str, seed: int = 1) -> Columns:
    """Four seconds at 2 kHz."""
    rng = np.random.default_rng(seed)
    volts = np.repeat(rng.uniform(-10.0, 10.0, 80), round(EACH_S / FINE_S))
    states = simulate_states(PAPER_MOTOR, volts, FINE_S, faults=KINDS[kind])
    current, speed = (states + rng.standard_normal(states.shape) * [0.02, 1.0]).T
    time_s = FINE_S * np.arange(len(volts))
    return {"time_s": time_s, "voltage_v": volts, "current_a": current, "speed_rad_s": speed}


def log(kind: str, every: int = 4) -> Columns:
    """At 500 Hz, but from 1 to 3 s one of so many samples of the simulation."""
    parts = [np.arange(3, 2003, 4), np.arange(2003, 6003, every), np.arange(6003, 8000, 4)]
    some = np.concatenate(parts)
    return {name: values[some] for name, values in simulated(kind).items()}


def scattered(n: int) -> Holes:
    return np.random.default_rng(5).random(n) < 0.05


def holed(columns: Columns, pattern: str) -> Columns:
    """With NaN, in all channels or in one, or without the lines."""
    how, which = pattern.split(" ", 1)
    places = np.arange(len(columns["time_s"]))
    at_steps = np.append(False, np.diff(columns["voltage_v"]) != 0.0)
    missing = {
        "at steps": at_steps,
        "before steps": np.append(at_steps[1:], False),
        "in bursts": (places - 60) % 500 < 25,
        "anywhere": scattered(len(places)),
        "of every 20th": places % 20 == 10,
        "of every 2nd": places % 2 == 1,
        "of every 4th": places % 4 == 1,
        "2 of every 5": np.isin(places % 5, (1, 3)),
        "at the end": places >= len(places) - 51,
    }[which]
    if how == "lines":
        return {name: values[~missing] for name, values in columns.items()}
    lost = ("voltage_v", "current_a", "speed_rad_s") if how == "all" else (how,)
    return columns | {name: np.where(missing, np.nan, columns[name]) for name in lost}


def verdicts(path: Path, columns: Columns) -> list[str]:
    return [str(piece.verdict) for piece in diagnose(write_csv(path, columns), MOTOR).pieces]


def streamed(columns: Columns) -> list[str]:
    """What is said of the windows of a stream."""
    events = watch(MOTOR, csv_text(columns).splitlines())
    return [event.text for event in events if event.kind == "window"]


@pytest.mark.parametrize(
    ("pattern", "kind"),
    [
        ("lines at steps", "healthy"),
        ("lines before steps", "winding"),
        ("lines of every 20th", "healthy"),
        ("all anywhere", "bearing"),
        ("all at steps", "healthy"),
        ("voltage_v at steps", "healthy"),
        ("current_a in bursts", "winding"),
        ("all at the end", "healthy"),
    ],
)
def test_holes_are_no_fault_and_hide_none(tmp_path: Path, pattern: str, kind: str) -> None:
    found = verdicts(tmp_path / "log.csv", holed(log(kind), pattern))
    assert len(found) in (3, 4)
    assert set(found) == {kind}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["lines", "all", "voltage_v", "current_a", "speed_rad_s"])
def test_no_pattern_of_holes_is_a_fault_or_hides_one(tmp_path: Path, how: str, kind: str) -> None:
    for which in ("at steps", "before steps", "in bursts", "anywhere", "of every 20th"):
        assert set(verdicts(tmp_path / "log.csv", holed(log(kind), f"{how} {which}"))) == {kind}


@pytest.mark.parametrize("every", [5, 28])
def test_a_log_that_changes_its_rate_is_judged_where_it_has_its_own(tmp_path: Path, every: int) -> None:
    """To 400 and 71 Hz and back, after which the samples fall between the places of the first ones."""
    found = diagnose(write_csv(tmp_path / "log.csv", log("healthy", every)), MOTOR).pieces
    said = [str(piece.verdict) for piece in found]
    assert said[0] == said[-1] == "healthy"
    assert set(said) == {"healthy", "unusable"}
    told = next(piece.reasons[0] for piece in found if piece.verdict is Verdict.UNUSABLE)
    assert "samples are there, and follow others 0.002 s apart without a hole" in told
    assert streamed(log("healthy", 5)) == ["healthy", "unusable", "unusable"]


@pytest.mark.parametrize("which", ["of every 2nd", "of every 4th", "2 of every 5"])
def test_holes_that_leave_another_interval_are_unusable(tmp_path: Path, which: str) -> None:
    for how in ("lines", "all"):
        some = holed(log("healthy"), f"{how} {which}")
        assert set(verdicts(tmp_path / "log.csv", some)) == {"unusable"}
        assert set(streamed(some)) == {"unusable"}


@pytest.mark.parametrize(
    ("channel", "size", "place", "kind"),
    [
        ("voltage_v", 61.0, 700, "winding"),
        ("voltage_v", 1e3, 501, "healthy"),
        ("current_a", -999.0, 900, "winding"),
        ("speed_rad_s", 1e5, 499, "healthy"),
    ],
)
def test_a_lone_outlier_is_no_fault_and_hides_none(
    tmp_path: Path, channel: str, size: float, place: int, kind: str
) -> None:
    columns = log(kind)
    columns[channel][place] = size
    found = diagnose(write_csv(tmp_path / "log.csv", columns), MOTOR)
    assert {str(piece.verdict) for piece in found.pieces} == {kind}
    assert {text for text in streamed(columns)[:2] if text != "healthy"} <= {kind}
    assert f"lone outliers count as missing: {channel} of {size:.4g}" in " ".join(found.recording.columns)


@pytest.mark.long
def test_logs_teach_where_holes_leave_the_steps_to_be_seen(tmp_path: Path) -> None:
    files = {}
    for pattern in ("all anywhere", "all at steps"):
        for seed in (1, 2):
            some = {name: values[3::4] for name, values in simulated("healthy", seed).items()}
            files[pattern, seed] = write_csv(tmp_path / f"{pattern}{seed}.csv", holed(some, pattern))
    learned = commission([files["all anywhere", seed] for seed in (1, 2)], window_s=1.0).motor
    for kind in KINDS:
        found = diagnose(write_csv(tmp_path / "log.csv", log(kind)), learned).pieces
        assert {str(piece.verdict) for piece in found} == {kind}
    with pytest.raises(InputError, match="samples are missing at the voltage's steps: the inductance is"):
        commission([files["all at steps", seed] for seed in (1, 2)], window_s=1.0)


def started(*missing: int, noise_v: float = 0.0, channel: str = "") -> Recording:
    """A start at 10 kHz, switched on at 20 ms (sample 200), with missing samples."""
    rng, n = np.random.default_rng(4), 1200
    volts = np.where(np.arange(n) >= 200, 12.0, 0.0)
    current, speed = simulate_states(PAPER_MOTOR, volts, 1e-4).T
    columns: dict[str, FloatArray] = {
        "current": current + rng.normal(0.0, 0.02, n),
        "voltage": volts + noise_v * rng.standard_normal(n),
        "speed": speed + rng.normal(0.0, 1.0, n),
    }
    for name in columns if channel == "" else [channel]:
        columns[name][list(missing)] = np.nan
    time_s, (amps, shown_v, rad_s) = np.linspace(0.0, 1e-4 * (n - 1), n), columns.values()
    return Recording(Path("start"), time_s, amps, shown_v, rad_s)


def test_a_start_is_fitted_without_its_missing_samples() -> None:
    anywhere = [n for n in np.flatnonzero(scattered(1200)).tolist() if not 197 < n < 203]
    whole, some = (diagnose(started(*missing, noise_v=0.01), "paper") for missing in ((), anywhere))
    assert whole.verdict is some.verdict is Verdict.HEALTHY
    start = prepare(started(*anywhere))
    assert not start.counted[anywhere].any()
    assert start.voltage_v is None  # a command: what fills a hole at its step is no third level
    assert prepare(started(200)).voltage_v is None


def test_a_start_whose_rise_is_missing_is_unusable() -> None:
    with pytest.raises(UnusableError, match=r"voltage are missing where it goes from .* to 12 V"):
        prepare(started(200, noise_v=0.01))
    prepare(started(100, 101, 102, 300, noise_v=0.01))
    with pytest.raises(UnusableError, match="14 samples of the current are missing where it begins to rise"):
        prepare(started(*range(198, 212), channel="current"))
    prepare(started(201, channel="current"))


@pytest.mark.parametrize(
    ("again", "said"),
    [("healthy", "sensor"), ("bearing", "sensor"), ("sensor", "unusable"), ("other", "unusable")],
)
def test_columns_are_swapped_where_the_motor_is_judged_the_other_way_round(
    again: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is strange either way, or of which a sensor failed, is no motor with swapped columns."""
    verdicts = {0: "unusable", 1: again}  # by the column whose sample is missing

    def judged(start: Recording, *_: object, **__: object) -> Judgement:
        ((_, channel),) = np.argwhere(present(start.missing))
        return Judgement(Verdict(verdicts[channel]), ("because",))

    monkeypatch.setattr("motor_env.diagnosis.diagnose.judge_start", judged)
    found = diagnose(started(300, noise_v=0.01, channel="voltage"), "paper")
    assert found.verdict == said
    assert found.kind == (FaultKind("swapped") if said == "sensor" else None)
