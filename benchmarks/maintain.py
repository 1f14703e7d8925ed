"""Policies of the maintenance task beside its bound.

`python benchmarks/maintain.py` measures, `python benchmarks/result_tables.py` writes docs/results/decisions.md. A
threshold is tuned on seed 100 and scored on seed 1. A range runs from running to failure to an agent that sees level
and rate every morning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from cyclopts import run
from maintain_bounds import clairvoyant_value, maintenance_bound
from tables import keep_table

from motor_env.envs import MaintainOptions, MaintainVectorEnv, PlannedUpkeep, ThresholdReplacement
from motor_env.envs.policies.evaluation import interval, returns_of
from motor_env.envs.policies.rule_policies import Policy

TASKS = {"Maintain-v0": MaintainOptions(), "MaintainUnknownRate-v0": MaintainOptions(rate_spread=0.5)}
TUNED = {
    "calendar": ("age", np.arange(15, 40) / 120.0 - 1e-6),
    "threshold on the severity": ("mean", np.arange(0.60, 0.94, 0.02)),
    "threshold on the remaining life": ("risk", np.geomspace(0.001, 0.05, 18)),
}


def tuned(options: MaintainOptions, feature: str, thresholds: Iterable[float], episodes: int) -> Policy:
    """The threshold with the best mean return."""
    envs = MaintainVectorEnv(episodes, options)
    candidates = [ThresholdReplacement(feature, float(threshold)) for threshold in thresholds]
    return max(candidates, key=lambda policy: float(returns_of(envs, policy, 100).mean()))


def measure(options: MaintainOptions, episodes: int) -> Iterator[list[str]]:
    """A row a policy, the worst first, then what none exceeds."""
    policies: dict[str, Policy] = {"run to failure": ThresholdReplacement("age", np.inf)}
    for name, (feature, thresholds) in TUNED.items():
        policies[name] = tuned(options, feature, thresholds, episodes // 5)
    policies["plan"] = PlannedUpkeep(options)
    envs = MaintainVectorEnv(episodes, options)
    found = {name: interval(returns_of(envs, policy, 1)) for name, policy in policies.items()}
    worst, best = found["run to failure"][0], clairvoyant_value(options)
    shown = {name: (mean, f" ± {half:.3f}") for name, (mean, half) in found.items()}
    shown |= {"bound": (maintenance_bound(options), ""), "sees the wear": (best, "")}
    for name, (mean, half) in shown.items():
        yield [name, f"{mean:+.3f}{half}", f"{(mean - worst) / (best - worst):.1%}"]


def main(*, episodes: int = 20_000) -> None:
    """Measure and keep."""
    for name, options in TASKS.items():
        keep_table("decisions", name, ("policy", "mean return", "of the range"), measure(options, episodes))


if __name__ == "__main__":
    run(main)
