"""Options and arguments: every environment runs to its end and can be copied, or refuses with one sentence."""

import copy
import pickle
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hostile_arguments import Good, Row, rows
from hypothesis import given, settings, strategies as st

from motor_env import (
    Channel,
    MotorParameters,
    Recipe,
    SensorParameters,
    SupplyParameters,
    Timing,
    envs,
    load_motor,
    load_recipe,
)
from motor_env.envs import (
    DriveEnv,
    DriveOptions,
    MaintainEnv,
    MaintainOptions,
    MaintainVectorEnv,
    MonitorEnv,
    MonitorOptions,
    MonitorVectorEnv,
    ProbeContinuousEnv,
    ProbeEnv,
    ProbeOptions,
)

POSITIVE = st.floats(-4.0, 2.0).map(lambda exponent: 10.0**exponent)
MOTORS = st.builds(MotorParameters, *[POSITIVE] * 5, viscous_friction_n_m_s_per_rad=POSITIVE | st.just(0.0))
CHANNELS = st.sampled_from(
    [(Channel.CURRENT,), (Channel.SPEED,), (Channel.CURRENT, Channel.SPEED), (Channel.SPEED, Channel.CURRENT)]
)
RATES_HZ = st.sampled_from([100.0, 5e3, 1e4, 1e6])


def recipe_of(
    motor: MotorParameters, channels: tuple[Channel, ...], rate_hz: float, voltage_v: float
) -> Recipe:
    sensor = SensorParameters(channels=channels, current_noise_a=0.02, speed_noise_rad_s=0.5)
    return replace(
        load_recipe("hard"),
        name="any",
        motor=motor,
        sensor=sensor,
        timing=Timing(rate_hz, 200.0 / rate_hz),
        supply=SupplyParameters(voltage_v),
    )


NUMBERS = st.floats(-1.0, 2.0) | st.sampled_from([0.0, 1e-3, 0.01, 0.02, float("nan"), float("inf"), 1e9])
NAMES = ["easy", "medium", "hard", "paper", "bench", "small", "field", "no such recipe"]
OF_PROBES = ("offsets_v", "max_offset_v", "probe_cost_per_v2_s", "energy_cost_per_j")
OPTIONS: dict[str, st.SearchStrategy[Any]] = {
    **{field.name: NUMBERS for field in fields(ProbeOptions)},
    **dict.fromkeys(("samples_per_step", "growth_levels", "confirm_steps"), st.integers(-1, 40)),
    "offsets_v": st.lists(NUMBERS, max_size=4).map(tuple),
    "recipe": st.sampled_from(NAMES)
    | st.builds(recipe_of, MOTORS, CHANNELS, RATES_HZ, st.floats(-30.0, 30.0)),
    "motor": st.sampled_from(["examples/motor.toml", "maxon", "no such motor"]) | MOTORS,
    "horizon_s": st.sampled_from([0.0, 1e-4, 0.01, 0.0203, -1.0, float("nan")]) | st.floats(0.0, 0.03),
    "start": st.sampled_from(["running", "standstill", "flying"]),
    "precision": st.sampled_from(["float32", "float32", "float16"]),
    "drive": st.sampled_from(["open_loop", "speed_loop", "current_loop"]),
    "observe": st.sampled_from(
        [(), ("time",), ("evidence_bearing", "excess"), ("label",), ("measured_speed",)]
    ),
}


def some_of(make: Any) -> st.SearchStrategy[tuple[Any, dict[str, Any]]]:
    """An environment and any of its options, few at a time, so that some of the sets are good."""
    known = sorted(OPTIONS.keys() - (OF_PROBES if make is MonitorEnv else ()))
    names = st.lists(st.sampled_from(known), max_size=3, unique=True)
    options = names.flatmap(lambda chosen: st.fixed_dictionaries({name: OPTIONS[name] for name in chosen}))
    return st.tuples(st.just(make), options)


