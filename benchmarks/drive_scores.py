"""What detection is worth to a controller: scores of the baselines of a drive for docs/results/decisions.md.

python benchmarks/drive_scores.py --task Drive-v0       # some two minutes of one core

Thresholds and the PI controller are tuned on 200 episodes of one seed, all are scored on 200 of each of five others.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from clairvoyant import clairvoyant_returns
from cyclopts import run
from pi_controller import PI
from planned_drive import PlannedDrive
from tables import keep_table

from motor_env.envs import DriveVectorEnv, Lqg, drive_episodes
from motor_env.envs.baselines.evaluation import interval, joined
from motor_env.envs.baselines.policies import Player
from motor_env.envs.drive.evaluation import Drives

LEVELS = 8
TUNING_SEED, SEEDS, EPISODES = 1, (11, 12, 13, 14, 15), 200
PI_GRID = {"gain": (0.02, 0.03, 0.05, 0.07), "reset_s": (0.005, 0.01, 0.02)}
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
    scores = [drive_episodes(envs, kind(envs.setup, **point), TUNING_SEED).returns.mean() for point in points]
    return points[int(np.argmax(scores))]


def row(name: str, runs: Drives) -> list[str]:
    """A row of the table."""
    mean, half = interval(runs.returns)
    by_class = [
        f"{runs.returns[runs.class_index == k].mean():.2f}" if (runs.class_index == k).any() else ""
        for k in range(3)
    ]
    parts = [f"{abs(part):.3f}" for part in runs.parts.mean(axis=1)]
    failed = f"{(runs.parts[-1] < 0.0).mean():.1%}"
    return [name, f"{mean:+.3f} ± {half:.3f}", *by_class, *parts, failed]


def main(*, task: str = "Drive-v0") -> None:
    """Tune, score, print."""
    envs, tuning = make(task, EPISODES), make(task, 200)
    bank = partial(Lqg, levels=LEVELS)
    pi, best = tuned(tuning, PI, PI_GRID), tuned(tuning, bank, BANK_GRID)
    print(f"PI {pi}, bank {best}", flush=True)
    policies: dict[str, Player] = {
        "PI": PI(envs.setup, **pi),
        "LQG with integral action": Lqg(envs.setup),
        "voltage by the bank": bank(envs.setup, decides=False),
        "decisions by the bank": bank(envs.setup, reconfigures=False, **best),
        "both by the bank": bank(envs.setup, **best),
        "plan": PlannedDrive(envs.setup),
    }
    scored = {}

    def rows() -> Iterator[list[str]]:
        for name, policy in policies.items():
            scored[name] = joined([drive_episodes(envs, policy, seed) for seed in SEEDS])
            yield row(name, scored[name])

    keep_table("decisions", task, HEADER, rows())
    last = scored["both by the bank"]
    known = np.concatenate([clairvoyant_returns(envs, seed) for seed in SEEDS])
    by_class = [f"{known[last.class_index == k].mean():.2f}" for k in np.unique(last.class_index)]
    mean, half = interval(known)
    print(f"clairvoyant {mean:+.3f} ± {half:.3f}, by class {by_class}")


if __name__ == "__main__":
    run(main)
