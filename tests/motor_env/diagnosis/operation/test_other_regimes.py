"""Motors that are driven otherwise than when they were healthy: the model's error is another one there."""

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, stats

from motor_env import Diagnosis, InputError, Recording, diagnose, load_motor

# Reaches in: windows are made by hand.
from motor_env.diagnosis.estimation.operation_fit import identify_operation
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.operation.windows import (
    WindowJudge,
    condition_distance,
    condition_features,
    judge_of,
)
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows
from motor_env.diagnosis.verdict.hypotheses import FittedWindow
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.data_sheet import save_motor
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[4] / "benchmarks"))
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate


@pytest.fixture(scope="module")
def geared() -> SimulatedMotor:
    """A motor with a gear that loses 11 % of the torque."""
    return draw_motor(np.random.default_rng([3, 1]), ("gear",))


@pytest.fixture(scope="module")
def commissioned(geared: SimulatedMotor) -> Healthy:
    """As if the model lacked something of that motor."""
    dt_s = 0.1 * geared.mechanical_s
    log = simulate(geared, "reversals", np.random.default_rng(5), samples=2400, dt_s=dt_s)
    healthy, _ = learn_windows([log], 400 * dt_s)
    assert healthy.windows is not None
    return replace(healthy, windows=replace(healthy.windows, alike=0.12))


def test_the_loss_of_a_gear_is_found(geared: SimulatedMotor) -> None:
    """Without it friction and inertia take its place."""
    rng = np.random.default_rng(4)
    log = simulate(geared, "reversals", rng, samples=2400, dt_s=0.1 * geared.mechanical_s)
    found = identify_operation([log])
    loss = found.quantity("gear_loss")
    assert loss.unit == "of the torque"
    assert loss.low < geared.further.gear < loss.high
    assert loss.log_sd < 0.15
    assert found.quantity("J").value == pytest.approx(geared.inertia, rel=0.01)
    assert found.quantity("coulomb").value == pytest.approx(geared.coulomb, rel=0.1)


QUANTITIES = ("voltage_v", "current_a", "speed_rad_s")


def window(command: float, *, held: str, others: float = 1.0) -> Recording:
    """Of a motor whose voltage, current or speed is commanded, and whose others scatter."""
    rng, time_s = np.random.default_rng(7), np.arange(400.0)
    columns = {name: others * rng.uniform(-9.0, 9.0, 400) for name in QUANTITIES}
    columns[held] = command * np.sin(time_s)
    return Recording(
        Path("window"), time_s, columns["current_a"], columns["voltage_v"], columns["speed_rad_s"]
    )


@pytest.mark.parametrize("held", QUANTITIES)
def test_windows_are_driven_alike_where_one_quantity_is(held: str) -> None:
    """A severe fault changes the others."""
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
    np.testing.assert_allclose(np.diff(fast[0, 10:13]), 0.0, atol=1e-12)  # whole periods of it
    np.testing.assert_allclose(fast[0, 13:], [2.0 * np.sqrt(lag / 16.0) for lag in (16, 8, 4, 2)], rtol=0.02)
    assert condition_distance(fast, slow[None])[0] == pytest.approx(np.mean(np.abs(fast - slow)[0, 10:]))


def test_the_last_window_of_a_recording_is_compared(commissioned: Healthy) -> None:
    """By how far it is from the nearest healthy one, over what is alike."""
    judge = judge_of(commissioned)
    dt_s = judge.windows.dt_s
    count = round(judge.windows.window_s / dt_s)

    def of(size: float) -> Recording:
        values = size * np.resize([1.0, -1.0], count)
        return Recording(Path("window"), dt_s * np.arange(float(count)), values, values, values)

    known = np.array([condition_features(of(2.0)), condition_features(of(9.0))])
    first, second = (replace(judge.windows.drives[0], moved=one[None]) for one in known)
    taught = replace(judge, windows=replace(judge.windows, drives=(first, second), alike=0.4))
    values: FloatArray = np.append(np.full(count, 50.0), of(3.0).current_a).astype(np.float64)
    time_s: FloatArray = dt_s * np.arange(len(values)).astype(np.float64)
    log = Recording(Path("log"), time_s, values, values, values)
    place, strange = taught.condition_of(log)
    assert place == 0
    assert strange == pytest.approx(condition_distance(condition_features(of(3.0)), known)[0] / 0.4)
    assert taught.condition_of(of(8.0))[0] == 1
    assert replace(judge, windows=replace(judge.windows, drives=())).condition_of(log) == (0, 0.0)


