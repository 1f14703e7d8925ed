"""The leaderboard of motor-bench: `python benchmarks/leaderboard.py enter [TASK/METHOD ...]`, `page` or `freeze`.

`enter` trains, answers, and scores as anybody's submission is scored; scores stay in benchmarks/leaderboard/. Without
names it makes every entry but those of aeon, which need `make peers`. `page` writes docs/leaderboard.md. `freeze`
writes the digests of the tasks, which must never change within a version.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import sklearn_methods
from cyclopts import run
from networks import network_of
from peers import peer_answers
from scaling import board_rows
from stream_delays import alarm_times
from tables import marked

from motor_classifiers.cli.main import main as motor_classifiers
from motor_classifiers.contest import tasks
from motor_classifiers.contest.leaderboard import page, read_scores
from motor_classifiers.contest.questions import StreamTask
from motor_classifiers.contest.submissions import write_submission
from motor_classifiers.contest.tasks import load_task
from motor_classifiers.estimators.methods import METHODS
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.own_methods import fed
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.peers import PEERS
from motor_classifiers.scoring.task import VERSION, ClassTask, DrawnTask
from motor_classifiers.wrappers.fault_family import family_fit
from motor_env import Cusum, Glr, TolerantFilter
from motor_env.detection.rules.base import Rule
from motor_env.files import write_text
from motor_env.motor.parameters import FloatArray

FOLDER = Path(__file__).resolve().parent
SCORES = FOLDER / "leaderboard"
PAGE = FOLDER.parent / "docs" / "leaderboard.md"
DIGESTS = Path(tasks.__file__).parent / "motor_bench.json"

US, SKLEARN = "motor-env", "scikit-learn"
Answer = Callable[[DrawnTask], FloatArray]

_OURS = {
    "bench": ("threshold", "rules", "physical-logistic", "raw-logistic", "residual-qda"),
    "bench-full": ("threshold", "rules", "physical-logistic"),
    "field": ("rules", "physical-logistic", "raw-logistic"),
    "operation": ("physical-logistic", "physical-forest", "raw-logistic", "residual-network"),
}
_OF_SKLEARN = {
    "bench": ("support_vectors", "boosting", "perceptron", "neighbours", "discriminant"),
    "bench-full": ("support_vectors", "boosting", "perceptron"),
    "field": ("support_vectors", "boosting", "perceptron"),
    "operation": ("regression", "support_vectors", "boosting"),
    "reference": ("support_vectors", "perceptron"),
}


def network(task: DrawnTask) -> FloatArray:
    """The posterior network of the task's recipe, which may take reference starts."""
    model = network_of(task.recipe, getattr(task, "n_references", 0))
    return in_recipe_order(model, model.predict_proba(task.test().X), task.recipe)


def shipped_severity(task: DrawnTask) -> FloatArray:
    """The severity that the shipped network reads off."""
    network: PosteriorNetwork = load_model(PRETRAINED)[0]
    return network.predict_severity(task.test().X, "bearing").mean


def least_squares(task: DrawnTask) -> FloatArray:
    """Partial least squares of scikit-learn."""
    train, test = task.train(), task.test()
    model = sklearn_methods.least_squares(task.recipe, 0)
    answers: FloatArray = model.fit(fed(model, train.X), train.severity).predict(fed(model, test.X))
    return answers


def distance(task: DrawnTask) -> FloatArray:
    """Distance from all faults of the known kinds."""
    return family_fit(task.recipe, task.test().X).distance


def isolation(task: DrawnTask) -> FloatArray:
    """Isolation forest of scikit-learn."""
    model = sklearn_methods.isolation(task.recipe, 0)
    answers: FloatArray = -model.fit(fed(model, task.train().X)).score_samples(fed(model, task.test().X))
    return answers


def alarms(rule: Rule, task: DrawnTask) -> FloatArray:
    """Alarms of a rule behind the tolerant filter, its threshold the cheapest on the training streams."""
    assert isinstance(task, StreamTask)
    tolerant = TolerantFilter.from_recipe(task.recipe)
    train, test = task.train_streams(), task.test()
    statistic = rule.statistic(tolerant.white(train.X))
    levels = np.quantile(statistic.max(axis=1), np.linspace(0.05, 0.95, 91))
    costs = [task.costs(train.truth, alarm_times(task, statistic, level)[:, None]).mean() for level in levels]
    return alarm_times(task, rule.statistic(tolerant.white(test.X)), float(levels[np.argmin(costs)]))


