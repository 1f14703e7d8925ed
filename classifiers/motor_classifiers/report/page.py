"""The benchmark's page, one self-contained HTML file with its charts."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_classifiers.estimators.methods import find_method
from motor_classifiers.scoring.benchmark import PEERS, Plan
from motor_classifiers.scoring.metrics import Reliability, Score
from motor_classifiers.scoring.results import as_csv, family, result_rows
from motor_classifiers.scoring.score import SIGNIFICANCE, ClassResult, Results
from motor_env.common.files import write_text
from motor_env.common.pages import Axis, Chart, percent, render, round_ticks
from motor_env.motor.faults import HEALTHY
from motor_env.simulation.named_recipes import recipe_to_dict


def interval_chart(
    bars: Sequence[tuple[str, str, Score]], limit: float, limit_label: str, *,
    width: int = 760, left: int = 170, title: str = "",
) -> str:  # fmt: skip
    """Chart each method's score (name, family, score) with its interval, and the limit as a line."""
    low = min([*(score.low for _, _, score in bars), limit]) - 0.01
    high = min(1.0, max([*(score.high for _, _, score in bars), limit]) + 0.01)
    shares = Axis("", low, high, round_ticks(low, high, 6 if width > 500 else 3), percent)
    chart = Chart(
        shares,
        Axis("", 0.0, len(bars), is_reversed=True),
        size=(width, 64 + 28 * len(bars)),
        margins=(left, 54, 34, 30),
        label=title or limit_label,
    )
    chart.x_numbers(grid=True)
    x = chart.x(limit)
    chart.line("limit", (x, chart.top - 6), (x, chart.bottom))
    chart.text((x + 4, chart.top - 13), limit_label, "limit-label", "end" if x > 0.6 * width else "middle")
    for row, (name, of_family, score) in enumerate(bars):
        y = chart.y(row + 0.5)
        chart.text((left - 12, y + 4), name, "name", "end")
        chart.line("range", (chart.x(score.low), y), (chart.x(score.high), y))
        chart.dot(f"dot {of_family}", (chart.x(score.value), y), 5.5)
        chart.text((chart.x(score.high) + 8, y + 4), f"{100 * score.value:.1f}", "value")
    return chart.svg()


def reliability_chart(binned: Reliability, low: float) -> str:
    """Chart the share of right decisions against the largest probability, with bars of one standard error."""
    axis = Axis("", low, 1.0, (low, 1.0))
    chart = Chart(axis, axis, size=(190, 190), margins=(34, 8, 8, 26), label="Reliability")
    chart.y_numbers()
    chart.x_numbers()
    chart.line("threshold", (chart.left, chart.bottom), (chart.right, chart.top))
    filled = binned.n_cases > 0
    confidence, shares, counts = binned.confidence[filled], binned.accuracy[filled], binned.n_cases[filled]
    chart.curve("estimate", confidence, shares)
    errors = np.sqrt(shares * (1.0 - shares) / counts)
    for sure, share, error, count in zip(confidence, shares, errors, counts, strict=True):
        x = chart.x(sure)
        chart.line("range", (x, chart.y(share + error)), (x, chart.y(share - error)))
        radius = 1.8 + 2.4 * float(np.sqrt(count / counts.max()))
        chart.dot("dot", (x, chart.y(share)), radius, f"{count:.0f} starts")
    return chart.svg()


class Line(NamedTuple):
    """A curve: label, style classes (`limit`, s0, s1, ...; `dashed`), positions and values."""

    label: str
    style: str
    x: Sequence[float]
    y: Sequence[float]


def share_axis(values: Sequence[float]) -> Axis:
    """Return an axis for shares, a point wider than the values."""
    low, high = min(values) - 0.01, min(1.0, max(values) + 0.01)
    return Axis("", low, high, round_ticks(low, high, 6), percent)


def line_chart(
    lines: Sequence[Line], x_axis: Axis, y_axis: Axis, *, named: bool = True, marked: bool = True
) -> str:
    """Chart curves over two axes; `named` at their right ends, `marked` with points and tooltips."""
    margins = (58, 132 if named else 22, 24, 40) if y_axis.title else (52, 132 if named else 22, 12, 40)
    label = f"{y_axis.title or 'Accuracy'} against {x_axis.title}"
    chart = Chart(x_axis, y_axis, size=(520, 400), margins=margins, label=label)
    chart.y_numbers()
    chart.x_numbers()
    chart.text(((chart.left + chart.right) / 2, 394), x_axis.title, anchor="middle")
    chart.text((4, 12), y_axis.title)
    ends = _spread_out([chart.y(line.y[-1]) for line in lines], 13.0, chart.top + 4.0, chart.bottom + 14.0)
    for line, label_y in zip(lines, ends, strict=True):
        with chart.group(f"series {line.style}"):
            chart.curve("", line.x, line.y)
            for x, y in zip(line.x, line.y, strict=True) if marked else ():
                title = f"{line.label}, {x_axis.number(x)}: {y_axis.number(y)}"
                chart.dot("", (chart.x(x), chart.y(y)), 3, title)
            if named:
                tip, level = chart.x(line.x[-1]), chart.y(line.y[-1])
                chart.line("lead", (tip, level), (tip + 12, label_y))
                chart.text((tip + 15, label_y + 4), line.label, "")
    return chart.svg()


