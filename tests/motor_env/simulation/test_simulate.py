"""Simulated starts: states against dlsim, noise from published words, readings of failed sensors."""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    MotorParameters,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    discretize,
    load_recipe,
    simulate,
    simulate_states,
)

# Reaches in: the posterior and the environments refuse what they cannot judge.
from motor_env.envs.options import MonitorOptions
from motor_env.envs.setup import make_setup
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.faults import SENSOR_KINDS, NoiseSource, apply_fault
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.fast_path import measure
from motor_env.simulation.random_streams import Stream, normals, philox, uniforms
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.sampling import draw, measure_draw

DT_S = 1e-4
QUIET_SENSOR = SensorParameters(current_noise_a=0.0, speed_noise_rad_s=0.0)
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED))


def test_states_against_dlsim() -> None:
    rng = np.random.default_rng(0)
    voltage, load = 12.0 * rng.standard_normal(500), 1e-3 * rng.standard_normal(500)
    states = simulate_states(PAPER_MOTOR, voltage, DT_S, load_torque_n_m=load, initial_state=(0.3, -20.0))
    model = discretize(PAPER_MOTOR, DT_S)
    system = (model.transition, model.gain, np.eye(2), np.zeros((2, 2)), DT_S)
    # dlsim returns x[k] before interval k; ours is read at its end.
    inputs = np.vstack([np.column_stack([voltage, load]), [0.0, 0.0]])
    _, _, expected = signal.dlsim(system, inputs, x0=(0.3, -20.0))
    np.testing.assert_allclose(states, expected[1:], rtol=1e-12, atol=1e-12)


def test_time_axis_and_the_step() -> None:
    timing = Timing(sampling_rate_hz=1000.0, duration_s=0.005, quiet_s=0.003)
    transients = simulate(Scenario(PAPER_MOTOR, sensor=QUIET_SENSOR, timing=timing), 0, [0])
    np.testing.assert_allclose(transients.time_s, 1e-3 * np.arange(-2, 6), atol=1e-15)
    assert transients.voltage_v[0].tolist() == [0.0] * 3 + [12.0] * 5
    current = transients.measurements[0, 0]
    # The sample at time 0 is read at the step itself: nothing flows before the interval that begins there.
    assert np.all(current[:3] == 0.0)
    assert current[3] == pytest.approx(12.0 * discretize(PAPER_MOTOR, 1e-3).gain[0, 0], rel=1e-12)


@pytest.mark.parametrize("kind", [FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT])
def test_an_onset_after_the_step_switches_the_interval_that_begins_there(kind: FaultKind) -> None:
    fault, timing = Fault(kind, 0.3, onset_s=0.0042), Timing(duration_s=0.01, quiet_s=0.003)
    faulty = simulate(Scenario(PAPER_MOTOR, (fault,), sensor=QUIET_SENSOR, timing=timing), 0, [0]).states[0]
    healthy = simulate(Scenario(PAPER_MOTOR, sensor=QUIET_SENSOR, timing=timing), 0, [0]).states[0]
    np.testing.assert_allclose(faulty[:72], healthy[:72], rtol=1e-13)
    worse = apply_fault(PAPER_MOTOR, fault)
    expected = simulate_states(worse, np.full(58, 12.0), DT_S, initial_state=healthy[71])
    np.testing.assert_allclose(faulty[72:], expected, rtol=1e-12)
    assert not np.allclose(faulty[72], healthy[72], rtol=1e-6)


def test_growth_holds_each_interval_at_the_severity_of_its_begin() -> None:
    fault = Fault(FaultKind.WINDING_CONTACT, 0.4, onset_s=0.001, growth_s=0.004)
    states = simulate_states(PAPER_MOTOR, np.full(80, 12.0), DT_S, faults=(fault,))
    x = np.zeros(2)
    for k in range(80):
        severity = 0.4 * min(1.0, max(0.0, (k * DT_S - 0.001) / 0.004))
        model = discretize(PAPER_MOTOR.scaled(resistance_ohm=1.0 + severity), DT_S)
        x = model.transition @ x + model.gain @ [12.0, 0.0]
        np.testing.assert_allclose(states[k], x, rtol=1e-5)


