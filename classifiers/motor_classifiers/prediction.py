"""The learned opinion on recordings: aligned, resampled, and refused where the model cannot know."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.wrapper_file import Wrapper, wrapped_model
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.open_set import OTHER, OpenSetClassifier
from motor_env.console import ExitStatus
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.report import as_json
from motor_env.identification.identify import identify
from motor_env.inference.features import FEATURE_NAMES, physical_features
from motor_env.inference.posterior import variance_factor
from motor_env.motor.data_sheet import MotorFile, Tolerance
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.model import State
from motor_env.motor.parameters import Channel, FloatArray
from motor_env.recordings.alignment import Alignment, align
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.start import prepare
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import simulate_states

UNDECIDED = "unusable"
"""Verdict where the model has no say: another motor, another supply, too short, too coarse."""

LEAST_PROBABILITY = 0.5
"""Of the decided verdict; below it the opinion is undecided."""

_FINE_SHIFTS = np.arange(-3.0, 3.02, 0.05)
_COARSEST_TO_INTERPOLATE = (
    0.25  # of the model's sampling interval: the rise of a start is too quick for coarser lines
)
_LARGEST_MISFIT = (
    5.0  # standard deviations of chi2 beyond which the start is not of a motor that the model knows
)
_VOLTAGE_TOLERANCE = 0.05


class Opinion(NamedTuple):
    """What a model says of a start.

    Attributes:
        verdict: healthy, bearing, winding, noise, other, or unusable.
        class_name: most probable class; empty where unusable.
        probability: of the verdict; of `other` and out of range, one minus the rate of false alarms.
        severity: its mean, for the most probable kind of the verdict; 0 for healthy.
        probabilities: of each class by name.
        reason: why there is no opinion, else empty.
        severity_interval: bounds that hold the severity in 90 of 100 cases, from a model that tells them.
        candidates: classes in the conformal set, from a model that has one; the set may be empty.
        out_of_range: whether the fault is larger than any that the model was trained on, from a model that tells it.
    """

    verdict: str
    class_name: str = ""
    probability: float = 0.0
    severity: float = 0.0
    probabilities: dict[str, float] = {}  # noqa: RUF012  # a tuple's default, never changed
    reason: str = ""
    severity_interval: tuple[float, float] | None = None
    candidates: tuple[str, ...] | None = None
    out_of_range: bool | None = None

    @property
    def status(self) -> ExitStatus:
        """Exit status that this opinion alone gives."""
        if self.verdict == UNDECIDED or self.probability < LEAST_PROBABILITY:
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
            "out_of_range": self.out_of_range,
            "undecided": self.status is ExitStatus.UNDECIDED,
            "reason": self.reason or None,
        }


def verdict_of(label_kind: str) -> str:
    """Verdict for a label kind: both winding faults are winding; healthy and joint faults keep their label."""
    return FaultKind(label_kind).verdict if label_kind in FaultKind else str(label_kind)


def opinions(model: BaseEstimator, recipe: Recipe, X: Any) -> list[Opinion]:
    """Opinion on each case, X of shape (n_cases, n_channels, n_timepoints)."""
    if isinstance(model, ConformalClassifier | OpenSetClassifier):
        return _around(model, opinions(wrapped_model(model), recipe, X), X)
    probabilities = in_recipe_order(model, model.predict_proba(X), recipe)
    verdicts = np.array([verdict_of(c.label_kind) for c in recipe.classes])
    best = probabilities.argmax(axis=1)
    mine = np.where(verdicts == verdicts[best][:, None], probabilities, 0.0)
    share = mine.sum(axis=1)
    if isinstance(model, PosteriorNetwork):
        told = _told_severities(model, recipe, X, best)
    else:
        told = [(mean, None) for mean in mine @ np.array([c.severity for c in recipe.classes]) / share]
    return [
        Opinion(
            verdict=str(verdicts[n]),
            class_name=recipe.class_names[n],
            probability=float(of_verdict),
            severity=float(severity),
            probabilities=dict(zip(recipe.class_names, row.tolist(), strict=True)),
            severity_interval=interval,
        )
        for n, of_verdict, row, (severity, interval) in zip(best, share, probabilities, told, strict=True)
    ]


def _around(model: Wrapper, inside: list[Opinion], X: Any) -> list[Opinion]:
    """What a wrapper adds to the opinions of the model inside."""
    if isinstance(model, ConformalClassifier):
        sets = (tuple(model.classes_[chosen].tolist()) for chosen in model.predict_set(X))
        return [opinion._replace(candidates=names) for opinion, names in zip(inside, sets, strict=True)]
    verdicts = (part.tolist() for part in model.verdicts(X))
    sure = 1.0 - model.false_alarm_rate
    return [_open(sure, *row) for row in zip(inside, *verdicts, strict=True)]


def _open(
    sure: float, inside: Opinion, label: str, is_other: bool, out_of_range: bool, severity: float
) -> Opinion:
    """What the model inside says, unless the start is of no known motor, or of a fault larger than any it knows."""
    if is_other:
        return Opinion(OTHER, "", sure, probabilities=inside.probabilities, out_of_range=False)
    if out_of_range:
        kind = verdict_of(label)
        return Opinion(kind, "", sure, severity, inside.probabilities, out_of_range=True)
    return inside._replace(out_of_range=False)


def _told_severities(
    model: PosteriorNetwork, recipe: Recipe, X: Any, best: NDArray[np.int64]
) -> list[tuple[float, tuple[float, float] | None]]:
    """Mean and 90 % interval for the (first) fault kind of each most probable class."""
    told: list[tuple[float, tuple[float, float] | None]] = [(0.0, None)] * len(best)
    kinds = np.array(["" if c.kind is None else str(c.kind) for c in recipe.classes])[best]
    for kind in set(kinds.tolist()) - {""}:
        found = model.predict_severity(X, kind)
        for row in np.flatnonzero(kinds == kind):
            told[row] = float(found.mean[row]), (float(found.low[row]), float(found.high[row]))
    return told


def overall_status(given: list[Opinion]) -> ExitStatus:
    """Fault before undecided before healthy."""
    statuses = [opinion.status for opinion in given]
    for status in (ExitStatus.FAULT, ExitStatus.UNDECIDED):
        if status in statuses:
            return status
    return ExitStatus.HEALTHY


def predict_recording(model: BaseEstimator, recipe: Recipe, path: Path) -> Opinion:
    """Opinion on one recording.

    Raises:
        InputError: the file cannot be read.
    """
    return judge_recording(model, recipe, read_recording(path))


def judge_recording(model: BaseEstimator, recipe: Recipe, recording: Recording) -> Opinion:
    """Opinion on a recording that was read."""
    core = model
    while isinstance(core, OpenSetClassifier | ConformalClassifier):
        core = wrapped_model(core)
    noise_range = core.noise_range if isinstance(core, PosteriorNetwork) else None
    references = model.n_features_in_ // (len(recipe.sensor.channels) * recipe.timing.n_samples) - 1
    if references:
        return Opinion(
            UNDECIDED, reason=f"the model wants {references} healthy starts of the same motor beside each"
        )
    try:
        case = aligned_case(recording, recipe, noise_range)
    except UnusableError as error:
        return Opinion(UNDECIDED, reason=str(error))
    return opinions(model, recipe, case)[0]


def second_opinion(recording: Recording, recipe: Recipe) -> dict[str, Any]:
    """What `motor-env diagnose` says of the recording, with the recipe's motor and tolerances for its data sheet."""
    spread = recipe.spread
    tolerance = Tolerance(
        supply=spread.supply,
        resistance=spread.resistance,
        constants=spread.constants,
        inertia=spread.inertia,
        friction=spread.friction,
        temperature_k=0.0,
    )
    motor = MotorFile(
        recipe.name, "data_sheet", recipe.motor, float(np.asarray(recipe.supply.voltage_v)), tolerance
    )
    told = as_json(diagnose(recording, motor))
    kept = ("verdict", "fault_kind", "severity", "severity_interval", "confidence", "reasons")
    return {name: told[name] for name in kept}


