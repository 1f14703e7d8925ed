"""The amortised posterior network beside the exact posterior: `python benchmarks/limit_cells.py --help`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_classifiers.estimators.networks.posterior_network import UNKNOWN_NOISE, PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.calibration import CalibrationScores, calibration_scores
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.severities import SeverityCell, severity_cell
from motor_datasets.generate import generate_arrays
from motor_env.files import write_text
from motor_env.inference.posterior import Excess, class_probabilities, excess_over_limit
from motor_env.motor.faults import FaultKind
from motor_env.simulation.recipes import Recipe, named_recipe

SEED = 77
RATES_HZ = (10_000.0, 1_000.0)
NOISES_A = (0.005, 0.02, 0.1)
FIRST_CASE = 1_000_000_000


def six_cells(recipe: Recipe) -> Iterator[Recipe]:
    """The recipe at each rate and noise."""
    for rate_hz in RATES_HZ:
        for noise_a in NOISES_A:
            timing = replace(recipe.timing, sampling_rate_hz=rate_hz)
            yield replace(recipe, timing=timing, sensor=replace(recipe.sensor, current_noise_a=noise_a))


@dataclass(frozen=True, slots=True)
class LimitCell:
    """One setting.

    Attributes:
        recipe: with its rate and noise.
        n_cases: test cases.
        model: of the classifier's probabilities.
        limit: of the exact posterior's on the same cases.
        excess: accuracy above the limit, compared in pairs.
        severities: by kind.
    """

    recipe: Recipe
    n_cases: int
    model: CalibrationScores
    limit: CalibrationScores
    excess: Excess
    severities: tuple[SeverityCell, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """One row, for a table or a file."""
        return {
            "recipe": self.recipe.name,
            "sampling_rate_hz": self.recipe.timing.sampling_rate_hz,
            "noise_a": self.recipe.sensor.current_noise_a,
            "n_cases": self.n_cases,
            **_scores("", self.model),
            **_scores("limit_", self.limit),
            "excess": self.excess.excess,
            "excess_standard_error": self.excess.standard_error,
            "severities": {
                str(cell.prior.kind): {
                    "n_cases": cell.n_cases,
                    **cell.model._asdict(),
                    **{f"limit_{name}": value for name, value in cell.limit._asdict().items()},
                }
                for cell in self.severities
            },
        }


def _scores(prefix: str, scored: CalibrationScores) -> dict[str, float]:
    return {f"{prefix}{name}": getattr(scored, name) for name in ("accuracy", "log_loss", "ece", "brier")}


def limit_cell(
    model: PosteriorNetwork, recipe: Recipe, seed: int, n_cases: int, n_severities: int = 0
) -> LimitCell:
    """Judge a model on fresh cases of a recipe.

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
    return LimitCell(
        recipe,
        n_cases,
        calibration_scores(own, test.class_index),
        calibration_scores(limit, test.class_index),
        excess_over_limit(limit, test.class_index, own.argmax(axis=1)),
        tuple(
            severity_cell(model, recipe, prior, seed, n_severities)
            for prior in model.severity_priors_
            if n_severities > 0
        ),
    )


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


def row(cell: LimitCell) -> str:
    """A row of the table of classes."""
    rate, noise = cell.recipe.timing.sampling_rate_hz, cell.recipe.sensor.current_noise_a
    excess, error = 100.0 * cell.excess.excess, 196.0 * cell.excess.standard_error
    model, limit = cell.model, cell.limit
    return (
        f"| {rate / 1e3:g} kHz | {1e3 * noise:g} mA | {limit.accuracy:.4f} | {model.accuracy:.4f} "
        f"| {excess:+.2f} ({excess - error:+.2f} to {excess + error:+.2f}) | {limit.log_loss:.4f} "
        f"| {model.log_loss:.4f} | {limit.ece:.4f} | {model.ece:.4f} |"
    )


def severity_rows(cell: LimitCell) -> list[str]:
    """Rows of the table of severities."""
    rate, noise = cell.recipe.timing.sampling_rate_hz, cell.recipe.sensor.current_noise_a
    return [
        f"| {s.prior.kind} | {rate / 1e3:g} kHz | {1e3 * noise:g} mA | {100 * s.limit.rmse:.2f} "
        f"| {100 * s.model.rmse:.2f} | {s.limit.coverage:.3f} | {s.model.coverage:.3f} |"
        for s in cell.severities
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
        write_text(options.out, json.dumps([cell.as_json() for cell in cells], indent=1) + "\n")
    print("\n| rate | noise | limit | network | difference, points | log-loss | network | ECE | network |")
    print("|---|---|---|---|---|---|---|---|---|", *map(row, cells), sep="\n")
    print("\n| kind | rate | noise | RMSE, points | network | coverage | network |")
    print("|---|---|---|---|---|---|---|", *(r for cell in cells for r in severity_rows(cell)), sep="\n")


if __name__ == "__main__":
    main()
