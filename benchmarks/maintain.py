"""Policies of the maintenance task beside its bound.

`python benchmarks/maintain.py` measures, `python benchmarks/result_tables.py` writes docs/results/decisions.md. A
threshold is tuned on seed 100 and scored on seed 1. A range runs from running to failure to an agent that sees level
and rate every morning.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from maintain_bounds import clairvoyant_value, maintenance_bound

from motor_env.envs import MaintainOptions, MaintainVectorEnv, PlannedUpkeep, ReplaceFrom
from motor_env.envs.baselines.evaluation import interval, returns_of
from motor_env.envs.baselines.policies import Policy

RESULTS = Path(__file__).resolve().parent / "results" / "maintain.json"
TASKS = {"Maintain-v0": MaintainOptions(), "MaintainUnknownRate-v0": MaintainOptions(rate_spread=0.5)}
TUNED = {
    "calendar": ("age", np.arange(15, 40) / 120.0 - 1e-6),
    "threshold on the severity": ("mean", np.arange(0.60, 0.94, 0.02)),
    "threshold on the remaining life": ("risk", np.geomspace(0.001, 0.05, 18)),
}
Row = dict[str, Any]


def tuned(options: MaintainOptions, feature: str, thresholds: Iterable[float], episodes: int) -> Policy:
    """The threshold with the best mean return."""
    envs = MaintainVectorEnv(episodes, options)
    candidates = [ReplaceFrom(feature, float(threshold)) for threshold in thresholds]
    return max(candidates, key=lambda policy: float(returns_of(envs, policy, 100).mean()))


def measure(options: MaintainOptions, episodes: int) -> list[Row]:
    """A row a policy, the worst first, then what none exceeds."""
    policies: dict[str, Policy] = {"run to failure": ReplaceFrom("age", np.inf)}
    for name, (feature, thresholds) in TUNED.items():
        policies[name] = tuned(options, feature, thresholds, episodes // 5)
    policies["plan"] = PlannedUpkeep(options)
    envs, rows = MaintainVectorEnv(episodes, options), []
    for name, policy in policies.items():
        mean, half = interval(returns_of(envs, policy, 1))
        rows.append({"policy": name, "return": mean, "half_width": half})
        if isinstance(policy, ReplaceFrom) and np.isfinite(policy.threshold):
            rows[-1]["threshold"] = policy.threshold
    bounds = {"bound": maintenance_bound(options), "sees the wear": clairvoyant_value(options)}
    return rows + [{"policy": name, "return": value} for name, value in bounds.items()]


def main(*, episodes: int = 20_000) -> None:
    """Measure and keep."""
    found = {name: measure(options, episodes) for name, options in TASKS.items()}
    RESULTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    run(main)
