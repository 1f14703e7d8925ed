"""Motors judged by their sisters, from files to the table, and a motor between its sisters and its own records."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from browser import opened
from scipy.stats import f as fisher, t as student_t

from motor_env import PAPER_MOTOR, Diagnosis, Fault, FaultKind, diagnose, load_motor, simulate_states
from motor_env.cli import main
from motor_env.common.errors import InputError
from motor_env.diagnosis.fleet.fits import FitCache, InitialFit, Reading, fit_fleet, processes
from motor_env.diagnosis.fleet.judging import FleetDiagnosis, common_cause, diagnose_fleet
from motor_env.diagnosis.fleet.learning import LearnedFleet, UnitId, learn_fleet
from motor_env.diagnosis.verdict.hypotheses import Difference, FittedWindow
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.envs import MonitorEnv
from motor_env.motor.data_sheet import Motor, save_motor

# Reaches in: fits, and how far a motor lies off, are made by hand.
from motor_env.motor.identifiable import matrix
from motor_env.motor.parameters import FloatArray

STEPS_V = np.repeat([0.0, 4.0, 10.0, -10.0, -4.0, 8.0], 45)
START_V = np.repeat([0.0, 12.0], [40, 260])
GROUP = r"(?P<machine>\d+)_(?P<motor>left|right)(_(?P<repeat>[a-z]))?"
SICK = "3_left"


def record(path: Path, seed: list[int], voltage_v: FloatArray, faults: tuple[Fault, ...] = ()) -> None:
    """A log of one motor of a fleet; the first number of the seed tells the motor."""
    r, k, j, b = np.exp(np.random.default_rng(seed[:2]).normal(0.0, [0.06, 0.025, 0.06, 0.1])).tolist()
    p = PAPER_MOTOR
    motor = replace(
        p,
        resistance_ohm=r * p.resistance_ohm,
        back_emf_constant_v_s_per_rad=k * p.back_emf_constant_v_s_per_rad,
        torque_constant_n_m_per_a=k * p.torque_constant_n_m_per_a,
        inertia_kg_m2=j * p.inertia_kg_m2,
        viscous_friction_n_m_s_per_rad=b * p.viscous_friction_n_m_s_per_rad,
    )
    rng = np.random.default_rng([*seed, 9])
    current_a, speed_rad_s = simulate_states(motor, voltage_v, 1e-3, faults=faults).T
    columns = {
        "time_s": 1e-3 * np.arange(len(voltage_v)),
        "voltage_v": voltage_v,
        "current_a": current_a + rng.normal(0.0, 0.02, len(voltage_v)),
        "speed_rad_s": speed_rad_s + rng.normal(0.0, 1.0, len(voltage_v)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(columns).round(5).to_csv(path, index=False)


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


def test_other_changes_beside_the_fault_are_not_denied(found: FleetDiagnosis) -> None:
    worst = found.units[0]
    names = worst.quantities
    off = np.zeros(len(names))
    off[names.index("B")] = 9.0
    alone = replace(worst, difference=Difference(off, np.eye(len(names)), matrix(names), 9.0))
    assert alone.odd.startswith("B +")
    assert alone.why == FaultKind.BEARING.finding
    off[names.index("R")] = 3.0
    both = replace(worst, difference=Difference(off, np.eye(len(names)), matrix(names), 9.0))
    assert "R +" in both.odd
    assert both.why == "mostly, friction is up: look at the bearings, the lubricant and the load"


def test_how_far_a_motor_is_off_by_hand(found: FleetDiagnosis) -> None:
    names = ("R", "K")
    difference = Difference(np.array([0.2, -0.6]), np.diag([0.04, 0.09]), matrix(names), 9.0)
    one = replace(found.units[0], quantities=names, difference=difference)
    assert one.deviations == pytest.approx({"R": 1.0, "K": -2.0})
    assert one.p_value == pytest.approx(fisher(2, 9).sf(2.5))


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


def test_a_motor_is_told_by_the_surest_of_its_faults(found: FleetDiagnosis) -> None:
    healthy, worst = found.units[-1].decisive, found.units[0].decisive

    def record(verdict: Verdict, confidence: float) -> Diagnosis:
        return replace(worst, pieces=(replace(worst.decisive, verdict=verdict, confidence=confidence),))

    faults = [record(Verdict.WINDING, 0.6), record(Verdict.BEARING, 0.9), record(Verdict.WINDING, 0.7)]
    records = {Path(str(n)): one for n, one in enumerate([healthy, *faults])}
    assert replace(found.units[0], records=records).verdict is Verdict.BEARING


def test_a_fleet_says_once_how_it_was_read(learned: LearnedFleet) -> None:
    (read,) = (line for line in learned.text(0.01).splitlines() if "read: " in line)
    assert read.startswith("  read: time is column 1 (time_s); ")


def test_motors_of_one_machine_do_not_count_for_each_other(learned: LearnedFleet) -> None:
    """Both motors of a machine off alike are both odd, however many motors it has."""
    core = learned.population_without("3")
    assert len(core.probability) == 6
    without = learned.motor("others", core, "left").healthy
    assert without is not None
    assert without.fleet is not None
    assert without.fleet.motors == 6


def test_logs_at_work_make_a_motor_file_that_judges_another_sister(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, toml = fleet(tmp_path / "fleet", STEPS_V, machines=3), tmp_path / "fleet.toml"
    assert main(["commission", "--fleet", *map(str, files), "--group", GROUP, "-o", str(toml)]) == 0
    motor = load_motor(toml)
    assert motor.healthy is not None
    assert motor.healthy.fleet is not None
    assert motor.healthy.fleet.motors == 6
    assert MonitorEnv(motor=str(toml)).reset(seed=0)[0].shape
    record(tmp_path / "new.csv", [50, 0], STEPS_V)
    record(tmp_path / "worn.csv", [50, 0], STEPS_V, (Fault(FaultKind.WINDING_CONTACT, 0.8),))
    assert diagnose(tmp_path / "new.csv", motor).verdict == "healthy"
    worn = diagnose(tmp_path / "worn.csv", motor)
    assert worn.verdict == "winding"
    assert worn.severity == pytest.approx(0.8, abs=0.25)
    assert worn.reasons[1] == "compared with 6 sisters of commissioned motor"

    # With each own record the healthy values come closer to the motor's own, and the spread falls.
    own = []
    for repeat in range(3):
        own.append(tmp_path / f"own_{repeat}.csv")
        record(own[-1], [50, 0, repeat], STEPS_V)
    healthy = [motor.healthy]
    for count in (1, 3):
        given, kept = [str(path) for path in own[:count]], tmp_path / f"own_{count}.toml"
        assert main(["commission", *given, "--motor", str(toml), "-o", str(kept)]) == 0
        learned = load_motor(kept).healthy
        assert learned is not None
        assert learned.pieces == count
        assert learned.degrees_of_freedom == pytest.approx(motor.healthy.degrees_of_freedom + count)
        healthy.append(learned)
    sd = np.sqrt(np.diagonal([one.log_covariance for one in healthy], axis1=1, axis2=2))
    assert (sd[1] < 0.8 * sd[0])[[0, 2]].all()
    assert (sd[1] < sd[0]).all()
    assert (sd[2] < sd[1]).all()
    resistance_ohm = np.exp(drawn(50)) * PAPER_MOTOR.resistance_ohm
    assert healthy[-1].values[0] == pytest.approx(resistance_ohm, rel=0.03)

    capsys.readouterr()
    assert main(["identify", str(own[0]), "--motor", str(toml), "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)
    low, high = one["parameters"]["R"]["interval"]
    assert low < resistance_ohm < high
    assert high / low < np.exp(4.0 * sd[0, 0])
    known = healthy[1].fleet
    assert known is not None
    own_sd = np.sqrt((healthy[1].log_covariance - known.log_within)[0, 0])
    half = student_t(healthy[1].degrees_of_freedom).ppf(0.975) * own_sd
    assert np.log(high / low) == pytest.approx(2.0 * half)
    assert one["parameters"]["R"]["value"] == pytest.approx(healthy[1].values[0])


def drawn(machine: int) -> float:
    """Logarithm of the factor on R of a motor of `record`."""
    return float(np.random.default_rng([machine, 0]).normal(0.0, 0.06))


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
        (["diagnose", "x.csv", "--fleet", "--start", "2"], "--start does not go with a fleet"),
        (["commission", "x.csv", "--group", "(?P<machine>x)", "-o", "m.toml"], "--group goes with --fleet"),
        (
            ["identify", "x.csv", "--motor", "m.toml", "--torque-constant", "1"],
            "--torque-constant does not go",
        ),
        (["commission", "x.csv", "--fleet", "--steady", "-o", "m.toml"], "--steady does not go with --fleet"),
    ],
)
def test_options_that_do_not_go_together(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert words in capsys.readouterr().err


def test_one_own_record_is_one_recording(
    starts: list[Path], learned: LearnedFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units = tmp_path / "sisters.toml"
    save_motor(learned.motor("sisters"), units)
    own = str(starts[0])
    assert main(["identify", own, "--motor", str(units)]) == 0
    assert main(["commission", own, "--motor", str(units), "-o", str(tmp_path / "own.toml")]) == 0
    said = capsys.readouterr().out
    assert "1 recording beside the sisters" in said
    assert "1 own recording beside the sisters" in said
    assert said.count("  read: time is column 1 (time_s); ") == 1


def test_own_records_need_the_file_of_a_fleet(starts: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["commission", str(starts[0]), "--motor", "paper", "-o", "never.toml"]) == 2
    assert "`motor-env commission --fleet` has written" in capsys.readouterr().err
    assert not Path("never.toml").exists()


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


def test_kept_fits_of_others_are_refused(starts: list[Path], tmp_path: Path) -> None:
    kept = tmp_path / "fits.jsonl"
    learn_fleet(starts, kept=kept)
    with pytest.raises(InputError, match="holds no fits of records that were read like these"):
        learn_fleet(starts, kept=kept, reading=Reading(voltage_v=9.0))
    lines = kept.read_text().splitlines()
    kept.write_text("\n".join([lines[0], '{"record": 3}', *lines[2:], ""]))
    with pytest.raises(InputError, match="line 2 is no kept fit"):
        learn_fleet(starts, kept=kept)


@pytest.mark.parametrize(
    "content", ["notes without an end of line", "# a title\nand text\n", "[" * 9999 + "\n"]
)
def test_a_file_of_another_kind_is_refused_and_stays(
    starts: list[Path], tmp_path: Path, content: str
) -> None:
    kept = tmp_path / "notes.md"
    kept.write_text(content)
    with pytest.raises(InputError, match="holds no fits of records"):
        learn_fleet(starts, kept=kept)
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
