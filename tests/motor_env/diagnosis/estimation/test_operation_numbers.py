"""Parts of the fit of a motor at work, each against a closed form or brute force on a small case."""

import json
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recorded_motor import DT_S, LOGS, Line, least_squares, plain, solution, values, worked
from scipy.linalg import circulant

from motor_env import InputError, Recording, identify, load_motor
from motor_env.cli import main

# Reaches in: a fit made by hand is patched in below `identify`, and told by the answer that it gives.
from motor_env.diagnosis import identification as identifying
from motor_env.diagnosis.estimation import (
    ekf,
    model_selection as fitting,
    parameter_index as index,
    uncertainty,
)
from motor_env.diagnosis.estimation.model_selection import _sign, initial_values
from motor_env.diagnosis.estimation.operation_fit import (
    OperationFit,
    _drag,
    _refuse_poor_fit,
    fit_window,
    identify_operation,
    identify_record,
    without_load,
)
from motor_env.diagnosis.estimation.preprocessing import (
    at_terminals,
    block_means,
    from_recordings,
    liveliest_stretches,
    median_noise,
    open_circuit,
)
from motor_env.diagnosis.estimation.problem import Problem, Solution, motor_unknowns
from motor_env.diagnosis.estimation.record import Hold, Record
from motor_env.diagnosis.estimation.terms import terms
from motor_env.diagnosis.estimation.uncertainty import (
    ScoreTest,
    candidates,
    information_covariance,
    normalised,
    sandwich,
    score_tests,
    secants,
)
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.regime import RegimeDecision
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.healthy_motor import motor_of_log
from motor_env.motor.parameters import FloatArray


@pytest.fixture(scope="module")
def small() -> Solution:
    """R, K, J and a load, fitted; the rest is known. There is a fan that the model lacks."""
    p = values()
    return solution(worked(values(SQUARE=5e-10)), [*LOGS, "load_constant"], p)


def test_the_voltage_between_samples_by_hand() -> None:
    record = plain(4, np.array([1.0, 2.0, 4.0, 8.0]))
    pairs = {
        "held": [[1, 1], [1, 1], [2, 2], [4, 4]],
        "late": [[1, 1], [2, 2], [4, 4], [8, 8]],
        "straight": [[1, 1], [1, 2], [2, 4], [4, 8]],
    }
    for hold, expected in pairs.items():
        held = replace(record, hold=cast("Hold", hold))
        np.testing.assert_allclose(held.between(), np.array(expected))


def test_parts_of_a_record_by_hand() -> None:
    volts = np.arange(100.0)
    record = replace(plain(100), readings=np.stack([volts + 0.5, -volts], axis=1))
    record.marks[[30, 31, 55]] = ekf.OPEN
    assert record.closed().marks.tolist() == [ekf.BEGIN, *[0.0] * 99]
    some = record.sample(40)
    assert some.voltage_v.tolist() == [10.0 * k + n for k in range(10) for n in range(4)]
    marks = np.where(np.arange(40) % 4 == 0, ekf.BEGIN, 0.0)
    marks[13] = ekf.OPEN
    assert some.marks.tolist() == marks.tolist()
    assert some.readings.tolist() == [[volts + 0.5, -volts] for volts in some.voltage_v]
    assert record.duration_s == pytest.approx(100 * DT_S)
    assert record.peaks == pytest.approx([98.901, 99.401, 98.901])
    assert record.only(current=False, speed=True).recorded.tolist() == [0.0, 1.0]
    assert record.marks[30] == ekf.OPEN  # the record itself stays


def recorded(
    current: FloatArray,
    *,
    volts: FloatArray | None = None,
    dt_s: float = 1e-3,
    speed: FloatArray | None = None,
) -> Recording:
    n = len(current)
    speed = np.linspace(0.0, 1.0, n) if speed is None else speed
    voltage = np.linspace(-1.0, 1.0, n) if volts is None else volts
    return Recording(Path("x"), dt_s * np.arange(float(n)), current, voltage, speed)


def lost(current: FloatArray) -> float:
    """Share of the variance that goes where two neighbours are averaged, beyond that of the noise."""
    pairs = current.reshape(-1, 2).mean(axis=1)
    return 1.0 - float(np.var(pairs) + 0.5 * median_noise(current) ** 2) / float(np.var(current))