def test_a_batch_is_its_motors() -> None:
    factors, severity = np.array([0.9, 1.0, 1.2]), np.array([0.0, 0.1, 0.25])
    volts, timing = np.array([11.0, 12.0, 13.0]), Timing(duration_s=0.02, quiet_s=0.005)

    def scenario(motor: MotorParameters, severity: Any, volts: Any) -> Scenario:
        faults = Fault(FaultKind.BEARING, severity), Fault(FaultKind.WINDING_CONTACT, severity, 0.007, 0.003)
        supply = SupplyParameters(volts)
        return Scenario(motor, faults, supply, BOTH, timing, process_noise_std=(1e-3, 0.1))

    batch = PAPER_MOTOR.scaled(resistance_ohm=factors)
    whole = simulate(scenario(batch, severity, volts), 5, [10, 11, 12])
    for n in range(3):
        alone = simulate(scenario(batch.motor(n), float(severity[n]), float(volts[n])), 5, [10 + n])
        np.testing.assert_allclose(alone.measurements[0], whole.measurements[n], rtol=1e-12)
        np.testing.assert_allclose(alone.states[0], whole.states[n], rtol=1e-12, atol=1e-15)


def test_noise_is_that_of_its_stream_and_a_fault_raises_it_from_its_onset_on() -> None:
    """Of two noise faults the factors on the variance multiply: 4 and 9."""
    sensor = SensorParameters(("current", "speed"), 0.02, 3.0)  # type: ignore[arg-type]  # names are taken too
    faults = Fault(FaultKind.NOISE, 3.0, onset_s=0.05), Fault(FaultKind.NOISE, 8.0, onset_s=0.08)
    transients = simulate(Scenario(PAPER_MOTOR, faults, sensor=sensor), 1, [5, 6])
    errors = transients.measurements - np.moveaxis(transients.states, 2, 1)
    noise = normals(1, Stream.MEASUREMENT, [5, 6], 2000).reshape(2, 2, 1000) * [[0.02], [3.0]]
    factors = np.repeat([1.0, 2.0, 6.0], [500, 300, 200])
    np.testing.assert_allclose(errors, factors * noise, rtol=1e-6, atol=1e-9)


def test_process_noise_enters_the_states() -> None:
    fault = Fault(FaultKind.NOISE, 3.0, onset_s=0.05, noise_source=NoiseSource.PROCESS)
    scenario = Scenario(PAPER_MOTOR, (fault,), process_noise_std=(0.01, 0.5))
    states = simulate(scenario, 2, np.arange(200)).states
    model = discretize(PAPER_MOTOR, DT_S)
    noise = states[:, 1:] - states[:, :-1] @ model.transition.T - model.gain @ [12.0, 0.0]
    assert noise[:, :499].std(axis=(0, 1)) == pytest.approx([0.01, 0.5], rel=0.01)
    assert noise[:, 499:].std(axis=(0, 1)) == pytest.approx([0.02, 1.0], rel=0.01)


def test_philox_gives_the_published_words() -> None:
    """Known answers of Random123's kat_vectors for philox4x32-10."""
    ones = np.uint32(0xFFFFFFFF)
    zero = np.uint32(0)
    assert philox.py_func is not None
    with np.errstate(over="ignore"):
        answers = [[int(word) for word in philox(*[each] * 6)] for each in (zero, ones)]
    assert answers == [
        [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8],
        [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD],
    ]


def test_streams_keep_their_numbers() -> None:
    """A number is part of every seed's meaning: what is drawn from it is in data sets and benchmarks of strangers."""
    names = (
        "class motor supply measurement process onset sensor split wear field_motor field_start severity missing"
        " calibration profile duty recovery"
    )
    assert [stream.name.lower() for stream in Stream] == names.split()
    drawn_from = [*range(9), *range(10, 18)]  # nothing is drawn from number 9 any more
    assert [stream.value for stream in Stream] == drawn_from


@pytest.mark.parametrize("stream", [Stream.CLASS, Stream.DUTY])
def test_uniforms_are_the_words_of_their_counter(stream: Stream) -> None:
    seed, case = 0x0123456789ABCDEF, 0xFEDCBA9876543
    assert philox.py_func is not None
    for block, four in enumerate(uniforms(seed, stream, [case], 12).reshape(3, 4)):
        counter = block, int(stream), case & 0xFFFFFFFF, case >> 32, seed & 0xFFFFFFFF, seed >> 32
        with np.errstate(over="ignore"):
            words = philox.py_func(*(np.uint32(word) for word in counter))
        assert four.tolist() == [(int(word) + 0.5) / 2**32 for word in words]


