"""What the Kalman filter's residual buys an agent: PPO that sees it, and PPO that sees raw measurements alone.

python benchmarks/residual_worth.py             # the table of what is kept, and its picture
python benchmarks/residual_worth.py --train     # trains what is missing first; all of it takes an hour of one core
python benchmarks/residual_worth.py --train --only Monitor --variants raw --variants stacked --seeds 0

Each training is a file of its own, `results/reference/ID/VARIANT-SEED.json`, written when it is done: begun anew, the
command goes on with what is missing. The agent that sees the filter's features is PPO of reference_scores.py.

A raw measurement is the mean current of a step. A step has 20 or 40 samples, of which the filter uses each; an agent
that saw the last one alone would lose by that. All agents see voltage and time. Raw numbers are shifted and scaled by
their running mean and deviation (VecNormalize), which takes no model of the motor: beside the current of a stalled
motor a fault is too small for PPO to see.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import reference_scores as reference
import tables
from cyclopts import run
from matplotlib.figure import Figure
from scipy.stats import trim_mean

from motor_env.common.plotting import COLOUR, QUIET, drawing, save
from motor_env.envs.layout import TERMINATED
from motor_env.envs.options import MonitorOptions
from motor_env.envs.policies.evaluation import interval
from motor_env.envs.single import Observation
from motor_env.envs.vector import BoolArray, MotorVectorEnv
from motor_env.motor.parameters import FloatArray

IDS = ("Monitor-v0", "Probe-v0")
SEEDS = {"ppo": 5, "raw": 5, "stacked": 5, "recurrent": 3}
"""What an agent sees, and how many are trained."""
STACKED, RAW = 8, ("measured_current", "voltage", "time")
NAMES = {
    "ppo": ("features of the filter", COLOUR["healthy"]),
    "raw": ("raw", COLOUR["bearing"]),
    "stacked": (f"raw, the last {STACKED} steps", COLOUR["winding"]),
    "recurrent": ("raw, recurrent network", COLOUR["noise"]),
}
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "residual-worth.svg"


class StepMeans(MotorVectorEnv):
    """A vector that takes each action for some samples, and shows the means of what each sample shows.

    Args:
        num_envs: number of sub-environments.
        options: of a task with a decision every sample.
        samples: of a step.
    """

    def __init__(self, num_envs: int, options: MonitorOptions, samples: int) -> None:
        super().__init__(num_envs, options, autoreset_mode="SameStep")
        self.samples = samples
        self._shown: Observation = np.zeros((num_envs, self._n_observed), dtype=np.float32)

    def _begin(self, mask: BoolArray) -> None:
        super()._begin(mask)
        self._begun = mask[:, None]

    def _observe(self) -> Observation:
        """The first sample of an episode that has just begun; of the others the means."""
        return np.where(self._begun, super()._observe(), self._shown)

    def _step(self, actions: Any) -> tuple[Observation, FloatArray, FloatArray, int]:
        """What follows the end of an episode within a step does not count."""
        shown, rewards = (
            np.zeros((self.num_envs, self._n_observed), dtype=np.float32),
            np.zeros(self.num_envs),
        )
        over = np.zeros(self.num_envs, dtype=np.bool_)
        for _ in range(self.samples):
            seen, reward, parts, _ = super()._step(actions)
            shown += seen
            rewards += reward * ~over
            over |= self._flags[TERMINATED, : self.num_envs]
        self._flags[TERMINATED, : self.num_envs] = over
        self._shown = shown / np.float32(self.samples)
        return self._shown, rewards, parts, int(over.sum())


def environments(name: str, variant: str, count: int, *, held_out: bool = False) -> Any:
    """What agents of raw measurements learn in, or are judged in.

    A declaration is confirmed in the first sample of a step. Where agents learn, it is in the last one, so that the
    next episode begins with a step of its own.
    """
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

    from motor_env.envs import StableBaselinesVecEnv

    task = reference.vector(name, 1).options
    samples = task.samples_per_step
    confirm = (task.confirm_steps - 1) * samples + (1 if held_out else samples)
    every = replace(task, samples_per_step=1, confirm_steps=confirm, observe=RAW)
    vector = StableBaselinesVecEnv(StepMeans(count, every, samples))
    envs = VecNormalize(vector, training=not held_out, norm_reward=False)
    return VecFrameStack(envs, STACKED) if variant == "stacked" else envs


def judged(model: Any, envs: Any) -> FloatArray:
    """Return of one episode in each sub-environment, by the likeliest actions."""
    envs.unwrapped.seed(reference.AGENT_SEED)
    observations, state = envs.reset(), None
    begins, alive = np.ones((2, envs.num_envs))
    returns: FloatArray = np.zeros(envs.num_envs)
    while alive.any():
        actions, state = model.predict(observations, state, begins, deterministic=True)
        observations, rewards, begins, _ = envs.step(actions)
        returns += rewards * alive
        alive *= ~begins
    return returns


def trained(name: str, variant: str, seed: int) -> reference.Result:
    """An agent with the defaults of its algorithm, and its learning curve."""
    if variant == "ppo":
        return reference.trained(name, "ppo", seed)
    import torch
    from quick_ppo import QuickPPO, QuickRecurrentPolicy
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.vec_env import sync_envs_normalization

    torch.set_num_threads(1)
    envs = environments(name, variant, reference.N_ENVS)
    test = environments(name, variant, reference.AGENT_EPISODES, held_out=True)
    envs.unwrapped.seed(seed)
    model: Any = (
        RecurrentPPO(QuickRecurrentPolicy, envs, seed=seed, device="cpu")
        if variant == "recurrent"
        else QuickPPO("MlpPolicy", envs, seed=seed, device="cpu")
    )
    begun, curve, rollout = time.process_time(), [], model.n_steps * reference.N_ENVS
    rollouts = -(-reference.STEPS // rollout)
    for part in np.diff(np.linspace(0, rollouts, reference.POINTS + 1).astype(int)):
        model.learn(int(part) * rollout, reset_num_timesteps=False)
        sync_envs_normalization(envs, test)
        mean, half = interval(judged(model, test))
        curve.append({"steps": model.num_timesteps, "return": mean, "half_width": half})
    return {"seed": seed, **curve[-1], "cpu_s": round(time.process_time() - begun), "curve": curve}


def kept(name: str, variant: str) -> list[reference.Result]:
    """The trainings that are kept."""
    paths = sorted((reference.RESULTS / name).glob(f"{variant}-[0-9].json"))
    return [json.loads(path.read_bytes()) for path in paths]


def difference(first: FloatArray, second: FloatArray, rounds: int = 20_000) -> str:
    """By how much one interquartile mean is above another, and its interval by a bootstrap of both."""
    rng = np.random.default_rng(0)
    drawn = [trim_mean(rng.choice(each, (rounds, len(each))), 0.25, axis=1) for each in (first, second)]
    low, high = np.quantile(drawn[0] - drawn[1], [0.025, 0.975])
    return f"{trim_mean(first, 0.25) - trim_mean(second, 0.25):+.3f} ({low:+.3f} to {high:+.3f})"


def table() -> str:
    """What agents and policies return, and how far the features are ahead."""
    rows = []
    for variant, (title, _) in NAMES.items():
        row = [f"PPO, {title}"]
        for name in IDS:
            ours, best = ([one["return"] for one in kept(name, which)] for which in (variant, "ppo"))
            row.append(reference.runs(ours))
            enough = variant != "ppo" and min(len(ours), len(best)) >= reference.FEWEST
            row.append(difference(np.array(best), np.array(ours)) if enough else "")
        rows.append(row)
    for method, title in {
        "textbook": "textbook policy",
        "best": "best policy known",
        "trivial": "silence",
    }.items():
        rows.append(
            [
                title,
                *(text for name in IDS for text in (reference.cell(reference.kept(name).get(method)), "")),
            ]
        )
    return tables.table(["policy", *(text for name in IDS for text in (name, "features ahead by"))], rows)


def draw(path: Path) -> None:
    """Learning curves: interquartile means over the seeds, and their intervals."""
    with drawing():
        figure = Figure(figsize=(9.0, 4.6), layout="constrained")
        for axis, name in zip(figure.subplots(1, 2, sharey=True), IDS, strict=True):
            for variant, (title, colour) in NAMES.items():
                curves = [one["curve"] for one in kept(name, variant)]
                if not curves:
                    continue
                points = [[each["return"] for each in at] for at in zip(*curves, strict=True)]
                spread = [reference.interquartile(np.array(at), np.random.default_rng(0)) for at in points]
                middle, low, high = np.array(spread).T
                steps = np.array([each["steps"] for each in curves[0]]) / 1000.0
                axis.plot(steps, middle, color=colour, label=title)
                axis.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0.0)
            for method, title, line in (("textbook", "textbook policy", "--"), ("trivial", "silence", ":")):
                level = reference.kept(name)[method]["return"]
                axis.axhline(level, color=QUIET, linestyle=line, linewidth=1.5, label=title)
            axis.set(title=name, xlabel="thousand steps of training", xlim=(0.0, 330.0), ylim=(-1.05, 1.0))
        figure.axes[0].set_ylabel("return of an episode")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        save(figure, path)


def main(
    *,
    train: bool = False,
    only: str = "",
    variants: tuple[str, ...] = tuple(SEEDS),
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
) -> None:
    """Train what is missing, print the table, draw the picture.

    Args:
        train: without it nothing is trained.
        only: ids that contain this.
        variants: of ppo (features of the filter), raw, stacked, recurrent.
        seeds: of the trainings; of the recurrent agents the first three.
    """
    jobs = [(name, variant, seed) for variant in variants for name in IDS if only in name for seed in seeds]
    for name, variant, seed in jobs if train else ():
        path = reference.RESULTS / name / f"{variant}-{seed}.json"
        if seed < SEEDS[variant] and not path.exists():
            result = trained(name, variant, seed)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
            print(f"{name} {path.stem}: {reference.cell(result)}, {result['cpu_s']} s of CPU", flush=True)
    print(table())
    draw(PICTURE)


if __name__ == "__main__":
    run(main)
