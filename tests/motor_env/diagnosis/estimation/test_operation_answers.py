"""What is told of a fitted motor at work: intervals, units, JSON, refusals; windows, and friction told from a load."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from recorded_motor import DT_S, LOGS, plain, solution, values, worked

from motor_env import InputError, Recording, identify

# Reaches in: a fit made by hand is patched in below `identify`, and told by the answer that it gives.
from motor_env.diagnosis import identification as identifying
from motor_env.diagnosis.estimation import ekf, parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import (
    OperationFit,
    _refuse_poor_fit,
    fit_window,
    identify_operation,
    identify_record,
    without_load,
)
from motor_env.diagnosis.estimation.problem import Problem, motor_unknowns
from motor_env.diagnosis.estimation.terms import terms
from motor_env.diagnosis.estimation.uncertainty import information_covariance, secants
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.regime import RegimeDecision
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.healthy_motor import motor_of_log


@pytest.fixture(scope="module")
def identified() -> OperationFit:
    record = worked(values(B=2e-5, NOISE_V=1e-3), n=500)
    volts = record.voltage_v + 1e-3 * np.random.default_rng(3).standard_normal(500)
    current, speed = record.readings.T
    return identify_operation([Recording(Path("log.csv"), DT_S * np.arange(500.0), current, volts, speed)])


def test_intervals_are_those_of_the_covariance(identified: OperationFit) -> None:
    """Each by its unknown's standard error: 95 of 100, 1.96 of them on either side; of a logarithm, or to 0."""
    problem, spread = identified.solution.problem, identified.covariance
    rows = motor_unknowns(problem)
    assert len(spread) == len(rows)
    for row, n in enumerate(rows):
        term, theta, half = problem.free[n], identified.solution.theta[n], 1.96 * math.sqrt(spread[row, row])
        if term.name not in ("R", "L", "K", "J", "B", "coulomb"):
            continue
        low, high = (term.value(theta + side) for side in (-half, half))
        found = identified.quantity(term.name)
        relative = half / 1.96 * (1.0 if term.is_log else 1.0 / abs(theta))
        assert (found.value, found.high) == pytest.approx((term.value(theta), high))
        assert found.low == pytest.approx(low if term.is_log else max(low, 0.0))
        assert found.log_sd == pytest.approx(relative)
        assert found.is_determined is bool(relative < 0.5)
    for name, true in {"R": 2.0, "K": 0.03, "J": 4e-6}.items():
        assert abs(math.log(identified.quantity(name).value / true)) < 3.5 * identified.quantity(name).log_sd


@pytest.mark.parametrize(
    ("channel", "units"),
    [
        (
            "current",
            {"R": "ohm", "L": "H", "J/K^2": "A s/V", "B/K^2": "A/V", "coulomb/K": "A", "drag/K": "A"},
        ),
        ("speed", {"K": "V s/rad", "R J": "A s2/rad ohm", "R coulomb": "V2 s/rad"}),
    ],
)
def test_one_channel_alone_tells_ratios_in_their_units(
    identified: OperationFit, channel: str, units: dict[str, str]
) -> None:
    true = {"R": 2.0, "J/K^2": 4e-6 / 0.03**2, "coulomb/K": 0.002 / 0.03, "R J": 8e-6, "R coulomb": 0.004}
    found = identify_record(identified.record.only(current=channel == "current", speed=channel == "speed"))
    assert {one.name: one.unit for one in found.quantities if one.name in units} == units
    for one in found.quantities:
        if one.name in true and one.is_determined:
            assert one.value == pytest.approx(true[one.name], rel=0.08)
    with pytest.raises(InputError, match="needs current and speed"):
        motor_of_log(found, "mine")
    if channel == "speed":
        assert found.r2_current is None
        assert f"{1.0 / found.solution.values[index.K]:.4g} rad/s a volt" in found.notes[0]


def test_json_and_motor_file_say_the_same(identified: OperationFit) -> None:
    log = Recording(Path("log.csv"), np.arange(2.0), np.zeros(2))
    taken = {log.path: RegimeDecision("operation", "as asked")}
    (told,) = identifying.Identification((), (log,), taken, identified).to_json()
    for one in identified.quantities:
        said = told["parameters"][one.name]
        assert (said["value"], said["interval"], said["unit"]) == (one.value, [one.low, one.high], one.unit)
        assert said["standard_error"] == pytest.approx((one.high - one.low) / 3.92)
        assert said["determined"] is one.is_determined
    assert told["model"] == list(identified.model)
    left = np.var(identified.record.readings - identified.expected, axis=0)
    r2 = 1.0 - left / np.var(identified.record.readings, axis=0)
    assert (told["r2_current"], told["r2_speed"]) == pytest.approx(r2, abs=1e-3)
    motor, p = motor_of_log(identified, "mine"), identified.solution.values
    told_p = motor.parameters
    assert (told_p.resistance_ohm, told_p.inductance_h) == (p[index.R], p[index.L])
    assert told_p.torque_constant_n_m_per_a == told_p.back_emf_constant_v_s_per_rad == p[index.K]
    assert (told_p.inertia_kg_m2, told_p.viscous_friction_n_m_s_per_rad) == (p[index.J], p[index.B])
    assert (motor.coulomb_friction_n_m, motor.brush_drop_v) == (p[index.COULOMB], p[index.DROP])
    assert (motor.current_noise_a, motor.speed_noise_rad_s) == (p[index.NOISE_I], p[index.NOISE_W])
    assert motor.nominal_voltage_v == identified.record.peaks[0]


