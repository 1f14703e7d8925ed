"""A residual network on raw transients: what a generic network reaches that knows nothing of the motor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import nn

from motor_classifiers.estimators.cases import fitting_recipe
from motor_classifiers.estimators.networks.epoch_classifier import EpochClassifier, unset_layer
from motor_classifiers.estimators.networks.training import Batch
from motor_classifiers.estimators.state import Arrays
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe


def _convolution(n_in: int, n_out: int, kernel: int, stride: int = 1) -> nn.Module:
    """A convolution and its normalisation over the batch."""
    options = {"stride": stride, "padding": kernel // 2, "bias": False}
    return nn.Sequential(unset_layer(nn.Conv1d, n_in, n_out, kernel, **options), nn.BatchNorm1d(n_out))


class _Block(nn.Module):
    """Two convolutions, and the input added to their output."""

    def __init__(self, n_in: int, n_out: int, *, kernel: int) -> None:
        super().__init__()
        self.first = _convolution(n_in, n_out, kernel, stride=2)
        self.second = _convolution(n_out, n_out, kernel)
        self.shortcut = _convolution(n_in, n_out, 1, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.second(torch.relu(self.first(x))) + self.shortcut(x))


class ResNetClassifier(EpochClassifier):
    """A one-dimensional residual network on the raw transient.

    Residual blocks after He et al. (2016), for time series Wang, Yan & Oates (2017). Batch normalisation alone: a norm
    over one transient (layer, group, instance) would take away its level, and with it every bearing fault. Every time
    sample is standardised by the training set, never a transient by itself. Fresh noise on the inputs of every step
    keeps the network from learning 2,000 transients by heart.

    Args:
        recipe: only its number of channels is used; one channel without it.
        width: channels of the first layers; the last ones have twice as many.
        stem: samples that the first layer moves on by.
        kernel: length of the other convolutions.
        noise: standard deviation of the added noise, in standard deviations of a time sample.
        epochs: passes over the training cases.
        batch_size: most cases of a step.
        learning_rate: highest rate of the cycle.
        weight_decay: of AdamW.
        random_state: of weights, order and noise.

    Attributes:
        classes_: labels.
        center_: mean of each time sample over the training cases, shape (n_features_in_,).
        scale_: its standard deviation.
        network_: the trained torch module.
        n_features_in_: n_channels * n_timepoints.
    """

    _at_once = 256

    def __init__(
        self,
        recipe: Recipe | None = None,
        width: int = 12,
        *,
        stem: int = 10,
        kernel: int = 5,
        noise: float = 1.0,
        epochs: int = 30,
        batch_size: int = 64,
        learning_rate: float = 5e-3,
        weight_decay: float = 0.3,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.recipe = recipe
        self.width = width
        self.stem = stem
        self.kernel = kernel
        self.noise = noise
        self.epochs = epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.random_state = random_state

    def _batches(
        self, inputs: torch.Tensor, labels: torch.Tensor, generator: torch.Generator
    ) -> Iterator[Batch]:
        """Batches of nearly equal size: a batch of one has no variance to normalise by."""
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for rows in torch.tensor_split(order, -(-len(inputs) // self.batch_size)):
                noise = torch.randn(inputs[rows].shape, generator=generator)
                yield inputs[rows] + self.noise * noise, labels[rows]

    def _n_channels(self) -> int:
        if self.recipe is None:
            return 1
        return len(fitting_recipe(self.recipe, self.n_features_in_).sensor.channels)

    def _inputs(self, features: FloatArray) -> FloatArray:
        return super()._inputs(features).reshape(len(features), self._n_channels(), -1)

    def _network(self, n_inputs: int) -> nn.Module:
        """A stem that thins the samples out, three residual blocks, the mean over time, logits."""
        width, kernel = self.width, self.kernel
        return nn.Sequential(
            _convolution(self._n_channels(), width, 2 * self.stem + 1, stride=self.stem),
            nn.ReLU(),
            _Block(width, width, kernel=kernel),
            _Block(width, 2 * width, kernel=kernel),
            _Block(2 * width, 2 * width, kernel=kernel),
            nn.AdaptiveAvgPool1d(1),
            nn.Flatten(),
            unset_layer(nn.Linear, 2 * width, len(self.classes_)),
        )

    def _check_sizes(self, arrays: Arrays) -> None:
        sizes = (self.width, self.stem, self.kernel)
        require(
            all(type(size) is int and size >= 1 for size in sizes), f"sizes must be integers, got {sizes!r}"
        )
        stem, inner = arrays["network.0.0.weight"].shape, arrays["network.2.second.0.weight"].shape
        require(
            stem == (self.width, self._n_channels(), 2 * self.stem + 1) and inner[2] == self.kernel,
            f"width, stem and kernel are {sizes}, the file holds convolutions of shape {stem}, {inner}",
        )
