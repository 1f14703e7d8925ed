"""The compiled filter of a motor at work against a stiff solver, a textbook filter, closed forms, and at standstill."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
import recorded_motor
from recorded_motor import DT_S, plain
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from motor_env import MotorParameters, discretize
from motor_env.diagnosis.estimation import ekf, integrator, parameter_index as index
from motor_env.diagnosis.estimation.preprocessing import open_circuit
from motor_env.diagnosis.estimation.record import HOLDS, Hold, Record
from motor_env.motor.parameters import FloatArray


def values(**given: float) -> FloatArray:
    """A small motor without dry friction, with what is given."""
    return recorded_motor.values(**({"COULOMB": 0.0, "NOISE_I": 1e-3, "NOISE_W": 0.1} | given))


def free_run(p: FloatArray, voltage: FloatArray) -> FloatArray:
    """Current and speed of the model without readings."""
    return plain(len(voltage), voltage).predict(p, learn=False)[0][:, 2:4]


def solved(p: FloatArray, voltage: FloatArray) -> FloatArray:
    """The same by an implicit solver, friction and drop with a knee, steep where there is none."""
    k = index

    def slope(_: float, x: FloatArray, volts: float) -> list[float]:
        dry = (
            (p[k.COULOMB] + p[k.GEAR] * p[k.K] * abs(x[0])) * x[1] / math.hypot(x[1], max(p[k.SLIDING], 0.01))
        )
        friction = dry + p[k.B] * x[1] + p[k.SQUARE] * x[1] * abs(x[1]) + p[k.LOAD]
        drop = p[k.DROP] * x[0] / math.hypot(x[0], max(p[k.KNEE], 1e-4))
        return [(volts - p[k.R] * x[0] - p[k.K] * x[1] - drop) / p[k.L], (p[k.K] * x[0] - friction) / p[k.J]]

    states = [np.zeros(2)]
    for volts in voltage[:-1]:
        run = solve_ivp(slope, (0.0, DT_S), states[-1], "LSODA", args=(volts,), rtol=1e-7, atol=1e-9)
        states.append(run.y[:, -1])
    return np.array(states)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"COULOMB": 0.004},
        {"COULOMB": 0.004, "DROP": 0.4},
        {"COULOMB": 0.004, "SLIDING": 5.0, "DROP": 0.4, "KNEE": 0.05},
        {"LOAD": 0.01, "COULOMB": 0.002},
        {"SQUARE": 2e-7},
        {"GEAR": 0.15},
        {"GEAR": 0.15, "COULOMB": 0.004, "SLIDING": 5.0},
    ],
)
def test_free_model_follows_a_stiff_solver(given: dict[str, float]) -> None:
    p = values(**given)
    voltage = np.repeat([0.0, 6.0, -4.0, 0.5, 8.0, 0.0], 40)
    expected, got = solved(p, voltage), free_run(p, voltage)
    assert np.all(np.abs(got - expected).max(axis=0) < 0.02 * np.abs(expected).max(axis=0))


def test_where_current_and_speed_hardly_move_beside_their_knees_one_part_is_enough() -> None:
    p = values(COULOMB=0.004, SLIDING=60.0, DROP=0.4, KNEE=0.3)
    voltage = 3.0 * np.sin(2.0 * np.pi * np.arange(700) / 700.0)
    expected, got = solved(p, voltage), free_run(p, voltage)
    for column, knee in zip(expected.T, (0.3, 60.0), strict=True):
        assert np.abs(np.diff(column)).max() < 0.1 * knee < np.abs(column).max()
    assert np.all(np.abs(got - expected).max(axis=0) < 0.01 * np.abs(expected).max(axis=0))


@pytest.mark.parametrize(
    ("least", "change", "parts"),
    [
        (5.1, 9.0, 0),
        (5.0, 0.1, 1),
        (4.0, 0.11, integrator.COARSE),
        (-1.0, 1.0, integrator.COARSE),
        (1.0, 1.1, integrator.FINE),
        (1.1, 9.0, integrator.COARSE),
    ],
)
def test_an_interval_is_taken_in_as_many_parts_as_its_knee_asks_for(
    least: float, change: float, parts: int
) -> None:
    for knee in (0.5, 1.0):
        assert integrator._parts.py_func(least * knee, change * knee, knee) == parts
    assert integrator._parts.py_func(0.0, 1e-9, 0.0) == integrator.FINE  # without a knee it turns at once
    assert integrator._parts.py_func(1e-9, 1.0, 0.0) == 0


@pytest.mark.parametrize("sliding", [0.0, 5.0])
def test_a_coasting_motor_that_its_load_turns_back_follows_a_stiff_solver(sliding: float) -> None:
    p = values(COULOMB=0.001, SLIDING=sliding, LOAD=0.003, SQUARE=2e-7)
    n = 60
    readings, marks = np.zeros((n, 2)), np.full(n, ekf.OPEN)
    readings[0, 1], marks[0] = 100.0, ekf.BEGIN
    got = Record(DT_S, np.full(n, 3.0), readings, np.ones(2), marks).predict(p, learn=False)[0][1:, 3]

    def slope(_: float, w: FloatArray) -> FloatArray:
        dry = 0.001 * w / np.hypot(w, max(sliding, 0.01))
        torque = dry + p[index.B] * w + 2e-7 * w * np.abs(w) + 0.003
        return np.asarray(-torque / p[index.J])

    span = DT_S * np.arange(n - 1)
    run = solve_ivp(slope, (0.0, span[-1]), got[:1], "LSODA", t_eval=span, rtol=1e-8, atol=1e-8)
    assert got == pytest.approx(run.y[0], abs=0.5)
    assert got[-1] < -10.0


def test_a_motor_below_its_breakaway_torque_stands() -> None:
    out = free_run(values(COULOMB=0.004), np.full(200, 0.2))
    assert np.all(out[:, 1] == 0.0)
    assert out[-1, 0] == pytest.approx(0.1, rel=1e-6)


def test_innovations_of_the_right_model_are_white_and_of_unit_size() -> None:
    rng = np.random.default_rng(1)
    p = values(COULOMB=0.004, DROP=0.2)
    voltage = np.repeat(rng.uniform(-8.0, 8.0, 100), 30)
    true = free_run(p, voltage)
    readings = true + rng.standard_normal(true.shape) * [p[index.NOISE_I], p[index.NOISE_W]]
    white = replace(plain(len(voltage), voltage), readings=readings).predict(p)[0][1:, :2]
    assert np.std(white, axis=0) == pytest.approx([1.0, 1.0], abs=0.05)
    assert abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 0.06


@pytest.mark.parametrize("is_logged_as_none", [False, True])
def test_a_speed_that_falls_without_current_is_an_open_circuit(is_logged_as_none: bool) -> None:
    rng = np.random.default_rng(2)
    speed = np.concatenate([np.full(100, 200.0), 200.0 * np.exp(-np.arange(100) / 60.0), np.full(20, 200.0)])
    current = np.repeat([0.5, 0.0, 0.5], [100, 100, 20])
    voltage = 0.03 * speed + 2.0 * current
    if is_logged_as_none:
        voltage[100:200] = 0.0
    readings = np.stack([current + 1e-3 * rng.standard_normal(220), speed], axis=1)
    found = open_circuit(voltage + 1e-3 * rng.standard_normal(220), readings, np.eye(1, 220)[0])
    assert np.flatnonzero(found).tolist() == list(range(100, 200))
    if is_logged_as_none:
        readings[:, 1] = 0.0
        for sign, first in ((1.0, 103), (-1.0, 200)):  # as a diode carries it, and as a motor brakes
            readings[100:103, 0] = sign * np.array([0.3, 0.2, 0.1])
            found = open_circuit(voltage + 1e-3 * rng.standard_normal(220), readings, np.eye(1, 220)[0])
            assert np.flatnonzero(found).tolist() == list(range(first, 200))


def test_a_circuit_that_closes_at_the_voltage_of_the_motor_is_closed_where_current_flows() -> None:
    rng = np.random.default_rng(2)
    after = np.arange(60)
    voltage = np.concatenate([np.full(50, 7.0), 6.0 - 0.02 * after[:50], np.full(60, 5.0)])
    current = np.concatenate([np.full(50, 0.5), np.zeros(50), 0.3 - 0.3 * np.exp(-after / 5.0)])
    readings = np.stack([current + 1e-3 * rng.standard_normal(160), np.zeros(160)], axis=1)
    found = np.flatnonzero(
        open_circuit(voltage + 1e-3 * rng.standard_normal(160), readings, np.eye(1, 160)[0])
    )
    assert found[0] == 50
    assert 99 <= found[-1] <= 102


def test_a_motor_that_idles_at_a_small_current_is_no_open_circuit() -> None:
    rng = np.random.default_rng(3)
    voltage = np.repeat([12.0, 6.0, 12.0], 100) + 5e-3 * rng.standard_normal(300)
    current = np.repeat([0.02, 0.01, 0.02], 100) + 0.02 * rng.standard_normal(300)
    current[[100, 101, 200, 201]] = [-3.0, -1.0, 3.0, 1.0]
    readings = np.stack([current, 30.0 * voltage], axis=1)
    assert not open_circuit(voltage, readings, np.eye(1, 300)[0]).any()


def test_the_knee_of_the_brush_drop_solves_its_equation() -> None:
    for free in (-3.0, -0.02, 0.0, 1e-4, 0.5, 20.0):
        for near in (0.0, 0.03, 1.0, 30.0):
            i = integrator._solve_knee.py_func(free, 1.5, 0.03, near)
            assert i + 1.5 * i / math.hypot(i, 0.03) == pytest.approx(free, rel=1e-6, abs=1e-9)


def test_a_voltage_that_steps_while_the_motor_idles_is_no_open_circuit() -> None:
    rng = np.random.default_rng(0)
    voltage = np.repeat([12.0, 8.0, 8.3, -6.0], [40, 12, 12, 40])
    speed = np.concatenate(
        [np.full(40, 120.0), 83.0 - np.minimum(np.arange(24), 12) * 0.3, np.full(40, -60.0)]
    )
    current = np.repeat([1.0, 0.0, 0.0, -1.0], [40, 12, 12, 40]) + 0.01 * rng.standard_normal(104)
    readings = np.stack([current, speed], axis=1)
    assert not open_circuit(voltage, readings, np.eye(1, 104)[0]).any()
    coasting = voltage.copy()
    coasting[40:64] = np.linspace(8.3, 7.0, 24)
    assert open_circuit(coasting, readings, np.eye(1, 104)[0])[44:64].all()


def exact_step(p: FloatArray, dt_s: float, warm_k: float = 0.0) -> FloatArray:
    """Rows current and speed; columns current, speed, voltage before, its rise over the interval, torque."""
    ohm, constant, drag = p[index.R] * (1.0 + 0.00393 * warm_k), p[index.K], p[index.B]
    constant, drag = constant * (1.0 - 0.001 * warm_k), drag * (1.0 - 0.003 * warm_k)
    whole = np.zeros((5, 5))
    whole[0, :3] = array(-ohm, -constant, 1.0) / p[index.L]
    whole[1, [0, 1, 4]] = array(constant, -drag, -1.0) / p[index.J]
    whole[2, 3] = 1.0 / dt_s
    rows: FloatArray = expm(whole * dt_s)[:2]
    return rows


def array(*given: float) -> FloatArray:
    return np.array(given)


@pytest.mark.parametrize("hold", HOLDS)
def test_a_linear_motor_takes_exact_steps(hold: Hold) -> None:
    """Against `discretize` for a voltage that is held, and the exponential of the whole for a straight line."""
    rng = np.random.default_rng(7)
    p, volts = values(LOAD=0.004, B=2e-5, OFFSET_I=0.3, OFFSET_W=5.0), rng.uniform(-12.0, 12.0, 40)
    model = discretize(MotorParameters(2.0, 1e-3, 0.03, 0.03, 4e-6, 2e-5), DT_S)
    m, x, expected = exact_step(p, DT_S), np.zeros(2), [np.zeros(2)]
    for before, now in pairwise(volts):
        if hold == "straight":
            x = m @ [*x, before, now - before, 0.004]
        else:
            x = model.transition @ x + model.gain @ [before if hold == "held" else now, 0.004]
        expected.append(x)
    readings = np.tile([0.3, 5.0], (40, 1))  # a motor at rest, through these offsets
    record = Record(DT_S, volts, readings, np.ones(2), np.eye(1, 40)[0], hold)
    got = record.predict(p, learn=False)[0][:, 2:4] - [0.3, 5.0]
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-11)


class Filter(NamedTuple):
    """A textbook Kalman filter of current, speed, load and the shown ones; one reading after the other."""

    white: FloatArray
    logs: float
    load: FloatArray


def interval(p: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Transition of current, speed, load, shown current and speed; how they follow voltage before, its rise, load."""
    k = index
    m, f, g = exact_step(p, dt_s), np.zeros((5, 5)), np.zeros((5, 3))
    f[:2, :2], f[:2, 2], g[:2], f[2, 2] = m[:, :2], m[:, 4], m[:, 2:], 1.0
    f[3], g[3] = f[0], g[0]
    if p[k.LAG_I] > 0.0:  # the exponential of motor, sensor and voltage as one system
        whole = np.zeros((6, 6))
        whole[0, :4], whole[1, :3] = (
            [-2.0 / 1e-3, -0.03 / 1e-3, 0.0, 1.0 / 1e-3],
            [0.03 / 4e-6, -5.0, -1.0 / 4e-6],
        )
        whole[3, 4], whole[5, 0], whole[5, 5] = 1.0 / dt_s, 1.0 / p[k.LAG_I], -1.0 / p[k.LAG_I]
        row = expm(whole * dt_s)[5]
        f[3], g[3] = [*row[:3], row[5], 0.0], [*row[3:5], row[2]]
    # First-order lag of a speed that goes in a straight line between two samples.
    kept = math.exp(-dt_s / p[k.LAG_W]) if p[k.LAG_W] > 0.0 else 0.0
    mean = (1.0 - kept) * p[k.LAG_W] / dt_s
    f[4], g[4] = (1.0 - mean) * f[1], (1.0 - mean) * g[1]
    f[4, 4], f[4, 1] = kept, f[4, 1] + mean - kept
    return f, g