def test_neighbours_are_averaged_as_long_as_their_means_tell_nearly_all() -> None:
    """Under noise a ripple so large that the means of two lose a little more or less than 2 % of what they tell."""
    n = 8_000
    phase, noise = np.arange(float(n)), 0.4 * np.random.default_rng(3).standard_normal(n)
    plain, ripple, low, high = np.sin(0.05 * phase) + noise, np.sin(0.7 * phase), 0.0, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if lost(plain + middle * ripple) > 0.02 else (middle, high)
    for size, factor in ((0.99 * low, 2), (1.01 * low, 1)):
        current = plain + size * ripple
        assert lost(current) == pytest.approx(0.02, abs=5e-4)
        record = from_recordings([recorded(current)], most=n // 2)
        assert (record.averaged, record.share) == (factor, 1.0 if factor == 2 else 0.5)
        assert record.dt_s == pytest.approx(1e-3 * factor)
        assert record.hold == ("straight" if factor == 2 else "held")


def test_records_hold_the_means_of_their_recordings() -> None:
    n = 50
    current, speed = np.arange(100.0) ** 2, np.arange(100.0)
    one = recorded(current, speed=speed)
    record = from_recordings([one, one], most=100)
    np.testing.assert_allclose(record.readings[:n, 0], 0.5 * (current[0:100:2] + current[1:100:2]))
    np.testing.assert_allclose(record.readings[n:, 1], np.arange(0.5, 100.0, 2.0))
    assert np.flatnonzero(record.begins).tolist() == [0, 50]
    assert (record.averaged, record.dt_s) == pytest.approx((2, 2e-3))
    assert block_means(np.arange(7.0), 3).tolist() == [1.0, 4.0]
    # What was averaged while it was read counts, too: its voltage is no held one.
    for most, factor in ((100, 1), (50, 2)):
        again = from_recordings([replace(one, averaged=3)], most=most)
        assert (again.averaged, again.hold) == (3 * factor, "straight")
    assert len(from_recordings([recorded(current[:40])]).voltage_v) == 40
    with pytest.raises(UnusableError, match="only 39 samples; at least 40 are needed"):
        from_recordings([recorded(current[:39])])
    for ratio, is_same in ((1.0199, True), (1.0203, False)):
        # They may differ by two hundredths of their mean.
        pair = [one, recorded(current, dt_s=1e-3 * ratio)]
        differ = pytest.raises(UnusableError, match="differ in their sampling interval")
        with nullcontext() if is_same else differ:
            assert from_recordings(pair).dt_s == pytest.approx(0.5e-3 * (1.0 + ratio))
    with pytest.raises(UnusableError, match="different columns"):
        from_recordings([one, replace(one, speed_rad_s=None)])


def test_what_stands_still_counts_as_not_recorded() -> None:
    one = recorded(np.arange(50.0))
    seen = {
        "both": (one, [1.0, 1.0]),
        "current": (replace(one, speed_rad_s=np.full(50, 3.0)), [1.0, 0.0]),
        "speed": (replace(one, current_a=np.zeros(50)), [0.0, 1.0]),
    }
    for recording, expected in seen.values():
        assert from_recordings([recording]).recorded.tolist() == expected
    with pytest.raises(UnusableError, match="neither the current nor the speed ever changes"):
        from_recordings([replace(one, current_a=np.zeros(50), speed_rad_s=None)])
    with pytest.raises(UnusableError, match="only where the voltage was recorded"):
        from_recordings([replace(one, voltage_v=None)])
    duty = replace(one, voltage_v=None, duty=np.full(50, 0.25))
    assert at_terminals(duty, 12.0).voltage_v == pytest.approx(np.full(50, 3.0))
    at_motor = at_terminals(one, None, Circuit(shunt_ohm=0.5)).voltage_v
    np.testing.assert_allclose(at_motor, np.linspace(-1.0, 1.0, 50) - 0.5 * np.arange(50.0))  # type: ignore[arg-type]


def test_the_noise_of_a_column() -> None:
    white = np.random.default_rng(5).standard_normal(20_000)
    assert median_noise(0.03 * white + np.linspace(0.0, 2.0, 20_000)) == pytest.approx(0.03, rel=0.02)
    steps = np.repeat(np.arange(40.0), 50)
    assert median_noise(0.1 * steps) == pytest.approx(0.1 / math.sqrt(12.0))
    assert median_noise(steps % 2) == pytest.approx(0.02)  # a switch is no converter's step
    assert median_noise(np.full(50, 3.0)) == pytest.approx(3e-6)
    assert median_noise(np.zeros(50)) == 1e-12


def test_the_liveliest_stretch_of_each_part() -> None:
    volts = np.zeros(1000)
    volts[130:160:2] = volts[700:730:2] = 5.0
    found = liveliest_stretches(recorded(np.zeros(1000), volts=volts), 0.1, count=2)
    spans = [one.time_s[[0, -1]] * 1e3 for one in found]
    assert [len(one.time_s) for one in found] == [50, 50]
    for (first, last), begin, end in zip(spans, (130, 700), (160, 730), strict=True):
        assert first < begin
        assert last >= end - 2.5
    assert len(liveliest_stretches(recorded(np.arange(1000.0), volts=volts), 0.1)) == 10


def test_six_samples_without_a_current_are_an_open_circuit() -> None:
    """Between two jumps of the voltage, which falls meanwhile."""
    rng = np.random.default_rng(2)
    for n, is_open in ((6, True), (5, False)):
        voltage = np.concatenate([np.full(50, 7.0), np.linspace(6.0, 5.0, n), np.full(50, 9.0)])
        current = np.concatenate([np.full(50, 0.5), np.zeros(n), np.full(50, 0.7)])
        shown = np.stack([current + 1e-3 * rng.standard_normal(100 + n), 30.0 * voltage], axis=1)
        found = np.flatnonzero(open_circuit(voltage, shown, np.eye(1, 100 + n)[0]))
        assert found.tolist() == (list(range(50, 56)) if is_open else [])


def test_what_an_open_circuit_is_measured_by_leaves_rare_samples_out() -> None:
    """Three samples of 2,000 belong to the largest voltage, thirty to the largest current; half as many do not."""
    rng = np.random.default_rng(2)
    for spikes, inrush, is_open in ((3, 30, True), (1, 30, False), (3, 15, False)):
        voltage, current = np.full(2000, 20.0), np.full(2000, 0.5)
        voltage[:spikes], current[:inrush] = 100.0, 10.0
        voltage[1000:1200] = 1.0  # below 2 % of 100 V: recorded as none
        current[1000:1200] = 0.02  # below 0.3 % of 10 A
        shown = np.stack([current + 1e-4 * rng.standard_normal(2000), np.zeros(2000)], axis=1)
        shown[1000:1200, 1], shown[:1000, 1] = np.linspace(300.0, 100.0, 200), 300.0
        found = np.flatnonzero(open_circuit(voltage, shown, np.eye(1, 2000)[0]))
        assert found.tolist() == (list(range(1000, 1200)) if is_open else [])


def test_units_of_the_unknowns() -> None:
    """Each term's unit, by the peaks of 12 V, 3 A, 200 rad/s and a motor of 2 ohm, 0.03 V s."""
    record = replace(plain(500), readings=np.stack([np.full(500, 1.5), np.zeros(500)], axis=1))
    every = terms(record, values(NOISE_I=0.01), (12.0, 3.0, 200.0))
    torque, second = 0.03 * 3.0, 500 * DT_S
    units = {
        "R": 2.0, "L": 2.0 * DT_S, "K": 0.03, "J": 4e-6, "B": torque / 200.0, "coulomb": torque, "brush_drop": 12.0,
        "gear_loss": 1.0, "brush_knee": 3.0, "stribeck": 1.0, "coulomb_knee": 200.0, "load_constant": torque,
        "load_square": torque / 200.0**2, "offset_current": 3.0, "offset_speed": 200.0,
        "supply_resistance": 2.0, "sensor_lag": DT_S, "speed_lag": DT_S, "noise_current": 0.01,
        "noise_speed": 0.2, "noise_voltage": 0.036,
        "noise_torque": 0.01 * torque, "load_walk": 0.05 * torque / math.sqrt(second),
    }  # fmt: skip
    assert {name: term.unit for name, term in every.items()} == pytest.approx(units)
    beliefs = {name: term.prior_sd for name, term in every.items() if term.prior_sd < math.inf}
    assert beliefs == pytest.approx({
        "brush_drop": 0.1, "brush_knee": 0.01, "stribeck": 0.2, "coulomb_knee": 0.01, "load_constant": 0.3,
        "offset_current": 0.003, "offset_speed": 0.003,
    })  # fmt: skip
    usual = {name: term.usual for name, term in every.items() if term.usual != 1.0}
    assert usual == {
        "brush_knee": 0.01,
        "gear_loss": 0.1,
        "load_constant": 0.3,
        "load_square": 0.3,
        "supply_resistance": 0.1,
    }
    reach = 0.5 * second / DT_S
    bounds = {
        "R": (-5.0, 5.0), "L": (0.0, reach), "K": (-5.0, 5.0), "J": (-7.0, 7.0), "B": (0.0, 20.0),
        "coulomb": (0.0, 0.9), "gear_loss": (0.0, 0.5), "brush_drop": (0.0, 1.5 / 12.0),
        "brush_knee": (0.0, 0.5), "stribeck": (0.0, 2.0),
        "coulomb_knee": (0.0, 0.05), "load_constant": (-2.0, 2.0), "load_square": (0.0, 20.0),
        "offset_current": (-0.2, 0.2), "offset_speed": (-0.1, 0.1),
        "supply_resistance": (0.0, 1.0),
        "sensor_lag": (0.0, 5.0), "speed_lag": (0.0, 50.0),  # 10 ms and 0.1 s
        "noise_current": (-5.0, 5.0), "noise_speed": (-5.0, 5.0),
        "noise_voltage": (-6.0, 4.0), "noise_torque": (-6.0, 4.0), "load_walk": (-6.0, 6.0),
    }  # fmt: skip
    assert {name: (term.low, term.high) for name, term in every.items()} == bounds
    assert every["R"].value(0.3) == pytest.approx(2.0 * math.exp(0.3))
    assert every["L"].value(0.3) == pytest.approx(0.3 * 2.0 * DT_S)
    alone = terms(record.only(current=False, speed=True), values(), (12.0, 3.0, 200.0))
    assert alone["coulomb"].unit == pytest.approx(0.03 * 12.0 / 2.0)
    assert (
        terms(record.only(current=True, speed=False), values(), (12.0, 3.0, 9.0))["coulomb_knee"].unit
        == 400.0
    )
    weak = terms(record, values(), (12.0, 1e-9, 1e-9))
    assert (weak["offset_current"].unit, weak["coulomb_knee"].unit) == pytest.approx((0.006, 0.4))


@pytest.mark.parametrize(("volts", "most_v"), [(2.0, 0.8), (12.0, 1.5), (60.0, 1.5), (61.0, 2.5)])
def test_brushes_take_no_more_than_physics_allows(volts: float, most_v: float) -> None:
    term = terms(plain(500), values(), (volts, 3.0, 200.0))["brush_drop"]
    assert term.value(term.high) == pytest.approx(most_v)
    assert (None if term.bound is None else term.bound.most) == (None if volts == 2.0 else most_v)
    stated = terms(replace(plain(500), brush_drop_v=3.0), values(), (volts, 3.0, 200.0))["brush_drop"]
    assert stated.value(stated.high) == pytest.approx(min(3.0, 0.4 * volts))


@pytest.mark.parametrize(
    ("step", "low"), [(0.02, 0.02 / math.sqrt(12.0) / 0.2), (1e-4, math.exp(-5.0)), (9.0, 1.0)]
)
def test_no_noise_is_finer_than_the_steps_of_its_readings(step: float, low: float) -> None:
    rng, record = np.random.default_rng(2), plain(500)
    shown = step * np.round(rng.uniform(-30.0, 30.0, (500, 2)))
    shown[7, 1] += 1e-12  # a rounding error is no step
    every = terms(replace(record, readings=shown), values(NOISE_I=0.01, NOISE_W=0.2), (12.0, 3.0, 200.0))
    assert every["noise_speed"].low == pytest.approx(math.log(low))
    assert every["noise_current"].low == pytest.approx(
        min(max(math.log(step / math.sqrt(12.0) / 0.01), -5.0), 0.0)
    )


def test_values_of_the_unknowns() -> None:
    known = values(DRAG=1.5)
    one = solution(worked(values()), ["R", "L"], known, np.array([math.log(1.1), 0.4]))
    found = one.problem.values(one.theta)
    assert found[index.R] == pytest.approx(2.2)
    assert found[[index.B, index.COULOMB]] == pytest.approx([3e-6, 0.003])
    assert found[index.L] == pytest.approx(math.hypot(0.4 * 2.0 * DT_S, 0.01 * 2.2 * DT_S))
    assert known[index.B] == 2e-6


def test_the_misfit_is_the_likelihood_at_the_best_noise_level() -> None:
    """-2 log likelihood of the innovations, the noises times a common factor, without its constant."""
    record = worked(values(), n=120)
    one = solution(record, LOGS, values(NOISE_V=0.01), np.array([0.02, -0.01, 0.03]))
    out, sums = record.predict(one.problem.values(one.theta))
    white, count = out[1:, :2], 2 * 119
    assert one.problem.count == count
    likelihoods = [
        sums + count * math.log(s * s) + float(np.sum(white**2)) / (s * s) - count
        for s in np.geomspace(0.1, 1e3, 20_001)
    ]
    assert one.misfit == pytest.approx(min(likelihoods), abs=1e-3)
    assert one.bic() == pytest.approx(one.misfit + 3.0 * math.log(count))
    level = math.sqrt(np.mean(out[:, :2] ** 2))
    assert one.values[index.NOISE_I] == pytest.approx(level * 2e-3)
    assert one.values[index.NOISE_V] == pytest.approx(level * 0.01)


def test_beliefs_count_as_readings_do() -> None:
    """What is believed of a load joins the residuals at their scale: a normal prior of the log likelihood."""
    record = worked(values(), n=120)
    bare = solution(record, LOGS, values(LOAD=0.3 * 0.03 * record.peaks[1]), np.zeros(3))
    with_load = solution(record, [*LOGS, "load_constant"], values(), np.array([0.0, 0.0, 0.0, 0.3]))
    ours, theirs = (one.problem.residuals(one.theta) for one in (with_load, bare))
    np.testing.assert_allclose(ours[: len(theirs) - 3], theirs[:-3], rtol=1e-9)
    sums = record.predict(bare.problem.values(bare.theta))[1]
    assert ours[-4:] == pytest.approx([0.0, 0.0, 0.0, math.exp(0.5 * sums / (2 * 119))])


def test_slopes_of_the_fit_are_central_differences(small: Solution) -> None:
    problem, theta = small.problem, small.theta
    jacobian = problem.jacobian(theta, problem.residuals(theta))
    for n in range(len(theta)):
        side = 1e-5 * np.eye(len(theta))[n]
        exact = (problem.residuals(theta + side) - problem.residuals(theta - side)) / 2e-5
        size = np.abs(exact).max()
        np.testing.assert_allclose(jacobian[:, n], exact, atol=0.02 * size)
        wide = problem.secants(theta, [n], np.array([1e-5]))[:, 0]
        np.testing.assert_allclose(wide, exact, atol=1e-6 * size)
    high = np.array([0.0, 0.0, 0.0, 2.0])
    bound = problem.jacobian(high, problem.residuals(high), [3])[:, 0]
    wide = problem.secants(high, [2, 3], np.array([1e-3, 1e-4]))
    np.testing.assert_allclose(bound, wide[:, 1], atol=0.02 * np.abs(bound).max())


def test_a_fit_finds_what_made_the_record(small: Solution) -> None:
    clean = worked(values(), seed=2)
    found = solution(clean, LOGS, values(R=2.6, K=0.027, J=5e-6))
    sd = np.sqrt(
        np.diag(information_covariance(found.problem, found.theta, secants(found.problem, found.theta)))
    )
    exact = np.log([2.0 / 2.6, 0.03 / 0.027, 4.0 / 5.0])
    assert np.all(np.abs(found.theta - exact) < 3.5 * sd)
    assert np.all(sd < 0.01)
    r2 = found.explained()
    free = clean.predict(found.values, learn=False)[0][:, 2:4]
    left = 1.0 - ((clean.readings - free) ** 2).sum(axis=0) / (clean.readings.var(axis=0) * 400)
    assert r2 == pytest.approx(left)


def test_a_score_test_is_one_step_of_the_richer_fit(small: Solution) -> None:
    """By least squares on all columns at once; and close to a fit with the term."""
    every = terms(small.problem.record, small.problem.known)
    base = small.problem.residuals(small.theta)
    jacobian = small.problem.jacobian(small.theta, base)
    variance = float(base @ base) / small.problem.count
    tested = ("gear_loss", "load_square", "sensor_lag", "speed_lag", "supply_resistance")
    assert score_tests(small, every, ()) == {}
    assert set(candidates(small)) == set(tested)
    for change, lacking in (
        ({"hold": "late"}, {"supply_resistance"}),
        ({"recorded": np.array([1.0, 0.0])}, {"gear_loss", "speed_lag"}),
        ({"recorded": np.array([0.0, 1.0])}, {"gear_loss", "load_square", "sensor_lag", "supply_resistance"}),
    ):
        other = replace(small.problem, record=replace(small.problem.record, **change))
        assert set(candidates(replace(small, problem=other))) == set(tested) - lacking
    assert "sensor_lag" not in candidates(
        replace(small, problem=replace(small.problem, without=("sensor_lag",)))
    )
    found = score_tests(small, every, tested)
    assert set(found) == set(tested)
    for name, test in found.items():
        problem = small.problem.with_terms([every[name]])
        size = every[name].slope_at
        wide = (problem.residuals(np.append(small.theta, size))[: len(base)] - base) / size
        both = np.column_stack([jacobian, wide])
        step = -np.linalg.lstsq(both, base, rcond=None)[0]
        spread = variance * np.linalg.inv(both.T @ both)
        assert test.value == pytest.approx(step[-1], rel=1e-6)
        assert test.sd == pytest.approx(math.sqrt(spread[-1, -1]), rel=1e-6)
        gain = (step[-1] / math.sqrt(spread[-1, -1])) ** 2
        is_bound = every[name].low >= 0.0 and step[-1] < 0.0
        assert test.chi_square == pytest.approx(0.0 if is_bound else gain, rel=1e-6)
        np.testing.assert_allclose(test.moves, spread[:-1, -1] / spread[-1, -1], rtol=1e-4, atol=1e-7)
    # Of given sizes, over the usual one and within the bounds, the most telling counts: here a secant over each.
    sizes = (0.1, 1.0, 100.0)
    sized = score_tests(small, every, tested, sizes)
    for name in tested:
        chi_squares = []
        for size in sizes:
            side = min(size * every[name].usual, every[name].high)
            moved = small.problem.with_terms([every[name]]).residuals(np.append(small.theta, side))
            wide = (np.delete(moved, len(base)) - base) / side
            both = np.column_stack([jacobian, wide])
            step = -np.linalg.lstsq(both, base, rcond=None)[0]
            sd = math.sqrt(variance * np.linalg.inv(both.T @ both)[-1, -1])
            is_bound = every[name].low >= 0.0 and step[-1] < 0.0
            chi_squares.append((0.0 if is_bound else (step[-1] / sd) ** 2, step[-1], sd))
        expected = max(chi_squares, key=lambda one: one[0])
        got = sized[name]
        assert got.chi_square == pytest.approx(expected[0], rel=1e-5)
        if expected[0] > 0.0:
            assert (got.value, got.sd) == pytest.approx(expected[1:], rel=1e-5)
    richer = solution(small.problem.record, [*small.names, "load_square"], small.problem.known)
    square = found["load_square"]
    assert square.chi_square > 10.0
    assert small.misfit - richer.misfit == pytest.approx(square.chi_square, rel=0.3)
    assert richer.theta[-1] == pytest.approx(square.value, rel=0.1)


def test_a_lag_is_tested_where_it_shows() -> None:
    """Where the current settles within an interval, a lag far below it hides: its slope at 0 would tell nothing."""
    quick = values(L=1e-4)  # twenty time constants of the winding an interval
    best = solution(worked(quick), LOGS, quick)
    test = score_tests(best, terms(best.problem.record, best.problem.known), ["sensor_lag"])["sensor_lag"]
    assert test.sd < 0.01
    assert abs(test.value) < 4.0 * test.sd


def test_a_term_is_taken_where_the_evidence_is_strong(
    monkeypatch: pytest.MonkeyPatch, small: Solution
) -> None:
    """Its score lies beyond log(n) + 6, and its fit is better by 6 than the criterion asks."""
    border = math.log(small.problem.count) + 6.0
    better: list[float] = [0.0]
    refits: list[str] = []

    def solved(best: Solution, added: list[Any]) -> Solution:
        problem = best.problem.with_terms(added)
        refits.append(added[0].name)
        misfit = best.misfit - math.log(best.problem.count) - better[0]
        return Solution(problem, np.append(best.theta, 0.0), misfit)

    monkeypatch.setattr(fitting, "_refit", solved)
    for score, gain, is_taken in (
        (border + 0.01, 6.01, True),
        (border + 0.01, 5.99, False),
        (border - 0.01, 9.0, False),
    ):
        tests = {
            "sensor_lag": ScoreTest(score, 1.0, 0.1, np.zeros(4)),
            "speed_lag": ScoreTest(1.0, 1.0, 0.1, np.zeros(4)),
        }
        monkeypatch.setattr(
            fitting, "score_tests", lambda best, *_, tests=tests: {} if "sensor_lag" in best.names else tests
        )
        better[0] = gain
        refits.clear()
        found = fitting._grown(small)
        assert (found.names[-1] == "sensor_lag") is is_taken
        assert refits == (["sensor_lag"] if score > border else [])


def walked(rho: float, n: int = 600) -> Line:
    """Two unknowns and a noise; regressors and errors that remember."""
    rng = np.random.default_rng(4)
    drawn = rng.standard_normal((n, 4))
    for k in range(1, n):
        drawn[k] += rho * drawn[k - 1]
    return Line(drawn[:, :3] * [1.0, 3.0, 1.0], drawn[:, 3], ("R", "K", "noise_current"))


def test_errors_of_white_residuals_are_those_of_least_squares() -> None:
    line = walked(0.0)
    theta = least_squares(line)
    found = information_covariance(cast("Any", line), theta, secants(cast("Any", line), theta))
    left = line.residuals(theta)
    expected = np.linalg.inv(line.design[:, :2].T @ line.design[:, :2]) * (left @ left) / 600
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert motor_unknowns(cast("Any", line)) == [0, 1]
    line.design *= [1e6, 1e-3, 1.0]
    units, scaled = np.array([1e-6, 1e3]), theta * np.array([1e-6, 1e3, 1.0])
    np.testing.assert_allclose(
        information_covariance(cast("Any", line), scaled, secants(cast("Any", line), scaled)),
        expected * np.outer(units, units),
    )


@pytest.mark.parametrize("rho", [0.9, 0.0, -0.6])
def test_errors_of_residuals_that_remember_are_those_of_newey_and_west(rho: float) -> None:
    line = walked(rho)
    theta = least_squares(line)
    found, _ = sandwich(*normalised(cast("Any", line), theta, line.design[:, :2], [0, 1]))
    size = math.sqrt(float(line.residuals(theta) @ line.residuals(theta)) / 600)
    left, design = line.residuals(theta) / size, line.design[:, :2] / size
    series = left - left.mean()
    full = np.array([series[lag:] @ series[: 600 - lag] / 600.0 for lag in range(60)])
    taper = full * (1.0 - np.arange(60) / 60.0)
    wrapped = np.concatenate([taper, np.zeros(601), taper[:0:-1]])
    coloured = circulant(
        np.fft.ifft(np.maximum(np.fft.fft(wrapped).real, difference_noise(series) ** 2)).real
    )
    weak = np.eye(2) / 9.0  # logarithms are known to 3 beforehand
    bread = np.linalg.inv(design.T @ design + weak)
    expected = bread @ (design.T @ coloured[:600, :600] @ design + weak) @ bread
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    white = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert (np.sqrt(np.diag(found)) > 2.0 * white).all() == (rho == 0.9)


def test_what_was_left_out_and_other_optima_widen_the_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    line = walked(0.0)
    theta = least_squares(line)
    tests = {"sensor_lag": ScoreTest(4.0, 0.5, 0.2, np.array([0.1, -0.3, 9.0]))}
    line.available_terms["sensor_lag"] = cast("Any", SimpleNamespace(usual=0.6))
    best = SimpleNamespace(
        problem=line, theta=theta, alternative_optima=(), misfit=10.0, free=(None, np.zeros((600, 4)))
    )
    monkeypatch.setattr(uncertainty, "_systematic_covariance", lambda *_: np.zeros((2, 2)))
    monkeypatch.setattr(uncertainty, "score_tests", lambda *_: {})
    monkeypatch.setattr(uncertainty, "unmodelled_effects", lambda _: [])
    monkeypatch.setattr(uncertainty, "quantisation_effects", lambda _: [])
    without = uncertainty.covariance(cast("Any", best))
    monkeypatch.setattr(uncertainty, "score_tests", lambda *_: tests)
    added = uncertainty.covariance(cast("Any", best)) - without
    odds = 0.2 / math.hypot(0.2, 0.6) * math.exp(2.0)
    size = odds / (1.0 + odds) * (0.5**2 + 0.2**2)
    np.testing.assert_allclose(added, size * np.outer([0.1, -0.3], [0.1, -0.3]), rtol=1e-7, atol=1e-12)
    monkeypatch.setattr(uncertainty, "score_tests", lambda *_: {})
    best.alternative_optima = (
        (theta + np.array([0.2, 0.0, 5.0]), 12.0),
        (theta - np.array([0.0, 0.1, 5.0]), 11.0),
    )
    added = uncertainty.covariance(cast("Any", best)) - without
    shares = np.exp([-1.0, -0.5])
    shares /= 1.0 + shares.sum()
    np.testing.assert_allclose(added, np.diag(shares * [0.04, 0.01]), rtol=1e-7, atol=1e-12)
    # What no term says is believed to be of size 1; the record settles a share of it.
    best.alternative_optima = ()
    monkeypatch.setattr(uncertainty, "unmodelled_effects", lambda _: [tests["sensor_lag"]])
    added = uncertainty.covariance(cast("Any", best)) - without
    settled = 1.0 / (1.0 + 0.2**2)
    size = (settled * 0.5) ** 2 + settled * 0.2**2
    np.testing.assert_allclose(added, size * np.outer([0.1, -0.3], [0.1, -0.3]), rtol=1e-7, atol=1e-12)
    # What rounding moves counts in full, and what follows the unknowns throughout.
    monkeypatch.setattr(uncertainty, "unmodelled_effects", lambda _: [])
    monkeypatch.setattr(uncertainty, "quantisation_effects", lambda _: [tests["sensor_lag"]])
    monkeypatch.setattr(uncertainty, "_systematic_covariance", lambda *_: np.diag([0.02, 0.03]))
    added = uncertainty.covariance(cast("Any", best)) - without
    moved = np.outer([0.1, -0.3], [0.1, -0.3]) + np.diag([0.02, 0.03])
    np.testing.assert_allclose(added, moved, rtol=1e-7, atol=1e-12)


def test_a_direction_of_which_nothing_is_known_has_a_hopeless_variance() -> None:
    line = walked(0.0)
    line.design[:, 1] *= 1e-6
    theta = np.zeros(3)
    found = information_covariance(cast("Any", line), theta, secants(cast("Any", line), theta))
    assert found[1, 1] == pytest.approx(1e6 * float(line.target @ line.target) / 600)


def test_slow_is_a_hundredth_of_nearly_the_fastest() -> None:
    """Not of the fastest: a few wild samples make no motor stand still."""
    w = np.repeat([10.0, -0.05, 0.0, 20.0, 1e4], [480, 500, 1, 14, 5])
    directions = _sign(w)[[0, 500, 980, 999]]
    np.testing.assert_allclose(directions, [1.0, -0.25, 0.0, 1.0], rtol=1e-6)


def test_regressions_begin_near_the_motor() -> None:
    """Without noise, at fine steps: each of the three kinds finds what its channels tell."""
    p = values(L=4e-3, B=4e-5, COULOMB=0.001, NOISE_I=1e-9, NOISE_W=1e-9)
    record = worked(p, n=16_000, hold="straight", noise=0.0, dt_s=1e-4)
    told = [index.R, index.L, index.K, index.J]
    best = min(initial_values(record), key=lambda one: float(np.abs(np.log(one[told] / p[told])).sum()))
    np.testing.assert_allclose(best[told], p[told], rtol=0.02)
    assert best[[index.B, index.COULOMB]] == pytest.approx(p[[index.B, index.COULOMB]], rel=0.1)
    alone = record.only(current=True, speed=False)
    # The resistance is one of nine, so that a motor is taken whose resistance is among them.
    volts, amps, _ = record.peaks
    share = min(np.geomspace(0.04, 2.0, 9), key=lambda one: abs(math.log(one * volts / amps / 2.0)))
    scale = 2.0 / (share * volts / amps)
    found = [one for one in initial_values(alone) if one[index.R] == pytest.approx(2.0 / scale)]
    assert {one[index.K] for one in found} == {1.0}
    near = min(found, key=lambda one: abs(math.log(one[index.J] / (4e-6 / 0.03**2))))
    assert near[index.J] == pytest.approx(4e-6 / 0.03**2, rel=0.35)
    speed = record.only(current=False, speed=True)
    lag, dead = 2.0 * 4e-6 / 0.03, 2.0 * 0.001 / 0.03
    drag = 2.0 * 4e-5 / 0.03
    near = min(initial_values(speed), key=lambda one: abs(math.log(one[index.K] / (0.03 + drag))))
    assert near[[index.R, index.B]].tolist() == [1.0, 0.0]
    assert near[index.K] == pytest.approx(0.03 + drag, rel=0.02)
    assert near[index.J] / near[index.K] == pytest.approx(lag, rel=0.25)
    assert near[index.COULOMB] / near[index.K] == pytest.approx(dead, rel=0.3)


def at(record: Record, names: list[str], p: FloatArray) -> Solution:
    """The model of these values as the fit of these terms; without a walking load."""
    begin = solution(record, names, p, np.zeros(len(names)))
    pairs = [(p[term.place] / term.unit, term.is_log) for term in begin.problem.free]
    theta = [math.log(max(value, 1e-3)) if is_log else value for value, is_log in pairs]
    return replace(begin, theta=np.array(theta))


@pytest.mark.parametrize(
    ("turns", "square", "load", "share"),
    [
        (1.0, 0.0, 6e-3, 4.0),
        (1.0, 0.0, -1e-3, 0.5),
        (1.0, 0.0, -9e-3, 0.01),
        (-1.0, 0.0, 1e-3, 0.5),
        (1.0, 8e-9, 6e-3, 2.5),
    ],
)
@pytest.mark.parametrize("walks", [False, True])
def test_a_fit_without_a_load_begins_with_its_drag_as_friction(
    monkeypatch: pytest.MonkeyPatch, turns: float, square: float, load: float, share: float, walks: bool
) -> None:
    """At a mean speed of 500 rad/s: 2e-3 N m of dry and viscous friction, and as much again of a fan.

    A third of the load is the mean of one that walks. Friction is held where it could balance that.
    """
    p = values(COULOMB=5e-4, B=3e-6, SQUARE=square, LOAD=load / 3.0 if walks else load, WALK=1e-3 * walks)
    drags = ["coulomb", "B", "load_square"]
    names = ["R", *drags, "load_constant", *["load_walk"] * walks]
    begin = at(plain(50, np.full(50, 6.0)), names, p)
    walked = np.zeros((50, 6))
    walked[:, 4] = np.linspace(0.0, 4.0 * load / 3.0, 50) * walks
    monkeypatch.setattr(Record, "predict", lambda *_: (walked, 0.0))
    monkeypatch.setattr(Problem, "solve", lambda problem, theta: (problem, theta))
    problem, theta = cast("Any", without_load(begin, 500.0 * turns))
    assert problem.names == (("R", "load_walk") if walks else ("R", *drags))
    known = dict(zip(names, begin.theta, strict=True))
    for name, one in zip(problem.names, theta, strict=True):
        assert one == pytest.approx((share if name in drags else 1.0) * known[name], rel=1e-6), name
    at_drag = [index.COULOMB, index.B, index.SQUARE]
    np.testing.assert_allclose(problem.known[at_drag], share * p[at_drag])
    assert problem.known[index.LOAD] == 0.0


def test_a_fit_without_a_load_finds_the_friction() -> None:
    """Of a motor that never reverses, where a load of nine tenths of the dry friction had been taken off it."""
    truth = values(COULOMB=0.002)
    record = worked(truth, n=600, lowest=4.0)
    wrong = values(COULOMB=0.02, LOAD=-0.018, WALK=1e-3)
    found = without_load(at(record, [*LOGS, "coulomb", "B", "load_constant"], wrong), 250.0)
    drag, expected = (p[index.COULOMB] + 250.0 * p[index.B] for p in (found.values, truth))
    assert drag == pytest.approx(expected, rel=0.05)
    assert found.values[index.LOAD] == 0.0


@pytest.mark.parametrize("turns", [1.0, -1.0])
def test_all_that_brakes_is_the_drag_where_a_load_walks_and_the_motor_turns_one_way(turns: float) -> None:
    """By the balance of energy, whatever load takes a part of it; where the motor reverses the factor is the fit's."""
    truth = values(COULOMB=0.002 * 3.0, B=2e-6 * 3.0)
    record = worked(truth, n=600, lowest=4.0)
    record = replace(record, voltage_v=turns * record.voltage_v, readings=turns * record.readings)
    known = values(COULOMB=0.002, B=2e-6, WALK=5e-3, DRAG=1.0)
    fits = [fit_window(record, known, ("load_walk",), one_way=one_way) for one_way in (True, False)]
    balanced, fitted = (math.exp(fit.logs[3]) for fit in fits)
    sd, wide = (math.sqrt(fit.covariance[3, 3]) for fit in fits)
    assert balanced == pytest.approx(3.0, rel=0.01)
    assert sd < 0.2 * wide
    assert abs(balanced - fitted) > 3.0 * sd
    np.testing.assert_array_equal(fits[0].logs[:3], fits[1].logs[:3])
    loaded = known.copy()
    loaded[index.LOAD] = turns * 0.002
    less = fit_window(record, loaded, ("load_walk",), one_way=True)
    speed = float(np.mean(np.square(record.readings[:, 1]))) / float(np.mean(np.abs(record.readings[:, 1])))
    assert balanced - math.exp(less.logs[3]) == pytest.approx(0.002 / (0.002 + 2e-6 * speed), rel=0.02)


def test_the_balance_of_energy_by_hand() -> None:
    """Of two recordings of a motor with a fan and a known load: the speed between them is no gain."""
    truth = values(COULOMB=0.006, B=6e-6, SQUARE=2e-8, LOAD=1e-3)
    first, second = (worked(truth, seed=seed, n=200, lowest=4.0) for seed in (1, 2))
    begins = np.concatenate([first.marks, second.marks])
    record = replace(
        first,
        voltage_v=np.concatenate([first.voltage_v, second.voltage_v]),
        readings=np.concatenate([first.readings, second.readings]),
        marks=begins,
    )
    known = values(COULOMB=0.002, B=2e-6, SQUARE=2e-8, LOAD=1e-3, WALK=5e-3, DRAG=1.0)
    fit, plainly = (fit_window(record, known, ("load_walk",), one_way=one_way) for one_way in (True, False))

    def whole(p: FloatArray) -> tuple[float, float]:
        i, w = record.predict(p)[0][:, 2:4].T
        given = w @ (p[index.K] * i - 1e-3 - 2e-8 * w**2)
        gained = sum(
            float(w[n + 1] ** 2 - w[n] ** 2) for n in range(len(w) - 1) if begins[n + 1] != ekf.BEGIN
        )
        work = float(w @ (0.002 + 2e-6 * w))
        noise = p[index.K] * math.sqrt(p[index.NOISE_I] ** 2 * (w @ w) + p[index.NOISE_W] ** 2 * (i @ i))
        return (given - 0.5 * p[index.J] * gained / record.dt_s) / work, noise / work

    factor, noise = whole(fit.values)
    assert math.exp(fit.logs[3]) == pytest.approx(factor, rel=1e-5)
    assert factor == pytest.approx(3.0, rel=0.02)
    moved = np.tile(fit.values, (4, 1))
    for row, at_ in zip(moved, ([index.R], [index.K], [index.J]), strict=False):
        row[at_] *= math.exp(1e-5)
    f = math.exp(plainly.logs[3])
    moved[3, [index.COULOMB, index.B]] *= 1.0 + 1e-5 / f
    slopes = np.array([whole(row)[0] - factor for row in moved]) / (1e-5 * factor)
    spread = plainly.covariance.copy()
    spread[3] /= math.log(f) / (f - 1.0)
    spread[:, 3] /= math.log(f) / (f - 1.0)
    expected = slopes @ spread @ slopes + (noise / factor) ** 2
    assert fit.covariance[3, 3] == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(fit.covariance[3, :3], (slopes @ spread)[:3], rtol=0.05, atol=1e-9)


@pytest.mark.parametrize("noise_rad_s", [0.0, 0.1])
def test_the_drag_of_a_motor_that_stands_is_not_told(noise_rad_s: float) -> None:
    """It does no work that a balance could tell."""
    known = values(COULOMB=0.002, B=2e-6, WALK=5e-3, DRAG=1.0)
    volts, *noise = np.random.default_rng(4).standard_normal((3, 300))
    record = plain(300, 0.001 * volts)
    record = replace(record, readings=np.transpose(noise) * [1e-3, noise_rad_s])
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
    known = values(DRAG=1.0, COULOMB=0.004)
    changed = values(R=2.4, K=0.029, J=4.4e-6, COULOMB=0.008, B=4e-6)
    found = fit_window(worked(changed, n=800), known, ())
    exact = np.log([1.2, 0.029 / 0.03, 1.1, 2.0]) + np.log([2.0, 0.03, 4e-6, 1.0])
    sd = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.logs - exact) < 3.5 * sd)
    assert np.all(sd < 0.05)
    assert found.values[index.COULOMB] == pytest.approx(0.008, rel=0.05)
    # The drag's factor f has the error of the information; its logarithm that over the way from 1 to f.
    fitted = solution(worked(changed, n=800), LOGS, known, np.zeros(3)).problem
    every = terms(fitted.record, known)
    drag = replace(every["coulomb"], name="drag", place=index.DRAG, unit=1.0, low=0.05, high=20.0)
    problem = Problem(fitted.record, known, (*fitted.free, drag))
    factor = math.exp(found.logs[3])
    theta = np.array([*(found.logs[:3] - np.log([2.0, 0.03, 4e-6])), factor])
    plain_ = information_covariance(problem, theta, secants(problem, theta))
    slope = np.array([1.0, 1.0, 1.0, math.log(factor) / (factor - 1.0)])
    np.testing.assert_allclose(found.covariance, plain_ * np.outer(slope, slope), rtol=1e-6)


