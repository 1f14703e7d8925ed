"""The part of the benchmark's page that compares settings: learning curves, noise, and a table of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from motor_classifiers.report.charts import Line, line_chart, share_axis
from motor_classifiers.scoring.benchmark import CellResult
from motor_classifiers.scoring.judging import Cell
from motor_classifiers.scoring.plan import Plan
from motor_env.pages.svg import Axis

_LINES = 10  # styles of lines, s0 to s9; more methods are drawn in a quiet colour


def sweep_section(plan: Plan, results: Sequence[CellResult]) -> dict[str, Any]:
    """Charts of a sweep, learning curves by recipe and rate and accuracies by noise; and a table of all settings."""
    style = {name: f"s{n}" if n < _LINES else "rest" for n, name in enumerate(plan.methods)}
    recipes = dict.fromkeys(result.cell.recipe.name for result in results)
    rates = sorted({result.cell.recipe.timing.sampling_rate_hz for result in results}, reverse=True)
    learning, noise = [], []
    for recipe in recipes:
        for rate in rates:
            here = [r for r in results if _at(r.cell, recipe, rate)]
            by_size = _same_noise(here)
            if len(by_size) > 1:
                learning.append(_panel(by_size, style, lambda c: float(c.n_train), "training starts"))
            size = here[0].cell.n_train if here else 0
            by_noise = sorted(
                (r for r in here if r.cell.n_train == size),
                key=lambda r: r.cell.recipe.sensor.current_noise_a,
            )
            if len(by_noise) > 1:
                noise.append(
                    _panel(by_noise, style, lambda c: 1e3 * c.recipe.sensor.current_noise_a, "noise, mA")
                )
    return {
        "learning": learning,
        "noise": noise,
        "methods": plan.methods,
        "settings": [_setting(result) for result in results],
    }


def _at(cell: Cell, recipe: str, rate_hz: float) -> bool:
    return cell.recipe.name == recipe and cell.recipe.timing.sampling_rate_hz == rate_hz


def _same_noise(results: Sequence[CellResult]) -> list[CellResult]:
    """Those at the noise at which most training sizes were tried, by size."""
    noises = [result.cell.recipe.sensor.current_noise_a for result in results]
    if not noises:
        return []
    usual = max(noises, key=noises.count)
    chosen = (r for r, noise in zip(results, noises, strict=True) if noise == usual)
    return sorted(chosen, key=lambda r: r.cell.n_train)


def _panel(
    results: Sequence[CellResult], style: dict[str, str], position: Any, x_title: str
) -> dict[str, str]:
    xs = [position(result.cell) for result in results]
    lines = [Line(name, style[name], xs, [_accuracy(result, name) for result in results]) for name in style]
    limit_name = "estimate" if results[0].limit_is_estimate else "Bayes limit"
    lines.append(Line(limit_name, "limit", xs, [r.limit.scores.accuracy.value for r in results]))
    cell = results[0].cell
    return {
        "title": f"{cell.recipe.name}, {cell.recipe.timing.sampling_rate_hz / 1e3:g} kHz",
        "chart": line_chart(
            lines,
            Axis(x_title, xs[0], xs[-1], xs, is_log=True),
            share_axis([value for line in lines for value in line.y]),
        ),
    }


def _accuracy(result: CellResult, name: str) -> float:
    return next(m.judged.scores.accuracy.value for m in result.methods if m.name == name)


def _setting(result: CellResult) -> dict[str, Any]:
    """A setting's figures for the table of all settings."""
    recipe = result.cell.recipe
    return {
        "recipe": recipe.name,
        "rate_khz": recipe.timing.sampling_rate_hz / 1e3,
        "noise_ma": 1e3 * recipe.sensor.current_noise_a,
        "n_train": result.cell.n_train,
        "limit": result.limit.scores.accuracy.value,
        "estimated": result.limit_is_estimate,
        "methods": {m.name: m for m in result.methods},
    }