def runs_or_refuses(make: Any, options: dict[str, Any]) -> None:
    try:
        env = make(**options)
    except ValueError as refusal:
        sentence = str(refusal)
        assert "\n" not in sentence
        assert 10 < len(sentence) < 400
        return
    observation, _ = env.reset(seed=3)
    wait = env.action_space.low * 0.0 if isinstance(env.action_space, gym.spaces.Box) else 0
    for step in range(min(env.options.n_steps, 400)):
        assert env.observation_space.contains(observation), observation
        observation, reward, over, _, _ = env.step(wait)
        assert np.isfinite(reward)
        assert over == (step == env.options.n_steps - 1)
    assert env.observation_space.contains(observation)


@settings(max_examples=150)
@given(st.sampled_from([MonitorEnv, ProbeEnv, ProbeContinuousEnv]).flatmap(some_of))
def test_any_options_run_or_are_refused(made: tuple[Any, dict[str, Any]]) -> None:
    runs_or_refuses(*made)


OWN = """name = "own"
[motor]
resistance_ohm = 3.0
inductance_mh = 0.2
torque_constant_mnm_per_a = 60.0
rotor_inertia_g_cm2 = 10.0
viscous_friction_n_m_s_per_rad = 1e-6
nominal_voltage_v = 48.0
[tolerance]
resistance = 0.01
temperature_k = 0.0
[sensor]
current_noise_a = 0.003
"""
DRY = OWN.replace("[tolerance]", "coulomb_friction_n_m = 1e-5\n[tolerance]")
JOINT = '[[classes]]\n[[classes]]\nkind = "bearing"\nseverity = 0.1\n[[classes.also]]\nkind = "noise"\nseverity = 0.5'


@pytest.mark.parametrize(
    ("kind", "content", "sentence"),
    [
        ("recipe", "[motor]\nresistanc_ohm = 2.0", "unknown key 'resistanc_ohm'"),
        ("recipe", "[motor", "is not TOML"),
        ("recipe", JOINT, "joint faults"),
        ("recipe", 'base = "field"', "a table field"),
        ("recipe", "starts_per_motor = 2", "several starts of a motor"),
        ("recipe", "[[classes]]", "healthy only"),
        ("motor", "resistance = ", "is not TOML"),
        ("motor", DRY, "an environment's motor is linear"),
        ("motor", OWN.replace("nominal_voltage_v = 48.0", ""), "nominal_voltage_v is missing"),
    ],
)
def test_a_file_that_no_environment_simulates_is_refused(
    kind: str, content: str, sentence: str, tmp_path: Path
) -> None:
    path = tmp_path / "own.toml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=sentence) as refusal:
        gym.make("motor_env/Monitor-v0", **{kind: str(path)})  # type: ignore[arg-type]
    assert "\n" not in str(refusal.value)


def test_a_motor_brings_its_supply_noise_tolerances_and_load_along(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    env = MonitorEnv(motor=str(path))
    task = env.options.task
    assert (task.supply.voltage_v, task.sensor.current_noise_a) == (48.0, 0.003)
    assert task.spread.resistance == pytest.approx(0.01)
    stall = 0.06 * 48.0 / 3.0
    assert env.options.load_n_m == pytest.approx(0.0147 * stall / (0.0235 * 12.0 / 2.18), rel=0.01)
    observation, _ = env.reset(seed=0)
    assert observation[env.setup.observed.index("voltage")] == 1.0
    assert 0.5 < observation[env.setup.observed.index("estimated_speed")] < 1.0
    assert MonitorEnv(motor=str(path), load_torque_n_m=0.001).options.load_n_m == 0.001
    path.write_text(f'notes = ["K is a guess"]\n{OWN}')
    with pytest.warns(UserWarning, match="K is a guess"):
        MonitorEnv(motor=str(path))
    with pytest.raises(ValueError, match="would drive it backwards"):
        MonitorEnv(load_torque_n_m=1.0)


@pytest.mark.parametrize("name", ["Monitor", "Probe", "ProbeContinuous", "Drive", "DriveControl", "Maintain"])
def test_a_copy_in_the_middle_of_an_episode_goes_on_alike(name: str) -> None:
    for env in (gym.make(f"motor_env/{name}-v0"), gym.make_vec(f"motor_env/{name}-v0", num_envs=3)):
        env.reset(seed=1)
        action = np.zeros_like(env.action_space.sample())
        env.step(action)
        copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]  # noqa: S301  # our own bytes
        expected = [*(env.step(action) for _ in range(5)), env.reset()]
        for each in copies:
            np.testing.assert_equal([*(each.step(action) for _ in range(5)), each.reset()], expected)


