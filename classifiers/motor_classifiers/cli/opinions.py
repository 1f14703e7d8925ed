"""What `motor-classifiers predict` finds and tells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from motor_classifiers.prediction.opinions import Opinion, opinions, predict_recording, second_opinion
from motor_classifiers.wrappers.outside import OUTSIDE
from motor_datasets.loaders import load
from motor_env.common.console import ExitStatus
from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.recording import read_recording
from motor_env.motor.data_sheet import Motor
from motor_env.motor.faults import HEALTHY
from motor_env.simulation.recipes import Recipe


def opinions_of(
    model: Any, recipe: Recipe, path: Path, split: str | None, motor: Motor | None = None
) -> tuple[list[Opinion], dict[str, Any] | None]:
    """Opinions on a data set; or the one on a recording, and what the model-based diagnosis says of it.

    Raises:
        InputError: it cannot be read, or has another time axis than the model.
    """
    if not path.is_dir():
        recording = read_recording(path)
        return [predict_recording(model, recipe, recording)], second_opinion(recording, recipe, motor)
    cases = load(path, split)
    if (cases.recipe.timing, cases.recipe.channels) != (recipe.timing, recipe.channels):
        raise InputError(f"{path}: has another time axis or other channels than the model was trained on")
    return opinions(model, recipe, cases.X), None


def opinion_lines(path: Path, opinions_given: list[Opinion], second: dict[str, Any] | None) -> list[str]:
    """One line of the model, and below it one of the diagnosis; counts for a data set."""
    if second is None:
        counts = Counter(opinion.verdict for opinion in opinions_given)
        summary = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
        return [f"{path}: {len(opinions_given)} cases: {summary}"]
    opinion = opinions_given[0]
    if opinion.verdict == OUTSIDE:
        first = f"{path}: {OUTSIDE}: {opinion.reason}"
    elif opinion.reason:
        first = f"{path}: no opinion: {opinion.reason}"
    else:
        doubt = " (undecided)" if opinion.status is ExitStatus.UNDECIDED else ""
        size = "" if opinion.verdict == HEALTHY else _size(opinion.severity, opinion.severity_interval)
        first = (
            f"{path}: {opinion.verdict}{doubt}, probability {opinion.probability:.2f}{size}{_beside(opinion)}"
        )
    sure = "" if second["confidence"] is None else f", confidence {second['confidence']:.2f}"
    size = _size(second["severity"], second["severity_interval"]) if second["severity"] else ""
    reasons = "; ".join(second["reasons"])
    return [first, f"  motor-env diagnose: {second['verdict']}{sure}{size}: {reasons}"]


def _beside(opinion: Opinion) -> str:
    """What only a wrapped model tells."""
    if opinion.candidates is None:
        return ""
    return f", could be {' or '.join(opinion.candidates) or 'none of its classes'}"


def _size(severity: float, interval: Sequence[float | None] | None) -> str:
    words = f", severity near {100.0 * severity:.0f} %"
    if interval is None or None in interval:
        return words
    low, high = (100.0 * bound for bound in interval if bound is not None)
    return f"{words} ({low:.0f} to {high:.0f})"
