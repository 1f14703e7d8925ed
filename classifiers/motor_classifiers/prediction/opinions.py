"""What a model says of a start: its opinion, with a reason where it has none."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from motor_classifiers.estimators.cases import values_of_start
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.own_methods import answered
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.prediction.alignment import aligned_case
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.fitted import innermost
from motor_classifiers.wrappers.outside import ADVICE, OUTSIDE, OutsideDetector
from motor_env.common.console import ExitStatus
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.readers.recording import Recording, UnusableError, read_recording
from motor_env.diagnosis.verdict.report_text import as_json
from motor_env.motor.data_sheet import Motor, Tolerance
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.simulation.recipes import Recipe

UNDECIDED = "unusable"
"""Verdict where the model has no say: another motor, another supply, too short, too coarse."""

LEAST_PROBABILITY = 0.5
"""Least probability of a verdict; below it the opinion is undecided."""


class Opinion(NamedTuple):
    """What a model says of a start.

    Attributes:
        verdict: healthy, bearing, winding, noise, `outside what I know`, or unusable.
        class_name: most probable class; empty where unusable.
        probability: of the verdict.
        severity: its mean, for the most probable kind of the verdict; 0 for healthy.
        probabilities: of each class by name.
        reason: why there is no opinion, and what to do; else empty.
        severity_interval: bounds that hold the severity in 90 of 100 cases, from a model that tells them.
        candidates: classes in the conformal set, from a model that has one; the set may be empty.
    """

    verdict: str
    class_name: str = ""
    probability: float = 0.0
    severity: float = 0.0
    probabilities: dict[str, float] = {}  # noqa: RUF012  # a tuple's default, never changed
    reason: str = ""
    severity_interval: tuple[float, float] | None = None
    candidates: tuple[str, ...] | None = None

    @property
    def status(self) -> ExitStatus:
        """Exit status that this opinion alone gives."""
        if self.verdict in (UNDECIDED, OUTSIDE) or self.probability < LEAST_PROBABILITY:
            return ExitStatus.UNDECIDED
        return ExitStatus.HEALTHY if self.verdict == HEALTHY else ExitStatus.FAULT

    def as_json(self) -> dict[str, Any]:
        """For --json."""
        return {
            "verdict": self.verdict,
            "class": self.class_name or None,
            "probability": self.probability,
            "severity": self.severity,
            "severity_interval": None if self.severity_interval is None else list(self.severity_interval),
            "probabilities": self.probabilities,
            "candidates": None if self.candidates is None else list(self.candidates),
            "undecided": self.status is ExitStatus.UNDECIDED,
            "reason": self.reason or None,
        }


def verdict_of(label_kind: str) -> str:
    """Verdict for a label kind: both winding faults are winding; healthy and joint faults keep their label."""
    return FaultKind(label_kind).verdict if label_kind in FaultKind else str(label_kind)


def opinions(model: BaseEstimator, recipe: Recipe, X: Any) -> list[Opinion]:
    """Opinion on each case, X of shape (n_cases, n_channels, n_timepoints)."""
    if isinstance(model, ConformalClassifier):
        sets = (tuple(model.classes_[chosen].tolist()) for chosen in model.predict_set(X))
        inside = opinions(model.wrapped_model, recipe, X)
        return [opinion._replace(candidates=names) for opinion, names in zip(inside, sets, strict=True)]
    probabilities = in_recipe_order(model, answered(model, X), recipe)
    verdicts = np.array([verdict_of(c.label_kind) for c in recipe.classes])
    best = probabilities.argmax(axis=1)
    mine = np.where(verdicts == verdicts[best][:, None], probabilities, 0.0)
    share = mine.sum(axis=1)
    if isinstance(model, PosteriorNetwork) and model.severity_ is not None:
        severities = _network_severities(model, recipe, X, best)
    else:
        means = mine @ np.array([c.severity for c in recipe.classes]) / share
        severities = [(mean, None) for mean in means]
    return [
        Opinion(
            verdict=str(verdicts[n]),
            class_name=recipe.class_names[n],
            probability=float(of_verdict),
            severity=float(severity),
            probabilities=dict(zip(recipe.class_names, row.tolist(), strict=True)),
            severity_interval=interval,
        )
        for n, of_verdict, row, (severity, interval) in zip(
            best, share, probabilities, severities, strict=True
        )
    ]


def _network_severities(
    model: PosteriorNetwork, recipe: Recipe, X: Any, best: NDArray[np.int64]
) -> list[tuple[float, tuple[float, float] | None]]:
    """Mean and 90 % interval for the (first) fault kind of each most probable class."""
    severities: list[tuple[float, tuple[float, float] | None]] = [(0.0, None)] * len(best)
    kinds = np.array(["" if c.kind is None else str(c.kind) for c in recipe.classes])[best]
    for kind in set(kinds.tolist()) - {""}:
        mean, low, high = model.predict_severity(X, kind)[1:]
        for row in np.flatnonzero(kinds == kind):
            severities[row] = float(mean[row]), (float(low[row]), float(high[row]))
    return severities


def predict(recording: Recording | Path | str, model: Path | str | None = None) -> Opinion:
    """Opinion on one recording.

    Args:
        recording: as read, or its file.
        model: file of the model; by default the network for the paper's motor that comes with the package.

    Raises:
        InputError: a file cannot be read.
    """
    fitted, recipe, _ = load_model(PRETRAINED if model is None else Path(model))
    return predict_recording(fitted, recipe, recording)


def predict_recording(model: BaseEstimator, recipe: Recipe, recording: Recording | Path | str) -> Opinion:
    """Opinion of a loaded model on one recording, as read, or its file.

    Raises:
        InputError: the file cannot be read.
    """
    if not isinstance(recording, Recording):
        recording = read_recording(Path(recording))
    references = model.n_features_in_ // values_of_start(recipe) - 1
    if references:
        return Opinion(
            UNDECIDED, reason=f"the model wants {references} healthy starts of the same motor beside each"
        )
    try:
        case = aligned_case(recording, recipe, _noise_range(model))
    except UnusableError as error:
        return Opinion(UNDECIDED, reason=str(error))
    (opinion,) = opinions(model, recipe, case)
    if any(kind.is_sensor for kind in recipe.kinds):  # such starts have no detector
        return opinion
    off = str(_detector(recipe, _noise_range(model)).what_is_off(case)[0])
    if not off:
        return opinion
    reason = f"most likely {off}: {ADVICE[off]}"
    return Opinion(OUTSIDE, probabilities=opinion.probabilities, reason=reason)


@lru_cache(maxsize=4)
def _detector(recipe: Recipe, noise_range: tuple[float, float] | None) -> OutsideDetector:
    return OutsideDetector(recipe, noise_range=noise_range).fit()


def _noise_range(model: BaseEstimator) -> tuple[float, float] | None:
    core = innermost(model)
    return core.noise_range if isinstance(core, PosteriorNetwork) else None


def second_opinion(recording: Recording, recipe: Recipe, motor: Motor | None = None) -> dict[str, Any]:
    """What `motor-env diagnose` says of the recording.

    Args:
        recording: as read.
        recipe: its motor and tolerances are the data sheet where no motor is given.
        motor: the healthy motor.
    """
    if motor is None:
        tolerance = Tolerance(**asdict(recipe.spread), temperature_k=0.0)
        voltage = float(np.asarray(recipe.supply.voltage_v))
        motor = Motor(f"of the recipe {recipe.name}", "data_sheet", recipe.motor, voltage, tolerance)
    diagnosis = as_json(diagnose(recording, motor))
    kept = ("verdict", "kind", "severity", "severity_interval", "confidence", "reasons")
    return {name: diagnosis[name] for name in kept}
