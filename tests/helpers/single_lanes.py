"""Vector environments, lane by lane, against a single environment."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray


def follow(env: Any, actions: NDArray[Any], seed: int, index: int, mode: AutoresetMode) -> list[Any]:
    """What a vector with that autoreset mode should give for one sub-environment."""
    observation, info = env.reset(seed=seed, options={"index": index})
    trace, over = [(observation, 0.0, False, info)], False
    for action in actions:
        if over and mode is AutoresetMode.NEXT_STEP:
            (observation, info), reward, over = env.reset(), 0.0, False
        else:
            observation, reward, over, _, info = env.step(action)
            if over and mode is AutoresetMode.SAME_STEP:
                observation, info = env.reset()
        trace.append((observation, reward, over, info))
    return trace


def assert_lanes_are_single(envs: Any, env: Any, actions: NDArray[Any]) -> None:
    """Every lane of a vector does what the environment alone does, over more than two episodes a lane.

    The parts of a reward are the same, too, and their sum is the reward.
    """
    observations, infos = envs.reset(seed=7)
    seen = [(observations, np.zeros(envs.num_envs), np.zeros(envs.num_envs, bool), infos)]
    for action in actions:
        observations, rewards, terminated, truncated, infos = envs.step(action)
        assert not truncated.any()
        parts = [infos[name] for name in infos if name.startswith("reward_")]
        np.testing.assert_allclose(np.sum(parts, axis=0), rewards, atol=1e-6)
        seen.append((observations, rewards, terminated, infos))
    assert sum(int(over.sum()) for _, _, over, _ in seen) > 2 * envs.num_envs
    *found, told = zip(*seen, strict=True)
    arrays = [np.array(values) for values in found]
    for index in range(envs.num_envs):
        trace = follow(env, actions[:, index], 7, index, envs.autoreset_mode)
        *expected, alone = zip(*trace, strict=True)
        for ours, theirs in zip(arrays, expected, strict=True):
            np.testing.assert_array_equal(ours[:, index], theirs)
        for all_infos, info in zip(told, alone, strict=True):
            assert all(all_infos[name][index] == info[name] for name in all_infos.keys() & info.keys())
