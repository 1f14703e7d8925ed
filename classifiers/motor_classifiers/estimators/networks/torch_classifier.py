"""Any torch module as a classifier: the wrapper for a network of one's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import torch
from sklearn.utils import Tags
from torch import nn

from motor_classifiers.estimators.networks.epoch_classifier import WaveformClassifier
from motor_classifiers.estimators.networks.training import seed_of


@dataclass(eq=False, repr=False)
class TorchClassifier(WaveformClassifier):
    """A torch module of your own, trained by cross-entropy, AdamW and one cosine cycle of the learning rate.

    The module gets (n_cases, n_channels, n_samples), each sample standardised by the training set, and gives a logit
    for each class. Its layers keep torch's own initial weights, drawn from `random_state`.

    Args:
        recipe: tells the number of channels; one without it.
        module: from the numbers of channels, samples and classes to the untrained module; one linear layer without it.
        epochs: passes over the training cases.
        batch_size: cases of a step.
        learning_rate: highest rate of the cycle.
        weight_decay: of AdamW.
        random_state: of initial weights and order.

    Attributes:
        classes_: labels.
        center_: mean of each time sample over the training cases, shape (n_features_in_,).
        scale_: its standard deviation.
        network_: the trained module.
        n_features_in_: n_channels * n_samples.
    """

    _: KW_ONLY
    module: Callable[[int, int, int], nn.Module] | None = None

    def __sklearn_tags__(self) -> Tags:
        """It takes transients with their channels, and flat ones."""
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
