"""Every public name of motor_env against hostile arguments: the right value, or one sentence of our own.

The table is complete: a new public name without a row fails. What a cell is, and what must come of it, stands in
`hostile_arguments`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Good, Row, complaint, public_names, rows

import motor_env
from motor_env import (
    PAPER_MOTOR,
    Channel,
    Cusum,
    Fault,
    FaultKind,
    Glr,
    KalmanFilter,
    ModelBank,
    MOfN,
    MotorParameters,
    Recording,
    Scenario,
    SensorParameters,
    ShiryaevRoberts,
    Sprt,
    SupplyParameters,
    Timing,
    discretize,
    draw,
    filter_residuals,
    run_filter,
    simulate,
)

# Reaches in: a threshold is written by hand.
from motor_env.detection.rules import Threshold
from motor_env.motor.faults import BUILT_IN_KINDS
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
RECIPE = replace(motor_env.load_recipe("bench"), timing=TIMING)
SCENARIO = Scenario(PAPER_MOTOR, timing=TIMING)
DRAWN = simulate(replace(SCENARIO, sensor=RECIPE.sensor), seed=1, cases=[0, 1, 2]).measurements
SHARES = np.array([[0.8, 0.2], [0.4, 0.6], [0.5, 0.5]])
LONGER = simulate(replace(SCENARIO, sensor=SENSOR, timing=Timing(duration_s=0.05, quiet_s=0.01)), 1, [0])
STARTUP = Recording(Path("start"), LONGER.time_s, LONGER.measurements[0, 0], LONGER.voltage_v[0])
RECORDING = Recording(Path("start"), START.time_s, READINGS[0, 0], VOLTAGE.copy())
MOTOR = {f: getattr(PAPER_MOTOR, f) for f in PAPER_MOTOR.__slots__}
BATCH = PAPER_MOTOR.scaled(resistance_ohm=np.array([1.0, 1.1, 1.2]))
THREE = KalmanFilter(
    TWO.model._replace(transition=np.eye(3)), np.eye(2, 3), np.eye(3), np.eye(2), np.zeros(3), np.eye(3)
)
"""A belief of three states, which the environment Drive has and compiled loops of filters have not."""
STREAMS = KalmanFilter.from_parameters(BATCH, SENSOR, DT_S)
RULES = {"CUSUM": (Cusum(0.5), Threshold(3.0, 0.0, ""))}
BEARING = FaultKind.BEARING
TOLERANT = motor_env.TolerantFilter.from_recipe(RECIPE)


def fed(kalman: KalmanFilter, n_streams: int = 1, **update: Any) -> Any:
    return motor_env.FilterStream(kalman, n_streams).update(**update)


def shown(figure: Any) -> Any:
    return [line.get_ydata() for axis in figure.axes for line in axis.get_lines()]


def without(call: Callable[[Any], Any], good: Any) -> Callable[[Any], Any]:
    """The call, but for the good value, which would take long or need a file."""
    return lambda value: None if isinstance(value, type(good)) and value == good else call(value)


def statistic(rule: Callable[..., Any]) -> Callable[..., Any]:
    return lambda **given: rule(**given).statistic(WHITE)


OF_WHITE = ("missing", "swapped axes", "one short", "more axes")
SEVERAL = ("several", "empty", "empty list")
NO_FAULTS = {*motor_env.Verdict} - {kind.verdict for kind in BUILT_IN_KINDS}
NO_FILE: tuple[Any, ...] = ([], [1], ["no_such"])
NO_WORDS = ("", "Fouling", "f-1", "1f", "two words", "fouling\n", "b\u0435aring", "x" * 41, 7, *NO_FAULTS)
SEED = Good(1, also=(1.5, -1, 2**64))
DIAGNOSED = {
    "start": Good(1, "None"),
    "regime": Good("auto", also=("bogus",)),
    "columns": Good((), "empty list"),
    "false_alarm_rate": Good(0.01),
    "voltage_v": Good(12.0, "None"),
    "periods_per_turn": Good(14.0, "None"),
    "temperature_c": Good(25.0, "None"),
}

FILTERS = [
    *rows(
        "KalmanFilter",
        partial(replace, TWO),
        model=Good(TWO.model, also=(RESULT, (1, 2, 3))),
        observation=Good(TWO.observation, also=(np.zeros((3, 2)),)),
        process_covariance=Good(TWO.process_covariance, also=([[1.0, 2.0], [2.0, 1.0]],)),
        measurement_covariance=Good(TWO.measurement_covariance, also=(np.ones((2, 2)),)),
        initial_state=TWO.initial_state,
        initial_covariance=Good(TWO.initial_covariance, also=([[1.0, 0.5], [0.4, 1.0]],)),
    ),
    *rows("KalmanFilter", lambda **v: replace(TWO, model=TWO.model._replace(**v)), **TWO.model._asdict()),
    *rows(
        "KalmanFilter",
        partial(KalmanFilter.from_parameters, PAPER_MOTOR),
        sensor=SENSOR,
        dt_s=DT_S,
        process_noise_std=Good(np.array([1e-5, 1e-3]), also=((1e-3,), (-1.0, 1.0), (0.1, 0.1, 0.1))),
        initial_std=Good(np.array([0.5, 1.0]), also=((0.5,),)),
    ),
    *rows(
        "run_filter",
        kalman=Good(TWO, also=(STREAMS, THREE)),
        measurements=Good(READINGS, "missing"),
        voltage_v=VOLTAGE,
        load_torque_n_m=Good(np.full(N, 1e-3), "0-d"),
    ),
    *rows(
        "filter_residuals",
        kalman=Good(KALMAN, also=(STREAMS,)),
        measurements=Good(CURRENT, "huge", "-huge"),
        voltage_v=VOLTAGE,
        load_torque_n_m=Good(1e-3, "several"),
    ),
    *rows("filter_residuals", partial(filter_residuals, KALMAN, CURRENT, VOLTAGE), dtype=np.float32),
    *rows(
        "FilterStream",
        fed,
        kalman=KALMAN,
        measurement=Good(0.5, "missing"),
        voltage_v=12.0,
        load_torque_n_m=1e-3,
    ),
    *rows(
        "FilterStream",
        partial(fed, TWO, 3),
        measurement=Good(READINGS[:, :, 5].copy(), "missing", "swapped axes", "more axes"),
        voltage_v=Good(np.full(3, 12.0), "0-d"),
    ),
    *rows(
        "FilterStream",
        partial(fed, STREAMS, measurement=np.ones(3), voltage_v=12.0),
        n_streams=Good(3, also=(1, 2, 5)),
    ),
    *rows(
        "smooth", kalman=Good(TWO, also=(KALMAN, STREAMS, THREE)), result=Good(RESULT, also=(tuple(RESULT),))
    ),
    *rows(
        "smooth",
        lambda **v: motor_env.smooth(TWO, RESULT._replace(**v)),
        innovation=Good(RESULT.innovation, "missing"),
        **{name: getattr(RESULT, name) for name in ("innovation_covariance", "state", "covariance", "gain")},
    ),
    *rows(
        "adaptive_filter",
        kalman=Good(KALMAN, also=(TWO, STREAMS)),
        measurements=CURRENT,
        voltage_v=VOLTAGE,
        memory=20.0,
    ),
    *rows(
        "joint_filter",
        motor=Good(PAPER_MOTOR, also=(BATCH,)),
        sensor=Good(SENSOR, also=(SensorParameters(current_noise_a=0.0),)),
        dt_s=DT_S,
        measurements=Good(CURRENT[:2, :, :9], "missing"),
        voltage_v=VOLTAGE[:9],
        names=Good(("friction",), also=(("friction",) * 2, ("x",), (1,), ())),
        prior_std=0.3,
        process_noise_std=np.array([1e-5, 1e-3]),
        kind=Good("extended", also=("bogus", "EXTENDED", 0)),
        memory=Good(20.0, "None", also=(0.5,)),
    ),
]

OF_RULES = [
    *(
        Row.of(name, "whitened", call, WHITE, *OF_WHITE)
        for name, call in {
            "check_consistency": motor_env.check_consistency,
            "Cusum": Cusum(0.5, True).statistic,
            "ShiryaevRoberts": ShiryaevRoberts(0.5).statistic,
            "Sprt": Sprt(0.5).statistic,
            "Glr": Glr(1, 20).statistic,
            "WindowedNis": motor_env.WindowedNis(5).statistic,
            "MOfN": MOfN().statistic,
            "nis_rule": motor_env.nis_rule().statistic,
            "ModelBank": ModelBank((1.0, -0.5)).statistic,
        }.items()
    ),
    *rows("Rule", lambda v: Cusum(0.5).stream().update(v), v=Good(0.5, "missing", "several")),
    *rows("Cusum", statistic(Cusum), shift=0.5, two_sided=Good(True, also=(1, "no"))),
    *rows("ShiryaevRoberts", statistic(ShiryaevRoberts), shift=0.5),
    *rows("Sprt", statistic(Sprt), shift=0.5, lower=-4.0, restart=Good(True, also=(2,))),
    *rows("Glr", statistic(Glr), shortest=3, longest=30, two_sided=True),
    *rows("Glr", statistic(partial(Glr, 1, 20)), signature=Good(np.array([0.5, 1.0]), "one short")),
    *rows("WindowedNis", statistic(motor_env.WindowedNis), window=5),
    *rows("MOfN", statistic(MOfN), needed=3, among=5),
    *rows("in_a_row", statistic(motor_env.in_a_row), count=3),
    *rows("ModelBank", statistic(ModelBank), shifts=Good(np.array([-1.0, 0.5]), "one short")),
    *rows("ModelBank", ModelBank((1.0,)).probabilities, whitened=Good(WHITE, *OF_WHITE), hazard=0.01),
    *rows(
        "Cusum",
        partial(Cusum(0.5).alarm_index, WHITE),
        threshold=Good(5.0, also=(Threshold(np.nan, 0.0, ""),)),
    ),
    *rows("Cusum", Cusum(0.5).average_run_length, threshold=5.0),
    *rows("Cusum", Cusum(0.5, True).average_run_length, threshold=3.0, shift=0.5),
    *rows("ShiryaevRoberts", ShiryaevRoberts(0.5).average_run_length, threshold=5.0),
    *rows("Sprt", Sprt(0.5, restart=True).average_run_length, threshold=5.0),
    *rows("Glr", Glr(longest=50).average_run_length, threshold=Good(8.0, also=(1e9, 1e3))),
    *rows("WindowedNis", motor_env.WindowedNis(5).average_run_length, threshold=Good(15.0, also=(200.0,))),
    *rows("MOfN", MOfN().average_run_length, threshold=Good(5.0, also=(1e308,)), shift=0.5),
    *rows("Cusum", Cusum(0.5).alarm_probability, threshold=5.0, n_samples=100),
    *rows("Cusum", lambda n: Cusum(0.5).stream(n).update(np.ones(3)), n=Good(3, "empty list")),
    *rows("Cusum", Cusum(0.5).threshold_for, arl0=Good(1e3, also=(1e280, 10**300, 0.5))),
    *rows("ShiryaevRoberts", ShiryaevRoberts(0.5).threshold_for, arl0=Good(1e3, also=(1e280,))),
    *rows("Sprt", Sprt(0.5, restart=True).threshold_for, arl0=Good(1e3, also=(1e280,))),
    *rows("MOfN", MOfN().threshold_for, arl0=Good(1e4, also=(1e280,)), n_channels=Good(2, also=(0,))),
    *rows(
        "Cusum",
        Cusum(0.5).threshold_for,
        false_alarm_probability=0.01,
        n_samples=Good(100, also=(10**30,)),
        n_channels=1,
        runs=Good(2_000, "None", also=(0, -5, 1.5)),
        seed=Good(5, also=(-1, 1.5)),
    ),
    *rows(
        "Cusum",
        partial(Cusum(0.5).threshold_for, false_alarm_probability=0.1),
        recipe=replace(RECIPE, spread=Spread()),
    ),
    *rows("TolerantFilter", motor_env.TolerantFilter.from_recipe, recipe=RECIPE),
    *rows("TolerantFilter", TOLERANT.white, measurements=Good(DRAWN, "missing")),
    *rows(
        "TolerantFilter",
        lambda n, v: TOLERANT.stream(n).update(v),
        n=3,
        v=Good(np.ones(3), "missing", "more axes"),
    ),
    *rows("TolerantFilter", partial(replace, TOLERANT), bias=TOLERANT.bias),
    *rows(
        "plot_rules",
        lambda **v: shown(motor_env.plot_rules(rules=RULES, **v)),
        time_s=START.time_s,
        whitened=Good(WHITE, "missing", "one short"),
        onset_s=Good(0.02, "None"),
    ),
    *rows(
        "plot_bank",
        lambda **v: shown(motor_env.plot_bank(names=("a", "b"), **v)),
        time_s=np.arange(3.0),
        probabilities=SHARES,
    ),
]

SIMULATION = [
    *rows("discretize", parameters=PAPER_MOTOR, dt_s=DT_S),
    *rows(
        "MotorParameters",
        lambda **v: discretize(MotorParameters(**v), DT_S),
        **{name: Good(value, *SEVERAL) for name, value in MOTOR.items()},
    ),
    *rows(
        "SensorParameters",
        channels=Good((Channel.CURRENT,), also=(("x",), (), (1,), ("speed",) * 2)),
        current_noise_a=0.02,
    ),
    *rows("SupplyParameters", voltage_v=Good(12.0, *SEVERAL)),
    *rows(
        "Fault",
        kind=Good(FaultKind.MAGNET, also=("bogus",)),
        severity=Good(0.1, *SEVERAL, also=(1.0, -0.1, [0.1, 2.0])),
        onset_s=Good(0.01, "inf", "-inf", "huge"),
        growth_s=Good(0.01, also=(-1.0,)),
    ),
    *rows(
        "Fault",
        partial(Fault, FaultKind.NOISE, 0.1),
        changes_s=Good(np.array([0.1, 0.2]), "one short", "inf", "huge", *SEVERAL, also=([0.2, 0.1],)),
        noise_source=Good("process", also=("bogus",)),
    ),
    *rows("Fault", partial(Fault, FaultKind.NOISE, 0.1), growth_s=Good(0.0, also=(1.0,))),
    *rows("Fault", partial(Fault, FaultKind("current_dead")), severity=Good(1.0, *SEVERAL, also=(1.1,))),
    Row.of("FaultKind", "name", FaultKind, "bearing", also=("bogus", "")),
    *rows(
        "register_fault_kind",
        partial(motor_env.register_fault_kind, finding=BEARING.finding),
        name=Good("bearing", also=NO_WORDS),
        powers=Good(
            {"friction": 1.0},
            also=({}, {"x": 1.0}, *({"friction": power} for power in (True, 2.0, "1.0", np.nan, 0.0, 1j))),
        ),
        verdict=Good("bearing", "None", also=NO_WORDS),
    ),
    *rows(
        "Timing",
        lambda **v: Timing(**v).n_samples,
        sampling_rate_hz=Good(1e4, also=(0.0,)),
        duration_s=Good(0.1, also=(1e-6, 1001.0)),
        quiet_s=Good(0.1, also=(-0.1,)),
    ),
    *rows(
        "Scenario",
        parameters=PAPER_MOTOR,
        faults=Good((), "empty list", also=((1,), Fault(BEARING, 0.1))),
        supply=SupplyParameters(),
        sensor=SENSOR,
        timing=TIMING,
    ),
    *rows(
        "Scenario",
        lambda **v: simulate(replace(SCENARIO, **v), 1, [0]),
        load_torque_n_m=1e-3,
        process_noise_std=np.array([1e-3, 0.1]),
    ),
    *rows(
        "Scenario",
        lambda v: Scenario(BATCH, (Fault(BEARING, v),)).batch_shape,
        v=Good(np.array([0.1, 0.2, 0.3]), "0-d", also=([0.1, 0.2],)),
    ),
    *rows("simulate", scenario=SCENARIO, seed=SEED, cases=Good(1, "empty", "empty list")),
    *rows("simulate", lambda case: simulate(SCENARIO, 1, [case]), case=Good(1, also=(1.5, -1))),
    *rows(
        "simulate_states",
        parameters=PAPER_MOTOR,
        voltage_v=VOLTAGE,
        dt_s=DT_S,
        faults=Good((), "empty list", also=((1,),)),
        load_torque_n_m=Good(np.full(N, 1e-3), "0-d"),
        initial_state=np.array([0.1, 2.0]),
        process_noise=np.full((2, N, 2), 1e-3),
        start_s=0.1,
    ),
    *rows("draw", partial(draw, cases=[0, 1]), recipe=RECIPE, seed=SEED),
    *rows("draw", lambda case: draw(RECIPE, 1, [0, case]), case=Good(1, "bool", also=(1.5, -1))),
    *rows(
        "load_recipe",
        name_or_path=Good("bench", also=("no_such", "no_such.toml", "a\0.toml", "x" * 5000 + ".toml")),
    ),
    *rows(
        "Recipe",
        partial(replace, RECIPE),
        name=Good("mine", also=("two\nlines",)),
        classes=Good(RECIPE.classes, also=((), (1,))),
        starts_per_motor=Good(1, also=(1.5,)),
        **{
            name: Good(getattr(RECIPE, name), "empty list", "None")
            for name in ("motor", "supply", "spread", "sensor", "timing", "field", "duty", "shifts")
        },
    ),
    *rows(
        "class_probabilities",
        recipe=RECIPE,
        measurements=Good(DRAWN, "one short"),
        prior=Good(None, also=(RECIPE, "x")),
    ),
    *rows(
        "severity_posterior",
        recipe=RECIPE,
        prior=motor_env.SeverityPrior(BEARING),
        measurements=Good(DRAWN, "one short"),
    ),
    *rows(
        "SeverityPrior",
        kind=Good(BEARING, also=("current_dead", "bogus", 3)),
        smallest=0.1,
        largest=Good(0.3, also=(11.0,)),
    ),
    *rows(
        "excess_over_limit",
        lambda shares, truth, told: motor_env.excess_over_limit(shares, [0, 1, truth], [0, 1, told]),
        shares=SHARES,
        truth=Good(1, "bool", also=(2, -1)),
        told=Good(1, "bool"),
    ),
]

DIAGNOSIS = [
    *rows("load_motor", name_or_path=Good("paper", also=("no_such", "no_such.toml"))),
    *rows(
        "Motor",
        name=Good("mine", "text", "digits"),
        kind=Good("data_sheet", also=("bogus",)),
        parameters=PAPER_MOTOR,
        nominal_voltage_v=Good(12.0, "None"),
    ),
    *rows(
        "Recording",
        partial(replace, RECORDING),
        path=Good(Path("start"), "text", "digits"),
        time_s=START.time_s,
        current_a=Good(READINGS[0, 0].copy(), "missing"),
        voltage_v=Good(VOLTAGE.copy(), "missing"),
        missing=Good(None, also=(np.zeros((N, 2), bool),)),
    ),
    *rows(
        "ColumnChoice", motor_env.ColumnChoice.parse, text=Good("current=CH2", also=("", "current=", "x=1"))
    ),
    *rows("diagnose", recording=STARTUP, motor=Good("paper", "None", also=(PAPER_MOTOR,))),
    *rows("identify", recordings=Good(STARTUP, also=([1], [None]))),
    *rows("identify", partial(motor_env.identify, STARTUP), constant=Good(0.02, "None")),
    *(
        row
        for option, good in DIAGNOSED.items()
        for row in rows("diagnose", partial(motor_env.diagnose, STARTUP, "paper"), **{option: good})
    ),
    *(
        Row.of(name, "files", without(getattr(motor_env, name), good), good, also=also)
        for name, good, also in (
            ("read_recording", "a.csv", ("no_such.csv",)),
            ("commission", ["a.csv"], ([], [1], "abc", b"abc")),
            ("trend", "a.csv", NO_FILE),
            ("learn_fleet", ["a.csv"], NO_FILE),
            ("diagnose_fleet", ["a.csv"], NO_FILE),
        )
    ),
    Row.of("watch", "motor", without(lambda v: list(motor_env.watch(v, [])), "a.toml"), "a.toml"),
]
ROWS = [*FILTERS, *OF_RULES, *SIMULATION, *DIAGNOSIS]

HOLDERS = {"PAPER_MOTOR", "Channel", "InputError", "Transients", "Diagnosis", "Verdict"}
"""Public names without arguments to be refused."""


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_every_cell_is_the_right_value_or_one_sentence(row: Row) -> None:
    assert row.defects() == []


def test_every_public_name_has_a_row() -> None:
    public = public_names(Path(motor_env.__file__).with_name("__init__.pyi"))
    assert public == {row.name for row in ROWS} | HOLDERS


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("voltage_v must be finite, got nan"), "not raised by us"),
        (ValueError("operands could not be broadcast together"), "word of others"),
        (ZeroDivisionError("division by zero"), "ZeroDivisionError"),
        (ValueError("two\nlines"), "no one sentence"),
    ],
)
def test_a_complaint_knows_the_words_of_others(error: Exception, words: str) -> None:
    with pytest.raises(type(error)) as raised:
        raise error
    assert words in complaint(raised.value)
