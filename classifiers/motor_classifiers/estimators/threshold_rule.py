"""The rule of confirmation by thresholds: the paper's Figure 1, tuned on training cases and on nothing else.

A filter that believes in the healthy nominal motor gives a residual. Its means over windows are compared with a
threshold; M of the last N windows beyond it confirm a fault. Then the residuals of a bank of filters, one for each
fault the recipe knows, are compared, and the fault whose filter fits best is the diagnosis (paper, Figure 1; multiple
models: Magill 1965). With tolerances the residual of a healthy motor is neither white nor small, so the thresholds
and the weights of the windows come from training cases: the rule stays one of thresholds, it learns no directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NamedTuple, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import expit, softmax
from sklearn.linear_model import LogisticRegression

from motor_env.motor.parameters import FloatArray, require

IntArray = NDArray[np.int64]

EQUAL_WINDOWS = (50, 20, 10, 5, 2, 1)
"""Numbers of equal windows that `tune` tries."""

DOUBLING_WINDOWS = (4, 5, 6, 7, 8)
"""Numbers of windows that double in length that `tune` tries: a start is quick at first and slow later."""

CONFIRMATIONS = ((1, 1), (2, 2), (2, 3), (3, 3), (3, 5), (5, 5))
"""Pairs (M, N) that `tune` tries."""


class ConfirmationResult(NamedTuple):
    """Decisions on n cases.

    Attributes:
        alarm_index: sample at which the fault was confirmed, -1 where none was, shape (n,).
        class_index: decided class, shape (n,): the healthy class without an alarm, the best fitting fault with one.
        probabilities: of the classes, calibrated on the training cases, shape (n, n_classes). They are graded where
            `class_index` is the rule's hard decision: near the threshold the two may disagree.
        statistic: largest statistic of each case over its threshold, shape (n,): an alarm is a value above 1.
    """

    alarm_index: IntArray
    class_index: IntArray
    probabilities: FloatArray
    statistic: FloatArray


@dataclass(frozen=True, slots=True)
class ThresholdRule:
    """The tuned rule (paper, Figure 1). Make one with `ThresholdRule.tune(whitened, labels, healthy)`.

    Attributes:
        healthy_index: position of the healthy class.
        with_spread: whether the windows' variance is a feature beside their mean (a recipe with noise faults).
        edges: first sample of each window, and the end of the last one.
        needed: M, the windows that must lie beyond the threshold.
        among: N, the windows among which they are counted.
        threshold: on the standardised window features.
        healthy_scale: root mean square of each feature on healthy training cases, shape (n_windows, n_features).
        own_scale: the same under the filter of the case's own class, all classes together.
        prior: share of each class in training, shape (n_classes,).
        temperature: divides the bank's log-likelihoods, whose windows are not independent.
        slope: how the log odds of a fault grow with log(statistic / threshold).
        intercept: the log odds at the threshold.
    """

    healthy_index: int
    with_spread: bool
    edges: tuple[int, ...]
    needed: int
    among: int
    threshold: float
    healthy_scale: FloatArray
    own_scale: FloatArray
    prior: FloatArray
    temperature: float = 1.0
    slope: float = 1.0
    intercept: float = 0.0

    @classmethod
    def tune(
        cls,
        whitened: FloatArray,
        labels: IntArray,
        healthy: int,
        *,
        with_spread: bool = False,
        false_alarm_rate: float | None = None,
    ) -> Self:
        """Choose window, M, N, threshold and weights on the residuals of training cases.

        Args:
            whitened: residual of each case under each class, shape (n_classes, n_cases, n_samples, n_channels).
            labels: class of each case, shape (n_cases,).
            healthy: position of the healthy class.
            with_spread: whether the windows' variance is a feature beside their mean.
            false_alarm_rate: share of healthy cases that may alarm. By default the threshold with most correct
                decisions on the training cases is taken.

        Raises:
            ValueError: no healthy case, or too few of them to tell the wanted false-alarm rate.
        """
        _check_rate(false_alarm_rate, int((labels == healthy).sum()))
        prior = np.bincount(labels, minlength=len(whitened)) / len(labels)
        candidates: list[tuple[float, Self]] = []
        for edges, pairs in _choices(whitened.shape[2], with_spread):
            features = np.stack([window_features(w, edges, with_spread) for w in whitened])
            base = cls(
                healthy, with_spread, edges, 1, 1, 1.0,
                healthy_scale=_rms(features[healthy, labels == healthy]),
                own_scale=_rms(features[labels, np.arange(len(labels))]),
                prior=prior,
            )  # fmt: skip
            fits = base._best_fault(features) == labels
            for needed, among in pairs:
                candidate = replace(base, needed=needed, among=among)
                largest = candidate.statistic(features[healthy]).max(axis=1)
                threshold, score = _choose_threshold(largest, labels == healthy, fits, false_alarm_rate)
                candidates.append((score, replace(candidate, threshold=threshold)))
        return max(candidates, key=itemgetter(0))[1].calibrated(whitened, labels)

    def decide(self, whitened: FloatArray) -> ConfirmationResult:
        """Decide on residuals under each class, shape (n_classes, n_cases, n_samples, n_channels)."""
        features = self._features(whitened)
        statistic = self.statistic(features[self.healthy_index])
        crossed = statistic > self.threshold
        alarm = crossed.any(axis=1)
        # The statistic of position p is complete with window p + N - 1.
        end = np.array(self.edges)[crossed.argmax(axis=1) + self.among] - 1
        largest = statistic.max(axis=1) / self.threshold
        fault = self._best_fault(features)
        return ConfirmationResult(
            alarm_index=np.where(alarm, end, -1).astype(np.int64),
            class_index=np.where(alarm, fault, self.healthy_index).astype(np.int64),
            probabilities=self._probabilities(features, largest),
            statistic=largest,
        )

    def _features(self, whitened: FloatArray) -> FloatArray:
        return np.stack([window_features(w, self.edges, self.with_spread) for w in whitened])

    def statistic(self, features: FloatArray) -> FloatArray:
        """M-th largest of the last N windows' standardised features, shape (n, n_windows - N + 1)."""
        height = np.abs(features / self.healthy_scale).max(axis=-1)
        last = sliding_window_view(height, self.among, axis=1)
        statistic: FloatArray = np.sort(last, axis=-1)[..., self.among - self.needed]
        return statistic

    def _log_likelihood(self, features: FloatArray) -> FloatArray:
        """Log-likelihood of each class for each case, shape (n, n_classes), the windows taken as independent."""
        log_likelihood: FloatArray = -0.5 * np.square(features / self.own_scale).sum(axis=(-2, -1)).T
        return log_likelihood

    def _best_fault(self, features: FloatArray) -> IntArray:
        score = self._log_likelihood(features)
        score[:, self.healthy_index] = -np.inf
        best: IntArray = score.argmax(axis=1).astype(np.int64)
        return best

    def fault_shares(self, features: FloatArray) -> FloatArray:
        """Probability of each fault class given that there is one, shape (n, n_classes)."""
        score = self._log_likelihood(features) / self.temperature + np.log(np.maximum(self.prior, 1e-12))
        score[:, self.healthy_index] = -np.inf
        share: FloatArray = softmax(score, axis=1)
        return share

    def _probabilities(self, features: FloatArray, statistic: FloatArray) -> FloatArray:
        faulty = expit(self.intercept + self.slope * np.log(np.maximum(statistic, 1e-12)))
        probabilities = self.fault_shares(features) * faulty[:, None]
        probabilities[:, self.healthy_index] = 1.0 - faulty
        return probabilities

    def calibrated(self, whitened: FloatArray, labels: IntArray) -> Self:
        """The rule with its probabilities fitted to training cases (Platt 1999; temperature: Guo et al. 2017)."""
        features = self._features(whitened)
        faulty = labels != self.healthy_index
        if not faulty.any():
            return self
        largest = self.statistic(features[self.healthy_index]).max(axis=1) / self.threshold
        # With a weak prior on both weights, which keeps them finite.
        design = np.column_stack([np.ones(len(largest)), np.log(np.maximum(largest, 1e-12))])
        platt = LogisticRegression(C=100.0, fit_intercept=False, solver="newton-cholesky", tol=1e-10)
        intercept, slope = platt.fit(design, faulty).coef_[0].tolist()

        def loss(temperature: float) -> float:
            share = replace(self, temperature=temperature).fault_shares(features[:, faulty])
            return float(-np.log(np.maximum(share[np.arange(faulty.sum()), labels[faulty]], 1e-12)).mean())

        temperature = min(np.geomspace(0.5, 200.0, 40).tolist(), key=loss)
        return replace(self, intercept=intercept, slope=slope, temperature=temperature)


