"""DQN of Stable-Baselines3 on Probe-v0 with its own observation and rewards: a first success in a minute (extra rl).

python examples/dqn_probe.py --steps 30000

Everything is the library's default. It learns the value of single steps, so that the short episodes of a random
beginning do not stop it.
"""

import argparse

import gymnasium as gym
import torch
from stable_baselines3 import DQN

from motor_env.envs import Policy, ProbeVectorEnv, run_episodes
from motor_env.envs.policies.evaluation import interval
from motor_env.envs.policies.rule_policies import Actions, Observations


class Greedy(Policy):
    """The action that the network values most."""

    def __init__(self, model: DQN) -> None:
        self._model = model

    def act(self, observations: Observations) -> Actions:
        """One action for each sub-environment."""
        return self._model.predict(observations, deterministic=True)[0]


def main() -> None:
    """Train and score."""
    parser = argparse.ArgumentParser(description="Train a DQN on Probe-v0.")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    env = gym.make("motor_env:motor_env/Probe-v0")
    model = DQN("MlpPolicy", env, seed=given.seed, device="cpu").learn(given.steps)
    mean, half = interval(run_episodes(ProbeVectorEnv(1000), Greedy(model), 1).returns)
    print(f"DQN after {given.steps} steps: {mean:+.3f} ± {half:.3f}")


if __name__ == "__main__":
    main()
