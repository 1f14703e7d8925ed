"""Vector environments, lane by lane, against a single environment."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray


def follow(
    env: Any, actions: NDArray[Any], seed: int, index: int, mode: AutoresetMode, told: str
) -> list[Any]:
    """What a vector with that autoreset mode should give for one sub-environment; `told` is of its info."""
    observation, info = env.reset(seed=seed, options={"index": index})
    trace, over = [(observation, 0.0, False, info[told])], False
    for action in actions:
        if over and mode is AutoresetMode.NEXT_STEP:
            (observation, info), reward, over = env.reset(), 0.0, False
        else:
            observation, reward, over, _, info = env.step(action)
            if over and mode is AutoresetMode.SAME_STEP:
                observation, info = env.reset()
        trace.append((observation, reward, over, info[told]))
    return trace


def assert_lanes_are_single(envs: Any, env: Any, actions: NDArray[Any], told: str) -> None:
    """Every lane of a vector does what the environment alone does, over more than two episodes a lane."""
    observations, infos = envs.reset(seed=7)
    seen = [(observations, np.zeros(envs.num_envs), np.zeros(envs.num_envs, bool), infos[told])]
    for action in actions:
        observations, rewards, terminated, truncated, infos = envs.step(action)
        assert not truncated.any()
        seen.append((observations, rewards, terminated, infos[told]))
    assert sum(int(over.sum()) for _, _, over, _ in seen) > 2 * envs.num_envs
    found = [np.array(values) for values in zip(*seen, strict=True)]
    for index in range(envs.num_envs):
        expected = zip(*follow(env, actions[:, index], 7, index, envs.autoreset_mode, told), strict=True)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_array_equal(ours[:, index], theirs)