def window_features(whitened: FloatArray, edges: tuple[int, ...], with_spread: bool) -> FloatArray:
    """Mean, and if wanted the variance, of white noise in windows, scaled to standard normal (Mehra & Peschon 1971).

    Args:
        whitened: shape (n, n_samples, n_channels).
        edges: first sample of each window, and the end of the last one.
        with_spread: whether to add the variance.

    Returns:
        Shape (n, n_windows, n_channels) or (n, n_windows, 2 n_channels).
    """
    length = np.diff(edges)[:, None]
    total = np.add.reduceat(whitened, edges[:-1], axis=1)
    mean = total / np.sqrt(length)
    if not with_spread:
        return mean
    squares = np.add.reduceat(np.square(whitened), edges[:-1], axis=1) - np.square(mean)
    spread = (squares - (length - 1)) / np.sqrt(2.0 * (length - 1))
    return np.concatenate([mean, spread], axis=-1)


def _check_rate(rate: float | None, n_healthy: int) -> None:
    require(n_healthy > 0, "training cases must hold healthy ones, got none")
    if rate is None:
        return
    require(0.0 < rate < 1.0, f"false_alarm_rate must lie between 0 and 1, got {rate:g}")
    least = int(np.ceil(1.0 / rate - 1.0 - 1e-9))
    require(
        n_healthy >= least,
        f"false_alarm_rate {rate:g} needs at least {least} healthy training cases, got {n_healthy}",
    )