def begun(p: FloatArray, record: Record, volts: float) -> tuple[FloatArray, FloatArray]:
    """State at the first sample, and its covariance: none where the state is known."""
    x, cov = np.zeros(5), np.zeros((5, 5))
    if record.marks[0] == ekf.STEADY:
        balance = [[p[index.R], p[index.K]], [p[index.K], -p[index.B]]]
        x[:2] = x[3:] = np.linalg.solve(balance, [volts, p[index.LOAD]])
    elif record.marks[0] != ekf.REST:
        x[:2] = x[3:] = record.readings[0]
        for row in range(2):
            sd = p[[index.NOISE_I, index.NOISE_W]][row]
            cov[np.ix_([row, 3 + row], [row, 3 + row])] = sd**2
        reach = np.abs(record.between(p[index.DELAY])).max()
        cov[2, 2] = (p[index.K] * 0.1 * reach / p[index.R]) ** 2 if p[index.WALK] > 0.0 else 0.0
    return x, cov


def textbook_filter(p: FloatArray, record: Record) -> Filter:
    k, n, volts = index, len(record.voltage_v), record.between(p[index.DELAY])
    p = p.copy()
    p[k.R] += p[k.SOURCE]  # behind a supply that held its voltage at the last sample
    (f, g), after = interval(p, record.dt_s), record.dt_s * np.ones(n)
    x, cov = begun(p, record, volts[0, 1])
    switched = -1
    if record.onset_s is not None:  # nothing before, and a switch at rest between two samples
        since = record.dt_s * np.arange(n) - record.onset_s
        switched = int(np.argmax(since > 0.0))
        after[switched] = since[switched]
        volts = np.where(since > 0.0, 1.0, 0.0)[:, None] * volts
    sd, white, load, logs = p[[k.NOISE_I, k.NOISE_W]], np.zeros((n, 2)), np.zeros(n), 0.0
    shown = [3 if p[k.LAG_I] + p[k.LAG_W] > 0.0 else 0, 4 if p[k.LAG_I] + p[k.LAG_W] > 0.0 else 1]
    for step in range(0 if record.is_start else 1, n):
        if step > 0 or step == switched:
            if step == switched:
                x, cov = np.zeros(5), np.zeros((5, 5))
            now_f, now_g = (f, g) if step != switched else interval(p, after[step])
            before, now = volts[step]
            now_f = now_f + p[k.SOURCE] * np.outer(now_g[:, 0], np.eye(5)[0])
            x = now_f @ x + now_g @ [before, now - before, p[k.LOAD]]
            noise = p[k.NOISE_V] ** 2 * np.outer(now_g[:, 0], now_g[:, 0])
            noise += p[k.NOISE_T] ** 2 * np.outer(now_g[:, 2], now_g[:, 2])
            noise[2, 2] = p[k.WALK] ** 2 * after[step]
            cov = now_f @ cov @ now_f.T + noise
        for channel in np.flatnonzero(np.isfinite(record.readings[step])):
            h = np.eye(5)[shown[channel]]
            variance = h @ cov @ h + sd[channel] ** 2
            white[step, channel] = (record.readings[step, channel] - h @ x) / math.sqrt(variance)
            logs += math.log(variance)
            # Beyond six standard deviations a reading weighs in as if it lay there.
            x = x + cov @ h / math.sqrt(variance) * np.clip(white[step, channel], -6.0, 6.0)
            cov = cov - np.outer(cov @ h, h @ cov) / variance
        load[step] = x[2]
    return Filter(white, logs, load)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"NOISE_V": 0.05, "SOURCE": 0.4},
        {"NOISE_T": 0.01},
        {"NOISE_V": 0.02, "NOISE_T": 0.01, "WALK": 0.03},
        {"NOISE_V": 0.02, "NOISE_T": 0.01, "WALK": 0.03, "LAG_I": 1.5e-3, "LAG_W": 4e-3},
        {"LAG_W": 3e-3, "LOAD": 0.002},
    ],
)
@pytest.mark.parametrize("hold", ["held", "straight"])
def test_innovations_are_those_of_a_textbook_filter(given: dict[str, float], hold: Hold) -> None:
    rng = np.random.default_rng(8)
    n = 60
    volts = np.repeat(rng.uniform(-8.0, 8.0, 10), 6)
    p = values(B=2e-5, **given)
    clean = plain(n, volts, hold)
    readings = clean.predict(p, learn=False)[0][:, 2:4] + rng.standard_normal((n, 2)) * [2e-3, 0.2]
    readings[33, 0] += 0.5  # a wild one
    record = replace(clean, readings=readings)
    out, logs = record.predict(p)
    expected = textbook_filter(p, record)
    np.testing.assert_allclose(out[:, :2], expected.white, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(out[:, 4], expected.load, rtol=1e-6, atol=1e-12)
    assert logs == pytest.approx(expected.logs, rel=1e-9)
    assert np.abs(out[33, 0]) > 6.0


BEYOND: list[dict[str, float]] = [
    {},
    {"NOISE_V": 0.05},
    {"NOISE_V": 0.02, "LAG_I": 1.5e-3, "LAG_W": 4e-3, "LOAD": 0.002},
]


def noisy(record: Record, p: FloatArray, seed: int) -> Record:
    """The record with readings of this motor under noise; some are missing, one is wild."""
    rng, n = np.random.default_rng(seed), len(record.voltage_v)
    clean = record.predict(p, learn=False)[0][:, 2:4]
    readings = clean + rng.standard_normal((n, 2)) * [2e-3, 0.2]
    readings[[7, 20, 21, 22], 0], readings[[22, 40], 1] = np.nan, np.nan
    readings[33, 0] += 0.5
    return replace(record, readings=readings)


@pytest.mark.parametrize("given", BEYOND)
@pytest.mark.parametrize("mark", [0.0, ekf.REST, ekf.STEADY])
def test_a_known_beginning_and_missing_readings_are_those_of_a_textbook_filter(
    mark: float, given: dict[str, float]
) -> None:
    """What is known has no covariance until the voltage's noise gives it one; what is missing weighs nothing."""
    n, p = 60, values(B=2e-5, **given)
    volts = np.repeat(np.random.default_rng(8).uniform(2.0, 8.0, 10), 6)
    marks = (mark or ekf.BEGIN) * np.eye(1, n)[0]
    record = noisy(replace(plain(n, volts), marks=marks), p, 9)
    out, logs = record.predict(p)
    expected = textbook_filter(p, record)
    np.testing.assert_allclose(out[:, :2], expected.white, rtol=1e-7, atol=1e-8)
    assert logs == pytest.approx(expected.logs, rel=1e-9)
    assert not out[np.isnan(record.readings)[:, 0], 0].any()
    assert not out[np.isnan(record.readings)[:, 1], 1].any()
    assert np.isfinite(out).all()
    assert bool(out[0, :2].any()) is record.is_start
    if mark and not given:  # the model runs freely, and errors over the sensors' noise are left
        free = record.predict(p, learn=False)[0]
        np.testing.assert_array_equal(out[:, 2:4], free[:, 2:4])
        left = (record.readings - free[:, 2:4]) / [1e-3, 0.1]
        np.testing.assert_allclose(out[:, :2], np.nan_to_num(left), rtol=1e-12)


@pytest.mark.parametrize("given", BEYOND)
@pytest.mark.parametrize("onset", [-1.7, 0.3, 12.4])
def test_a_switched_motor_is_that_of_a_textbook_filter(onset: float, given: dict[str, float]) -> None:
    """Its first interval is one of its own, also before the first sample; the voltage's noise acts in it."""
    n, p = 60, values(B=2e-5, **(given | {"LOAD": 0.0}))  # which would turn a motor that waits for its supply
    waiting = replace(plain(n, np.full(n, 6.0)), marks=ekf.REST * np.eye(1, n)[0], onset_s=onset * DT_S)
    record = noisy(waiting, p, 10)
    out, logs = record.predict(p)
    expected = textbook_filter(p, record)
    np.testing.assert_allclose(out[:, :2], expected.white, rtol=1e-7, atol=1e-8)
    assert logs == pytest.approx(expected.logs, rel=1e-9)


def test_what_is_not_recorded_begins_at_the_balance_of_the_voltages() -> None:
    p, volts = values(OFFSET_I=0.1), array(0.0, 5.0, 5.0)
    readings, begin = array(0.5, 0.0, 0.7, 0.0, 0.6, 0.0).reshape(3, 2), np.eye(1, 3)[0]
    current = Record(DT_S, volts, readings, array(1.0, 0.0), begin, "late")
    out, logs = current.predict(p)
    # The mean of the first two currents is 0.5 A, and they rise by 0.2 A in 2 ms.
    speed = (5.0 - 2.0 * 0.5 - 1e-3 * 0.2 / DT_S) / 0.03
    assert out[0, 2:4] == pytest.approx([0.5, speed])
    m = exact_step(p, DT_S)
    sd_w = math.hypot(0.3 * 5.0, 1e-3 / DT_S * 1e-3) / 0.03
    variance = m[0, 0] ** 2 * 1e-6 + m[0, 1] ** 2 * sd_w**2 + 1e-6
    assert out[1, 0] == pytest.approx((0.6 - m[0] @ [0.4, speed, 5.0, 0.0, 0.0]) / math.sqrt(variance))
    far = replace(current, voltage_v=np.full(3, 5.0), readings=readings * [[60.0, 0.0]])
    assert far.predict(p)[0][0, 3] == pytest.approx(-5.0 / 0.03)  # no more than the voltage turns it
    speeds = replace(current, recorded=array(0.0, 1.0), readings=np.tile([0.0, 20.0], (3, 1)))
    out, logs = speeds.predict(p)
    i = (5.0 - 0.03 * 20.0) / 2.0
    assert out[0, 2:4] == pytest.approx([i + 0.1, 20.0])
    variance = m[1, 0] ** 2 * (0.3 * 5.0 / 2.0) ** 2 + m[1, 1] ** 2 * 0.01 + 0.01
    assert out[1, 1] == pytest.approx((20.0 - m[1] @ [i, 20.0, 5.0, 0.0, 0.0]) / math.sqrt(variance))
    assert logs == pytest.approx(math.log(variance), abs=5.0)


def slopes(run: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """How what a run gives moves with each of its inputs, by differences, shape (n_out, n_in)."""
    sides = 1e-4 * np.eye(len(at))
    return np.stack([(run(at + side) - run(at - side)) / 2e-4 for side in sides], axis=1)


NOISES = ({"NOISE_I": 3e-3}, {"NOISE_W": 0.5}, {"NOISE_I": 1e-4, "NOISE_W": 1e-2, "NOISE_V": 0.02})


@pytest.mark.parametrize("noises", NOISES)
@pytest.mark.parametrize(
    ("given", "begin", "volts"),
    [
        ({}, (0.5, 60.0), 6.0),
        ({"SQUARE": 2e-6}, (0.5, 60.0), 6.0),
        ({"SQUARE": 2e-6, "COULOMB": 0.004, "DROP": 0.4}, (0.5, 60.0), 6.0),
        ({"SQUARE": 2e-7, "COULOMB": 1e-3, "SLIDING": 20.0, "DROP": 0.1, "KNEE": 0.15}, (0.5, 60.0), 6.0),
        ({"COULOMB": 0.004}, (0.05, 0.0), 0.1),
    ],
    ids=["linear", "fan", "friction", "knees", "stands"],
)
def test_uncertainty_spreads_as_differences_of_the_free_model_say(
    given: dict[str, float], begin: tuple[float, float], volts: float, noises: dict[str, float]
) -> None:
    """One step: the innovations' covariance by how the step moves with state and voltage."""
    p, at = values(**{"B": 2e-5} | given | noises), np.array([*begin, volts])

    def record(at: FloatArray) -> Record:
        return Record(DT_S, np.full(2, at[2]), np.tile(at[:2], (2, 1)), np.ones(2), np.eye(1, 2)[0])

    f = slopes(lambda one: record(one).predict(p, learn=False)[0][1, 2:4], at)
    sd = p[[index.NOISE_I, index.NOISE_W, index.NOISE_V]]
    expected = f @ np.diag(sd**2) @ f.T + np.diag(sd[:2] ** 2)
    assert record(at).predict(p)[1] == pytest.approx(np.linalg.slogdet(expected)[1], abs=0.03)


@pytest.mark.parametrize("noises", NOISES)
@pytest.mark.parametrize(
    ("given", "speed"),
    [
        ({"SQUARE": 5e-7, "COULOMB": 0.001}, 80.0),
        ({"SQUARE": 5e-7, "COULOMB": 0.001, "B": 0.0}, 80.0),
        ({"LOAD": -0.003, "B": 2e-4}, 80.0),
        ({"COULOMB": 0.02}, 25.0),
    ],
    ids=["coasts", "without drag", "driven by its load", "comes to rest"],
)
def test_uncertainty_of_a_coasting_motor(
    given: dict[str, float], speed: float, noises: dict[str, float]
) -> None:
    """The circuit opens at once: in the first interval the filter still believes it closed."""
    p, marks = values(**{"B": 2e-5} | given | noises), array(ekf.BEGIN, ekf.OPEN, ekf.OPEN)

    def speeds(at: FloatArray) -> FloatArray:
        readings = np.tile(at[:2], (3, 1))
        record = Record(DT_S, np.full(3, at[2]), readings, np.ones(2), marks)
        return record.predict(p, learn=False)[0][1:, 3]

    at, sd = array(0.2, speed, 3.0), p[[index.NOISE_I, index.NOISE_W, index.NOISE_V]]
    first, second = slopes(speeds, at)
    before = first @ np.diag(sd**2) @ first
    after = before * sd[1] ** 2 / (before + sd[1] ** 2) * (second[1] / first[1]) ** 2
    expected = math.log(before + sd[1] ** 2) + math.log(after + sd[1] ** 2) + 4.0 * math.log(sd[0])
    readings = np.array([[0.2, speed], *((0.0, one) for one in speeds(at))])
    record = Record(DT_S, np.full(3, 3.0), readings, np.ones(2), marks)
    assert record.predict(p)[1] == pytest.approx(expected, abs=0.05)


def test_a_fan_and_coasting_follow_their_closed_forms() -> None:
    """J dw/dt = -c w^2 and J dw/dt = -B w - T, without a current."""
    n, drag, torque = 40, 3e-5, 0.002
    marks, readings = np.full(n, ekf.OPEN), np.zeros((n, 2))
    readings[0, 1], marks[0] = 300.0, ekf.BEGIN
    time_s = DT_S * np.arange(n - 1.0)

    def coasted(**given: float) -> FloatArray:
        record = Record(DT_S, np.zeros(n), readings, np.ones(2), marks)
        return record.predict(values(**given), learn=False)[0][1:, 3]

    got = coasted(B=drag, COULOMB=torque)
    rest = torque / drag
    exact = (got[0] + rest) * np.exp(-drag / 4e-6 * time_s) - rest
    np.testing.assert_allclose(got, np.maximum(exact, 0.0), rtol=1e-9, atol=1e-9)
    fan = coasted(B=0.0, SQUARE=1e-7)
    np.testing.assert_allclose(fan, fan[0] / (1.0 + fan[0] * 1e-7 / 4e-6 * time_s), rtol=1e-3)


def test_a_diode_lets_a_current_end_and_not_turn() -> None:
    """Where the circuit opens, a current that would turn meanwhile is none, and the motor coasts from there on."""
    p, marks = values(B=2e-5, L=2e-2), array(ekf.BEGIN, ekf.OPEN)
    m = exact_step(p, DT_S)
    for i, coasts in ((0.05, True), (0.5, False), (-0.05, True), (-0.5, False)):
        speed = math.copysign(20.0, i)
        volts = 0.03 * speed - math.copysign(2.0, i)
        readings = np.tile([i, speed], (2, 1))
        out = Record(DT_S, np.full(2, volts), readings, np.ones(2), marks).predict(p, learn=False)[0]
        new_i, new_w = m @ [i, speed, volts, 0.0, 0.0]
        assert bool(new_i * i < 0.0) is coasts
        expected = speed * math.exp(-2e-5 / 4e-6 * DT_S) if coasts else new_w
        assert out[1, 2:4] == pytest.approx([0.0, expected], rel=1e-9)


@pytest.mark.parametrize(
    ("speed", "part"), [(2.0, math.exp(-1.0 / 16.0)), (8.0, math.exp(-1.0)), (60.0, 0.0)]
)
def test_dry_friction_is_larger_at_low_speed(speed: float, part: float) -> None:
    """Stribeck's curve by its definition: the current that carries it keeps the speed. 8 rad/s are slow at 12 V."""
    for share in (0.5, 0.0):
        p = values(COULOMB=0.003, STRIBECK=share, B=0.0)
        i = 0.003 * (1.0 + share * part) / 0.03
        volts = np.array([12.0, 12.0, *3 * [2.0 * i + 0.03 * speed]])
        marks = np.array([ekf.BEGIN, 0.0, ekf.BEGIN, 0.0, 0.0])
        record = Record(DT_S, volts, np.tile([i, speed], (5, 1)), np.ones(2), marks)
        assert record.predict(p, learn=False)[0][4, 2:4] == pytest.approx([i, speed], rel=1e-3)
