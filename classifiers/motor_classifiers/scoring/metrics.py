"""Scores of decisions with bootstrap intervals, paired comparison, and calibration of probabilities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binom

from motor_classifiers.scoring.task import DrawnTask
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

BIN_EDGES: FloatArray = np.linspace(0.0, 1.0, 16)
"""Edges of the bins of confidence: fifteen of equal width (Guo et al. 2017)."""

_SMALLEST = 1e-15  # a probability of 0 for what happened costs this much, not infinity


class Reliability(NamedTuple):
    """Accuracy of decisions by their probability.

    Attributes:
        confidence: mean largest probability in each bin, nan if empty, shape (n_bins,).
        accuracy: share of right decisions in each bin, nan if empty.
        n_cases: cases in each bin.
    """

    confidence: FloatArray
    accuracy: FloatArray
    n_cases: FloatArray


class CalibrationScores(NamedTuple):
    """Calibration of probabilities.

    Attributes:
        accuracy: share of cases whose most probable class is the true one.
        ece: expected calibration error: mean over the cases of |accuracy - confidence| in their bin (Naeini et al.
            2015).
        brier: mean squared distance of the probabilities from the truth, 0 to 2 (Brier 1950).
        log_loss: mean negative logarithm of the true class's probability, in nats.
        reliability: by bins of confidence.
    """

    accuracy: float
    ece: float
    brier: float
    log_loss: float
    reliability: Reliability


def reliability(probabilities: FloatArray, truth: ArrayLike) -> Reliability:
    """Compute confidence and accuracy in fixed bins of the largest probability.

    Args:
        probabilities: shape (n_cases, n_classes).
        truth: true class of each case as a column of `probabilities`, shape (n_cases,).
    """
    labels = np.asarray(truth)
    require(
        probabilities.ndim == 2 and labels.shape == (len(probabilities),),
        f"probabilities (n_cases, n_classes) and truth (n_cases,) must fit, "
        f"got {probabilities.shape} and {labels.shape}",
    )
    confidence = probabilities.max(axis=1)
    right = probabilities.argmax(axis=1) == labels
    n_bins = len(BIN_EDGES) - 1
    index = np.clip(np.searchsorted(BIN_EDGES, confidence, side="left") - 1, 0, n_bins - 1)
    count = np.bincount(index, minlength=n_bins).astype(np.float64)
    filled = np.where(count > 0.0, count, np.nan)
    return Reliability(
        np.bincount(index, weights=confidence, minlength=n_bins) / filled,
        np.bincount(index, weights=right, minlength=n_bins) / filled,
        count,
    )


def calibration_scores(probabilities: FloatArray, truth: ArrayLike) -> CalibrationScores:
    """Compute all measures; arguments as `reliability`."""
    binned = reliability(probabilities, truth)
    labels = np.asarray(truth)
    rows = np.arange(len(labels))
    happened = np.zeros_like(probabilities)
    happened[rows, labels] = 1.0
    gap = np.nan_to_num(np.abs(binned.accuracy - binned.confidence))
    return CalibrationScores(
        accuracy=float((probabilities.argmax(axis=1) == labels).mean()),
        ece=float((gap * binned.n_cases).sum() / len(labels)),
        brier=float(np.square(probabilities - happened).sum(axis=1).mean()),
        log_loss=float(-np.log(np.maximum(probabilities[rows, labels], _SMALLEST)).mean()),
        reliability=binned,
    )


IntArray = NDArray[np.int64]

N_RESAMPLES = 2000
ENDS = (0.025, 0.975)
"""Quantiles of every interval's ends."""

WINDING = frozenset({FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT})
BEARING = frozenset({FaultKind.BEARING})
"""Kinds of the sub-scores."""


class Score(NamedTuple):
    """Score with its 95 % bootstrap interval (percentile method: Efron & Tibshirani 1993, ch. 13)."""

    value: float
    low: float
    high: float


class Scores(NamedTuple):
    """Scores of one method; rates are shares, 0 to 1.

    Attributes:
        accuracy: share of right decisions.
        macro_f1: mean over the classes of F1.
        recall: of each class, in the recipe's order.
        false_alarm_rate: share of healthy motors called faulty.
        missed_detection_rate: share of faulty motors called healthy.
        level_error: mean absolute error of the severity, 0.01 for a point; for a wrong kind both severities count.
        winding: balanced accuracy of winding fault or none.
        bearing: the same for bearing faults.
        level: level accuracy, given the right kind of fault.
        confusion: cases by true (row) and decided (column) class.
    """

    accuracy: Score
    macro_f1: Score
    recall: tuple[Score, ...]
    false_alarm_rate: Score
    missed_detection_rate: Score
    level_error: Score
    winding: Score
    bearing: Score
    level: Score
    confusion: IntArray


def confusion_matrices(truth: IntArray, decided: IntArray, n_classes: int, weights: FloatArray) -> FloatArray:
    """Return confusion matrices (n_resamples, n_classes, n_classes) for weights (n_resamples, n_cases)."""
    cells = truth * n_classes + decided
    order = np.argsort(cells, kind="stable")
    filled, begins = np.unique(cells[order], return_index=True)
    matrices = np.zeros((len(weights), n_classes * n_classes))
    matrices[:, filled] = np.add.reduceat(weights[:, order], begins, axis=1)
    return matrices.reshape(len(weights), n_classes, n_classes)