@pytest.fixture(scope="module")
def identified() -> OperationFit:
    """A record with current and speed that is quickly fitted."""
    record = worked(values(B=2e-5, NOISE_V=1e-3), n=500)
    time_s = DT_S * np.arange(500.0)
    volts = record.voltage_v + 1e-3 * np.random.default_rng(3).standard_normal(500)
    current, speed = record.readings.T
    return identify_operation([Recording(Path("log.csv"), time_s, current, volts, speed)])


def test_intervals_are_those_of_the_covariance(identified: OperationFit) -> None:
    """Each interval by its unknown's standard error: 95 of 100, 1.959964 of them on either side."""
    found = identified
    spread, problem = found.covariance, found.solution.problem
    free = [problem.free[n] for n in motor_unknowns(problem)]
    theta = found.solution.theta[motor_unknowns(problem)]
    assert len(spread) == len(free)
    shown = iter(found.quantities)
    for row, (term, one) in enumerate(zip(free, theta, strict=True)):
        half = 1.959964 * math.sqrt(spread[row, row])
        value = term.value(one)
        low, high = value - half * term.unit, value + half * term.unit
        if term.is_log:
            low, high = value * math.exp(-half), value * math.exp(half)
        elif term.low >= 0.0:
            low = max(low, 0.0)
        relative = half / 1.959964 * (1.0 if term.is_log else term.unit / max(abs(value), 1e-300))
        if term.name in ("brush_knee", "stribeck", "coulomb_knee") and relative >= 0.5:
            continue
        found_one = next(shown)
        assert found_one.name.split("/")[0].split()[-1] in (term.name, "J", "coulomb")
        assert (found_one.value, found_one.low, found_one.high) == pytest.approx(
            (value, low, high), rel=1e-4, abs=1e-4 * half * term.unit
        )
        assert found_one.log_sd == pytest.approx(relative)
        assert found_one.is_determined is bool(relative < 0.5)
    p, speed = found.solution.values, found.record.predict(found.solution.values)[0][:, 3]
    w = math.sqrt(np.mean(speed**2))
    drag = next(shown)
    torque = p[index.B] * w + p[index.COULOMB] + p[index.SQUARE] * w * w
    moves = {"B": w, "coulomb": 1.0, "load_square": w * w}
    gradient = np.array([moves.get(term.name, 0.0) * term.unit for term in free])
    sd = math.sqrt(gradient @ spread @ gradient)
    assert drag.name == "drag"
    assert drag.value == pytest.approx(torque)
    expected = (max(torque - 1.959964 * sd, 0.0), torque + 1.959964 * sd)
    assert (drag.low, drag.high) == pytest.approx(expected, rel=1e-4)
    assert drag.log_sd == pytest.approx(sd / torque)
    for name, true in {"R": 2.0, "K": 0.03, "J": 4e-6}.items():
        told = found.quantity(name)
        assert told.low < true < told.high or abs(math.log(told.value / true)) < 3.5 * told.log_sd


