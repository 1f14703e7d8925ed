"""Classifiers trained in epochs over given cases: perceptron, ResNet, and custom torch modules."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from scipy.special import softmax
from sklearn.utils import Tags
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators import cases
from motor_classifiers.estimators.cases import (
    State,
    loaded_module,
    module_arrays,
    part_of,
    plain_parameters,
)
from motor_classifiers.estimators.features import ResidualProjection
from motor_classifiers.estimators.networks.training import Batch, initialise, one_thread, seed_of, train
from motor_env.common.arrays import number, whole
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

MOST_LAYERS = 1000


class LogitClassifier(cases.ProbabilityClassifier):
    """Classifier whose `_logits` are log-probabilities up to a constant."""

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, shape (n_cases, n_classes)."""
        probabilities: FloatArray = softmax(self._logits(X), axis=1)
        return probabilities

    @abstractmethod
    def _logits(self, X: Any) -> FloatArray:
        """Return logits, shape (n_cases, n_classes), in the order of `classes_`."""


def logits_in_parts(network: nn.Module, flat: FloatArray, at_once: int) -> FloatArray:
    """Return a network's outputs, shape (n_cases, ...), computed in parts to bound the memory."""
    inputs = torch.from_numpy(
        flat if flat.flags.writeable else flat.copy()
    )  # torch shares memory to write to
    with one_thread(), torch.inference_mode():
        return np.concatenate([network(part).numpy() for part in torch.split(inputs, at_once)])


def perceptron(n_in: int, n_hidden: int, n_layers: int, n_out: int) -> nn.Sequential:
    """Return fully connected layers with SiLU between, float64, without memory for their weights."""
    require(0 <= n_layers <= MOST_LAYERS, f"n_layers must be from 0 to {MOST_LAYERS}, got {n_layers!r}")
    whole("n_hidden", n_hidden, 1)
    whole("n_layers", n_layers)
    sizes = [n_in, *[n_hidden] * n_layers, n_out]
    with torch.device("meta"):
        layers = [[nn.SiLU(), nn.Linear(*pair, dtype=torch.float64)] for pair in pairwise(sizes)]
    return nn.Sequential(*[layer for pair in layers for layer in pair][1:])


@dataclass(eq=False, repr=False)
class EpochClassifier(LogitClassifier):
    """Network on standardised inputs, trained in epochs.

    Args:
        recipe: the motor; its use depends on the subclass.
        epochs: passes over the training cases.
        batch_size: largest number of cases in a step.
        learning_rate: highest rate of the cycle.
        weight_decay: of AdamW.
        random_state: of initial weights, order and noise.

    Attributes:
        center_: mean of each input over the training cases.
        scale_: its standard deviation.
        network_: the trained torch module.
    """

    recipe: Recipe | None = None
    _: KW_ONLY
    epochs: int = 40
    batch_size: int = 64
    learning_rate: float = 0.01
    weight_decay: float = 0.1
    random_state: int | np.random.RandomState | None = None
    _at_once = 4096

    def fit(self, X: Any, y: Any) -> Self:
        """Minimise the cross-entropy by AdamW with one cosine cycle (Loshchilov & Hutter 2019).

        Raises:
            ValueError: fewer than two classes, invalid labels, or shapes that do not fit.
        """
        for name in ("epochs", "batch_size"):
            whole(name, getattr(self, name), 1)
        number("learning_rate", self.learning_rate, above=0.0)
        number("weight_decay", self.weight_decay, least=0.0)
        flat, labels = cases.labelled_cases(self, X, y)
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        self.projection_ = self._projection()
        features = flat if self.projection_ is None else self.projection_.fit_transform(flat)
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
                total_steps=int(self.epochs) * -(-len(flat) // int(self.batch_size)),
                cycle_momentum=False,
            )
            inputs = torch.from_numpy(self._inputs(features)).to(next(network.parameters()).dtype)
            batches = self._batches(inputs, torch.from_numpy(labels), generator)
            train(network, batches, nn.functional.cross_entropy, schedule)
        # In single precision a start's logits would depend on the starts judged beside it, in the seventh digit.
        self.network_ = network.double()
        return self

    def to_state(self) -> State:
        """Return the fitted network as arrays and values."""
        arrays = module_arrays(self.network_, "network") | {"center": self.center_, "scale": self.scale_}
        if self.projection_ is not None:
            arrays |= {"weights": self.projection_.weights_, "offset": self.projection_.offset_}
        return State(arrays, {"parameters": plain_parameters(self)})

    @classmethod
    def from_state(cls, state: State, recipe: Recipe) -> Self:
        """Restore the fitted network.

        Raises:
            ValueError, KeyError, TypeError, RuntimeError: values or arrays of a wrong type or shape.
        """
        model = cls(recipe, **state.values["parameters"])
        model.classes_ = np.array(state.values["classes"])
        model.n_features_in_ = cases.values_of_start(recipe)
        model.center_, model.scale_ = state.arrays["center"], state.arrays["scale"]
        n_inputs = model.n_features_in_
        model.projection_ = model._projection()
        if model.projection_ is not None:
            n_inputs = model.projection_.restore(state.arrays["weights"], state.arrays["offset"])
        sizes = model.center_.shape, model.scale_.shape
        require(sizes == ((n_inputs,), (n_inputs,)), f"center and scale must have {n_inputs} numbers each")
        require(bool((model.scale_ > 0.0).all()), "scale must be > 0")
        model.network_ = loaded_module(model._network(n_inputs), part_of(state.arrays, "network"))
        return model

    def _batches(
        self, inputs: torch.Tensor, labels: torch.Tensor, generator: torch.Generator
    ) -> Iterator[Batch]:
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for rows in torch.split(order, int(self.batch_size)):
                yield inputs[rows], labels[rows]

    def _inputs(self, features: FloatArray) -> FloatArray:
        standard: FloatArray = (features - self.center_) / self.scale_
        return standard

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        features = cases.flat_cases(self, X, reset=False)
        if self.projection_ is not None:
            features = self.projection_.transform(features)
        return logits_in_parts(self.network_, self._inputs(features), self._at_once)

    def _projection(self) -> ResidualProjection | None:
        """Return the map from cases to features; None for the raw values."""
        return None

    @abstractmethod
    def _network(self, n_inputs: int) -> nn.Module:
        """Return the network on the device `meta`, where weights take no memory."""


