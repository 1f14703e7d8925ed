"""Scores of controllers of the drive."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs.baselines.policies import Player
from motor_env.envs.drive.env import REWARDS, DriveVectorEnv
from motor_env.motor.parameters import FloatArray


class Drives(NamedTuple):
    """What happened in each episode, and its truth.

    Attributes:
        returns: sum of the rewards, shape (episodes,).
        parts: the same for each part of the reward, in the order of `kernel.PARTS`, shape (parts, episodes).
        class_index: what the motor had, shape (episodes,).
    """

    returns: FloatArray
    parts: FloatArray
    class_index: NDArray[np.int64]


def drive_episodes(envs: DriveVectorEnv, policy: Player, seed: int) -> Drives:
    """Drive: play one episode of a policy in each sub-environment."""
    observations, info = envs.reset(seed=seed)
    policy.start(envs.num_envs)
    class_index, alive = info["class_index"], np.ones(envs.num_envs, dtype=np.bool_)
    parts = np.zeros((len(REWARDS), envs.num_envs))
    for _ in range(envs.options.n_steps):
        observations, _, over, _, info = envs.step(policy.act(observations))
        parts += np.stack([info[name] for name in REWARDS]) * alive
        alive &= ~over
        if not alive.any():
            break
    return Drives(parts.sum(axis=0), parts, class_index)
