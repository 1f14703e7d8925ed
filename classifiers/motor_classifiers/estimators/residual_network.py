"""A one-dimensional residual network on raw transients, behind scikit-learn's interface.

What a generic network reaches that knows nothing of the motor. Residual blocks after He et al. (2016), for time series
Wang, Yan & Oates (2017). Batch normalisation alone: a norm over one transient (layer, group, instance) would take
away its level, and with it every bearing fault.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import torch
from sklearn.utils.validation import check_is_fitted
from torch import nn

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, labelled_cases
from motor_classifiers.estimators.perceptron import LogitClassifier, initialise, one_thread, seed_of
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

_AT_ONCE = 256  # cases judged together: bounds the memory


def _convolution(n_in: int, n_out: int, kernel: int, stride: int = 1) -> nn.Module:
    """A convolution that takes no number from torch's global generator, and its normalisation over the batch."""
    layer: nn.Module = nn.utils.skip_init(  # type: ignore[no-untyped-call]  # torch leaves it untyped
        nn.Conv1d, n_in, n_out, kernel, stride=stride, padding=kernel // 2, bias=False
    )
    return nn.Sequential(layer, nn.BatchNorm1d(n_out))


class _Block(nn.Module):
    """Two convolutions, and the input added to what they give."""

    def __init__(self, n_in: int, n_out: int, kernel: int) -> None:
        super().__init__()
        self.first = _convolution(n_in, n_out, kernel, stride=2)
        self.second = _convolution(n_out, n_out, kernel)
        self.shortcut = _convolution(n_in, n_out, 1, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.second(torch.relu(self.first(x))) + self.shortcut(x))


def residual_network(n_channels: int, n_classes: int, width: int, stem: int, kernel: int) -> nn.Sequential:
    """A stem that thins the samples out, three residual blocks, the mean over time, logits; weights not yet set."""
    last: nn.Module = nn.utils.skip_init(  # type: ignore[no-untyped-call]  # torch leaves it untyped
        nn.Linear, 2 * width, n_classes
    )
    return nn.Sequential(
        _convolution(n_channels, width, 2 * stem + 1, stride=stem),
        nn.ReLU(),
        _Block(width, width, kernel),
        _Block(width, 2 * width, kernel),
        _Block(2 * width, 2 * width, kernel),
        nn.AdaptiveAvgPool1d(1),
        nn.Flatten(),
        last,
    )


class ResidualNetworkClassifier(LogitClassifier):
    """A residual network on the raw transient.

    Every time sample is standardised by the training set, never a transient by itself. Fresh noise on the inputs of
    every step keeps the network from learning 2,000 transients by heart.

    Args:
        recipe: only its number of channels is used; one channel without it.
        width: channels of the first layers; the last ones have twice as many.
        stem: samples that the first layer moves on by.
        kernel: length of the other convolutions.
        noise: standard deviation of the added noise, in standard deviations of a time sample.
        epochs: passes over the training cases.
        batch_size: cases of a step.
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

    def __init__(
        self,
        recipe: Recipe | None = None,
        width: int = 12,
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

    def fit(self, X: Any, y: Any) -> Self:
        """Train.

        Raises:
            ValueError: fewer than two classes, labels that are no classes, or shapes that do not fit.
        """
        flat, labels = labelled_cases(self, X, y)
        generator = torch.Generator().manual_seed(seed_of(self.random_state))
        self.center_ = flat.mean(axis=0)
        spread = flat.std(axis=0)
        self.scale_ = np.where(spread > 0.0, spread, 1.0)
        network = residual_network(self._n_channels(), len(self.classes_), self.width, self.stem, self.kernel)
        with one_thread():
            initialise(network, generator)
            self._train(network, self._inputs(flat).float(), torch.from_numpy(labels), generator)
        # In single precision a start's logits would depend on the starts judged beside it, in the seventh digit.
        self.network_ = network.double()
        return self

    def _train(
        self, network: nn.Module, inputs: torch.Tensor, labels: torch.Tensor, generator: torch.Generator
    ) -> None:
        """Minimise the cross-entropy by AdamW with one cycle (Loshchilov & Hutter 2019)."""
        batches = -(-len(inputs) // self.batch_size)
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, max_lr=self.learning_rate, total_steps=self.epochs * batches, cycle_momentum=False
        )
        network.train()
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for batch in torch.tensor_split(order, batches):  # no batch of one: it has no variance
                noise = torch.randn(inputs[batch].shape, generator=generator)
                optimiser.zero_grad()
                loss = nn.functional.cross_entropy(network(inputs[batch] + self.noise * noise), labels[batch])
                loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
                optimiser.step()
                schedule.step()
        network.eval()

    def _n_channels(self) -> int:
        if self.recipe is None:
            return 1
        return len(fitting_recipe(self.recipe, self.n_features_in_).sensor.channels)

    def _inputs(self, flat: FloatArray) -> torch.Tensor:
        standard = (flat - self.center_) / self.scale_
        return torch.from_numpy(standard.reshape(len(flat), self._n_channels(), -1))

    def _logits(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        inputs = self._inputs(flat_cases(self, X, reset=False))
        with one_thread(), torch.inference_mode():
            logits = [self.network_(part).numpy() for part in torch.split(inputs, _AT_ONCE)]
        return np.concatenate(logits)
