"""Windows that move the motor otherwise than the healthy ones did: the model's error is another one there."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from motor_env import Diagnosis, InputError, diagnose, load_motor
from motor_env.diagnosis.motor_files import motor_of_windows
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.running.windows import judge_of, unlike

# Reaches in: windows are fitted by hand, and compared with covariances that no record has.
from motor_env.fitting.identify import identify_operation
from motor_env.fitting.record import Record
from motor_env.fitting.recorded import from_recordings
from motor_env.fitting.window import Scores
from motor_env.motor.data_sheet import save_motor
from motor_env.motor.healthy import Healthy

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
from operation_simulator import Motor as SimulatedMotor, draw_motor, simulate


@pytest.fixture(scope="module")
def geared() -> SimulatedMotor:
    """A motor with a gear that loses 11 % of the torque."""
    return draw_motor(np.random.default_rng([3, 1]), ("gear",))


@pytest.fixture(scope="module")
def commissioned(geared: SimulatedMotor) -> Healthy:
    rng, dt_s = np.random.default_rng(5), 0.1 * geared.mechanical_s
    healthy, _ = learn_windows([simulate(geared, "reversals", rng, samples=2400, dt_s=dt_s)], 400 * dt_s)
    return healthy


def recorded(motor: SimulatedMotor, profile: str) -> Record:
    rng = np.random.default_rng(6)
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


@pytest.mark.parametrize("variance", [0.2, 1.0, 3.0])
def test_what_windows_tell_is_compared_by_relative_entropy(variance: float) -> None:
    """Of normal distributions of one mean, by integration; that of independent quantities adds up."""
    own, other = stats.norm(0.0, math.sqrt(variance)), stats.norm()
    exact, _ = integrate.quad(lambda x: own.pdf(x) * (own.logpdf(x) - other.logpdf(x)), -15.0, 15.0)
    assert unlike(np.array([[variance]]), np.eye(1)[None]) == pytest.approx(exact, abs=1e-9)
    axes = np.array([[0.6, 0.8], [-0.8, 0.6]]) @ np.diag([2.0, 0.1])  # in any units
    far, near = (axes @ np.diag(each) @ axes.T for each in ([9.0, 9.0], [1.0, 1.0]))
    pair = axes @ np.diag([variance, 1.0]) @ axes.T
    assert unlike(pair, np.array([far, near])) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize(("nats", "times"), [(0.299, 0.0), (0.3 * math.e, 1.0), (0.3 * math.e**4, 4.0)])
def test_a_window_that_tells_otherwise_may_be_off_by_more(
    geared: SimulatedMotor, commissioned: Healthy, nats: float, times: float
) -> None:
    """By 2.5 % of R and J, 1.25 % of K and 40 % of friction at e times the entropy up to which they are alike."""
    judge = judge_of(commissioned)
    fit = judge.fitted(recorded(geared, "reversals"))
    variance = optimize.brentq(lambda v: 2.0 * (v - 1.0 - math.log(v)) - nats, 1.0, 1e3)
    taught = np.array([1e6 * np.eye(4), fit.log_covariance / variance])
    found = replace(judge, windows=replace(judge.windows, covariances=taught)).reference_for(fit, 0.01)
    more = found.log_covariance - judge.reference.log_covariance
    # Of 6 windows and the prior, at the share of one test of six: a normal quantile over one of Student's t.
    quantiles = stats.norm.ppf(0.01 / 6.0) / stats.t.ppf(0.01 / 6.0, 9.0)
    expected = np.square([0.025, 0.0125, 0.025, 0.4]) * [times, times, times, min(times, 1.0)]
    np.testing.assert_allclose(more, quantiles**2 * np.diag(expected), atol=1e-9)
    np.testing.assert_allclose(found.drive_covariance, more, atol=1e-12)
    steady = replace(judge, windows=replace(judge.windows, covariances=None))
    assert steady.reference_for(fit, 0.01) is judge.reference


def test_another_controller_hides_friction_but_for_a_lot_and_says_so(
    geared: SimulatedMotor, commissioned: Healthy
) -> None:
    rng, dt_s = np.random.default_rng(8), 0.1 * geared.mechanical_s
    known = motor_of_windows(commissioned, "it")

    def judged(profile: str, times: float) -> Diagnosis:
        motor = replace(geared, coulomb=times * geared.coulomb, viscous=times * geared.viscous)
        log = simulate(motor, profile, rng, samples=1200, dt_s=dt_s, stiffness=0.3)
        return diagnose(log, known, regime="operation")

    for times in (1.5, 2.0, 4.0, 8.0):  # a severe fault, too, changes what a window tells
        assert judged("reversals", times).verdict == "bearing"
    healthy = judged("speed loop", 1.0)
    assert healthy.verdict == "healthy"
    (undecided,) = (reason for reason in healthy.reasons if "undecided" in reason)
    assert "friction is undecided: the motor was driven otherwise when it was healthy" in undecided
    assert not any("otherwise" in reason for reason in judged("reversals", 1.0).reasons)
    # What would be a fault as the motor was driven is neither one nor healthy.
    twice = judged("speed loop", 2.0)
    assert twice.verdict == "unusable"
    assert twice.reasons[0].startswith(
        "the motor is driven otherwise than when it was healthy: commission it"
    )
    assert "friction is up and nothing else moved" in twice.reasons[0]
    assert judged("speed loop", 8.0).verdict == "bearing"
    warm = replace(geared, ohm=1.4 * geared.ohm)
    log = simulate(warm, "speed loop", rng, samples=1200, dt_s=dt_s, stiffness=0.3)
    assert diagnose(log, known, regime="operation").verdict == "winding"


def test_a_motor_file_keeps_what_windows_tell(commissioned: Healthy, tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    save_motor(motor_of_windows(commissioned, "it"), path)
    read = load_motor(path).healthy
    assert read is not None
    kept, learned = (judge_of(one).windows.covariances for one in (read, commissioned))
    assert kept is not None
    assert learned is not None
    assert kept.shape == (6, 4, 4)
    np.testing.assert_array_equal(kept, learned)
    text = path.read_text(encoding="utf-8")
    first = next(line for line in text.splitlines() if line.startswith("covariances"))
    path.write_text(text.replace(first, "covariances = [[[1.0, 0.0], [0.0, 1.0]]]"), encoding="utf-8")
    with pytest.raises(
        InputError, match=r"healthy\.windows\.covariances must be positive definite, of 4 quantities"
    ):
        load_motor(path)


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
