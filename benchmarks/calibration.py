"""Ranks of the truth in the posteriors with simultaneous bands, and coverage by class and by severity.

`python benchmarks/calibration.py [--networks NAME ...]`: the two tables of docs/calibrated-probabilities.md. Networks
that are not there are trained first: four minutes for `field`, half a minute for each other one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from cyclopts import run
from networks import network_of
from ranks import check, class_ranks, confidence_ranks, rank_check, severity_ranks, severity_shares
from tables import keep_table

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.severity_density import severity_recipe
from motor_classifiers.estimators.reference_starts import referenced_starts
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.frozen_tasks import load_task
from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

SEED, FIRST = 47, 3_000_000_000
ERROR = 0.001
"""Probability that right posteriors leave any of the bands of one run."""

SHIPPED = "shipped"
NETWORKS = (SHIPPED, "field", "bench-full", "reference")
SURE, _LOOKED_AT = 0.99, 4
_FEWEST = 100  # starts of a class whose coverage is told


class Posterior(NamedTuple):
    """The posterior of one quantity in many cases, beside the truth.

    Attributes:
        name: network and quantity.
        ranks: of the truth, shape (n_cases,).
        covered: share of the cases in which the 90 % set or interval holds the truth, by part of the truth.
    """

    name: str
    ranks: FloatArray
    covered: dict[str, float]


def network(name: str) -> tuple[PosteriorNetwork, Recipe]:
    """The shipped network, or that of a task's recipe."""
    if name == SHIPPED:
        model, recipe, _ = load_model(PRETRAINED)
        assert isinstance(model, PosteriorNetwork)
        return model, recipe
    task = load_task(name)
    return network_of(task.recipe, getattr(task, "n_references", 0)), task.recipe


def of_classes(name: str, n_cases: int) -> Iterator[Posterior]:
    """Class, and confidence, of the first starts in which a network is not sure.

    A right posterior is right given what it saw, and where it is sure, a rank is but a random number.
    """
    model, recipe = network(name)
    cases = referenced_starts(recipe, SEED, FIRST + np.arange(_LOOKED_AT * n_cases), model.n_references)
    probabilities = in_recipe_order(model, model.predict_proba(cases.X), recipe)
    unsure = np.flatnonzero(probabilities.max(axis=1) < SURE)[:n_cases]
    probabilities, truth, count = probabilities[unsure], cases.class_index[unsure], len(unsure)
    # Even: chance in these numbers tells nothing.
    uniform = (np.random.default_rng(SEED).permutation(count) + 0.5) / count
    order = np.argsort(-probabilities, axis=1, kind="stable")
    ranked = np.take_along_axis(probabilities, order, axis=1)
    before = np.cumsum(ranked, axis=1) - ranked
    # Randomised, the set holds exactly nine tenths of the probability.
    inside = np.take_along_axis((before + uniform[:, None] * ranked < 0.9), np.argsort(order, axis=1), axis=1)
    held = inside[np.arange(count), truth]
    covered = {
        f"{label}, {(truth == n).sum()} starts": float(held[truth == n].mean())
        for n, label in enumerate(cases.recipe.class_names)
        if (truth == n).sum() >= _FEWEST
    }
    yield Posterior(f"{name}: class", class_ranks(probabilities, truth, uniform), covered)
    yield Posterior(f"{name}: confidence", confidence_ranks(probabilities, truth, uniform), {})


def of_severities(n_cases: int) -> Iterator[Posterior]:
    """Severity of each kind, by the shipped network."""
    model, recipe = network(SHIPPED)
    ranges = severity_recipe(recipe)
    for n, prior in enumerate(model.severity_priors_):
        cases = generate_arrays(replace(ranges, classes=(ranges.classes[n],)), SEED + 1 + n, n_cases)
        position = cases.severity / prior.largest
        ranks = severity_ranks(severity_shares(model, cases.X, str(prior.kind)), position)
        held = (ranks > 0.05) & (ranks < 0.95)
        thirds, points = np.minimum((3.0 * position).astype(int), 2), 100 * prior.largest / 3
        covered = {
            f"{points * k:.0f} to {points * (k + 1):.0f} %": float(held[thirds == k].mean()) for k in range(3)
        }
        yield Posterior(f"shipped: {prior.kind}", ranks, covered)


def main(*, networks: tuple[str, ...] = NETWORKS, cases: int = 2_000) -> None:
    """Check the severities of the shipped network, and the classes of `shipped` or of tasks."""
    check()
    posteriors = [*of_severities(cases), *(one for name in networks for one in of_classes(name, cases))]
    rows = []
    for one in posteriors:
        band = rank_check(one.ranks, ERROR / len(posteriors))
        rows.append((one.name, str(len(one.ranks)), f"{band.largest:.4f}", "yes" if band.inside else "no"))
    header = ("posterior", "starts", "largest distance", "within its band")
    keep_table("calibrated-probabilities", "ranks", header, rows)
    covered = (
        (one.name, part, f"{100.0 * share:.1f} %")
        for one in posteriors
        for part, share in one.covered.items()
    )
    keep_table("calibrated-probabilities", "coverage", ("posterior", "truth", "90 % sets hold it"), covered)


if __name__ == "__main__":
    run(main)
