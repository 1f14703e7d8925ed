"""A running motor judged by windows of its logs."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_recording
from scipy import stats

from motor_env import InputError, Motor, Recording, Verdict, commission, diagnose, load_motor
from motor_env.cli import main
from motor_env.common.console import worst
from motor_env.diagnosis import file_verdicts
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.operation import windows
from motor_env.diagnosis.operation.windows import WindowJudge
from motor_env.diagnosis.verdict.hypotheses import EXPONENTS, NAMES, alarm_share, joint_share
from motor_env.diagnosis.verdict.judgement import Judgement

# Reaches in: the oracle of the joint share needs the direction in which each fault shows.
from motor_env.motor import identifiable
from motor_env.motor.healthy import Healthy, Windows

sys.path.insert(0, str(Path(__file__).resolve().parents[4] / "benchmarks"))
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate

COLUMNS = ("current_a", "voltage_v", "speed_rad_s")
PHYSICAL = np.zeros(index.N_VALUES)
WINDOWS = Windows(
    window_s=0.01, terms=("R", "K"), physical=PHYSICAL, hold="held", dt_s=1e-3, speed_rad_s=100.0
)
HEALTHY = Healthy(12, 15.0, NAMES, np.array([2.0, 0.03, 4e-6, 1e-6]), np.eye(4) * 4e-4, windows=WINDOWS)
MOTOR = replace(load_motor("paper"), healthy=HEALTHY)


@pytest.mark.parametrize(("load", "seed", "share"), [("square", (5, 4), 0.05), ("walk", (6, 0), 0.02)])
def test_friction_of_a_motor_that_never_turns_back_is_told(
    load: str, seed: tuple[int, int], share: float
) -> None:
    """With a fan: what a fit takes for a load balances a dry friction that is too large, and would hide this one.

    With a load that walks: it hides no friction beyond its own range, and is no other motor.
    """
    rng = np.random.default_rng(seed)
    motor = draw_motor(rng)
    dt_s, torque = motor.mechanical_s / 10.0, share * motor.constant * motor.stall_a

    def log(factor: float, samples: int) -> Recording:
        worn = replace(motor, viscous=factor * motor.viscous, coulomb=factor * motor.coulomb)
        torque_n_m = torque * np.sqrt(samples / 600.0) if load == "walk" else torque
        return simulate(
            worn, "one way", rng, samples=samples, dt_s=dt_s, usual=motor, load=load, torque_n_m=torque_n_m
        )

    known = commission([log(1.0, 1200), log(1.0, 1200)], window_s=300 * dt_s).motor
    assert [diagnose(log(1.0, 600), known).verdict for _ in range(3)] == [Verdict.HEALTHY] * 3
    found = diagnose(log(4.0, 600), known)
    assert found.verdict is Verdict.BEARING
    assert found.severity == pytest.approx(3.0, abs=0.5)


@pytest.mark.long
def test_faults_show_in_windows_and_warmth_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng([77, 2])
    motor = draw_motor(rng)
    dt_s = motor.mechanical_s / 10.0

    def log(name: str, changed: SimulatedMotor = motor, samples: int = 800, warm_k: float = 0.0) -> str:
        recording = simulate(changed, "reversals", rng, samples=samples, dt_s=dt_s, warm_k=warm_k)
        return write_recording(tmp_path / f"{name}.csv", recording)

    toml = str(tmp_path / "motor.toml")
    healthy = [log("a", samples=1200), log("b", samples=1200)]
    assert main(["commission", *healthy, "--window", str(300 * dt_s), "-o", toml]) == 0
    friction = replace(motor, viscous=1.5 * motor.viscous, coulomb=1.5 * motor.coulomb)
    logs = [
        log("healthy"),
        log("warm", warm_k=20.0),
        log("contact", replace(motor, ohm=1.25 * motor.ohm)),
        log("friction", friction),
        log("magnet", replace(motor, constant=0.9 * motor.constant)),
        write_recording(
            tmp_path / "weak.csv",
            simulate(replace(motor, volts=0.1 * motor.volts), "reversals", rng, dt_s=dt_s),
        ),
    ]
    capsys.readouterr()
    assert main(["diagnose", *logs, "--motor", toml, "--json", "--out", str(tmp_path)]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [one["verdict"] for one in told] == [
        "healthy",
        "healthy",
        "winding",
        "bearing",
        "magnet",
        "unusable",
    ]
    assert [one["kind"] for one in told[2:5]] == ["winding_contact", "bearing", "magnet"]
    assert (tmp_path / "003-contact-csv.html").exists()
    monkeypatch.setattr(windows, "MANY", 4)
    monkeypatch.setattr(windows, "MOST_JUDGED", 4)
    parts = [simulate(one, "reversals", rng, samples=1500, dt_s=dt_s) for one in (motor, friction, motor)]
    columns = [np.concatenate([getattr(one, name) for one in parts]) for name in COLUMNS]
    long = write_recording(
        tmp_path / "long.csv",
        Recording(Path("long"), dt_s * np.arange(4500.0), columns[0], columns[1], columns[2]),
    )
    assert main(["diagnose", long, "--motor", toml, "--json"]) == 1
    (one,) = json.loads(capsys.readouterr().out)
    assert (one["verdict"], len(one["pieces"]), one["pieces_of_recording"]) == ("bearing", 4, 15)


def judging(monkeypatch: pytest.MonkeyPatch, *pieces: Judgement, of: int = 1) -> None:
    """Instead of the windows of a log, these."""
    monkeypatch.setattr(WindowJudge, "judge", lambda *_: (list(pieces), of))


def test_one_bad_log_costs_no_other_its_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = Recording(tmp_path / "a.csv", np.arange(30.0), np.ones(30))
    read: Iterator[Recording | Exception] = iter(
        [OverflowError("too large"), TypeError("a bug"), record, InputError("b.csv: is empty")]
    )

    def reading(*_: object) -> Recording:
        found = next(read)
        if isinstance(found, Exception):
            raise found
        return found

    def known(_: str) -> Motor:
        return MOTOR

    monkeypatch.setattr(file_verdicts, "read_recording", reading)
    monkeypatch.setattr(file_verdicts, "load_motor", known)
    judging(monkeypatch, *[Judgement(Verdict.HEALTHY, ())] * 2, of=3)
    paths = [tmp_path / f"{n}.csv" for n in range(4)]
    outcomes = file_verdicts.diagnose_files(paths, motor="m.toml", regime="operation")
    assert [one.diagnosis is None for one in outcomes] == [True, True, False, True]
    assert [one.as_json()["verdict"] for one in outcomes] == ["unusable", "unusable", "healthy", "unusable"]
    assert outcomes[2].diagnosis is not None
    assert "2 of 2 windows judged, of 3" in repr(outcomes[2].diagnosis)
    assert [one.is_bug for one in outcomes] == [False, True, False, False]
    assert outcomes[0].error == f"{paths[0]}: cannot be judged (too large)"
    assert worst(one.status for one in outcomes) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("has_levels", "reason"), [(True, "more slowly than it switches"), (False, "at rest")]
)
def test_a_log_without_a_usable_window_says_why(
    has_levels: bool, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the whole log where it tells why; else of each window."""
    rng = np.random.default_rng(8)
    noise, sine = rng.standard_normal((2, 400)), 12.0 * np.sin(np.arange(400.0) / 20.0)
    volts = rng.choice([0.0, 12.0], 400) if has_levels else sine
    record = Recording(Path("a.csv"), 1e-3 * np.arange(400.0), noise[0], volts, noise[1])
    judging(monkeypatch, *[Judgement(Verdict.UNUSABLE, ("at rest",))] * 2, of=2)
    found = diagnose(record, MOTOR, regime="operation")
    assert (found.verdict, found.of) == ("unusable", 1 if has_levels else 2)
    assert reason in found.reasons[0]
    (whole, *_) = found.pieces
    assert whole.duration_s == (pytest.approx(0.4) if has_levels else 0.0)
    assert file_verdicts.Outcome(record.path, found).status == 3


@pytest.mark.parametrize("rate", [0.15, 0.02])
def test_the_tests_of_a_window_alarm_together_at_the_rate(rate: float) -> None:
    rng, freedom, n = np.random.default_rng(5), 20.0, 200_000
    root = np.tril(rng.normal(0.0, 0.02, (4, 4))) + 0.05 * np.eye(4)
    share = joint_share(rate, root @ root.T, EXPONENTS, freedom)
    length = np.sqrt(rng.chisquare(freedom, n) / freedom)
    drawn = rng.standard_normal((n, 4)) / length[:, None]
    axes = np.linalg.inv(root) @ np.transpose(
        [identifiable.visible_direction(kind, EXPONENTS) for kind in identifiable.nameable_kinds(EXPONENTS)]
    )
    along = drawn @ (axes / np.linalg.norm(axes, axis=0))
    alarms = (along > stats.t.isf(share, freedom)).any(axis=1)
    alarms |= np.sum(drawn**2, axis=1) / 4.0 > stats.f.isf(share, 4, freedom)
    assert alarms.mean() == pytest.approx(rate, rel=0.05)
    assert share > 1.3 * alarm_share(rate, EXPONENTS)
