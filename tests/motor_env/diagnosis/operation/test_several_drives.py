"""Motors that were commissioned under several drives: a window is compared with those that are driven alike."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motor_env import FaultKind, Recording, commission
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import WindowFit, fit_window
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.uncertainty import excess_covariance

# Reaches in: drives and windows are made by hand, and a watch hears them.
from motor_env.diagnosis.operation import window_baseline, windows
from motor_env.diagnosis.operation.sequential_monitor import YEAR_S, SequentialMonitor, learn_calibration
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.operation.windows import (
    CONDITION_SPREAD,
    DRIVEN_OTHERWISE,
    WindowJudge,
    condition_offsets,
    group_by_condition,
    judge_of,
    windows_of,
)
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows
from motor_env.diagnosis.verdict.healthy_spread import (
    RECORD_SPREAD,
    detectable_changes,
    learn_without,
    next_window,
    predictive_t,
    usual_condition_windows,
)
from motor_env.diagnosis.verdict.hypotheses import FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.healthy import Healthy, OperatingCondition
from motor_env.motor.parameters import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[4] / "benchmarks"))
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate

WINDOW = 400
PROFILES = ("reversals", "steps")


@pytest.fixture(scope="module")
def simulated() -> SimulatedMotor:
    """A motor with a gear, stiction and cogging."""
    return draw_motor(np.random.default_rng([3, 1]), ("gear", "presliding", "cogging"))


def log_of(
    motor: SimulatedMotor, profile: str, seed: int, *, usual: SimulatedMotor, windows: int = 3
) -> Recording:
    rng = np.random.default_rng(seed)
    dt_s = 0.1 * usual.mechanical_s
    return simulate(motor, profile, rng, samples=windows * WINDOW, dt_s=dt_s, usual=usual)


@pytest.fixture(scope="module")
def logs(simulated: SimulatedMotor) -> list[Recording]:
    return [log_of(simulated, profile, 5, usual=simulated) for profile in PROFILES]


@pytest.fixture(scope="module")
def learned(simulated: SimulatedMotor, logs: list[Recording]) -> tuple[Healthy, list[FittedWindow]]:
    return learn_windows(logs, WINDOW * 0.1 * simulated.mechanical_s)


def test_windows_are_sorted_by_how_they_are_driven() -> None:
    """Windows of one drive follow one another, each as near to the next as the farthest one is to its nearest."""
    levels = np.array([1.0, 1.1, 3.0, 1.2, 3.3])
    moved: FloatArray = np.zeros((5, 3, 17))
    moved[:, :, :10] = levels[:, None, None]  # a constant: as far apart as the levels, over the other's
    drive, alike = group_by_condition(moved, 1.0)
    assert drive.tolist() == [0, 0, 1, 0, 1]
    assert alike == pytest.approx(0.12)  # 0.3 / 3.3 is less
    farther, alike = group_by_condition(moved, 6.0)
    assert farther.tolist() == [0] * 5  # 1.8 / 3.0 is 0.6
    assert alike == pytest.approx(0.72)
    spread, alike = group_by_condition(moved * np.array([1.0, 1.2, 1.0, 1.0, 1.3])[:, None, None], 1.0)
    assert spread.tolist() == [0, 0, 1, 0, 1]
    assert alike == pytest.approx(1.29 / 3.0)


def test_each_drive_teaches_its_own_values(learned: tuple[Healthy, list[FittedWindow]]) -> None:
    """With the spread of its own windows, and that from record to record."""
    healthy, fits = learned
    assert healthy.windows is not None
    drives = healthy.windows.drives
    assert [drive.pieces for drive in drives] == [(0, 1, 2), (3, 4, 5)]
    for drive in drives:
        some = [fits[n] for n in drive.pieces]
        centre, covariance, freedom = predictive_t(
            np.array([fit.log_values for fit in some]),
            np.mean([fit.white_covariance for fit in some], axis=0),
        )
        np.testing.assert_allclose(np.log(drive.values), centre)
        np.testing.assert_allclose(drive.log_covariance, covariance + np.diag(np.square(RECORD_SPREAD)))
        assert drive.degrees_of_freedom == freedom == 6.0
    assert not np.allclose(drives[0].values, drives[1].values, rtol=1e-3)


def test_windows_of_a_rare_drive_scatter_no_less_than_those_of_the_usual_one() -> None:
    """Two that agree by chance would call the third a fault, as where a load comes and goes."""
    rng, error = np.random.default_rng(4), np.diag([1e-6, 1e-6, 1e-6, 4.0])
    spread = np.array([0.01, 0.02, 0.03, 0.5])
    usual = [FittedWindow(spread * rng.normal(size=4), error, np.zeros((1, 2))) for _ in range(8)]
    rare = [FittedWindow(np.full(4, 1.0 + 0.001 * n), error, np.zeros((1, 2))) for n in range(2)]
    logs = np.array([fit.log_values for fit in rare])
    of_usual = next_window(usual, steady=True)[1]
    believed = error + excess_covariance(error, of_usual)
    assert np.diag(believed)[0] == pytest.approx(of_usual[0, 0], rel=0.1)
    assert believed[3, 3] > 4.0  # its own error is larger
    centre, covariance, freedom = next_window(rare, steady=False, usual=usual)
    expected = predictive_t(logs, believed)
    np.testing.assert_allclose(centre, expected[0])
    np.testing.assert_allclose(covariance, expected[1] + np.diag(np.square(RECORD_SPREAD)))
    assert freedom == expected[2] == 5.0
    assert usual_condition_windows([8, 9], [range(8), [8, 9]]) == range(8)
    assert len(usual_condition_windows([7, 8], [range(7), [7, 8]])) == 0
    assert len(usual_condition_windows(range(8), [range(8), [8, 9]])) == 0


def test_a_rare_drive_is_learned_beside_the_usual_one(
    simulated: SimulatedMotor, logs: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    of = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 1])
    monkeypatch.setattr(window_baseline, "group_by_condition", lambda *_: (of, 1.0))
    log = log_of(simulated, PROFILES[0], 8, usual=simulated, windows=10)
    healthy, fits = learn_windows([log], WINDOW * 0.1 * simulated.mechanical_s)
    assert healthy.windows is not None
    usual, rare = healthy.windows.drives
    np.testing.assert_allclose(usual.log_covariance, next_window(fits[:8], steady=False)[1])
    np.testing.assert_allclose(rare.log_covariance, next_window(fits[8:], steady=False, usual=fits[:8])[1])
    np.testing.assert_allclose(
        learn_without(healthy, fits, 9).log_covariance,
        next_window(fits[8:9], steady=False, usual=fits[:8])[1],
    )


def test_how_far_a_drive_is_off_the_others() -> None:
    """Off their median; of a usual drive the others tell nothing."""
    rows = [[0.0, 0.0, 0.0, 0.3], [0.1, 0.0, 0.0, 0.3], [0.5, -0.2, 0.4, 3.0]]

    def with_windows(*counts: int) -> list[OperatingCondition]:
        return [
            OperatingCondition(tuple(range(n)), np.ones((1, 3, 17)), np.exp(row), np.eye(4), 5.0)
            for n, row in zip(counts, rows, strict=False)
        ]

    off = condition_offsets(with_windows(2, 2, 4))
    np.testing.assert_allclose(off[0], [-0.3, 0.1, -0.2, -1.35])
    np.testing.assert_allclose(off[2], [0.45, -0.2, 0.4, 2.7])
    usual = condition_offsets(with_windows(2, 2, 5))
    np.testing.assert_array_equal(usual[:2], off[:2])
    assert not usual[2].any()
    assert condition_offsets(with_windows(4)).tolist() == [[0.0] * 4]
    assert condition_offsets([]).tolist() == [[0.0] * 4]


def test_a_window_is_compared_with_those_that_are_driven_alike(
    simulated: SimulatedMotor, learned: tuple[Healthy, list[FittedWindow]]
) -> None:
    healthy, _ = learned
    judge = judge_of(healthy)
    worn = replace(simulated, viscous=2.0 * simulated.viscous, coulomb=2.0 * simulated.coulomb)
    for place, profile in enumerate(PROFILES):
        fresh = log_of(simulated, profile, 6, usual=simulated)
        assert judge.condition_of(fresh)[0] == place
        assert judge.condition_of(fresh)[1] <= 1.0
        assert [one.verdict for one in judge.judge(fresh, 0.01)[0]] == ["healthy"] * 3
        judged = judge.judge(log_of(worn, profile, 6, usual=simulated), 0.01)[0]
        told = [one for one in judged if one.verdict == "bearing"]
        assert len(told) >= 2  # of three: of windows with twice the friction one in 36 is missed
        for one in told:
            assert (
                one.reasons[-1]
                == "compared with 3 of 6 healthy windows of this motor under the same operating condition"
            )


def test_the_smallest_change_shows_under_each_drive(learned: tuple[Healthy, list[FittedWindow]]) -> None:
    healthy, fits = learned
    assert healthy.windows is not None
    motor = motor_of_windows(healthy, "it")
    smallest, _ = detectable_changes(motor, fits, None, 0.01)
    each = []
    for drive in healthy.windows.drives:
        alone = replace(healthy.under(drive), windows=replace(healthy.windows, drives=()))
        own = [fits[n] for n in drive.pieces]
        each.append(detectable_changes(replace(motor, healthy=alone), own, None, 0.01)[0])
    assert smallest == pytest.approx({kind: max(one[kind] for one in each) for kind in each[0]})
    assert each[0] != each[1]
    turned = replace(healthy, windows=replace(healthy.windows, drives=healthy.windows.drives[::-1]))
    assert (
        detectable_changes(replace(motor, healthy=turned), fits, None, 0.01)[0] == smallest
    )  # whatever their order
    others = [fits[n] for n in (3, 5)]
    np.testing.assert_allclose(
        np.log(learn_without(healthy, fits, 4).values), np.mean([fit.log_values for fit in others], axis=0)
    )


def test_a_commissioning_says_in_how_many_ways_the_motor_was_driven(
    simulated: SimulatedMotor,
    logs: list[Recording],
    learned: tuple[Healthy, list[FittedWindow]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    window_s = WINDOW * 0.1 * simulated.mechanical_s
    with monkeypatch.context() as patch:
        patch.setattr("motor_env.diagnosis.commission.learn_windows", lambda *_, **__: learned)
        said = commission(logs, window_s=window_s).text()
    assert "  2 operating conditions: each window is compared with those" in said
    again = log_of(simulated, PROFILES[0], 7, usual=simulated)
    alike = commission([logs[0], again], window_s=window_s)
    assert "  driven in" not in alike.text()
    assert judge_of(alike.healthy).reference.source == "6 healthy windows of this motor"


def test_windows_scatter_about_their_own_condition(learned: tuple[Healthy, list[FittedWindow]]) -> None:
    healthy, fits = learned
    assert healthy.windows is not None
    assert healthy.windows.calibration is not None
    own = [each.values for each in healthy.windows.drives for _ in each.pieces]
    off = np.array([fit.log_values for fit in fits]) - np.log(own)
    errors = np.array([fit.log_covariance for fit in fits])
    expected = learn_calibration(off, errors, RECORD_SPREAD, temperature_k=15.0)
    np.testing.assert_allclose(healthy.windows.calibration.covariance, expected.covariance)
    np.testing.assert_allclose(healthy.windows.calibration.drift_covariance, expected.drift_covariance)


def test_a_watch_goes_on_from_one_condition_to_another(
    simulated: SimulatedMotor, learned: tuple[Healthy, list[FittedWindow]]
) -> None:
    """Whatever the friction is taken for under each: what was healthy before is no fault after, and a fault is told."""
    healthy, _ = learned
    judge = judge_of(healthy)

    def verdicts(watch: SequentialMonitor, log: Recording) -> list[str]:
        return [str(watch.diagnose(part).verdict) for part in windows_of(log, judge.windows.window_s)]

    per_year = YEAR_S / (1000.0 * judge.windows.window_s)
    watch = SequentialMonitor(judge, healthy, false_alarms_per_year=per_year)
    for profile, seed in zip(PROFILES, (8, 9), strict=True):
        assert verdicts(watch, log_of(simulated, profile, seed, usual=simulated)) == ["healthy"] * 3
    later = SequentialMonitor(judge, healthy, false_alarms_per_year=per_year, state=watch.state_dict)
    worn = replace(simulated, ohm=1.25 * simulated.ohm)
    assert verdicts(later, log_of(worn, PROFILES[1], 10, usual=simulated))[-1] == "winding"


def with_drives_apart(healthy: Healthy, off: FloatArray) -> Healthy:
    """Its two drives as far apart as the logarithms are given."""
    assert healthy.windows is not None
    centre = np.log(healthy.values)
    drives = tuple(
        replace(drive, values=np.exp(centre + side * off))
        for side, drive in zip((-0.5, 0.5), healthy.windows.drives, strict=True)
    )
    return replace(healthy, windows=replace(healthy.windows, drives=drives))


def test_near_a_drive_that_is_off_the_others_a_strange_window_may_be_off_too(
    learned: tuple[Healthy, list[FittedWindow]],
) -> None:
    """As many times as far; and friction that goes down moves by more in its logarithm."""
    healthy, fits = learned
    assert healthy.windows is not None
    centre = np.log(healthy.values)
    off = np.array([0.14, 0.036, 0.0, 3.0])  # R and K 4 and 2 times as far as is usual
    apart = judge_of(with_drives_apart(healthy, off))
    usual = judge_of(replace(healthy, windows=replace(healthy.windows, drives=())))
    at = replace(fits[0], log_values=centre)
    times = np.sqrt((4.0**2 + 2.0**2) / 3.0)
    for place in (0, 1):
        np.testing.assert_allclose(apart.condition_spread(place, at), times * CONDITION_SPREAD)
    np.testing.assert_allclose(usual.condition_spread(0, at), CONDITION_SPREAD)
    down = replace(at, log_values=centre - np.array([0.0, 0.0, 0.0, np.log(4.0)]))
    up = replace(at, log_values=centre + np.array([0.0, 0.0, 0.0, np.log(4.0)]))
    factor = np.array([1.0, 1.0, 1.0, np.log(4.0) / 0.75])
    np.testing.assert_allclose(usual.condition_spread(0, down), CONDITION_SPREAD * factor)
    np.testing.assert_allclose(usual.condition_spread(0, up), CONDITION_SPREAD)


def test_a_fault_is_told_under_another_drive_where_the_drives_agree(
    simulated: SimulatedMotor, learned: tuple[Healthy, list[FittedWindow]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where R of the nearest drive is far off that of the others, so may be that of this window."""
    monkeypatch.setattr(WindowJudge, "condition_of", lambda *_: (0, 2.0))  # near the first one
    worn = log_of(replace(simulated, ohm=1.5 * simulated.ohm), PROFILES[0], 6, usual=simulated)
    for apart, verdict in ((0.0, "winding"), (0.7, "unusable")):
        judge = judge_of(with_drives_apart(learned[0], np.array([apart, 0.0, 0.0, 0.0])))
        judged = judge.judge(worn, 0.01)[0]
        assert {str(one.verdict) for one in judged} == {verdict}
        assert all(one.reasons[-1].startswith(DRIVEN_OTHERWISE) for one in judged)


