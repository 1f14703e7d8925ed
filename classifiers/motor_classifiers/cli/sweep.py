"""Options of `motor-classifiers benchmark`, and what it prints before, during and after a run."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from rich.console import Console

from motor_classifiers.scoring.benchmark import AnswerStore, Plan, Unit, run_plan, units
from motor_classifiers.scoring.score import Results
from motor_env.common.console import working
from motor_env.common.errors import InputError
from motor_env.common.files import replacing


def numbers(option: str, text: str | None) -> tuple[float, ...]:
    """Parse numbers with commas between, none twice; empty without the option.

    Raises:
        InputError: something else.
    """
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--{option} must be numbers with commas between, got {text!r}") from None
    if len(set(values)) != len(values):
        raise InputError(f"--{option} must not name a value twice, got {text!r}")
    return values


def whole_numbers(option: str, text: str) -> list[int]:
    """Whole numbers with commas between, none twice."""
    values = numbers(option, text)
    if not all(value.is_integer() for value in values):
        raise InputError(f"--{option} must be whole numbers, got {text!r}")
    return list(map(int, values))


def require_writable(out: Path) -> None:
    """Fail before the work, not after it.

    Raises:
        InputError: a file of this name.
        OSError: nothing can be written there.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, not a folder")
    probe = out / ".writable"
    with replacing(probe):
        pass
    probe.unlink()


FULL_SWEEP = {
    "recipe": "bench,bench-full,paper,field",
    "sampling_rate_hz": "10000,1000",
    "current_noise_a": "0.02,0.005,0.1",
    "n_train": "2000,200,500,1000,8000",
}
"""Options of `benchmark --full`."""


def plan_lines(plan: Plan, store: AnswerStore, *, as_json: bool) -> list[str]:
    """List what would be run, what is there, and about how long the rest takes."""
    todo = [(unit, store.find(unit) is not None) for unit in units(plan)]
    if as_json:
        rows = [
            {"setting": unit.task.title, "method": unit.name, "done": done, "about_s": unit.seconds}
            for unit, done in todo
        ]
        return [json.dumps(rows, indent=1)]
    total = Counter(unit.task.title for unit, _ in todo)
    done_of = Counter(unit.task.title for unit, done in todo if done)
    minutes = sum(unit.seconds for unit, done in todo if not done) / 60.0
    return [
        *(f"{name:58} {done_of[name]:3} of {count:3} answers there" for name, count in total.items()),
        f"{len(plan.tasks)} settings, {len(todo)} answers, about {minutes:.0f} minutes of one core to go",
    ]


def run_with_progress(plan: Plan, store: AnswerStore) -> tuple[Results, ...]:
    """Run a plan with a progress bar, or a line an answer where standard error is no terminal."""
    todo, errors = units(plan), Console(stderr=True)
    begun, before = 0, 0.0

    def step(unit: Unit, known: bool) -> None:
        nonlocal begun, before
        begun += 1
        sentence = f"{begun} of {len(todo)}: {unit.name} on {unit.task.title}"
        update(advance=before)
        before = unit.seconds
        if errors.is_terminal:
            update(description=sentence)
        else:
            errors.print(f"{sentence}{' (known)' if known else ''}", soft_wrap=True, highlight=False)

    with working("judging", sum(unit.seconds for unit in todo)) as update:
        return run_plan(plan, store, step)


def table_lines(result: Results) -> list[str]:
    """The table of one setting."""
    heads = f"{'accuracy':>9}{'95 % interval':>17}{'below limit':>13}{'winding':>9}{'bearing':>9}{'level':>8}"
    limit_name = "Bayes estimate" if result.limit_is_estimate else "Bayes limit"
    rows = [(limit_name, result.limit), *((method.name, method) for method in result.ranked())]
    width = max(len(name) for name, _ in rows)
    lines = [result.task.title, f"{'method':{width}}{heads}{'us':>9}{'MB':>7}"]
    for name, own in rows:
        scores, memory = own.scores, own.answer.inference.memory_mb
        below = own.against_limit.difference.value / 100.0
        lines.append(
            f"{name:{width}}{scores.accuracy.value:9.4f}{scores.accuracy.low:9.4f}..{scores.accuracy.high:.4f}"
            f"{below:13.4f}{scores.winding.value:9.4f}{scores.bearing.value:9.4f}{scores.level.value:8.4f}"
            f"{own.answer.microseconds_per_transient:9.1f}{'' if memory is None else f'{memory:7.0f}'}"
        )
    kept = sorted(
        {f"{own.name}: kept answers, {own.answer.origin}" for own in result.methods if own.answer.origin}
    )
    return [*lines, *kept]
