"""The amortised posterior network beside the exact posterior: `python benchmarks/limit_cells.py --help`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from motor_classifiers.estimators.networks.posterior_network import UNKNOWN_NOISE, PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.calibration import calibration_scores
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.metrics import IntArray
from motor_classifiers.scoring.severities import severity_figures
from motor_datasets.generate import generate_arrays
from motor_env.files import write_text
from motor_env.inference.posterior import class_probabilities, excess_over_limit
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import changed_recipe, named_recipe
from motor_env.simulation.recipes import Recipe

SEED = 77
RATES_HZ = (10_000.0, 1_000.0)
NOISES_A = (0.005, 0.02, 0.1)
FIRST_CASE = 1_000_000_000

Row = dict[str, Any]


def six_cells(recipe: Recipe) -> Iterator[Recipe]:
    """The recipe at each rate and noise."""
    for rate_hz, noise_a in product(RATES_HZ, NOISES_A):
        yield changed_recipe(recipe, sampling_rate_hz=rate_hz, current_noise_a=noise_a)


def _scores(prefix: str, probabilities: FloatArray, truth: IntArray) -> Row:
    scored = calibration_scores(probabilities, truth)
    return {f"{prefix}{name}": getattr(scored, name) for name in ("accuracy", "log_loss", "ece", "brier")}


def limit_cell(
    model: PosteriorNetwork, recipe: Recipe, seed: int, n_cases: int, n_severities: int = 0
) -> Row:
    """Judge a model on fresh cases of a recipe, beside the exact posterior on the same cases.

    Args:
        model: fitted; it may have been trained for another noise than the recipe's.
        recipe: what the cases are drawn from; its likelihood must be known (no `field`).
        seed: the random seed.
        n_cases: test cases for the classes.
        n_severities: test cases for the severities of each kind.
    """
    test = generate_arrays(recipe, seed, np.arange(n_cases) + FIRST_CASE)
    limit = class_probabilities(recipe, test.X)
    own = in_recipe_order(model, model.predict_proba(test.X), recipe)
    above = excess_over_limit(limit, test.class_index, own.argmax(axis=1))
    severities: Row = {}
    for prior in model.severity_priors_ if n_severities > 0 else ():
        judged = severity_figures(model, recipe, prior, seed, n_severities)
        beside = {f"limit_{name}": value for name, value in judged["limit"].items()}
        severities[str(prior.kind)] = {"n_cases": n_severities, **judged["network"], **beside}
    return {
        "recipe": recipe.name,
        "sampling_rate_hz": recipe.timing.sampling_rate_hz,
        "noise_a": recipe.sensor.current_noise_a,
        "n_cases": n_cases,
        **_scores("", own, test.class_index),
        **_scores("limit_", limit, test.class_index),
        "excess": above.excess,
        "excess_standard_error": above.standard_error,
        "severities": severities,
    }


def networks(
    recipe: Recipe, steps: int, only_rate_hz: float | None
) -> Iterator[tuple[Recipe, PosteriorNetwork]]:
    """Each setting with its network.

    One network serves all noises of a rate, and is not told which; the shipped one where it is of this rate. Where a
    fault is told by its noise, each noise has a network of its own.
    """
    shipped, its_recipe, _ = load_model(PRETRAINED)
    tells_noise = any(c.kind is FaultKind.NOISE for c in recipe.classes)
    known: dict[float, PosteriorNetwork] = {}
    for cell in six_cells(recipe):
        middle = replace(cell, sensor=recipe.sensor)
        rate_hz = cell.timing.sampling_rate_hz
        if only_rate_hz not in (None, rate_hz):
            continue
        if tells_noise:
            yield cell, trained(cell, steps, None)
            continue
        if rate_hz not in known:
            known[rate_hz] = shipped if middle == its_recipe else trained(middle, steps, UNKNOWN_NOISE)
        yield cell, known[rate_hz]


def trained(recipe: Recipe, steps: int, noise_range: tuple[float, float] | None) -> PosteriorNetwork:
    """A network, its training told on standard error."""
    begin, last = time.process_time(), 0

    def tell(done: int, total: int) -> None:
        nonlocal last
        if done * 10 // total > last:
            last = done * 10 // total
            print(f"  trained {10 * last} %", file=sys.stderr, flush=True)

    model = PosteriorNetwork.from_recipe(
        recipe, on_step=tell, steps=steps, noise_range=noise_range, random_state=0
    )
    print(f"  {time.process_time() - begin:.0f} CPU seconds", file=sys.stderr, flush=True)
    return model


def setting(cell: Row) -> str:
    """Columns of rate and noise."""
    return f"{cell['sampling_rate_hz'] / 1e3:g} kHz | {1e3 * cell['noise_a']:g} mA"


def row(cell: Row) -> str:
    """A row of the table of classes."""
    excess, error = 100.0 * cell["excess"], 196.0 * cell["excess_standard_error"]
    return (
        f"| {setting(cell)} | {cell['limit_accuracy']:.4f} | {cell['accuracy']:.4f} "
        f"| {excess:+.2f} ({excess - error:+.2f} to {excess + error:+.2f}) | {cell['limit_log_loss']:.4f} "
        f"| {cell['log_loss']:.4f} | {cell['limit_ece']:.4f} | {cell['ece']:.4f} |"
    )


def severity_rows(cell: Row) -> list[str]:
    """Rows of the table of severities."""
    return [
        f"| {kind} | {setting(cell)} | {100 * s['limit_rmse']:.2f} "
        f"| {100 * s['rmse']:.2f} | {s['limit_coverage']:.3f} | {s['coverage']:.3f} |"
        for kind, s in cell["severities"].items()
    ]


def main() -> None:
    """Train, judge and print, cell by cell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recipe", default="bench", help="bench or bench-full")
    parser.add_argument("--cases", type=int, default=20_000, help="test cases for the classes")
    parser.add_argument("--severities", type=int, default=1_200, help="test cases for each kind's severity")
    parser.add_argument("--steps", type=int, default=2500, help="batches that each trained network sees")
    parser.add_argument("--rate", type=float, help="only this sampling rate, 1000 or 10000")
    parser.add_argument("--out", type=Path, default=Path("out/limit_cells.json"))
    options = parser.parse_args()
    cells = []
    for recipe, model in networks(named_recipe(options.recipe), options.steps, options.rate):
        cells.append(limit_cell(model, recipe, SEED, options.cases, options.severities))
        print(row(cells[-1]), *severity_rows(cells[-1]), sep="\n", flush=True)
        write_text(options.out, json.dumps(cells, indent=1) + "\n")
    print("\n| rate | noise | limit | network | difference, points | log-loss | network | ECE | network |")
    print("|---|---|---|---|---|---|---|---|---|", *map(row, cells), sep="\n")
    print("\n| kind | rate | noise | RMSE, points | network | coverage | network |")
    print("|---|---|---|---|---|---|---|", *(r for cell in cells for r in severity_rows(cell)), sep="\n")


if __name__ == "__main__":
    main()