@pytest.mark.parametrize(
    ("each", "said"),
    [
        ("healthy unusable winding", "healthy unusable unusable"),
        ("winding healthy winding", "winding healthy winding"),
        ("winding unusable", "winding unusable"),
        ("winding", "winding"),
        ("alike healthy unusable", "winding healthy unusable"),
    ],
)
def test_half_of_the_windows_that_are_driven_otherwise_must_show_a_fault(
    each: str,
    said: str,
    simulated: SimulatedMotor,
    learned: tuple[Healthy, list[FittedWindow]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fault of fewer is told as what would be said; that of a window that is driven alike stands alone."""
    told = Judgement(Verdict.OTHER, (), 0.1, (0.1, 0.2), 0.9, FaultKind.WINDING_CONTACT, 1.0)
    judged = [
        replace(told, verdict=Verdict.WINDING, reasons=("R is up",))
        if one == "alike"
        else replace(told, verdict=Verdict(one), reasons=("R is up", DRIVEN_OTHERWISE))
        for one in each.split()
    ]
    log = log_of(simulated, PROFILES[0], 6, usual=simulated, windows=len(judged))

    def judged_by(judge: WindowJudge) -> list[Judgement]:
        left = iter(judged)
        monkeypatch.setattr(WindowJudge, "_judge_window", lambda *_: next(left))
        return judge.judge(log, 0.01)[0]

    healthy = learned[0]
    assert healthy.windows is not None
    one_drive = replace(healthy.windows, drives=healthy.windows.drives[:1])
    alone = judged_by(judge_of(replace(healthy, windows=one_drive)))
    assert [one.verdict for one in alone] == [one.verdict for one in judged]
    found = judged_by(judge_of(healthy))
    assert " ".join(one.verdict for one in found) == said
    for before, after in zip(judged, found, strict=True):
        if after.verdict == before.verdict:
            assert (after.reasons, after.severity) == (before.reasons, before.severity)
        else:
            assert after.reasons[0].endswith("under a commissioned one the verdict would be that R is up")
            assert (after.severity, after.confidence, after.kind) == (None, None, None)


def test_a_fit_begins_at_what_its_own_drive_has_taught(
    simulated: SimulatedMotor, learned: tuple[Healthy, list[FittedWindow]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the mean of drives that are far apart it may end in a notch between them."""
    taught = with_drives_apart(learned[0], np.array([0.0, 0.02, 0.0, 0.0]))
    judge, begun = judge_of(taught), list[float]()

    def spy(record: Record, known: FloatArray, *args: Any, **options: Any) -> WindowFit:
        begun.append(float(known[index.K]))
        return fit_window(record, known, *args, **options)

    monkeypatch.setattr(windows, "fit_window", spy)
    for place, profile in enumerate(PROFILES):
        judge.judge(log_of(simulated, profile, 6, usual=simulated), 0.01)
        own = float(np.exp(judge.references[place].log_values[1]))
        assert begun[3 * place :] == pytest.approx([own] * 3)
