"""Every method given k = 0, 1, 3 healthy starts of the same motor: the tables of docs/healthy-starts.md.

`python benchmarks/references.py --rate-hz 10000` prints each cell as it comes; `--method` takes some of them. Aeon's
classifiers join in where `make peers` has set up their environment.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from cyclopts import run
from peers import PYTHON, peer_answers
from tables import keep_table

from motor_classifiers.estimators.cases import with_channels
from motor_classifiers.estimators.methods import ESTIMATE, METHODS, make_method
from motor_classifiers.estimators.reference_starts import (
    RecentredStarts,
    referenced_probabilities,
    referenced_starts,
)
from motor_classifiers.scoring.metrics import IntArray
from motor_datasets.arrays import Dataset
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import Timing

SEED = 0
TEST = 1_000_000  # first motor of the test
COUNTS = (0, 1, 3)
PEERS = ("quant", "minirocket")

Told = tuple[str, IntArray]
"""A method, and the class index that it decides on for each test start."""


def decide(name: str, recipe: Recipe, train: Dataset, test: Dataset, n_references: int) -> IntArray:
    """Train one of our methods on starts as it takes them; the network that learns from a stream takes references."""
    model = make_method(name, recipe, SEED)
    if name == ESTIMATE:
        model.set_params(n_references=n_references, with_severity=False)
    decided = model.fit(train.X, train.class_name).predict(test.X)
    names = {class_name: n for n, class_name in enumerate(recipe.class_names)}
    return np.array([names[class_name] for class_name in decided.tolist()])


def peers_decide(train: Dataset, test: Dataset) -> Iterator[Told]:
    """Aeon's classifiers on the same starts, in their own environment."""
    for name, probabilities in peer_answers(train, test, *PEERS).items():
        yield name, probabilities.argmax(axis=1)


def recentred(cases: Dataset, recipe: Recipe) -> Dataset:
    """The judged starts as if their motors were the nominal one."""
    flat: FloatArray = RecentredStarts(recipe).fit_transform(cases.X)
    return replace(cases, X=with_channels(flat, recipe).astype(np.float32))


def decisions(
    names: list[str], recipe: Recipe, train: Dataset, test: Dataset, n_references: int
) -> Iterator[Told]:
    """The methods named, one by one; without names all, and the peers."""
    plain = recentred(train, recipe), recentred(test, recipe)
    for name in names or METHODS:
        learned, judged = (train, test) if name == ESTIMATE else plain
        yield name, decide(name, recipe, learned, judged, n_references)
    if not names and PYTHON.exists():
        yield from peers_decide(*plain)
        if n_references:
            yield from ((f"{name}, the starts as channels", told) for name, told in peers_decide(train, test))


def against_limit(decided: IntArray, best: IntArray, truth: IntArray) -> str:
    """Accuracy, and in points the difference from the limit's on the same starts with its standard error."""
    right = decided == truth
    difference = 100.0 * (right.astype(np.float64) - (best == truth))
    error = difference.std() / np.sqrt(len(truth))
    return f"{right.mean():.4f} ({difference.mean():+.2f} ± {error:.2f})"


def keep(names: list[str], rate_hz: float, n_train: int, n_test: int) -> None:
    """Make one rate's table: methods down, reference starts across."""
    recipe = named_recipe("bench", timing=Timing(rate_hz, 0.1))
    rows: dict[str, list[str]] = {"expected of the limit": [], "limit": []}
    for column, k in enumerate(COUNTS):
        train = referenced_starts(recipe, SEED, np.arange(n_train), k)
        test = referenced_starts(recipe, SEED, np.arange(n_test) + TEST, k)
        posterior = referenced_probabilities(recipe, test.X)
        best, sure = posterior.argmax(axis=1), posterior.max(axis=1)
        rows["expected of the limit"].append(f"{sure.mean():.4f} ± {sure.std() / np.sqrt(n_test):.4f}")
        rows["limit"].append(f"{(best == test.class_index).mean():.4f}")
        for name, decided in decisions(names, recipe, train, test, k):
            cell = against_limit(decided, best, test.class_index)
            print(f"{rate_hz:g} Hz, k = {k}, {name}: {cell}", file=sys.stderr, flush=True)
            row = rows.setdefault(name, [])
            row += [""] * (column - len(row)) + [cell]
    header = (f"{rate_hz / 1e3:g} kHz", *(f"k = {k}" for k in COUNTS))
    keep_table("healthy-starts", f"{rate_hz:g}-hz", header, ([name, *cells] for name, cells in rows.items()))


def main(
    *,
    rate_hz: tuple[float, ...] = (10_000.0, 1_000.0),
    method: list[str] | None = None,
    n_train: int = 2000,
    n_test: int = 10_000,
) -> None:
    """Make a table for each rate.

    Args:
        rate_hz: may be repeated.
        method: may be repeated; all, and the peers, by default.
        n_train: starts to learn from.
        n_test: starts to be judged.
    """
    for each in rate_hz:
        keep(method or [], each, n_train, n_test)


if __name__ == "__main__":
    run(main)
