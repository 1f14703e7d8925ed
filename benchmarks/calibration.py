"""Calibration as simulation-based inference tests it: `python benchmarks/calibration.py [--networks NAME ...]`.

Ranks of the truth in the posterior with simultaneous bands, coverage by class and by severity; and, where `make bench`
has set up .venv-bench, TARP (Lemos et al. 2023) and LC2ST (Linhart et al. 2023) by `sbi`. Tables go to
docs/calibration.md by `python benchmarks/result_tables.py`.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from class_by_class import refined_probabilities
from cyclopts import run
from networks import network_of
from ranks import class_ranks, confidence_ranks, rank_check, severity_ranks, severity_shares
from tables import keep_table

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.severity_density import severity_recipe
from motor_classifiers.estimators.reference_starts import referenced_starts
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.frozen_tasks import load_task
from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.inference.work_features import work_fit
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

FOLDER = Path(__file__).resolve().parent
PYTHON = FOLDER.parent / ".venv-bench" / "bin" / "python"
SEED, FIRST = 47, 3_000_000_000
ERROR = 0.001
"""Probability that right posteriors leave any of the bands of one run."""

SHIPPED, WORK = "shipped", "operation"
NETWORKS = (SHIPPED, "field", "bench-full", "reference", WORK)
SURE, _LOOKED_AT = 0.99, 4
_FEWEST = 100  # starts of a class whose coverage is told


class Posterior(NamedTuple):
    """The posterior of one quantity in many cases, beside the truth.

    Attributes:
        name: network and quantity.
        ranks: of the truth, shape (n_cases,).
        covered: share of the cases in which the 90 % set or interval holds the truth, by part of the truth.
        truth: shape (n_cases, n_values), for `sbi`.
        draws: from the posterior, shape (n_draws, n_cases, n_values).
        seen: what the network sees of each case, shape (n_cases, n_coordinates).
    """

    name: str
    ranks: FloatArray
    covered: dict[str, float]
    truth: FloatArray
    draws: FloatArray
    seen: FloatArray


def network(name: str) -> tuple[PosteriorNetwork, Recipe]:
    """The shipped network, or that of a task's recipe."""
    if name == SHIPPED:
        model, recipe, _ = load_model(PRETRAINED)
        assert isinstance(model, PosteriorNetwork)
        return model, recipe
    task = load_task(name)
    return network_of(task.recipe, getattr(task, "n_references", 0)), task.recipe


def seen_by(space: Callable[[torch.Tensor], torch.Tensor], X: Any) -> FloatArray:
    """What the network with these coordinates sees of each case."""
    seen: FloatArray = space(torch.from_numpy(X.reshape(len(X), -1).astype(np.float64))).numpy()
    return seen


Answers = tuple[Dataset, FloatArray, Callable[[FloatArray], FloatArray]]
"""Cases, the probability of each class, and what a method sees of cases."""


def of_network(name: str, count: int) -> Answers:
    """By the network of a task."""
    model, recipe = network(name)
    cases = referenced_starts(recipe, SEED, FIRST + np.arange(count), model.n_references)
    probabilities = in_recipe_order(model, model.predict_proba(cases.X), recipe)
    return cases, probabilities, partial(seen_by, model.posterior_.space)


def at_work(name: str, count: int) -> Answers:
    """Of motors at work by the fit, refined class by class."""
    recipe = load_task(name).recipe
    cases = generate_arrays(recipe, SEED, FIRST + np.arange(count))
    probabilities, _ = refined_probabilities(recipe, cases.X.astype(np.float64), np.random.default_rng(SEED))
    return cases, probabilities, lambda X: work_fit(recipe, X).values


def of_classes(name: str, n_cases: int, n_draws: int) -> Iterator[Posterior]:
    """Class, and confidence, of the first starts in which a network is not sure.

    A right posterior is right given what it saw, and where it is sure, a rank is but a random number.
    """
    cases, probabilities, sight = (at_work if name == WORK else of_network)(name, _LOOKED_AT * n_cases)
    recipe = cases.recipe
    unsure = np.flatnonzero(probabilities.max(axis=1) < SURE)[:n_cases]
    probabilities, n_cases = probabilities[unsure], len(unsure)
    X, truth = cases.X[unsure].astype(np.float64), cases.class_index[unsure]
    generator = np.random.default_rng(SEED)
    uniform = (generator.permutation(n_cases) + 0.5) / n_cases  # even: chance in these numbers tells nothing
    n_classes = probabilities.shape[1]
    drawn = (generator.uniform(size=(n_draws, n_cases, 1)) > np.cumsum(probabilities, axis=1)).sum(axis=2)
    drawn = np.minimum(drawn, n_classes - 1)

    def spread(index: Any) -> FloatArray:
        # A class as a point of its own, and around it a little: distances have no ties then.
        around: FloatArray = 0.5 * generator.uniform(size=(*np.shape(index), n_classes))
        around += np.eye(n_classes)[index]
        return around

    order = np.argsort(-probabilities, axis=1, kind="stable")
    ranked = np.take_along_axis(probabilities, order, axis=1)
    before = np.cumsum(ranked, axis=1) - ranked
    # Randomised, the set holds exactly nine tenths of the probability.
    inside = np.take_along_axis((before + uniform[:, None] * ranked < 0.9), np.argsort(order, axis=1), axis=1)
    held = inside[np.arange(n_cases), truth]
    covered = {
        f"{label}, {(truth == n).sum()} starts": float(held[truth == n].mean())
        for n, label in enumerate(recipe.class_names)
        if (truth == n).sum() >= _FEWEST
    }
    seen = sight(X)
    truths, draws = spread(truth), spread(drawn)
    yield Posterior(
        f"{name}: class", class_ranks(probabilities, truth, uniform), covered, truths, draws, seen
    )
    yield Posterior(
        f"{name}: confidence", confidence_ranks(probabilities, truth, uniform), {}, truths[:0], draws, seen
    )


