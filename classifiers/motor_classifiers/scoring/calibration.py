"""Whether probabilities mean what they say: reliability, expected calibration error, Brier score, log-loss.

All are measured on the same cases and in the same bins for a method and for the limit, so that they can be compared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.motor.parameters import FloatArray, require

BIN_EDGES: FloatArray = np.linspace(0.0, 1.0, 16)
"""Edges of the bins of confidence, for every method and for the limit: fifteen of equal width (Guo et al. 2017)."""

_SMALLEST = 1e-15  # a probability of 0 for what happened costs this much, not infinity


class Reliability(NamedTuple):
    """Decisions by the probability that was given to them.

    Attributes:
        confidence: mean largest probability in each bin, nan in an empty one, shape (n_bins,).
        accuracy: share of right decisions in each bin, nan in an empty one.
        n_cases: cases in each bin.
    """

    confidence: FloatArray
    accuracy: FloatArray
    n_cases: FloatArray


class CalibrationScores(NamedTuple):
    """How far probabilities are from what happens.

    Attributes:
        accuracy: share of cases whose most probable class is the true one.
        ece: expected calibration error: mean over the cases of |accuracy - confidence| in their bin (Naeini et al.
            2015). Even the true posterior's is not 0 on finitely many cases: compare with the limit's.
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
    """Confidence and accuracy in fixed bins of the largest probability.

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
    """All measures at once; arguments as of `reliability`."""
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