@pytest.mark.parametrize(("noise", "least"), [(0.0, 0.5), (0.7, 0.33), (9.0, 0.2)])
@pytest.mark.parametrize("name", ["r2_current", "r2_speed"])
def test_a_motor_explains_half_of_what_is_no_noise(
    identified: OperationFit, noise: float, least: float, name: str
) -> None:
    """And a fifth of all in any case; it is no motor whose L/R is longer than 0.2 s."""
    moves = np.where(np.arange(500) // 40 % 2 == 0, 1.0, -1.0)
    readings = moves[:, None] + noise * np.random.default_rng(1).standard_normal((500, 2))
    record = replace(identified.record, readings=readings)
    shown = replace(identified, record=record, r2_current=0.99, r2_speed=0.99)
    _refuse_poor_fit(replace(shown, **cast("Any", {name: least + 0.05})))
    for r2 in (least - 0.05, math.nan):
        with pytest.raises(UnusableError, match=f"no motor model explains the {name[3:]}"):
            _refuse_poor_fit(replace(shown, **cast("Any", {name: r2})))
    longest = replace(
        identified.quantity("L"), value=0.3 * identified.quantity("R").value, is_determined=True
    )
    with pytest.raises(UnusableError, match="is that of no motor"):
        _refuse_poor_fit(replace(identified, quantities=(*identified.quantities, longest)))


def test_a_duty_and_a_shunt_reach_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Recording] = []

    def unfitted(recordings: tuple[Recording, ...]) -> OperationFit:
        given.extend(recordings)
        raise UnusableError("no motor")

    monkeypatch.setattr(identifying, "identify_operation", unfitted)
    one = Recording(Path("x"), 1e-3 * np.arange(50.0), np.full(50, 2.0), duty=np.full(50, 0.5))
    found = identify([one], voltage_v=12.0, circuit=Circuit(shunt_ohm=0.25), regime="operation")
    assert given[0].voltage_v == pytest.approx(np.full(50, 6.0 - 0.5))
    assert (found.is_complete, found.trouble, found.parameters) == (False, "no motor", {})


@pytest.mark.parametrize("turns", [1.0, -1.0])
def test_a_fit_without_a_load_finds_the_friction(turns: float) -> None:
    """Of a motor that never reverses, where a load of nine tenths of the dry friction had been taken off it."""
    truth = values(COULOMB=0.002)
    record = worked(truth, n=600, lowest=4.0)
    record = replace(record, voltage_v=turns * record.voltage_v, readings=turns * record.readings)
    wrong, names = values(COULOMB=0.02, LOAD=turns * -0.018), [*LOGS, "coulomb", "B", "load_constant"]
    begin = solution(record, names, wrong, np.zeros(len(names)))
    at = [
        math.log(wrong[t.place] / t.unit) if t.is_log else wrong[t.place] / t.unit for t in begin.problem.free
    ]
    found = without_load(replace(begin, theta=np.array(at)), 250.0 * turns)
    assert "load_constant" not in found.names
    drag, expected = (p[index.COULOMB] + 250.0 * p[index.B] for p in (found.values, truth))
    assert drag == pytest.approx(expected, rel=0.05)
    assert found.values[index.LOAD] == 0.0


