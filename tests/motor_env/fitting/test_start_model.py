"""A start with what the textbook lacks: against matrix exponentials of motor and sensors, and constant brakes."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.special import ndtr

from motor_env import PAPER_MOTOR, discretize
from motor_env.fitting.starts import (
    Extension,
    between_samples,
    driven,
    mean_rise,
    step_start,
)
from motor_env.motor.model import continuous_model, steady_state
from motor_env.motor.parameters import FloatArray

DT_S = 2e-4
TIME_S: FloatArray = np.arange(-20.0, 200.0) * DT_S
ONSET_S = 0.37 * DT_S


def exact(time_s: FloatArray, volts: float, lag_s: float, load_n_m: float = 0.0) -> FloatArray:
    """Current, speed and the lagging reading of the current at times after a step from rest, shape (n, 3)."""
    model = continuous_model(PAPER_MOTOR)
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 3] = model.transition, model.gain @ [volts, load_n_m]
    whole[2, 0], whole[2, 2] = 1.0 / lag_s, -1.0 / lag_s
    return np.array([expm(whole * max(t, 0.0))[:3, 3] for t in time_s])


def test_a_textbook_start_begins_between_two_samples() -> None:
    got = step_start(PAPER_MOTOR, Extension(), TIME_S, ONSET_S, 12.0)
    np.testing.assert_allclose(got, exact(TIME_S - ONSET_S, 12.0, 1.0)[:, :2], rtol=1e-9, atol=1e-12)
    late = step_start(PAPER_MOTOR, Extension(), TIME_S, TIME_S[-1] + DT_S, 12.0)
    assert not late.any()
    before = step_start(PAPER_MOTOR, Extension(), TIME_S[21:], ONSET_S, 12.0)
    np.testing.assert_allclose(before[1:], got[22:], rtol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_drop_and_friction_are_a_lower_voltage_and_a_load_in_both_directions(sign: float) -> None:
    extension = Extension(coulomb_friction_n_m=2e-3, brush_drop_v=1.5, fan_n_m_s2_per_rad2=3e-8)
    got = step_start(PAPER_MOTOR, extension, TIME_S, 0.0, sign * 12.0)
    model, x = discretize(PAPER_MOTOR, DT_S), np.zeros(2)
    for row in got[21:]:
        load = 2e-3 + 3e-8 * x[1] ** 2
        x = model.transition @ x + model.gain @ [12.0 - 1.5, load]
        np.testing.assert_allclose(sign * row, x, rtol=1e-9)


def test_what_brakes_never_drives() -> None:
    """A voltage below the drop moves nothing; a torque below the friction leaves a circuit of R and L."""
    still = step_start(PAPER_MOTOR, Extension(brush_drop_v=1.0), TIME_S, 0.0, 0.99)
    assert not still.any()
    held = step_start(PAPER_MOTOR, Extension(coulomb_friction_n_m=0.0235), TIME_S, 0.0, 2.18 * 0.99)
    assert not held[:, 1].any()
    assert held[-1, 0] == pytest.approx(0.99, rel=1e-9)
    moving = step_start(PAPER_MOTOR, Extension(coulomb_friction_n_m=0.0235), TIME_S, 0.0, 2.18 * 1.01)
    assert moving[-1, 1] > 0.0


@pytest.mark.parametrize("drop_v", [0.0, 1.5])
def test_a_lagging_sensor_is_exact_from_the_onset_on(drop_v: float) -> None:
    extension = Extension(sensor_lag_s=3e-4, brush_drop_v=drop_v)
    got = step_start(PAPER_MOTOR, extension, TIME_S, ONSET_S, 12.0)[:, 0]
    np.testing.assert_allclose(got, exact(TIME_S - ONSET_S, 12.0 - drop_v, 3e-4)[:, 2], rtol=1e-9, atol=1e-12)


def test_a_lagging_sensor_of_a_running_motor_begins_in_its_steady_state() -> None:
    """A measured voltage falls from 12 to 0 V in one interval: the answer to -12 V on top of the steady state."""
    volts = np.where(np.arange(60) < 10, 12.0, 0.0)
    extension = Extension(sensor_lag_s=3e-4)
    got = driven(PAPER_MOTOR, extension, volts, DT_S, from_rest=False, late=0.5)
    current, speed = steady_state(PAPER_MOTOR, 12.0)
    since: FloatArray = (np.arange(60.0) - 10.0) * DT_S
    expected = exact(since, -12.0, 3e-4)
    np.testing.assert_allclose(got[:, 0], current + expected[:, 2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got[:, 1], speed + expected[:, 1], rtol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_running_motor_stays_where_drop_and_friction_hold_it(sign: float) -> None:
    for coulomb, lag in ((1e-3, 0.0), (0.0, 1e-4)):
        extension = Extension(coulomb, brush_drop_v=1.0, sensor_lag_s=lag, speed_lag_s=1e-3)
        got = driven(PAPER_MOTOR, extension, np.full(30, sign * 9.0), DT_S, from_rest=False)
        expected = sign * steady_state(PAPER_MOTOR, 8.0, coulomb)
        np.testing.assert_allclose(got, np.tile(expected, (30, 1)), rtol=1e-9)
    below = np.array([0.5, *[9.0] * 29])
    begun = driven(PAPER_MOTOR, Extension(brush_drop_v=1.0), sign * below, DT_S, from_rest=False)
    assert not begun[0].any()  # a voltage below the drop: no current
    rest = driven(PAPER_MOTOR, extension, np.full(30, sign * 9.0), DT_S, from_rest=True)
    assert not rest[0].any()


def test_a_lagging_speed_follows_the_means_of_its_intervals() -> None:
    plain = step_start(PAPER_MOTOR, Extension(), TIME_S, ONSET_S, 12.0)[:, 1]
    got = step_start(PAPER_MOTOR, Extension(speed_lag_s=1e-3), TIME_S, ONSET_S, 12.0)[:, 1]
    decay, shown = np.exp(-0.2), plain[0]
    for k in range(1, len(plain)):
        shown = decay * shown + (1.0 - decay) * 0.5 * (plain[k - 1] + plain[k])
        assert got[k] == pytest.approx(shown, rel=1e-9, abs=1e-12)


def test_a_dead_zone_hides_small_currents() -> None:
    plain = step_start(PAPER_MOTOR, Extension(), TIME_S, ONSET_S, 12.0)
    got = step_start(PAPER_MOTOR, Extension(dead_zone_a=2.0), TIME_S, ONSET_S, 12.0)
    np.testing.assert_allclose(got[:, 0], plain[:, 0] * ndtr((plain[:, 0] - 2.0) / 0.2), rtol=1e-12)
    np.testing.assert_array_equal(got[:, 1], plain[:, 1])


@pytest.mark.parametrize("shares", [(), (0.1, 0.4, 0.3, 0.2)])
def test_the_mean_of_a_supply_that_rises(shares: tuple[float, ...]) -> None:
    extension = Extension(supply_rise_s=1e-3, supply_shares=shares)
    corners = np.concatenate([[0.0], np.cumsum(shares or (1.0,))])
    places = np.linspace(0.0, 1e-3, len(corners))
    begin: FloatArray = np.arange(8.0) * 1.7e-4
    expected = [
        quad(lambda t: float(np.interp(t, places, corners)), b, b + 1.7e-4, points=places.tolist())[0]
        / 1.7e-4
        for b in begin
    ]
    np.testing.assert_allclose(mean_rise(extension, begin, begin + 1.7e-4), expected, rtol=1e-7)
    np.testing.assert_array_equal(mean_rise(Extension(), begin, begin + 1.7e-4), np.ones(8))


def test_a_rising_supply_drives_by_its_means() -> None:
    extension = Extension(supply_rise_s=1.3e-3)
    got = step_start(PAPER_MOTOR, extension, TIME_S, ONSET_S, 12.0)
    after = TIME_S[21:] - ONSET_S
    edges = np.concatenate([[0.0], after])
    area = np.where(edges < 1.3e-3, 0.5 * edges**2 / 1.3e-3, edges - 0.65e-3)
    x = np.zeros(2)
    for k, row in enumerate(got[21:]):
        width = edges[k + 1] - edges[k]
        model = discretize(PAPER_MOTOR, width)
        x = model.transition @ x + model.gain @ [12.0 * (area[k + 1] - area[k]) / width, 0.0]
        np.testing.assert_allclose(row, x, rtol=1e-8)


@pytest.mark.parametrize(
    ("late", "expected"),
    [
        (0.0, [1.5, 3.0, 6.0, 12.0]),
        (0.25, [1.25, 2.5, 5.0, 10.0]),
        (-0.5, [2.0, 4.0, 8.0, 16.0]),
        (1.0, [1.0, 1.5, 3.0, 6.0]),
        (0.75, [1.0, 1.75, 3.5, 7.0]),
        (-1.25, [3.5, 7.0, 14.0, 16.0]),
    ],
)
def test_where_between_two_samples_a_voltage_changes(late: float, expected: list[float]) -> None:
    """In the middle it is the mean of both; later it weighs the earlier more; beyond half it is another interval."""
    np.testing.assert_allclose(between_samples(np.array([1.0, 2.0, 4.0, 8.0, 16.0]), late), expected)
