"""The part of the benchmark's page that compares settings: learning curves, noise, and a table of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

from motor_classifiers.report.charts import Line, line_chart, share_axis
from motor_classifiers.scoring.plan import Plan
from motor_classifiers.scoring.score import Results
from motor_env.pages.svg import Axis

_LINES = 10  # styles of lines, s0 to s9; more methods are drawn in a quiet colour


def sweep_section(plan: Plan, results: Sequence[Results]) -> dict[str, Any]:
    """Charts of a sweep, learning curves by recipe and rate and accuracies by noise; and a table of all settings."""
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
    """Those at the noise at which most training sizes were tried, by size."""
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
    lines = [Line(name, style[name], xs, [one[name] for one in accuracies]) for name in style]
    limit_name = "estimate" if results[0].limit_is_estimate else "Bayes limit"
    lines.append(Line(limit_name, "limit", xs, [r.limit.scores.accuracy.value for r in results]))
    task = results[0].task
    x_axis = Axis(x_title, xs[0], xs[-1], xs, is_log=True)
    return {
        "title": f"{task.recipe.name}, {task.recipe.timing.sampling_rate_hz / 1e3:g} kHz",
        "chart": line_chart(lines, x_axis, share_axis([value for line in lines for value in line.y])),
    }