def aligned_case(
    recording: Recording, recipe: Recipe, noise_range: tuple[float, float] | None = None
) -> FloatArray:
    """The recording on the recipe's time axis, shape (1, n_channels, n_samples).

    At equal rates the start is fitted with its onset free, and moved onto a sample by what the fit says: a step
    between two samples looks like another motor, for the current rises by amperes in a sample. A faster recording is
    interpolated at the shift where the recipe's motor, parameters free, fits best. The mean of the quiet part before
    the start is taken off the current; nothing else is normalised.

    Args:
        recording: as read.
        recipe: of the model.
        noise_range: factors on the recipe's noise between which the model reads the noise off the start itself.

    Raises:
        UnusableError: the model was trained for other motors, supplies, channels or time axes than this.
    """
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
    """Variance of the noise over the recipe's, from differences of neighbours (von Neumann 1941), within the range.

    The second half of a start changes slowly beside the noise: what is left is slow misfit, not noise.
    """
    settled = case[:, case.shape[1] // 2 :] / recipe.sensor.noise_std[:, None]
    level = float(np.square(np.diff(settled, axis=1)).mean() / 2.0)
    return float(np.clip(level, noise_range[0] ** 2, noise_range[1] ** 2))


def _moved_onto_a_sample(recording: Recording, recipe: Recipe) -> FloatArray:
    """What the fit leaves over, on top of the fitted motor's response to a step at a sample: shape (1, ...)."""
    timing = recipe.timing
    prepared = prepare(recording, float(np.asarray(recipe.supply.voltage_v)))
    # The recipe's supply is a step; a measured voltage would also bring its noise, and pin the onset to its samples.
    fitted = identify(replace(prepared, voltage_v=None))
    start = fitted.start
    step = int(np.abs(start.time_s - fitted.onset_s).argmin())
    rows = np.arange(timing.n_samples) + step + 1 - timing.n_quiet
    if rows[0] < 0 or rows[-1] >= len(start.time_s):
        raise UnusableError(
            f"the model wants {timing.quiet_s:g} s before the start and {timing.duration_s:g} s after it"
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
        raise UnusableError("the model wants the speed, which was not recorded")
    ratio = recording.dt_s / timing.dt_s
    if abs(ratio - 1.0) >= 1e-3 and ratio > _COARSEST_TO_INTERPOLATE:
        raise UnusableError(
            f"sampled at {1.0 / recording.dt_s:.4g} Hz, "
            f"the model wants {timing.sampling_rate_hz:g} Hz, or four times that and more"
        )
    left = float(recording.time_s[-1]) - start.onset_s
    if left < timing.duration_s - 0.5 * timing.dt_s:
        raise UnusableError(f"{left:.3g} s after the start, the model wants {timing.duration_s:g} s")
    if recording.voltage_v is not None:
        level = float(np.median(np.abs(recording.voltage_v[start.onset_index + 1 :])))
        wanted = float(np.asarray(recipe.supply.voltage_v))
        if abs(level - wanted) > _VOLTAGE_TOLERANCE * wanted:
            raise UnusableError(f"the supply is at {level:.4g} V, the model was trained at {wanted:g} V")


def _resampled(recording: Recording, recipe: Recipe, start: Alignment, shift: float) -> FloatArray:
    """Channels of the recipe on its time axis, the onset moved by `shift` of its samples."""
    onset_s = recording.time_s[start.onset_index]
    at = onset_s + shift * recipe.timing.dt_s + recipe.timing.time_s
    columns = {Channel.CURRENT: start.sign * (recording.current_a - start.offset_a)}
    if recording.speed_rad_s is not None:
        columns[Channel.SPEED] = start.sign * recording.speed_rad_s
    return np.stack([np.interp(at, recording.time_s, columns[channel]) for channel in recipe.sensor.channels])
