"""Prediction for a recorded start on the model's time axis, with the model-based diagnosis beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from motor_classifiers.estimators.cases import cases_by_axis, values_of_start
from motor_classifiers.estimators.methods import model_probabilities
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.fitted import innermost
from motor_classifiers.wrappers.outlier_detector import ADVICE, OUTSIDE, OutsideDetector
from motor_datasets.loaders import load
from motor_env.common.arrays import instance
from motor_env.common.console import ExitStatus
from motor_env.common.errors import InputError
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.estimation.starts.start_identification import identify
from motor_env.diagnosis.readers.alignment import Alignment, align
from motor_env.diagnosis.readers.recording import Recording, UnusableError, read_recording
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.verdict.report_text import as_json
from motor_env.inference.class_model import FEATURE_NAMES, physical_features
from motor_env.inference.posterior import variance_factor
from motor_env.motor.data_sheet import Motor, Tolerance
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.model import State
from motor_env.motor.parameters import Channel, FloatArray
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import simulate_states

_FINE_SHIFTS = np.arange(-3.0, 3.02, 0.05)
# Of the model's sampling interval: the rise of a start is too quick for coarser lines.
_COARSEST_TO_INTERPOLATE = 0.25
# Standard deviations of chi2 beyond which the start is not of a motor that the model knows.
_LARGEST_MISFIT = 5.0
_VOLTAGE_TOLERANCE = 0.05


def aligned_case(
    recording: Recording, recipe: Recipe, noise_range: tuple[float, float] | None = None
) -> FloatArray:
    """Resample a recording to the recipe's time axis, shape (1, n_channels, n_samples).

    At equal rates a fit moves the onset onto a sample, as a step between two samples looks like another motor. A
    faster recording is interpolated at the shift of the best fit. The mean of the quiet part before the start is
    subtracted.

    Args:
        recording: of a start.
        recipe: of the model.
        noise_range: range of the noise over the recipe's in which the model estimates it.

    Raises:
        UnusableError: the model is for other motors, supplies, channels or time axes.
        ValueError: the model is for motors at work.
    """
    recipe.require_step()
    start = align(recording)
    _check_comparable(recording, recipe, start)
    if abs(recording.dt_s / recipe.timing.dt_s - 1.0) < 1e-3:
        shifted = _moved_onto_a_sample(recording, recipe)
    else:
        shifted = np.stack([_resampled(recording, recipe, start, shift) for shift in _FINE_SHIFTS])
    features = physical_features(recipe, shifted)
    misfit = features[:, FEATURE_NAMES.index("reduced_chi2")]
    best = int(misfit.argmin())
    n_values = shifted[0].size
    noisiest = max(map(variance_factor, recipe.classes))
    largest = noisiest * (1.0 + _LARGEST_MISFIT * np.sqrt(2.0 / n_values))
    level = 1.0 if noise_range is None else _noise_level(shifted[best], recipe, noise_range)
    if misfit[best] > level * largest:
        raise UnusableError(
            "no motor that the model knows fits this start: "
            f"the squared residual is {misfit[best] / level:.3g} times the noise's"
        )
    return shifted[best : best + 1]


def _noise_level(case: FloatArray, recipe: Recipe, noise_range: tuple[float, float]) -> float:
    """Return the noise variance over the recipe's, from neighbours' differences (von Neumann 1941)."""
    settled = case[:, case.shape[1] // 2 :] / recipe.sensor.noise_std[:, None]
    level = float(np.square(np.diff(settled, axis=1)).mean() / 2.0)
    return float(np.clip(level, noise_range[0] ** 2, noise_range[1] ** 2))


def _moved_onto_a_sample(recording: Recording, recipe: Recipe) -> FloatArray:
    """Move a start onto the sample grid: fitted response to a step at a sample, plus the residual, shape (1, ...)."""
    timing = recipe.timing
    prepared = prepare(recording, float(np.asarray(recipe.supply.voltage_v)))
    # The recipe's supply is a step; a measured voltage would also bring its noise, and pin the onset to its samples.
    fitted = identify(replace(prepared, voltage_v=None))
    start = fitted.start
    step = int(np.abs(start.time_s - fitted.onset_s).argmin())
    rows = np.arange(timing.n_samples) + step + 1 - timing.n_quiet
    if rows[0] < 0 or rows[-1] >= len(start.time_s):
        raise UnusableError(
            f"the model needs {timing.quiet_s:g} s before the start and {timing.duration_s:g} s after it"
        )
    voltage = start.level_v * (np.arange(timing.n_samples) >= timing.n_quiet)
    response = simulate_states(fitted.parameters, voltage, timing.dt_s)
    left = {Channel.CURRENT: fitted.residual_a[rows]}
    if start.speed_rad_s is not None:
        left[Channel.SPEED] = (start.speed_rad_s - fitted.expected[:, 1])[rows]
    columns = {Channel.CURRENT: response[:, State.CURRENT], Channel.SPEED: response[:, State.SPEED]}
    return np.stack([left[channel] + columns[channel] for channel in recipe.sensor.channels])[None]


def _check_comparable(recording: Recording, recipe: Recipe, start: Alignment) -> None:
    timing = recipe.timing
    if Channel.SPEED in recipe.sensor.channels and recording.speed_rad_s is None:
        raise UnusableError("the model needs the speed, which was not recorded")
    ratio = recording.dt_s / timing.dt_s
    if abs(ratio - 1.0) >= 1e-3 and ratio > _COARSEST_TO_INTERPOLATE:
        raise UnusableError(
            f"sampled at {1.0 / recording.dt_s:.6g} Hz, the model needs {timing.sampling_rate_hz:g} Hz, or four times "
            f"that and more; train it with --sampling-rate-hz {1.0 / recording.dt_s:.6g}"
        )
    left = float(recording.time_s[-1]) - start.onset_s
    if left < timing.duration_s - 0.5 * timing.dt_s:
        raise UnusableError(f"{left:.3g} s after the start, the model needs {timing.duration_s:g} s")
    if recording.voltage_v is not None:
        level = float(np.median(np.abs(recording.voltage_v[start.onset_index + 1 :])))
        wanted = float(np.asarray(recipe.supply.voltage_v))
        if abs(level - wanted) > _VOLTAGE_TOLERANCE * wanted:
            raise UnusableError(f"the supply is at {level:.4g} V, the model was trained at {wanted:g} V")


def _resampled(recording: Recording, recipe: Recipe, start: Alignment, shift: float) -> FloatArray:
    onset_s = recording.time_s[start.onset_index]
    at = onset_s + shift * recipe.timing.dt_s + recipe.timing.time_s
    columns = {Channel.CURRENT: start.sign * (recording.current_a - start.offset_a)}
    if recording.speed_rad_s is not None:
        columns[Channel.SPEED] = start.sign * recording.speed_rad_s
    return np.stack([np.interp(at, recording.time_s, columns[channel]) for channel in recipe.sensor.channels])


UNDECIDED = "unusable"
"""Verdict without a prediction: another motor or supply, too short, too coarse."""

LEAST_PROBABILITY = 0.5
"""Least probability of a verdict, else the prediction is undecided."""


class Prediction(NamedTuple):
    """Prediction of a model for a start.

    Attributes:
        verdict: healthy, bearing, winding, noise, `outside what I know`, or unusable.
        class_name: most probable class; empty where unusable.
        probability: of the verdict.
        severity: its mean, for the most probable kind of the verdict; 0 for healthy.
        probabilities: of each class by name.
        reason: of a missing prediction, with advice; else empty.
        severity_interval: bounds of 90 %, if the model gives them.
        candidates: classes in the conformal set, if the model has one; may be empty.
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
        """Exit status of this prediction."""
        if self.verdict in (UNDECIDED, OUTSIDE) or self.probability < LEAST_PROBABILITY:
            return ExitStatus.UNDECIDED
        return ExitStatus.HEALTHY if self.verdict == HEALTHY else ExitStatus.FAULT

    def as_json(self) -> dict[str, Any]:
        """Return the prediction for --json."""
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
    """Return the verdict for a label kind; both winding faults are winding."""
    return FaultKind(label_kind).verdict if label_kind in FaultKind else str(label_kind)


