"""How far to trust a verdict: the figures of the benchmark's section of that name, in one setting.

Conformal sets need no answers beside those of the benchmark. All else is one piece of work of its own: faults never
trained on, severities, early verdicts. Its figures are plain JSON, and kept beside the answers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # comes with scikit-learn, without types

from motor_classifiers.estimators.methods import ESTIMATE
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.judging import digest_of
from motor_classifiers.scoring.metrics import IntArray
from motor_classifiers.scoring.task import TEST_FIRST_CASE, ClassTask, judged_starts
from motor_classifiers.scoring.unknown_faults import Confidence, foreign_scores
from motor_classifiers.scoring.verdict_times import (
    accuracy_by_moment,
    moments,
    probabilities_by_moment,
    race,
    stopping_rows,
)
from motor_classifiers.wrappers.conformal import ConformalSets, Coverage, measured_coverage
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.files import LARGEST_TABLE_BYTES, read_json, write_text
from motor_env.inference.posterior import class_probabilities
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipe_files import recipe_to_dict
from motor_env.simulation.recipes import FaultClass, Recipe

TRUST = "trust"
"""Name of this piece of work among the answers."""

Figures = dict[str, Any]
"""What JSON can hold; a section that is left out holds its `reason` alone."""

FIRST_CASE = 2_000_000_000
"""First number of the starts judged here: neither training nor test starts of the benchmark."""

TELLING_RATE_HZ = 1_000.0
"""Rate of a second setting of the unknown faults: at 10 kHz every one of them is found."""

SECTIONS = ("unknown", "severity", "early", "race")

_PROMISED = 0.90  # coverage of sets


@dataclass(frozen=True, slots=True)
class Counts:
    """How many starts each figure rests on.

    Attributes:
        threshold: known motors that set the threshold of the verdict `other`.
        known: known motors it is tried on.
        foreign: motors with each unknown fault.
        severity: motors with each kind of fault.
        early: starts of the early verdicts.
        healthy: healthy starts that set the thresholds of the sequential rules.
        steps: batches of the network where one must be trained for the second rate.
    """

    threshold: int = 3000
    known: int = 3000
    foreign: int = 500
    severity: int = 800
    early: int = 2000
    healthy: int = 4000
    steps: int = 1000


COUNTS = Counts()


def shipped_network(recipe: Recipe) -> PosteriorNetwork | None:
    """The network that comes with the package where the recipe is its own."""
    shipped, own, _ = load_model(PRETRAINED)
    return shipped if recipe == own and isinstance(shipped, PosteriorNetwork) else None


def network_for(recipe: Recipe, random_state: int, **parameters: Any) -> PosteriorNetwork:
    """The shipped network where the recipe is its own; else one trained for it."""
    return shipped_network(recipe) or PosteriorNetwork.from_recipe(
        recipe, random_state=random_state, **parameters
    )


def halves_coverage(probabilities: FloatArray, truth: IntArray, motors: IntArray) -> Coverage:
    """Coverage of label-conditional sets where each half of the motors calibrates the other.

    A half with strange starts is covered too rarely by the other's threshold, and covers the other too often: to first
    order chance cancels in the mean, which therefore lies near the promise. The size of the sets is what differs.

    Args:
        probabilities: of starts that the model was not trained on, shape (n_cases, n_classes).
        truth: true class of each.
        motors: motor of each; all its starts stand in one half.

    Raises:
        ValueError: a half has no start of a class.
    """
    is_first = np.unique(motors, return_inverse=True)[1] % 2 == 0
    sets = np.zeros(probabilities.shape, dtype=np.bool_)
    for calibrating in (is_first, ~is_first):
        known = ConformalSets.calibrate(
            probabilities[calibrating], truth[calibrating], label_conditional=True
        )
        sets[~calibrating] = known.sets(probabilities[~calibrating], _PROMISED)
    return measured_coverage(sets, truth)


def set_figures(probabilities: Mapping[str, FloatArray], test: Dataset) -> Figures:
    """Coverage of label-conditional 90 % sets of each method, calibrated and tried on halves of the test starts.

    Args:
        probabilities: of each method, in the recipe's order of classes, shape (n_test, n_classes).
        test: the starts.
    """
    try:
        measured = {
            name: halves_coverage(own, test.class_index, test.motor_id) for name, own in probabilities.items()
        }
    except ValueError:
        return {"reason": f"{len(test)} test starts are too few: a class has none in one of their halves"}
    rows = [
        {
            "method": name,
            "coverage": scores.overall,
            "by_class": scores.by_class.tolist(),
            "mean_size": scores.mean_size,
            "empty": scores.empty,
        }
        for name, scores in measured.items()
    ]
    return {"n_test": len(test), "promised": _PROMISED, "methods": rows}


def trust_key(task: ClassTask, *, with_network: bool) -> str:
    """Digest of all that the figures depend on."""
    contents = {
        "what": TRUST,
        "recipe": recipe_to_dict(task.recipe),
        "n_train": task.n_train,
        "seed": task.seed,
        "counts": asdict(COUNTS),
        "network": with_network,
    }
    return digest_of(contents)


def expected_seconds(task: ClassTask, *, with_network: bool) -> float:
    """About how long the figures take on one core."""
    if task.recipe.field is not None:
        return 1.0
    samples = task.recipe.timing.n_samples / 1000.0
    return (20.0 + 40.0 * samples) if with_network else 5.0 + 30.0 * samples


def trust_figures(task: ClassTask, *, with_network: bool) -> Figures:
    """All figures of a setting; sections that it cannot have say why.

    Args:
        task: setting; its training starts are those of the early verdicts.
        with_network: whether a posterior network is asked for.
    """
    counts = {"counts": asdict(COUNTS)}
    if task.recipe.field is not None:
        reason = {
            "reason": f"the likelihood of recipe {task.recipe.name} has no closed form, and these figures need it"
        }
        return {**counts, **dict.fromkeys(SECTIONS, reason)}
    seed = task.seed % 2**32
    with threadpool_limits(1):
        network = network_for(task.recipe, seed) if with_network else None
        return {
            **counts,
            "unknown": _unknown(task, network),
            "severity": _severity(task, network),
            "early": _early(task),
            "race": _race(task),
        }


def _unknown(task: ClassTask, network: PosteriorNetwork | None) -> Figures:
    """Faults never trained on, told by distance and by confidence."""
    settings = [(task.recipe, network)]
    if task.recipe.timing.sampling_rate_hz > TELLING_RATE_HZ:
        slow = replace(
            task.recipe, timing=replace(task.recipe.timing, sampling_rate_hz=TELLING_RATE_HZ), shifts=()
        )
        trained = None
        if network is not None:
            trained = network_for(slow, task.seed % 2**32, steps=COUNTS.steps, with_severity=False)
        settings.append((slow, trained))
    rows = []
    for recipe, own in settings:
        confidences: dict[str, Confidence] = {"limit": partial(class_probabilities, recipe)}
        if own is not None:
            confidences[ESTIMATE] = own.predict_proba
        scores = foreign_scores(
            recipe, confidences, seed=task.seed, first_case=FIRST_CASE,
            n_threshold=COUNTS.threshold, n_known=COUNTS.known, n_foreign=COUNTS.foreign,
        )  # fmt: skip
        rows.append({"sampling_rate_hz": recipe.timing.sampling_rate_hz, **scores})
    return {"settings": rows}


def _severity(task: ClassTask, network: PosteriorNetwork | None) -> Figures:
    """Severities, uniform over the range, beside the exact posterior's."""
    if network is None:
        return {"reason": f"{ESTIMATE}, which tells severities, is not among the methods"}
    kinds = [
        {"kind": str(prior.kind), "largest": prior.largest}
        | severity_figures(network, task.recipe, prior, task.seed, COUNTS.severity)
        for prior in network.severity_priors_
    ]
    return {"network_is_shipped": shipped_network(task.recipe) is not None, "kinds": kinds}


