"""RecurrentPPO of sb3-contrib: an agent that sees one innovation a step, and has to remember the others (extra rl).

python examples/recurrent_ppo.py                                    # 50,000 steps; five minutes of one core
python examples/recurrent_ppo.py --steps 5000 --tensorboard out/logs   # then: tensorboard --logdir out/logs

A monitor shows running means of the residual by default. Here they are hidden: the network's own memory replaces them.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import RecurrentPPO

import motor_env  # noqa: F401  # registers the environments
from motor_env.envs import StableBaselinesVecEnv

EPISODES, SEED = 500, 77


def environments(count: int) -> StableBaselinesVecEnv:
    """Monitors that show the innovation of the last step and the time."""
    seen = ("innovation_current", "time")
    return StableBaselinesVecEnv(
        gym.make_vec("motor_env/Monitor-v0", num_envs=count, autoreset_mode="SameStep", observe=seen)
    )


def returns(model: Any, envs: StableBaselinesVecEnv) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return of one episode in each sub-environment, by the likeliest actions."""
    envs.seed(SEED)
    observations, state = envs.reset(), None
    found, begins = np.zeros(envs.num_envs), np.ones(envs.num_envs, dtype=bool)
    plays = begins
    while plays.any():
        actions, state = model.predict(observations, state, begins, deterministic=True)
        observations, rewards, begins, _ = envs.step(actions)
        found += rewards * plays
        plays = plays & ~begins
    return found


def main() -> None:
    """Train and score."""
    parser = argparse.ArgumentParser(description="Train an agent with a memory.")
    parser.add_argument("--steps", type=int, default=50_000, help="of training, over all sub-environments")
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--tensorboard", metavar="FOLDER", help="where logs for TensorBoard go")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = RecurrentPPO(
        "MlpLstmPolicy", environments(8), seed=given.seed, device="cpu", tensorboard_log=given.tensorboard
    )
    model.learn(given.steps)
    found = returns(model, environments(EPISODES))
    error = 1.96 * found.std() / EPISODES**0.5
    print(f"mean return {found.mean():+.3f} ± {error:.3f} of {EPISODES} episodes")


if __name__ == "__main__":
    main()
