"""What `motor-classifiers benchmark` says before, during and after a run."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from motor_classifiers.scoring.benchmark import CellResult, run_plan
from motor_classifiers.scoring.plan import AnswerStore, Plan, Unit, units
from motor_env.motor.parameters import Channel
from motor_env.simulation.recipes import Recipe, named_recipe

FULL_SWEEP = {
    "recipe": "bench,bench-full,paper,field",
    "sampling_rate_hz": "10000,1000",
    "current_noise_a": "0.02,0.005,0.1",
    "n_train": "2000,200,500,1000,8000",
}
"""Options of `benchmark --full`."""


def chosen_recipe(name: str, duration_s: float | None, channels: str | None) -> Recipe:
    """A named recipe with the options' changes."""
    chosen = named_recipe(name)
    if duration_s is not None:
        chosen = replace(chosen, timing=replace(chosen.timing, duration_s=duration_s))
    if channels is not None:
        measured = tuple(Channel(part) for part in channels.split(","))
        chosen = replace(chosen, sensor=replace(chosen.sensor, channels=measured))
    return chosen


def plan_lines(plan: Plan, store: AnswerStore, *, as_json: bool) -> list[str]:
    """What would be run, what is there already, and about how long the rest takes."""
    rows = [
        {
            "setting": unit.cell.title,
            "method": unit.name,
            "done": store.find(unit) is not None,
            "about_s": unit.seconds,
        }
        for unit in units(plan)
    ]
    open_s = sum(unit.seconds for unit, row in zip(units(plan), rows, strict=True) if not row["done"])
    if as_json:
        return [json.dumps(rows)]
    return [
        *(
            f"{name:58} {done:3} of {total:3} answers there"
            for name, (done, total) in _by_setting(rows).items()
        ),
        f"{len(plan.cells)} settings, {len(rows)} answers, about {open_s / 60.0:.0f} minutes of one core to go",
    ]


def _by_setting(rows: list[dict[str, Any]]) -> dict[str, tuple[int, int]]:
    counted: dict[str, tuple[int, int]] = {}
    for row in rows:
        done, total = counted.get(row["setting"], (0, 0))
        counted[row["setting"]] = (done + row["done"], total + 1)
    return counted


def run_with_progress(plan: Plan, store: AnswerStore) -> tuple[CellResult, ...]:
    """Run a plan with a progress bar, or a line an answer where standard error is no terminal."""
    todo = units(plan)
    columns = (BarColumn(30), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task("starting", total=sum(unit.seconds for unit in todo))
        begun, before = 0, 0.0

        def step(unit: Unit, known: bool) -> None:
            nonlocal begun, before
            begun += 1
            sentence = f"{begun} of {len(todo)}: {unit.name} on {unit.cell.title}"
            bar.update(task, advance=before, description=sentence)
            before = unit.seconds
            if not errors.is_terminal:
                errors.print(f"{sentence}{' (known)' if known else ''}", soft_wrap=True, highlight=False)

        results = run_plan(plan, store, step)
        bar.update(task, advance=before, description="done")
    return results


def table_lines(result: CellResult) -> list[str]:
    """The table of one setting."""
    heads = f"{'accuracy':>9}{'95 % interval':>17}{'below limit':>13}{'winding':>9}{'bearing':>9}{'level':>8}"
    lines = [result.cell.title, f"{'method':18}{heads}{'us':>9}{'MB':>7}"]
    limit = result.limit
    rows = [
        ("Bayes estimate" if result.limit_is_estimate else "Bayes limit", limit, 0.0),
        *((m.name, m.judged, -m.against_limit.difference.value) for m in result.ranked()),
    ]
    for name, judged, below in rows:
        accuracy, cost = judged.scores.accuracy, judged.answer
        memory = cost.inference.memory_mb
        lines.append(
            f"{name:18}{accuracy.value:9.4f}{accuracy.low:9.4f}..{accuracy.high:.4f}{below:13.4f}"
            f"{judged.scores.winding.value:9.4f}{judged.scores.bearing.value:9.4f}{judged.scores.level.value:8.4f}"
            f"{cost.microseconds_per_transient:9.1f}{'' if memory is None else f'{memory:7.0f}'}"
        )
    return lines
