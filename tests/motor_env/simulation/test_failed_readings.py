"""Failed sensors in simulation: the readings change as the kind says, and the motor stays as it is."""

from dataclasses import replace

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    Fault,
    FaultKind,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    load_recipe,
    simulate,
)

# Reaches in: the posterior and the environments refuse what they cannot judge.
from motor_env.envs.options import MonitorOptions
from motor_env.envs.setup import make_setup
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.faults import SENSOR_KINDS, apply_fault
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.fast_path import measure
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.sampling import draw, measure_draw

SENSOR = SensorParameters(("current", "speed"), 0.02, 1.0)  # type: ignore[arg-type]  # names do as well
TIMING = Timing(5_000.0, 0.1, 0.02)
CHANNELS = ("current", "speed")


def read(*faults: Fault, noise: bool = True) -> FloatArray:
    """Current and speed of a start, shape (2, 600)."""
    sensor = SENSOR if noise else replace(SENSOR, current_noise_a=0.0, speed_noise_rad_s=0.0)
    scenario = Scenario(PAPER_MOTOR, faults, sensor=sensor, timing=TIMING)
    readings = simulate(scenario, 4, [0]).measurements
    np.testing.assert_allclose(measure(scenario, 4, [0]), readings, rtol=1e-4, atol=2e-3)
    return np.asarray(readings[0])


CLEAN, TRUE = read(), read(noise=False)
NOISE = CLEAN - TRUE
SCALE = np.array([[12.0 / 2.18], [12.0 / 0.02352]])  # of the blocked motor, and of one without load


@pytest.mark.parametrize(
    ("failure", "severity", "expected"),
    [
        ("dead", 1.0, NOISE),
        ("dead", 0.75, 0.25 * TRUE + NOISE),
        ("gain", 0.5, 1.5 * TRUE + NOISE),
        ("polarity", 1.0, NOISE - TRUE),
        ("offset", 0.1, CLEAN + 0.1 * SCALE),
        ("drift", 0.5, CLEAN + 0.5 * SCALE * np.arange(600) / 5_000.0),
        (
            "clipped",
            0.5,
            np.clip(CLEAN, -0.5 * np.abs(CLEAN).max(1)[:, None], 0.5 * np.abs(CLEAN).max(1)[:, None]),
        ),
        ("stuck", 0.7, np.where(np.arange(600) < 180, CLEAN, CLEAN[:, 180:181])),
    ],
)
def test_each_failure_changes_its_channel_and_no_other(
    failure: str, severity: float, expected: FloatArray
) -> None:
    for row, channel in enumerate(CHANNELS):
        if f"{channel}_{failure}" in SENSOR_KINDS:
            found = read(Fault(FaultKind(f"{channel}_{failure}"), severity))
            np.testing.assert_allclose(found[row], expected[row], rtol=1e-12, atol=1e-12)
            np.testing.assert_array_equal(found[1 - row], CLEAN[1 - row])


@pytest.mark.parametrize("kind", [each for each in SENSOR_KINDS if each.partition("_")[0] in CHANNELS])
def test_a_failure_does_not_depend_on_the_motors_beside_it(kind: FaultKind) -> None:
    """One motor has half of the other's supply, and so half of its largest reading."""
    volts = np.array([6.0, 12.0])
    both = Scenario(PAPER_MOTOR, (Fault(kind, 0.5),), SupplyParameters(volts), SENSOR, TIMING)
    for read_by in (measure, lambda *given: simulate(*given).measurements):
        together = read_by(both, 4, [0, 1])
        for n, supply in enumerate(volts.tolist()):
            alone = read_by(replace(both, supply=SupplyParameters(supply)), 4, [n])
            np.testing.assert_allclose(together[n], alone[0], rtol=1e-5, atol=1e-5)


def test_no_failure_of_a_sensor_is_one_of_the_motor() -> None:
    assert all(apply_fault(PAPER_MOTOR, Fault(kind, 0.5)) == PAPER_MOTOR for kind in SENSOR_KINDS)
    with pytest.raises(ValueError, match=r"severity of current_dead must be <= 1, got 1\.1"):
        Fault(FaultKind("current_dead"), 1.1)
    assert Fault(FaultKind("current_gain"), 1.1).severity == 1.1