WRONG_TYPES: Any = ("1", "x", None, [], {}, {1}, True, 10**400, 1j, object(), (None,), ("1", "2"))


@pytest.mark.parametrize("kind", [MonitorOptions, ProbeOptions, DriveOptions, MaintainOptions])
def test_an_option_of_another_type_is_one_sentence(kind: Any) -> None:
    default = kind()
    for field in fields(kind):
        for value in WRONG_TYPES:
            none = kind is not DriveOptions and field.name in ("motor", "load_torque_n_m")
            several: Any = {"observe": ([], ("1", "2")), "ahead_s": ([],)}.get(field.name, ())
            if (value is None and none) or value in several:
                replace(default, **{field.name: value})
                continue
            with pytest.raises(ValueError, match=r"must|no such motor file") as told:
                replace(default, **{field.name: value})
            assert len(str(told.value)) < 400


@pytest.mark.parametrize("make", [MonitorEnv, MonitorVectorEnv, DriveEnv, MaintainEnv, MaintainVectorEnv])
def test_a_seed_has_64_bits(make: Any) -> None:
    env = make()
    last = env.reset(seed=2**64 - 1)[0]
    np.testing.assert_array_equal(env.reset(seed=np.uint64(2**64 - 1))[0], last)
    with pytest.raises(ValueError, match=r"^seed must be a whole number in 0 \.\. 2\^64 - 1, got "):
        env.reset(seed=2**64)
    with pytest.raises(ValueError, match="options of reset must be a dict, got 5"):
        env.reset(options=5)
    with pytest.raises(ValueError, match=r"^options must be [A-Z][a-z]+Options, got {}"):
        make(options={})


SHORTEST_LOOP_S = 2.0 * (1e-4 + 0.238e-3 / 2.18)


FAMILIES = ("Monitor", "Probe", "ProbeContinuous", "Drive", "Maintain")
CLIPPED = ("huge", "-huge", "large", "tiny")


def rows_of(make: Any) -> Iterator[Row]:
    """Of an environment, or of three."""
    name, is_vector = make.__name__, "Vector" in make.__name__

    def stepped(action: Any) -> Any:
        env = new()
        env.reset(seed=1)
        return env.step(action)[:2]

    def new() -> Any:
        return make(3) if is_vector else make()

    def first_seen(**options: Any) -> Any:
        return make(**options).reset(seed=1)[0]

    space = new().action_space
    good = 1 if space.dtype.kind == "i" else 0.25
    action = good if space.shape == () else np.full(space.shape, good, dtype=space.dtype)
    yield Row.of(name, "action", stepped, action, *CLIPPED, "objects")
    yield Row.of(name, "seed", lambda seed: new().reset(seed=seed)[0], 5, "None")
    if is_vector:
        yield from rows(name, first_seen, num_envs=Good(3, "None", also=(0, -1)), autoreset_mode="SameStep")
        yield from rows(
            name, partial(first_seen, num_envs=2), max_episode_steps=Good(3, "None", also=(0, -1))
        )
    else:
        yield from rows(name, first_seen, render_mode=Good("rgb_array", "None"))
        yield Row.of(name, "index", lambda n: new().reset(seed=1, options={"index": n})[0], 2, "None")


MAKERS = [getattr(envs, f"{family}{kind}") for family in FAMILIES for kind in ("Env", "VectorEnv")]


@pytest.mark.parametrize("row", [row for make in MAKERS for row in rows_of(make)], ids=str)
def test_hostile_arguments_of_environments(row: Row) -> None:
    assert row.defects() == []


def test_a_drive_takes_the_parameters_of_a_motor_file(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    with pytest.raises(ValueError, match="the profile must be one that the motor can follow"):
        DriveEnv(motor=str(path))
    path.write_text(OWN.replace("60.0", "25.0"))
    assert DriveEnv(motor=str(path)).options.motor == load_motor(path).parameters
