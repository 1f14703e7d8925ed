"""Agents that learn when a drive should limp or stop, by the PPO of ppo.py (needs torch, safetensors).

python examples/drive_ppo.py --out out/drive                     # five training seeds; some two minutes of one core
python examples/drive_ppo.py --score --out examples/ppo          # scores the weights that are there

The agent does not set the voltage: the fixed LQG does. It decides ten times a second whether the motor runs, limps or
stops, from the environment's own observation and its weighted mean over the last second. No filter bank helps it.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from ppo import LEARNING_RATE, N_ENVS, N_STEPS, Learner, network
from safetensors.torch import load_file, save_file

from motor_env.envs import DriveVectorEnv, Lqg, drive_episodes
from motor_env.envs.baselines.evaluation import interval
from motor_env.envs.drive.evaluation import joined_drives
from motor_env.envs.drive.policies import LIMP, RUN, STOP

HOLD, MEMORY = 10, 0.9  # steps between two decisions; what is left of the mean after these
DECISIONS = np.array([RUN, LIMP, STOP])
RELUCTANCE = (0.0, 1.0, 5.0)  # at first it seldom limps, and hardly ever stops
SEEDS, EPISODES = (11, 12, 13, 14, 15), 200


class Decisions:
    """A drive under the fixed LQG: an action is a decision for ten steps, its reward theirs together.

    What the first steps of a new episode cost, where one ends in between, is dropped.
    """

    def __init__(self, count: int) -> None:
        self.envs = DriveVectorEnv(count, autoreset_mode="SameStep")
        self.lqg = Lqg(self.envs.setup)
        shape = (2 * len(self.envs.setup.observed),)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, shape, dtype=np.float32)
        self.single_action_space = gym.spaces.Discrete(len(DECISIONS))

    def reset(self, seed: int) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin episodes."""
        self.seen, info = self.envs.reset(seed=seed)
        self.lqg.start(self.envs.num_envs)
        self.mean = self.seen.copy()
        return np.concatenate([self.seen, self.mean], axis=1), info

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, ...]:
        """A decision of each sub-environment."""
        rewards, over = np.zeros(len(actions)), np.zeros(len(actions), dtype=np.bool_)
        for _ in range(HOLD):
            chosen = self.lqg.act(self.seen)
            chosen[:, 1] = np.where(over, RUN, DECISIONS[actions])
            self.seen, reward, ended, _, _ = self.envs.step(chosen)
            rewards += reward * ~over
            over |= ended
        self.mean = np.where(over[:, None], self.seen, MEMORY * self.mean + (1.0 - MEMORY) * self.seen)
        return np.concatenate([self.seen, self.mean], axis=1), rewards, over, np.zeros_like(over), {}


class DriveLearner(Learner):
    """The learner of ppo.py on a drive."""

    def __init__(self, seed: int) -> None:
        torch.manual_seed(seed)
        self.envs = Decisions(N_ENVS)
        self.width = self.envs.single_observation_space.shape[0]
        self.actor, self.critic = network(self.width, len(DECISIONS), 0.01), network(self.width, 1, 1.0)
        with torch.no_grad():
            self.actor[-1].bias -= torch.tensor(RELUCTANCE)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, LEARNING_RATE, eps=1e-5)
        self.seen = torch.from_numpy(self.envs.reset(seed=1000 + seed)[0])

    @torch.no_grad()
    def returns(self, count: int, seed: int) -> NDArray[np.float64]:
        """Returns of an episode of each sub-environment, by the likeliest decision."""
        envs = Decisions(count)
        seen, _ = envs.reset(seed)
        total, alive = np.zeros(count), np.ones(count, dtype=np.bool_)
        while alive.any():
            seen, rewards, over, _, _ = envs.step(self.actor(torch.from_numpy(seen)).argmax(1).numpy())
            total += rewards * alive
            alive &= ~over
        return total


def train(learner: DriveLearner, steps: int, points: int = 8) -> list[dict[str, float]]:
    """The learning curve: mean return on validation episodes."""
    rounds, curve = max(1, steps // (N_ENVS * N_STEPS)), []
    for k in range(rounds):
        learner.update(1.0 - k / rounds)
        if (k + 1) * points // rounds > k * points // rounds:
            mean, half = interval(learner.returns(EPISODES, 800))
            curve.append({"steps": (k + 1) * N_ENVS * N_STEPS, "mean_return": mean, "half_width": half})
            print(f"{curve[-1]['steps']:>9} steps: {mean:+.3f} ± {half:.3f}", flush=True)  # noqa: T201
    return curve


def main() -> None:
    """Train or load, score, write."""
    parser = argparse.ArgumentParser(
        description="Train agents that drive, and score them beside the fixed LQG."
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of the training")
    parser.add_argument("--steps", type=int, default=300_000, help="decisions of the training")
    parser.add_argument("--score", action="store_true", help="score the weights in the folder, train nothing")
    parser.add_argument("--out", type=Path, default=Path("out/drive"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    weights_file, results = given.out / "drive.safetensors", given.out / "drive.json"
    weights = load_file(weights_file) if given.score else {}
    envs = DriveVectorEnv(EPISODES)
    fixed, bank = (
        joined_drives([drive_episodes(envs, Lqg(envs.setup, levels=levels), at) for at in SEEDS]).returns
        for levels in (0, 8)
    )
    found: dict[str, Any] = {
        "steps": given.steps,
        "lqg": interval(fixed),
        "bank": interval(bank),
        "agents": {},
    }
    for seed in given.seeds:
        learner = DriveLearner(seed)
        if given.score:
            own = {
                name.split(".", 1)[1]: value for name, value in weights.items() if name.startswith(f"{seed}.")
            }
            learner.actor.load_state_dict(own)
        curve = [] if given.score else train(learner, given.steps)
        ours = np.concatenate([learner.returns(EPISODES, at) for at in SEEDS])
        ahead, behind = interval(ours - fixed), interval(bank - ours)
        print(  # noqa: T201
            f"seed {seed}: {ours.mean():+.3f}, ahead of the LQG by {ahead[0]:+.3f} ± {ahead[1]:.3f}, "
            f"behind the bank by {behind[0]:+.3f} ± {behind[1]:.3f}",
            flush=True,
        )
        weights |= {f"{seed}.{name}": value for name, value in learner.actor.state_dict().items()}
        found["agents"][seed] = {
            "return": interval(ours),
            "ahead": ahead,
            "behind_bank": behind,
            "curve": curve,
        }
    if not given.score:
        save_file(weights, weights_file)
        results.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
