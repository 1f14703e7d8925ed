"""The twin of the exported C source: against the package's filter and rules, and in fixed point."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from motor_env import (
    PAPER_MOTOR,
    Cusum,
    Fault,
    FaultKind,
    MOfN,
    MotorFile,
    Scenario,
    SensorParameters,
    nis_rule,
    run_filter,
    simulate,
)
from motor_env.cli import main
from motor_env.detection.rules.base import first_above
from motor_env.embedded.arithmetic import Steps, fixed_point, floating
from motor_env.embedded.monitor import CusumBank, Monitor, monitor_of
from motor_env.embedded.twin import Answers, SampleVerdict, answers, readings_of
from motor_env.motor.parameters import Channel
from motor_env.simulation.simulate import Transients

RULES: dict[str, CusumBank | MOfN] = {
    "cusum": CusumBank(),
    "one shift": CusumBank((0.5,), ()),
    "nis": nis_rule(),
}


@cache
def monitor(
    rule: CusumBank | MOfN, n_channels: int = 1, *, scheduled: bool = False, rate_hz: float = 10_000.0
) -> Monitor:
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED)[:n_channels], 0.02, 1.0)
    motor = MotorFile("paper", "data_sheet", PAPER_MOTOR)
    return monitor_of(motor, rate_hz, rule=rule, sensor=sensor, voltage_v=12.0, scheduled=scheduled)


def first(answer: Answers) -> NDArray[np.int64]:
    faulty = answer.verdict == SampleVerdict.FAULT
    return np.where(faulty.any(axis=1), faulty.argmax(axis=1), -1)


def starts(believed: Monitor, count: int, severity: float = 0.25) -> Transients:
    channels = (Channel.CURRENT, Channel.SPEED)[: believed.n_channels]
    faults = (Fault(FaultKind.BEARING, severity),)
    return simulate(
        Scenario(PAPER_MOTOR, faults, sensor=SensorParameters(channels, 0.02, 1.0)), 1, range(count)
    )


def expected(believed: Monitor, data: Transients) -> NDArray[np.float64]:
    """The statistic of the package's filter and rules, as a share of its threshold."""
    result = run_filter(believed.kalman, data.measurements, data.voltage_v)
    if isinstance(believed.rule, MOfN):
        return believed.rule.statistic(result.whitened) / believed.thresholds[0]
    predicted = result.state - np.einsum("nij,bnj->bni", result.gain, result.innovation)
    share = 2.0**-believed.memory
    slow = lfilter([share], [1.0, share - 1.0], predicted, axis=1)
    along = [slow[..., 1]] * len(believed.rule.friction)
    along += [predicted[..., 0] - slow[..., 0]] * len(believed.rule.winding)
    shares = []
    for shift, threshold, sign in zip(believed.rule.shifts, believed.thresholds, along, strict=True):
        signed = np.where(sign < 0.0, -1.0, 1.0) * result.whitened[..., 0]
        shares.append(Cusum(shift, two_sided=True).statistic(signed[..., None]) / threshold)
    statistic: NDArray[np.float64] = np.max(shares, axis=0)
    return statistic


@pytest.mark.parametrize(
    ("rule", "n_channels", "scheduled"),
    [("cusum", 1, False), ("cusum", 2, True), ("one shift", 1, True), ("nis", 2, False)],
)
def test_twin_is_filter_and_rule(rule: str, n_channels: int, scheduled: bool) -> None:
    believed = monitor(RULES[rule], n_channels, scheduled=scheduled)
    data = starts(believed, 20)
    reference = expected(believed, data)
    exact = floating(believed, np.float64)
    statistic = answers(exact, readings_of(exact, data.measurements, data.voltage_v)).statistic
    # A schedule ends where the gain is within 1e-6 of the steady one.
    np.testing.assert_allclose(statistic, reference, rtol=1e-9, atol=1e-6 if scheduled else 1e-9)
    alarms = first_above(reference, 1.0)
    for numbers in (floating(believed), fixed_point(believed, Steps.suited(believed.limits))):
        answer = answers(numbers, readings_of(numbers, data.measurements, data.voltage_v))
        off = np.abs(first(answer) - alarms)
        assert off.max() <= 1
        assert np.mean(off == 0) >= 0.9


def test_sensor_is_watched() -> None:
    believed = monitor(RULES["cusum"])
    data = starts(believed, 1, 0.0)
    current, on = data.measurements.copy(), int(np.argmax(data.voltage_v > 0.0))
    current[0, 0, on + 300 : on + 500] = current[0, 0, on + 300]
    current[0, 0, on + 600] = 50.0
    for numbers in (floating(believed), fixed_point(believed, Steps.suited(believed.limits))):
        readings = readings_of(numbers, current, data.voltage_v)
        verdict = answers(numbers, readings).verdict[0]
        assert (verdict[on + 400 : on + 500] == SampleVerdict.SENSOR_STUCK).all()
        assert verdict[on + 600] == SampleVerdict.SENSOR_RANGE
        others = np.r_[on : on + 400, on + 500 : on + 600, on + 601 : len(verdict)]
        assert (verdict[others] == SampleVerdict.HEALTHY).all()


def test_brushes_and_dry_friction_are_known() -> None:
    motor = MotorFile("dry", "identified", PAPER_MOTOR, brush_drop_v=0.4, coulomb_friction_n_m=4e-4)
    believed = monitor_of(motor, 1e4, rule=RULES["cusum"], sensor=SensorParameters(), voltage_v=12.0)
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
        numbers = fixed_point(believed, Steps.suited(believed.limits))
        answer = answers(numbers, readings_of(numbers, sign * current, sign * volts))
        assert (answer.verdict == SampleVerdict.HEALTHY).all()
    blind = fixed_point(monitor(RULES["cusum"]), Steps.suited(believed.limits))
    assert (answers(blind, readings_of(blind, current, volts)).verdict == SampleVerdict.FAULT).any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rate-hz", "0"], "rate_hz must be finite and > 0, got 0"),
        (["--false-alarms-per-year", "0"], "false_alarms_per_year must be finite and > 0, got 0"),
        (["--current-count", "100"], "step of current_a must suit 11.0092, got 100"),
        (["--name", "Motor;"], "name must be a C name"),
        (["--voltage", "-12"], "voltage_v must be finite and > 0, got -12"),
    ],
)
def test_bad_input_is_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    rate = [] if "--rate-hz" in options else ["--rate-hz", "1000"]
    sheet = str(Path(__file__).parents[3] / "examples" / "motor.toml")
    assert main(["export-c", sheet, "--out", str(folder), *rate, *options]) == 2
    assert words in capsys.readouterr().err
    assert not folder.exists()


def test_counts_of_a_converter_do() -> None:
    believed = monitor(RULES["cusum"])
    data = starts(believed, 50)
    coarse, fine = (
        fixed_point(believed, steps) for steps in (Steps(4e-3, 1.0, 6e-3), Steps.suited(believed.limits))
    )
    rounded = answers(coarse, readings_of(coarse, data.measurements, data.voltage_v))
    reference = answers(fine, readings_of(fine, data.measurements, data.voltage_v))
    assert np.mean((first(rounded) >= 0) == (first(reference) >= 0)) > 0.9
