"""Windows under several operating conditions: each is compared with those driven alike; where none is, errors grow."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate
from scipy import stats

from motor_env import FaultKind, InputError, Recording, commission, diagnose, load_motor
from motor_env.diagnosis.estimation.uncertainty import excess_covariance

# Reaches in: drives and windows are made by hand, and a watch hears them.
from motor_env.diagnosis.operation.sequential_monitor import YEAR_S, SequentialMonitor, learn_calibration
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.operation.windows import (
    CONDITION_SPREAD,
    DRIVEN_OTHERWISE,
    WindowJudge,
    condition_distance,
    condition_features,
    condition_offsets,
    group_by_condition,
    judge_of,
    windows_of,
)
from motor_env.diagnosis.readers.recording import cut
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows
from motor_env.diagnosis.verdict.healthy_spread import (
    RECORD_SPREAD,
    learn_without,
    next_window,
    predictive_t,
    usual_condition_windows,
)
from motor_env.diagnosis.verdict.hypotheses import FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.data_sheet import save_motor
from motor_env.motor.healthy import Healthy, OperatingCondition
from motor_env.motor.parameters import FloatArray

WINDOW = 400
PROFILES = ("reversals", "steps")


@pytest.fixture(scope="module")
def simulated() -> SimulatedMotor:
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


@pytest.mark.parametrize(
    ("levels", "times", "groups", "alike"),
    [
        ([1.0, 1.1, 3.0, 1.2, 3.3], 1.0, [0, 0, 1, 0, 1], 0.12),  # 0.3 / 3.3 is less
        ([1.0, 1.1, 3.0, 1.2, 3.3], 6.0, [0, 0, 0, 0, 0], 0.72),  # 1.8 / 3.0 is 0.6
        ([1.0, 1.32, 3.0, 1.2, 4.29], 1.0, [0, 0, 1, 0, 1], 1.29 / 3.0),
    ],
)
def test_windows_are_sorted_by_how_they_are_driven(
    levels: list[float], times: float, groups: list[int], alike: float
) -> None:
    """Windows of one drive follow one another, each as near to the next as the farthest one is to its nearest."""
    moved: FloatArray = np.zeros((5, 3, 17))
    moved[:, :, :10] = np.array(levels)[
        :, None, None
    ]  # a constant: as far apart as the levels, over the other's
    drive, found = group_by_condition(moved, times)
    assert drive.tolist() == groups
    assert found == pytest.approx(alike)


def test_each_drive_teaches_its_own_values(learned: tuple[Healthy, list[FittedWindow]]) -> None:
    """With the spread of its own windows, and that from record to record; windows scatter about their own."""
    healthy, fits = learned
    assert healthy.windows is not None
    drives, calibration = healthy.windows.drives, healthy.windows.calibration
    assert [drive.pieces for drive in drives] == [(0, 1, 2), (3, 4, 5)]
    logs, errors = (
        np.array(each) for each in zip(*((f.log_values, f.log_covariance) for f in fits), strict=True)
    )
    for drive in drives:
        some = list(drive.pieces)
        white = np.mean([fits[n].white_covariance for n in some], axis=0)
        centre, covariance, freedom = predictive_t(logs[some], white)
        np.testing.assert_allclose(np.log(drive.values), centre)
        np.testing.assert_allclose(drive.log_covariance, covariance + np.diag(np.square(RECORD_SPREAD)))
        assert drive.degrees_of_freedom == freedom == 6.0
    assert not np.allclose(drives[0].values, drives[1].values, rtol=1e-3)
    off = logs - np.log([drives[n // 3].values for n in range(6)])
    expected = learn_calibration(off, errors, RECORD_SPREAD, temperature_k=15.0)
    assert calibration is not None
    np.testing.assert_allclose(calibration.covariance, expected.covariance)
    np.testing.assert_allclose(np.log(learn_without(healthy, fits, 4).values), logs[[3, 5]].mean(axis=0))
    np.testing.assert_allclose(calibration.drift_covariance, expected.drift_covariance)


def test_windows_of_a_rare_drive_scatter_no_less_than_those_of_the_usual_one() -> None:
    """Two that agree by chance would call the third a fault, as where a load comes and goes."""
    rng, error = np.random.default_rng(4), np.diag([1e-6, 1e-6, 1e-6, 4.0])
    logs = np.array([0.01, 0.02, 0.03, 0.5]) * rng.normal(size=(8, 4))
    usual = [FittedWindow(row, error, np.zeros((1, 2))) for row in logs]
    rare = [FittedWindow(np.full(4, 1.0 + 0.001 * n), error, np.zeros((1, 2))) for n in range(2)]
    of_usual = next_window(usual, steady=True)[1]
    believed = error + excess_covariance(error, of_usual)
    assert believed[0, 0] == pytest.approx(of_usual[0, 0], rel=0.1)
    assert believed[3, 3] > 4.0  # its own error is larger
    centre, covariance, freedom = next_window(rare, steady=False, usual=usual)
    expected = predictive_t(np.array([fit.log_values for fit in rare]), believed)
    np.testing.assert_allclose(centre, expected[0])
    np.testing.assert_allclose(covariance, expected[1] + np.diag(np.square(RECORD_SPREAD)))
    assert freedom == expected[2] == 5.0
    assert usual_condition_windows([8, 9], [range(8), [8, 9]]) == range(8)
    assert len(usual_condition_windows([7, 8], [range(7), [7, 8]])) == 0
    assert len(usual_condition_windows(range(8), [range(8), [8, 9]])) == 0


def test_how_far_a_drive_is_off_the_others() -> None:
    """Off their median; of a usual drive the others tell nothing."""
    rows = [[0.0, 0.0, 0.0, 0.3], [0.1, 0.0, 0.0, 0.3], [0.5, -0.2, 0.4, 3.0]]
    drives = [
        OperatingCondition(tuple(range(n)), np.ones((1, 3, 17)), np.exp(row), np.eye(4), 5.0)
        for n, row in zip((2, 2, 4), rows, strict=True)
    ]
    off = condition_offsets(drives)
    np.testing.assert_allclose(off[0], [-0.3, 0.1, -0.2, -1.35])
    np.testing.assert_allclose(off[2], [0.45, -0.2, 0.4, 2.7])
    drives[2] = replace(drives[2], pieces=tuple(range(5)))
    assert not condition_offsets(drives)[2].any()
    assert condition_offsets(drives[:1]).tolist() == condition_offsets([]).tolist() == [[0.0] * 4]


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
            wanted = "compared with 3 of 6 healthy windows of this motor under the same operating condition"
            assert one.reasons[-1] == wanted


def test_a_commissioning_says_in_how_many_ways_the_motor_was_driven(
    logs: list[Recording], learned: tuple[Healthy, list[FittedWindow]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("motor_env.diagnosis.commission.learn_windows", lambda *_, **__: learned)
    assert (
        "  2 operating conditions: each window is compared with those"
        in commission(logs, window_s=1.0).text()
    )


def test_a_watch_goes_on_from_one_condition_to_another(
    simulated: SimulatedMotor, learned: tuple[Healthy, list[FittedWindow]]
) -> None:
    """What was healthy before is no fault after, a fault is told, and windows driven otherwise are no evidence."""
    judge, state = judge_of(learned[0]), None

    def verdicts(profile: str, seed: int, motor: SimulatedMotor = simulated) -> list[str]:
        log = log_of(motor, profile, seed, usual=simulated)
        return [str(watch.diagnose(part).verdict) for part in windows_of(log, judge.windows.window_s)]

    per_year = YEAR_S / (1000.0 * judge.windows.window_s)
    for profile, seed in zip(PROFILES, (8, 9), strict=True):
        watch = SequentialMonitor(judge, learned[0], false_alarms_per_year=per_year, state=state)
        assert verdicts(profile, seed) == ["healthy"] * 3
        state = watch.state_dict
    worn = replace(simulated, ohm=1.25 * simulated.ohm)
    assert verdicts(PROFILES[1], 10, worn)[-1] == "winding"
    before = watch.state_dict
    assert before["alarm"] == [1.0]
    verdicts("averaged pwm", 11, worn)
    assert watch.state_dict == before | {"alarm": [0.0]}


def with_drives_apart(healthy: Healthy, off: FloatArray) -> Healthy:
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
    off = np.array([0.14, 0.036, 0.0, 3.0])  # R and K 4 and 2 times as far as is usual
    apart = judge_of(with_drives_apart(healthy, off))
    usual = judge_of(replace(healthy, windows=replace(healthy.windows, drives=())))
    times, down = np.sqrt((4.0**2 + 2.0**2) / 3.0), np.array([0.0, 0.0, 0.0, np.log(4.0)])
    at, lower, higher = (
        replace(fits[0], log_values=np.log(healthy.values) + side * down) for side in (0.0, -1.0, 1.0)
    )
    for place in (0, 1):
        np.testing.assert_allclose(apart.condition_spread(place, at), times * CONDITION_SPREAD)
    np.testing.assert_allclose(usual.condition_spread(0, higher), CONDITION_SPREAD)
    factor = np.array([1.0, 1.0, 1.0, np.log(4.0) / 0.75])
    np.testing.assert_allclose(usual.condition_spread(0, lower), CONDITION_SPREAD * factor)


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
        ("alike healthy unusable", "winding healthy unusable"),
    ],
)
def test_half_of_the_windows_that_are_driven_otherwise_must_show_a_fault(
    each: str,
    said: str,
    logs: list[Recording],
    learned: tuple[Healthy, list[FittedWindow]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fault of fewer is told as what would be said; that of a window that is driven alike stands alone."""
    told = Judgement(Verdict.WINDING, ("R is up",), 0.1, (0.1, 0.2), 0.9, FaultKind.WINDING_CONTACT, 1.0)
    otherwise = replace(told, reasons=("R is up", DRIVEN_OTHERWISE))
    judged = [told if one == "alike" else replace(otherwise, verdict=Verdict(one)) for one in each.split()]
    log = cut(logs[0], slice(len(judged) * WINDOW))

    def judged_by(judge: WindowJudge) -> list[Judgement]:
        left = iter(judged)
        monkeypatch.setattr(WindowJudge, "_judge_window", lambda *_: next(left))
        return judge.judge(log, 0.01)[0]

    judge = judge_of(learned[0])
    alone = judged_by(replace(judge, references=judge.references[:1]))
    assert [one.verdict for one in alone] == [one.verdict for one in judged]
    found = judged_by(judge)
    assert " ".join(one.verdict for one in found) == said
    for before, after in zip(judged, found, strict=True):
        if after.verdict == before.verdict:
            assert (after.reasons, after.severity) == (before.reasons, before.severity)
        else:
            assert after.reasons[0].endswith("under a commissioned one the verdict would be that R is up")
            assert (after.severity, after.confidence, after.kind) == (None, None, None)


