"""Methods that are scikit-learn's alone, nothing of ours: entries of the leaderboard, and examples of one's own method.

`motor-classifiers benchmark --with benchmarks/sklearn_methods.py:support_vectors`
"""

from __future__ import annotations

from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.cross_decomposition import PLSRegression
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier, IsolationForest
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from motor_env import Recipe


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


def least_squares(recipe: Recipe, seed: int) -> BaseEstimator:
    """Partial least squares on raw samples."""
    return PLSRegression(8)


def isolation(recipe: Recipe, seed: int) -> BaseEstimator:
    """20 principal components, isolation forest."""
    return _components(seed, IsolationForest(random_state=seed))
