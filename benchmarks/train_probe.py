"""Train an agent to probe a motor and to declare its fault, by PPO of Stable-Baselines3 (extra rl), and score it.

python benchmarks/train_probe.py --steps 1200000 --out out/probe-agent

The agent sees the summary of a posterior (`motor_env.envs.baselines.belief`), made from what the environment shows and
nothing else, and learns by PPO (Schulman et al. 2017) from the reward that the posterior expects: the true one on
average, without the noise of luck. It is scored on other seeds beside the best open-loop probe that
benchmarks/baselines.py finds, and beside a textbook rule in closed loop, all on the same episodes. Minutes on one core.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import film
import numpy as np
import torch
from matplotlib import pyplot as plt
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from motor_env.envs.adapters import StableBaselinesVecEnv
from motor_env.envs.baselines.belief import ProbeBelief
from motor_env.envs.baselines.evaluation import Runs, interval, joined, run_episodes, score
from motor_env.envs.baselines.policies import Policy
from motor_env.envs.baselines.posterior_view import PosteriorView, Summarised
from motor_env.envs.baselines.probing import Bursts, OnDemand, OpenLoop, WorthTest
from motor_env.envs.probe import ProbeVectorEnv
from motor_env.envs.setup import Setup

TRAINING_SEED, VALIDATION_SEED = 1000, 800
EVALUATION_SEEDS = (1, 2, 3, 4, 5)
OPEN_LOOP, OPEN_LOOP_THRESHOLD = Bursts(start=20, period=10, length=2), 0.93
ON_DEMAND_ABOVE, ON_DEMAND_THRESHOLD = 0.065, 0.97


def open_loop(setup: Setup) -> Policy:
    """The best open-loop probe and its test, as tuned by benchmarks/baselines.py."""
    return OpenLoop(WorthTest(setup, OPEN_LOOP_THRESHOLD), OPEN_LOOP.actions(setup.options.n_steps))


def on_demand(setup: Setup) -> OnDemand:
    """The textbook rule in closed loop, as tuned there."""
    return OnDemand(WorthTest(setup, ON_DEMAND_THRESHOLD), ON_DEMAND_ABOVE)


def agent(setup: Setup, model: BaseAlgorithm) -> Policy:
    """What was learned, as a policy: the likeliest action, without chance."""
    return Summarised(ProbeBelief(setup), lambda seen: model.predict(seen, deterministic=True)[0])


class Curve(BaseCallback):  # type: ignore[misc]  # it is untyped
    """Scores the agent on validation episodes now and then, keeps its best weights, and shows progress."""

    def __init__(self, steps: int, episodes: int, *, points: int = 8) -> None:
        super().__init__()
        self._envs, self._every, self._total = ProbeVectorEnv(episodes), max(1, steps // points), steps
        self.points: list[dict[str, float]] = []
        self._best, self._due = -np.inf, 0
        self._weights: dict[str, torch.Tensor] = {}
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns)

    def _on_training_start(self) -> None:
        self._progress.start()
        self._task = self._progress.add_task("training", total=self._total)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._progress.update(self._task, completed=self.num_timesteps)
        if self.num_timesteps >= self._due:
            self._due += self._every
            self.measure()

    def _on_training_end(self) -> None:
        self.measure()
        self._progress.stop()
        self.model.policy.load_state_dict(self._weights)

    def measure(self) -> None:
        """One more point of the curve."""
        runs = run_episodes(self._envs, agent(self._envs.setup, self.model), VALIDATION_SEED)
        mean, half_width = interval(runs.returns)
        self.points.append({"steps": self.num_timesteps, "mean_return": mean, "half_width": half_width})
        self._progress.update(self._task, description=f"return {mean:+.3f} ± {half_width:.3f}")
        if mean > self._best:
            state = self.model.policy.state_dict()
            self._best, self._weights = mean, {name: value.clone() for name, value in state.items()}


def train(steps: int, n_envs: int, seed: int, episodes: int) -> tuple[PPO, list[dict[str, float]]]:
    """The agent and its learning curve."""
    torch.set_num_threads(1)
    view = PosteriorView(ProbeVectorEnv(n_envs, autoreset_mode="SameStep"))
    envs = StableBaselinesVecEnv(view)
    envs.seed(TRAINING_SEED + seed)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=64,
        batch_size=8 * n_envs,
        n_epochs=5,
        gamma=1.0,  # an episode is short, and all of it counts
        gae_lambda=0.97,
        ent_coef=1e-3,
        learning_rate=lambda left: 1e-3 * min(1.0, 2.0 * left),
        policy_kwargs={"net_arch": [64, 64]},
        seed=seed,
        device="cpu",
    )
    with torch.no_grad():  # at first it seldom declares: else no episode lasts until its fault
        model.policy.action_net.bias[len(view.belief.setup.options.offsets_v) :] -= 6.0
    curve = Curve(steps, episodes)
    model.learn(steps, callback=curve)
    return model, curve.points


def compare(model: PPO, episodes: int) -> dict[str, Any]:
    """Scores of the agent and its rivals on the same episodes, and how far it is ahead of each."""
    envs = ProbeVectorEnv(episodes)
    rivals = {
        "agent": agent(envs.setup, model),
        "open loop": open_loop(envs.setup),
        "on demand": on_demand(envs.setup),
    }
    runs: dict[str, Runs] = {
        name: joined([run_episodes(envs, policy, seed) for seed in EVALUATION_SEEDS])
        for name, policy in rivals.items()
    }
    ahead = {
        name: interval(runs["agent"].returns - run.returns) for name, run in runs.items() if name != "agent"
    }
    return {
        "scores": {name: score(envs, run).as_row() for name, run in runs.items()},
        "ahead": {name: {"mean": mean, "half_width": half} for name, (mean, half) in ahead.items()},
    }


def draw_curve(points: list[dict[str, float]], compared: dict[str, Any], path: Path) -> None:
    """Learning curve, whole and enlarged where it ends, with the rivals as lines."""
    figure, both = plt.subplots(1, 2, figsize=(8.6, 3.4), layout="constrained")
    steps = np.array([point["steps"] for point in points]) / 1e6
    mean, half = (np.array([point[name] for point in points]) for name in ("mean_return", "half_width"))
    for axes in both:
        axes.fill_between(steps, mean - half, mean + half, color="tab:blue", alpha=0.2, linewidth=0)
        axes.plot(steps, mean, color="tab:blue", marker=".", label="agent, validation episodes (95 %)")
        for name, colour in (("on demand", "tab:green"), ("open loop", "tab:red")):
            level = compared["scores"][name]["mean_return"]
            axes.axhline(level, color=colour, linestyle="--", linewidth=1.2, label=f"{name}, evaluation")
        axes.set(xlabel="million steps of training")
        axes.spines[["top", "right"]].set_visible(False)
    both[0].set(ylabel="mean return")
    both[0].legend(frameon=False, loc="lower right")
    both[1].set(xlim=(0.45 * steps[-1], 1.02 * steps[-1]), ylim=(0.78, 0.92))
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def main() -> None:
    """Train, score, draw."""
    parser = argparse.ArgumentParser(
        description="Train an agent on Probe-v0 and score it beside textbook rules."
    )
    parser.add_argument("--steps", type=int, default=1_200_000, help="of training, over all sub-environments")
    parser.add_argument("--envs", type=int, default=256, help="sub-environments")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=500, help="of each of the five evaluation seeds")
    parser.add_argument("--out", type=Path, default=Path("out/probe-agent"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    model, points = train(given.steps, given.envs, given.seed, given.episodes)
    compared = compare(model, given.episodes)
    (given.out / "evaluation.json").write_text(json.dumps({"curve": points, **compared}, indent=2) + "\n")
    draw_curve(points, compared, given.out / "learning-curve.svg")
    draw_curve(points, compared, given.out / "learning-curve.png")
    env = film.probe()
    film.film(env, agent(env.setup, model), given.out / "episode.gif")
    for name, found in compared["scores"].items():
        print(f"{name:<10} return {found['mean_return']:+.4f} ± {found['return_half_width']:.4f}")
    for name, found in compared["ahead"].items():
        print(f"ahead of {name}: {found['mean']:+.4f} ± {found['half_width']:.4f}")


if __name__ == "__main__":
    main()
