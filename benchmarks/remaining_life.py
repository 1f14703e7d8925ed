"""Coverage of the remaining-life interval on synthetic runs to failure: the table of docs/trend.md.

python benchmarks/remaining_life.py --runs 2000
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from cyclopts import run
from run_to_failure import WearRecipe, remaining_life_coverage
from tables import keep_table

from motor_env.motor.parameters import SensorParameters

POPULATION = WearRecipe()
ALIKE = replace(POPULATION, drift_spread=0.0, diffusion_spread=0.0, onset_days=(0.0, 0.0))
REGIMES = {
    "default recipe": POPULATION,
    "differ widely": replace(POPULATION, drift_spread=0.7, diffusion_spread=1.0),
    "half the diffusion": replace(POPULATION, diffusion=0.01),
    "default, 10 mA": replace(POPULATION, sensor=SensorParameters(current_noise_a=0.01)),
    "default, 40 mA": replace(POPULATION, sensor=SensorParameters(current_noise_a=0.04)),
    "all wear from day 0": replace(POPULATION, onset_days=(0.0, 0.0)),
    "all alike": ALIKE,
    "alike, diffusion 0.005": replace(ALIKE, diffusion=0.005),
    "alike, diffusion 0.05": replace(ALIKE, diffusion=0.05),
    "alike, drift 0.005": replace(ALIKE, drift_per_day=0.005),
    "alike, drift 0.02": replace(ALIKE, drift_per_day=0.02),
    "alike, onset day 20 to 40": replace(ALIKE, onset_days=(20.0, 40.0)),
    "no drift, no diffusion": replace(ALIKE, drift_per_day=0.0, diffusion=0.0),
}


def row(name: str, runs: int, seed: int) -> list[str]:
    """One recipe."""
    result = remaining_life_coverage(REGIMES[name], seed, np.arange(runs))
    told = result.reported
    parts = (result.covered, result.life > result.high, result.life < result.low)
    claimed = 100.0 * float(result.claimed[told].mean()) if told.any() else np.nan
    covered, early, late = (100.0 * float(part[told].mean()) if told.any() else np.nan for part in parts)
    return [
        name,
        str(runs),
        f"{100 * result.covered.mean():.1f} % ({100 * result.claimed.mean():.1f})",
        f"{100 * told.mean():.0f} %",
        f"{covered:.1f} % ({claimed:.1f})" if told.any() else "–",
        f"{early:.1f} / {late:.1f} %" if told.any() else "–",
    ]


def main(*, runs: int = 2000, seed: int = 7, recipe: Sequence[str] = tuple(REGIMES)) -> None:
    """Print the table and keep it."""
    header = (
        "recipe",
        "runs",
        "all covered (claimed)",
        "reported",
        "of them covered (claimed)",
        "too early / too late",
    )
    keep_table("trend", "runs", header, (row(name, runs, seed) for name in recipe))


if __name__ == "__main__":
    run(main)
