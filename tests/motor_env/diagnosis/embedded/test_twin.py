"""The twin of the exported C source: against the package's filter and rules, and in fixed point."""

import errno
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Cusum,
    Fault,
    FaultKind,
    KalmanFilter,
    Motor,
    Scenario,
    SensorParameters,
    Transients,
    run_filter,
    simulate,
)
from motor_env.cli import main
from motor_env.diagnosis.embedded import source
from motor_env.diagnosis.embedded.arithmetic import Numbers, Row, fixed_point, floating
from motor_env.diagnosis.embedded.monitor import CusumBank, Monitor, Readings, monitor_of, steady_schedule
from motor_env.diagnosis.embedded.source import checks, write_library
from motor_env.diagnosis.embedded.twin import SampleVerdict, TwinResult, readings_of, run_twin

# Reaches in: the gain that is exported ends the filter's schedule, which it is compared with.
from motor_env.filters.kalman import schedule
from motor_env.motor.model import steady_state

RULES = {"bank": CusumBank(), "one shift": CusumBank((0.5,), ())}
YEAR_SAMPLES = 365.25 * 86_400.0 * 10_000.0


thresholds_for = cache(CusumBank.thresholds_for)


@pytest.fixture(autouse=True)
def solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An integral equation takes its time, so once for each rule and each number of samples."""
    monkeypatch.setattr(CusumBank, "thresholds_for", thresholds_for)


def monitor(name: str = "bank", n_channels: int = 1) -> Monitor:
    """Of the textbook motor at 10 kHz."""
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED)[:n_channels], 0.02, 1.0)
    motor = Motor("paper", "data_sheet", PAPER_MOTOR)
    return monitor_of(motor, 10_000.0, rule=RULES[name], sensor=sensor, voltage_v=12.0)


def first(answer: TwinResult) -> NDArray[np.int64]:
    faulty = answer.verdict == SampleVerdict.FAULT
    return np.where(faulty.any(axis=1), faulty.argmax(axis=1), -1)


def starts(believed: Monitor, count: int, severity: float = 0.25) -> Transients:
    channels = (Channel.CURRENT, Channel.SPEED)[: len(believed.kalman.observation)]
    faults = (Fault(FaultKind.BEARING, severity),)
    return simulate(
        Scenario(PAPER_MOTOR, faults, sensor=SensorParameters(channels, 0.02, 1.0)), 1, range(count)
    )


def expected(believed: Monitor, data: Transients) -> NDArray[np.float64]:
    """The statistic of the package's filter and rules, as a share of its threshold."""
    result = run_filter(believed.kalman, data.measurements, data.voltage_v)
    predicted = result.state - np.einsum("nij,bnj->bni", result.gain, result.innovation)
    share = 2.0 ** -floating(believed).memory
    slow = lfilter([share], [1.0, share - 1.0], predicted, axis=1)
    along = [slow[..., 1]] * len(believed.rule.friction)
    along += [predicted[..., 0] - slow[..., 0]] * len(believed.rule.winding)
    shares = []
    for shift, threshold, sign in zip(believed.rule.shifts, believed.thresholds, along, strict=True):
        signed = np.where(sign < 0.0, -1.0, 1.0) * result.whitened[..., 0]
        shares.append(Cusum(shift, two_sided=True).statistic(signed[..., None]) / threshold)
    statistic: NDArray[np.float64] = np.max(shares, axis=0)
    return statistic


@pytest.mark.parametrize(("rule", "n_channels"), [("bank", 1), ("bank", 2), ("one shift", 1)])
def test_twin_is_filter_and_rule(rule: str, n_channels: int) -> None:
    believed = monitor(rule, n_channels)
    data = starts(believed, 20)
    reference = expected(believed, data)
    exact = floating(believed, np.float64)
    statistic = run_twin(exact, readings_of(exact, data.measurements, data.voltage_v)).statistic
    np.testing.assert_allclose(statistic, reference, rtol=1e-9, atol=1e-9)
    above = reference > 1.0
    alarms = np.where(above.any(axis=1), above.argmax(axis=1), -1)
    for numbers in (floating(believed), fixed_point(believed, believed.limits.counts())):
        answer = run_twin(numbers, readings_of(numbers, data.measurements, data.voltage_v))
        off = np.abs(first(answer) - alarms)
        assert off.max() <= 1
        assert np.mean(off == 0) >= 0.9