def predictions(model: BaseEstimator, recipe: Recipe, X: Any) -> list[Prediction]:
    """Predict each case, X of shape (n_cases, n_channels, n_timepoints), or flattened."""
    instance("model", model, BaseEstimator)
    instance("recipe", recipe, Recipe)
    if isinstance(model, ConformalClassifier):
        sets = (tuple(model.classes_[chosen].tolist()) for chosen in model.predict_set(X))
        inside = predictions(model.wrapped_model, recipe, X)
        return [prediction._replace(candidates=names) for prediction, names in zip(inside, sets, strict=True)]
    X = X if isinstance(X, np.ndarray) and X.ndim == 2 else cases_by_axis(X, recipe)
    probabilities = in_recipe_order(model, model_probabilities(model, X), recipe)
    verdicts = np.array([verdict_of(c.label_kind) for c in recipe.classes])
    best = probabilities.argmax(axis=1)
    same_verdict = np.where(verdicts == verdicts[best][:, None], probabilities, 0.0)
    share = same_verdict.sum(axis=1)
    if isinstance(model, PosteriorNetwork) and model.severity_ is not None:
        severities = _network_severities(model, recipe, X, best)
    else:
        means = same_verdict @ np.array([c.severity for c in recipe.classes]) / share
        severities = [(mean, None) for mean in means]
    return [
        Prediction(
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
    """Return mean and 90 % interval for the (first) fault kind of each most probable class."""
    severities: list[tuple[float, tuple[float, float] | None]] = [(0.0, None)] * len(best)
    kinds = np.array(["" if c.kind is None else str(c.kind) for c in recipe.classes])[best]
    for kind in set(kinds.tolist()) - {""}:
        mean, low, high = model.predict_severity(X, kind)[1:]
        for row in np.flatnonzero(kinds == kind):
            severities[row] = float(mean[row]), (float(low[row]), float(high[row]))
    return severities


def predict(recording: Recording | Path | str, model: Path | str | None = None) -> Prediction:
    """Predict for one recording.

    Args:
        recording: one, or its file.
        model: file of the model; by default the package's network for the paper's motor.

    Raises:
        InputError: a file cannot be read.
    """
    fitted, recipe, _ = load_model(PRETRAINED if model is None else model)
    return predict_recording(fitted, recipe, recording)


def predict_recording(model: BaseEstimator, recipe: Recipe, recording: Recording | Path | str) -> Prediction:
    """Predict for one recording or its file by a loaded model.

    Raises:
        InputError: the file cannot be read.
    """
    instance("model", model, BaseEstimator)
    instance("recipe", recipe, Recipe)
    instance("recording", recording, (Recording, Path, str))
    if not isinstance(recording, Recording):
        recording = read_recording(Path(recording))
    references = model.n_features_in_ // values_of_start(recipe) - 1
    if references:
        return Prediction(
            UNDECIDED, reason=f"the model needs {references} healthy starts of the same motor beside each"
        )
    try:
        case = aligned_case(recording, recipe, _noise_range(model))
    except UnusableError as error:
        return Prediction(UNDECIDED, reason=str(error))
    (prediction,) = predictions(model, recipe, case)
    if recipe.recovering or any(kind.is_sensor for kind in recipe.kinds):  # such starts have no detector
        return prediction
    shift = str(_detector(recipe, _noise_range(model)).likely_shift(case)[0])
    if not shift:
        return prediction
    reason = f"most likely {shift}: {ADVICE[shift]}"
    return Prediction(OUTSIDE, probabilities=prediction.probabilities, reason=reason)


@lru_cache(maxsize=4)
def _detector(recipe: Recipe, noise_range: tuple[float, float] | None) -> OutsideDetector:
    return OutsideDetector(recipe, noise_range=noise_range).fit()


def _noise_range(model: BaseEstimator) -> tuple[float, float] | None:
    core = innermost(model)
    return core.noise_range if isinstance(core, PosteriorNetwork) else None


def model_based_diagnosis(recording: Recording, recipe: Recipe, motor: Motor | None = None) -> dict[str, Any]:
    """Diagnose the recording as `motor-env diagnose`, by default for the recipe's motor and tolerances."""
    if motor is None:
        tolerance = Tolerance(**asdict(recipe.spread), temperature_k=0.0)
        voltage = float(np.asarray(recipe.supply.voltage_v))
        motor = Motor(f"of the recipe {recipe.name}", "data_sheet", recipe.motor, voltage, tolerance)
    diagnosis = as_json(diagnose(recording, motor))
    kept = ("verdict", "kind", "severity", "severity_interval", "confidence", "reasons")
    return {name: diagnosis[name] for name in kept}


def predict_file(
    model: Any, recipe: Recipe, path: Path, split: str | None, motor: Motor | None = None
) -> tuple[list[Prediction], dict[str, Any] | None]:
    """Predict for a data set; or for one recording, with the model-based diagnosis.

    Raises:
        InputError: it is unreadable, or has another time axis than the model.
    """
    if not path.is_dir():
        recording = read_recording(path)
        return [predict_recording(model, recipe, recording)], model_based_diagnosis(recording, recipe, motor)
    cases = load(path, split)
    if (cases.recipe.timing, cases.recipe.channels) != (recipe.timing, recipe.channels):
        raise InputError(f"{path}: has another time axis or other channels than the model was trained on")
    return predictions(model, recipe, cases.X), None


def prediction_lines(path: Path, predictions: list[Prediction], second: dict[str, Any] | None) -> list[str]:
    """Return a line of the model and one of the diagnosis; counts for a data set."""
    if second is None:
        counts = Counter(prediction.verdict for prediction in predictions)
        summary = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
        return [f"{path}: {len(predictions)} cases: {summary}"]
    prediction = predictions[0]
    if prediction.verdict == OUTSIDE:
        first = f"{path}: {OUTSIDE}: {prediction.reason}"
    elif prediction.reason:
        first = f"{path}: no opinion: {prediction.reason}"
    else:
        doubt = " (undecided)" if prediction.status is ExitStatus.UNDECIDED else ""
        size = _size(prediction.severity, prediction.severity_interval)
        size = "" if prediction.verdict == HEALTHY else size
        sure = f"probability {prediction.probability:.2f}"
        first = f"{path}: {prediction.verdict}{doubt}, {sure}{size}{_candidates(prediction)}"
    sure = "" if second["confidence"] is None else f", confidence {second['confidence']:.2f}"
    size = _size(second["severity"], second["severity_interval"]) if second["severity"] else ""
    reasons = "; ".join(second["reasons"])
    return [first, f"  motor-env diagnose: {second['verdict']}{sure}{size}: {reasons}"]


def _candidates(prediction: Prediction) -> str:
    if prediction.candidates is None:
        return ""
    return f", could be {' or '.join(prediction.candidates) or 'none of its classes'}"


def _size(severity: float, interval: Sequence[float | None] | None) -> str:
    words = f", severity near {100.0 * severity:.0f} %"
    if interval is None or None in interval:
        return words
    low, high = (100.0 * bound for bound in interval if bound is not None)
    return f"{words} ({low:.0f} to {high:.0f})"
