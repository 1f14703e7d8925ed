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
from motor_env.diagnosis.estimation.record import HOLDS, Hold, Record
from motor_env.motor.parameters import FloatArray

MOTORS = {
    "small": (2.0, 1e-3, 0.03, 4e-6, 2e-5),
    "stiff": (10.0, 1e-5, 0.02, 1e-5, 1e-6),
    "underdamped": (0.5, 5e-3, 0.05, 2e-6, 1e-6),
    "large": (0.3, 2e-3, 0.5, 0.05, 1e-3),
    "braked": (5.0, 1e-3, 0.01, 1e-4, 1e-2),
}
"""R, L, K, J, B."""
each_motor = pytest.mark.parametrize("name", MOTORS)


def values(name: str = "", /, **given: float) -> FloatArray:
    """A small motor without dry friction, or another one, with what is given."""
    motor = dict(zip("RLKJB", MOTORS[name], strict=True)) if name else {}
    return recorded_motor.values(**({"COULOMB": 0.0, "NOISE_I": 1e-3, "NOISE_W": 0.1} | motor | given))


def free_run(p: FloatArray, voltage: FloatArray) -> FloatArray:
    return plain(len(voltage), voltage).predict(p, learn=False)[0][:, 2:4]


def solved(p: FloatArray, voltage: FloatArray) -> FloatArray:
    """The same by an implicit solver, friction and drop with a knee, steep where there is none."""
    k = index

    def slope(_: float, x: FloatArray, volts: float) -> list[float]:
        dry = p[k.COULOMB] + p[k.GEAR] * p[k.K] * abs(x[0])
        friction = dry * x[1] / math.hypot(x[1], max(p[k.SLIDING], 0.01))
        friction += p[k.B] * x[1] + p[k.SQUARE] * x[1] * abs(x[1]) + p[k.LOAD]
        drop = p[k.DROP] * x[0] / math.hypot(x[0], max(p[k.KNEE], 1e-4))
        return [(volts - p[k.R] * x[0] - p[k.K] * x[1] - drop) / p[k.L], (p[k.K] * x[0] - friction) / p[k.J]]

    states = [np.zeros(2)]
    for volts in voltage[:-1]:
        run = solve_ivp(slope, (0.0, DT_S), states[-1], "LSODA", args=(volts,), rtol=1e-7, atol=1e-9)
        states.append(run.y[:, -1])
    return np.array(states)


STEPS = np.repeat([0.0, 6.0, -4.0, 0.5, 8.0, 0.0], 40)
SLOW = 3.0 * np.sin(2.0 * np.pi * np.arange(700) / 700.0)  # current and speed hardly move beside their knees


@pytest.mark.parametrize(
    ("given", "voltage", "off"),
    [
        ({}, STEPS, 0.02),
        ({"COULOMB": 0.004}, STEPS, 0.02),
        ({"COULOMB": 0.004, "DROP": 0.4}, STEPS, 0.02),
        ({"COULOMB": 0.004, "SLIDING": 5.0, "DROP": 0.4, "KNEE": 0.05}, STEPS, 0.02),
        ({"LOAD": 0.01, "COULOMB": 0.002}, STEPS, 0.02),
        ({"SQUARE": 2e-7}, STEPS, 0.02),
        ({"GEAR": 0.15}, STEPS, 0.02),
        ({"GEAR": 0.15, "COULOMB": 0.004, "SLIDING": 5.0}, STEPS, 0.02),
        ({"COULOMB": 0.004, "SLIDING": 60.0, "DROP": 0.4, "KNEE": 0.3}, SLOW, 0.01),
    ],
)
def test_free_model_follows_a_stiff_solver(given: dict[str, float], voltage: FloatArray, off: float) -> None:
    p = values(**given)
    expected, got = solved(p, voltage), free_run(p, voltage)
    assert np.all(np.abs(got - expected).max(axis=0) < off * np.abs(expected).max(axis=0))


