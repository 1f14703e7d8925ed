"""A small convolutional network as a method of one's own (docs/howto/own-method.md)."""

from torch import nn

from motor_classifiers import TorchClassifier
from motor_env import Recipe


def module(n_channels: int, n_samples: int, n_classes: int) -> nn.Module:
    """Eight convolutions, their means over ten parts of the start, a linear layer."""
    return nn.Sequential(
        nn.Conv1d(n_channels, 8, kernel_size=25, stride=5),
        nn.ReLU(),
        nn.AdaptiveAvgPool1d(10),
        nn.Flatten(),
        nn.Linear(8 * 10, n_classes),
    )


def cnn(recipe: Recipe, seed: int) -> TorchClassifier:
    """Eight convolutions, their means, a linear layer."""
    return TorchClassifier(recipe, module=module, epochs=20, random_state=seed)
