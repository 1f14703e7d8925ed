"""What has the environments and their best policies compiled: a step of each alone and in a vector, and an episode."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import gymnasium as gym
import numpy as np

from motor_env.envs.offline.behaviours import TASKS, Behaviour
from motor_env.envs.offline.recording import episodes_of


def _steps(*names: str) -> None:
    for name in names:
        for env in (gym.make(f"motor_env/{name}-v0"), gym.make_vec(f"motor_env/{name}-v0", num_envs=2)):
            env.reset(seed=0)
            space = env.action_space
            env.step(np.zeros(space.shape or (), dtype=space.dtype))
            env.close()


def _policies() -> None:
    for task in TASKS:
        for behaviour in (Behaviour.RULE, Behaviour.BEST):
            episodes_of(task, behaviour, 1, 0)


CALLS: dict[str, Callable[[], None]] = {
    "Monitor and Probe": partial(_steps, "Monitor", "Probe", "ProbeContinuous"),
    "Drive": partial(_steps, "Drive"),
    "Maintain": partial(_steps, "Maintain"),
    "policies": _policies,
}