def level_distance(recipe: Recipe) -> FloatArray:
    """Return |decided - true| severity between classes, summed over kinds, shape (n_classes, n_classes)."""
    kinds = sorted({c.label_kind for c in recipe.classes} - {HEALTHY})
    severity = np.array([[c.severity * (c.label_kind == kind) for kind in kinds] for c in recipe.classes])
    distance: FloatArray = np.abs(severity[:, None] - severity[None]).sum(axis=-1)
    return distance


def resampling_weights(n_cases: int, random_state: int, groups: IntArray | None = None) -> FloatArray:
    """Return bootstrap counts of the cases, shape (1 + N_RESAMPLES, n_cases); the first row is all 1.

    The same weights for all methods make them comparable in pairs.

    Args:
        n_cases: number of cases.
        random_state: of the draws.
        groups: motor of each case, shape (n_cases,): whole motors are drawn; by default each case is a motor.
    """
    motors = np.arange(n_cases) if groups is None else np.unique(groups, return_inverse=True)[1]
    n_motors = int(motors.max()) + 1
    rng = np.random.default_rng(random_state)
    drawn = rng.multinomial(n_motors, np.full(n_motors, 1.0 / n_motors), size=N_RESAMPLES)
    return np.vstack([np.ones((1, n_cases)), drawn[:, motors]])


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    ratio: FloatArray = np.divide(part, whole, out=np.full(np.shape(part), np.nan), where=whole > 0.0)
    return ratio


def interval(values: FloatArray) -> Score:
    """Return a figure and its interval from its values under bootstrap weights, the first being the figure."""
    rest = values[1:][np.isfinite(values[1:])]
    if not np.isfinite(values[0]) or not len(rest):
        return Score(float("nan"), float("nan"), float("nan"))
    low, high = np.quantile(rest, ENDS)
    return Score(float(values[0]), float(low), float(high))


def scores(recipe: Recipe, truth: IntArray, decided: IntArray, weights: FloatArray) -> Scores:
    """Score decisions.

    Args:
        recipe: for the classes.
        truth: true class of each case as an index into `recipe.classes`, shape (n_cases,).
        decided: decided class, likewise.
        weights: from `resampling_weights`.
    """
    n_classes = len(recipe.classes)
    matrices = confusion_matrices(truth, decided, n_classes, weights)
    total = matrices.sum(axis=(1, 2))
    hits = np.diagonal(matrices, axis1=1, axis2=2)
    actual, called = matrices.sum(axis=2), matrices.sum(axis=1)
    recall = _ratio(hits, actual)
    f1 = np.nan_to_num(_ratio(2.0 * hits, actual + called))
    healthy = np.array([c.kind is None for c in recipe.classes])
    kinds = np.array([c.label_kind for c in recipe.classes])
    same_kind = (kinds[:, None] == kinds) & ~healthy
    return Scores(
        accuracy=interval(hits.sum(axis=1) / total),
        macro_f1=interval(f1.mean(axis=1)),
        recall=tuple(interval(recall[:, n]) for n in range(n_classes)),
        false_alarm_rate=interval(_share_called(matrices, healthy, ~healthy)),
        missed_detection_rate=interval(_share_called(matrices, ~healthy, healthy)),
        level_error=interval((matrices * level_distance(recipe)).sum(axis=(1, 2)) / total),
        winding=interval(_balanced_accuracy(matrices, _classes_with(recipe, WINDING))),
        bearing=interval(_balanced_accuracy(matrices, _classes_with(recipe, BEARING))),
        level=interval(_ratio(hits[:, ~healthy].sum(axis=1), (matrices * same_kind).sum(axis=(1, 2)))),
        confusion=matrices[0].astype(np.int64),
    )


def root_mean_square(errors: FloatArray, weights: FloatArray) -> Score:
    """Return the root mean square of errors of shape (n_cases,)."""
    return interval(np.sqrt(weights @ np.square(errors) / weights.sum(axis=1)))


def _share_called(matrices: FloatArray, true: NDArray[np.bool_], called: NDArray[np.bool_]) -> FloatArray:
    """Return the share of cases of some classes that are called others, shape (n_resamples,)."""
    cases = matrices[:, true]
    return _ratio(cases[:, :, called].sum(axis=(1, 2)), cases.sum(axis=(1, 2)))


def _classes_with(recipe: Recipe, kinds: frozenset[FaultKind]) -> NDArray[np.bool_]:
    return np.array([any(part.kind in kinds for part in c.parts) for c in recipe.classes])


def _balanced_accuracy(matrices: FloatArray, of_group: NDArray[np.bool_]) -> FloatArray:
    """Return the balanced accuracy of "of this group or not", shape (n_resamples,); nan for a single group."""
    sensitivity = _share_called(matrices, of_group, of_group)
    return 0.5 * (sensitivity + _share_called(matrices, ~of_group, ~of_group))


class Comparison(NamedTuple):
    """Comparison of two methods on the same cases.

    Attributes:
        difference: metric of the first minus the second, with its paired bootstrap interval.
        only_first: cases that cost the first less (in class tasks: only it is right).
        only_second: the opposite.
        p_above: p-value for the first being better (exact one-sided McNemar test, 1947).
    """

    difference: Score
    only_first: int
    only_second: int
    p_above: float


def compare(task: DrawnTask, first: FloatArray, second: FloatArray, weights: FloatArray) -> Comparison:
    """Compare costs of the same cases in pairs, both of shape (n_cases,)."""
    only_first, only_second = int((first < second).sum()), int((second < first).sum())
    p_above = float(binom.sf(only_first - 1, only_first + only_second, 0.5)) if only_first else 1.0
    difference = interval(task.figures(first, weights) - task.figures(second, weights))
    return Comparison(difference, only_first, only_second, p_above)