def test_normals_never_move_by_a_bit() -> None:
    """Additions, products, roots and shifts of float32 alone, which every processor rounds alike."""
    z = normals(1, Stream.MEASUREMENT, range(64), 1000).astype(np.float32)
    digest = "97f7ec25650bcfd0ebfc5491f19bb43d3d148a14e7d3d1f8b81c498e42078426"
    assert hashlib.sha256(z.tobytes()).hexdigest() == digest


def test_normals_are_the_box_muller_transform_of_the_words() -> None:
    words = (uniforms(5, Stream.MEASUREMENT, range(50), 1000) * 2.0**32 - 0.5).round()
    u, v = (words.reshape(50, -1, 2) + 0.5).transpose(2, 0, 1) * 2.0**-32
    radius = np.sqrt(-2.0 * np.log(u))
    expected = np.stack([radius * np.cos(2.0 * np.pi * v), radius * np.sin(2.0 * np.pi * v)], axis=-1)
    np.testing.assert_allclose(
        normals(5, Stream.MEASUREMENT, range(50), 1000), expected.reshape(50, 1000), atol=1e-5
    )


def test_a_row_does_not_depend_on_its_length_or_neighbours() -> None:
    long = normals(1, Stream.MEASUREMENT, range(20), 1000)
    for count in (1, 3, 5, 255, 256, 257, 999):
        assert np.array_equal(normals(1, Stream.MEASUREMENT, [13], count), long[13:14, :count]), count


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
NOISE, LEVEL = CLEAN - TRUE, 0.5 * np.abs(CLEAN).max(axis=1, keepdims=True)
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
        ("clipped", 0.5, np.clip(CLEAN, -LEVEL, LEVEL)),
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
    volts = np.array([6.0, 12.0])
    both = Scenario(PAPER_MOTOR, (Fault(kind, 0.5),), SupplyParameters(volts), SENSOR, TIMING)
    for read_by in (measure, lambda *given: simulate(*given).measurements):
        together = read_by(both, 4, [0, 1])
        for n, supply in enumerate(volts.tolist()):
            alone = read_by(replace(both, supply=SupplyParameters(supply)), 4, [n])
            np.testing.assert_allclose(together[n], alone[0], rtol=1e-5, atol=1e-5)


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
    clean = measure_draw(drawn._replace(scenario=replace(drawn.scenario, faults=())), recipe, 5)
    factors = {"voltage_gain_50": 1.5, "voltage_polarity_100": -1.0}
    for index, name in enumerate(recipe.class_names):
        rows = drawn.class_index == index
        assert rows.any()
        np.testing.assert_allclose(found[rows, 1], factors.get(name, 1.0) * clean[rows, 1], rtol=1e-6)
        current = np.abs(found[rows, 0] - clean[rows, 0]).max()
        assert (current > 0.02) == (name in ("current_dead_100", "swapped_100"))
    swapped = np.flatnonzero(drawn.class_index == 4)[:1]
    alone = measure_draw(draw(recipe, 5, swapped), recipe, 5)
    np.testing.assert_array_equal(alone, found[swapped])  # a case depends on itself alone
    healthy = replace(recipe, classes=(FaultClass(),))
    other = measure_draw(draw(healthy, 6, swapped), healthy, 6)  # of the next seed
    np.testing.assert_array_equal(alone[:, 0], other[:, 0])


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("speed_dead", "speed_dead needs the speed among the channels current"),
     ("voltage_gain", "voltage_gain needs the voltage among the channels current"),
     ("swapped", "swapped needs the readings of another motor")],
)  # fmt: skip
def test_what_is_not_recorded_cannot_fail(name: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        simulate(Scenario(PAPER_MOTOR, (Fault(FaultKind(name), 1.0),)), 1, [0])


@pytest.mark.parametrize("kind", ["current_clipped", "speed_dead"])
def test_what_knows_motors_alone_refuses_failed_sensors(kind: str) -> None:
    recipe = load_recipe("bench", classes=(FaultClass(), FaultClass(FaultKind(kind), 0.5)))
    with pytest.raises(
        ValueError, match=f"recipe bench must have faults of motors alone for this, got {kind}"
    ):
        class_probabilities(recipe, np.zeros((1, 1, 1000)))
    with pytest.raises(ValueError, match=f"recipe bench has {kind}, which an environment does not simulate"):
        make_setup(MonitorOptions(recipe=recipe))
