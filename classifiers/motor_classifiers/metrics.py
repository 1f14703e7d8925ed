"""Scores of decisions and probabilities, each with a bootstrap interval over the same resampled cases.

Every interval resamples whole test cases (Efron 1979), and every method sees the same resamples, so differences are
compared in pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.faults import HEALTHY
from motor_env.parameters import FloatArray

IntArray = NDArray[np.int64]


class Interval(NamedTuple):
    """A figure with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


class Classes(NamedTuple):
    """What the metrics need to know of the classes, each of shape (n_classes,).

    Attributes:
        names: labels.
        kinds: healthy, or the fault's kind.
        severities: level of the fault, 0 for healthy.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    severities: FloatArray


def resamples(n_cases: int, n_resamples: int, generator: np.random.Generator) -> FloatArray:
    """How often each case stands in each resample, shape (n_resamples, n_cases), float32."""
    weights = generator.multinomial(n_cases, np.full(n_cases, 1.0 / n_cases), size=n_resamples)
    return weights.astype(np.float32)


def confusion(true: IntArray, decided: IntArray, n_classes: int) -> IntArray:
    """Counts, true classes in rows and decided ones in columns, shape (n_classes, n_classes)."""
    counts = np.zeros((n_classes, n_classes), dtype=np.int64)
    np.add.at(counts, (true, decided), 1)
    return counts


def _confusions(true: IntArray, decided: IntArray, n_classes: int, weights: FloatArray) -> FloatArray:
    """Weighted confusion of each resample, shape (n_resamples, n_classes, n_classes)."""
    cells = np.zeros((len(true), n_classes * n_classes), dtype=np.float32)
    cells[np.arange(len(true)), true * n_classes + decided] = 1.0
    counts: FloatArray = (weights @ cells).astype(np.float64)
    return counts.reshape(-1, n_classes, n_classes)


def scores_of(counts: FloatArray, classes: Classes) -> dict[str, FloatArray]:
    """Scores of confusion matrices of shape (..., n_classes, n_classes); each of shape (...).

    accuracy: share of right decisions. macro_f1: mean of the classes' F1. false_alarm_rate: healthy cases called
    faulty. missed_detection_rate: faulty cases called healthy. level_error: mean absolute difference of the decided
    class's severity from the true one, where the fault's kind is right, in points. recall_NAME: of each class. A rate
    whose cases are missing in a resample is nan there.
    """
    diagonal = np.diagonal(counts, axis1=-2, axis2=-1)
    actual, called = counts.sum(axis=-1), counts.sum(axis=-2)
    kinds = np.array(classes.kinds)
    healthy = kinds == HEALTHY
    same_fault = (kinds[:, None] == kinds) & ~healthy[:, None]
    distance = 100.0 * np.abs(classes.severities[:, None] - classes.severities)
    with np.errstate(invalid="ignore", divide="ignore"):
        f1 = np.where(actual + called > 0.0, 2.0 * diagonal / (actual + called), np.nan)
        right_kind = counts * same_fault
        scores = {
            "accuracy": diagonal.sum(axis=-1) / actual.sum(axis=-1),
            "macro_f1": np.nanmean(f1, axis=-1),
            "false_alarm_rate": counts[..., healthy, :][..., ~healthy].sum(axis=(-2, -1))
            / actual[..., healthy].sum(axis=-1),
            "missed_detection_rate": counts[..., ~healthy, :][..., healthy].sum(axis=(-2, -1))
            / actual[..., ~healthy].sum(axis=-1),
            "level_error_points": (right_kind * distance).sum(axis=(-2, -1)) / right_kind.sum(axis=(-2, -1)),
        }
        for index, name in enumerate(classes.names):
            scores[f"recall_{name}"] = diagonal[..., index] / actual[..., index]
    return scores


def score_intervals(
    true: IntArray, decided: IntArray, classes: Classes, weights: FloatArray
) -> dict[str, Interval]:
    """Every score of decisions with its interval.

    Args:
        true: class index of each case, shape (n_cases,).
        decided: decided class index, shape (n_cases,).
        classes: names, kinds and levels.
        weights: resamples of the cases, from `resamples`.
    """
    n_classes = len(classes.names)
    value = scores_of(confusion(true, decided, n_classes).astype(np.float64), classes)
    spread = scores_of(_confusions(true, decided, n_classes, weights), classes)
    return {name: _interval(float(value[name]), spread[name]) for name in value}


def mean_interval(values: FloatArray, weights: FloatArray) -> Interval:
    """Mean of a figure over the cases, with its interval; `values` of shape (n_cases,)."""
    return _interval(float(values.mean()), (weights @ values) / weights.sum(axis=1))


def _interval(value: float, spread: FloatArray) -> Interval:
    known = spread[np.isfinite(spread)]
    if not len(known):
        return Interval(value, float("nan"), float("nan"))
    low, high = np.quantile(known, (0.025, 0.975))
    return Interval(value, float(low), float(high))


class PairedExcess(NamedTuple):
    """How far a method's expected accuracy lies above the limit's on the same cases.

    Attributes:
        difference: mean over the cases of the method's hit less the limit's hit.
        p_value: of the hypothesis that the method is no better than the limit's own decisions, by the exact
            one-sided sign test on the cases where one of them is right and the other is not (McNemar 1947).
        expected_gap: mean posterior probability of the limit's decision less that of the method's: the accuracy
            that the method gives away, without the noise of the labels; never negative.
    """

    difference: float
    p_value: float
    expected_gap: float


def paired_excess(true: IntArray, decided: IntArray, posterior: FloatArray) -> PairedExcess:
    """Compare decisions with the Bayes-optimal ones on the same cases.

    Args:
        true: class index of each case, shape (n_cases,).
        decided: the method's decisions, shape (n_cases,).
        posterior: Bayes-optimal probabilities, shape (n_cases, n_classes).
    """
    from scipy.stats import binom

    best = posterior.argmax(axis=1)
    ours, limits = decided == true, best == true
    wins, losses = int((ours & ~limits).sum()), int((~ours & limits).sum())
    p_value = float(binom.sf(wins - 1, wins + losses, 0.5)) if wins else 1.0
    rows = np.arange(len(true))
    gap = posterior[rows, best] - posterior[rows, decided]
    return PairedExcess(float(ours.mean() - limits.mean()), p_value, float(gap.mean()))
