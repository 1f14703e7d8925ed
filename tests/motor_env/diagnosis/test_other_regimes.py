"""Windows that move the motor differently than the healthy ones did: what their fits hold may be wrong."""

import math
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.linalg import block_diag

from motor_env import InputError, diagnose, load_motor
from motor_env.diagnosis.motor_files import motor_of_windows
from motor_env.diagnosis.running import lessons
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.running.windows import FittedWindow, WindowJudge, judge_of

# Reaches in: the fit of a window is made with values of which one is wrong.
from motor_env.fitting import places
from motor_env.fitting.identify import identify_operation
from motor_env.fitting.record import Record
from motor_env.fitting.recorded import from_recordings
from motor_env.fitting.score import GEAR, behind_brushes
from motor_env.fitting.window import Scores, fit_window, moved_by_held
from motor_env.motor.data_sheet import save_motor
from motor_env.motor.healthy import Healthy, Held
from motor_env.motor.parameters import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate

TERMS = ("noise_current", "noise_speed", "noise_voltage")


@pytest.fixture(scope="module")
def geared() -> SimulatedMotor:
    """A motor with a gear that loses 11 % of the torque."""
    return draw_motor(np.random.default_rng([3, 1]), ("gear",))


@pytest.fixture(scope="module")
def commissioned(geared: SimulatedMotor) -> Healthy:
    rng, dt_s = np.random.default_rng(5), 0.1 * geared.mechanical_s
    healthy, _ = learn_windows([simulate(geared, "reversals", rng, samples=2400, dt_s=dt_s)], 400 * dt_s)
    return healthy


def recorded(motor: SimulatedMotor, profile: str, seed: int = 6) -> Record:
    rng = np.random.default_rng(seed)
    return from_recordings([simulate(motor, profile, rng, samples=400, dt_s=0.1 * motor.mechanical_s)])


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


@pytest.mark.parametrize("profile", ["reversals", "speed loop"])
def test_a_fit_moves_as_said_where_what_it_holds_is_wrong(
    geared: SimulatedMotor, commissioned: Healthy, profile: str
) -> None:
    judge = judge_of(commissioned)
    known, peaks = judge.physical(), judge.peaks
    record = replace(recorded(geared, profile), hold=judge.windows.hold)
    held, sizes = [places.GEAR, places.COULOMB], known[[places.GEAR, places.COULOMB]] * 0.05
    errors = np.zeros((4, 5))
    errors[0, 0], errors[1, 1], errors[2, 3], errors[3, 4] = *sizes, 0.1, 0.1
    moves = moved_by_held(record, known, TERMS, peaks=peaks, held=held, errors=errors)

    def fitted(record: Record, **off: float) -> FloatArray:
        values = known.copy()
        for name, value in off.items():
            values[getattr(places, name)] += value
        return fit_window(record, values, TERMS).logs

    current = record.predict(known, learn=False)[0][:, 2] - known[places.OFFSET_I]
    stall = peaks[0] / known[places.R]
    lost = record.voltage_v - behind_brushes(record, current, peaks[0], 0.1 * stall).voltage_v
    behind = replace(record, voltage_v=record.voltage_v - 0.1 * lost)
    refitted = [
        fitted(record, GEAR=sizes[0]) - fitted(record),
        fitted(record, COULOMB=sizes[1]) - fitted(record),
        fitted(behind) - fitted(record),
        np.zeros(4),  # a gear is not lacked where it is a term
    ]
    # To first order. K and J share what a reversal tells: there one step of a fit is 0.8 % off, on some processors.
    np.testing.assert_allclose(moves, refitted, rtol=0.35, atol=1e-2)
    for own, atol in ((0, 2e-3), (3, 8e-3)):
        np.testing.assert_allclose(moves[:, own], np.array(refitted)[:, own], rtol=0.35, atol=atol)
    # Of a motor that was fitted without its gear.
    toothless = known.copy()
    toothless[places.GEAR] = 0.0
    toothless[[places.R, places.K, places.J, places.DRAG]] = np.exp(fit_window(record, toothless, TERMS).logs)
    toothed = toothless.copy()
    toothed[places.GEAR] = 0.5 * GEAR  # small ones get lost where the fits have kinks
    lacked = moved_by_held(record, toothless, TERMS, peaks=peaks, held=held, errors=5.0 * errors[3:])[0]
    ends = [fit_window(record, known, TERMS).logs for known in (toothless, toothed)]
    np.testing.assert_allclose(lacked, ends[1] - ends[0], rtol=0.35, atol=4e-3)
    assert lacked[3] < -0.01
    # The same motor, whose friction is twice that of other values.
    twice = known.copy()
    twice[places.DRAG] *= 2.0
    twice[[places.B, places.COULOMB]] /= 2.0
    errors[1, 1] /= 2.0
    same = moved_by_held(record, twice, TERMS, peaks=peaks, held=held, errors=errors)
    np.testing.assert_allclose(same, moves, rtol=0.02, atol=1e-4)


