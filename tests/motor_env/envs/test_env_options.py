"""Options: every environment that can be made can be stepped to its end, or refuses with one sentence."""

import copy
import math
import pickle
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from motor_env import (
    Channel,
    MotorParameters,
    Recipe,
    SensorParameters,
    SupplyParameters,
    Timing,
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
    """A recipe of any motor, sensor, sampling rate and supply."""
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
MONITOR = {
    "recipe": st.sampled_from(
        ["easy", "medium", "hard", "paper", "bench", "small", "field", "no such recipe"]
    )
    | st.builds(recipe_of, MOTORS, CHANNELS, RATES_HZ, st.floats(-30.0, 30.0)),
    "motor": st.sampled_from(["examples/motor.toml", "maxon", "no such motor"]) | MOTORS,
    "horizon_s": st.sampled_from([0.0, 1e-4, 0.01, 0.0203, -1.0, float("nan")]) | st.floats(0.0, 0.03),
    "samples_per_step": st.integers(-1, 25),
    "start": st.sampled_from(["running", "standstill", "flying"]),
    "load_torque_n_m": NUMBERS,
    "earliest_onset_s": NUMBERS,
    "mean_onset_s": NUMBERS,
    "growth_s": st.sampled_from([0.0, 0.001, 0.01, 3.0, -1.0]),
    "growth_levels": st.integers(-1, 40),
    "delay_cost_per_s": NUMBERS,
    "miss_cost": NUMBERS,
    "precision": st.sampled_from(["float32", "float32", "float16"]),
    "drive": st.sampled_from(["open_loop", "speed_loop", "current_loop"]),
    "loop_time_s": NUMBERS,
    "confirm_steps": st.integers(-1, 40),
    "observe": st.sampled_from(
        [(), ("time",), ("evidence_bearing", "excess"), ("label",), ("measured_speed",)]
    ),
}
PROBE = {
    **MONITOR,
    "offsets_v": st.lists(NUMBERS, max_size=4).map(tuple),
    "max_offset_v": NUMBERS,
    "probe_cost_per_v2_s": NUMBERS,
}


def some_of(options: dict[str, st.SearchStrategy[Any]]) -> st.SearchStrategy[dict[str, Any]]:
    """Any of the options, few at a time, so that some of the sets are good."""
    names = st.lists(st.sampled_from(sorted(options)), max_size=3, unique=True)
    return names.flatmap(lambda chosen: st.fixed_dictionaries({name: options[name] for name in chosen}))


def runs_or_refuses(make: Any, options: dict[str, Any]) -> None:
    """The property."""
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


@settings(max_examples=120)
@given(some_of(MONITOR))
def test_monitor_runs_or_refuses(options: dict[str, Any]) -> None:
    runs_or_refuses(MonitorEnv, options)


@settings(max_examples=120)
@given(some_of(PROBE), st.sampled_from([ProbeEnv, ProbeContinuousEnv]))
def test_probe_runs_or_refuses(options: dict[str, Any], make: Any) -> None:
    runs_or_refuses(make, options)


@pytest.mark.parametrize("kind", ["recipe", "motor"])
def test_any_file_runs_or_refuses(kind: str, tmp_path: Path) -> None:
    """A recipe or a motor of one's own as an option of gymnasium.make."""
    files = {
        "recipe": {
            "good": 'base = "bench"\n[sensor]\nchannels = ["current", "speed"]\n[timing]\nsampling_rate_hz = 5000.0',
            "unknown key 'resistanc_ohm'": "[motor]\nresistanc_ohm = 2.0",
            "is not TOML": "[motor",
            "joint faults": '[[classes]]\n[[classes]]\nkind = "bearing"\nseverity = 0.1\n'
            '[[classes.also]]\nkind = "noise"\nseverity = 0.5',
            "a table field": 'base = "field"',
            "several starts of a motor": "starts_per_motor = 2",
            "healthy only": "[[classes]]",
        },
        "motor": {
            "good": Path("examples/motor.toml").read_text(encoding="utf-8"),
            "resistance": "[motor]\nresistance_ohm = -2.0",
            "is not TOML": "resistance = ",
            "an environment's motor is linear": Path("examples/motor.toml")
            .read_text(encoding="utf-8")
            .replace("[tolerance]", "coulomb_friction_n_m = 1e-5\n[tolerance]"),
        },
    }[kind]
    for sentence, content in files.items():
        path = tmp_path / "own.toml"
        path.write_text(content, encoding="utf-8")
        options: dict[str, Any] = {kind: str(path), "horizon_s": 0.02}
        if sentence == "good":
            observation, _ = gym.make("motor_env/Monitor-v0", **options).reset(seed=0)
            assert observation.shape == ((13,) if kind == "recipe" else (9,))
            runs_or_refuses(ProbeEnv, {**options, "samples_per_step": 1})
        else:
            with pytest.raises(ValueError, match=sentence) as refusal:
                gym.make("motor_env/Monitor-v0", **options)
            assert "\n" not in str(refusal.value)
    with pytest.raises(ValueError, match="no such"):
        MonitorEnv(**{kind: "absent.toml"})  # type: ignore[arg-type]  # the name is one of two options


OWN = """name = "own"
[motor]
resistance_ohm = {ohm}
inductance_mh = 0.2
torque_constant_mnm_per_a = {constant}
rotor_inertia_g_cm2 = 10.0
viscous_friction_n_m_s_per_rad = 1e-6
{voltage}
[tolerance]
resistance = 0.01
temperature_k = 0.0
[sensor]
current_noise_a = 0.003
"""


def own_motor(
    tmp_path: Path, voltage: str = "nominal_voltage_v = 48.0", before: str = "", **values: float
) -> str:
    """Path of a motor's file."""
    path = tmp_path / "own.toml"
    path.write_text(before + OWN.format(voltage=voltage, **{"ohm": 3.0, "constant": 60.0, **values}))
    return str(path)


def test_a_motor_brings_its_supply_noise_tolerances_and_load_along(tmp_path: Path) -> None:
    env = MonitorEnv(motor=own_motor(tmp_path))
    task = env.options.task
    assert (task.supply.voltage_v, task.sensor.current_noise_a) == (48.0, 0.003)
    assert task.spread.resistance == pytest.approx(0.01)
    stall = 0.06 * 48.0 / 3.0
    assert env.options.load_n_m == pytest.approx(0.0147 * stall / (0.0235 * 12.0 / 2.18), rel=0.01)
    observation, _ = env.reset(seed=0)
    assert observation[env.setup.observed.index("voltage")] == 1.0
    assert 0.5 < observation[env.setup.observed.index("estimated_speed")] < 1.0
    assert MonitorEnv().options.load_n_m == 0.0147
    assert MonitorEnv(motor=own_motor(tmp_path), load_torque_n_m=0.001).options.load_n_m == 0.001


def test_a_motor_that_does_not_turn_or_says_too_little_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="would drive it backwards"):
        MonitorEnv(load_torque_n_m=1.0)
    with pytest.raises(ValueError, match="nominal_voltage_v is missing"):
        MonitorEnv(motor=own_motor(tmp_path, voltage=""))
    with pytest.warns(UserWarning, match="K is a guess"):
        MonitorEnv(motor=own_motor(tmp_path, before='notes = ["K is a guess"]\n'))


