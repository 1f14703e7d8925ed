"""The frozen tasks of motor-bench, and the digests of their data."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from typing import Any

from motor_classifiers.contest.questions import ReferenceTask, SeverityTask, StrangerTask, StreamTask
from motor_classifiers.scoring.task import ClassTask, DrawnTask
from motor_env.errors import InputError
from motor_env.motor.faults import FaultKind
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import FaultClass
from motor_env.simulation.simulate import Timing


def _tasks() -> dict[str, DrawnTask]:
    bench = named_recipe("bench")
    severities = replace(bench, classes=(FaultClass(FaultKind.BEARING, 0.0, severity_to=0.30),))
    # A winding that ages under a motor without load hardly changes its current: bearings alone.
    bearings = [FaultClass(FaultKind.BEARING, severity) for severity in (0.25, 0.5, 1.0)]
    half = (FaultClass(weight=float(len(bearings))), *bearings)
    stream = replace(bench, classes=half, timing=Timing(1_000.0, 0.7))
    slow = replace(bench, timing=Timing(1_000.0, 0.1))
    full, field, operation = map(named_recipe, ("bench-full", "field", "operation"))
    friction = "Which class in the field: friction, ramps, sensor errors"
    at_work = "Which class at work: another voltage, which is a channel, and load in each case"
    late = "When did a bearing fault set in: delay against false alarms"
    every: tuple[DrawnTask, ...] = (
        ClassTask("bench", "Which of five classes: tolerances, current alone, 10 kHz", recipe=bench),
        ClassTask("bench-full", "Which of nine classes: all kinds of faults", recipe=full),
        ClassTask("field", friction, bracket=(16.29, 16.97), recipe=field),
        ClassTask("operation", at_work, bracket=(18.68, 20.16), recipe=operation),
        ReferenceTask(
            "reference", "Which class, with one healthy start of the same motor", 2000, recipe=bench
        ),
        SeverityTask(
            "severity", "How large a bearing fault, 0 to 30 %", 2000, "RMSE, points", recipe=severities
        ),
        StrangerTask(
            "unknown",
            "How strange: faults never trained on, 1 kHz",
            4000,
            "100 (1 - area under the ROC curve)",
            recipe=slow,
        ),
        StreamTask("stream", late, 2000, "100 x mean cost", recipe=stream),
    )
    return {task.name: task for task in every}


TASKS = _tasks()
"""Every task by name."""


def load_task(name: str) -> DrawnTask:
    """A frozen task of motor-bench: recipe, training starts, test cases.

    Raises:
        InputError: there is none of this name.
    """
    if name not in TASKS:
        raise InputError(f"task must be one of {', '.join(TASKS)}, got {name!r}")
    return TASKS[name]


SMALL = 24
"""Cases of the small counts that are checked quickly."""


def current_digests(*, whole: bool) -> dict[str, dict[str, str]]:
    """Digests of all tasks as this code draws them, of so many cases as they have, or of `SMALL`."""
    tasks = TASKS if whole else {n: replace(t, n_train=SMALL, n_test=SMALL) for n, t in TASKS.items()}
    return {name: task.digests() for name, task in tasks.items()}


def frozen_digests() -> dict[str, Any]:
    """What they must be: of `small` counts and `whole`, written by `python benchmarks/leaderboard.py freeze`."""
    text = (files("motor_classifiers.contest") / "motor_bench.json").read_text(encoding="utf-8")
    digests: dict[str, Any] = json.loads(text)
    return digests