def test_windows_of_the_same_regime_are_compared_as_closely_as_before(
    geared: SimulatedMotor, commissioned: Healthy
) -> None:
    judge = judge_of(commissioned)
    sds = {}
    for profile in ("reversals", "speed loop"):
        record = recorded(geared, profile)
        fit = judge.fitted(record)
        sds[profile] = np.sqrt(np.diag(judge.reference_for(record, fit).log_covariance))
        unheld = replace(judge, windows=replace(judge.windows, held=None))
        assert unheld.reference_for(record, fit) is judge.reference
        wrong = replace(fit, robust_covariance=np.diag([1.0, 0.0, 0.0, 0.0]))
        assert judge.reference_for(record, wrong).log_covariance[0, 0] == pytest.approx(1.0, rel=0.01)
        # Healthy windows that were explained as badly scatter by no more than they do.
        assert judge.windows.held is not None
        used = replace(judge.windows.held, robust_covariance=wrong.robust_covariance)
        to_it = replace(judge, windows=replace(judge.windows, held=used))
        exact = replace(fit, robust_covariance=np.zeros((4, 4)))
        np.testing.assert_allclose(
            to_it.reference_for(record, wrong).log_covariance,
            judge.reference_for(record, exact).log_covariance,
            atol=1e-12,
        )
    learned = np.sqrt(np.diag(judge.reference.log_covariance))
    assert np.all(sds["reversals"] < [1.3, 1.3, 1.8, 3.0] * learned)
    assert sds["speed loop"][3] > 1.2 * sds["reversals"][3]


def test_a_healthy_motor_is_healthy_under_another_controller(
    geared: SimulatedMotor, commissioned: Healthy
) -> None:
    rng, dt_s = np.random.default_rng(8), 0.1 * geared.mechanical_s
    known = motor_of_windows(commissioned, "it")
    stuck = replace(geared, coulomb=4.0 * geared.coulomb, viscous=4.0 * geared.viscous)
    for stiffness in (1.0, 0.3):
        log = simulate(geared, "speed loop", rng, samples=1200, dt_s=dt_s, stiffness=stiffness)
        assert diagnose(log, known, regime="operation").verdict == "healthy"
        log = simulate(stuck, "speed loop", rng, samples=1200, dt_s=dt_s, stiffness=stiffness)
        assert diagnose(log, known, regime="operation").verdict == "bearing"


