"""The compiled step of Monitor and Probe is the page of NumPy; declarations, rewards and failing sensors by hand."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from motor_env import Channel, FaultKind, SensorParameters, Timing, draw, load_recipe
from motor_env.envs import MonitorEnv, MonitorVectorEnv
from motor_env.envs.layout import FIELD, block_type
from motor_env.envs.reference import Reference

# Reaches in: recipes of failing sensors, and their readings in a data set.
from motor_env.simulation.recipes import FaultClass, Recovery, Spread
from motor_env.simulation.sampling import measure_draw

IDS = [name for name in gym.registry if name.startswith(("motor_env/Monitor", "motor_env/Probe"))]
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 0.5)


def failing(kind: str, severity: float, **options: Any) -> tuple[str, dict[str, Any]]:
    """A monitor of bearings and of a fault that comes and goes."""
    recovery = Recovery(mean_duration_s=0.01, mean_pause_s=0.005)
    seldom = (FaultClass(weight=0.2), FaultClass(FaultKind.BEARING, 0.1, 0.2))
    classes = (*seldom, FaultClass(FaultKind(kind), severity, recovery=recovery))
    recipe = load_recipe("bench", sensor=BOTH, classes=classes)
    return "motor_env/MonitorInstant-v0", {"recipe": recipe, "mean_onset_s": 0.02, **options}


TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in IDS},
    "grows from standstill, two sensors": (
        "motor_env/Monitor-v0",
        {
            "recipe": load_recipe("bench", sensor=BOTH),
            "growth_s": 0.02,
            "growth_levels": 5,
            "start": "standstill",
            "correct_reward": 2.0,
            "silent_reward": 3.0,
            "wrong_kind_cost": 4.0,
        },
    ),
    "loop, energy, tolerances": (
        "motor_env/Probe-v0",
        {"recipe": "hard", "drive": "speed_loop", "energy_cost_per_j": 0.7, "mean_onset_s": 0.0},
    ),
    "a loose contact that grows": failing("winding_contact", 0.3, growth_s=0.005, growth_levels=4),
    "a sensor that drifts, beside a bank": ("motor_env/ProbeInstant-v0", failing("current_drift", 0.3)[1]),
    "a sensor that repeats itself": failing("speed_stuck", 1.0, drive="speed_loop"),
}


def action_of(env: Any, rng: np.random.Generator, says: int) -> Any:
    """Any voltage, or the kind of that number, -1 for none."""
    if isinstance(env.action_space, gym.spaces.Box):
        action = rng.uniform(-1.5, 0.5, env.action_space.shape)
        action[1 + says :][: says >= 0] = 0.9
        return action
    offsets = len(env.options.offsets_v)
    return offsets + says if says >= 0 else int(rng.integers(offsets))


SEED = 362 + (5 << 32) + (3 << 40)  # of more than 32 bits; its episodes end in every way


# To compile a single step in double precision, which nobody gets unasked, takes seven seconds. In single precision
# evidence that starts anew may do so a sample later.
@pytest.mark.parametrize(
    ("precision", "usual", "evidence"),
    [("float32", 1e-4, 4e-3), pytest.param("float64", 1e-9, 1e-9, marks=pytest.mark.long)],
)
@pytest.mark.parametrize("name", TASKS)
def test_the_compiled_step_is_the_page(name: str, precision: str, usual: float, evidence: float) -> None:
    identity, options = TASKS[name]
    env: Any = gym.make(identity, precision=precision, disable_env_checker=True, **options).unwrapped
    page, rng, returns = Reference(env.options), np.random.default_rng(3), set()
    rows = env.setup.numbers.features[:, FIELD].astype(int)
    scale, bound, offset = env.setup.view[:, env.setup.chosen]
    within = np.array([evidence if "evidence" in each else usual for each in env.observed])
    for episode in range(4):
        observation = (env.reset(seed=SEED, options={"index": 2}) if episode == 0 else env.reset())[0]
        np.testing.assert_allclose(observation, page.reset(SEED, 2, episode), atol=1e-6)
        # Too early, then each kind once it has something to say, then never.
        after = int(min(page.onset, 1000) // env.options.samples_per_step) + 3
        speaks, kind = ((1, 0), (after, 0), (after, 1), (10**6, 0))[episode]
        over, step = False, 0
        while not over:
            action = action_of(env, rng, kind if step >= speaks else -1)
            observation, reward, over, _, info = env.step(action)
            wanted, paid, ends = page.step(action)
            # An observation is in float32; what it is made from is not.
            values = env._state.view(block_type(precision))[0]["rows"][rows, 0].astype(float)
            found = np.clip((values + offset) * scale, -bound, bound)
            assert (np.abs(found - wanted) <= within).all(), (step, found - wanted)
            np.testing.assert_allclose(observation, found, atol=1e-6)
            assert reward == pytest.approx(paid, abs=max(usual / 10.0, 1e-9))
            assert over == ends
            step += 1
        returns.add(info["reward_verdict"])
    assert len(returns) > 2  # right, wrong, false, missed or silent


WAIT = 0
INSTANT: dict[str, Any] = {"samples_per_step": 1, "confirm_steps": 1}


def monitor(**options: Any) -> MonitorEnv:
    return MonitorEnv(**{**INSTANT, **options})


def monitors(count: int, **options: Any) -> MonitorVectorEnv:
    return MonitorVectorEnv(count, **{**INSTANT, **options})


def seed_of(env: MonitorEnv, label: str) -> int:
    """A seed whose first episode is of that class."""
    return next(seed for seed in range(100) if env.reset(seed=seed)[1]["label"] == label)


@pytest.mark.parametrize(
    ("actions", "ends"),
    [
        ((1, 1), False),
        ((1, 1, 1), True),
        ((1, 1, 2, 1, 1), False),
        ((2, 2, 0, 2, 2), False),
        ((0,) * 199 + (1,), True),  # in the last step the first word counts
    ],
)
def test_a_declaration_can_be_asked_to_be_confirmed(actions: tuple[int, ...], ends: bool) -> None:
    env = monitor(confirm_steps=3, horizon_s=0.02, earliest_onset_s=0.0, mean_onset_s=0.0)
    env.reset(seed=seed_of(env, FaultKind.BEARING))
    *_, last = (env.step(action) for action in actions)
    assert last[2] == ends
    assert not ends or last[1] > 0.0


@pytest.mark.parametrize(
    ("label", "onset", "wait", "action", "reward"),
    [
        ("bearing", 50, 50, 1, -3.0),  # nothing of the fault has been observed yet
        ("bearing", 50, 51, 1, 2.0 - 7e-4),
        ("bearing", 50, 53, 2, -4.0 - 3.0 * 7e-4),
        ("bearing", 50, 199, WAIT, -5.0 - 150.0 * 7e-4),
        ("bearing", 199, 199, WAIT, -5.0 - 7e-4),
        ("bearing", 200, 199, WAIT, 6.0),  # at the horizon is after the episode
        ("healthy", 50, 199, WAIT, 6.0),
        ("healthy", 50, 60, 1, -3.0),
    ],
)
def test_rewards_say_what_the_options_say(
    label: str, onset: int, wait: int, action: int, reward: float
) -> None:
    prices = {"correct_reward": 2.0, "false_alarm_cost": 3.0, "wrong_kind_cost": 4.0, "miss_cost": 5.0}
    prices |= {"silent_reward": 6.0, "delay_cost_per_s": 7.0}
    env = monitor(horizon_s=0.02, earliest_onset_s=onset * 1e-4, mean_onset_s=0.0, **prices)
    env.reset(seed=seed_of(env, label))
    steps = [env.step(each) for each in (*[WAIT] * wait, action)]
    assert [step[1] for step in steps] == pytest.approx([0.0] * wait + [reward], rel=1e-6)
    assert [step[2] for step in steps] == [False] * wait + [True]


LOOSE = Recovery(mean_duration_s=0.004, mean_pause_s=0.002)
FAILING = replace(
    load_recipe("medium"),
    sensor=SensorParameters((Channel.CURRENT, Channel.SPEED), current_noise_a=1e-7, speed_noise_rad_s=1e-5),
    timing=Timing(10_000.0, 0.03),
    classes=(
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.1, severity_to=0.3, recovery=LOOSE),
        FaultClass(FaultKind("current_dead"), 1.0),
        FaultClass(FaultKind("current_gain"), 0.1),
        FaultClass(FaultKind("current_offset"), 0.1, recovery=LOOSE),
        FaultClass(FaultKind("current_drift"), 0.1),
        FaultClass(FaultKind("current_stuck"), 1.0, recovery=LOOSE),
        FaultClass(FaultKind("speed_dead"), 0.7),
        FaultClass(FaultKind("speed_gain"), 0.2),
        FaultClass(FaultKind("speed_offset"), 0.1, severity_to=0.4),
        FaultClass(FaultKind("speed_drift"), 0.02, recovery=LOOSE),
        FaultClass(FaultKind("speed_stuck"), 1.0),
    ),
)
KNOWN = replace(
    FAILING,
    sensor=replace(FAILING.sensor, channels=(Channel.CURRENT,)),
    classes=tuple(replace(c, severity_to=None) for c in FAILING.classes if not c.name.startswith("speed_")),
)


@pytest.mark.parametrize(
    "recipe", [KNOWN, replace(FAILING, spread=Spread(*[0.02] * 5))], ids=["known", "spread"]
)
def test_sensors_fail_and_faults_recover_as_in_a_data_set(recipe: Any) -> None:
    """Every class: its draws, and each reading of a start but for the noise, whose order is another one."""
    channels, wait = recipe.sensor.channels, np.full(60, WAIT)
    options: dict[str, Any] = {"start": "standstill", "load_torque_n_m": 0.0, "horizon_s": 0.03}
    options |= {"earliest_onset_s": 0.0, "mean_onset_s": 0.0}
    envs = monitors(60, recipe=recipe, observe=tuple(f"measured_{c}" for c in channels), **options)
    info, drawn = envs.reset(seed=7)[1], draw(recipe, 7, np.arange(60) << 32)
    np.testing.assert_array_equal(info["class_index"], drawn.class_index)
    np.testing.assert_array_equal(info["severity"], drawn.severity)
    assert set(drawn.class_index) == set(range(len(recipe.classes)))
    steps = [envs.step(wait) for _ in range(300)]
    units = np.array([[12.0 / 2.18], [12.0 / 0.02352]])[: len(channels)]
    found = units * np.stack([step[0] for step in steps], axis=-1)
    np.testing.assert_allclose(found, measure_draw(drawn, recipe, 7), rtol=2e-5, atol=2e-5)
    acts = np.zeros((60, 300), dtype=bool)
    for fault in drawn.scenario.faults:
        fraction = fault.fraction_at(recipe.timing.interval_start_s)
        acts |= np.reshape(fault.severity, (-1, 1)) * fraction > 0.0
    np.testing.assert_array_equal(np.stack([step[4]["fault_active"] for step in steps], axis=-1), acts)