def test_a_drive_takes_a_motor_file(tmp_path: Path) -> None:
    fast = own_motor(tmp_path, constant=25.0)
    assert DriveEnv(motor=fast).options.motor == load_motor(fast).parameters
    with pytest.raises(ValueError, match="the profile must be one that the motor can follow"):
        DriveEnv(motor=own_motor(tmp_path))


def test_an_unknown_option_is_named_and_the_known_ones_listed() -> None:
    for kind in (ValueError, TypeError):
        with pytest.raises(kind, match="no option 'horizn_s'; there are recipe, motor, horizon_s"):
            MonitorEnv(horizn_s=1.0)


@pytest.mark.parametrize("name", ["Monitor", "Probe", "ProbeContinuous", "Drive", "DriveControl", "Maintain"])
def test_a_copy_in_the_middle_of_an_episode_goes_on_alike(name: str) -> None:
    """Search by simulation copies environments; what info tells must be the copy's own."""
    for env in (gym.make(f"motor_env/{name}-v0"), gym.make_vec(f"motor_env/{name}-v0", num_envs=3)):
        env.reset(seed=1)
        action = np.zeros_like(env.action_space.sample())
        for _ in range(3):
            env.step(action)
        copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]  # noqa: S301  # our own bytes
        for _ in range(5):
            expected = env.step(action)
            for each in copies:
                np.testing.assert_equal(each.step(action), expected)
        first = env.reset()
        for each in copies:
            np.testing.assert_equal(each.reset(), first)


WRONG_TYPES: Any = ("1", "x", None, [], {}, {1}, True, 10**400, 1j, object(), (None,), ("1", "2"))
OPTIONS: Any = (MonitorOptions, ProbeOptions, DriveOptions, MaintainOptions)
ENVIRONMENTS: Any = (MonitorEnv, MonitorVectorEnv, DriveEnv, MaintainEnv, MaintainVectorEnv)


@pytest.mark.parametrize("kind", OPTIONS)
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


@pytest.mark.parametrize("make", ENVIRONMENTS)
def test_a_seed_is_a_whole_number_of_64_bits(make: Any) -> None:
    env = make()
    bad: tuple[Any, ...] = (2**64, -1, 1.5, "1", True, {}, 10**400)
    for seed in bad:
        with pytest.raises(ValueError, match=r"^seed must be a whole number in 0 \.\. 2\^64 - 1, got "):
            env.reset(seed=seed)
    last = env.reset(seed=2**64 - 1)[0]
    np.testing.assert_array_equal(env.reset(seed=np.uint64(2**64 - 1))[0], last)
    with pytest.raises(ValueError, match="options of reset must be a dict, got 5"):
        env.reset(options=5)
    with pytest.raises(ValueError, match=r"^options must be [A-Z][a-z]+Options, got {}"):
        make(options={})


