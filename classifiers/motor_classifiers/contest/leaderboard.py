"""Kept scores as a page: ranks that know ties."""

from __future__ import annotations

import hashlib
import html
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from motor_classifiers.contest.submissions import unpacked_costs
from motor_classifiers.contest.tasks import TASKS
from motor_classifiers.scoring.metrics import compare, resampling_weights
from motor_classifiers.scoring.task import VERSION, DrawnTask
from motor_env.files import LARGEST_TABLE_BYTES, read_json

Scored = dict[str, Any]
"""As `score_submission` gives it."""


def file_of(folder: Path, scored: Scored) -> Path:
    """Where a score is kept: TASK/METHOD.json, with a digest of a name that is no file's."""
    method = str(scored["method"])
    name = re.sub(r"[^a-z0-9_]+", "-", method.lower()).strip("-")[:100]
    if name != method:
        name = f"{name}-{hashlib.sha256(method.encode()).hexdigest()[:8]}".strip("-")
    return folder / str(scored["task"]) / f"{name}.json"


def read_scores(folder: Path) -> dict[str, list[Scored]]:
    """Kept scores of the public splits by task, in the order of the tasks."""
    scores: dict[str, list[Scored]] = {}
    for name in TASKS:
        found = [read_json(path, LARGEST_TABLE_BYTES) for path in sorted((folder / name).glob("*.json"))]
        if found:
            scores[name] = found
    return scores


def ranks(task: DrawnTask, scored: Sequence[Scored]) -> list[tuple[int, Scored]]:
    """Rank and score, the best first.

    A method shares the rank of the best one of its group as long as the 95 % interval of their paired difference holds
    0; the first that does not begins the next group, at the place where it stands.
    """
    weights = resampling_weights(
        task.n_test, 0, groups=task.test().motor if task.recipe.starts_per_motor > 1 else None
    )
    ordered = sorted(scored, key=lambda one: one["value"])
    ranked: list[tuple[int, Scored]] = []
    best, rank = ordered[0], 1
    for place, one in enumerate(ordered, start=1):
        if compare(task, unpacked_costs(one), unpacked_costs(best), weights).difference.low > 0.0:
            best, rank = one, place
        ranked.append((rank, one))
    return ranked


_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_ADDRESS = re.compile(r"\b(?:[a-z][a-z0-9+.-]*://|www\.|mailto:)\S+", re.IGNORECASE)


def _plain(text: str) -> str:
    """A stranger's text as text: no table, no code, no HTML, no link and no picture."""
    text = _ADDRESS.sub("(link)", _LINK.sub(r"\1", text.replace("|", "/").replace("`", "'")))
    return html.escape(re.sub(r"([\\\[\]])", r"\\\1", text).replace("@", " at "), quote=False)


def page(scores: dict[str, list[Scored]]) -> str:
    """The tables in Markdown, one a task."""
    parts = []
    for name, scored in scores.items():
        task = TASKS[name]
        known = "limit" in scored[0]
        best = f" The best possible on the same cases: {scored[0]['limit']:.2f}." if known else ""
        if task.bracket is not None:
            best = " The best possible on average: between {:.2f} and {:.2f}.".format(*task.bracket)
        head = [
            "rank",
            "method",
            "by",
            task.metric,
            *(["above the best possible"] if known else []),
            "learned from",
            "what it is",
        ]
        parts.append(f"## {name}\n\n{task.title}. {task.n_test} cases, motor-bench {VERSION}.{best}\n")
        parts.append(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
        for rank, one in ranks(task, scored):
            value = f"{one['value']:.2f} ({one['low']:.2f} to {one['high']:.2f})"
            names = ("above_limit", "above_limit_low", "above_limit_high")
            above = ["{:.2f} ({:.2f} to {:.2f})".format(*(one[each] for each in names))] if known else []
            cells = [
                str(rank),
                one["method"],
                one["authors"],
                value,
                *above,
                one["learned_from"],
                one["about"],
            ]
            parts.append(f"| {' | '.join(_plain(cell) for cell in cells)} |")
        parts.append("")
    return "\n".join(parts).replace("-0.00", "0.00")