def _spread_out(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Move places at least `gap` apart."""
    order = np.argsort(wanted, kind="stable")
    placed = np.asarray(wanted, dtype=np.float64)[order]
    for n in range(len(placed)):
        placed[n] = max(placed[n], low if n == 0 else placed[n - 1] + gap)
    for n in range(len(placed) - 1, -1, -1):
        placed[n] = min(placed[n], high if n == len(placed) - 1 else placed[n + 1] - gap)
    result = np.empty(len(placed))
    result[order] = placed
    return [float(value) for value in result]


def readable(name: str) -> str:
    """Return a class name in words: bearing_10 becomes bearing 10 %."""
    stem, _, level = name.rpartition("_")
    return (
        f"{stem.replace('_', ' ')} {level} %" if level.replace(".", "").isdigit() else name.replace("_", " ")
    )


def short(name: str) -> str:
    """Return a class name for narrow columns: B 10, WC 25."""
    stem, _, level = name.rpartition("_")
    if not level.replace(".", "").isdigit():
        return "ok" if name == HEALTHY else name[:3]
    return f"{''.join(word[0].upper() for word in stem.split('_'))} {level}"


def render_report(plan: Plan, results: Sequence[Results], machine: str) -> str:
    """Render the page as HTML; `machine` describes the computer."""
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
        confusions=[_confusion(method) for method in (result.limit, *ranked)],
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
    """Format three figures of a time or size; a dash for unknown ones."""
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
    graded = [(method.name, method.calibration) for method in shown if method.calibration is not None]
    lowest = min(float(np.nanmin(scores.reliability.confidence)) for _, scores in graded)
    low = max(0.0, np.floor(10.0 * lowest) / 10.0)
    return [
        {"name": name, "chart": reliability_chart(scores.reliability, low), "scores": scores}
        for name, scores in graded
    ]


def write_results(plan: Plan, results: Sequence[Results], folder: Path) -> Path:
    """Write results.json, results.csv, recipes.json and report.html, each whole or not at all; return its path."""
    rows = result_rows(results)
    recipes = {task.recipe.name: recipe_to_dict(task.recipe) for task in reversed(plan.tasks)}
    write_text(folder / "results.json", json.dumps(rows, indent=1) + "\n")
    write_text(folder / "results.csv", as_csv(rows))
    write_text(folder / "recipes.json", json.dumps(recipes, indent=1) + "\n")
    page = folder / "report.html"
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    write_text(page, render_report(plan, results, machine))
    return page


_LINES = 10  # styles of lines, s0 to s9; more methods are drawn in a quiet colour


def sweep_section(plan: Plan, results: Sequence[Results]) -> dict[str, Any]:
    """Chart a sweep: learning curves by recipe and rate, accuracies by noise, and a table of all settings."""
    style = {name: f"s{n}" if n < _LINES else "rest" for n, name in enumerate(plan.methods)}
    recipes = dict.fromkeys(result.task.recipe.name for result in results)
    rates = sorted({result.task.recipe.timing.sampling_rate_hz for result in results}, reverse=True)
    learning, noise = [], []
    for at in product(recipes, rates):
        here = [r for r in results if (r.task.recipe.name, r.task.recipe.timing.sampling_rate_hz) == at]
        by_size = _same_noise(here)
        if len(by_size) > 1:
            learning.append(_panel(by_size, style, _n_train, "training starts"))
        by_noise = sorted((r for r in here if r.task.n_train == here[0].task.n_train), key=_noise_ma)
        if len(by_noise) > 1:
            noise.append(_panel(by_noise, style, _noise_ma, "noise, mA"))
    return {
        "learning": learning,
        "noise": noise,
        "methods": plan.methods,
        "settings": [(result.task, result, {m.name: m for m in result.methods}) for result in results],
    }


def _same_noise(results: Sequence[Results]) -> list[Results]:
    """Return the results at the noise with the most training sizes, by size."""
    noises = list(map(_noise_ma, results))
    usual = max(noises, key=noises.count, default=None)
    return sorted((result for result in results if _noise_ma(result) == usual), key=_n_train)


def _noise_ma(result: Results) -> float:
    return 1e3 * result.task.recipe.sensor.current_noise_a


def _n_train(result: Results) -> float:
    return float(result.task.n_train)


def _panel(
    results: Sequence[Results],
    style: dict[str, str],
    position: Callable[[Results], float],
    x_title: str,
) -> dict[str, str]:
    xs = [position(result) for result in results]
    accuracies = [{m.name: m.scores.accuracy.value for m in result.methods} for result in results]
    lines = [Line(name, style[name], xs, [by_method[name] for by_method in accuracies]) for name in style]
    limit_name = "estimate" if results[0].limit_is_estimate else "Bayes limit"
    lines.append(Line(limit_name, "limit", xs, [r.limit.scores.accuracy.value for r in results]))
    task = results[0].task
    x_axis = Axis(x_title, xs[0], xs[-1], xs, is_log=True)
    return {
        "title": f"{task.recipe.name}, {task.recipe.timing.sampling_rate_hz / 1e3:g} kHz",
        "chart": line_chart(lines, x_axis, share_axis([value for line in lines for value in line.y])),
    }
