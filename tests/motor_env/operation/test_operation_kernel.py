"""The compiled filter of a motor at work against a stiff solver, and at standstill."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from motor_env.motor.parameters import FloatArray
from motor_env.operation import kernel
from motor_env.operation.record import Record, open_circuit

DT_S = 2e-3


def values(**given: float) -> FloatArray:
    """A small motor, with what is given."""
    base = {"R": 2.0, "L": 1e-3, "K": 0.03, "J": 4e-6, "B": 2e-6, "NOISE_I": 1e-3, "NOISE_W": 0.1}
    out = np.zeros(kernel.N_VALUES)
    for name, value in (base | given).items():
        out[getattr(kernel, name)] = value
    return out


def free_run(p: FloatArray, voltage: FloatArray) -> FloatArray:
    """Current and speed of the model without readings."""
    n = len(voltage)
    marks = np.eye(1, n)[0]
    record = Record(DT_S, voltage, np.zeros((n, 2)), np.ones(2), marks)
    return record.predict(p, learn=False)[0][:, 2:4]


def solved(p: FloatArray, voltage: FloatArray) -> FloatArray:
    """The same by an implicit solver, friction and drop with a knee, steep where there is none."""
    k = kernel

    def slope(_: float, x: FloatArray, volts: float) -> list[float]:
        dry = p[k.COULOMB] * x[1] / math.hypot(x[1], max(p[k.SLIDING], 0.01))
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
    ],
)
def test_free_model_follows_a_stiff_solver(given: dict[str, float]) -> None:
    p = values(**given)
    voltage = np.repeat([0.0, 6.0, -4.0, 0.5, 8.0, 0.0], 40)
    expected, got = solved(p, voltage), free_run(p, voltage)
    assert np.all(np.abs(got - expected).max(axis=0) < 0.02 * np.abs(expected).max(axis=0))


@pytest.mark.parametrize("sliding", [0.0, 5.0])
def test_a_coasting_motor_that_its_load_turns_back_follows_a_stiff_solver(sliding: float) -> None:
    p = values(COULOMB=0.001, SLIDING=sliding, LOAD=0.003, SQUARE=2e-7)
    n = 60
    readings, marks = np.zeros((n, 2)), np.full(n, kernel.OPEN)
    readings[0, 1], marks[0] = 100.0, kernel.BEGIN
    got = Record(DT_S, np.full(n, 3.0), readings, np.ones(2), marks).predict(p, learn=False)[0][1:, 3]

    def slope(_: float, w: FloatArray) -> FloatArray:
        dry = 0.001 * w / np.hypot(w, max(sliding, 0.01))
        torque = dry + p[kernel.B] * w + 2e-7 * w * np.abs(w) + 0.003
        return np.asarray(-torque / p[kernel.J])

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
    readings = true + rng.standard_normal(true.shape) * [p[kernel.NOISE_I], p[kernel.NOISE_W]]
    record = Record(DT_S, voltage, readings, np.ones(2), np.eye(1, len(voltage))[0])
    white = record.predict(p)[0][1:, :2]
    assert np.std(white, axis=0) == pytest.approx([1.0, 1.0], abs=0.05)
    assert abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 0.06


def test_warmth_follows_the_heat_of_the_winding() -> None:
    p = values(COULOMB=0.004, HEATING=5.0, COOLING=0.5)
    n = 4000
    record = Record(DT_S, np.full(n, 0.2), np.zeros((n, 2)), np.ones(2), np.eye(1, n)[0])
    warm = record.predict(p, learn=False)[0][-1, 5]
    assert warm == pytest.approx(5.0 * 2.0 * 0.01 / 0.5 * (1.0 - np.exp(-0.5 * n * DT_S)), rel=0.01)


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
        i = kernel._kneed(free, 1.5, 0.03)
        assert i + 1.5 * i / math.hypot(i, 0.03) == pytest.approx(free, abs=1e-9)


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