def severity_figures(
    model: PosteriorNetwork, recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int
) -> dict[str, dict[str, float]]:
    """Judge severities, drawn uniformly over the range, of motors that have this kind of fault.

    Returns:
        Of the `network` and of the `limit`, on the same cases: `rmse`, the root mean square error, 0.01 for a point,
        and `coverage`, the share of the 90 % intervals that hold the severity.
    """
    own = replace(recipe, classes=(FaultClass(prior.kind, 0.0, severity_to=prior.largest),))
    test = generate_arrays(own, seed, np.arange(n_cases) + TEST_FIRST_CASE)
    estimated = model.predict_severity(test.X, str(prior.kind))
    exact = severity_posterior(recipe, prior, test.X)
    intervals = np.column_stack([estimated.low, estimated.high]), exact.interval(0.90)
    return {
        "network": _scored(estimated.mean, intervals[0], test.severity),
        "limit": _scored(exact.mean, intervals[1], test.severity),
    }


def _scored(mean: FloatArray, interval: FloatArray, truth: FloatArray) -> dict[str, float]:
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return {"rmse": float(np.sqrt(np.square(mean - truth).mean())), "coverage": float(inside.mean())}


def _early(task: ClassTask) -> Figures:
    """Accuracy by what was seen, and the stopping rule."""
    recipe, seen = task.recipe, moments(task.recipe.timing)
    if len(seen.samples) < 2:
        return {"reason": f"a start of recipe {recipe.name} has too few samples to be cut short"}
    test = judged_starts(recipe, task.seed, FIRST_CASE, COUNTS.early)
    probabilities = probabilities_by_moment(recipe, task.seed % 2**32, task.train(), test)
    return {
        "time_s": seen.time_s.tolist(),
        "accuracy": {
            name: accuracy_by_moment(own, test.class_index).tolist() for name, own in probabilities.items()
        },
        "stopping": stopping_rows(probabilities, test.class_index, seen.time_s),
    }


def _race(task: ClassTask) -> Figures:
    """The largest bearing fault or none, by the limit and by the sequential rules."""
    recipe = task.recipe
    bearings = [c for c in recipe.classes if [part.kind for part in c.parts] == [FaultKind.BEARING]]
    if not bearings or len(moments(recipe.timing).samples) < 2:
        return {"reason": f"recipe {recipe.name} has no class of a bearing fault alone, or too few samples"}
    fault = max(bearings, key=lambda c: c.severity)
    curves = race(
        recipe, FaultClass(fault.kind, fault.severity), seed=task.seed, first_case=FIRST_CASE,
        n_cases=COUNTS.early, n_healthy=COUNTS.healthy,
    )  # fmt: skip
    return {
        "severity": fault.severity,
        "curves": {name: [point._asdict() for point in points] for name, points in curves.items()},
    }


def save_figures(figures: Figures, path: Path) -> None:
    """Write figures; the file appears whole or not at all."""
    write_text(path, json.dumps(figures, allow_nan=False, indent=1) + "\n")


def load_figures(path: Path) -> Figures | None:
    """Read figures; None where there are none, or only damaged ones."""
    try:
        figures = read_json(path, LARGEST_TABLE_BYTES)
    except (OSError, ValueError):
        return None
    return figures if isinstance(figures, dict) and {"counts", *SECTIONS} <= set(figures) else None
