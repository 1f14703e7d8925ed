"""Conformal coverage on a stream of cases."""

import numpy as np
import pytest
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier

from motor_classifiers import ConformalClassifier, ConformalSets
from motor_classifiers.wrappers.conformal import measured_coverage

N_CLASSES = 4


def stream(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Posterior probabilities of classes that differ much in how well they are told, and classes drawn from them."""
    ease = np.array([0.5, 1.0, 3.0, 8.0])
    truth = rng.integers(N_CLASSES, size=n)
    logits = rng.normal(size=(n, N_CLASSES))
    logits[np.arange(n), truth] += ease[truth]
    share = np.exp(logits - logits.max(axis=1, keepdims=True))
    return share / share.sum(axis=1, keepdims=True), truth


def test_sets_cover_as_they_say_overall_and_in_each_class() -> None:
    rng = np.random.default_rng(4)
    known, known_truth = stream(rng, 20_000)
    new, truth = stream(rng, 20_000)
    marginal = measured_coverage(ConformalSets.calibrate(known, known_truth).sets(new), truth)
    assert 0.89 < marginal.overall < 0.91
    assert np.ptp(marginal.by_class) > 0.1  # over all, not in each class
    each = measured_coverage(
        ConformalSets.calibrate(known, known_truth, label_conditional=True).sets(new), truth
    )
    assert ((each.by_class > 0.88) & (each.by_class < 0.92)).all()


def test_clear_cases_are_not_all_alike() -> None:
    probabilities = np.array([[1.0, 1e-40], [1.0, 1e-30], [1.0, 1e-20]])
    sets = ConformalSets.calibrate(probabilities, np.zeros(3, dtype=int))
    p = sets.p_values(probabilities)[:, 0]
    assert len(set(p.tolist())) == 3


def test_classifier_calibrates_on_cases_it_did_not_train_on() -> None:
    rng = np.random.default_rng(7)
    centres = np.array([[0.0, 0.0], [1.5, 0.0], [0.0, 5.0]])

    def drawn(n: int) -> tuple[np.ndarray, np.ndarray]:
        y = rng.integers(3, size=n)
        return centres[y] + rng.normal(size=(n, 2)), np.array(["a", "b", "c"])[y]

    X, y = drawn(3000)
    model = ConformalClassifier(random_state=1).fit(X, y)
    frozen = ConformalClassifier(FrozenEstimator(LogisticRegression().fit(X, y))).fit(*drawn(3000))
    new, truth = drawn(10_000)
    index = np.searchsorted(model.classes_, truth)
    for fitted in (model, frozen):
        got = measured_coverage(fitted.predict_set(new), index)
        # Calibrated on some 300 (or 1,000) cases a class: two standard deviations are 0.035.
        assert (np.abs(got.by_class - 0.9) < 0.05).all()
        assert got.mean_size < 2.0
    # Labels by chance, and a model that knows by heart what it was trained on: half of its own answers must be wrong.
    guessed = np.where(rng.random(200) < 0.5, "a", "b")
    by_heart = ConformalClassifier(KNeighborsClassifier(1), random_state=1).fit(X[:200], guessed)
    assert 0.3 < np.concatenate(by_heart.sets_.nonconformity).mean() < 0.7
    with pytest.raises(ValueError, match="does not know the class 'd'"):
        ConformalClassifier(FrozenEstimator(LogisticRegression().fit(X, y))).fit(
            X, np.where(y == "a", "d", y)
        )
