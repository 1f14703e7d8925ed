"""The leaderboard of motor-bench: `python benchmarks/leaderboard.py enter [TASK/METHOD ...]`, `page` or `freeze`.

`enter` trains, answers and scores; scores stay in benchmarks/results/leaderboard.json. Without names it makes every
entry but those of aeon, which need `make peers`. `page` writes docs/leaderboard.md. `freeze` writes the digests of the
tasks, which must never change within a version.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import sklearn_methods
from cyclopts import run
from networks import network_of
from peers import peer_answers
from tables import marked, table

from motor_classifiers import OutsideDetector
from motor_classifiers.estimators.methods import find_method, model_input
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring import frozen_tasks
from motor_classifiers.scoring.benchmark import PEERS
from motor_classifiers.scoring.frozen_tasks import TASKS, VERSION, StreamTask, load_task, score_answers
from motor_classifiers.scoring.judging import in_recipe_order, judge
from motor_classifiers.scoring.task import ClassTask, DrawnTask
from motor_env import Cusum, Glr, TolerantFilter
from motor_env.common.files import write_text
from motor_env.detection.rules.base import Rule, first_above
from motor_env.motor.parameters import FloatArray

FOLDER = Path(__file__).resolve().parent
SCORES = FOLDER / "results" / "leaderboard.json"
PAGE = FOLDER.parent / "docs" / "leaderboard.md"
DIGESTS = Path(frozen_tasks.__file__).parent / "motor_bench.json"

Row = dict[str, Any]
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
    answers: FloatArray = model.fit(model_input(model, train.X), train.severity).predict(
        model_input(model, test.X)
    )
    return answers


def distance(task: DrawnTask) -> FloatArray:
    """Distance from the recipe's starts, as `predict` judges it."""
    return -OutsideDetector(task.recipe).fit().score_samples(task.test().X)


def isolation(task: DrawnTask) -> FloatArray:
    """Isolation forest of scikit-learn."""
    model = sklearn_methods.isolation(task.recipe, 0)
    answers: FloatArray = -model.fit(model_input(model, task.train().X)).score_samples(
        model_input(model, task.test().X)
    )
    return answers


def alarm_times(task: StreamTask, statistic: FloatArray, threshold: float) -> FloatArray:
    """First time above a threshold, nan for none, shape (n,)."""
    timing, index = task.recipe.timing, first_above(statistic, threshold)
    return np.where(index < 0, np.nan, (index + 1 - timing.n_quiet) * timing.dt_s)


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
    "unknown/distance": (
        distance,
        US,
        "Distance from the recipe's starts, as `predict` judges it",
        "the recipe",
    ),
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


def enter(entry: str) -> Row:
    """Make one entry: answers, and their score."""
    name, method = entry.split("/")
    task = load_task(name)
    if entry in OWN_ANSWERS:
        answer, authors, about, seen = OWN_ANSWERS[entry]
        answers = np.asarray(answer(task)).reshape(task.n_test, -1)
    else:
        assert isinstance(task, ClassTask)
        seen = f"{task.n_train:,} starts"
        answers, authors, about = _peer(task, method) if method in PEERS else _trained(task, method)
    said = {"method": method, "authors": authors, "about": about, "learned_from": seen}
    return {**said, **score_answers(task, answers)}


def _trained(task: ClassTask, method: str) -> tuple[FloatArray, str, str]:
    """Answers of a method of the benchmark, or of scikit-learn alone; who made it, and what it is."""
    ours = method in _OURS.get(task.name, ())
    full = method if ours else f"{FOLDER / 'sklearn_methods.py'}:{method}"
    return judge(full, task, 0).probabilities, US if ours else SKLEARN, find_method(full).title


def _peer(task: ClassTask, method: str) -> tuple[FloatArray, str, str]:
    """Answers of one of aeon's classifiers, in its own environment."""
    shares = peer_answers(task.train(), task.starts(), method)[method]
    return shares / shares.sum(axis=1, keepdims=True), "aeon", PEERS[method]


def kept_scores() -> dict[str, Row]:
    """Kept scores by TASK/METHOD."""
    rows: dict[str, Row] = json.loads(SCORES.read_bytes()) if SCORES.is_file() else {}
    return rows


def board(scores: dict[str, Row]) -> str:
    """The tables in Markdown, one a task, the best first."""
    parts, told = [], set[str]()
    for name, task in TASKS.items():
        rows = sorted((row for row in scores.values() if row["task"] == name), key=lambda row: row["value"])
        if not rows:
            continue
        known, best = "limit" in rows[0], ""
        if known:
            best = f" The best possible on the same cases: {rows[0]['limit']:.2f}."
        elif task.bracket is not None:
            best = " The best possible on average: between {:.2f} and {:.2f}.".format(*task.bracket)
        above = ["above the best possible"] * known
        head = ["method", task.metric, *above, "learned from", "what it is"]
        parts.append(f"## {name}\n\n{task.title}. {task.n_test} cases, motor-bench {VERSION}.{best}\n")
        parts.append(table(head, [_cells(row, told) for row in rows]).replace("-0.00", "0.00") + "\n")
    return "\n".join(parts)


def _cells(row: Row, told: set[str]) -> list[str]:
    """A row of the table; what a method is stands where it first comes."""
    names = ("", "_low", "_high")
    above = [row[f"above_limit{end}"] for end in names] if "limit" in row else []
    about = "" if row["about"] in told else row["about"]
    told.add(row["about"])
    return [
        row["method"] if row["authors"] == US else f"{row['method']} ({row['authors']})",
        f"{row['value']:.2f} ({row['low']:.2f} to {row['high']:.2f})",
        *(["{:.2f} ({:.2f} to {:.2f})".format(*above)] if above else []),
        row["learned_from"],
        about,
    ]


def whole_page() -> str:
    """The page docs/leaderboard.md with its tables made anew."""
    return marked(PAGE.read_text(encoding="utf-8"), {"leaderboard": board(kept_scores())})


def main(what: Literal["enter", "page", "freeze"], /, *entry: str) -> None:
    """Enter TASK/METHOD, all but aeon's by default; write the page; or freeze the digests."""
    if what == "enter":
        for each in entry or entries():
            print(each, file=sys.stderr, flush=True)
            row = enter(each)
            write_text(SCORES, json.dumps(kept_scores() | {each: row}, indent=1) + "\n")
    elif what == "freeze":
        digests = {
            whole: frozen_tasks.current_digests(whole=whole == "whole") for whole in ("small", "whole")
        }
        write_text(DIGESTS, json.dumps({"version": VERSION, **digests}, indent=1) + "\n")
    else:
        write_text(PAGE, whole_page())


if __name__ == "__main__":
    run(main)
