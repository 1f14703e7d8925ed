"""Methods that are scikit-learn's alone, nothing of ours: entries of the leaderboard, and examples of one's own method.

`motor-classifiers benchmark --with benchmarks/sklearn_methods.py:support_vectors`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.cross_decomposition import PLSRegression
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier, IsolationForest
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, QuantileTransformer, StandardScaler
from sklearn.svm import SVC

from motor_env import Recipe

Floats = NDArray[np.float64]
_STANDSTILL_V = 0.2  # back-EMF below which the direction is not sure


def _components(seed: int, *steps: BaseEstimator) -> Pipeline:
    return make_pipeline(PCA(20, random_state=seed), StandardScaler(), *steps)


def support_vectors(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, support vector machine."""
    return _components(seed, CalibratedClassifierCV(SVC(C=10.0, gamma=0.003), ensemble=False))


def boosting(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, histogram gradient boosting."""
    return _components(seed, HistGradientBoostingClassifier(max_iter=100, random_state=seed))


def perceptron(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, multi-layer perceptron."""
    return _components(seed, MLPClassifier((64,), alpha=0.1, early_stopping=True, random_state=seed))


def neighbours(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, 15 nearest neighbours."""
    return _components(seed, KNeighborsClassifier(15))


def discriminant(recipe: Recipe, seed: int) -> BaseEstimator:
    """Raw samples, linear discriminant analysis with shrinkage."""
    return LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")


def integrated_regression(cases: Floats, dt_s: float, resistance_ohm: float) -> Floats:
    """Coefficients of the motor's equations by least squares, integrated so that no noise is differentiated.

    With the back-EMF e = v - R i, the integral of the voltage is linear in the integrals of i, i, the double integrals
    of v, i, sign e (dry friction) and e |e| (a fan), t^2 (a load) and t.

    Args:
        cases: current and applied voltage side by side, shape (n_cases, 2 n_samples).
        dt_s: sampling interval.
        resistance_ohm: of the nominal motor.
    """
    current, voltage = np.split(cases.astype(np.float64), 2, axis=1)
    mean = 0.5 * (current + np.pad(current, ((0, 0), (1, 0)))[:, :-1])
    back_emf = voltage - resistance_ohm * mean
    time = np.broadcast_to(dt_s * np.arange(1, current.shape[1] + 1), current.shape)

    def once(values: Floats) -> Floats:
        return dt_s * np.cumsum(values, axis=1)

    twice = [
        once(once(values))
        for values in (voltage, mean, np.tanh(back_emf / _STANDSTILL_V), back_emf * np.abs(back_emf))
    ]
    columns = np.stack([once(mean), current, *twice, time**2, time], axis=2)
    columns /= np.abs(columns).max(axis=(0, 1))
    pairs = zip(columns, once(voltage), strict=True)
    return np.array([np.linalg.lstsq(column, wanted, rcond=None)[0] for column, wanted in pairs])


def regression(recipe: Recipe, seed: int) -> BaseEstimator:
    """Motors at work: least squares on the motor's equations in integrated signals, support vector machine."""
    known = {"dt_s": recipe.timing.dt_s, "resistance_ohm": float(recipe.motor.resistance_ohm)}
    return make_pipeline(
        FunctionTransformer(integrated_regression, kw_args=known),
        QuantileTransformer(n_quantiles=200, output_distribution="normal", random_state=seed),
        CalibratedClassifierCV(SVC(), ensemble=False),
    )


def least_squares(recipe: Recipe, seed: int) -> BaseEstimator:
    """Partial least squares on raw samples."""
    return PLSRegression(8)


def isolation(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, isolation forest."""
    return _components(seed, IsolationForest(random_state=seed))
