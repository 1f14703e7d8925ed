"""Agents that decide after the verdict, by the PPO of ppo.py (needs torch, safetensors).

python examples/decisions_ppo.py --task drive --out out/agents      # five training seeds; some two minutes of one core
python examples/decisions_ppo.py --task maintain --out out/agents   # some seven minutes
python examples/decisions_ppo.py --task drive --score --out examples/ppo   # scores the weights that are there

On Drive-v0 the fixed LQG sets the voltage. The agent decides ten times a second whether the motor runs, limps or stops,
from the environment's own observation and its weighted mean over the last second. No filter bank helps it.

On Maintain-v0 it learns from what a day costs in expectation: the observed risk times the failure, not the luck.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from ppo import N_ENVS, Learner, train
from safetensors.torch import load_file, save_file

from motor_env.envs import (
    DriveVectorEnv,
    Lqg,
    MaintainVectorEnv,
    PlannedUpkeep,
    Policy,
    ThresholdReplacement,
    returns_of,
)
from motor_env.envs.drive.drive_env import LIMP, RUN, STOP
from motor_env.envs.policies.evaluation import interval

HOLD, MEMORY = 10, 0.9  # steps between two decisions of a drive; what is left of the mean after these
DECISIONS = np.array([RUN, LIMP, STOP])
SEEDS = (11, 12, 13, 14, 15)
Floats = NDArray[np.float64]


class Driven:
    """A drive under the fixed LQG: an action is a decision for ten steps, its reward theirs together.

    What the first steps of a new episode cost, where one ends in between, is dropped.
    """

    def __init__(self, count: int) -> None:
        self.num_envs, self.envs = count, DriveVectorEnv(count, autoreset_mode="SameStep")
        self.lqg = Lqg(self.envs.setup)

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


def spread_out(seen: NDArray[np.float32]) -> NDArray[np.float32]:
    """The features of the maintenance on scales of about 1; small risks and the last days are told apart."""
    estimate, mean, std, risk, _, age, left = seen.T
    parts = (4.0 * estimate - 2.0, 8.0 * mean - 5.0, 20.0 * std - 1.4, np.log10(risk + 1e-5) + 2.5)
    return np.stack([*parts, 3.0 * age, 2.0 * left - 1.0, np.exp(-10.0 * left)], axis=1)


class Maintained(gym.vector.VectorWrapper[Any, Any, Any]):
    """Maintenance where a run costs the risk of the day times the failure."""

    def __init__(self, count: int) -> None:
        super().__init__(MaintainVectorEnv(count, autoreset_mode="SameStep"))
        options = self.env.unwrapped.options  # type: ignore[attr-defined]  # ours
        self._costs = np.array([0.0, options.inspection_cost, options.replacement_cost])
        self._failure = options.failure_cost

    def reset(self, seed: int) -> Any:  # type: ignore[override]  # the learner always gives one
        """Begin episodes."""
        self._seen, info = self.env.reset(seed=seed)
        return spread_out(self._seen), info

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, ...]:
        """A day of each motor."""
        risk = np.where(actions == 0, self._seen[:, 3], 0.0)
        self._seen, _, over, truncated, info = self.env.step(actions)
        return spread_out(self._seen), -self._failure * risk - self._costs[actions], over, truncated, info


class Task(NamedTuple):
    """What is learned, and what it is compared with.

    Attributes:
        make: so many sub-environments for the training.
        reluctance: of each action at first.
        entropy: weight of the entropy at first.
        steps: decisions of the training.
        episodes: of each seed of the score.
        returns: of an agent, a function of observations, by the environment's own rewards, with a seed.
        rivals: returns of other policies with a seed, by name.
    """

    make: Callable[[int], Any]
    reluctance: tuple[float, ...]
    entropy: float
    steps: int
    episodes: int
    returns: Callable[[Any, int], Floats]
    rivals: dict[str, Callable[[int], Floats]]


class Chosen(Policy):
    """An agent as a policy, which sees each observation as `show` gives it."""

    def __init__(self, choose: Any, show: Callable[[Any], Any] = np.asarray) -> None:
        self._choose, self._show = choose, show

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Its likeliest action."""
        actions: NDArray[np.int64] = self._choose(self._show(observations))
        return actions


