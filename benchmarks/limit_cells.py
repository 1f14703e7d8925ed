"""The amortised posterior network beside the exact posterior: `python benchmarks/limit_cells.py --help`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from motor_classifiers.estimators.networks.posterior_network import UNKNOWN_NOISE, PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.limit_cells import LimitCell, limit_cell, six_cells
from motor_env.files import write_text
from motor_env.motor.faults import FaultKind
from motor_env.simulation.recipes import Recipe, named_recipe

SEED = 77


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