@pytest.fixture(scope="module")
def geared() -> SimulatedMotor:
    return draw_motor(np.random.default_rng([3, 1]), ("gear",))


@pytest.fixture(scope="module")
def commissioned(geared: SimulatedMotor) -> Healthy:
    dt_s = 0.1 * geared.mechanical_s
    log = simulate(geared, "reversals", np.random.default_rng(5), samples=2400, dt_s=dt_s)
    healthy, _ = learn_windows([log], 400 * dt_s)
    assert healthy.windows is not None
    return replace(healthy, windows=replace(healthy.windows, alike=0.12))


QUANTITIES = ("voltage_v", "current_a", "speed_rad_s")


def window(command: float, *, held: str, others: float = 1.0) -> Recording:
    rng, time_s = np.random.default_rng(7), np.arange(400.0)
    columns = {name: others * rng.uniform(-9.0, 9.0, 400) for name in QUANTITIES}
    columns[held] = command * np.sin(time_s)
    return Recording(
        Path("window"), time_s, columns["current_a"], columns["voltage_v"], columns["speed_rad_s"]
    )


@pytest.mark.parametrize("held", QUANTITIES)
def test_windows_are_driven_alike_where_one_quantity_is(held: str) -> None:
    known = np.array([condition_features(window(4.0, held=held)), condition_features(window(8.0, held=held))])
    for command, off in ((4.0, 0.0), (4.5, 0.5 / 4.0), (7.0, 1.0 / 8.0)):
        found = condition_distance(condition_features(window(command, held=held, others=5.0)), known).min()
        mean_over_rms = 2.0 * math.sqrt(2.0) / math.pi  # of a sine
        assert found == pytest.approx(off * mean_over_rms, abs=0.01)


