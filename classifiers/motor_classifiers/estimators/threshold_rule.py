"""Confirmation by thresholds: the paper's Figure 1, tuned on training cases.

A filter for the healthy nominal motor gives a residual. Its means over windows are compared with lower and upper
thresholds; M of the last N windows beyond theirs confirm a fault. Then a bank of filters, one for each fault, is
compared: the best fit is the diagnosis (multiple models: Magill 1965).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import expit, softmax
from sklearn.linear_model import LogisticRegression

from motor_env.common.arrays import number
from motor_env.motor.parameters import FloatArray, require

IntArray = NDArray[np.int64]

EQUAL_WINDOWS = (50, 20, 10, 5, 2, 1)
"""Numbers of equal windows that `tune` tries."""

DOUBLING_WINDOWS = (4, 5, 6, 7, 8)
"""Numbers of windows of doubling length that `tune` tries."""

CONFIRMATIONS = ((1, 1), (2, 2), (2, 3), (3, 3), (3, 5), (5, 5))
"""Pairs (M, N) that `tune` tries with one common threshold."""

MOST_WINDOWS = 3
"""Windows with thresholds of their own."""

LEAST_GAIN = 0.004
"""Least share of the training cases that another threshold must correct."""

UNLIMITED = 1e9
"""Threshold of a side without one, in standard deviations of healthy cases: files hold no infinite numbers."""

LEAST_STATISTIC = 0.3
"""Smallest statistic that is graded; smaller ones are equal."""

_TINY = 1e-12


class ConfirmationResult(NamedTuple):
    """Decisions on n cases.

    Attributes:
        alarm_index: sample of the confirmation, -1 without one, shape (n,).
        class_index: healthy without an alarm, else the best fitting fault, shape (n,).
        probabilities: of the classes, calibrated on the training cases, shape (n, n_classes).
        statistic: largest M-th of N heights, shape (n,); a window's height is its distance from healthy cases over the
            threshold on that side. An alarm is a value above 1.
    """

    alarm_index: IntArray
    class_index: IntArray
    probabilities: FloatArray
    statistic: FloatArray


@dataclass(frozen=True, slots=True)
class ThresholdRule:
    """The tuned rule (paper, Figure 1), made by `ThresholdRule.tune(whitened, labels, healthy)`.

    Attributes:
        healthy_index: position of the healthy class.
        with_spread: whether the windows' variance is a feature, too (for noise faults).
        windows: first sample and end of each window, ordered by ends, shape (n_windows, 2).
        bank_windows: those for the comparison of filters, shape (n_bank_windows, 2).
        needed: M, windows beyond a threshold.
        among: N, consecutive windows.
        healthy_center: median of each feature on healthy training cases, shape (n_windows, n_features).
        healthy_scale: root mean square distance from it.
        lower: thresholds below the center, in units of the scale, < 0; -`UNLIMITED` for none.
        upper: thresholds above it, > 0.
        own_scale: root mean square of each bank feature under the filter of the true class, shape (n_bank_windows,
            n_features).
        prior: share of each class in training, shape (n_classes,).
        temperature: divides the bank's log-likelihoods, as windows are dependent.
        slope: of the log odds of a fault over log(statistic).
        intercept: the log odds at the thresholds.
    """

    healthy_index: int
    with_spread: bool
    windows: IntArray
    bank_windows: IntArray
    needed: int
    among: int
    healthy_center: FloatArray
    healthy_scale: FloatArray
    lower: FloatArray
    upper: FloatArray
    own_scale: FloatArray
    prior: FloatArray
    temperature: float = 1.0
    slope: float = 1.0
    intercept: float = 0.0

    @staticmethod
    def tune(
        whitened: FloatArray,
        labels: IntArray,
        healthy: int,
        *,
        with_spread: bool = False,
        false_alarm_rate: float | None = None,
    ) -> ThresholdRule:
        """Choose windows, thresholds, M, N and weights on the residuals of training cases.

        Candidates are windows that fill the start with one threshold and M of N; and up to `MOST_WINDOWS` windows of a
        grid with own thresholds, of which one confirms. The most correct decisions win.

        Args:
            whitened: residual of each case under each class, shape (n_classes, n_cases, n_samples, n_channels).
            labels: class of each case, shape (n_cases,).
            healthy: position of the healthy class.
            with_spread: whether the windows' variance is a feature, too.
            false_alarm_rate: largest probability of an alarm in a new healthy case (Vovk et al. 2005, ch. 2): half of
                the healthy cases choose the rule, the others scale its thresholds.

        Raises:
            ValueError: no healthy case, or too few for the false-alarm rate.
        """
        at_healthy = np.flatnonzero(labels == healthy)
        _check_rate(false_alarm_rate, len(at_healthy))
        if false_alarm_rate is None:
            chosen = _chosen(whitened, labels, healthy, with_spread, 1.0)
        else:
            held = at_healthy[len(at_healthy) // 2 :]
            others = np.delete(np.arange(len(labels)), held)
            chosen = _chosen(whitened[:, others], labels[others], healthy, with_spread, false_alarm_rate)
            ordered = np.sort(chosen.largest(whitened[healthy, held]))
            at = int(np.ceil((len(ordered) + 1) * (1.0 - false_alarm_rate) - 1e-9)) - 1
            chosen = chosen.scaled(max(float(ordered[at]), _TINY))
        prior = np.bincount(labels, minlength=len(whitened)) / len(labels)
        return replace(chosen, prior=prior).calibrated(whitened, labels)

    def decide(self, whitened: FloatArray) -> ConfirmationResult:
        """Decide on residuals under each class, shape (n_classes, n_cases, n_samples, n_channels)."""
        statistic = self.statistic(
            window_features(whitened[self.healthy_index], self.windows, self.with_spread)
        )
        crossed = statistic > 1.0
        alarm = crossed.any(axis=1)
        # The statistic of position p is complete with window p + N - 1.
        end = self.windows[crossed.argmax(axis=1) + self.among - 1, 1] - 1
        largest = statistic.max(axis=1)
        bank = self._bank_features(whitened)
        fault = _bank_scores(bank, self.own_scale, self.healthy_index).argmax(axis=1)
        return ConfirmationResult(
            alarm_index=np.where(alarm, end, -1).astype(np.int64),
            class_index=np.where(alarm, fault, self.healthy_index).astype(np.int64),
            probabilities=self._probabilities(bank, largest),
            statistic=largest,
        )

    def scaled(self, factor: float) -> Self:
        """Return the rule with all thresholds times a factor."""
        return replace(self, lower=self.lower * factor, upper=self.upper * factor)

    def statistic(self, features: FloatArray) -> FloatArray:
        """Return the M-th largest height of the last N windows, shape (n, n_windows - N + 1)."""
        z = (features - self.healthy_center) / self.healthy_scale
        height = np.maximum(z / self.upper, z / self.lower).max(axis=-1)
        last = sliding_window_view(height, self.among, axis=1)
        statistic: FloatArray = np.sort(last, axis=-1)[..., self.among - self.needed]
        return statistic

    def largest(self, residual: FloatArray) -> FloatArray:
        """Return the largest statistic of each case from its healthy residual, shape (n,)."""
        features = window_features(residual, self.windows, self.with_spread)
        largest: FloatArray = self.statistic(features).max(axis=1)
        return largest

    def _bank_features(self, whitened: FloatArray) -> FloatArray:
        return np.stack([window_features(w, self.bank_windows, self.with_spread) for w in whitened])

    def fault_shares(self, features: FloatArray) -> FloatArray:
        """Return the probability of each fault class given a fault, from bank features, shape (n, n_classes)."""
        score = _bank_scores(features, self.own_scale, self.healthy_index) / self.temperature
        share: FloatArray = softmax(score + np.log(np.maximum(self.prior, _TINY)), axis=1)
        return share

    def _probabilities(self, features: FloatArray, largest: FloatArray) -> FloatArray:
        faulty = expit(self.intercept + self.slope * _evidence(largest))
        probabilities = self.fault_shares(features) * faulty[:, None]
        probabilities[:, self.healthy_index] = 1.0 - faulty
        return probabilities

    def calibrated(self, whitened: FloatArray, labels: IntArray) -> Self:
        """Return the rule with probabilities fitted to training cases (Platt 1999; Guo et al. 2017)."""
        faulty = labels != self.healthy_index
        if not faulty.any():
            return self
        evidence = _evidence(self.largest(whitened[self.healthy_index]))
        # With a weak prior on both weights, which keeps them finite.
        design = np.column_stack([np.ones(len(evidence)), evidence])
        platt = LogisticRegression(C=100.0, fit_intercept=False, solver="newton-cholesky", tol=1e-10)
        intercept, slope = platt.fit(design, faulty).coef_[0].tolist()
        features = self._bank_features(whitened[:, faulty])

        def loss(temperature: float) -> float:
            share = replace(self, temperature=temperature).fault_shares(features)
            return float(-np.log(np.maximum(share[np.arange(faulty.sum()), labels[faulty]], _TINY)).mean())

        temperature = min(np.geomspace(0.5, 200.0, 40).tolist(), key=loss)
        return replace(self, intercept=intercept, slope=slope, temperature=temperature)


def window_features(whitened: FloatArray, windows: IntArray, with_spread: bool) -> FloatArray:
    """Return means, and if wanted variances, of white noise in windows, scaled to standard normal.

    Args:
        whitened: shape (n, n_samples, n_channels).
        windows: first sample and end of each window, shape (n_windows, 2).
        with_spread: whether to add the variance.

    Returns:
        Shape (n, n_windows, n_channels) or (n, n_windows, 2 n_channels).
    """
    edges, places = np.unique(windows, return_inverse=True)
    begin, end = places.reshape(windows.shape).T

    def total(values: FloatArray) -> FloatArray:
        pieces = np.add.reduceat(values[:, : edges[-1]], edges[:-1], axis=1)
        before = np.concatenate([np.zeros_like(pieces[:, :1]), np.cumsum(pieces, axis=1)], axis=1)
        totals: FloatArray = before[:, end] - before[:, begin]
        return totals

    length = np.diff(windows)
    mean = total(whitened) / np.sqrt(length)
    if not with_spread:
        return mean
    squares = total(np.square(whitened)) - np.square(mean)
    spread = (squares - (length - 1)) / np.sqrt(2.0 * (length - 1))
    return np.concatenate([mean, spread], axis=-1)


def _chosen(
    whitened: FloatArray, labels: IntArray, healthy: int, with_spread: bool, rate: float
) -> ThresholdRule:
    layouts = _layouts(whitened.shape[2], with_spread)
    features = np.stack([window_features(w, np.concatenate(layouts), with_spread) for w in whitened])
    parts = np.split(features, np.cumsum([len(windows) for windows in layouts])[:-1], axis=2)
    scales = [_rms(part[labels, np.arange(len(labels))]) for part in parts]
    named = [
        _bank_scores(part, scale, healthy).argmax(axis=1) == labels
        for part, scale in zip(parts, scales, strict=True)
    ]
    bank = int(np.argmax([right.sum() for right in named]))
    at_healthy = labels == healthy
    gain = np.where(at_healthy, -1, named[bank].astype(np.int64))
    spare = int(rate * at_healthy.sum())

    def based(windows: IntArray, features: FloatArray) -> ThresholdRule:
        center = np.median(features[at_healthy], axis=0)
        scale = _rms(features[at_healthy] - center)
        return ThresholdRule(
            healthy, with_spread, windows, layouts[bank], 1, 1, center, scale, -np.ones_like(scale),
            np.ones_like(scale), scales[bank], prior=np.ones(len(whitened)),
        )  # fmt: skip

    candidates: list[tuple[int, ThresholdRule]] = []
    for windows, part in zip(layouts, parts, strict=True):
        base = based(windows, part[healthy])
        for needed, among in CONFIRMATIONS:
            if among <= len(windows):
                rule = replace(base, needed=needed, among=among)
                height = rule.statistic(part[healthy]).max(axis=1)[:, None]
                won, _, threshold = _best_threshold(height, _descending(height), gain, spare)
                candidates.append((won, rule.scaled(threshold)))
    grid = _grid(whitened.shape[2], with_spread)
    on_grid = window_features(whitened[healthy], grid, with_spread)
    candidates.append(_with_own_thresholds(based(grid, on_grid), on_grid, gain, spare))
    return max(candidates, key=itemgetter(0))[1]


def _with_own_thresholds(
    rule: ThresholdRule, features: FloatArray, gain: IntArray, spare: int
) -> tuple[int, ThresholdRule]:
    """Reduce a rule on all grid windows to the few best thresholds; return its gain, too."""
    z = ((features - rule.healthy_center) / rule.healthy_scale).reshape(len(features), -1)
    n_windows, n_features = rule.healthy_scale.shape
    window_of = np.tile(np.repeat(np.arange(n_windows), n_features), 2)
    won, limits = _few_thresholds(np.concatenate([z, -z], axis=1), window_of, gain, spare)
    bounds = np.full(len(window_of), UNLIMITED)
    for side, threshold in limits:
        bounds[side] = min(bounds[side], threshold)
    upper, lower = bounds.reshape(2, n_windows, n_features)
    used = np.unique(window_of[[side for side, _ in limits]]) if limits else np.array([0])
    used = used[np.argsort(rule.windows[used, 1], kind="stable")]
    return won, replace(
        rule, windows=rule.windows[used], healthy_center=rule.healthy_center[used],
        healthy_scale=rule.healthy_scale[used], lower=-lower[used], upper=upper[used],
    )  # fmt: skip


def _check_rate(rate: float | None, n_healthy: int) -> None:
    require(n_healthy > 0, "training cases must hold healthy ones, got none")
    if rate is None:
        return
    number("false_alarm_rate", rate, least=1e-12, below=1.0)
    least = 2 * int(np.ceil(1.0 / rate - 1.0 - 1e-9))
    require(
        n_healthy >= least,
        f"false_alarm_rate {rate:g} needs at least {least} healthy training cases, got {n_healthy}",
    )


def _layouts(n_samples: int, with_spread: bool) -> list[IntArray]:
    layouts = [np.linspace(0, n_samples, count + 1) for count in EQUAL_WINDOWS]
    layouts += [n_samples * np.append(0.0, 2.0 ** np.arange(1 - count, 1)) for count in DOUBLING_WINDOWS]
    windows = [np.array(list(pairwise(np.round(edges).astype(np.int64)))) for edges in layouts]
    return [w for w in windows if np.diff(w).min() >= 1 + with_spread]


def _grid(n_samples: int, with_spread: bool) -> IntArray:
    """Return windows between any two edges (tenths of the start, and doublings), shape (n_windows, 2)."""
    shares = np.concatenate([np.arange(11) / 10.0, 2.0 ** -np.arange(1, 7)])
    edges = np.unique(np.round(n_samples * shares).astype(np.int64))
    return np.array([(begin, end) for begin in edges for end in edges if end > begin + with_spread])


def _rms(features: FloatArray) -> FloatArray:
    scale: FloatArray = np.sqrt(np.square(features).mean(axis=0))
    return np.maximum(scale, 1e-6)


def _bank_scores(features: FloatArray, own_scale: FloatArray, healthy: int) -> FloatArray:
    """Return the log-likelihood of each fault, shape (n, n_classes), for independent windows."""
    score: FloatArray = -0.5 * np.square(features / own_scale).sum(axis=(-2, -1)).T
    score[:, healthy] = -np.inf
    return score


def _evidence(largest: FloatArray) -> FloatArray:
    evidence: FloatArray = np.log(np.maximum(largest, LEAST_STATISTIC))
    return evidence


def _descending(heights: FloatArray) -> IntArray:
    return np.argsort(-heights, axis=0, kind="stable")


def _best_threshold(
    heights: FloatArray, order: IntArray, gain: IntArray, spare: int
) -> tuple[int, int, float]:
    """Return gain, column and value of the best single threshold, halfway between two cases."""
    ordered = np.take_along_axis(heights, order, axis=0)
    gains = gain[order]
    # After row r the cases up to r alarm, the others do not.
    won = gains.cumsum(axis=0)[:-1]
    cut = (ordered[:-1] > 0.0) & (ordered[:-1] > ordered[1:]) & ((gains < 0).cumsum(axis=0)[:-1] <= spare)
    if not cut.any():
        return 0, 0, max(float(ordered[0, 0]), _TINY)
    row, column = np.unravel_index(np.where(cut, won, -len(gain) - 1).argmax(), won.shape)
    threshold = 0.5 * (ordered[row, column] + max(ordered[row + 1, column], 0.0))
    return int(won[row, column]), int(column), float(threshold)


def _few_thresholds(
    heights: FloatArray, window_of: IntArray, gain: IntArray, spare: int
) -> tuple[int, list[tuple[int, float]]]:
    """Choose thresholds on few windows: add the best one at a time, then choose each anew while that gains."""
    order = _descending(heights)
    limits: list[tuple[int, float]] = []
    won = 0

    def one_more(others: list[tuple[int, float]]) -> tuple[int, list[tuple[int, float]]]:
        alarms = np.zeros(len(heights), dtype=np.bool_)
        for column, threshold in others:
            alarms |= heights[:, column] > threshold
        used = {window_of[column] for column, _ in others}
        free = (
            np.isin(window_of, list(used)) if len(used) == MOST_WINDOWS else np.ones_like(window_of, np.bool_)
        )
        columns = np.flatnonzero(free)
        left = spare - int((gain[alarms] < 0).sum())
        more, column, threshold = _best_threshold(
            heights[:, columns], order[:, columns], np.where(alarms, 0, gain), left
        )
        return int(gain[alarms].sum()) + more, [*others, (int(columns[column]), threshold)]

    while len(limits) < 2 * MOST_WINDOWS:
        total, more = one_more(limits)
        swapped = True
        while swapped:
            swapped = False
            for out in range(len(more)):
                again, other = one_more(more[:out] + more[out + 1 :])
                if again > total:
                    total, more, swapped = again, other, True
        if total <= won + LEAST_GAIN * len(gain):
            break
        won, limits = total, more
    return won, limits