def of_severities(n_cases: int, n_draws: int) -> Iterator[Posterior]:
    """Severity of each kind, by the shipped network."""
    model, recipe = network(SHIPPED)
    generator = np.random.default_rng(SEED)
    ranges = severity_recipe(recipe)
    for n, prior in enumerate(model.severity_priors_):
        kind = str(prior.kind)
        one = Recipe(**{**{f: getattr(ranges, f) for f in ranges.__slots__}, "classes": (ranges.classes[n],)})
        cases = generate_arrays(one, SEED + 1 + n, n_cases)
        shares = severity_shares(model, cases.X, kind)
        position = cases.severity / prior.largest
        ranks = severity_ranks(shares, position)
        held = (ranks > 0.05) & (ranks < 0.95)
        thirds = np.minimum((3.0 * position).astype(int), 2)
        parts = [
            f"{100 * prior.largest * k / 3:.0f} to {100 * prior.largest * (k + 1) / 3:.0f} %"
            for k in range(3)
        ]
        covered = {part: float(held[thirds == k].mean()) for k, part in enumerate(parts)}
        cumulated = np.cumsum(shares, axis=1) - 0.5 * shares
        grid, uniform = np.linspace(0.0, 1.0, shares.shape[1]), generator.uniform(size=(n_draws, n_cases))
        draws = np.array([np.interp(u, row, grid) for u, row in zip(uniform.T, cumulated, strict=True)]).T
        assert model.severity_ is not None
        seen = seen_by(model.severity_.space, cases.X)
        yield Posterior(f"shipped: {kind}", ranks, covered, position[:, None], draws[..., None], seen)


def by_sbi(posteriors: list[Posterior]) -> dict[str, dict[str, float]]:
    """TARP and LC2ST of each posterior; none where the environment is not there."""
    if not PYTHON.exists():
        print(f"{PYTHON} is missing: `make bench` sets it up; no TARP and no LC2ST")
        return {}
    with tempfile.TemporaryDirectory() as folder:
        cases, answers = Path(folder) / "cases.npz", Path(folder) / "answers.json"
        told = [one for one in posteriors if len(one.truth)]
        arrays = {
            f"{n}-{part}": getattr(one, part)
            for n, one in enumerate(told)
            for part in ("truth", "draws", "seen")
        }
        np.savez(cases, **arrays)
        subprocess.run(
            [str(PYTHON), str(FOLDER / "calibration_sbi.py"), str(cases), str(answers)], check=True
        )
        found: list[dict[str, float]] = json.loads(answers.read_bytes())
    return {one.name: row for one, row in zip(told, found, strict=True)}


def main(*, networks: tuple[str, ...] = NETWORKS, cases: int = 2_000, draws: int = 200) -> None:
    """Check the severities of the shipped network and the classes of these: `shipped`, `operation`, or other tasks."""
    posteriors = [
        *of_severities(cases, draws),
        *(one for name in networks for one in of_classes(name, cases, draws)),
    ]
    checks = {one.name: rank_check(one.ranks, ERROR / len(posteriors)) for one in posteriors}
    sbi = by_sbi(posteriors)
    rows = (
        (
            one.name,
            str(len(one.ranks)),
            f"{checks[one.name].largest:.4f}",
            "yes" if checks[one.name].inside else "no",
            *(f"{sbi[one.name][key]:.3f}" if one.name in sbi else "" for key in ("atc", "tarp_p", "lc2st")),
        )
        for one in posteriors
    )
    header = (
        "posterior",
        "starts",
        "largest distance",
        "within its band",
        "TARP: ATC",
        "p",
        "LC2ST: rejected",
    )
    keep_table("calibration", "ranks", header, rows)
    covered = (
        (one.name, part, f"{100.0 * share:.1f} %")
        for one in posteriors
        for part, share in one.covered.items()
    )
    keep_table("calibration", "coverage", ("posterior", "truth", "90 % sets hold it"), covered)


if __name__ == "__main__":
    run(main)
