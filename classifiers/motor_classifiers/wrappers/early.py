"""Early verdicts: a rule that stops once the largest probability is at least 1 - error.

With calibrated probabilities, at most that share of the stopped cases is wrong (Wald 1947; Baum & Veeravalli 1994).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta
from sklearn.base import BaseEstimator, MetaEstimatorMixin, clone
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import ProbabilityClassifier, flat_cases, labelled_cases
from motor_classifiers.wrappers.fitted import unfitted
from motor_env.common.arrays import number, shown, wholes
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

_SHARES = (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)


class Stopped(NamedTuple):
    """Verdicts of a stopping rule.

    Attributes:
        decided: column of the most probable class at the stop or the end, shape (n_cases,).
        moment: row of that moment.
        sure: whether the rule stopped; else the verdict is the best guess at the end.
    """

    decided: NDArray[np.int64]
    moment: NDArray[np.int64]
    sure: NDArray[np.bool_]


def stop_when_sure(probabilities: FloatArray, error: float) -> Stopped:
    """Stop each case once a class has a probability of at least 1 - error.

    Args:
        probabilities: at each moment, shape (n_moments, n_cases, n_classes).
        error: wanted share of wrong verdicts among stopped cases.
    """
    require(0.0 < error < 1.0, f"error must lie between 0 and 1, got {error:g}")
    reached = probabilities.max(axis=2) >= 1.0 - error
    sure = reached.any(axis=0)
    moment = np.where(sure, reached.argmax(axis=0), len(probabilities) - 1)
    decided = probabilities[moment, np.arange(len(moment))].argmax(axis=1)
    return Stopped(decided, moment, sure)


class StoppingScore(NamedTuple):
    """Error and time of a stopping rule on test cases.

    Attributes:
        error: share of wrong verdicts among stopped cases.
        error_low: lower end of its 95 % interval (Clopper & Pearson 1934).
        error_high: upper end.
        stopped: share of the cases that stopped.
        accuracy: share of right verdicts of all cases, best guesses included.
        mean_time_s: mean time of the verdict over all cases.
    """

    error: float
    error_low: float
    error_high: float
    stopped: float
    accuracy: float
    mean_time_s: float


def stopping_score(stopped: Stopped, truth: ArrayLike, time_s: ArrayLike) -> StoppingScore:
    """Score verdicts.

    Args:
        stopped: of `stop_when_sure`.
        truth: true column of each case, shape (n_cases,).
        time_s: time of each moment, shape (n_moments,).
    """
    wrong = stopped.decided != np.asarray(truth)
    count, misses = int(stopped.sure.sum()), int((wrong & stopped.sure).sum())
    low = float(beta.ppf(0.025, misses, count - misses + 1)) if misses else 0.0
    high = float(beta.ppf(0.975, misses + 1, count - misses)) if misses < count else 1.0
    return StoppingScore(
        misses / count if count else float("nan"),
        low,
        high,
        count / len(wrong),
        float(1.0 - wrong.mean()),
        float(np.asarray(time_s)[stopped.moment].mean()),
    )


def limit_by_samples(recipe: Recipe, measurements: ArrayLike, samples: ArrayLike) -> FloatArray:
    """Return the Bayes-optimal posterior from the first samples, shape (n_moments, n_cases, n_classes)."""
    measured = np.asarray(measurements)
    return np.stack([class_probabilities(recipe, measured[..., :count]) for count in np.asarray(samples)])


def shortened(estimator: BaseEstimator, n_samples: int) -> BaseEstimator:
    """Return an unfitted estimator for starts cut to `n_samples`."""
    fresh: BaseEstimator = clone(estimator)
    recipes = {name: value for name, value in fresh.get_params().items() if isinstance(value, Recipe)}
    for name, recipe in recipes.items():
        duration_s = (n_samples - recipe.timing.n_quiet) * recipe.timing.dt_s
        fresh.set_params(**{name: replace(recipe, timing=replace(recipe.timing, duration_s=duration_s))})
    return fresh


@dataclass(eq=False, repr=False)
class EarlyClassifier(MetaEstimatorMixin, ProbabilityClassifier):
    """Classifier fitted for several lengths of a start, with a rule that stops once one is sure.

    Args:
        estimator: the classifier; a logistic regression by default. Its recipes are cut to each length.
        samples: lengths, rising; by default eight from 2 to 100 % of the transient.
        error: wanted share of wrong verdicts among stopped cases.

    Attributes:
        samples_: lengths, shape (n_moments,).
        estimators_: the fitted classifier of each length.
    """

    estimator: Any = None
    samples: tuple[int, ...] | None = None
    _: KW_ONLY
    error: float = 0.05

    def fit(self, X: Any, y: Any) -> Self:
        """Train a classifier on the first samples of the cases, for each length.

        Raises:
            ValueError: lengths do not rise or exceed the cases, or the classifier refuses.
        """
        number("error", self.error, above=0.0, below=1.0)
        flat, labels = labelled_cases(self, X, y)
        base = unfitted(self.estimator)
        recipe = next((v for v in base.get_params().values() if isinstance(v, Recipe)), None)
        self.n_channels_ = 1 if recipe is None else len(recipe.channels)
        n_samples = flat.shape[1] // self.n_channels_
        usual = tuple(max(1, round(share * n_samples)) for share in _SHARES)
        chosen = usual if self.samples is None else self.samples
        self.samples_ = np.unique(wholes("samples", chosen))
        require(
            len(self.samples_) > 0 and self.samples_[0] >= 1 and self.samples_[-1] <= n_samples,
            f"samples must be from 1 to {n_samples}, got {shown(chosen)}",
        )
        names = self.classes_[labels]
        self.estimators_ = [
            shortened(base, int(count)).fit(self._first(flat, int(count)), names) for count in self.samples_
        ]
        self.classes_ = np.asarray(self.estimators_[-1].classes_)
        return self

    def probabilities_by_samples(self, X: Any) -> FloatArray:
        """Return the probability of each class at each length, shape (n_moments, n_cases, n_classes)."""
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        pairs = zip(self.estimators_, self.samples_, strict=True)
        return np.stack([model.predict_proba(self._first(flat, int(count))) for model, count in pairs])

    def stop(self, X: Any) -> Stopped:
        """Return each case's verdict and time: `decided` indexes `classes_`, `moment` indexes `samples_`."""
        return stop_when_sure(self.probabilities_by_samples(X), self.error)

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class at the stop, shape (n_cases, n_classes)."""
        probabilities = self.probabilities_by_samples(X)
        moment = stop_when_sure(probabilities, self.error).moment
        then: FloatArray = probabilities[moment, np.arange(len(moment))]
        return then

    def _first(self, flat: FloatArray, count: int) -> FloatArray:
        return flat.reshape(len(flat), self.n_channels_, -1)[..., :count].reshape(len(flat), -1)
