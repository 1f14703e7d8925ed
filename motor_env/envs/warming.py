"""What has the environments' steps compiled: each of them once, alone and in a vector, from reset to reset."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import gymnasium as gym
import numpy as np


def _steps(*names: str) -> None:
    for name in names:
        for env in (gym.make(f"motor_env/{name}-v0"), gym.make_vec(f"motor_env/{name}-v0", num_envs=2)):
            env.reset(seed=0)
            space = env.action_space
            env.step(np.zeros(space.shape or (), dtype=space.dtype))
            env.close()


CALLS: dict[str, Callable[[], None]] = {
    "Monitor and Probe": partial(_steps, "Monitor", "Probe", "ProbeContinuous"),
    "Drive": partial(_steps, "Drive"),
    "Maintain": partial(_steps, "Maintain"),
}