def test_a_window_that_stands_elsewhere_is_driven_otherwise_by_its_levels() -> None:
    """By the Wasserstein distance over the root mean square, as scipy has it."""
    time_s, rng = np.arange(4_000.0), np.random.default_rng(8)
    levels = [np.sort(rng.normal(size, 1.0, 4_000)) for size in (3.0, 4.0)]
    one, other = (condition_features(Recording(Path("it"), time_s, each, each, each)) for each in levels)
    exact = stats.wasserstein_distance(*levels) / np.sqrt(np.mean(np.square(levels[1])))
    assert condition_distance(one, other[None])[0] == pytest.approx(exact, rel=0.02)


def test_a_window_with_other_holding_times_is_driven_otherwise_by_its_moves() -> None:
    """A square wave differs from itself an odd number of half periods before."""

    def square(half: int) -> FloatArray:
        values = np.where(np.arange(1024) // half % 2, 1.0, -1.0)
        return condition_features(Recording(Path("it"), np.arange(1024.0), values, values, values))

    slow, fast = square(128), square(16)
    shares = [2.0 * np.sqrt(min(lag / 128.0, 1.0)) for lag in (128, 64, 32, 16, 8, 4, 2)]
    np.testing.assert_allclose(slow[0, 10:], shares, rtol=0.08)
    assert condition_distance(fast, slow[None])[0] == pytest.approx(np.mean(np.abs(fast - slow)[0, 10:]))


@pytest.mark.parametrize(
    ("profile", "changed", "verdict"),
    [
        ("reversals", {}, "healthy"),
        ("reversals", {"coulomb": 1.5, "viscous": 1.5}, "bearing"),
        ("reversals", {"coulomb": 8.0, "viscous": 8.0}, "bearing"),  # a severe fault is none of the drive
        ("averaged pwm", {}, "healthy"),
        ("averaged pwm", {"coulomb": 2.0, "viscous": 2.0}, "unusable"),
        ("averaged pwm", {"coulomb": 8.0, "viscous": 8.0}, "bearing"),
        ("averaged pwm", {"ohm": 1.4}, "winding"),
        ("steps", {}, "healthy"),
        ("steps", {"ohm": 1.4}, "unusable"),
    ],
)
def test_under_another_drive_what_differs_is_told_if_it_is_large_and_the_drive_not_far(
    geared: SimulatedMotor, commissioned: Healthy, profile: str, changed: dict[str, float], verdict: str
) -> None:
    motor = replace(geared, **{name: factor * getattr(geared, name) for name, factor in changed.items()})
    rng, dt_s = np.random.default_rng(5), 0.1 * geared.mechanical_s  # the work of the commissioning
    log = simulate(motor, profile, rng, samples=1200, dt_s=dt_s, usual=geared)
    found = diagnose(log, motor_of_windows(commissioned, "it"), regime="operation")
    assert found.verdict == verdict
    assert any("was not commissioned" in reason for reason in found.reasons) is (profile != "reversals")
    if verdict == "unusable":
        assert (found.severity, found.confidence) == (None, None)
        assert "commission it, too; under a commissioned one" in found.reasons[0]


def test_a_motor_file_keeps_how_it_was_driven(commissioned: Healthy, tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    save_motor(motor_of_windows(commissioned, "it"), path)
    read = load_motor(path).healthy
    assert read is not None
    (kept,), (learned,) = (judge_of(one).windows.drives for one in (read, commissioned))
    assert kept.moved.shape == (6, 3, 17)
    np.testing.assert_array_equal(kept.moved, learned.moved)
    np.testing.assert_array_equal(kept.log_covariance, learned.log_covariance)
    text = path.read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("moved"))
    path.write_text(text.replace(line, "moved = [[[1.0, 0.0], [0.0, 1.0]]]"), encoding="utf-8")
    with pytest.raises(InputError, match=r"healthy\.windows\.drives\.moved must hold 3 rows of 17"):
        load_motor(path)
