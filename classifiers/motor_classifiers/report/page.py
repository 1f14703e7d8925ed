"""The benchmark's page: one self-contained HTML file."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from motor_classifiers.estimators.own_methods import find_method
from motor_classifiers.report.charts import interval_chart, reliability_chart
from motor_classifiers.report.names import readable, short
from motor_classifiers.report.sweep_page import sweep_section
from motor_classifiers.scoring.metrics import Score
from motor_classifiers.scoring.peers import PEERS
from motor_classifiers.scoring.plan import Plan
from motor_classifiers.scoring.results import as_csv, family, result_rows
from motor_classifiers.scoring.score import SIGNIFICANCE, ClassResult, Results
from motor_env.files import write_text
from motor_env.pages.html import render
from motor_env.simulation.recipe_files import recipe_to_dict


def render_report(plan: Plan, results: Sequence[Results], machine: str) -> str:
    """The page as HTML.

    Args:
        plan: what was run.
        results: of `run_plan`.
        machine: what it ran on, in words.
    """
    result = results[plan.reference]
    recipe, ranked = result.task.recipe, result.ranked()
    ours = [method for method in ranked if not method.answer.origin]
    return render(
        "motor_classifiers.report",
        "report.html.j2",
        title=f"Motor fault classifiers on {recipe.name}",
        filters={"share": _share, "points": _points, "quantity": _quantity},
        task=result.task,
        recipe=recipe,
        machine=machine,
        best=ours[0],
        best_peer=next((method for method in ranked if method.answer.origin), None),
        origins=sorted({method.answer.origin for method in ranked if method.answer.origin}),
        titles=PEERS | {name: find_method(name).title for name in plan.methods},
        methods=ranked,
        limit=result.limit,
        estimated=result.limit_is_estimate,
        limit_name="Best estimate of the limit" if result.limit_is_estimate else "Bayes limit",
        limit_expected=float(result.limit.answer.probabilities.max(axis=1).mean()),
        leaks=[(name, other.task.title) for other in results for name in other.leaks],
        above=result.leaks,
        significance=SIGNIFICANCE,
        n_comparisons=plan.n_comparisons,
        short_titles=[short(name) for name in recipe.class_names],
        class_titles=[readable(name) for name in recipe.class_names],
        accuracy_chart=_score_chart(result, ranked, "accuracy", "Bayes limit on these motors"),
        sub_charts=_sub_charts(result, ranked),
        confusions=[_confusion(one) for one in (result.limit, *ranked)],
        reliability=_reliability((result.limit, *ranked)),
        sweep=sweep_section(plan, results) if len(results) > 1 else None,
        against=[
            (method.name, result.difference(method, ours[0])) for method in ranked if method is not ours[0]
        ],
    )


def _share(score: Score, digits: int = 1) -> str:
    return "–" if np.isnan(score.value) else f"{100.0 * score.value:.{digits}f}"


def _points(value: float, digits: int = 2) -> str:
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else f"{0.0:.{digits}f}"


def _quantity(value: float | None) -> str:
    """Three figures of a time or size; a dash for what is not known."""
    if value is None or np.isnan(value):
        return "–"
    return f"{value:.0f}" if value >= 20.0 else f"{value:.1f}"


def _score_chart(result: Results, ranked: Sequence[ClassResult], name: str, label: str, **shape: Any) -> str:
    limit: Score = getattr(result.limit.scores, name)
    bars = [(m.name, family(m), getattr(m.scores, name)) for m in ranked]
    text = label.replace("Bayes limit", "Estimated limit") if result.limit_is_estimate else label
    return interval_chart(bars, limit.value, f"{text}: {100.0 * limit.value:.1f} %", **shape)


def _sub_charts(result: Results, ranked: Sequence[ClassResult]) -> list[dict[str, str]]:
    parts = {
        "winding": ("Winding", "a winding fault or none"),
        "bearing": ("Bearing", "a bearing fault or none"),
        "level": ("Severity", "level accuracy, given the right kind"),
    }
    return [
        {
            "title": title,
            "what": what,
            "chart": _score_chart(result, ranked, name, "limit", width=440, left=166, title=title),
        }
        for name, (title, what) in parts.items()
        if not np.isnan(getattr(result.limit.scores, name).value)
    ]


def _confusion(result: ClassResult) -> dict[str, Any]:
    counts = result.scores.confusion
    totals = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    return {"name": result.name, "counts": counts.tolist(), "shares": (100.0 * counts / totals).tolist()}


def _reliability(shown: Sequence[ClassResult]) -> list[dict[str, Any]]:
    graded = [(one.name, one.calibration) for one in shown if one.calibration is not None]
    lowest = min(float(np.nanmin(scores.reliability.confidence)) for _, scores in graded)
    low = max(0.0, np.floor(10.0 * lowest) / 10.0)
    return [
        {"name": name, "chart": reliability_chart(scores.reliability, low), "scores": scores}
        for name, scores in graded
    ]


def write_results(plan: Plan, results: Sequence[Results], folder: Path) -> Path:
    """Write results.json, results.csv, recipes.json and report.html, each whole or not at all.

    Returns:
        The page's path.
    """
    rows = result_rows(results)
    recipes = {task.recipe.name: recipe_to_dict(task.recipe) for task in reversed(plan.tasks)}
    write_text(folder / "results.json", json.dumps(rows, indent=1) + "\n")
    write_text(folder / "results.csv", as_csv(rows))
    write_text(folder / "recipes.json", json.dumps(recipes, indent=1) + "\n")
    page = folder / "report.html"
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    write_text(page, render_report(plan, results, machine))
    return page
