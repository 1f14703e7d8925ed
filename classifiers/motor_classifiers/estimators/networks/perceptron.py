"""A perceptron on the directions of the signal that can matter."""

from __future__ import annotations

import numpy as np
from torch import nn

from motor_classifiers.estimators.features import ResidualProjection
from motor_classifiers.estimators.networks.epoch_classifier import EpochClassifier, perceptron
from motor_classifiers.estimators.state import Arrays, State, check_perceptron
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe


class PerceptronClassifier(EpochClassifier):
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
        *,
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

    def to_state(self) -> State:
        """The fitted network as arrays and values."""
        state = super().to_state()
        projection = {"weights": self.projection_.weights_, "offset": self.projection_.offset_}
        return state._replace(arrays=state.arrays | projection)

    def _fit_features(self, flat: FloatArray) -> FloatArray:
        self.projection_ = ResidualProjection(self.recipe, self.n_components).fit(flat)
        return self.projection_.transform(flat)

    def _features(self, flat: FloatArray) -> FloatArray:
        return self.projection_.transform(flat)

    def _network(self, n_inputs: int) -> nn.Module:
        return perceptron(n_inputs, self.n_hidden, self.n_layers, len(self.classes_))

    def _load_features(self, arrays: Arrays) -> int:
        projection = ResidualProjection(self.recipe, self.n_components)
        projection.weights_, projection.offset_ = arrays["weights"], arrays["offset"]
        projection.n_features_in_ = self.n_features_in_
        require(
            projection.weights_.shape == (len(projection.offset_), self.n_features_in_),
            f"weights of shape {projection.weights_.shape} do not fit its recipe",
        )
        self.projection_ = projection
        return len(projection.offset_)

    def _check_sizes(self, arrays: Arrays) -> None:
        check_perceptron(arrays, self.n_hidden, self.n_layers, len(self.classes_))