def driven_returns(choose: Any, seed: int) -> Floats:
    """Of a drive."""
    envs: Any = Driven(TASKS["drive"].episodes)
    return returns_of(envs, Chosen(choose), seed)


def maintained_returns(choose: Any, seed: int) -> Floats:
    """Of the maintenance."""
    return returns_of(MaintainVectorEnv(TASKS["maintain"].episodes), Chosen(choose, spread_out), seed)


def lqg_returns(levels: int, seed: int) -> Floats:
    """Of the LQG on a drive."""
    envs = DriveVectorEnv(TASKS["drive"].episodes)
    return returns_of(envs, Lqg(envs.setup, levels=levels), seed)


def upkeep_returns(make: Callable[[Any], Any], seed: int) -> Floats:
    """Of a policy of the maintenance."""
    envs = MaintainVectorEnv(TASKS["maintain"].episodes)
    return returns_of(envs, make(envs.options), seed)


TASKS = {
    "drive": Task(
        Driven,
        (0.0, 1.0, 5.0),
        1e-3,
        300_000,
        200,
        driven_returns,
        {"lqg": lambda seed: lqg_returns(0, seed), "bank": lambda seed: lqg_returns(8, seed)},
    ),
    "maintain": Task(
        Maintained,
        (0.0, 1.0, 4.0),
        0.05,
        1_500_000,
        2000,
        maintained_returns,
        {
            "threshold": lambda seed: upkeep_returns(lambda _: ThresholdReplacement("risk", 0.01), seed),
            "plan": lambda seed: upkeep_returns(PlannedUpkeep, seed),
        },
    ),
}


class Decider(Learner):
    """The learner of ppo.py on such a task."""

    def __init__(self, task: Task, seed: int) -> None:
        self.returns, self.entropy = task.returns, task.entropy
        self.begin(task.make(N_ENVS), task.reluctance, seed)

    def validation(self) -> Floats:
        """Returns of validation episodes."""
        return self.returns(self.choose, 800)


def main() -> None:
    """Train or load, score, write."""
    parser = argparse.ArgumentParser(
        description="Train agents that decide after the verdict, and score them."
    )
    parser.add_argument("--task", choices=TASKS, default="drive")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of the training")
    parser.add_argument("--steps", type=int, help="decisions of the training")
    parser.add_argument("--score", action="store_true", help="score the weights in the folder, train nothing")
    parser.add_argument("--out", type=Path, default=Path("out/agents"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    task, steps = TASKS[given.task], given.steps or TASKS[given.task].steps
    weights_file, results = given.out / f"{given.task}.safetensors", given.out / f"{given.task}.json"
    weights = load_file(weights_file) if given.score else {}
    rivals = {name: np.concatenate([play(at) for at in SEEDS]) for name, play in task.rivals.items()}
    found: dict[str, Any] = {
        "steps": steps,
        "rivals": {name: interval(theirs) for name, theirs in rivals.items()},
        "agents": {},
    }
    for seed in given.seeds:
        learner = Decider(task, seed)
        if given.score:
            own = {
                name.partition(".")[2]: each for name, each in weights.items() if name.startswith(f"{seed}.")
            }
            learner.actor.load_state_dict(own)
        curve = [] if given.score else train(learner, steps)
        ours = np.concatenate([task.returns(learner.choose, at) for at in SEEDS])
        ahead = {name: interval(ours - theirs) for name, theirs in rivals.items()}
        said = ", ".join(
            f"ahead of {name} by {mean:+.3f} ± {half:.3f}" for name, (mean, half) in ahead.items()
        )
        print(f"seed {seed}: {ours.mean():+.3f}, {said}", flush=True)  # noqa: T201
        weights |= {f"{seed}.{name}": value for name, value in learner.actor.state_dict().items()}
        found["agents"][seed] = {"return": interval(ours), "ahead": ahead, "curve": curve}
    if not given.score:
        save_file(weights, weights_file)
        results.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