@pytest.mark.parametrize("changes_s", [None, [0.05, 0.06], [0.0402, 0.0404, 0.05, 0.07, 0.09]])
def test_a_sensor_fails_from_its_onset_on_and_while_the_fault_lasts(changes_s: list[float] | None) -> None:
    at = np.arange(600)
    edges = [300, *(round(5_000.0 * (change + 0.02)) for change in changes_s or ())]
    turn = np.searchsorted(edges, at, side="right")
    acts, first = turn % 2 == 1, np.array([0, *edges])[turn]
    drift = CLEAN[1] + 0.5 * SCALE[1] * (at - first) / 5_000.0
    cases = (("dead", 1.0, NOISE[1]), ("stuck", 1.0, CLEAN[1, first]), ("drift", 0.5, drift))
    for failure, severity, expected in cases:
        changes = None if changes_s is None else np.array(changes_s)
        found = read(Fault(FaultKind(f"speed_{failure}"), severity, onset_s=0.04, changes_s=changes))[1]
        np.testing.assert_allclose(found, np.where(acts, expected, CLEAN[1]), atol=1e-5)


def test_recipes_draw_them_for_motors_at_work() -> None:
    names = ("current_dead", "voltage_gain", "voltage_polarity", "swapped")
    classes = (FaultClass(), *(FaultClass(FaultKind(name), 0.5 if "gain" in name else 1.0) for name in names))
    recipe = load_recipe("operation", classes=classes)
    drawn = draw(recipe, 5, np.arange(40))
    found = measure_draw(drawn, recipe, 5)
    healthy = drawn._replace(scenario=replace(drawn.scenario, faults=()))
    clean = measure_draw(healthy, recipe, 5)
    for index, name in enumerate(recipe.class_names):
        rows = drawn.class_index == index
        current, volts = (
            found[rows, 0] - clean[rows, 0],
            found[rows, 1] / np.where(clean[rows, 1], clean[rows, 1], 1.0),
        )
        assert rows.any()
        np.testing.assert_allclose(
            volts[clean[rows, 1] != 0.0],
            {"voltage_gain_50": 1.5, "voltage_polarity_100": -1.0}.get(name, 1.0),
            rtol=1e-6,
        )
        is_other = name in ("current_dead_100", "swapped_100")
        assert (np.abs(current).max() > 0.02) is np.bool_(is_other)
    swapped = np.flatnonzero(drawn.class_index == 4)
    alone = measure_draw(draw(recipe, 5, swapped[:1]), recipe, 5)
    np.testing.assert_array_equal(alone[0], found[swapped[0]])  # a case depends on itself alone


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("speed_dead", "speed_dead needs the speed among the channels current"),
     ("voltage_gain", "voltage_gain needs the voltage among the channels current"),
     ("swapped", "swapped needs the readings of another motor")],
)  # fmt: skip
def test_what_is_not_recorded_cannot_fail(name: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        simulate(Scenario(PAPER_MOTOR, (Fault(FaultKind(name), 1.0),)), 1, [0])


def test_what_knows_motors_alone_refuses_failed_sensors() -> None:
    classes = (FaultClass(), FaultClass(FaultKind("current_clipped"), 0.5))
    recipe = load_recipe("bench", classes=classes)
    with pytest.raises(
        ValueError, match="recipe bench must have faults of motors alone for this, got current_clipped"
    ):
        class_probabilities(recipe, np.zeros((1, 1, 1000)))
    with pytest.raises(
        ValueError, match="recipe bench has current_clipped, which an environment does not simulate"
    ):
        make_setup(MonitorOptions(recipe=recipe))
    away = load_recipe("bench", classes=(FaultClass(), FaultClass(FaultKind("speed_dead"), 1.0)))
    with pytest.raises(
        ValueError, match="recipe bench has speed_dead, which an environment does not simulate"
    ):
        make_setup(MonitorOptions(recipe=away))