@pytest.mark.parametrize("sliding", [0.0, 5.0])
def test_a_coasting_motor_that_its_load_turns_back_follows_a_stiff_solver(sliding: float) -> None:
    p = values(COULOMB=0.001, SLIDING=sliding, LOAD=0.003, SQUARE=2e-7)
    got = coasted(p, 100.0, 60)

    def slope(_: float, w: FloatArray) -> FloatArray:
        dry = 0.001 * w / np.hypot(w, max(sliding, 0.01))
        return np.asarray(-(dry + p[index.B] * w + 2e-7 * w * np.abs(w) + 0.003) / p[index.J])

    span = DT_S * np.arange(59.0)
    run = solve_ivp(slope, (0.0, span[-1]), got[:1], "LSODA", t_eval=span, rtol=1e-8, atol=1e-8)
    assert got == pytest.approx(run.y[0], abs=0.5)
    assert got[-1] < -10.0


def coasted(p: FloatArray, speed: float, n: int) -> FloatArray:
    readings, marks = np.zeros((n, 2)), np.full(n, ekf.OPEN)
    readings[0, 1], marks[0] = speed, ekf.BEGIN
    return Record(DT_S, np.full(n, 3.0), readings, np.ones(2), marks).predict(p, learn=False)[0][1:, 3]


def test_the_knee_of_the_brush_drop_solves_its_equation() -> None:
    for free in (-3.0, -0.02, 0.0, 1e-4, 0.5, 20.0):
        for near in (0.0, 0.03, 1.0, 30.0):
            i = integrator._solve_knee.py_func(free, 1.5, 0.03, near)
            assert i + 1.5 * i / math.hypot(i, 0.03) == pytest.approx(free, rel=1e-6, abs=1e-9)


def slopes_of(p: FloatArray) -> FloatArray:
    """Slopes of current and speed by current, speed, load and voltage, shape (2, 4)."""
    k = index
    current = np.array([-p[k.R], -p[k.K], 0.0, 1.0]) / p[k.L]
    return np.stack([current, np.array([p[k.K], -p[k.B], -1.0, 0.0]) / p[k.J]])


def exact_step(p: FloatArray, dt_s: float) -> FloatArray:
    """Rows current and speed; columns current, speed, load, voltage before, its rise over the interval."""
    whole = np.zeros((5, 5))
    whole[:2, :4], whole[3, 4] = slopes_of(p), 1.0 / dt_s
    rows: FloatArray = expm(whole * dt_s)[:2]
    return rows


def scale_s(p: FloatArray) -> float:
    return 1.0 / float(np.abs(np.linalg.eigvals(slopes_of(p)[:, :2])).max())


@each_motor
@pytest.mark.parametrize("share", [0.01, 1.0, 30.0])
@pytest.mark.parametrize("hold", HOLDS)
def test_a_linear_motor_takes_exact_steps(name: str, share: float, hold: Hold) -> None:
    """Against `discretize` for a voltage that is held, and the exponential of the whole for a straight line."""
    ohm, henry, constant, inertia, drag = MOTORS[name]
    p, volts = values(name, OFFSET_I=0.3, OFFSET_W=5.0), np.random.default_rng(7).uniform(-12.0, 12.0, 40)
    p[index.LOAD], dt_s = 0.1 * constant * 12.0 / ohm, share * scale_s(p)
    model = discretize(MotorParameters(ohm, henry, constant, constant, inertia, drag), dt_s)
    m, x, expected = exact_step(p, dt_s), np.zeros(2), [np.zeros(2)]
    for before, now in pairwise(volts):
        if hold == "straight":
            x = m @ [*x, p[index.LOAD], before, now - before]
        else:
            x = model.transition @ x + model.gain @ [before if hold == "held" else now, p[index.LOAD]]
        expected.append(x)
    readings = np.tile([0.3, 5.0], (40, 1))  # a motor at rest, through these offsets
    record = Record(dt_s, volts, readings, np.ones(2), np.eye(1, 40)[0], hold)
    got, peaks = record.predict(p, learn=False)[0][:, 2:4] - [0.3, 5.0], np.abs(expected).max(axis=0)
    np.testing.assert_allclose(got / peaks, expected / peaks, rtol=1e-9, atol=1e-10)


class Filter(NamedTuple):
    """A textbook Kalman filter of current, speed, load and the shown ones; one reading after the other."""

    white: FloatArray
    logs: float
    load: FloatArray


