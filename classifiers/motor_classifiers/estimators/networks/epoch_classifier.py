"""What classifiers behind a torch network share: logits, epochs over given cases, and their state as arrays."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators.cases import (
    ProbabilityClassifier,
    flat_cases,
    labelled_cases,
    values_of_start,
)
from motor_classifiers.estimators.networks.training import Batch, initialise, one_thread, seed_of, train
from motor_classifiers.estimators.state import (
    Arrays,
    State,
    load_module,
    module_arrays,
    part_of,
    plain_parameters,
)
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe


class LogitClassifier(ProbabilityClassifier):
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

    @abstractmethod
    def _logits(self, X: Any) -> FloatArray:
        """Shape (n_cases, n_classes), in the order of `classes_`."""


def logits_in_parts(network: nn.Module, flat: FloatArray, at_once: int) -> FloatArray:
    """Outputs of a network for inputs, shape (n_cases, ...), some at a time: that bounds the memory."""
    inputs = torch.from_numpy(
        flat if flat.flags.writeable else flat.copy()
    )  # torch shares memory to write to
    with one_thread(), torch.inference_mode():
        return np.concatenate([network(part).numpy() for part in torch.split(inputs, at_once)])


def unset_layer(layer: type[nn.Module], *sizes: int, **options: Any) -> nn.Module:
    """A layer whose weights are not yet set: it takes no number from torch's global generator."""
    made: nn.Module = nn.utils.skip_init(layer, *sizes, **options)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return made


def perceptron(n_in: int, n_hidden: int, n_layers: int, n_out: int) -> nn.Sequential:
    """Fully connected layers with SiLU between, float64, weights not yet set."""
    sizes = [n_in, *[n_hidden] * n_layers]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [unset_layer(nn.Linear, before, after, dtype=torch.float64), nn.SiLU()]
    layers.append(unset_layer(nn.Linear, sizes[-1], n_out, dtype=torch.float64))
    return nn.Sequential(*layers)


class EpochClassifier(LogitClassifier):
    """A network on standardised inputs that sees the training cases once in each epoch."""

    recipe: Recipe | None
    epochs: int
    batch_size: int
    learning_rate: float
    weight_decay: float
    random_state: int | np.random.RandomState | None
    _at_once = 4096

    def fit(self, X: Any, y: Any) -> Self:
        """Minimise the cross-entropy by AdamW with one cosine cycle (Loshchilov & Hutter 2019).

        Raises:
            ValueError: fewer than two classes, labels that are no classes, or shapes that do not fit.
        """
        flat, labels = labelled_cases(self, X, y)
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        features = self._fit_features(flat)
        self.center_ = features.mean(axis=0)
        spread = features.std(axis=0)
        self.scale_ = np.where(spread > 0.0, spread, 1.0)
        network = self._network(features.shape[1])
        with one_thread():
            initialise(network, generator)
            optimiser = torch.optim.AdamW(
                network.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay
            )
            schedule = torch.optim.lr_scheduler.OneCycleLR(
                optimiser,
                max_lr=self.learning_rate,
                total_steps=self.epochs * -(-len(flat) // self.batch_size),
                cycle_momentum=False,
            )
            inputs = torch.from_numpy(self._inputs(features)).to(next(network.parameters()).dtype)
            batches = self._batches(inputs, torch.from_numpy(labels), generator)
            train(network, batches, nn.functional.cross_entropy, schedule)
        # In single precision a start's logits would depend on the starts judged beside it, in the seventh digit.
        self.network_ = network.double()
        return self

    def to_state(self) -> State:
        """The fitted network as arrays and values."""
        arrays = module_arrays(self.network_, "network") | {"center": self.center_, "scale": self.scale_}
        return State(arrays, {"parameters": plain_parameters(self)})

    @classmethod
    def from_state(cls, state: State, recipe: Recipe) -> Self:
        """The fitted network again.

        Raises:
            ValueError, KeyError, TypeError, RuntimeError: values or arrays of a wrong type or shape.
        """
        model = cls(recipe, **state.values["parameters"])
        model.classes_ = np.array(state.values["classes"])
        model.n_features_in_ = values_of_start(recipe)
        model.center_, model.scale_ = state.arrays["center"], state.arrays["scale"]
        n_inputs = model._load_features(state.arrays)
        sizes = model.center_.shape, model.scale_.shape
        require(sizes == ((n_inputs,), (n_inputs,)), f"center and scale must have {n_inputs} numbers each")
        require(bool((model.scale_ > 0.0).all()), "scale must be > 0")
        model._check_sizes(state.arrays)
        model.network_ = model._network(n_inputs)
        load_module(model.network_, part_of(state.arrays, "network"))
        return model

    def _batches(
        self, inputs: torch.Tensor, labels: torch.Tensor, generator: torch.Generator
    ) -> Iterator[Batch]:
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for rows in torch.split(order, self.batch_size):
                yield inputs[rows], labels[rows]

    def _inputs(self, features: FloatArray) -> FloatArray:
        """What the network sees of features."""
        standard: FloatArray = (features - self.center_) / self.scale_
        return standard

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        features = self._features(flat_cases(self, X, reset=False))
        return logits_in_parts(self.network_, self._inputs(features), self._at_once)

    def _fit_features(self, flat: FloatArray) -> FloatArray:
        """Learn how cases become features, and return those of the training cases; the values themselves by default."""
        return flat

    def _features(self, flat: FloatArray) -> FloatArray:
        """Features of cases."""
        return flat

    def _load_features(self, arrays: Arrays) -> int:
        """Set what a file holds of the features, and return how many there are."""
        return int(self.n_features_in_)

    @abstractmethod
    def _network(self, n_inputs: int) -> nn.Module:
        """The network, weights not yet set."""

    @abstractmethod
    def _check_sizes(self, arrays: Arrays) -> None:
        """Check that a network of the parameters' sizes has arrays as large as the file's, before it is made."""
