"""A start with what the textbook lacks: against matrix exponentials of motor and sensors, and constant brakes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr
from started_motor import driven, driven_record, step_record, step_start, values_of

from motor_env import PAPER_MOTOR
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.record import Record, mean_rise
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray

DT_S = 2e-4
TIME_S: FloatArray = np.arange(-20.0, 200.0) * DT_S
ONSET_S = 0.37 * DT_S
OHM, HENRY, TORQUE, BACK_EMF, INERTIA, DRAG = 2.18, 0.238e-3, 0.0235, 0.02352, 1.07e-6, 12e-7


def test_an_onset_at_a_sample_is_one_just_after_it() -> None:
    """A switch closer before a sample than a millionth of an interval counts as one so long before it."""
    after, at, before = (
        step_start(PAPER_MOTOR, TIME_S, late * DT_S, 12.0)[:, 0] for late in (1e-9, 0.0, -1e-9)
    )
    least = 12.0 / HENRY * 1e-6 * DT_S  # di = V / L dt
    assert (TIME_S[20], after[20]) == (0.0, 0.0)
    assert before[20] == pytest.approx(least, rel=1e-4)
    assert max(np.abs(one - after).max() for one in (at, before)) < 1.01 * least
    for late_s in (TIME_S[-1], TIME_S[-1] + DT_S):  # none yet
        assert not step_start(PAPER_MOTOR, TIME_S, late_s, 12.0).any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_running_motor_stays_where_drop_and_friction_hold_it(sign: float) -> None:
    volts = np.full(30, sign * 9.0)
    for coulomb, lag in ((1e-3, 0.0), (0.0, 1e-4)):
        beyond = {"COULOMB": coulomb, "DROP": 1.0, "LAG_I": lag, "LAG_W": 1e-3}
        got = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, **beyond)
        expected = sign * steady_state(PAPER_MOTOR, 8.0, coulomb)
        np.testing.assert_allclose(got, np.tile(expected, (30, 1)), rtol=1e-9)
        assert not driven(PAPER_MOTOR, volts, DT_S, from_rest=True, **beyond)[0].any()
    fan = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, COULOMB=1e-3, SQUARE=2e-8)
    np.testing.assert_allclose(fan, np.tile(fan[0], (30, 1)), rtol=1e-8)
    assert abs(fan[0, 1]) < 0.99 * abs(steady_state(PAPER_MOTOR, 9.0, 1e-3)[1])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("share", "is_held"), [(0.0, False), (0.999, False), (1.001, True), (9.0, True)])
def test_a_motor_that_its_friction_holds_does_not_begin_backwards(
    sign: float, share: float, is_held: bool
) -> None:
    dry = share * TORQUE * 0.7 / OHM
    begun = driven(PAPER_MOTOR, np.full(20, sign * 0.8), DT_S, from_rest=False, COULOMB=dry, DROP=0.1)
    expected = [0.7 / OHM, 0.0] if is_held else steady_state(PAPER_MOTOR, 0.7, dry)
    np.testing.assert_allclose(begun[0], sign * np.array(expected), rtol=1e-9)


def test_a_dead_zone_hides_small_currents() -> None:
    plain = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0)
    got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, ZONE=2.0)
    np.testing.assert_allclose(got[:, 0], plain[:, 0] * ndtr((plain[:, 0] - 2.0) / 0.2), rtol=1e-12)
    np.testing.assert_array_equal(got[:, 1], plain[:, 1])
    nulled = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, ZONE=2.0, OFFSET_I=0.5)
    np.testing.assert_allclose(nulled[:, 0], got[:, 0] + 0.5, rtol=1e-12)  # hidden before it is added


def rising(rise_s: float, shares: tuple[float, ...]) -> FloatArray:
    return values_of(PAPER_MOTOR, RISE=rise_s, CURVE=[share / shares[0] for share in shares[1:]])


@pytest.mark.parametrize("shares", [(0.2,) * 5, (0.1, 0.4, 0.3, 0.15, 0.05)])
def test_the_mean_of_a_supply_that_rises(shares: tuple[float, ...]) -> None:
    p = rising(1e-3, shares)
    corners = np.concatenate([[0.0], np.cumsum(shares)])
    at = np.linspace(0.0, 1e-3, 6)
    begin: FloatArray = np.arange(8.0) * 1.7e-4
    expected = [
        quad(lambda t: float(np.interp(t, at, corners)), b, b + 1.7e-4, points=at.tolist())[0] / 1.7e-4
        for b in begin
    ]
    np.testing.assert_allclose(mean_rise(p, begin, begin + 1.7e-4), expected, rtol=1e-7)
    np.testing.assert_array_equal(mean_rise(values_of(PAPER_MOTOR), begin, begin + 1.7e-4), np.ones(8))


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
    volts = driven_record(np.array([1.0, 2.0, 4.0, 8.0, 16.0]), DT_S, from_rest=True).between(late)
    np.testing.assert_allclose(volts, np.tile([1.0, *expected], (2, 1)).T)


@pytest.mark.parametrize("noise_v", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["measured", "stepped", "log"])
def test_many_motors_at_once_are_each_alone(kind: str, noise_v: float) -> None:
    """Under supplies of their own: other delays, onsets and rises; and the values that are given stay as they are."""
    rng = np.random.default_rng(6)
    readings, volts = rng.uniform(0.0, 3.0, (60, 2)), np.repeat(rng.uniform(-9.0, 9.0, 12), 5)
    if kind == "measured":
        record = replace(driven_record(volts, DT_S, from_rest=False), readings=readings, shunt_ohm=0.2)
    elif kind == "stepped":
        record = replace(step_record(TIME_S[:60], ONSET_S, 12.0), readings=readings, rectified_a=0.01)
    else:
        record = Record(DT_S, volts, readings, np.ones(2), np.eye(1, 60)[0], "straight")
    moved: list[dict[str, float]] = [
        {}, {"DELAY": -1.2, "ONSET": 1e-4}, {"ONSET": -3e-4, "RISE": 1e-3}, {"RISE": 1e-3},
        {"DELAY": 0.3, "R": 3.0, "COULOMB": 1e-3}, {"ZONE": 1.0, "LAG_I": 1e-4}, {"LAG_W": 1e-4}, {"ONSET": 1.0},
    ]  # fmt: skip
    each = np.stack([values_of(PAPER_MOTOR, **({"NOISE_V": noise_v} | one)) for one in moved])
    each[3, index.CURVE] = [2.0, 1.0, 0.5, 0.1]
    given = each.copy()
    tables, logs = record.predict_each(each)
    np.testing.assert_array_equal(each, given)
    for table, log, one in zip(tables, logs, each, strict=True):
        alone = record.predict(one)
        np.testing.assert_array_equal(table, alone[0])
        assert log == alone[1]
    assert len({table.tobytes() for table in tables}) >= (4 if kind == "log" else 5)  # a log has no delay


@pytest.mark.parametrize("from_rest", [True, False])
@pytest.mark.parametrize("seen", [[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
@pytest.mark.parametrize(
    "beyond",
    [
        {},
        {"LAG_I": 0.7 * DT_S, "LAG_W": 3.0 * DT_S},
        {"COULOMB": 2e-2, "DROP": 1.0},
        {"COULOMB": 2e-2, "DROP": 1.0, "LAG_I": 3.0 * DT_S},
        {"COULOMB": 2e-3, "LOAD": 1e-3, "LAG_W": 3.0 * DT_S},
        {"DROP": 1.0, "LOAD": -5e-3},
        {"SQUARE": 3e-8},
    ],
)
def test_a_simple_start_is_run_as_any_other(
    from_rest: bool, seen: list[float], beyond: dict[str, float]
) -> None:
    """Friction that hardly grows towards standstill takes the filter of any record, whose numbers are the same."""
    volts = np.repeat([0.0, 9.0, 0.0, -12.0, 0.4, 0.0], 150) if from_rest else np.repeat([6.0, 9.0, -3.0], 80)
    readings = np.random.default_rng(0).normal(0.0, 1.0, (len(volts), 2)) * [3.0, 300.0]
    readings[[50, 70], [0, 1]] = readings[90] = np.nan
    driven_by = replace(driven_record(volts, DT_S, from_rest=from_rest), readings=readings)
    switched = replace(step_record(TIME_S, ONSET_S, 12.0), readings=readings[: len(TIME_S)])
    given = {"NOISE_I": 0.3, "NOISE_W": 2.0, "OFFSET_I": 0.02, "OFFSET_W": -1.5} | beyond
    for record in (driven_by, switched):
        one = replace(record, recorded=np.array(seen))
        simple, any_other = (one.predict(values_of(PAPER_MOTOR, STRIBECK=x, **given)) for x in (0.0, 1e-200))
        np.testing.assert_allclose(simple[0], any_other[0], rtol=1e-9, atol=1e-12)
        assert simple[1] == pytest.approx(any_other[1], rel=1e-12)


@pytest.mark.parametrize(
    "beyond",
    [
        {"KNEE": 0.1}, {"SLIDING": 5.0}, {"STRIBECK": 0.3}, {"GEAR": 0.1}, {"SOURCE": 0.1},
        {"NOISE_V": 0.5}, {"NOISE_T": 1e-3}, {"WALK": 0.01},
    ],
)  # fmt: skip
def test_what_bends_or_disturbs_a_start_is_not_left_out(beyond: dict[str, float]) -> None:
    record = driven_record(np.repeat([0.0, 9.0, -9.0, 0.0], 100), DT_S, from_rest=True)
    noise = np.random.default_rng(0).normal(0.0, 1.0, (400, 2)) * [3.0, 300.0]
    usual, other, as_any = (
        replace(record, readings=noise).predict(values_of(PAPER_MOTOR, COULOMB=2e-3, DROP=1.0, **one))[0]
        for one in ({}, beyond, {"STRIBECK": 1e-200} | beyond)
    )
    assert np.abs(other - usual)[:, 3].max() > 0.01
    np.testing.assert_array_equal(other, as_any)
