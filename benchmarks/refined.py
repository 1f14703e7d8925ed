"""Refined posteriors of motors at work beside the limit: `python benchmarks/refined.py`.

The starts are those of the limit's first run (`benchmarks/field_limit.py --recipe operation`, kept in out/), less the
first hundred, on which the draws were chosen.
"""

from __future__ import annotations

import time

import numpy as np
from cyclopts import run
from field_limit import SEED, Z_95, mean_and_error, single, stored
from tables import keep_table

from motor_datasets.generate import generate_arrays
from motor_env.inference.refined import refined_probabilities
from motor_env.inference.work_features import work_probabilities
from motor_env.motor.parameters import FloatArray

CHOSEN_ON, ENOUGH = 100, 8.0


def main() -> None:
    """Write the table of the fit alone and of the refined posterior."""
    limit, _, seconds = stored("operation", 0)
    each = seconds / len(limit)
    starts = generate_arrays(single("operation"), SEED, range(CHOSEN_ON, len(limit)))
    X, limit = starts.X.astype(np.float64), limit[CHOSEN_ON:]
    began = time.process_time()
    fit = work_probabilities(single("operation"), X)
    halfway = time.process_time()
    refined, effective = refined_probabilities(single("operation"), X, np.random.default_rng(SEED))
    ended = time.process_time()
    believed = ((effective == 0.0) | (effective >= ENOUGH)).all(axis=1)

    def row(name: str, said: FloatArray, seconds: float) -> list[str]:
        behind = limit.max(axis=1) - limit[np.arange(len(limit)), said.argmax(axis=1)]
        mean, error = mean_and_error(100.0 * behind)
        scatter = float(np.sqrt(np.square(said - limit).mean()))
        return [
            name, str(len(limit)), f"{mean:.2f} ± {error:.2f}", f"{mean + Z_95 * error:.2f}", f"{scatter:.3f}",
            f"{1e3 * seconds / len(limit):.0f}", f"{seconds / len(limit) / each:.2f}",
        ]  # fmt: skip

    rows = [row("fit", fit, halfway - began), row("refined", refined, ended - halfway)]
    rows[1][0] += f" ({100.0 * believed.mean():.0f} % believed)"
    header = (
        "posterior",
        "starts",
        "points behind the limit",
        "upper 95 %",
        "RMS difference",
        "ms a start",
        "of the limit's",
    )
    keep_table("calibration", "refined", header, rows)


if __name__ == "__main__":
    run(main)
