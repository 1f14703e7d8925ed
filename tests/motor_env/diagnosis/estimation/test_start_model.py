"""A start with what the textbook lacks: against matrix exponentials of motor and sensors, and constant brakes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm
from scipy.special import ndtr
from started_motor import driven, driven_record, step_record, step_start, values_of

from motor_env import PAPER_MOTOR, discretize
from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.record import Record, mean_rise
from motor_env.motor.model import continuous_model, steady_state
from motor_env.motor.parameters import FloatArray

DT_S = 2e-4
TIME_S: FloatArray = np.arange(-20.0, 200.0) * DT_S
ONSET_S = 0.37 * DT_S
OHM, HENRY, TORQUE, BACK_EMF, INERTIA, DRAG = 2.18, 0.238e-3, 0.0235, 0.02352, 1.07e-6, 12e-7


def exact(time_s: FloatArray, volts: float, lag_s: float, load_n_m: float = 0.0) -> FloatArray:
    """Current, speed and the lagging reading of the current at times after a step from rest, shape (n, 3)."""
    model = continuous_model(PAPER_MOTOR)
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 3] = model.transition, model.gain @ [volts, load_n_m]
    whole[2, 0], whole[2, 2] = 1.0 / lag_s, -1.0 / lag_s
    return np.array([expm(whole * max(t, 0.0))[:3, 3] for t in time_s])


@pytest.mark.parametrize("share", [1e-5, 0.01, 0.37, 0.9, 0.99999, 1.0, 1.3])
def test_a_textbook_start_begins_between_two_samples(share: float) -> None:
    """The first interval, shorter than the others, is one of its own; also where it ends at the first sample."""
    onset_s = share * DT_S
    got = step_start(PAPER_MOTOR, TIME_S, onset_s, 12.0)
    expected = exact(TIME_S - onset_s, 12.0, 1.0)[:, :2]
    size = 1e-12 if share != 1.0 else 2e-6 * expected.max(axis=0)  # at a sample, but for rounding
    np.testing.assert_array_less(np.abs(got - expected), size + 1e-8 * np.abs(expected))
    later = int(np.searchsorted(TIME_S, onset_s, side="right"))
    before = step_start(PAPER_MOTOR, TIME_S[later + 3 :], onset_s, 12.0)
    np.testing.assert_allclose(before, expected[later + 3 :], rtol=1e-8)


def test_a_start_that_comes_after_the_last_sample_is_none() -> None:
    for onset_s in (TIME_S[-1], TIME_S[-1] + DT_S):
        assert not step_start(PAPER_MOTOR, TIME_S, onset_s, 12.0).any()
    last = step_start(PAPER_MOTOR, TIME_S, TIME_S[-1] - 0.25 * DT_S, 12.0)
    assert not last[:-1].any()
    np.testing.assert_allclose(last[-1], exact(np.array([0.25 * DT_S]), 12.0, 1.0)[0, :2], rtol=1e-8)


def test_an_onset_at_a_sample_is_one_just_after_it() -> None:
    """A switch closer before a sample than a millionth of an interval counts as one so long before it."""
    just_after, at, just_before = (
        step_start(PAPER_MOTOR, TIME_S, late * DT_S, 12.0) for late in (1e-9, 0.0, -1e-9)
    )
    assert TIME_S[20] == 0.0
    assert not just_after[20].any()
    least = 12.0 / HENRY * 1e-6 * DT_S  # di = V / L dt
    assert just_before[20, 0] == pytest.approx(least, rel=1e-4)
    assert least < 2e-6 * just_after[:, 0].max()
    for one in (at, just_before):
        assert np.abs(one - just_after)[:, 0].max() < 1.01 * least


def test_the_onset_is_fitted_about_that_of_the_record() -> None:
    record = step_record(TIME_S, ONSET_S, 12.0)
    for later in (-3.6, -0.3, 0.4, 2.8):
        got = record.predict(values_of(PAPER_MOTOR, ONSET=later * DT_S), learn=False)[0][:, 2:4]
        np.testing.assert_allclose(
            got, exact(TIME_S - ONSET_S - later * DT_S, 12.0, 1.0)[:, :2], rtol=1e-8, atol=1e-12
        )


def braked(time_s: FloatArray, volts: float, dry: float, fan: float, drop: float) -> FloatArray:
    """Current and speed of a motor that stands until its torque breaks it away, then an exact solver."""
    held_s = -HENRY / OHM * math.log(1.0 - OHM * dry / TORQUE / (volts - drop))

    def slope(_: float, x: FloatArray) -> FloatArray:
        torque = TORQUE * x[0] - DRAG * x[1] - dry - fan * x[1] ** 2
        return np.array([(volts - drop - OHM * x[0] - BACK_EMF * x[1]) / HENRY, torque / INERTIA])

    moving = time_s[time_s > held_s]
    run = solve_ivp(
        slope, (held_s, moving[-1]), [dry / TORQUE, 0.0], "LSODA", t_eval=moving, rtol=1e-10, atol=1e-12
    )
    before = (volts - drop) / OHM * -np.expm1(-OHM / HENRY * np.maximum(time_s[time_s <= held_s], 0.0))
    return np.vstack([np.stack([before, np.zeros_like(before)], axis=1), run.y.T])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("dry", "fan"), [(0.0, 0.0), (2e-3, 0.0), (0.0, 3e-8), (2e-3, 3e-8)])
def test_drop_and_friction_are_a_lower_voltage_and_a_load_in_both_directions(
    sign: float, dry: float, fan: float
) -> None:
    """Dry friction holds the motor for a part of the first interval, which is found to a sixteenth of it."""
    got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, sign * 12.0, COULOMB=dry, DROP=1.5, SQUARE=fan)
    expected = braked(TIME_S - ONSET_S, 12.0, dry, fan, 1.5)
    peaks = expected.max(axis=0)
    np.testing.assert_allclose(sign * got / peaks, expected / peaks, atol=1e-5 if dry + fan > 0.0 else 1e-9)


def test_what_brakes_never_drives() -> None:
    """A voltage below the drop moves nothing; a torque below the friction leaves a circuit of R and L."""
    still = step_start(PAPER_MOTOR, TIME_S, 0.0, 0.99, DROP=1.0)
    assert not still.any()
    held = step_start(PAPER_MOTOR, TIME_S, 0.0, OHM * 0.99, COULOMB=TORQUE)
    assert not held[:, 1].any()
    after = np.maximum(TIME_S, 0.0)
    np.testing.assert_allclose(held[:, 0], -0.99 * np.expm1(-OHM / HENRY * after), atol=1e-5)
    assert held[-1, 0] == pytest.approx(0.99, rel=1e-9)
    moving = step_start(PAPER_MOTOR, TIME_S, 0.0, OHM * 1.01, COULOMB=TORQUE)
    assert moving[-1, 1] > 0.0


@pytest.mark.parametrize("drop_v", [0.0, 1.5])
def test_a_lagging_sensor_is_exact_from_the_onset_on(drop_v: float) -> None:
    got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_I=3e-4, DROP=drop_v)[:, 0]
    np.testing.assert_allclose(got, exact(TIME_S - ONSET_S, 12.0 - drop_v, 3e-4)[:, 2], rtol=1e-9, atol=1e-12)


def test_a_lag_that_a_fit_hardly_needs_costs_no_digits() -> None:
    """A lag moves the current by itself times di/dt; one below a millionth of an interval no more than that."""
    plain = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0)[:, 0]
    for share in (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13):
        got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_I=share * DT_S)[:, 0]
        most = max(share, 1.01e-6) * DT_S * 12.0 / HENRY
        assert np.abs(got - plain).max() < most


def test_a_lagging_sensor_of_a_running_motor_begins_in_its_steady_state() -> None:
    """A measured voltage falls from 12 to 0 V in one interval: the answer to -12 V on top of the steady state."""
    volts = np.where(np.arange(60) < 10, 12.0, 0.0)
    got = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, LAG_I=3e-4, DELAY=0.5)
    current, speed = steady_state(PAPER_MOTOR, 12.0)
    since: FloatArray = (np.arange(60.0) - 10.0) * DT_S
    expected = exact(since, -12.0, 3e-4)
    np.testing.assert_allclose(got[:, 0], current + expected[:, 2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got[:, 1], speed + expected[:, 1], rtol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_running_motor_stays_where_drop_and_friction_hold_it(sign: float) -> None:
    for coulomb, lag in ((1e-3, 0.0), (0.0, 1e-4)):
        beyond = {"COULOMB": coulomb, "DROP": 1.0, "LAG_I": lag, "LAG_W": 1e-3}
        got = driven(PAPER_MOTOR, np.full(30, sign * 9.0), DT_S, from_rest=False, **beyond)
        expected = sign * steady_state(PAPER_MOTOR, 8.0, coulomb)
        np.testing.assert_allclose(got, np.tile(expected, (30, 1)), rtol=1e-9)
    fan = driven(PAPER_MOTOR, np.full(30, sign * 9.0), DT_S, from_rest=False, COULOMB=1e-3, SQUARE=2e-8)
    np.testing.assert_allclose(fan, np.tile(fan[0], (30, 1)), rtol=1e-8)
    assert abs(fan[0, 1]) < 0.99 * abs(steady_state(PAPER_MOTOR, 9.0, 1e-3)[1])
    below = np.array([0.5, *[9.0] * 29])
    begun = driven(PAPER_MOTOR, sign * below, DT_S, from_rest=False, DROP=1.0)
    assert not begun[0].any()  # a voltage below the drop: no current
    rest = driven(PAPER_MOTOR, np.full(30, sign * 9.0), DT_S, from_rest=True, **beyond)
    assert not rest[0].any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_that_its_friction_holds_does_not_begin_backwards(sign: float) -> None:
    """Its current is that of the voltage over R; without dry friction a voltage as small turns it."""
    volts = np.full(20, sign * 0.8)
    held = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, COULOMB=TORQUE, DROP=0.1)
    np.testing.assert_allclose(held, np.tile([sign * 0.7 / OHM, 0.0], (20, 1)), rtol=1e-9)
    turns = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, DROP=0.1)
    np.testing.assert_allclose(turns[0], sign * steady_state(PAPER_MOTOR, 0.7), rtol=1e-9)
    # On either side of what it just holds.
    torque = TORQUE * 0.8 / OHM
    for share, is_held in ((0.999, False), (1.001, True)):
        begun = driven(PAPER_MOTOR, volts, DT_S, from_rest=False, COULOMB=share * torque)[0, 1]
        assert bool(begun == 0.0) is is_held
        assert begun * sign >= 0.0


@pytest.mark.parametrize("lag_s", [1e-5, 1e-3, 0.1])
def test_a_lagging_speed_follows_straight_lines_between_the_samples(lag_s: float) -> None:
    """A sensor of the first order, its input by quadrature; the first interval is that from the onset on."""
    plain = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0)[:, 1]
    got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_W=lag_s)[:, 1]
    shown = 0.0
    assert not got[:21].any()
    for k in range(21, len(plain)):
        width = TIME_S[k] - ONSET_S if k == 21 else DT_S
        before, rise = plain[k - 1], (plain[k] - plain[k - 1]) / width

        def entering(left: float, before: float = before, rise: float = rise, width: float = width) -> float:
            return float((before + rise * (width - left)) * math.exp(-left / lag_s) / lag_s)

        shown *= math.exp(-width / lag_s)
        shown += quad(entering, 0.0, width, points=[min(5.0 * lag_s, 0.5 * width)])[0]
        assert got[k] == pytest.approx(shown, rel=1e-9, abs=1e-12)


def test_both_sensors_lag_without_each_other() -> None:
    both = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_I=3e-4, LAG_W=1e-3)
    current = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_I=3e-4)
    speed = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, LAG_W=1e-3)
    np.testing.assert_allclose(both, np.stack([current[:, 0], speed[:, 1]], axis=1), rtol=1e-12)


def test_a_dead_zone_hides_small_currents() -> None:
    plain = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0)
    got = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, ZONE=2.0)
    np.testing.assert_allclose(got[:, 0], plain[:, 0] * ndtr((plain[:, 0] - 2.0) / 0.2), rtol=1e-12)
    np.testing.assert_array_equal(got[:, 1], plain[:, 1])
    nulled = step_start(PAPER_MOTOR, TIME_S, ONSET_S, 12.0, ZONE=2.0, OFFSET_I=0.5)
    np.testing.assert_allclose(nulled[:, 0], got[:, 0] + 0.5, rtol=1e-12)  # hidden before it is added


def test_innovations_of_a_sensor_that_hides_are_of_what_it_shows() -> None:
    record = step_record(TIME_S, ONSET_S, 12.0)
    rng = np.random.default_rng(3)
    record.readings[:, 0], record.readings[:, 1] = rng.uniform(0.0, 3.0, (2, len(TIME_S)))
    record.readings[7, 0] = np.nan
    p = values_of(PAPER_MOTOR, ZONE=2.0, OFFSET_I=0.1, NOISE_I=0.02)
    out = replace(record, rectified_a=0.01).predict(p)[0]
    np.testing.assert_allclose(
        out[:, 0], np.nan_to_num((record.readings[:, 0] - out[:, 2]) / 0.02), rtol=1e-12
    )
    assert out[7, 0] == 0.0
    assert out[:20, 2] == pytest.approx(np.full(20, 0.1 + 0.01 / math.sqrt(2.0 * math.pi)))


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


@pytest.mark.parametrize("onset_s", [ONSET_S, 0.0, -0.4 * DT_S])
def test_a_rising_supply_drives_by_its_means(onset_s: float) -> None:
    got = step_start(PAPER_MOTOR, TIME_S, onset_s, 12.0, RISE=1.3e-3)
    first = int(np.searchsorted(TIME_S, onset_s, side="right"))
    after = TIME_S[first:] - onset_s
    edges = np.concatenate([[0.0], after])
    area = np.where(edges < 1.3e-3, 0.5 * edges**2 / 1.3e-3, edges - 0.65e-3)
    x, rounding = np.zeros(2), 2e-6 if onset_s == 0.0 else 1e-8
    for k, row in enumerate(got[first:]):
        width = edges[k + 1] - edges[k]
        model = discretize(PAPER_MOTOR, width)
        x = model.transition @ x + model.gain @ [12.0 * (area[k + 1] - area[k]) / width, 0.0]
        np.testing.assert_allclose(row, x, rtol=rounding)


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
def test_many_motors_at_once_are_each_alone(noise_v: float) -> None:
    """Under supplies of their own: other delays, onsets and rises; and the values that are given stay as they are."""
    rng = np.random.default_rng(6)
    readings = rng.uniform(0.0, 3.0, (60, 2))
    volts: FloatArray = np.repeat(rng.uniform(-9.0, 9.0, 12), 5)
    measured = replace(driven_record(volts, DT_S, from_rest=False), readings=readings, shunt_ohm=0.2)
    stepped = replace(step_record(TIME_S[:60], ONSET_S, 12.0), readings=readings, rectified_a=0.01)
    log = Record(DT_S, volts, readings, np.ones(2), np.eye(1, 60)[0], "straight")
    moved: list[dict[str, float]] = [
        {}, {"DELAY": 0.3}, {"DELAY": -1.2, "ONSET": 1e-4}, {"ONSET": -3e-4, "RISE": 1e-3}, {"RISE": 1e-3},
        {"DELAY": 0.3, "R": 3.0, "COULOMB": 1e-3}, {"ZONE": 1.0, "LAG_I": 1e-4}, {"LAG_W": 1e-4}, {"ONSET": 1.0},
    ]  # fmt: skip
    each = np.stack([values_of(PAPER_MOTOR, **({"NOISE_V": noise_v} | one)) for one in moved])
    each[4, index.CURVE] = [2.0, 1.0, 0.5, 0.1]
    given = each.copy()
    for record in (measured, stepped, log):
        tables, logs = record.predict_each(each)
        np.testing.assert_array_equal(each, given)
        alone = [record.predict(one) for one in each]
        np.testing.assert_array_equal(tables, [table for table, _ in alone])
        np.testing.assert_array_equal(logs, [one for _, one in alone])
        assert len({table.tobytes() for table in tables}) >= (4 if record is log else 6)  # a log has no delay


@pytest.mark.parametrize("from_rest", [True, False])
@pytest.mark.parametrize("speed_lag_s", [0.0, 3.0 * DT_S])
@pytest.mark.parametrize(
    "beyond",
    [
        {},
        {"LAG_I": 0.7 * DT_S},
        {"COULOMB": 2e-2, "DROP": 1.0},
        {"COULOMB": 2e-2, "DROP": 1.0, "LAG_I": 3.0 * DT_S},
        {"COULOMB": 2e-3, "LOAD": 1e-3},
        {"DROP": 1.0, "LOAD": -5e-3},
        {"SQUARE": 3e-8},
    ],
)
def test_a_simple_start_is_run_as_any_other(
    from_rest: bool, speed_lag_s: float, beyond: dict[str, float]
) -> None:
    """Friction that hardly grows towards standstill takes the filter of any record, whose numbers are the same."""
    rng = np.random.default_rng(0)
    volts = np.repeat([0.0, 9.0, 0.0, -12.0, 0.4, 0.0], 150) if from_rest else np.repeat([6.0, 9.0, -3.0], 80)
    readings = rng.normal(0.0, 1.0, (len(volts), 2)) * [3.0, 300.0]
    readings[[50, 70], [0, 1]] = np.nan
    readings[90] = np.nan
    record = replace(driven_record(volts, DT_S, from_rest=from_rest), readings=readings)
    sensors = {"NOISE_I": 0.3, "NOISE_W": 2.0, "OFFSET_I": 0.02, "OFFSET_W": -1.5, "LAG_W": speed_lag_s}
    for seen in ([1.0, 1.0], [1.0, 0.0], [0.0, 1.0]):
        for switched in (
            record,
            replace(step_record(TIME_S, ONSET_S, 12.0), readings=readings[: len(TIME_S)]),
        ):
            one = replace(switched, recorded=np.array(seen))
            simple = one.predict(values_of(PAPER_MOTOR, **sensors, **beyond))
            any_other = one.predict(values_of(PAPER_MOTOR, STRIBECK=1e-200, **sensors, **beyond))
            np.testing.assert_allclose(simple[0], any_other[0], rtol=1e-9, atol=1e-12)
            assert simple[1] == pytest.approx(any_other[1], rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value"), [("KNEE", 0.1), ("SLIDING", 5.0), ("STRIBECK", 0.3), ("GEAR", 0.1), ("SOURCE", 0.1)]
)
def test_what_bends_a_start_is_not_left_out(name: str, value: float) -> None:
    volts = np.repeat([0.0, 9.0, -9.0, 0.0], 100)
    usual, bent, as_any = (
        driven(PAPER_MOTOR, volts, DT_S, from_rest=True, COULOMB=2e-3, DROP=1.0, **beyond)
        for beyond in ({}, {name: value}, {"STRIBECK": 1e-200, name: value})
    )
    assert np.abs(bent - usual)[:, 1].max() > 0.01
    np.testing.assert_array_equal(bent, as_any)


@pytest.mark.parametrize(("name", "value"), [("NOISE_V", 0.5), ("NOISE_T", 1e-3), ("WALK", 0.01)])
def test_a_start_that_something_disturbs_is_filtered(name: str, value: float) -> None:
    record = driven_record(np.full(200, 9.0), DT_S, from_rest=True)
    readings = np.random.default_rng(0).normal(0.0, 1.0, (200, 2)) * [3.0, 300.0]
    record = replace(record, readings=readings)
    free, filtered = (record.predict(values_of(PAPER_MOTOR, **beyond))[0] for beyond in ({}, {name: value}))
    assert np.abs(filtered - free)[:, 3].max() > 1.0


def test_an_open_circuit_carries_no_current_in_a_start_either() -> None:
    record = driven_record(np.full(100, 9.0), DT_S, from_rest=True)
    record.marks[60:] = ekf.OPEN
    current = record.predict(values_of(PAPER_MOTOR), learn=False)[0][:, 2]
    assert current[50] > 0.1
    assert not current[62:].any()