def test_the_drag_is_as_uncertain_as_its_parts_together() -> None:
    """Viscous and dry friction and a fan at the effective speed, by hand."""
    names, p = [*LOGS, "B", "coulomb", "load_square"], values(SQUARE=5e-10)
    one = solution(worked(p), names, p, np.array([0.0, 0.0, 0.0, 1e-3, 0.1, 0.2]))
    w = math.sqrt(np.mean(one.free[0][:, 3] ** 2))
    units = np.array([term.unit for term in one.problem.free[3:]])
    theta, sds = one.theta[3:], np.array([1e-4, 0.02, 0.03])
    found = _drag(one, np.diag(np.append(np.zeros(3), sds)) ** 2, "drag", "N m")
    assert found is not None
    parts = units * [w, 1.0, w * w]
    assert found.value == pytest.approx(parts @ theta)
    assert found.log_sd * found.value == pytest.approx(np.linalg.norm(parts * sds))


def test_one_channel_alone_tells_ratios_in_their_units(identified: OperationFit) -> None:
    units = {
        "current": {"R": "ohm", "L": "H", "J/K^2": "A s/V", "B/K^2": "A/V", "coulomb/K": "A", "drag/K": "A"},
        "speed": {"K": "V s/rad", "R J": "A s2/rad ohm", "R coulomb": "V2 s/rad"},
    }
    true = {"R": 2.0, "J/K^2": 4e-6 / 0.03**2, "coulomb/K": 0.002 / 0.03, "R J": 8e-6, "R coulomb": 0.004}
    for channel, expected in units.items():
        alone = identified.record.only(current=channel == "current", speed=channel == "speed")
        found = identify_record(alone)
        assert {one.name: one.unit for one in found.quantities if one.name in expected} == expected
        for one in found.quantities:
            if one.name in true and one.is_determined:
                assert one.value == pytest.approx(true[one.name], rel=0.08)
        with pytest.raises(InputError, match="needs current and speed"):
            motor_of_log(found, "mine")
    assert found.r2_current is None
    p = found.solution.values
    told = [
        f"{1.0 / p[index.K]:.4g} rad/s a volt",
        f"time constant of {p[index.J] / p[index.K] ** 2:.3g} s",
    ]
    told += [f"dead voltage of {p[index.COULOMB] / p[index.K]:.3g} V"]
    assert all(words in found.notes[0] for words in told)