def test_an_index_and_a_number_of_environments_are_whole_numbers() -> None:
    env, envs = MonitorEnv(), MonitorVectorEnv(2)
    bad: tuple[Any, ...] = (2**32, -1, 1.5, "1")
    for number in bad:
        with pytest.raises(ValueError, match=r"^index must be a whole number in 0 \.\. 2\^32 - 1, got "):
            env.reset(seed=1, options={"index": number})
        with pytest.raises(ValueError, match=r"^num_envs must be a whole number in 0 \.\. 2\^32 - 1, got "):
            MonitorVectorEnv(number)
    lists: tuple[Any, ...] = ([1, 2**64], [1, "1"])
    for seeds in lists:
        with pytest.raises(ValueError, match=r"^seed must be a whole number in"):
            envs.reset(seed=seeds)


SHORTEST_LOOP_S = 2.0 * (1e-4 + 0.238e-3 / 2.18)


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ({"confirm_steps": 1000}, {"confirm_steps": 1001}),
        ({"growth_levels": 1}, {"growth_levels": 0}),
        ({"samples_per_step": 1}, {"samples_per_step": True}),
        ({"horizon_s": 0.01, "samples_per_step": 100}, {"horizon_s": 0.01, "samples_per_step": 101}),
        ({"horizon_s": 1e-4, "samples_per_step": 1}, {"horizon_s": 4e-5, "samples_per_step": 1}),
        ({"horizon_s": 1000.0}, {"horizon_s": 1000.002}),
        ({"horizon_s": 1000.0}, {"horizon_s": 1e12}),
        ({"loop_time_s": SHORTEST_LOOP_S * 1.000001}, {"loop_time_s": SHORTEST_LOOP_S * 0.999999}),
        ({"loop_time_s": 1000.0}, {"loop_time_s": 1000.1}),
        ({"offsets_v": (1.0,)}, {"offsets_v": ()}),
        ({"offsets_v": (0.0,) * 1000}, {"offsets_v": (0.0,) * 1001}),
        ({"offsets_v": (0.0, -1e6)}, {"offsets_v": (0.0, -1.001e6)}),
        # Beyond, sums of rewards and states would lose their digits or overflow.
        ({"miss_cost": 1e9}, {"miss_cost": 1.001e9}),
        ({"correct_reward": -1e9}, {"correct_reward": -1.001e9}),
        ({"load_torque_n_m": 1e9}, {"load_torque_n_m": 1e300}),
        ({"probe_cost_per_v2_s": 1e9}, {"probe_cost_per_v2_s": 1.001e9}),
        ({"max_offset_v": 1e6}, {"max_offset_v": 1.001e6}),
    ],
)
def test_limits_of_the_options_are_exact(good: dict[str, Any], bad: dict[str, Any]) -> None:
    drive = {"drive": "speed_loop"} if "loop_time_s" in good else {}
    of_probes = {"offsets_v", "max_offset_v", "probe_cost_per_v2_s"}
    make: Any = ProbeOptions if of_probes & good.keys() else MonitorOptions
    make(**good, **drive)
    with pytest.raises(ValueError, match=next(iter(bad))):
        make(**bad, **drive)


def test_a_seed_of_ones_own_is_any_of_63_bits() -> None:
    env, envs = MonitorEnv(), MonitorVectorEnv(2)
    seed = int(np.random.default_rng(5).integers(2**63))
    wanted = env.reset(seed=seed)[0]
    for one in (env, envs):
        one._np_random = np.random.default_rng(5)
    env._seed = None  # as before the first reset
    np.testing.assert_array_equal(env.reset()[0], wanted)
    np.testing.assert_array_equal(envs.reset()[0][0], wanted)


def test_counts_that_follow_from_the_options() -> None:
    options = MonitorOptions(horizon_s=0.02, samples_per_step=4)
    assert (options.n_samples, options.n_steps, options.n_levels) == (200, 50, 1)
    assert MonitorOptions(growth_s=0.4e-4).n_levels == 1  # rounds to no sample
    assert MonitorOptions(growth_s=0.6e-4).n_levels == 16
    with pytest.raises(ValueError, match="samples long, got 20000000"):
        MonitorOptions(horizon_s=1e12)


@pytest.mark.parametrize("env", ["Monitor", "Probe"])
@pytest.mark.parametrize("action", [1.9, "1", None, np.float32(1.0), 99, -1])
def test_an_action_is_a_whole_number(env: str, action: Any) -> None:
    made = gym.make(f"motor_env/{env}-v0", disable_env_checker=True).unwrapped
    made.reset(seed=1)
    with pytest.raises(ValueError, match=r"action must be a whole number in 0 \.\. \d+, got "):
        made.step(action)
    assert math.isfinite(float(made.step(np.int64(0))[1]))
