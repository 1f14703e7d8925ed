"""Every public name of motor_env against hostile arguments: the right value, or one sentence of our own.

The table is complete: a new public name without a row fails. What a cell is, and what must come of it, stands in
`hostile_arguments`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Row, complaint, equal, public_names, values_of

import motor_env
from motor_env import (
    PAPER_MOTOR,
    Channel,
    ColumnChoice,
    Cusum,
    Fault,
    FaultKind,
    FilterStream,
    Glr,
    KalmanFilter,
    ModelBank,
    MOfN,
    Motor,
    MotorParameters,
    Recipe,
    Recording,
    Scenario,
    SensorParameters,
    SeverityPrior,
    ShiryaevRoberts,
    Sprt,
    SupplyParameters,
    Timing,
    TolerantFilter,
    WindowedNis,
    adaptive_filter,
    check_consistency,
    class_probabilities,
    commission,
    diagnose,
    diagnose_fleet,
    discretize,
    draw,
    excess_over_limit,
    filter_residuals,
    identify,
    in_a_row,
    joint_filter,
    learn_fleet,
    load_motor,
    load_recipe,
    nis_rule,
    plot_bank,
    plot_rules,
    read_recording,
    register_fault_kind,
    run_filter,
    severity_posterior,
    simulate,
    simulate_states,
    smooth,
    trend,
    watch,
)

# Reaches in: a threshold is written by hand.
from motor_env.detection.rules import Threshold
from motor_env.simulation.recipes import Spread

N = 40
DT_S = 1e-4
SENSOR = SensorParameters(current_noise_a=0.02)
BOTH = SensorParameters(channels=(Channel.CURRENT, Channel.SPEED))
KALMAN = KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, DT_S)
TWO = KalmanFilter.from_parameters(PAPER_MOTOR, BOTH, DT_S)
TIMING = Timing(duration_s=N * DT_S)
START = simulate(Scenario(PAPER_MOTOR, sensor=BOTH, timing=TIMING), seed=1, cases=[0, 1, 2])
READINGS, VOLTAGE = START.measurements, START.voltage_v[0]
CURRENT = READINGS[:, :1].copy()
RESULT = run_filter(TWO, READINGS, VOLTAGE)
WHITE = RESULT.whitened[0]
RECIPE = replace(load_recipe("bench"), timing=TIMING)
DRAWN = simulate(
    Scenario(PAPER_MOTOR, sensor=RECIPE.sensor, timing=TIMING), seed=1, cases=[0, 1, 2]
).measurements
SHARES = np.array([[0.8, 0.2], [0.4, 0.6], [0.5, 0.5]])
LONGER = simulate(
    Scenario(PAPER_MOTOR, sensor=SENSOR, timing=Timing(duration_s=0.05, quiet_s=0.01)), seed=1, cases=[0]
)
STARTUP = Recording(Path("start"), LONGER.time_s, LONGER.measurements[0, 0], LONGER.voltage_v[0])
RECORDING = Recording(Path("start"), START.time_s, READINGS[0, 0], VOLTAGE.copy())


@cache
def tolerant() -> TolerantFilter:
    return TolerantFilter.from_recipe(RECIPE)


def fed(kalman: KalmanFilter, n_streams: int = 1, *update: Any) -> Any:
    return FilterStream(kalman, n_streams).update(*update)


def of_threshold(**request: Any) -> Threshold:
    return Cusum(0.5).threshold_for(**{"false_alarm_probability": 0.01, "n_samples": 100} | request)


def joint(**changes: Any) -> Any:
    given: dict[str, Any] = {"motor": PAPER_MOTOR, "sensor": SENSOR, "dt_s": DT_S} | {
        "measurements": CURRENT[:2, :, :9], "voltage_v": VOLTAGE[:9]
    } | changes  # fmt: skip
    return joint_filter(**given)


def axis_of(figure: Any) -> Any:
    return [line.get_ydata() for axis in figure.axes for line in axis.get_lines()]


def without(call: Callable[[Any], Any], good: Any) -> Callable[[Any], Any]:
    """The call, but for the good value, which would take long or need a file."""
    return lambda value: None if isinstance(value, type(good)) and value == good else call(value)


def setter(value: Any, name: str) -> Callable[[Any], Any]:
    return lambda v: replace(value, **{name: v})


def diagnosed(name: str) -> Callable[[Any], Any]:
    return lambda v: str(diagnose(STARTUP, "paper", **{name: v}))


def identified(name: str) -> Callable[[Any], Any]:
    return lambda v: str(identify(STARTUP, **{name: v}))


def smoother(name: str) -> Callable[[Any], Any]:
    return lambda v: smooth(TWO, RESULT._replace(**{name: v}))


def discretizer(name: str) -> Callable[[Any], Any]:
    return lambda v: discretize(MotorParameters(**MOTOR | {name: v}), DT_S)


MOTOR = {f: getattr(PAPER_MOTOR, f) for f in PAPER_MOTOR.__slots__}
BATCH = PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, 1.1, 1.2]))
THREE = KalmanFilter(
    TWO.model._replace(transition=np.eye(3)), np.eye(2, 3), np.eye(3), np.eye(2), np.zeros(3), np.eye(3)
)
"""A belief of three states, which the environment Drive has and compiled loops of filters have not."""
STREAMS = KalmanFilter.from_parameters(BATCH, SENSOR, DT_S)


ROWS = [
    *(
        Row.of("KalmanFilter", name, setter(TWO, name), getattr(TWO, name))
        for name in (
            "observation",
            "process_covariance",
            "measurement_covariance",
            "initial_state",
            "initial_covariance",
        )
    ),
    Row.of("KalmanFilter", "model", lambda v: replace(TWO, model=v), TWO.model, also=(RESULT, (1, 2, 3))),
    Row.of(
        "KalmanFilter",
        "transition",
        lambda v: replace(TWO, model=TWO.model._replace(transition=v)),
        TWO.model.transition,
    ),
    Row.of("KalmanFilter", "gain", lambda v: replace(TWO, model=TWO.model._replace(gain=v)), TWO.model.gain),
    Row.of("KalmanFilter", "dt_s", lambda v: KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, v), DT_S),
    Row.of(
        "KalmanFilter",
        "process_noise_std",
        lambda v: KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, DT_S, process_noise_std=v),
        np.array([1e-5, 1e-3]),
        also=((1e-3,), (-1.0, 1.0), (0.1, 0.1, 0.1)),
    ),
    Row.of(
        "KalmanFilter",
        "initial_std",
        lambda v: KalmanFilter.from_parameters(PAPER_MOTOR, SENSOR, DT_S, initial_std=v),
        np.array([0.5, 1.0]),
        also=((0.5,),),
    ),
    Row.of("KalmanFilter", "sensor", lambda v: KalmanFilter.from_parameters(PAPER_MOTOR, v, DT_S), SENSOR),
    Row.of("run_filter", "kalman", lambda v: run_filter(v, READINGS, VOLTAGE), TWO, also=(STREAMS, THREE)),
    Row.of("run_filter", "measurements", lambda v: run_filter(TWO, v, VOLTAGE), READINGS, "missing"),
    Row.of(
        "run_filter", "measurements of one", lambda v: run_filter(KALMAN, v, VOLTAGE), CURRENT[0], "missing"
    ),
    Row.of("run_filter", "voltage_v", lambda v: run_filter(TWO, READINGS, v), VOLTAGE),
    Row.of("run_filter", "voltage_v of each", lambda v: run_filter(TWO, READINGS, v), START.voltage_v.copy()),
    Row.of(
        "run_filter",
        "load_torque_n_m",
        lambda v: run_filter(TWO, READINGS, VOLTAGE, v),
        np.full(N, 1e-3),
        "0-d",
    ),
    Row.of(
        "filter_residuals", "kalman", lambda v: filter_residuals(v, CURRENT, VOLTAGE), KALMAN, also=(STREAMS,)
    ),
    Row.of(
        "filter_residuals",
        "measurements",
        lambda v: filter_residuals(KALMAN, v, VOLTAGE),
        CURRENT,
        "huge",
        "-huge",
    ),
    Row.of(
        "filter_residuals",
        "measurements of two",
        lambda v: filter_residuals(TWO, v, VOLTAGE),
        READINGS,
        "huge",
        "-huge",
    ),
    Row.of("filter_residuals", "voltage_v", lambda v: filter_residuals(KALMAN, CURRENT, v), VOLTAGE),
    Row.of(
        "filter_residuals",
        "load_torque_n_m",
        lambda v: filter_residuals(KALMAN, CURRENT, VOLTAGE, v),
        1e-3,
        "several",
    ),
    Row.of(
        "filter_residuals", "dtype", lambda v: filter_residuals(KALMAN, CURRENT, VOLTAGE, dtype=v), np.float32
    ),
    Row.of("FilterStream", "kalman", lambda v: fed(v, 1, 0.5, 12.0), KALMAN),
    Row.of("FilterStream", "n_streams", lambda v: fed(KALMAN, v, np.ones(3), 12.0), 3),
    Row.of(
        "FilterStream",
        "n_streams of three motors",
        lambda v: fed(STREAMS, v, np.ones(3), 12.0),
        3,
        also=(1, 2, 5),
    ),
    Row.of(
        "FilterStream",
        "measurement",
        lambda v: fed(TWO, 3, v, 12.0),
        READINGS[:, :, 5].copy(),
        "missing",
        "swapped axes",
        "more axes",
    ),
    Row.of("FilterStream", "measurement of one", lambda v: fed(KALMAN, 1, v, 12.0), 0.5, "missing"),
    Row.of("FilterStream", "voltage_v", lambda v: fed(KALMAN, 3, np.ones(3), v), np.full(3, 12.0), "0-d"),
    Row.of("FilterStream", "load_torque_n_m", lambda v: fed(KALMAN, 1, 0.5, 12.0, v), 1e-3),
    Row.of("smooth", "kalman", lambda v: smooth(v, RESULT), TWO, also=(KALMAN, STREAMS, THREE)),
    Row.of("smooth", "result", lambda v: smooth(TWO, v), RESULT, also=(tuple(RESULT),)),
    *(
        Row.of(
            "smooth",
            name,
            smoother(name),
            getattr(RESULT, name),
        )
        for name in ("innovation_covariance", "state", "covariance", "gain")
    ),
    Row.of(
        "smooth",
        "innovation",
        lambda v: smooth(TWO, RESULT._replace(innovation=v)),
        RESULT.innovation,
        "missing",
    ),
    Row.of(
        "check_consistency",
        "whitened",
        check_consistency,
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of(
        "adaptive_filter",
        "kalman",
        lambda v: adaptive_filter(v, CURRENT, VOLTAGE),
        KALMAN,
        also=(TWO, STREAMS),
    ),
    Row.of("adaptive_filter", "measurements", lambda v: adaptive_filter(KALMAN, v, VOLTAGE), CURRENT),
    Row.of("adaptive_filter", "voltage_v", lambda v: adaptive_filter(KALMAN, CURRENT, v), VOLTAGE),
    Row.of("adaptive_filter", "memory", lambda v: adaptive_filter(KALMAN, CURRENT, VOLTAGE, memory=v), 20.0),
    Row.of("joint_filter", "motor", lambda v: joint(motor=v), PAPER_MOTOR, also=(BATCH,)),
    Row.of(
        "joint_filter",
        "sensor",
        lambda v: joint(sensor=v),
        SENSOR,
        also=(SensorParameters(current_noise_a=0.0),),
    ),
    Row.of("joint_filter", "dt_s", lambda v: joint(dt_s=v), DT_S),
    Row.of("joint_filter", "measurements", lambda v: joint(measurements=v), CURRENT[:2, :, :9], "missing"),
    Row.of(
        "joint_filter",
        "measurements, memory",
        lambda v: joint(measurements=v, memory=20.0),
        CURRENT[:2, :, :9],
        "missing",
    ),
    Row.of("joint_filter", "voltage_v", lambda v: joint(voltage_v=v, kind="unscented"), VOLTAGE[:9]),
    Row.of(
        "joint_filter",
        "names",
        lambda v: joint(names=v),
        ("friction",),
        also=(("friction",) * 2, ("x",), (1,), ()),
    ),
    Row.of("joint_filter", "prior_std", lambda v: joint(prior_std=v), 0.3),
    Row.of("joint_filter", "process_noise_std", lambda v: joint(process_noise_std=v), np.array([1e-5, 1e-3])),
    Row.of("joint_filter", "kind", lambda v: joint(kind=v), "extended", also=("bogus", "EXTENDED", 0)),
    Row.of("joint_filter", "memory", lambda v: joint(memory=v), 20.0, "None", also=(0.5,)),
    Row.of("Cusum", "shift", lambda v: Cusum(v).statistic(WHITE), 0.5),
    Row.of("Cusum", "two_sided", lambda v: Cusum(0.5, v).statistic(WHITE), True, also=(1, "no")),
    Row.of(
        "Cusum",
        "whitened",
        Cusum(0.5, True).statistic,
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of(
        "Cusum",
        "threshold",
        lambda v: Cusum(0.5).alarm_index(WHITE, v),
        5.0,
        also=(Threshold(np.nan, 0.0, ""),),
    ),
    Row.of("Cusum", "run length", lambda v: Cusum(0.5).average_run_length(v), 5.0),
    Row.of("Cusum", "run length, shift", lambda v: Cusum(0.5, True).average_run_length(3.0, v), 0.5),
    Row.of("Cusum", "n_samples of a probability", lambda v: Cusum(0.5).alarm_probability(5.0, v), 100),
    Row.of("Cusum", "n_streams", lambda v: Cusum(0.5).stream(v).update(np.ones(3)), 3, "empty list"),
    Row.of("Cusum", "arl0", lambda v: Cusum(0.5).threshold_for(arl0=v), 1e3, also=(1e280, 10**300, 0.5)),
    Row.of("Cusum", "false_alarm_probability", lambda v: of_threshold(false_alarm_probability=v), 0.01),
    Row.of("Cusum", "n_samples", lambda v: of_threshold(n_samples=v), 100, also=(10**30,)),
    Row.of(
        "Cusum",
        "n_samples, both sides",
        lambda v: Cusum(1.0, True).threshold_for(false_alarm_probability=0.1, n_samples=v),
        50,
        also=(10**7,),
    ),
    Row.of("Cusum", "n_channels", lambda v: of_threshold(n_channels=v), 1),
    Row.of("Cusum", "runs", lambda v: of_threshold(runs=v), 2_000, "None", also=(0, -5, 1.5)),
    Row.of("Cusum", "seed", lambda v: of_threshold(seed=v), 5, also=(-1, 1.5)),
    Row.of(
        "Cusum",
        "recipe",
        lambda v: Cusum(0.5).threshold_for(false_alarm_probability=0.1, recipe=v),
        replace(RECIPE, spread=Spread()),
    ),
    Row.of("ShiryaevRoberts", "shift", lambda v: ShiryaevRoberts(v).statistic(WHITE), 0.5),
    Row.of(
        "ShiryaevRoberts",
        "whitened",
        ShiryaevRoberts(0.5).statistic,
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of("ShiryaevRoberts", "run length", lambda v: ShiryaevRoberts(0.5).average_run_length(v), 5.0),
    Row.of(
        "ShiryaevRoberts", "arl0", lambda v: ShiryaevRoberts(0.5).threshold_for(arl0=v), 1e3, also=(1e280,)
    ),
    Row.of("Sprt", "shift", lambda v: Sprt(v).statistic(WHITE), 0.5),
    Row.of("Sprt", "lower", lambda v: Sprt(0.5, v).statistic(WHITE), -4.0),
    Row.of("Sprt", "restart", lambda v: Sprt(0.5, restart=v).statistic(WHITE), True, also=(2,)),
    Row.of(
        "Sprt", "whitened", Sprt(0.5).statistic, WHITE, "missing", "swapped axes", "one short", "more axes"
    ),
    Row.of("Sprt", "run length", lambda v: Sprt(0.5, restart=True).average_run_length(v), 5.0),
    Row.of("Sprt", "arl0", lambda v: Sprt(0.5, restart=True).threshold_for(arl0=v), 1e3, also=(1e280,)),
    Row.of("Glr", "shortest", lambda v: Glr(v, 30).statistic(WHITE), 3),
    Row.of("Glr", "longest", lambda v: Glr(2, v).statistic(WHITE), 30),
    Row.of("Glr", "two_sided", lambda v: Glr(2, 30, v).statistic(WHITE), True),
    Row.of(
        "Glr",
        "signature",
        lambda v: Glr(1, 20, signature=v).statistic(WHITE),
        np.array([0.5, 1.0]),
        "one short",
    ),
    Row.of(
        "Glr", "whitened", Glr(1, 20).statistic, WHITE, "missing", "swapped axes", "one short", "more axes"
    ),
    Row.of("Glr", "run length", lambda v: Glr(longest=50).average_run_length(v), 8.0, also=(1e9, 1e3)),
    Row.of("WindowedNis", "window", lambda v: WindowedNis(v).statistic(WHITE), 5),
    Row.of(
        "WindowedNis",
        "whitened",
        WindowedNis(5).statistic,
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of("WindowedNis", "run length", lambda v: WindowedNis(5).average_run_length(v), 15.0, also=(200.0,)),
    Row.of("MOfN", "needed", lambda v: MOfN(v, 5).statistic(WHITE), 3),
    Row.of("MOfN", "among", lambda v: MOfN(2, v).statistic(WHITE), 5),
    Row.of("MOfN", "whitened", MOfN().statistic, WHITE, "missing", "swapped axes", "one short", "more axes"),
    Row.of("MOfN", "arl0", lambda v: MOfN().threshold_for(arl0=v), 1e4, also=(1e280,)),
    Row.of("MOfN", "run length", lambda v: MOfN().average_run_length(v), 5.0, also=(1e308,)),
    Row.of("MOfN", "run length, shift", lambda v: MOfN().average_run_length(5.0, v), 0.5),
    Row.of("MOfN", "n_channels", lambda v: MOfN().threshold_for(arl0=1e3, n_channels=v), 2, also=(0,)),
    Row.of(
        "nis_rule",
        "whitened",
        lambda v: nis_rule().statistic(v),
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of("in_a_row", "count", lambda v: in_a_row(v).statistic(WHITE), 3),
    Row.of(
        "ModelBank", "shifts", lambda v: ModelBank(v).statistic(WHITE), np.array([-1.0, 0.5]), "one short"
    ),
    Row.of(
        "ModelBank",
        "whitened",
        ModelBank((1.0, -0.5)).statistic,
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of("ModelBank", "hazard", lambda v: ModelBank((1.0,)).probabilities(WHITE, v), 0.01),
    Row.of(
        "ModelBank",
        "probabilities",
        lambda v: ModelBank((1.0,)).probabilities(v, 0.01),
        WHITE,
        "missing",
        "swapped axes",
        "one short",
        "more axes",
    ),
    Row.of("TolerantFilter", "recipe", lambda v: TolerantFilter.from_recipe(v).bias, RECIPE),
    Row.of("TolerantFilter", "measurements", lambda v: tolerant().white(v), DRAWN, "missing"),
    Row.of("TolerantFilter", "n_streams", lambda v: tolerant().stream(v).update(np.ones(3)), 3),
    Row.of(
        "TolerantFilter",
        "measurement",
        lambda v: tolerant().stream(3).update(v),
        np.ones(3),
        "missing",
        "more axes",
    ),
    Row.of("TolerantFilter", "bias", lambda v: replace(tolerant(), bias=v), tolerant().bias),
    Row.of(
        "plot_rules",
        "time_s",
        lambda v: axis_of(plot_rules(v, WHITE, {"CUSUM": (Cusum(0.5), Threshold(3.0, 0.0, ""))})),
        START.time_s,
    ),
    Row.of(
        "plot_rules",
        "whitened",
        lambda v: axis_of(plot_rules(START.time_s, v, {"CUSUM": (Cusum(0.5), Threshold(3.0, 0.0, ""))})),
        WHITE,
        "missing",
        "one short",
    ),
    Row.of("plot_bank", "probabilities", lambda v: axis_of(plot_bank(np.arange(3.0), v, ("a", "b"))), SHARES),
    Row.of("plot_bank", "time_s", lambda v: axis_of(plot_bank(v, SHARES, ("a", "b"))), np.arange(3.0)),
    Row.of("class_probabilities", "recipe", lambda v: class_probabilities(v, DRAWN), RECIPE),
    Row.of(
        "class_probabilities", "measurements", lambda v: class_probabilities(RECIPE, v), DRAWN, "one short"
    ),
    Row.of(
        "class_probabilities",
        "prior",
        lambda v: class_probabilities(RECIPE, DRAWN, v),
        None,
        also=(RECIPE, "x"),
    ),
    Row.of(
        "severity_posterior",
        "recipe",
        lambda v: severity_posterior(v, SeverityPrior(FaultKind.BEARING), DRAWN),
        RECIPE,
    ),
    Row.of(
        "severity_posterior",
        "prior",
        lambda v: severity_posterior(RECIPE, v, DRAWN),
        SeverityPrior(FaultKind.BEARING),
    ),
    Row.of(
        "severity_posterior",
        "measurements",
        lambda v: severity_posterior(RECIPE, SeverityPrior(FaultKind.BEARING), v),
        DRAWN,
        "one short",
    ),
    Row.of("SeverityPrior", "kind", SeverityPrior, FaultKind.BEARING, also=("current_dead", "bogus", 3)),
    Row.of("SeverityPrior", "smallest", lambda v: SeverityPrior(FaultKind.BEARING, v), 0.1),
    Row.of("SeverityPrior", "largest", lambda v: SeverityPrior(FaultKind.BEARING, 0.0, v), 0.3, also=(11.0,)),
    Row.of(
        "excess_over_limit", "probabilities", lambda v: excess_over_limit(v, [0, 1, 1], [0, 1, 0]), SHARES
    ),
    Row.of(
        "excess_over_limit",
        "class_index",
        lambda v: excess_over_limit(SHARES, [0, 1, v], [0, 1, 0]),
        1,
        "bool",
        also=(2, -1),
    ),
    Row.of(
        "excess_over_limit", "predicted", lambda v: excess_over_limit(SHARES, [0, 1, 1], [0, 1, v]), 1, "bool"
    ),
    Row.of("discretize", "parameters", lambda v: discretize(v, DT_S), PAPER_MOTOR),
    Row.of("discretize", "dt_s", lambda v: discretize(PAPER_MOTOR, v), DT_S),
    *(
        Row.of(
            "MotorParameters",
            name,
            discretizer(name),
            value,
            "several",
            "empty",
            "empty list",
        )
        for name, value in MOTOR.items()
    ),
    Row.of(
        "MotorParameters",
        "batch",
        lambda v: discretize(
            MotorParameters(**MOTOR | {"inductance_h": BATCH.resistance_ohm, "resistance_ohm": v}), DT_S
        ),
        BATCH.resistance_ohm,
        "0-d",
        also=([1.0, 2.0],),
    ),
    Row.of(
        "SensorParameters",
        "channels",
        SensorParameters,
        (Channel.CURRENT,),
        also=(("x",), (), (1,), ("speed",) * 2),
    ),
    Row.of(
        "SensorParameters", "current_noise_a", lambda v: SensorParameters(current_noise_a=v).noise_std, 0.02
    ),
    Row.of("SupplyParameters", "voltage_v", SupplyParameters, 12.0, "several", "empty", "empty list"),
    Row.of("Fault", "kind", lambda v: Fault(v, 0.1), FaultKind.BEARING, also=("bogus",)),
    Row.of(
        "Fault",
        "severity",
        lambda v: Fault(FaultKind.MAGNET, v),
        0.1,
        "several",
        "empty",
        "empty list",
        also=(1.0, -0.1, [0.1, 2.0]),
    ),
    Row.of("Fault", "onset_s", lambda v: Fault(FaultKind.BEARING, 0.1, v), 0.01, "inf", "-inf", "huge"),
    Row.of(
        "Fault",
        "changes_s",
        lambda v: Fault(FaultKind.BEARING, 0.1, changes_s=v),
        np.array([0.1, 0.2]),
        "one short",
        "inf",
        "huge",
        "empty",
        "empty list",
        also=([0.2, 0.1],),
    ),
    Row.of("Fault", "growth_s", lambda v: Fault(FaultKind.BEARING, 0.1, 0.0, v), 0.01),
    Row.of(
        "Fault",
        "noise_source",
        lambda v: Fault(FaultKind.NOISE, 0.1, noise_source=v),
        "process",
        also=("bogus",),
    ),
    Row.of("FaultKind", "name", FaultKind, "bearing", also=("bogus", "")),
    Row.of(
        "register_fault_kind",
        "name",
        lambda v: register_fault_kind(v, {"friction": 1.0}, finding=FaultKind.BEARING.finding),
        "bearing",
        also=("Upper", "healthy", ""),
    ),
    Row.of(
        "register_fault_kind",
        "powers",
        lambda v: register_fault_kind("bearing", v, finding=FaultKind.BEARING.finding),
        {"friction": 1.0},
        also=({}, {"x": 1.0}, {"friction": True}, {"friction": 2.0}),
    ),
    Row.of(
        "register_fault_kind",
        "power",
        lambda v: register_fault_kind("bearing", {"friction": v}, finding=FaultKind.BEARING.finding),
        1.0,
    ),
    Row.of(
        "register_fault_kind",
        "verdict",
        lambda v: register_fault_kind("bearing", {"friction": 1.0}, v, FaultKind.BEARING.finding),
        "bearing",
        "None",
    ),
    Row.of("Timing", "sampling_rate_hz", lambda v: Timing(v).n_samples, 1e4),
    Row.of("Timing", "duration_s", lambda v: Timing(duration_s=v).n_samples, 0.1),
    Row.of("Timing", "quiet_s", lambda v: Timing(quiet_s=v).n_samples, 0.1),
    Row.of("Scenario", "parameters", Scenario, PAPER_MOTOR),
    Row.of(
        "Scenario",
        "faults",
        lambda v: Scenario(PAPER_MOTOR, v),
        (),
        "empty list",
        also=((1,), Fault(FaultKind.BEARING, 0.1)),
    ),
    Row.of("Scenario", "supply", lambda v: Scenario(PAPER_MOTOR, supply=v), SupplyParameters()),
    Row.of("Scenario", "sensor", lambda v: Scenario(PAPER_MOTOR, sensor=v), SENSOR),
    Row.of("Scenario", "timing", lambda v: Scenario(PAPER_MOTOR, timing=v), TIMING),
    Row.of(
        "Scenario",
        "load_torque_n_m",
        lambda v: simulate(Scenario(PAPER_MOTOR, timing=TIMING, load_torque_n_m=v), 1, [0]),
        1e-3,
    ),
    Row.of(
        "Scenario",
        "process_noise_std",
        lambda v: simulate(Scenario(PAPER_MOTOR, timing=TIMING, process_noise_std=v), 1, [0]),
        np.array([1e-3, 0.1]),
    ),
    Row.of(
        "Scenario",
        "batch",
        lambda v: Scenario(BATCH, (Fault(FaultKind.BEARING, v),)).batch_shape,
        np.array([0.1, 0.2, 0.3]),
        "0-d",
        also=([0.1, 0.2],),
    ),
    Row.of("simulate", "scenario", lambda v: simulate(v, 1, [0]), Scenario(PAPER_MOTOR, timing=TIMING)),
    Row.of(
        "simulate",
        "seed",
        lambda v: simulate(Scenario(PAPER_MOTOR, timing=TIMING), v, [0]),
        1,
        also=(1.5, -1, 2**64),
    ),
    Row.of(
        "simulate",
        "case",
        lambda v: simulate(Scenario(PAPER_MOTOR, timing=TIMING), 1, [v]),
        1,
        also=(1.5, -1),
    ),
    Row.of(
        "simulate",
        "cases",
        lambda v: simulate(Scenario(PAPER_MOTOR, timing=TIMING), 1, v),
        1,
        "empty",
        "empty list",
    ),
    Row.of("simulate_states", "parameters", lambda v: simulate_states(v, VOLTAGE, DT_S), PAPER_MOTOR),
    Row.of(
        "simulate_states",
        "voltage_v",
        lambda v: simulate_states(PAPER_MOTOR, v, DT_S),
        START.voltage_v.copy(),
        "swapped axes",
        "one short",
    ),
    Row.of("simulate_states", "dt_s", lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, v), DT_S),
    Row.of(
        "simulate_states",
        "faults",
        lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, DT_S, faults=v),
        (),
        "empty list",
        also=((1,),),
    ),
    Row.of(
        "simulate_states",
        "load_torque_n_m",
        lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, DT_S, load_torque_n_m=v),
        np.full(N, 1e-3),
        "0-d",
    ),
    Row.of(
        "simulate_states",
        "initial_state",
        lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, DT_S, initial_state=v),
        np.array([0.1, 2.0]),
    ),
    Row.of(
        "simulate_states",
        "process_noise",
        lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, DT_S, process_noise=v),
        np.full((2, N, 2), 1e-3),
    ),
    Row.of(
        "simulate_states", "start_s", lambda v: simulate_states(PAPER_MOTOR, VOLTAGE, DT_S, start_s=v), 0.1
    ),
    Row.of("draw", "recipe", lambda v: draw(v, 1, [0, 1]), RECIPE),
    Row.of("draw", "seed", lambda v: draw(RECIPE, v, [0, 1]), 1, also=(1.5, -1, 2**64)),
    Row.of("draw", "case", lambda v: draw(RECIPE, 1, [0, v]), 1, "bool", also=(1.5, -1)),
    Row.of(
        "load_recipe",
        "name_or_path",
        load_recipe,
        "bench",
        also=("no_such", "no_such.toml", "a\0.toml", "x" * 5000 + ".toml"),
    ),
    *(
        Row.of(
            "Recipe",
            name,
            setter(RECIPE, name),
            getattr(RECIPE, name),
            "empty list",
            "None",
        )
        for name in ("motor", "supply", "spread", "sensor", "timing", "field", "duty", "shifts")
    ),
    Row.of("Recipe", "name", Recipe, "mine", also=("two\nlines",)),
    Row.of("Recipe", "classes", lambda v: replace(RECIPE, classes=v), RECIPE.classes, also=((), (1,))),
    Row.of("Recipe", "starts_per_motor", lambda v: replace(RECIPE, starts_per_motor=v), 1, also=(1.5,)),
    Row.of("load_motor", "name_or_path", load_motor, "paper", also=("no_such", "no_such.toml")),
    Row.of("Recording", "path", lambda v: replace(RECORDING, path=v), Path("start"), "text", "digits"),
    Row.of("Recording", "time_s", lambda v: replace(RECORDING, time_s=v), START.time_s),
    Row.of(
        "Recording", "current_a", lambda v: replace(RECORDING, current_a=v), READINGS[0, 0].copy(), "missing"
    ),
    Row.of("Recording", "voltage_v", lambda v: replace(RECORDING, voltage_v=v), VOLTAGE.copy(), "missing"),
    Row.of(
        "Recording", "missing", lambda v: replace(RECORDING, missing=v), None, also=(np.zeros((N, 2), bool),)
    ),
    Row.of("read_recording", "path", without(read_recording, "a.csv"), "a.csv", also=("no_such.csv",)),
    Row.of("ColumnChoice", "text", ColumnChoice.parse, "current=CH2", also=("", "current=", "x=1")),
    Row.of("Motor", "name", lambda v: Motor(v, "data_sheet", PAPER_MOTOR), "mine", "text", "digits"),
    Row.of("Motor", "kind", lambda v: Motor("mine", v, PAPER_MOTOR), "data_sheet", also=("bogus",)),
    Row.of("Motor", "parameters", lambda v: Motor("mine", "data_sheet", v), PAPER_MOTOR),
    Row.of("Motor", "nominal_voltage_v", lambda v: Motor("mine", "data_sheet", PAPER_MOTOR, v), 12.0, "None"),
    Row.of("diagnose", "recording", lambda v: str(diagnose(v, "paper")), STARTUP),
    Row.of("diagnose", "motor", lambda v: str(diagnose(STARTUP, v)), "paper", "None", also=(PAPER_MOTOR,)),
    Row.of("diagnose", "start", lambda v: str(diagnose(STARTUP, "paper", start=v)), 1, "None"),
    Row.of(
        "diagnose", "regime", lambda v: str(diagnose(STARTUP, "paper", regime=v)), "auto", also=("bogus",)
    ),
    Row.of("diagnose", "columns", lambda v: str(diagnose(STARTUP, "paper", columns=v)), (), "empty list"),
    *(
        Row.of("diagnose", name, diagnosed(name), good, *allows)
        for name, good, *allows in (
            ("false_alarm_rate", 0.01),
            ("voltage_v", 12.0, "None"),
            ("temperature_c", 25.0, "None"),
            ("periods_per_turn", 14.0, "None"),
        )
    ),
    *(
        Row.of("identify", name, identified(name), good, "None")
        for name, good in (("start", 1), ("voltage_v", 12.0), ("constant", 0.02), ("periods_per_turn", 14.0))
    ),
    Row.of("identify", "recordings", lambda v: str(identify(v)), STARTUP, also=([1], [None])),
    Row.of(
        "commission", "recordings", without(commission, ["a.csv"]), ["a.csv"], also=([], [1], "abc", b"abc")
    ),
    Row.of("trend", "paths", without(trend, "a.csv"), "a.csv", also=([], [1], ["no_such"])),
    Row.of("learn_fleet", "files", without(learn_fleet, ["a.csv"]), ["a.csv"], also=([], [1], ["no_such"])),
    Row.of(
        "diagnose_fleet", "files", without(diagnose_fleet, ["a.csv"]), ["a.csv"], also=([], [1], ["no_such"])
    ),
    Row.of("watch", "motor", without(lambda v: list(watch(v, [])), "a.toml"), "a.toml"),
    Row.of("Rule", "whitened", lambda v: Cusum(0.5).stream().update(v), 0.5, "missing", "several"),
]

HOLDERS = {
    "PAPER_MOTOR": "a constant",
    "Channel": "two words",
    "InputError": "what is raised",
    "Transients": "what `simulate` gives",
    "Diagnosis": "what `diagnose` gives",
    "Verdict": "a word of what `diagnose` gives",
}
"""Public names without arguments to be refused."""


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_every_cell_is_the_right_value_or_one_sentence(row: Row) -> None:
    assert row.defects() == []


def test_every_public_name_has_a_row() -> None:
    public = public_names(Path(motor_env.__file__).with_name("__init__.pyi"))
    assert public - {row.name for row in ROWS} - set(HOLDERS) == set()


@pytest.mark.parametrize(
    "hostile",
    [
        {"measurement": np.inf},
        {"measurement": np.zeros(5)},
        {"voltage_v": np.nan},
        {"voltage_v": np.ma.masked},
        {"load_torque_n_m": np.nan},
        {"load_torque_n_m": "1"},
    ],
    ids=str,
)
def test_after_a_refusal_a_stream_stands_where_it_stood(hostile: dict[str, Any]) -> None:
    stream, untouched = FilterStream(KALMAN), FilterStream(KALMAN)
    for k, reading in enumerate(CURRENT[0, 0]):
        if k == 3:
            with pytest.raises(ValueError, match=next(iter(hostile))):
                stream.update(**{"measurement": reading, "voltage_v": 12.0} | hostile)
        found = stream.update(reading, 12.0)
        assert equal(values_of(found), values_of(untouched.update(reading, 12.0)))


def test_a_missing_reading_of_a_stream_updates_nothing() -> None:
    stream = FilterStream(KALMAN)
    missing: tuple[Any, ...] = (None, np.nan, np.ma.masked)
    for reading in missing:
        assert stream.update(reading, 12.0).nis.tolist() == [0.0]
    assert np.isfinite(stream.update(0.5, 12.0).state).all()


def test_a_wild_reading_that_is_masked_counts_as_missing() -> None:
    wild = CURRENT.copy()
    wild[0, 0, 20] = 300.0
    masked = np.ma.masked_greater(wild, 100.0)
    found = run_filter(KALMAN, masked, VOLTAGE)
    assert equal(values_of(found), values_of(run_filter(KALMAN, masked.filled(np.nan), VOLTAGE)))
    assert found.nis[0, 20] == 0.0


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("process_covariance", np.diag([1.0, -1.0]), "positive semi-definite"),
        ("process_covariance", np.array([[1.0, 2.0], [2.0, 1.0]]), "positive semi-definite"),
        ("initial_covariance", np.array([[1.0, 0.5], [0.4, 1.0]]), "symmetric"),
        ("measurement_covariance", np.zeros((2, 2)), "positive definite"),
        ("measurement_covariance", np.ones((2, 2)), "positive definite"),
        ("observation", np.zeros((3, 2)), "1 or 2 rows"),
        ("initial_state", np.zeros(0), "shape"),
    ],
)
def test_a_belief_that_is_none_is_refused_when_made(name: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must .*{words}"):
        replace(TWO, **{name: value})
    with pytest.raises(ValueError, match=f"{name} must .*{words}"):
        KalmanFilter(**{f: getattr(TWO, f) for f in TWO.__slots__} | {name: value})


def test_a_sample_that_takes_the_estimate_away_is_named() -> None:
    wild = CURRENT[:1, :, :9].copy()
    wild[0, 0, 5] = 1e99
    with pytest.raises(ValueError, match=r"at sample \d+: the largest measurements there are"):
        joint(measurements=wild)


def test_both_ways_to_name_a_kind_are_one() -> None:
    extended, unscented = joint(kind="extended"), joint(kind="unscented")
    assert equal(values_of(extended), values_of(joint()))
    assert not equal(values_of(extended), values_of(unscented))


def test_nothing_changes_a_fault_kind() -> None:
    kind: Any = FaultKind.BEARING
    with pytest.raises(TypeError):
        kind.powers["friction"] = -5.0
    with pytest.raises(AttributeError, match="cannot be changed"):
        kind.powers = {"friction": -5.0}
    assert dict(kind.powers) == {"friction": 1.0}


def test_a_complaint_knows_the_words_of_others() -> None:
    def refusal(error: Exception) -> str:
        try:
            raise error
        except type(error) as raised:
            return complaint(raised)

    assert "not raised by us" in refusal(ValueError("voltage_v must be finite, got nan"))
    assert "word of others" in refusal(ValueError("operands could not be broadcast together"))
    assert "ZeroDivisionError" in refusal(ZeroDivisionError("division by zero"))
    assert "no one sentence" in refusal(ValueError("two\nlines"))


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_compiled_code_stays_within_its_arrays(tmp_path: Path) -> None:
    """This table, the filters, the rules and the simulation, each read of an array checked; compiled anew: minutes."""
    here = Path(__file__).parent
    rooms = [
        here / f"{name}.py"
        for name in ("filters/test_kalman", "detection/test_rules", "simulation/test_fast_path")
    ]
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-m", "not long", *rooms, __file__],
        env=os.environ | {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        cwd=here.parents[1],
    )
    assert found.returncode == 0, found.stdout[-3000:]