@pytest.mark.parametrize("quantity", [0, 1, 2])
def test_under_another_drive_resistance_constant_and_inertia_may_be_off_by_more(
    geared: SimulatedMotor, commissioned: Healthy, monkeypatch: pytest.MonkeyPatch, quantity: int
) -> None:
    """By 3.5, 1.8 and 3.5 % (normal) beside the spread of the healthy windows (Student's t, 9 degrees of freedom).

    Where windows are driven otherwise by more than three times the limit, no fault is told at all.
    """
    judge = judge_of(commissioned)
    log = simulate(geared, "reversals", np.random.default_rng(6), samples=400, dt_s=0.1 * geared.mechanical_s)
    monkeypatch.setattr(WindowJudge, "failed_sensor", lambda *_: None)

    def off(shift: float) -> FittedWindow:
        return FittedWindow(judge.reference.log_values + shift * np.eye(4)[quantity], 1e-6 * np.eye(4))

    def said(shift: float, known: FloatArray | None) -> Verdict:
        monkeypatch.setattr(WindowJudge, "fitted", lambda *_: off(shift))
        drives = () if known is None else (replace(judge.windows.drives[0], moved=known),)
        (one,), _ = replace(judge, windows=replace(judge.windows, drives=drives, alike=0.12)).judge(log, 0.01)
        return one.verdict

    def limit(says: Callable[[float], Verdict]) -> float:
        return float(optimize.brentq(lambda shift: says(shift).is_fault - 0.5, 0.0, 1.0, xtol=1e-5))

    ratio = stats.norm.ppf(0.01 / 6.0) / stats.t.ppf(0.01 / 6.0, 9.0)
    more = np.diag(np.square([0.035, 0.018, 0.035, 0.4])) * ratio**2
    allowed = replace(judge.reference, log_covariance=judge.reference.log_covariance + more)
    strange, far = (np.array([times * condition_features(log)] * 2) for times in (1.25, 2.0))
    narrow, wide = limit(lambda shift: said(shift, None)), limit(lambda shift: said(shift, strange))
    assert wide > narrow + 0.02
    assert wide == pytest.approx(limit(lambda shift: decide(off(shift), allowed, 0.01).verdict), abs=3e-5)
    assert said(narrow + 1e-3, strange) is Verdict.UNUSABLE
    assert said(narrow - 1e-3, strange) is Verdict.HEALTHY
    assert said(wide + 1e-3, strange).is_fault
    assert said(wide + 1e-3, far) is Verdict.UNUSABLE


def test_under_another_drive_what_differs_is_told_if_it_is_large_and_the_drive_not_far(
    geared: SimulatedMotor, commissioned: Healthy
) -> None:
    dt_s, known = 0.1 * geared.mechanical_s, motor_of_windows(commissioned, "it")

    def judged(profile: str, *, friction: float = 1.0, resistance: float = 1.0) -> Diagnosis:
        rng = np.random.default_rng(5)  # the work of the commissioning
        motor = replace(
            geared,
            coulomb=friction * geared.coulomb,
            viscous=friction * geared.viscous,
            ohm=resistance * geared.ohm,
        )
        log = simulate(motor, profile, rng, samples=1200, dt_s=dt_s, usual=geared)
        return diagnose(log, known, regime="operation")

    for friction in (1.0, 1.5, 8.0):  # a severe fault is none of the drive
        own = judged("reversals", friction=friction)
        assert own.verdict == ("healthy" if friction == 1.0 else "bearing")
        assert not any("otherwise" in reason for reason in own.reasons)
    otherwise = "this operating condition was not commissioned"
    for profile in ("averaged pwm", "steps"):
        healthy = judged(profile)
        assert healthy.verdict == "healthy"
        assert healthy.reasons[-1] == otherwise
        twice = judged(profile, friction=2.0)
        assert (twice.verdict, twice.severity, twice.confidence) == ("unusable", None, None)
        assert twice.reasons[0].startswith(
            f"{otherwise}: commission it, too; under a commissioned one the verdict would be that friction is up"
        )
    assert judged("averaged pwm", friction=8.0).verdict == "bearing"
    assert judged("averaged pwm", resistance=1.4).verdict == "winding"
    assert judged("steps", resistance=1.4).verdict == "unusable"


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
    words = {
        "moved must hold 3 rows of 17": (
            [[[1.0, 0.0], [0.0, 1.0]]],
            [[[1.0] * 16] * 3],
            [[[1.0] * 17] * 2] * 2,
        ),
        "values must have 4 numbers": ([1.0],),
        "log_covariance must be 4 by 4 and positive definite": (
            np.diag([1.0, 1.0, 1.0, -1.0]).tolist(),
            np.eye(3).tolist(),
            (np.eye(4) + 0.1 * np.eye(4, k=1)).tolist(),
        ),
    }
    for error, values in words.items():
        name = error.split()[0]
        first = next(
            line
            for line in text.partition("[healthy.windows.drives]")[2].splitlines()
            if line.startswith(name)
        )
        for broken in values:
            path.write_text(text.replace(first, f"{name} = {broken}"), encoding="utf-8")
            with pytest.raises(InputError, match=rf"healthy\.windows\.drives\.{error}"):
                load_motor(path)
