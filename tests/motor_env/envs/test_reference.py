"""The compiled step is the page of NumPy: all Monitor and Probe ids under random actions, step by step."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from motor_env import Channel, FaultKind, SensorParameters, load_recipe
from motor_env.envs.layout import FIELD, block_type
from motor_env.envs.reference import Reference
from motor_env.simulation.recipes import FaultClass, Recovery

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


# To compile a single step in double precision, which nobody gets unasked, takes seven seconds.
@pytest.mark.parametrize(
    ("precision", "within"), [("float32", 4e-3), pytest.param("float64", 1e-9, marks=pytest.mark.long)]
)
@pytest.mark.parametrize("name", TASKS)
def test_the_compiled_step_is_the_page(name: str, precision: str, within: float) -> None:
    identity, options = TASKS[name]
    env: Any = gym.make(identity, precision=precision, disable_env_checker=True, **options).unwrapped
    page, rng, returns = Reference(env.options), np.random.default_rng(3), set()
    rows = env.setup.numbers.features[:, FIELD].astype(int)
    scale, bound, offset = env.setup.view[:, env.setup.chosen]
    for episode in range(4):
        observation = (env.reset(seed=11, options={"index": 2}) if episode == 0 else env.reset())[0]
        np.testing.assert_allclose(observation, page.reset(11, 2, episode), atol=1e-6)
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
            np.testing.assert_allclose(np.clip((values + offset) * scale, -bound, bound), wanted, atol=within)
            np.testing.assert_allclose(observation, wanted, atol=1e-6 + within)
            assert reward == pytest.approx(paid, abs=max(within / 100.0, 1e-9))
            assert over == ends
            step += 1
        returns.add(info["reward_verdict"])
    assert len(returns) > 1  # right, wrong, false, missed or silent
