"""What detection is worth to a controller: scores of the baselines of a drive for docs/drive-and-maintain.md.

python benchmarks/drive_scores.py --task DriveControl-v0       # some two minutes of one core

Thresholds are tuned on 200 episodes of one seed, all policies are scored on 200 of each of five others.
"""

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from best_policies import PlannedDrive
from cyclopts import run
from numpy.typing import NDArray
from tables import keep_table

from motor_env.envs import DriveVectorEnv, Lqg, parts_of, returns_of
from motor_env.envs.policies.evaluation import interval
from motor_env.envs.policies.rule_policies import Player
from motor_env.motor.parameters import FloatArray

LEVELS = 8
TUNING_SEED, SEEDS, EPISODES = 1, (11, 12, 13, 14, 15), 200
PARTS = ("tracking", "heat", "wear", "limping", "stopped", "failure")
BANK_GRID = {
    "limp_above": (0.3, 0.5, 0.7, 0.9),
    "stop_above": ((0.8, 0.75), (0.87, 0.75), (2.0, 0.75), (0.87, 0.65)),
}
HEADER = ("policy", "return", "healthy", "bearing", "winding", *PARTS, "fail")


def make(task: str, count: int) -> DriveVectorEnv:
    """So many of the task."""
    spec = gym.spec(f"motor_env/{task}")
    return DriveVectorEnv(count, **spec.kwargs)


def tuned(
    envs: DriveVectorEnv, kind: Callable[..., Player], grid: Mapping[str, tuple[Any, ...]]
) -> dict[str, Any]:
    """The point of the grid with the best mean return."""
    points = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    scores = [returns_of(envs, kind(envs.setup, **point), TUNING_SEED).mean() for point in points]
    return points[int(np.argmax(scores))]


def by_class(returns: FloatArray, class_index: NDArray[np.int64]) -> list[str]:
    """Mean return of the episodes of each class; empty where there is none."""
    chosen = [returns[class_index == k] for k in range(3)]
    return [f"{those.mean():.2f}" if len(those) else "" for those in chosen]


def row(name: str, parts: FloatArray, class_index: NDArray[np.int64]) -> list[str]:
    """A row of the table."""
    returns = parts.sum(axis=0)
    mean, half = interval(returns)
    means = [f"{abs(part):.3f}" for part in parts.mean(axis=1)]
    failed = f"{(parts[-1] < 0.0).mean():.1%}"
    return [name, f"{mean:+.3f} ± {half:.3f}", *by_class(returns, class_index), *means, failed]


def main(*, task: str = "DriveControl-v0") -> None:
    """Tune, score, print."""
    envs, tuning = make(task, EPISODES), make(task, 200)
    bank = partial(Lqg, levels=LEVELS)
    best = tuned(tuning, bank, BANK_GRID)
    print(f"bank {best}", flush=True)
    policies: dict[str, Player] = {
        "LQG with integral action": Lqg(envs.setup),
        "voltage by the bank": bank(envs.setup, decides=False),
        "decisions by the bank": bank(envs.setup, reconfigures=False, **best),
        "both by the bank": bank(envs.setup, **best),
        "plan": PlannedDrive(envs.setup),
    }
    class_index = np.concatenate([envs.reset(seed=seed)[1]["class_index"] for seed in SEEDS])
    rows = (
        row(name, np.concatenate([parts_of(envs, policy, seed) for seed in SEEDS], axis=1), class_index)
        for name, policy in policies.items()
    )
    keep_table("drive-and-maintain", task, HEADER, rows)


if __name__ == "__main__":
    run(main)
