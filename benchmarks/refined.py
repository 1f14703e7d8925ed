"""Refined posteriors beside the limit: `python benchmarks/refined.py`.

The limit's posterior is sampled for starts on which nothing was chosen: half an hour of processor time, kept in out/
beside what `benchmarks/field_limit.py` sampled of others.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from class_by_class import refined_probabilities
from cyclopts import run
from field_limit import SEED, Z_95, chunks, mean_and_error, sample_missing, single, stored
from networks import network_of
from tables import keep_table

from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets.generate import generate_arrays
from motor_env.inference.work_features import work_probabilities
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

STARTS = {"field": range(3500, 6500), "operation": range(1500, 3000)}
ENOUGH = 8.0


def of_network(recipe: Recipe, starts: FloatArray) -> FloatArray:
    """Posterior of the trained network, in the order of the recipe's classes."""
    model = network_of(recipe)
    return in_recipe_order(model, model.predict_proba(starts), recipe)


def rows_of(name: str, other: str, said_by: Callable[[Recipe, FloatArray], FloatArray]) -> list[list[str]]:
    """Rows of the table for a recipe: another posterior, and the refined one."""
    recipe = single(name)
    sample_missing(name, chunks(name, 0, STARTS[name]))
    limit, _, seconds = stored(name, 0, STARTS[name])
    each = seconds / len(limit)
    X = generate_arrays(recipe, SEED, STARTS[name]).X.astype(np.float64)
    said_by(recipe, X[:2])  # what is made once for a recipe
    began = time.process_time()
    said = said_by(recipe, X)
    halfway = time.process_time()
    refined, effective = refined_probabilities(recipe, X, np.random.default_rng(SEED))
    ended = time.process_time()
    believed = ((effective == 0.0) | (effective >= ENOUGH)).all(axis=1)

    def row(title: str, said: FloatArray, seconds: float) -> list[str]:
        behind = limit.max(axis=1) - limit[np.arange(len(limit)), said.argmax(axis=1)]
        mean, error = mean_and_error(100.0 * behind)
        scatter = float(np.sqrt(np.square(said - limit).mean()))
        return [
            name, title, str(len(limit)), f"{mean:.2f} ± {error:.2f}", f"{mean + Z_95 * error:.2f}", f"{scatter:.3f}",
            f"{1e3 * seconds / len(limit):.1f}", f"{seconds / len(limit) / each:.2f}",
        ]  # fmt: skip

    title = f"refined ({100.0 * believed.mean():.1f} % believed)"
    return [row(other, said, halfway - began), row(title, refined, ended - halfway)]


def main() -> None:
    """Write the table of other posteriors and of the refined ones."""
    header = (
        *("recipe", "posterior", "starts", "points behind the limit"),
        *("upper 95 %", "RMS difference", "ms a start", "of the limit's"),
    )
    rows = [*rows_of("field", "network", of_network), *rows_of("operation", "fit", work_probabilities)]
    keep_table("calibration", "refined", header, rows)


if __name__ == "__main__":
    run(main)
