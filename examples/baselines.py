"""Score the baselines of Monitor-v0: thresholds tuned on one seed, scores from another.

python examples/baselines.py --recipe medium --episodes 2000 --out out/baselines.json
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from motor_env.envs.bayes import BayesPolicy
from motor_env.envs.evaluation import Score, score
from motor_env.envs.monitor import MonitorVectorEnv
from motor_env.envs.policies import BankPolicy, Never, Policy, Random, RulePolicy, baseline_features
from motor_env.envs.tasks import task_recipe
from motor_env.rules import Cusum, Glr, MOfN, nis_rule

Build = Callable[[float], Policy]


def candidates(envs: MonitorVectorEnv) -> dict[str, tuple[Build, list[float]]]:
    """Each baseline as a function of its threshold, and the thresholds to try."""
    setup = envs.setup
    shift = 0.12  # of the smallest bearing fault at 20 mA, in standard deviations
    glr = Glr(shortest=5, longest=400, two_sided=True)
    tried: dict[str, tuple[Build, list[float]]] = {
        "never": (lambda _: Never(), [0.0]),
        "random": (lambda p: Random(len(setup.offsets_v), np.random.default_rng(0), p), [1e-3]),
        "NIS": (lambda h: RulePolicy(setup, nis_rule(), h), [14.0, 17.0, 21.0]),
        "3 of 5 NIS": (lambda h: RulePolicy(setup, MOfN(3, 5), h), [5.0, 6.0, 7.5]),
        "CUSUM": (
            lambda h: RulePolicy(setup, Cusum(shift, two_sided=True), h),
            [25.0, 40.0, 55.0, 75.0],
        ),
        "GLR of a step": (lambda h: RulePolicy(setup, glr, h), [20.0, 25.0, 30.0, 36.0]),
        "bank of filters": (lambda h: BankPolicy(setup, h), [6.0, 8.0, 10.0, 13.0]),
    }
    if not envs.options.task.spread.std.any():
        tried["Bayes posterior"] = (lambda v: BayesPolicy(setup, v), [0.8, 0.9, 0.95, 0.98])
    return tried


def best(envs: MonitorVectorEnv, build: Build, thresholds: list[float], seed: int) -> tuple[float, Score]:
    """Threshold with the largest mean return on episodes of one seed; score on those of the next."""
    chosen = thresholds[0]
    if len(thresholds) > 1:
        chosen = max(thresholds, key=lambda h: score(envs, build(h), seed).mean_return)
    return chosen, score(envs, build(chosen), seed + 1)


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description="Score the baselines of Monitor-v0.")
    parser.add_argument("--recipe", default="medium")
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/baselines.json"))
    given = parser.parse_args()
    recipe = task_recipe(given.recipe)
    envs = MonitorVectorEnv(given.episodes, recipe=recipe, observe=baseline_features(recipe))
    rows = []
    print("policy            threshold  return          false alarms  detected  isolated  median delay")  # noqa: T201
    for name, (build, thresholds) in candidates(envs).items():
        threshold, found = best(envs, build, thresholds, given.seed)
        rows.append({"policy": name, "recipe": recipe.name, "threshold": threshold, **found.as_row()})
        print(  # noqa: T201
            f"{name:<18}{threshold:<10g} {found.mean_return:+.3f} ± {found.return_half_width:.3f}"
            f"  {found.false_alarm_share:<12.3f}  {found.detected_share:<8.3f}  {found.isolated_share:<8.3f}"
            f"  {1e3 * found.median_delay_s:.1f} ms",
            flush=True,
        )
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
