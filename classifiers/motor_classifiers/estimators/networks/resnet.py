"""A residual network on raw transients: what a generic network reaches that knows nothing of the motor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass

import torch
from torch import nn

from motor_classifiers.estimators.networks.epoch_classifier import WaveformClassifier
from motor_classifiers.estimators.networks.training import Batch
from motor_env.motor.parameters import require


def _convolution(n_in: int, n_out: int, kernel: int, stride: int = 1) -> nn.Module:
    """A convolution and its normalisation over the batch."""
    convolution = nn.Conv1d(n_in, n_out, kernel, stride=stride, padding=kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm1d(n_out))


class _Block(nn.Module):
    """Two convolutions, and the input added to their output."""

    def __init__(self, n_in: int, n_out: int, *, kernel: int) -> None:
        super().__init__()
        self.first = _convolution(n_in, n_out, kernel, stride=2)
        self.second = _convolution(n_out, n_out, kernel)
        self.shortcut = _convolution(n_in, n_out, 1, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.second(torch.relu(self.first(x))) + self.shortcut(x))


@dataclass(eq=False, repr=False)
class ResNetClassifier(WaveformClassifier):
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
        """Batches of nearly equal size: a batch of one has no variance to normalise by."""
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            for rows in torch.tensor_split(order, -(-len(inputs) // self.batch_size)):
                noise = torch.randn(inputs[rows].shape, generator=generator)
                yield inputs[rows] + self.noise * noise, labels[rows]

    def _network(self, n_inputs: int) -> nn.Module:
        """A stem that thins the samples out, three residual blocks, the mean over time, logits."""
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