def known(joint: OperationFit) -> identifying.Identification:
    """Of one log."""
    log = Recording(Path("log.csv"), np.arange(2.0), np.zeros(2))
    return identifying.Identification((), (log,), {log.path: RegimeDecision("operation", "as asked")}, joint)


def test_text_json_and_motor_file_say_the_same(identified: OperationFit) -> None:
    (told,), text = known(identified).to_json(), known(identified).text().splitlines()
    for one, line in zip(identified.quantities, text[3:], strict=False):
        said = told["parameters"][one.name]
        assert said == {
            "value": one.value,
            "standard_error": pytest.approx((one.high - one.low) / 3.92),
            "interval": [one.low, one.high],
            "unit": one.unit,
            "determined": one.is_determined,
        }
        words = f"{one.name} {one.value:.4g} +- {said['standard_error']:.2g} {one.unit} "
        assert " ".join(line.split()).startswith(words)
        assert (f"{one.low:.4g} to {one.high:.4g}" if one.is_determined else "not determined") in line
    assert told["model"] == list(identified.model)
    assert (told["r2_current"], told["r2_speed"]) == identified.solution.explained()
    assert told["voltage"] == identified.record.hold
    assert told["taken_for"] == {"regime": "operation", "why": "as asked"}
    units = {
        "R": "ohm",
        "L": "H",
        "K": "V s/rad",
        "J": "kg m2",
        "B": "N m s/rad",
        "coulomb": "N m",
        "drag": "N m",
    }
    assert {one.name: one.unit for one in identified.quantities} | units == {
        one.name: one.unit for one in identified.quantities
    }
    motor, p = motor_of_log(identified, "mine"), identified.solution.values
    assert motor.parameters.resistance_ohm == p[index.R]
    assert motor.parameters.inductance_h == p[index.L]
    assert (
        motor.parameters.torque_constant_n_m_per_a
        == motor.parameters.back_emf_constant_v_s_per_rad
        == p[index.K]
    )
    assert motor.parameters.inertia_kg_m2 == p[index.J]
    assert motor.parameters.viscous_friction_n_m_s_per_rad == p[index.B]
    assert (motor.coulomb_friction_n_m, motor.brush_drop_v) == (p[index.COULOMB], p[index.DROP])
    assert (motor.current_noise_a, motor.speed_noise_rad_s) == (p[index.NOISE_I], p[index.NOISE_W])
    assert motor.nominal_voltage_v == identified.record.peaks[0]