def interval(p: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Transition of current, speed, load, shown current and speed; how they follow voltage before, its rise, load."""
    k = index
    m, f, g = exact_step(p, dt_s), np.zeros((5, 5)), np.zeros((5, 3))
    f[:2, :3], f[2, 2], g[:2, :2], g[:2, 2] = m[:, :3], 1.0, m[:, 3:], m[:, 2]
    f[3], g[3] = f[0], g[0]
    if p[k.LAG_I] > 0.0:  # the exponential of motor, sensor and voltage as one system
        whole = np.zeros((6, 6))
        whole[:2, :4], whole[3, 4] = slopes_of(p), 1.0 / dt_s
        whole[5, 0], whole[5, 5] = 1.0 / p[k.LAG_I], -1.0 / p[k.LAG_I]
        row = expm(whole * dt_s)[5]
        f[3], g[3] = [*row[:3], row[5], 0.0], [*row[3:5], row[2]]
    # First-order lag of a speed that goes in a straight line between two samples.
    kept = math.exp(-dt_s / p[k.LAG_W]) if p[k.LAG_W] > 0.0 else 0.0
    mean = (1.0 - kept) * p[k.LAG_W] / dt_s
    f[4], g[4] = (1.0 - mean) * f[1], (1.0 - mean) * g[1]
    f[4, 4], f[4, 1] = kept, f[4, 1] + mean - kept
    return f, g


def begun(
    p: FloatArray, record: Record, volts: FloatArray, shown: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State at the first sample, and its covariance: none where the state is known; what is not recorded to 30 %."""
    x, cov, reach = np.zeros(5), np.zeros((5, 5)), np.abs(volts).max() + 1e-9
    if record.marks[0] == ekf.STEADY:
        balance = [[p[index.R], p[index.K]], [p[index.K], -p[index.B]]]
        x[:2] = x[3:] = np.linalg.solve(balance, [volts[0, 1], p[index.LOAD]])
    elif record.marks[0] != ekf.REST:
        x[:2] = x[3:] = shown
        sds = p[[index.NOISE_I, index.NOISE_W]]
        if not record.recorded[1]:
            sds[1] = math.hypot(0.3 * reach, p[index.L] / record.dt_s * p[index.NOISE_I]) / p[index.K]
        if not record.recorded[0]:
            sds[0] = 0.3 * reach / p[index.R]
        for row, sd in enumerate(sds):
            cov[np.ix_([row, 3 + row], [row, 3 + row])] = sd**2
        cov[2, 2] = (p[index.K] * 0.1 * reach / p[index.R]) ** 2 if p[index.WALK] > 0.0 else 0.0
    return x, cov


def textbook_filter(p: FloatArray, record: Record, shown: FloatArray) -> Filter:
    k, n, volts = index, len(record.voltage_v), record.between(p[index.DELAY])
    p = p.copy()
    p[k.R] += p[k.SOURCE]  # behind a supply that held its voltage at the last sample
    (f, g), after = interval(p, record.dt_s), record.dt_s * np.ones(n)
    x, cov = begun(p, record, volts, shown)
    switched = -1
    if record.onset_s is not None:  # nothing before, and a switch at rest between two samples
        since = record.dt_s * np.arange(n) - record.onset_s - p[k.ONSET]
        switched = int(np.argmax(since > 0.0))
        after[switched] = since[switched]
        volts = np.where(since > 0.0, 1.0, 0.0)[:, None] * volts
    sd, white, load, logs = p[[k.NOISE_I, k.NOISE_W]], np.zeros((n, 2)), np.zeros(n), 0.0
    lags = 3 if p[k.LAG_I] + p[k.LAG_W] > 0.0 else 0
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
        for channel in np.flatnonzero(np.isfinite(record.readings[step]) & (record.recorded > 0.0)):
            h = np.eye(5)[channel + lags]
            variance = h @ cov @ h + sd[channel] ** 2
            white[step, channel] = (record.readings[step, channel] - h @ x) / math.sqrt(variance)
            logs += math.log(variance)
            # Beyond six standard deviations a reading weighs in as if it lay there.
            x = x + cov @ h / math.sqrt(variance) * np.clip(white[step, channel], -6.0, 6.0)
            cov = cov - np.outer(cov @ h, h @ cov) / variance
        load[step] = x[2]
    return Filter(white, logs, load)


def assert_textbook(p: FloatArray, record: Record) -> FloatArray:
    out, logs = record.predict(p)
    expected = textbook_filter(p, record, out[0, 2:4])
    np.testing.assert_allclose(out[:, :2], expected.white, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(out[:, 4], expected.load, rtol=1e-6, atol=1e-9 * p[index.K])
    assert logs == pytest.approx(expected.logs, rel=1e-9)
    return out


def noisy(record: Record, p: FloatArray) -> Record:
    """The record with readings of this motor under noise, of which one is wild and some are missing."""
    shown = record.predict(p, learn=False)[0][:, 2:4]
    noise = np.random.default_rng(8).standard_normal(shown.shape) * p[[index.NOISE_I, index.NOISE_W]]
    shown = shown + 2.0 * noise
    shown[33, 0] += 500.0 * p[index.NOISE_I]
    shown[[7, 20, 21, 22], 0] = shown[[22, 40], 1] = np.nan
    return replace(record, readings=shown)


DRIVEN = np.repeat(np.random.default_rng(8).uniform(-8.0, 8.0, 8), 8)


@each_motor
@pytest.mark.parametrize("given", [{}, {"NOISE_V": 0.3}, {"NOISE_V": 0.3, "WALK": 0.02}])
@pytest.mark.parametrize("seen", [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
def test_innovations_of_any_motor_are_those_of_a_textbook_filter(
    name: str, given: dict[str, float], seen: list[float]
) -> None:
    p = values(name, **given)
    p[index.LOAD] = 0.1 * p[index.K] / p[index.R]
    record = replace(plain(64, DRIVEN, dt_s=0.7 * scale_s(p)), recorded=np.array(seen))
    assert_textbook(p, noisy(record, p))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"NOISE_V": 0.05, "SOURCE": 0.4},
        {"NOISE_T": 0.01},
        {"NOISE_V": 0.02, "LAG_I": 1.5e-3, "LAG_W": 4e-3, "LOAD": 0.002},
        {"NOISE_V": 0.02, "NOISE_T": 0.01, "WALK": 0.03, "LAG_I": 1.5e-3, "LAG_W": 4e-3},
        {"LAG_W": 3e-3, "LOAD": 0.002},
        {"LAG_I": 3e-3},
    ],
)
@pytest.mark.parametrize("mark", [ekf.BEGIN, ekf.REST, ekf.STEADY])
@pytest.mark.parametrize("hold", ["held", "straight"])
def test_innovations_are_those_of_a_textbook_filter(given: dict[str, float], mark: float, hold: Hold) -> None:
    """A known beginning has no covariance until noise gives it one; what is missing weighs nothing."""
    p, volts = values(B=2e-5, **given), np.abs(DRIVEN) if mark == ekf.STEADY else DRIVEN
    record = noisy(replace(plain(64, volts, hold), marks=mark * np.eye(1, 64)[0]), p)
    out = assert_textbook(p, record)
    assert np.abs(out[33, 0]) > 6.0
    assert bool(out[0, :2].any()) is record.is_start


@pytest.mark.parametrize("given", [{}, {"NOISE_V": 0.05}, {"NOISE_V": 0.02, "LAG_I": 1.5e-3, "LAG_W": 4e-3}])
@pytest.mark.parametrize("onset", [-1.7, 1e-5, 0.3, 0.99999, 12.4])
@pytest.mark.parametrize("late", [0.0, 2.8])
def test_a_switched_motor_is_that_of_a_textbook_filter(
    onset: float, late: float, given: dict[str, float]
) -> None:
    """Its first interval is one of its own, also before the first sample; the onset is fitted about the record's."""
    p = values(B=2e-5, ONSET=late * DT_S, **given)
    waiting = replace(plain(64, np.full(64, 6.0)), marks=ekf.REST * np.eye(1, 64)[0], onset_s=onset * DT_S)
    assert_textbook(p, noisy(waiting, p))


def test_what_is_not_recorded_begins_at_the_balance_of_the_voltages() -> None:
    p, volts = values(OFFSET_I=0.1), np.array([0.0, 5.0, 5.0])
    readings, begin = np.array([[0.5, 0.0], [0.7, 0.0], [0.6, 0.0]]), np.eye(1, 3)[0]
    current = Record(DT_S, volts, readings, np.array([1.0, 0.0]), begin, "late")
    # The mean of the first two currents is 0.5 A, and they rise by 0.2 A in 2 ms.
    speed = (5.0 - 2.0 * 0.5 - 1e-3 * 0.2 / DT_S) / 0.03
    assert current.predict(p)[0][0, 2:4] == pytest.approx([0.5, speed])
    far = replace(current, voltage_v=np.full(3, 5.0), readings=readings * [[60.0, 0.0]])
    assert far.predict(p)[0][0, 3] == pytest.approx(-5.0 / 0.03)  # no more than the voltage turns it
    speeds = replace(current, recorded=np.array([0.0, 1.0]), readings=np.tile([0.0, 20.0], (3, 1)))
    assert speeds.predict(p)[0][0, 2:4] == pytest.approx([(5.0 - 0.03 * 20.0) / 2.0 + 0.1, 20.0])


def slopes(run: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """How what a run gives moves with each of its inputs, by differences, shape (n_out, n_in)."""
    sides = 1e-4 * np.eye(len(at))
    return np.stack([(run(at + side) - run(at - side)) / 2e-4 for side in sides], axis=1)


each_noise = pytest.mark.parametrize(
    "noises", [{"NOISE_I": 3e-3}, {"NOISE_W": 0.5}, {"NOISE_I": 1e-4, "NOISE_W": 1e-2, "NOISE_V": 0.02}]
)


@each_noise
@pytest.mark.parametrize(
    ("given", "begin", "volts"),
    [
        ({"SQUARE": 2e-6}, (0.5, 60.0), 6.0),
        ({"SQUARE": 2e-6, "COULOMB": 0.004, "DROP": 0.4}, (0.5, 60.0), 6.0),
        ({"SQUARE": 2e-7, "COULOMB": 1e-3, "SLIDING": 20.0, "DROP": 0.1, "KNEE": 0.15}, (0.5, 60.0), 6.0),
        ({"COULOMB": 0.004}, (0.05, 0.0), 0.1),
    ],
    ids=["fan", "friction", "knees", "stands"],
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


@pytest.mark.parametrize(("i", "coasts"), [(0.05, True), (0.5, False), (-0.05, True), (-0.5, False)])
def test_a_diode_lets_a_current_end_and_not_turn(i: float, coasts: bool) -> None:
    """Where the circuit opens, a current that would turn meanwhile is none, and the motor coasts from there on."""
    p, speed = values(B=2e-5, L=2e-2), math.copysign(20.0, i)
    volts = 0.03 * speed - math.copysign(2.0, i)
    record = Record(
        DT_S, np.full(2, volts), np.tile([i, speed], (2, 1)), np.ones(2), np.array([ekf.BEGIN, ekf.OPEN])
    )
    new_i, new_w = exact_step(p, DT_S) @ [i, speed, 0.0, volts, 0.0]
    assert bool(new_i * i < 0.0) is coasts
    expected = speed * math.exp(-2e-5 / 4e-6 * DT_S) if coasts else new_w
    assert record.predict(p, learn=False)[0][1, 2:4] == pytest.approx([0.0, expected], rel=1e-9)


@pytest.mark.parametrize(
    ("speed", "part"), [(2.0, math.exp(-1.0 / 16.0)), (8.0, math.exp(-1.0)), (60.0, 0.0)]
)
@pytest.mark.parametrize("share", [0.5, 0.0])
def test_dry_friction_is_larger_at_low_speed(speed: float, part: float, share: float) -> None:
    """Stribeck's curve by its definition: the current that carries it keeps the speed. 8 rad/s are slow at 12 V."""
    p = values(COULOMB=0.003, STRIBECK=share, B=0.0)
    i = 0.003 * (1.0 + share * part) / 0.03
    volts = np.array([12.0, 12.0, *3 * [2.0 * i + 0.03 * speed]])
    marks = np.array([ekf.BEGIN, 0.0, ekf.BEGIN, 0.0, 0.0])
    record = Record(DT_S, volts, np.tile([i, speed], (5, 1)), np.ones(2), marks)
    assert record.predict(p, learn=False)[0][4, 2:4] == pytest.approx([i, speed], rel=1e-3)