@pytest.mark.parametrize(("held_from", "powers"), [(0, [8]), (300, [8, 9]), (2**30, range(8, 21))])
def test_gains_are_followed_until_they_hold(
    held_from: int, powers: Sequence[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a million samples at most."""
    kalman, asked = monitor().kalman, []

    def schedule_of(_: KalmanFilter, n_samples: int) -> Any:
        asked.append(n_samples)
        return SimpleNamespace(held_from=min(held_from, n_samples))

    monkeypatch.setattr("motor_env.diagnosis.embedded.monitor.schedule", schedule_of)
    steady_schedule(kalman)
    assert asked == [2**power for power in powers]


def test_sensor_is_watched() -> None:
    believed = monitor()
    data = starts(believed, 1, 0.0)
    current, on = data.measurements.copy(), int(np.argmax(data.voltage_v > 0.0))
    current[0, 0, on + 300 : on + 500] = current[0, 0, on + 300]
    current[0, 0, on + 600] = 50.0
    for numbers in (floating(believed), fixed_point(believed, believed.limits.counts())):
        readings = readings_of(numbers, current, data.voltage_v)
        verdict = run_twin(numbers, readings).verdict[0]
        assert (verdict[on + 400 : on + 500] == SampleVerdict.SENSOR_STUCK).all()
        assert verdict[on + 600] == SampleVerdict.SENSOR_RANGE
        others = np.r_[on : on + 400, on + 500 : on + 600, on + 601 : len(verdict)]
        assert (verdict[others] == SampleVerdict.HEALTHY).all()


def test_a_current_that_reads_nothing_in_an_inrush_is_that_of_a_dead_sensor() -> None:
    """It is said from the fourth sample on, and until a current is read where there must be one."""
    believed = monitor()
    data = starts(believed, 1, 0.0)
    alive, on = data.measurements[:, :1], int(np.argmax(data.voltage_v > 0.0))
    quiet = np.random.default_rng(1).normal(0.0, 0.02, alive.shape)
    mended = np.where(np.arange(alive.shape[-1]) < on + 20, quiet, alive)
    for numbers in (floating(believed), fixed_point(believed, believed.limits.counts())):

        def verdicts(current: NDArray[np.float64], numbers: Numbers = numbers) -> Any:
            return run_twin(numbers, readings_of(numbers, current, data.voltage_v)).verdict[0]

        assert not (verdicts(alive) == SampleVerdict.SENSOR_DEAD).any()
        said = verdicts(quiet) == SampleVerdict.SENSOR_DEAD
        assert int(np.argmax(said)) in range(on + 3, on + 7)
        assert said[on + 7 :].all()
        said = verdicts(mended) == SampleVerdict.SENSOR_DEAD
        assert said[on + 7 : on + 20].all()
        assert not said[on + 20 :].any()


def test_brushes_and_dry_friction_are_known() -> None:
    motor = Motor("dry", "identified", PAPER_MOTOR, brush_drop_v=0.4, coulomb_friction_n_m=4e-4)
    believed = monitor_of(motor, 1e4, rule=CusumBank(), sensor=SensorParameters(), voltage_v=12.0)
    n = 500
    load = np.full(n, motor.coulomb_friction_n_m)
    volts = np.full(n, 12.0)
    rng = np.random.default_rng(3)
    states = np.zeros((2, n + 1))
    for k in range(n):
        inputs = np.array([volts[k] - motor.brush_drop_v, load[k]])
        states[:, k + 1] = (
            believed.kalman.model.transition @ states[:, k] + believed.kalman.model.gain @ inputs
        )
    current = states[None, :1, 1:] + 0.02 * rng.standard_normal(n)
    for sign in (1.0, -1.0):  # the first samples, in which the twin knows of no motion, are near to nothing
        numbers = fixed_point(believed, believed.limits.counts())
        answer = run_twin(numbers, readings_of(numbers, sign * current, sign * volts))
        assert (answer.verdict == SampleVerdict.HEALTHY).all()
    blind = fixed_point(monitor(), believed.limits.counts())
    assert (run_twin(blind, readings_of(blind, current, volts)).verdict == SampleVerdict.FAULT).any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rate-hz", "0"], "rate_hz must be finite and > 0, got 0"),
        (["--false-alarms-per-year", "0"], "false_alarms_per_year must be finite and > 0, got 0"),
        (["--current-count", "100"], "step of current_a must suit 11.0092, got 100"),
        (["--name", "Motor;"], "name must be a C name"),
        (["--name", "int"], "and no word of C, got 'int'"),
        (["--name", "uint_least8_t"], "and no word of C, got 'uint_least8_t'"),
        (["--name", "innovation"], "and no word of C, got 'innovation'"),
        (["--current-noise", "1e6"], "give a number that 32 bits do not hold"),
        (["--voltage", "1e-6"], "give a number that 32 bits do not hold"),
        (["--voltage", "-12"], "voltage_v must be finite and > 0, got -12"),
    ],
)
def test_bad_input_is_one_sentence(
    options: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "out"
    rate = [] if "--rate-hz" in options else ["--rate-hz", "1000"]
    sheet = str(Path(__file__).parents[4] / "examples" / "motor.toml")
    assert main(["export-c", sheet, "--out", str(folder), *rate, *options]) == 2
    assert words in capsys.readouterr().err
    assert not folder.exists()


def test_a_library_is_whole_and_only_in_its_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, sheet = tmp_path / "out", str(Path(__file__).parents[4] / "examples" / "motor.toml")
    command = ["export-c", sheet, "--out", str(folder), "--rate-hz", "1000"]

    def contents() -> dict[str, str]:
        return {
            str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()
        }

    with monkeypatch.context() as patch:

        def on_a_full_disk(path: Path, text: str) -> None:
            if path.name == "library.properties":
                raise OSError(errno.ENOSPC, "No space left on device")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

        patch.setattr(source, "write_text", on_a_full_disk)
        assert main(command) == 2
        assert "no space left on device" in capsys.readouterr().err
        assert not folder.exists()
        folder.mkdir()
    (folder / "CMakeLists.txt").write_text("mine")
    assert main(command) == 2
    assert capsys.readouterr().err.endswith("export-c did not make it; give a new or empty folder\n")
    assert contents() == {"CMakeLists.txt": "mine"}
    (folder / "CMakeLists.txt").unlink()
    assert main(command) == 0
    first = contents()
    assert len(first) == 6
    (folder / "src" / "own.c").write_text("mine")
    assert main([*command, "--voltage", "10"]) == 0  # its own folder
    assert contents().keys() == first.keys() | {"src/own.c"}
    assert contents()["src/motor_monitor.c"] != first["src/motor_monitor.c"]


def units_of(fixed: Numbers) -> NDArray[np.float64]:
    """What one count of current, speed and voltage is worth inside."""
    units: NDArray[np.float64] = np.array(fixed.readings) / np.array(fixed.scales)
    return units


def test_fixed_point_is_the_floats_in_other_units() -> None:
    """Every number within half a count; factors with as many bits as 64 take, one shift for all whitenings."""
    believed = monitor(n_channels=2)
    dry = replace(believed.motor, brush_drop_v=0.3, coulomb_friction_n_m=2e-4)
    believed = replace(believed, motor=dry)
    steps = Readings(1e-6, 1e-3, 1e-6)
    assert believed.limits.counts(None, 1e-3, None) == pytest.approx(steps)
    assert Readings(9.9, 1000.0, 0.024).counts() == pytest.approx((1e-7, 1e-4, 1e-9))
    exact, fixed = floating(believed, np.float64), fixed_point(believed, steps)
    for most, step, scale in zip(believed.limits, steps, fixed.scales, strict=True):
        assert scale * most / step <= 2**28 < 2 * scale * most / step
    units, share = units_of(fixed), 2.0**-26
    model, transition = believed.kalman.model, believed.kalman.model.transition
    rows = [*zip(exact.model, fixed.model, (units, units), units[:2], strict=True)]
    rows += [*zip(exact.gain, fixed.gain, (units[:2], units[:2]), units[:2], strict=True)]
    width = len(exact.white[0].factors)
    rows += [(one, other, units[:width], share) for one, other in zip(exact.white, fixed.white, strict=True)]
    for one, other, before, after in rows:
        assert other.shift is not None
        np.testing.assert_allclose(
            other.factors * 2.0**-other.shift * after / before,
            one.factors,
            atol=0.51 * 2.0**-other.shift * after / np.min(before),
        )
    for row in (*fixed.model, *fixed.gain):
        assert 2**29 < np.abs(row.factors).max() <= 2**30
    assert {row.shift for row in fixed.white} == {fixed.white[0].shift}
    assert 2**29 < max(np.abs(row.factors).max() for row in fixed.white) <= 2**30
    np.testing.assert_allclose(
        [row.factors for row in exact.model], np.column_stack([transition - np.eye(2), model.gain[:, 0]])
    )
    forward = model.gain @ [0.3, -2e-4]
    np.testing.assert_allclose(exact.drag[:2], forward, rtol=1e-12)
    np.testing.assert_allclose(np.array(fixed.drag[:2]) * units[:2], forward, atol=0.51 * units[:2].max())
    assert exact.drag[2] == pytest.approx(
        0.005 * believed.limits.speed_rad_s
    )  # 1 % of the speed without load
    assert fixed.drag[2] * units[1] == pytest.approx(exact.drag[2], rel=1e-6)
    assert all(part > 0 for part in fixed.drag)
    assert not any(floating(monitor(n_channels=2)).drag[:2])
    assert float(exact.threshold) == 1.0
    assert int(fixed.threshold) == 1 << 26
    np.testing.assert_allclose(fixed.halves * share, exact.halves, atol=0.51 * share)
    halves = np.array([0.075, 0.25, 0.625]) / np.array(believed.thresholds)
    np.testing.assert_allclose(exact.halves, halves)
    assert fixed.ranges.tolist() == [
        int(most / step) for most, step in zip(believed.limits, steps, strict=True)
    ]
    assert exact.ranges.tolist() == list(believed.limits)
    assert (exact.n_channels, fixed.n_channels) == (2, 2)
    assert (exact.n_friction, exact.memory) == (2, fixed.memory)


def test_a_row_rounds_half_up_and_clamps() -> None:
    row = Row(np.array([3, -5]), shift=2)
    ones = np.array([1, 2, 3, -1])
    # (3 a - 5 b) / 4 of whole numbers, half upwards
    assert row.total((ones, np.array([1, 0, 0, 0]))).tolist() == [0, 2, 2, -1]
    most = 1 << 29
    assert row.total((np.array([4 * most, -4 * most]), np.zeros(2, dtype=int))).tolist() == [most, -most]
    assert Row(np.array([0.5, 2.0])).total((np.array([3.0]), np.array([4.0]), np.array([5.0]))) == [9.5]


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (Readings(4.1e-8, 1e-3, 1e-6), "step of current_a must suit"),
        (Readings(1e-6, 600.0, 1e-6), "step of speed_rad_s must suit"),
        (Readings(1e-6, 1e-3, 0.0), "step of voltage_v must suit 24, got 0"),
        (Readings(1e-6, 1e-3, float("inf")), "step of voltage_v must suit"),
    ],
)
def test_steps_must_suit_the_ranges(steps: Readings, words: str) -> None:
    """From 2 counts to 2^28."""
    believed = monitor()
    with pytest.raises(ValueError, match=words):
        fixed_point(believed, steps)
    most = np.array(believed.limits)
    assert fixed_point(believed, Readings(*(most / 2.0**28))).scales == (1, 1, 1)
    assert (
        fixed_point(believed, Readings(most[0] / 2.0, most[1] / 2.0**28, most[2] / 2.0**28)).scales[0]
        == 2**27
    )


def test_a_factor_must_leave_a_bit_to_round() -> None:
    """Whitened innovations grow as the threshold falls: below 2^29 a factor fits with a shift of 1."""
    believed = monitor("one shift")
    steps = believed.limits.counts()
    [row] = fixed_point(believed, steps).white
    assert row.shift is not None
    largest = float(row.factors[0]) * 2.0**-row.shift * believed.thresholds[0]
    [found] = fixed_point(replace(believed, thresholds=(largest / (0.9 * 2.0**29),)), steps).white
    assert found.shift == 1
    with pytest.raises(ValueError, match="is too large for fixed point"):
        fixed_point(replace(believed, thresholds=(largest / (1.1 * 2.0**29),)), steps)


def test_thresholds_share_the_false_alarms() -> None:
    """Rates add up but for 12 / sqrt(ARL0) of them that two sums give at once; one sum has them all to itself."""
    for arl0, overlap in ((1e6, 0.012), (1e4, 0.1)):
        found = CusumBank((0.5,), (1.25,)).thresholds_for(arl0)
        rates = [
            1.0 / Cusum(shift, two_sided=True).average_run_length(threshold)
            for shift, threshold in zip((0.5, 1.25), found, strict=True)
        ]
        assert rates == pytest.approx([0.5 / arl0 / (1.0 - overlap)] * 2, rel=1e-4)
    [alone] = CusumBank((0.5,), ()).thresholds_for(1e4)
    assert Cusum(0.5, two_sided=True).average_run_length(alone) == pytest.approx(1e4, rel=1e-4)
    motor, rule = Motor("paper", "data_sheet", PAPER_MOTOR), CusumBank((0.5,), ())
    believed = monitor_of(
        motor, 1e4, rule=rule, sensor=SensorParameters(), voltage_v=12.0, false_alarms_per_year=5e6
    )
    assert believed.thresholds == rule.thresholds_for(YEAR_SAMPLES / 5e6)
    assert (believed.stuck_after, fixed_point(believed, believed.limits.counts()).stuck_after) == (100, 100)
    for stuck_after in (0, 65_536):
        with pytest.raises(ValueError, match="stuck_after must be from 1 to 65535"):
            monitor_of(
                motor, 1e4, rule=rule, sensor=SensorParameters(), voltage_v=12.0, stuck_after=stuck_after
            )
    assert (CusumBank().friction, CusumBank().winding) == ((0.15, 0.5), (1.25,))


def test_limits_and_memory_are_those_of_the_motor() -> None:
    believed = monitor()
    speed = float(steady_state(PAPER_MOTOR, 12.0)[1])
    assert believed.limits == pytest.approx((24.0 / 2.18, 2.0 * speed, 24.0))
    # the slow pole, 3.9 ms or so: 39 samples of 0.1 ms are nearest to 32, and a tenth of them to 4
    slow_s = -1e-4 / np.log(np.abs(np.linalg.eigvals(believed.kalman.model.transition)).max())
    assert floating(believed).memory == round(float(np.log2(slow_s / 1e-4)))
    for dt_s, memory in ((1e-8, 15), (0.1, 0)):
        kalman = KalmanFilter.from_parameters(PAPER_MOTOR, SensorParameters(), dt_s)
        assert floating(replace(believed, kalman=kalman)).memory == memory


def test_the_gain_is_that_of_the_settled_filter() -> None:
    believed = monitor(n_channels=2)
    gain, white = believed.gains()
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 1.0)
    late = schedule(KalmanFilter.from_parameters(PAPER_MOTOR, sensor, 1e-4), 20_000)
    np.testing.assert_allclose(gain, late.gain[-1], rtol=1e-9)
    root = np.linalg.inv(np.linalg.cholesky(late.innovation_covariance[-1]))
    np.testing.assert_allclose(white, root[0, 0] / np.array(believed.thresholds)[:, None], rtol=1e-9)


def test_a_sample_that_is_no_reading_is_not_used() -> None:
    """Out of range, not a number, or stuck: the state goes on with the model, the statistic stays."""
    believed = replace(monitor("one shift", 2), stuck_after=3)
    exact, model = floating(believed, np.float64), believed.kalman.model
    gain, white = believed.gains()
    rng, state, statistic = np.random.default_rng(4), np.zeros(2), 0.0
    slow, sums = 0.0, np.zeros(2)
    volts = np.array([0.0] * 6 + [12.0] * 24)
    readings, wanted = np.zeros((3, 30)), []
    same = np.zeros(2)
    for k in range(30):
        held = volts[k]
        predicted = model.transition @ state + model.gain[:, 0] * held
        seen = predicted + rng.normal(size=2) * [0.02, 1.0]
        if k < 6:
            seen[:] = 0.25, 3.0  # the same again and again, but the voltage is off
        if 10 <= k < 15:
            seen[1] = readings[1, 9]  # stuck from the third repetition on
        if k == 18:
            seen[0] = np.nextafter(believed.limits.current_a, 99.0)
        if k == 19:
            seen[0] = np.nan
        if k == 20:
            readings[2, k] = 25.0  # the voltage of before holds
        readings[:2, k] = seen
        readings[2, k] = readings[2, k] or held
        same = np.where((k > 0) & (seen == readings[:2, k - 1]) & (held > 0.0), same + 1, 0)
        verdict = 3 if k in (18, 19, 20) else 2 if (same >= 3).any() else 0
        state = predicted
        slow += (predicted[1] - slow) / 2.0**exact.memory
        if verdict == 0:
            off = seen - predicted
            moved = (-1.0 if slow < 0.0 else 1.0) * white[0, 0] * off[0]
            sums = np.maximum(sums + np.array([moved, -moved]) - exact.halves[0], 0.0)
            state, statistic = predicted + gain @ off, float(sums.max())
            verdict = int(statistic > 1.0)
        wanted.append((verdict, statistic))
    found = run_twin(exact, readings[None])
    assert found.verdict[0].tolist() == [verdict for verdict, _ in wanted]
    assert {0, 2, 3} <= set(found.verdict[0].tolist())
    np.testing.assert_allclose(found.statistic[0], [value for _, value in wanted], rtol=1e-9, atol=1e-12)


def test_readings_are_counts() -> None:
    believed = monitor(n_channels=2)
    numbers = fixed_point(believed, Readings(0.1, 2.0, 0.5))
    measured = np.array([[[0.24, 0.26], [3.1, -2.9]]])
    assert readings_of(numbers, measured, [12.0, 11.8]).tolist() == [[[2, 3], [2, -1], [24, 24]]]
    assert readings_of(floating(believed, np.float64), measured, 12.0).tolist() == [
        [[0.24, 0.26], [3.1, -2.9], [12.0, 12.0]]
    ]


@pytest.mark.parametrize("n_channels", [1, 2])
def test_a_self_test_is_a_start_with_a_fault_and_a_wrong_reading(n_channels: int) -> None:
    """Eight healthy samples, half a standard deviation up and down; then a current that is off until it alarms."""
    believed = monitor(n_channels=n_channels)
    exact = floating(believed, np.float64)
    model, state, noise = believed.kalman.model, np.zeros(2), np.array([0.02, 1.0])
    offs = []
    found = checks(believed, exact)
    assert [check.verdict for check in found[:8]] == ["HEALTHY"] * 8
    assert [check.verdict for check in found].count("FAULT") > 0
    assert (len(found), found[-1].verdict) == (16, "SENSOR_RANGE")
    for k, check in enumerate(found):
        state = model.transition @ state + model.gain[:, 0] * 12.0
        off = (check.readings[:-1] - state[:n_channels]) / noise[:n_channels] - (0.5 if k % 2 == 0 else -0.5)
        assert check.readings[-1] == 12.0
        if k < 8:
            np.testing.assert_allclose(off, 0.0, atol=1e-9)
        elif k < 15:
            offs.append(off[0])
            np.testing.assert_allclose(off[1:], 0.0, atol=1e-9)
    assert found[-1].readings[0] == pytest.approx(4.0 * believed.limits.current_a)
    assert offs == pytest.approx([offs[0]] * 7)
    assert np.log2(offs[0] / 4.0) == pytest.approx(round(np.log2(offs[0] / 4.0)))
    told = run_twin(exact, np.array([check.readings for check in found]).T[None])
    np.testing.assert_allclose([check.statistic for check in found], told.statistic[0])


@pytest.mark.parametrize("fixed", [True, False])
def test_the_source_holds_the_numbers_of_its_twin(fixed: bool, tmp_path: Path) -> None:
    """Read back from the text; that it computes as its twin does is tested with a compiler (long)."""
    believed = monitor(n_channels=2)
    believed = replace(believed, motor=replace(believed.motor, name="my/motor"))
    steps = believed.limits.counts() if fixed else None
    files = write_library(believed, tmp_path, steps=steps, name="m", wanted="1 a year")
    source, header = (tmp_path / f"src/m.{ending}" for ending in ("c", "h"))
    assert {source, header} <= set(files)
    text, head = source.read_text(encoding="utf-8"), header.read_text(encoding="utf-8")
    numbers = fixed_point(believed, steps) if steps else floating(believed)
    assert f"typedef {'int32_t' if fixed else 'float'} m_number;" in head

    def table(name: str) -> NDArray[np.float64]:
        found = re.search(rf"\b{name}\[.*?= (\{{.*?\}});", text, re.DOTALL)
        assert found is not None
        return np.array([float(each) for each in re.findall(r"-?\d[\d.]*(?:e[-+]?\d+)?", found[1])])

    rows = np.concatenate([row.factors for row in (*numbers.gain, *numbers.white)])
    np.testing.assert_array_equal(table("GAINS").astype(numbers.dtype), rows)
    np.testing.assert_allclose(
        table("MODEL"), np.concatenate([row.factors for row in numbers.model]), rtol=1e-7
    )
    np.testing.assert_allclose(table("HALVES"), numbers.halves, rtol=1e-7)
    assert ("int64_t" in text) is fixed
    assert "Monitor of my_motor" in text
    assert "#define M_RATE_HZ 10000\n" in head
    sketch = next(path for path in files if path.suffix == ".ino").read_text(encoding="utf-8")
    assert "due_us += 100UL;" in sketch
    counts = (1e-6, 1e-4, 1e-6) if fixed else (1.0, 1.0, 1.0)
    for name, count in zip(("CURRENT_COUNT_A", "SPEED_COUNT_RAD_S", "VOLTAGE_COUNT_V"), counts, strict=True):
        found = re.search(rf"{name} (\S+)f", head)
        assert found is not None
        assert float(found[1]) == pytest.approx(count)
    statistic = re.search(r"M_STATISTIC_COUNT (\S+)f", head)
    assert statistic is not None
    assert np.float32(statistic[1]) == (2.0**-26 if fixed else 1.0)
    share = f"* {np.float32(2.0**-numbers.memory)!s}f"
    assert (share in text) is not fixed
    nothing, something = (" >> 4)", " >> 1)") if fixed else (" * 0.0625f)", " * 0.5f)")
    assert f"shown < (predicted{nothing}" in text
    assert f"shown >= (predicted{something}" in text
    assert "off > 0 ||" in text if fixed else "off > 1e-3f" in text
    assert text.count("M_SENSOR_RANGE }") == 1