def test_only_what_a_motor_can_be_is_told(identified: OperationFit) -> None:
    """The free model explains half of what is no noise, and a fifth of all in any case; L/R lies below 0.2 s."""
    record, rng = identified.record, np.random.default_rng(1)
    moves = np.where(np.arange(len(record.voltage_v)) // 40 % 2 == 0, 1.0, -1.0)
    for noise, part in ((0.0, 0.5), (0.7, 0.33), (9.0, 0.2)):
        readings = moves[:, None] + noise * rng.standard_normal((len(moves), 2))
        shown = replace(identified, record=replace(record, readings=readings))
        for n, name in enumerate(("r2_current", "r2_speed")):
            share = difference_noise(readings[:, n]) ** 2 / np.var(readings[:, n])
            least = max(float(0.5 * (1.0 - share)), 0.2)
            assert least == pytest.approx(part, abs=0.04)
            for r2, is_refused in ((least - 1e-6, True), (least + 1e-6, False), (math.nan, True)):
                refusal = pytest.raises(UnusableError, match=f"no motor model explains the {name[3:]}")
                with refusal if is_refused else nullcontext():
                    _refuse_poor_fit(replace(shown, **cast("Any", {name: r2})))
    ohm = identified.quantity("R").value
    for lag, is_refused in ((0.201, True), (0.199, False)):
        slow = tuple(
            replace(one, value=lag * ohm, is_determined=True) if one.name == "L" else one
            for one in identified.quantities
        )
        refusal = pytest.raises(UnusableError, match="is that of no motor")
        with refusal if is_refused else nullcontext():
            _refuse_poor_fit(replace(identified, quantities=slow))


def test_the_command_tells_logs_from_starts(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    identified: OperationFit,
) -> None:
    """A log and a start together: both are told, as text and as JSON; the status is that of the worse."""
    record = identified.record
    rows = np.column_stack([DT_S * np.arange(500.0), record.voltage_v, record.readings])
    log, toml = tmp_path / "log.csv", tmp_path / "motor.toml"
    np.savetxt(log, rows, delimiter=",", header="time_s,voltage_v,current_a,speed_rad_s", comments="")
    start = str(Path(__file__).parents[4] / "examples" / "startup_capture.csv")
    monkeypatch.setattr(identifying, "identify_operation", lambda _: identified)
    assert main(["identify", str(log), start, "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert (first["files"], second["files"]) == ([start], [str(log)])
    assert second["parameters"] == known(identified).parameters
    assert main(["identify", str(log), start, "-o", str(toml)]) == 0
    said = capsys.readouterr().out
    assert f"{start}: model textbook; 95 % intervals" in said
    model = " + ".join(identified.model)
    assert f"{log}: model {model}; 95 % intervals\n  taken for a motor at work (the voltage reverses" in said
    assert main(["identify", str(log), "--regime", "operation", "-o", str(toml)]) == 0
    assert "(as asked)" in capsys.readouterr().out
    assert load_motor(toml).parameters.inertia_kg_m2 == identified.solution.values[index.J]
    assert main(["identify", str(log), "--regime", "rest"]) == 2
    monkeypatch.setattr(identifying, "identify_operation", lambda _: refuse())
    assert main(["identify", str(log), start]) == 3
    assert f"{log}: unusable: no motor" in capsys.readouterr().out
    assert main(["identify", str(log), "-o", str(toml)]) == 2
    assert "no motor file: no motor" in capsys.readouterr().err


def refuse() -> OperationFit:
    raise UnusableError("no motor")


def test_a_duty_and_a_shunt_reach_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Recording] = []

    def unfitted(recordings: tuple[Recording, ...]) -> OperationFit:
        given.extend(recordings)
        return refuse()

    monkeypatch.setattr(identifying, "identify_operation", unfitted)
    one = replace(recorded(np.full(50, 2.0)), voltage_v=None, duty=np.full(50, 0.5))
    found = identify([one], voltage_v=12.0, circuit=Circuit(shunt_ohm=0.25), regime="operation")
    assert given[0].voltage_v == pytest.approx(np.full(50, 6.0 - 0.5))
    assert (found.is_complete, found.trouble, found.parameters) == (False, "no motor", {})