def test_windows_that_move_differently_tell_what_they_hold(
    commissioned: Healthy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The posterior of the errors, by conditioning their joint normal distribution with all fits at once."""
    judge, rng = judge_of(commissioned), np.random.default_rng(2)
    spread, units = np.array([[4e-4, 1e-4], [1e-4, 9e-4]]), (2e-3, 0.5)
    free = [
        SimpleNamespace(name="R", place=places.R, unit=3.0),
        SimpleNamespace(name="coulomb", place=places.COULOMB, unit=units[0]),
        SimpleNamespace(name="gear_loss", place=places.GEAR, unit=units[1]),
        SimpleNamespace(name="delay", place=places.DELAY, unit=1.0),  # there is none
    ]
    joint_covariance = np.diag([1e-6, 0.0, 0.0, 1.0])
    joint_covariance[1:3, 1:3] = spread
    solution = SimpleNamespace(problem=SimpleNamespace(free=free, names=[one.name for one in free]))
    joint: Any = SimpleNamespace(solution=solution, covariance=joint_covariance)
    slopes = [0.1 * rng.standard_normal((5, 4)) for _ in range(5)]  # of two values, two brushes and a gear
    ratios = [0.01 * rng.standard_normal(4) for _ in range(5)]
    noises = [np.diag(rng.uniform(1e-4, 1e-3, 4)) for _ in range(5)]
    scale = np.diag([1.0 / units[0], 1.0 / units[1], 1.0, 1.0, 1.0])
    queue = iter(slopes)  # errors are in SI
    monkeypatch.setattr(WindowJudge, "moved", lambda *given: given[-1] @ scale @ next(queue))
    found = [
        FittedWindow(judge.reference.log_values + ratio, np.eye(4), robust_covariance=(n + 1) * np.eye(4))
        for n, ratio in enumerate(ratios)
    ]
    held = lessons._held(joint, cast("Any", [None] * 5), judge, found, noises)
    np.testing.assert_allclose(held.robust_covariance, 3.0 * np.eye(4))
    assert held.places == (places.COULOMB, places.GEAR)
    prior, middle = block_diag(spread, np.eye(3)), np.mean(slopes, axis=0)
    design = np.concatenate([(slope - middle).T for slope in slopes])
    noise = block_diag(*noises)
    gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + noise)
    left, mean = prior - gain @ design @ prior, gain @ np.concatenate(ratios)
    second = scale @ held.errors.T @ held.errors @ scale
    np.testing.assert_allclose(second, left + np.outer(mean, mean), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(held.moves, held.errors @ scale @ middle, rtol=1e-9, atol=1e-12)


def test_tables_of_what_is_held_go_together() -> None:
    Held((0, 1), np.zeros((3, 5)), np.zeros((3, 4)), np.zeros((4, 4)))
    for covariance in (np.zeros((3, 3)), -np.eye(4)):
        with pytest.raises(ValueError, match="must be a covariance of 4 quantities"):
            Held((0, 1), np.zeros((3, 5)), np.zeros((3, 4)), covariance)
    for errors, moves in ((np.zeros((3, 4)), np.zeros((3, 4))), (np.zeros((3, 5)), np.zeros((3, 5)))):
        with pytest.raises(ValueError, match="errors must go with them and with places"):
            Held((0, 1), errors, moves, np.zeros((4, 4)))


def test_a_fault_does_not_hide_behind_what_is_held(geared: SimulatedMotor, commissioned: Healthy) -> None:
    """Fits of a motor with twice the friction move as those of the healthy one."""
    judge = judge_of(commissioned)
    sds = []
    for factor in (1.0, 2.0):
        motor = replace(geared, coulomb=factor * geared.coulomb, viscous=factor * geared.viscous)
        record = recorded(motor, "reversals")
        fit = judge.fitted(record)
        exact = replace(fit, robust_covariance=np.zeros((4, 4)))
        sds.append(math.sqrt(judge.reference_for(record, exact).log_covariance[3, 3]))
        assert fit.log_values[3] - judge.reference.log_values[3] == pytest.approx(math.log(factor), abs=0.1)
    assert sds[1] < 1.5 * sds[0]


def test_a_motor_file_keeps_what_is_held(commissioned: Healthy, tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    save_motor(motor_of_windows(commissioned, "it"), path)
    read = load_motor(path).healthy
    assert read is not None
    windows = [judge_of(one).windows for one in (read, commissioned)]
    held = [one.held for one in windows if one.held is not None]
    assert held[0].places == held[1].places
    np.testing.assert_array_equal(held[0].errors, held[1].errors)
    np.testing.assert_array_equal(held[0].moves, held[1].moves)
    np.testing.assert_array_equal(held[0].robust_covariance, held[1].robust_covariance)


def test_a_motor_file_that_holds_no_value_of_the_fit_is_refused(commissioned: Healthy) -> None:
    windows = judge_of(commissioned).windows
    for place, is_refused in ((places.N_VALUES - 1, False), (places.N_VALUES, True)):
        held = Held((place,), np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((4, 4)))
        other = replace(commissioned, windows=replace(windows, held=held))
        with (
            pytest.raises(InputError, match=r"held\.places must be below 34, got 34")
            if is_refused
            else nullcontext()
        ):
            judge_of(other)


def test_a_load_that_a_section_says_nothing_of_stays_as_it_is_known() -> None:
    """As an offset of the current while the circuit is open: nothing is believed of it beforehand either."""
    information = np.diag([4.0, 4.0, 4.0, 4.0, 0.0])[None]
    steps, spread = Scores(np.array([[1.0, 2.0, 3.0, 4.0, 0.0]]), information, np.zeros(5)).steps()
    np.testing.assert_allclose(steps, [[-0.25, -0.5, -0.75, -1.0]])
    np.testing.assert_allclose(spread[0], 0.25 * np.eye(4))


def test_a_piece_that_tells_one_thing_alone_has_errors_to_reckon_with() -> None:
    """As at standstill, under a voltage that is nearly exact: of all but one combination it says nothing."""
    told = np.array([3.0, 1.0, 2.0, 1.0, 5.0]) * 1e8
    steps, spread = Scores(-told[None], np.outer(told, told)[None], np.full(5, 0.01)).steps()
    np.linalg.cholesky(spread)
    assert np.abs(steps).max() < 1.0
    assert np.sqrt(np.diag(spread[0])).min() > 1e-5
