"""Policies that have understood nothing stay far below the threshold of every id."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import motor_env  # noqa: F401  # registers the environments

IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))
LANES = 24  # of each policy


def degenerate(space: Any, steps: int, rng: np.random.Generator) -> NDArray[Any]:
    """What ten policies do in each step, shape (steps, 10 * LANES, ...): none looks at what it observes."""
    k, shape = np.arange(steps)[:, None], (steps, LANES)
    if isinstance(space, gym.spaces.Discrete):
        n = int(space.n)
        drawn, last = rng.integers(0, n, shape), n - 1
        rows: list[Any] = [
            *(np.full(shape, action % n) for action in range(4)),
            np.full(shape, last),
            drawn,
            np.where(rng.random(shape) < 0.05, drawn, 0),
            np.where(k < steps // 2, 0, last),
            np.where(k < steps // 4, last - 1, 0) if n > 3 else np.where(k < 3 * steps // 4, 1, last),
            np.where(k % 2 == 0, 0, rng.integers(0, n - 1, shape)),
        ]
        return np.concatenate([np.broadcast_to(row, shape) for row in rows], axis=1)
    width = int(space.shape[0])
    one, anything = np.eye(width), rng.uniform(-1.0, 1.0, (*shape, width))
    only_first = anything * one[0] - (1.0 - one[0])
    moves: list[NDArray[np.float64]] = [
        np.zeros((*shape, width)),
        np.ones((*shape, width)),
        -np.ones((*shape, width)),
        np.broadcast_to(one[-1], (*shape, width)),
        np.broadcast_to(0.6 * one[0] - (1.0 - one[0]), (*shape, width)),
        anything,
        only_first,
        np.sign(only_first),
        0.1 * rng.normal(size=(*shape, width)),
        np.where(k[..., None] < steps // 2, 0.5 * one[0], one[-1]) + np.zeros((*shape, width)),
    ]
    return np.concatenate(moves, axis=1)


@pytest.mark.parametrize("name", IDS)
def test_ten_degenerate_policies_stay_far_below(name: str) -> None:
    envs: Any = gym.make_vec(name, num_envs=10 * LANES).unwrapped
    options = envs.options
    steps = getattr(options, "n_steps", getattr(options, "days", 0)) // getattr(
        options, "steps_per_decision", 1
    )
    actions = degenerate(envs.single_action_space, steps, np.random.default_rng(3))
    envs.reset(seed=17)
    total, alive = np.zeros(10 * LANES), np.ones(10 * LANES, dtype=np.bool_)
    for row in actions:
        _, rewards, over, _, _ = envs.step(row)
        total += rewards * alive
        alive &= ~over
    best = total.reshape(10, LANES).mean(axis=1).max()
    threshold = gym.spec(name).reward_threshold
    assert threshold is not None
    assert best < threshold - 0.6


def test_mistakes_of_a_bounded_drive_cost_at_most_five_times_as_much_as_stopping() -> None:
    envs: Any = gym.make_vec("motor_env/DriveBounded-v0", num_envs=10 * LANES).unwrapped
    actions = degenerate(envs.single_action_space, envs.options.n_steps, np.random.default_rng(4))
    envs.reset(seed=18)
    total, alive = np.zeros(10 * LANES), np.ones(10 * LANES, dtype=np.bool_)
    for row in actions:
        row[:, 2] = -1.0  # never stops
        _, rewards, over, _, _ = envs.step(row)
        total += rewards * alive
        alive &= ~over
    stopped = -envs.options.stop_cost_per_s * envs.options.horizon_s
    assert 5.0 * stopped < total.reshape(10, LANES).mean(axis=1).min() < stopped
