"""Motors judged by their sisters, from files to the table, and a motor between its sisters and its own records."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import opened
from present import present
from recording_csv import write_recording
from scipy.stats import t as student_t

from motor_env import (
    PAPER_MOTOR,
    Diagnosis,
    Fault,
    FaultKind,
    Recording,
    diagnose,
    load_motor,
    simulate_states,
)
from motor_env.cli import main
from motor_env.common.errors import InputError
from motor_env.diagnosis.fleet.fits import FitCache, InitialFit, Reading, fit_fleet, processes
from motor_env.diagnosis.fleet.judging import FleetDiagnosis, common_cause, diagnose_fleet
from motor_env.diagnosis.fleet.learning import LearnedFleet, UnitId, learn_fleet, unit_ids
from motor_env.diagnosis.fleet.population import Motors, floor_covariance, learn_population
from motor_env.diagnosis.verdict.hypotheses import Difference, FittedWindow
from motor_env.envs import MonitorEnv

# Reaches in: fits, and how far a motor lies off, are made by hand.
from motor_env.motor.data_sheet import Motor
from motor_env.motor.identifiable import matrix
from motor_env.motor.parameters import FloatArray

STEPS_V = np.repeat([0.0, 4.0, 10.0, -10.0, -4.0, 8.0], 45)
START_V = np.repeat([0.0, 12.0], [40, 260])
GROUP = r"(?P<machine>\d+)_(?P<motor>left|right)(_(?P<repeat>[a-z]))?"
SICK = "3_left"


def record(path: Path, seed: list[int], voltage_v: FloatArray, faults: tuple[Fault, ...] = ()) -> None:
    """A log of one motor of a fleet; the first number of the seed tells the motor."""
    r, k, j, b = np.exp(np.random.default_rng(seed[:2]).normal(0.0, [0.06, 0.025, 0.06, 0.1])).tolist()
    motor = PAPER_MOTOR.scaled(
        resistance_ohm=r,
        back_emf_constant_v_s_per_rad=k,
        torque_constant_n_m_per_a=k,
        inertia_kg_m2=j,
        viscous_friction_n_m_s_per_rad=b,
    )
    states = simulate_states(motor, voltage_v, 1e-3, faults=faults)
    noisy = states + np.random.default_rng([*seed, 9]).normal(0.0, [0.02, 1.0], states.shape)
    time_s = 1e-3 * np.arange(float(len(voltage_v)))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(path, Recording(path, time_s, noisy[:, 0], voltage_v, noisy[:, 1]))


def fleet(folder: Path, voltage_v: FloatArray, machines: int = 4) -> list[Path]:
    """Machines of two motors each, one sick."""
    files = []
    for machine in range(1, machines + 1):
        for side, motor in enumerate(("left", "right")):
            name = f"{machine}_{motor}"
            faults = (Fault(FaultKind.BEARING, 9.0),) if name == SICK else ()
            files.append(folder / f"{name}.csv")
            record(files[-1], [machine, side], voltage_v, faults)
    return files


@pytest.fixture(scope="module")
def starts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return fleet(tmp_path_factory.mktemp("starts"), START_V)


@pytest.fixture(scope="module")
def learned(starts: list[Path]) -> LearnedFleet:
    return learn_fleet(starts, group=GROUP)


@pytest.fixture(scope="module")
def found(starts: list[Path], learned: LearnedFleet) -> FleetDiagnosis:
    """What `diagnose_fleet` says; it would learn the same once more."""

    def known(files: list[Path], *, group: str, **_: object) -> LearnedFleet:
        assert (files, group) == (starts, GROUP)
        return learned

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("motor_env.diagnosis.fleet.judging.learn_fleet", known)
        return diagnose_fleet(starts, group=GROUP)


def test_the_sick_motor_leads_the_table(found: FleetDiagnosis) -> None:
    worst = found.units[0]
    assert worst.unit_id.name == "3 left"
    assert worst.verdict == "bearing"
    assert worst.ratios["B"] == pytest.approx(10.0, rel=0.3)
    assert worst.deviations["B"] > 3.0
    assert worst.p_value is not None
    assert worst.p_value < 0.01
    assert {one.verdict for one in found.units[1:]} == {"healthy"}
    assert found.status == 1


def test_table_json_and_page_say_the_same(found: FleetDiagnosis) -> None:
    first, second = repr(found).splitlines()[:2]
    expected = "If all were healthy, about 0.1 motors would stand out by chance (1 in 100)."
    assert first == f"1 of 8 motors stands out. {expected}"
    assert second.split()[:3] == ["3", "left", "bearing"]
    (worst, *rest) = found.to_json()
    json.dumps(found.to_json(), allow_nan=False)
    assert (worst["motor"], worst["machine"], worst["verdict"]) == ("3 left", "3", "bearing")
    assert len(rest) == 7
    page = found.page()
    assert page.count('class="odd"') == len(found.quantities)
    assert page.count('class="sister"') == 7 * len(found.quantities)
    assert "http" not in page.replace("http://www.w3.org", "")
    assert f"<p>{first}</p>" in page


def test_the_page_in_a_browser(found: FleetDiagnosis, tmp_path: Path) -> None:
    (tmp_path / "fleet.html").write_text(found.page(), encoding="utf-8")
    with opened((tmp_path / "fleet.html").as_uri()) as browser:
        assert browser.value("document.querySelectorAll('table tr').length") == 1 + len(found.units)
        assert browser.value("document.querySelector('td').textContent") == "3 left"
        heights = (
            "[...document.querySelectorAll('svg .odd')].map((dot) => dot.getBoundingClientRect().height)"
        )
        assert all(height > 0.0 for height in browser.value(heights))


def test_the_records_of_a_motor_share_its_rate(
    starts: list[Path], learned: LearnedFleet, found: FleetDiagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = {}
    more = replace(learned, unit_of=learned.unit_of | {Path("1_left_b.csv"): UnitId("1", "left")})

    def noted(path: Path, _: Motor, *, false_alarm_rate: float, **reading: object) -> Diagnosis:
        rates[path.stem] = false_alarm_rate
        return found.units[-1].decisive

    monkeypatch.setattr("motor_env.diagnosis.fleet.judging.learn_fleet", lambda *_, **__: more)
    monkeypatch.setattr("motor_env.diagnosis.fleet.judging.diagnose", noted)
    diagnose_fleet(starts, false_alarm_rate=0.02)
    assert rates == {path.stem: 0.02 for path in starts} | {"1_left": 0.01, "1_left_b": 0.01}


def test_motors_of_one_machine_do_not_count_for_each_other(learned: LearnedFleet) -> None:
    """Both motors of a machine off alike are both odd, however many motors it has."""
    core = learned.population_without("3")
    assert len(core.probability) == 6
    without = present(learned.motor("others", core, "left").healthy)
    assert without.fleet is not None
    assert without.fleet.motors == 6


def test_logs_at_work_make_a_motor_file_that_judges_another_sister(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With an own record the healthy values come closer to the motor's own, and the spread falls."""
    files, toml, kept = (
        fleet(tmp_path / "fleet", STEPS_V, machines=3),
        tmp_path / "fleet.toml",
        tmp_path / "own.toml",
    )
    assert main(["commission", "--fleet", *map(str, files), "--group", GROUP, "-o", str(toml)]) == 0
    motor, own = load_motor(toml), tmp_path / "own.csv"
    assert MonitorEnv(motor=str(toml)).reset(seed=0)[0].shape
    record(own, [50, 0], STEPS_V)
    record(tmp_path / "worn.csv", [50, 0], STEPS_V, (Fault(FaultKind.WINDING_CONTACT, 0.8),))
    assert diagnose(own, motor).verdict == "healthy"
    worn = diagnose(tmp_path / "worn.csv", motor)
    assert (worn.verdict, worn.reasons[1]) == ("winding", "compared with 6 sisters of commissioned motor")
    assert worn.severity == pytest.approx(0.8, abs=0.25)

    assert main(["commission", str(own), "--motor", str(toml), "-o", str(kept)]) == 0
    sisters, learned = motor.healthy, load_motor(kept).healthy
    assert sisters is not None
    assert learned is not None
    assert learned.pieces == 1
    assert learned.degrees_of_freedom == pytest.approx(sisters.degrees_of_freedom + 1)
    before, after = (np.sqrt(np.diag(one.log_covariance)) for one in (sisters, learned))
    assert (after < [0.8, 1.0, 0.8, 1.0] * before).all()
    capsys.readouterr()
    assert main(["identify", str(own), "--motor", str(toml), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)[0]["parameters"]["R"]
    resistance_ohm = np.exp(np.random.default_rng([50, 0]).normal(0.0, 0.06)) * PAPER_MOTOR.resistance_ohm
    low, high = told["interval"]
    assert low < resistance_ohm < high
    assert learned.fleet is not None
    own_sd = np.sqrt((learned.log_covariance - learned.fleet.log_within)[0, 0])
    assert np.log(high / low) == pytest.approx(
        2.0 * student_t(learned.degrees_of_freedom).ppf(0.975) * own_sd
    )
    assert told["value"] == pytest.approx(learned.values[0])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda files: learn_fleet(files[:3]), "a fleet needs at least 5 motors that can be fitted, got 3"),
        (lambda files: learn_fleet([*files, files[0]]), "given twice"),
        (lambda files: diagnose_fleet(files, false_alarm_rate=2.0), "false-alarm-rate"),
    ],
)
def test_what_makes_no_fleet_is_refused(
    starts: list[Path], call: Callable[[list[Path]], object], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        call(starts)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["diagnose", "x.csv", "--group", "(?P<machine>x)"], "--group goes with --fleet"),
        (["diagnose", "x.csv", "--fleet", "--motor", "m.toml"], "--motor does not go with --fleet"),
        (["commission", "x.csv", "--group", "(?P<machine>x)", "-o", "m.toml"], "--group goes with --fleet"),
        (
            ["identify", "x.csv", "--motor", "m.toml", "--torque-constant", "1"],
            "--torque-constant does not go",
        ),
        (["commission", "x.csv", "--fleet", "--steady", "-o", "m.toml"], "--steady does not go with --fleet"),
        (
            ["commission", "x.csv", "--motor", "paper", "-o", "m.toml"],
            "`motor-env commission --fleet` has written",
        ),
    ],
)
def test_options_that_do_not_go_together(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert words in capsys.readouterr().err


def test_a_fleet_that_was_stopped_goes_on_where_it_was(starts: list[Path], tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    kept, fitted = tmp_path / "fits.jsonl", list[Path]()

    def stop(path: Path) -> None:
        fitted.append(path)
        if len(fitted) == 6:
            raise StoppedError

    with pytest.raises(StoppedError):
        learn_fleet(starts, group=GROUP, kept=kept, progress=stop)
    with kept.open("a") as file:
        file.write('{"record": "cut sh')
    fitted.clear()
    found = learn_fleet(starts, group=GROUP, kept=kept, progress=fitted.append)
    assert fitted == [*starts[6:], *starts]  # first fits of the rest, then second ones of all
    assert found.population.centres.tolist() == learn_fleet(starts, group=GROUP).population.centres.tolist()


def test_a_kept_fit_counts_only_for_the_file_as_it_was(tmp_path: Path) -> None:
    record, kept = tmp_path / "one.csv", tmp_path / "fits.jsonl"
    record.write_text("as it was")
    then_ns = record.stat().st_mtime_ns
    with FitCache(kept, Reading()) as known:
        known.add(record, InitialFit("no motor"))
    assert FitCache(kept, Reading())[record] == InitialFit("no motor")
    for text, later_ns in (("as it was then", 0), ("as it is!", 1_000_000)):
        record.write_text(text)
        os.utime(record, ns=(then_ns + later_ns, then_ns + later_ns))
        assert record not in FitCache(kept, Reading())


def test_a_record_with_more_columns_than_most_is_left_out() -> None:
    files = [Path(f"{n}.csv") for n in range(4)]
    few = InitialFit(names=("R",), quantities=("R", "K^2/J"), values=(1.0, 2.0))
    more = few._replace(quantities=("R", "K", "J"), values=(1.0, 2.0, 3.0))
    steps: list[Any] = [
        [("start", ())] * 4,
        [few, few, more, few],
        [FittedWindow(np.zeros(2), np.eye(2))] * 3,
    ]
    told = iter(steps)
    fits = fit_fleet(files, Reading(), each=lambda job, given: next(told))
    assert fits.quantities == few.quantities
    assert list(fits.by_file) == [files[0], files[1], files[3]]
    assert fits.failures == {files[2]: "it was recorded with other columns than most"}


def test_one_log_among_starts_makes_all_of_them_logs() -> None:
    """A start is a short log, too; a log is no start."""
    steps: list[Any] = [[("start", ()), ("operation", ()), ("start", ())], [InitialFit("no motor")] * 3]
    told, jobs = iter(steps), list[Any]()

    def each(job: Any, given: Any) -> Any:
        jobs.append(job)
        return next(told)

    with pytest.raises(InputError, match="no record of the fleet can be used: no motor"):
        fit_fleet([Path(f"{n}.csv") for n in range(3)], Reading(), each=each)
    assert jobs[1].args[0].regime == "operation"


def test_kept_fits_of_others_are_refused_and_stay(starts: list[Path], tmp_path: Path) -> None:
    kept = tmp_path / "fits.jsonl"
    learn_fleet(starts, kept=kept)
    lines = kept.read_text().splitlines()
    torn = "\n".join([lines[0], '{"record": 3}', *lines[2:], ""])
    for content, reading, words in (
        (kept.read_text(), Reading(voltage_v=9.0), "holds no fits of records that were read like these"),
        (torn, Reading(), "line 2 is no kept fit"),
        ("# a title\nand text\n", Reading(), "holds no fits of records"),
        ("[" * 9999 + "\n", Reading(), "holds no fits of records"),
    ):
        kept.write_text(content)
        with pytest.raises(InputError, match=words):
            learn_fleet(starts, kept=kept, reading=reading)
        assert kept.read_text() == content


@pytest.mark.long
def test_a_cluster_finds_the_same(starts: list[Path], found: FleetDiagnosis) -> None:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(n_workers=1, dashboard_address=None)
    with cluster, processes(1, cluster.scheduler_address) as each:
        assert diagnose_fleet(starts, group=GROUP, each=each).to_json() == found.to_json()


def test_motors_of_a_machine_off_alike_are_told_together() -> None:
    """A speed that reads 12 % high in both motors: a gear or an encoder of other pulses, too little for one alone."""
    sd = np.array([0.1, 0.05, 0.1, 0.3])
    low_k = np.array([0.0, -np.log(1.12), -2.0 * np.log(1.12), -2.0 * np.log(1.12)])
    names = ("R", "K", "J", "B")
    both = [Difference(low_k, np.diag(sd**2), matrix(names), 60.0)] * 2
    assert common_cause(both, names, 0.01).startswith("all of it is explained if the speed is 1.12 times")
    assert common_cause(both[:1], names, 0.01) == ""
    # Three gains, each either way, share the rate.
    mild = [replace(both[0], log_ratios=low_k * np.log(1.10) / np.log(1.12))] * 2
    assert common_cause(mild, names, 0.03)
    assert common_cause(mild, names, 0.02) == ""
    other = Difference(-low_k, np.diag(sd**2), matrix(names), 60.0)
    assert common_cause([both[0], other], names, 0.01) == ""


BETWEEN = np.diag(np.square([0.065, 0.025, 0.065, 0.25]))
WITHIN = np.diag(np.square([0.02, 0.01, 0.02, 0.05]))
ERROR = np.diag(np.square([0.01, 0.005, 0.01, 0.03]))
CENTRE = np.log([4.0, 0.09, 8e-5, 3e-4])
BELIEF = np.diag(np.square([0.075, 0.03, 0.075, 0.35]))


def motors(logs: FloatArray, *, repeats: int = 1, positions: int = 1) -> Motors:
    """Motors with so many records each, in so many places of their machines."""
    count = len(logs) // repeats
    return Motors(
        logs,
        np.tile(ERROR, (len(logs), 1, 1)),
        np.repeat(np.arange(count), repeats),
        np.arange(count) % positions,
        BELIEF,
        np.eye(4) * 0.02**2,
    )


def healthy(rng: np.random.Generator, count: int) -> FloatArray:
    return CENTRE + rng.multivariate_normal(np.zeros(4), BETWEEN + WITHIN + ERROR, count)


def test_the_core_is_that_of_the_healthy_ones_with_a_fifth_sick() -> None:
    rng = np.random.default_rng(3)
    logs = healthy(rng, 100)
    logs[:20, 3] += np.log(8.0)
    core = learn_population(motors(logs))
    assert np.abs(core.centres[0] - CENTRE) == pytest.approx(0.0, abs=0.06)
    ratio = np.sqrt(np.diag(core.between + core.within) / np.diag(BETWEEN + WITHIN))
    assert ratio == pytest.approx(1.0, abs=0.25)
    assert (core.probability[:20] < 0.1).all()
    assert np.mean(core.probability[20:] > 0.5) > 0.95


def test_left_and_right_have_centres_of_their_own() -> None:
    logs = healthy(np.random.default_rng(2), 60)
    logs[1::2, 0] += 0.3
    core = learn_population(motors(logs, positions=2))
    assert core.centres[1, 0] - core.centres[0, 0] == pytest.approx(0.3, abs=0.06)
    assert np.sqrt(core.between[0, 0]) < 0.1


def test_pairs_of_records_tell_how_far_records_scatter() -> None:
    """By the median deviation from their mean, beside a belief that is worth four records."""
    half = np.array([0.1, 0.2, 0.1, 0.3])
    everyone = motors(np.tile([half, -half], (10, 1)), repeats=2)
    variance = 2.0 * (1.4826 * half) ** 2 - np.diag(ERROR)
    expected = (10.0 * np.diag(variance) + 4.0 * everyone.within) / 14.0
    np.testing.assert_allclose(everyone.within_covariance(), expected, rtol=1e-3)


def test_a_covariance_is_raised_in_the_directions_that_it_lacks_alone() -> None:
    raised = floor_covariance(np.diag([4.0, -1.0]), np.eye(2))
    assert raised == pytest.approx(np.diag([4.0, 1.0]))


NAMED = r"(?P<machine>\d+)(_(?P<repeat>[a-z]+))?_(?P<motor>left|right)"


@pytest.mark.parametrize(
    ("name", "group", "unit"),
    [
        ("a/one.csv", None, UnitId("one")),  # each file is a machine
        ("robot_07_left.csv", NAMED, UnitId("07", "left")),
        ("robot_86_dagmar_right.csv", NAMED, UnitId("86", "right")),  # a repeat is the same motor
        ("pump_3_b.csv", r"_(?P<motor>\d)_(?P<repeat>[a-z])", UnitId("3")),
    ],
)
def test_machine_and_motor_stand_in_a_files_name(name: str, group: str | None, unit: UnitId) -> None:
    assert unit_ids([Path(name)], group) == [unit]
    assert unit.name == f"{unit.machine} {unit.motor}".strip()


@pytest.mark.parametrize(
    ("group", "words"),
    [
        ("(", "must be a regular expression, got '\\('"),
        ("(?P<side>left)", "must have named groups of machine, motor, repeat, got \\['side'\\]"),
        ("(?P<repeat>left)", "a repeat alone names no motor"),
        ("(?P<machine>[0-9]{3})", "robot_07_left.csv: --group .* does not match its name"),
    ],
)
def test_a_group_that_tells_no_motor_is_refused(group: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        unit_ids([Path("robot_07_left.csv")], group)


recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
DEAD = ("13 left", "13 right", "17 left")
"""Whose current reads nothing while they turn."""
HEAVY = ("19 left", "55 right", "11 left")
"""They draw clearly more current than their sisters."""


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
def test_the_motors_that_draw_too_much_lead_and_no_dead_sensor_is_a_fault_of_a_motor() -> None:
    files = sorted((Path(recordings_path or "") / "regbot").glob("*.csv"))
    assert len(files) == 78
    with processes(2) as each:
        found = {one.unit_id.name: one for one in diagnose_fleet(files, group=NAMED, each=each).units}
    for name in (*DEAD, "11 right"):
        assert found[name].verdict not in ("healthy", "winding", "bearing", "magnet"), name
    told = [
        name for name, one in found.items() if one.p_value is not None and name not in (*DEAD, "11 right")
    ]
    assert set(sorted(told, key=lambda name: found[name].p_value or 0.0)[:3]) == set(HEAVY)
    assert all(found[name].verdict.is_fault for name in HEAVY)
    assert found["19 left"].ratios["B"] > 3.0
    healthy = sum(one.verdict == "healthy" for one in found.values())
    assert healthy > 50