class WaveformClassifier(EpochClassifier):
    """Network on the samples of each channel, each standardised by the training set."""

    _at_once = 256

    def _shape(self) -> tuple[int, int]:
        if self.recipe is None:
            return 1, self.n_features_in_
        channels = cases.fitting_recipe(self.recipe, self.n_features_in_).channels
        return len(channels), self.n_features_in_ // len(channels)

    def _inputs(self, features: FloatArray) -> FloatArray:
        return super()._inputs(features).reshape(len(features), *self._shape())


@dataclass(eq=False, repr=False)
class PerceptronClassifier(EpochClassifier):
    """Perceptron on the filter's residual along the model's signal directions.

    The first linear map is `ResidualProjection`, standardised by the training set.

    Args:
        recipe: motor, nuisances and faults; without one, directions come from the training cases.
        n_components: number of directions.
        n_hidden: width of a hidden layer.
        n_layers: number of hidden layers.

    Attributes:
        projection_: the fitted first map.
    """

    n_components: int = 6
    _: KW_ONLY
    n_hidden: int = 32
    n_layers: int = 2

    def _projection(self) -> ResidualProjection:
        return ResidualProjection(self.recipe, self.n_components)

    def _network(self, n_inputs: int) -> nn.Module:
        return perceptron(n_inputs, self.n_hidden, self.n_layers, len(self.classes_))


@dataclass(eq=False, repr=False)
class TorchClassifier(WaveformClassifier):
    """Classifier around a torch module of your own.

    The module gets (n_cases, n_channels, n_samples), each sample standardised by the training set, and gives a logit
    for each class.

    Args:
        recipe: for the number of channels; one without it.
        module: makes the untrained module from the numbers of channels, samples and classes; default: a linear layer.
    """

    _: KW_ONLY
    module: Callable[[int, int, int], nn.Module] | None = None

    def __sklearn_tags__(self) -> Tags:
        """Accept transients with channels, and flat ones."""
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def _network(self, n_inputs: int) -> nn.Module:
        # Layers of strangers draw from the global generator: it is put back afterwards.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(self.random_state))
            return (self.module or _linear)(*self._shape(), len(self.classes_))


def _linear(n_channels: int, n_samples: int, n_classes: int) -> nn.Module:
    return nn.Sequential(nn.Flatten(), nn.Linear(n_channels * n_samples, n_classes))


def _convolution(n_in: int, n_out: int, kernel: int, stride: int = 1) -> nn.Module:
    convolution = nn.Conv1d(n_in, n_out, kernel, stride=stride, padding=kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm1d(n_out))


class _Block(nn.Module):
    def __init__(self, n_in: int, n_out: int, *, kernel: int) -> None:
        super().__init__()
        self.first = _convolution(n_in, n_out, kernel, stride=2)
        self.second = _convolution(n_out, n_out, kernel)
        self.shortcut = _convolution(n_in, n_out, 1, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.second(torch.relu(self.first(x))) + self.shortcut(x))


@dataclass(eq=False, repr=False)
class ResNetClassifier(WaveformClassifier):
    """One-dimensional residual network on the raw transient.

    Residual blocks: He et al. (2016), for time series Wang, Yan & Oates (2017). Only batch normalisation: a norm over
    one transient would remove its level, the sign of bearing faults. Fresh noise on the inputs prevents overfitting.

    Args:
        recipe: for the number of channels; one without it.
        width: channels of the first layers, half those of the last.
        stem: stride of the first layer in samples.
        kernel: length of the other convolutions.
        noise: standard deviation of the added noise over that of a time sample.
    """

    width: int = 12
    _: KW_ONLY
    stem: int = 10
    kernel: int = 5
    noise: float = 1.0
    epochs: int = 30
    learning_rate: float = 5e-3
    weight_decay: float = 0.3

    def _batches(
        self, inputs: torch.Tensor, labels: torch.Tensor, generator: torch.Generator
    ) -> Iterator[Batch]:
        """Yield batches of nearly equal size, as batch normalisation fails on a batch of one."""
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for rows in torch.tensor_split(order, -(-len(inputs) // int(self.batch_size))):
                noise = torch.randn(inputs[rows].shape, generator=generator)
                yield inputs[rows] + self.noise * noise, labels[rows]

    def _network(self, n_inputs: int) -> nn.Module:
        width, kernel = self.width, self.kernel
        sizes = (width, self.stem, kernel)
        require(min(sizes) >= 1, f"width, stem and kernel must be >= 1, got {sizes}")
        with torch.device("meta"):
            return nn.Sequential(
                _convolution(self._shape()[0], width, 2 * self.stem + 1, stride=self.stem),
                nn.ReLU(),
                _Block(width, width, kernel=kernel),
                _Block(width, 2 * width, kernel=kernel),
                _Block(2 * width, 2 * width, kernel=kernel),
                nn.AdaptiveAvgPool1d(1),
                nn.Flatten(),
                nn.Linear(2 * width, len(self.classes_)),
            )