@pytest.mark.parametrize("turns", [1.0, -1.0])
def test_all_that_brakes_is_the_drag_where_a_load_walks_and_the_motor_turns_one_way(turns: float) -> None:
    """By the balance of energy, whatever load takes a part of it; where the motor reverses the factor is the fit's."""
    record = worked(values(COULOMB=0.006, B=6e-6), n=600, lowest=4.0)
    record = replace(record, voltage_v=turns * record.voltage_v, readings=turns * record.readings)
    known = values(COULOMB=0.002, B=2e-6, WALK=5e-3, DRAG=1.0)
    fits = [fit_window(record, known, ("load_walk",), one_way=one_way) for one_way in (True, False)]
    balanced, fitted = (math.exp(fit.logs[3]) for fit in fits)
    sd, wide = (math.sqrt(fit.covariance[3, 3]) for fit in fits)
    assert balanced == pytest.approx(3.0, rel=0.01)
    assert sd < 0.2 * wide
    assert abs(balanced - fitted) > 3.0 * sd
    np.testing.assert_array_equal(fits[0].logs[:3], fits[1].logs[:3])
    known[index.LOAD] = turns * 0.002
    less = fit_window(record, known, ("load_walk",), one_way=True)
    speed = float(np.mean(np.square(record.readings[:, 1]))) / float(np.mean(np.abs(record.readings[:, 1])))
    assert balanced - math.exp(less.logs[3]) == pytest.approx(0.002 / (0.002 + 2e-6 * speed), rel=0.02)


def test_the_balance_of_energy() -> None:
    """Of two recordings of a motor with a fan and a known load: the speed between them is no gain."""
    truth = values(COULOMB=0.006, B=6e-6, SQUARE=2e-8, LOAD=1e-3)
    both = [worked(truth, seed=seed, n=200, lowest=4.0) for seed in (1, 2)]
    voltage, readings, begins = (
        np.concatenate([getattr(one, name) for one in both]) for name in ("voltage_v", "readings", "marks")
    )
    record = replace(both[0], voltage_v=voltage, readings=readings, marks=begins)
    known = values(COULOMB=0.002, B=2e-6, SQUARE=2e-8, LOAD=1e-3, WALK=5e-3, DRAG=1.0)
    fit = fit_window(record, known, ("load_walk",), one_way=True)
    p, (i, w) = fit.values, record.predict(fit.values)[0][:, 2:4].T
    gained = np.diff(w**2)[begins[1:] != ekf.BEGIN].sum()
    given, work = w @ (p[index.K] * i - 1e-3 - 2e-8 * w**2), w @ (0.002 + 2e-6 * w)
    factor = float((given - 0.5 * p[index.J] * gained / record.dt_s) / work)
    assert math.exp(fit.logs[3]) == pytest.approx(factor, rel=1e-5)
    assert factor == pytest.approx(3.0, rel=0.02)
    noise = p[index.K] * math.hypot(*(p[[index.NOISE_I, index.NOISE_W]] * np.linalg.norm([w, i], axis=1)))
    assert noise / work / factor < math.sqrt(fit.covariance[3, 3]) < 0.02


@pytest.mark.parametrize("noise_rad_s", [0.0, 0.1])
def test_the_drag_of_a_motor_that_stands_is_not_told(noise_rad_s: float) -> None:
    volts, *noise = np.random.default_rng(4).standard_normal((3, 300))
    record = replace(plain(300, 0.001 * volts), readings=np.transpose(noise) * [1e-3, noise_rad_s])
    known = values(COULOMB=0.002, B=2e-6, WALK=5e-3, DRAG=1.0)
    found = fit_window(record, known, ("load_walk",), one_way=True)
    assert np.isfinite(found.logs).all()
    assert math.sqrt(found.covariance[3, 3]) > 9.0  # of 10, beyond which nothing is told


@pytest.mark.parametrize("place", [index.NOISE_I, index.NOISE_W])
def test_values_of_no_motor_are_refused(place: int) -> None:
    known = values(DRAG=1.0)
    known[place] = 0.0
    with pytest.raises(InputError, match="holds the values of no motor"):
        fit_window(worked(values(), n=80), known, ("noise_current", "noise_speed"))


def test_a_window_is_fitted_near_the_healthy_motor() -> None:
    known, record = (
        values(DRAG=1.0, COULOMB=0.004),
        worked(values(R=2.4, K=0.029, J=4.4e-6, COULOMB=0.008, B=4e-6), n=800),
    )
    found = fit_window(record, known, ())
    sd = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.logs - np.log([2.4, 0.029, 4.4e-6, 2.0])) < 3.5 * sd)
    assert np.all(sd < 0.05)
    assert found.values[index.COULOMB] == pytest.approx(0.008, rel=0.05)
    # The drag's factor f has the error of the information; its logarithm that over the way from 1 to f.
    every, factor = terms(record, known), math.exp(found.logs[3])
    drag = replace(every["coulomb"], name="drag", place=index.DRAG, unit=1.0, low=0.05, high=20.0)
    problem = Problem(record, known, (*(every[name] for name in LOGS), drag))
    theta = np.array([*(found.logs[:3] - np.log([2.0, 0.03, 4e-6])), factor])
    slope = np.array([1.0, 1.0, 1.0, math.log(factor) / (factor - 1.0)])
    expected = information_covariance(problem, theta, secants(problem, theta)) * np.outer(slope, slope)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