def _choices(n_samples: int, with_spread: bool) -> Iterator[tuple[tuple[int, ...], list[tuple[int, int]]]]:
    """Edges of windows, and the pairs (M, N) that fit their number."""
    shortest = 2 if with_spread else 1
    layouts = [np.linspace(0, n_samples, count + 1) for count in EQUAL_WINDOWS]
    layouts += [n_samples * np.append(0.0, 2.0 ** np.arange(1 - count, 1)) for count in DOUBLING_WINDOWS]
    for layout in layouts:
        edges = tuple(int(edge) for edge in np.round(layout))
        if min(np.diff(edges)) >= shortest:
            yield edges, [(m, n) for m, n in CONFIRMATIONS if n < len(edges)]


def _rms(features: FloatArray) -> FloatArray:
    scale: FloatArray = np.sqrt(np.square(features).mean(axis=0))
    return np.maximum(scale, 1e-6)


def _choose_threshold(
    largest: FloatArray, healthy: NDArray[np.bool_], fits: NDArray[np.bool_], rate: float | None
) -> tuple[float, float]:
    """Threshold on the cases' largest statistics, and the share of correct decisions with it."""
    if rate is not None:
        # The order statistic that a new healthy case exceeds with probability <= rate (Vovk et al. 2005, ch. 2).
        ordered = np.sort(largest[healthy])
        threshold = float(ordered[int(np.ceil((len(ordered) + 1) * (1.0 - rate) - 1e-9)) - 1])
        return threshold, float(np.where(healthy, largest <= threshold, fits & (largest > threshold)).mean())
    order = np.argsort(largest, kind="stable")
    right_below = np.cumsum(healthy[order])
    right_above = (fits & ~healthy)[order][::-1].cumsum()[::-1]
    # After position p of the sorted cases: those up to p are called healthy, the others faulty.
    correct = right_below[:-1] + right_above[1:]
    at = int(np.argmax(correct))
    threshold = 0.5 * float(largest[order[at]] + largest[order[at + 1]])
    return threshold, float(correct[at]) / len(largest)
