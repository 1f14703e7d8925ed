"""Small torch networks behind scikit-learn's interface: a class of our own over a plain loop.

One thread and a generator of its own make the training repeatable to the bit; torch's global random state and its
number of threads are as they were afterwards.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators.cases import flat_cases, labelled_cases
from motor_classifiers.estimators.features import ResidualProjection
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

_LARGEST_SEED = 2**31 - 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: quicker for small networks, and sums are always taken in the same order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def perceptron(n_in: int, n_hidden: int, n_layers: int, n_out: int) -> nn.Sequential:
    """Fully connected layers with SiLU between, float64, weights not yet set."""
    sizes = [n_in, *[n_hidden] * n_layers]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [_unset_linear(before, after), nn.SiLU()]
    layers.append(_unset_linear(sizes[-1], n_out))
    return nn.Sequential(*layers)


def _unset_linear(n_in: int, n_out: int) -> nn.Module:
    """A layer that takes no number from torch's global generator."""
    layer: nn.Module = nn.utils.skip_init(nn.Linear, n_in, n_out, dtype=torch.float64)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return layer


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Weights by He et al. (2015), biases zero, from the generator alone."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv1d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def train(
    network: nn.Module,
    inputs: torch.Tensor,
    labels: torch.Tensor,
    generator: torch.Generator,
    *,
    epochs: int,
    batch_size: int,
    learning_rate: float,
    weight_decay: float,
) -> None:
    """Minimise the cross-entropy by AdamW with one cosine cycle (Loshchilov & Hutter 2019)."""
    optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=weight_decay)
    batches = -(-len(inputs) // batch_size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=learning_rate, total_steps=epochs * batches, cycle_momentum=False
    )
    network.train()
    for _ in range(epochs):
        order = torch.randperm(len(inputs), generator=generator)
        for batch in torch.split(order, batch_size):
            optimiser.zero_grad()
            loss = nn.functional.cross_entropy(network(inputs[batch]), labels[batch])
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
            optimiser.step()
            schedule.step()
    network.eval()


class LogitClassifier(ClassifierMixin, BaseEstimator, ABC):
    """What classifiers share whose `_logits` are logarithms of probabilities up to a constant of each case."""

    def decision_function(self, X: Any) -> FloatArray:
        """Logits, shape (n_cases, n_classes); for two classes the second's over the first's, shape (n_cases,)."""
        logits = self._logits(X)
        return logits[:, 1] - logits[:, 0] if len(self.classes_) == 2 else logits

    def predict_proba(self, X: Any) -> FloatArray:
        """Probability of each class, shape (n_cases, n_classes)."""
        logits = self._logits(X)
        share = np.exp(logits - logits.max(axis=1, keepdims=True))
        probabilities: FloatArray = share / share.sum(axis=1, keepdims=True)
        return probabilities

    def predict(self, X: Any) -> NDArray[Any]:
        """Most probable class of each case, shape (n_cases,)."""
        most = self._logits(X).argmax(axis=1)
        labels: NDArray[Any] = self.classes_[most]
        return labels

    @abstractmethod
    def _logits(self, X: Any) -> FloatArray:
        """Shape (n_cases, n_classes), in the order of `classes_`."""


def seed_of(random_state: int | np.random.RandomState | None) -> int:
    """A seed below 2^31 from what scikit-learn takes for one."""
    return int(check_random_state(random_state).randint(_LARGEST_SEED))


class NetworkClassifier(LogitClassifier):
    """A perceptron on the filter's residual along the model's own signal directions.

    The first linear map is `ResidualProjection`, so the network sees the whole waveform through the directions that can
    matter. Its components are standardised by the training set, never by the transient.

    Args:
        recipe: the motor, its nuisances and faults; without one, directions come from the training cases.
        n_components: directions the network sees.
        n_hidden: width of a hidden layer.
        n_layers: hidden layers.
        epochs: passes over the training cases.
        batch_size: cases of a step.
        learning_rate: highest rate of the cycle.
        weight_decay: of AdamW.
        random_state: seed, generator or None, as in scikit-learn.

    Attributes:
        classes_: labels.
        projection_: the fitted first map.
        scale_: standard deviation of each component in training, shape (n_components,).
        center_: its mean.
        network_: the torch module.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(
        self,
        recipe: Recipe | None = None,
        n_components: int = 6,
        n_hidden: int = 32,
        n_layers: int = 2,
        epochs: int = 40,
        batch_size: int = 64,
        learning_rate: float = 0.01,
        weight_decay: float = 0.1,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.recipe = recipe
        self.n_components = n_components
        self.n_hidden = n_hidden
        self.n_layers = n_layers
        self.epochs = epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.random_state = random_state

    def fit(self, X: Any, y: Any) -> Self:
        """Train.

        Raises:
            ValueError: fewer than two classes, labels that are no classes, or shapes that do not fit.
        """
        flat, labels = labelled_cases(self, X, y)
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        self.projection_ = ResidualProjection(self.recipe, self.n_components).fit(flat)
        components = self.projection_.transform(flat)
        self.center_ = components.mean(axis=0)
        spread = components.std(axis=0)
        self.scale_ = np.where(spread > 0.0, spread, 1.0)
        network = perceptron(components.shape[1], self.n_hidden, self.n_layers, len(self.classes_))
        with one_thread():
            initialise(network, generator)
            train(
                network,
                torch.from_numpy((components - self.center_) / self.scale_),
                torch.from_numpy(labels),
                generator,
                epochs=self.epochs,
                batch_size=self.batch_size,
                learning_rate=self.learning_rate,
                weight_decay=self.weight_decay,
            )
        self.network_ = network
        return self

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        components = (self.projection_.transform(flat) - self.center_) / self.scale_
        with one_thread(), torch.inference_mode():
            logits: FloatArray = self.network_(torch.from_numpy(components)).numpy()
        return logits
