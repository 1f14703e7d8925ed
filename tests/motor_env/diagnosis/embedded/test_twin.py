"""The twin of the exported C source: against the package's filter and rules, and in fixed point."""

import errno
from dataclasses import replace
from functools import cache
from pathlib import Path
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
from motor_env.diagnosis.embedded.monitor import CusumBank, Monitor, monitor_of
from motor_env.diagnosis.embedded.source import checks
from motor_env.diagnosis.embedded.twin import (
    Numbers,
    SampleVerdict,
    fixed_point,
    floating,
    readings_of,
    run_twin,
)
from motor_env.motor.model import steady_state

RULES = {"bank": CusumBank(), "one shift": CusumBank((0.5,), ())}
YEAR_SAMPLES = 365.25 * 86_400.0 * 10_000.0


thresholds_for = cache(CusumBank.thresholds_for)


@pytest.fixture(autouse=True)
def solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An integral equation takes its time, so once for each rule and each number of samples."""
    monkeypatch.setattr(CusumBank, "thresholds_for", thresholds_for)


def monitor(name: str = "bank", n_channels: int = 1) -> Monitor:
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED)[:n_channels], 0.02, 1.0)
    motor = Motor("paper", "data_sheet", PAPER_MOTOR)
    return monitor_of(motor, 10_000.0, rule=RULES[name], sensor=sensor, voltage_v=12.0)


def first(faulty: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.where(faulty.any(axis=1), faulty.argmax(axis=1), -1)


def starts(believed: Monitor, count: int, severity: float = 0.25) -> Transients:
    channels = (Channel.CURRENT, Channel.SPEED)[: len(believed.kalman.observation)]
    faults = (Fault(FaultKind.BEARING, severity),)
    return simulate(
        Scenario(PAPER_MOTOR, faults, sensor=SensorParameters(channels, 0.02, 1.0)), 1, range(count)
    )


def both(believed: Monitor) -> tuple[Numbers, Numbers]:
    return floating(believed), fixed_point(believed, believed.limits.counts())


def verdicts(numbers: Numbers, current: NDArray[np.float64], volts: Any) -> NDArray[np.int64]:
    verdict: NDArray[np.int64] = run_twin(numbers, readings_of(numbers, current, volts)).verdict[0]
    return verdict


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
    alarms = first(reference > 1.0)
    for numbers in both(believed):
        answer = run_twin(numbers, readings_of(numbers, data.measurements, data.voltage_v))
        shares = answer.statistic / float(numbers.threshold)
        np.testing.assert_allclose(shares, reference, atol=1e-3)
        off = np.abs(first(answer.verdict == SampleVerdict.FAULT) - alarms)
        assert off.max() <= 1
        assert np.mean(off == 0) >= 0.9


def test_sensor_is_watched() -> None:
    """What is stuck, out of range or no number is not used: the state goes on with the model."""
    believed = monitor()
    data = starts(believed, 1, 0.0)
    current, volts = data.measurements.copy(), data.voltage_v.copy()
    on = int(np.argmax(volts > 0.0))
    current[0, 0, on + 300 : on + 500] = current[0, 0, on + 300]
    current[0, 0, on + 600], volts[0, on + 700] = 50.0, 25.0
    if_nan = current.copy()
    if_nan[0, 0, on + 600] = np.nan
    for numbers in both(believed):
        is_float = numbers.dtype == np.float32
        verdict = verdicts(numbers, if_nan if is_float else current, volts)
        assert (verdict[on + 400 : on + 500] == SampleVerdict.SENSOR_STUCK).all()
        assert (verdict[[on + 600, on + 700]] == SampleVerdict.SENSOR_RANGE).all()
        others = np.r_[on : on + 400, on + 500 : on + 600, on + 601 : on + 700, on + 701 : len(verdict)]
        assert (verdict[others] == SampleVerdict.HEALTHY).all()


def test_a_current_that_reads_nothing_in_an_inrush_is_that_of_a_dead_sensor() -> None:
    believed = monitor()
    data = starts(believed, 1, 0.0)
    alive, on = data.measurements[:, :1], int(np.argmax(data.voltage_v > 0.0))
    quiet = np.random.default_rng(1).normal(0.0, 0.02, alive.shape)
    mended = np.where(np.arange(alive.shape[-1]) < on + 20, quiet, alive)
    for numbers in both(believed):
        never, always, once = (
            verdicts(numbers, current, data.voltage_v) == SampleVerdict.SENSOR_DEAD
            for current in (alive, quiet, mended)
        )
        assert not never.any()
        assert int(np.argmax(always)) in range(on + 3, on + 7)
        assert always[on + 7 :].all()
        assert once[on + 7 : on + 20].all()
        assert not once[on + 20 :].any()


def test_brushes_and_dry_friction_are_known() -> None:
    motor = Motor("dry", "identified", PAPER_MOTOR, brush_drop_v=0.4, coulomb_friction_n_m=4e-4)
    believed = monitor_of(motor, 1e4, rule=CusumBank(), sensor=SensorParameters(), voltage_v=12.0)
    model, inputs = believed.kalman.model, [12.0 - motor.brush_drop_v, motor.coulomb_friction_n_m]
    states = [np.zeros(2)]
    for _ in range(500):
        states.append(model.transition @ states[-1] + model.gain @ inputs)
    current = np.array(states)[None, None, 1:, 0] + 0.02 * np.random.default_rng(3).standard_normal(500)
    volts, numbers = np.full(500, 12.0), fixed_point(believed, believed.limits.counts())
    for sign in (1.0, -1.0):  # the first samples, in which the twin knows of no motion, are near to nothing
        assert (verdicts(numbers, sign * current, sign * volts) == SampleVerdict.HEALTHY).all()
    blind = fixed_point(monitor(), believed.limits.counts())
    assert (verdicts(blind, current, volts) == SampleVerdict.FAULT).any()


SHEET = str(Path(__file__).parents[4] / "examples" / "motor.toml")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--false-alarms-per-year", "0"], "false_alarms_per_year must be finite and > 0, got 0"),
        (["--current-count", "100"], "step of current_a must suit 11.0092, got 100"),
        (["--name", "Motor;"], "name must be a C name"),
        (["--name", "uint_least8_t"], "and no word of C, got 'uint_least8_t'"),
        (["--name", "innovation"], "and no word of C, got 'innovation'"),
        (["--voltage", "1e-6"], "give a number that 32 bits do not hold"),
    ],
)
def test_bad_input_is_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    assert main(["export-c", SHEET, "--out", str(folder), "--rate-hz", "1000", *options]) == 2
    assert words in capsys.readouterr().err
    assert not folder.exists()


def test_a_library_is_whole_and_only_in_its_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    command = ["export-c", SHEET, "--out", str(folder), "--rate-hz", "1000"]

    def on_a_full_disk(path: Path, text: str) -> None:
        if path.name == "library.properties":
            raise OSError(errno.ENOSPC, "No space left on device")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    with monkeypatch.context() as patch:
        patch.setattr(source, "write_text", on_a_full_disk)
        assert main(command) == 2
    assert "no space left on device" in capsys.readouterr().err
    assert not folder.exists()
    own, written = folder / "CMakeLists.txt", folder / "src" / "motor_monitor.c"
    folder.mkdir()
    own.write_text("mine")
    assert main(command) == 2
    assert "export-c did not make it; give a new or empty folder" in capsys.readouterr().err
    assert [*folder.rglob("*")] == [own]
    own.unlink()
    assert main(command) == 0
    first = written.read_text()
    (folder / "src" / "own.c").write_text("mine")
    assert main([*command, "--voltage", "10"]) == 0  # its own folder
    assert (folder / "src" / "own.c").exists()
    assert written.read_text() != first


def test_thresholds_share_the_false_alarms() -> None:
    """Rates add up but for 12 / sqrt(ARL0) of them that two sums give at once; one sum has them all to itself."""
    for bank, arl0, share in (
        (CusumBank((0.5,), (1.25,)), 1e6, 0.5 / (1.0 - 0.012)),
        (CusumBank((0.5,), (1.25,)), 1e4, 0.5 / (1.0 - 0.1)),
        (CusumBank((0.5,), ()), 1e4, 1.0),
    ):
        for shift, threshold in zip(bank.shifts, bank.thresholds_for(arl0), strict=True):
            length = Cusum(shift, two_sided=True).average_run_length(threshold)
            assert length == pytest.approx(arl0 / share, rel=1e-4)
    motor, rule = Motor("paper", "data_sheet", PAPER_MOTOR), CusumBank((0.5,), ())
    given: dict[str, Any] = {"rule": rule, "sensor": SensorParameters(), "voltage_v": 12.0}
    believed = monitor_of(motor, 1e4, **given, false_alarms_per_year=5e6)
    assert believed.thresholds == rule.thresholds_for(YEAR_SAMPLES / 5e6)
    for stuck_after in (0, 65_536):
        with pytest.raises(ValueError, match="stuck_after must be from 1 to 65535"):
            monitor_of(motor, 1e4, **given, stuck_after=stuck_after)


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


@pytest.mark.parametrize("n_channels", [1, 2])
def test_a_self_test_is_a_start_with_a_fault_and_a_wrong_reading(n_channels: int) -> None:
    """Eight healthy samples, half a standard deviation up and down; then a current that is off until it alarms."""
    believed = monitor(n_channels=n_channels)
    exact, model, state, offs = floating(believed, np.float64), believed.kalman.model, np.zeros(2), []
    found = checks(believed, exact)
    said = [check.verdict for check in found]
    assert (said[:8], said[-1], len(said), "FAULT" in said) == (["HEALTHY"] * 8, "SENSOR_RANGE", 16, True)
    for k, check in enumerate(found[:15]):
        state = model.transition @ state + model.gain[:, 0] * 12.0
        off = (check.readings[:-1] - state[:n_channels]) / [0.02, 1.0][:n_channels]
        offs.append(off - (0.5 if k % 2 == 0 else -0.5))
        assert check.readings[-1] == 12.0
    np.testing.assert_allclose(offs[:8], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.array(offs)[:, 1:], 0.0, atol=1e-9)
    faulty = np.array(offs)[8:, 0]
    assert faulty == pytest.approx(np.full(7, faulty[0]))
    assert np.log2(faulty[0] / 4.0) == pytest.approx(round(np.log2(faulty[0] / 4.0)))
    assert found[-1].readings[0] == pytest.approx(4.0 * believed.limits.current_a)
    told = run_twin(exact, np.array([check.readings for check in found]).T[None])
    np.testing.assert_allclose([check.statistic for check in found], told.statistic[0])