FRESH = "2.4 million fresh starts"
OWN_ANSWERS: dict[str, tuple[Answer, str, str, str]] = {
    **{
        f"{task}/posterior-network": (
            network,
            US,
            "Amortised posterior: network on the recipe's endless stream",
            FRESH,
        )
        for task in ("bench", "bench-full", "field")
    },
    "reference/posterior-network": (network, US, "Amortised posterior, given the reference start", FRESH),
    "severity/posterior-network": (
        shipped_severity,
        US,
        "The shipped network, which does not know the noise",
        FRESH,
    ),
    "severity/least_squares": (
        least_squares,
        SKLEARN,
        str(sklearn_methods.least_squares.__doc__),
        "2,000 starts",
    ),
    "unknown/distance": (distance, US, "Distance from the family of known faults", "the recipe"),
    "unknown/isolation": (isolation, SKLEARN, str(sklearn_methods.isolation.__doc__), "2,000 starts"),
    "stream/cusum": (
        partial(alarms, Cusum(0.2)),
        US,
        "CUSUM of the residual whitened for the tolerances",
        "recipe; threshold: 2,000 streams",
    ),
    "stream/glr": (
        partial(alarms, Glr(10, 700)),
        US,
        "Generalised likelihood ratio of the same residual",
        "recipe; threshold: 2,000 streams",
    ),
}


def entries() -> list[str]:
    """Every entry but aeon's as TASK/METHOD."""
    pairs = [
        (task, name) for table in (_OURS, _OF_SKLEARN) for task, names in table.items() for name in names
    ]
    return [*(f"{task}/{name}" for task, name in pairs), *OWN_ANSWERS]


def enter(entry: str) -> None:
    """Make one entry: a submission, and its score."""
    name, method = entry.split("/")
    with tempfile.TemporaryDirectory() as folder:
        if entry in OWN_ANSWERS:
            answer, authors, about, seen = OWN_ANSWERS[entry]
            task = load_task(name)
            card = {"method": method, "authors": authors, "about": about, "learned_from": seen}
            write_submission(folder, task, answer(task), card)
        elif method in PEERS:
            _enter_peer(name, method, folder)
        else:
            ours = method in METHODS
            full = method if ours else f"{FOLDER / 'sklearn_methods.py'}:{method}"
            options = ["--method", full, "--authors", US if ours else SKLEARN, "--out", folder]
            _run("submit", name, *options)
        _run("score", folder, "--keep", str(SCORES))


def _run(*arguments: str) -> None:
    if motor_classifiers(arguments):
        raise SystemExit(f"motor-classifiers {' '.join(arguments)} failed")


def _enter_peer(name: str, method: str, folder: str) -> None:
    """Let one of aeon's classifiers answer, in its own environment."""
    task = load_task(name)
    assert isinstance(task, ClassTask)
    shares = peer_answers(task.train(), task.starts(), method)[method]
    seen = f"{task.n_train:,} starts"
    card = {"method": method, "authors": "aeon", "about": PEERS[method], "learned_from": seen}
    write_submission(folder, task, shares / shares.sum(axis=1, keepdims=True), card)


def whole_page() -> str:
    """The page docs/leaderboard.md with its tables made anew."""
    scores = read_scores(SCORES)
    for task, more in board_rows().items():
        there = {one["method"] for one in scores[task]}
        scores[task] += [one for one in more if one["method"] not in there]
    return marked(PAGE.read_text(encoding="utf-8"), {"leaderboard": page(scores)})


def main(what: Literal["enter", "page", "freeze"], /, *entry: str) -> None:
    """Enter TASK/METHOD, all but aeon's by default; write the page; or freeze the digests."""
    if what == "enter":
        for each in entry or entries():
            print(each, file=sys.stderr, flush=True)
            enter(each)
    elif what == "freeze":
        digests = {"small": tasks.current_digests(whole=False), "whole": tasks.current_digests(whole=True)}
        write_text(DIGESTS, json.dumps({"version": VERSION, **digests}, indent=1) + "\n")
    else:
        write_text(PAGE, whole_page())


if __name__ == "__main__":
    run(main)
