"""Cases that a network never sees twice: fresh starts of a recipe at every step, nothing stored."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count

import numpy as np
import torch

from motor_classifiers.estimators.networks.signal_space import SignalSpace
from motor_classifiers.estimators.reference_starts import drawn_starts
from motor_datasets.arrays import Dataset
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe


def with_more_noise(
    coefficients: torch.Tensor,
    energy: torch.Tensor,
    freedom: int,
    factor: FloatArray,
    generator: np.random.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same starts under more noise: what `SignalSpace.coordinates` would be.

    White noise along orthonormal directions is white; outside them n is added to what is left, v, of which only the
    squares matter: |v + n|^2 is (|v| + n_1)^2 and a chi-square with one degree of freedom less. Both are exact.

    Args:
        coefficients: in units of the recipe's noise, shape (n, n_components).
        energy: squares left outside the directions, shape (n,).
        freedom: their degrees of freedom.
        factor: on the noise's standard deviation, >= 1, shape (n,).
        generator: of the noise.
    """
    n_cases = len(coefficients)
    added = np.sqrt(np.square(factor) - 1.0)
    along = coefficients.numpy() + added[:, None] * generator.standard_normal(coefficients.shape)
    first = np.sqrt(energy.numpy()) + added * generator.standard_normal(n_cases)
    rest = generator.chisquare(freedom - 1, n_cases) if freedom > 1 else 0.0
    outside = np.square(first) + np.square(added) * rest
    return torch.from_numpy(along.astype(np.float32)), torch.from_numpy(outside.astype(np.float32))


def fresh_cases(
    space: SignalSpace,
    recipe: Recipe,
    seed: int,
    batch_size: int,
    *,
    most_noise: float = 1.0,
    n_references: int = 0,
) -> Iterator[tuple[torch.Tensor, Dataset]]:
    """Endless batches of standardised coordinates, and the cases with their truth.

    Args:
        space: in single precision.
        recipe: what to draw from.
        seed: of the stream.
        batch_size: cases of a batch.
        most_noise: largest factor on the recipe's noise; it is drawn log-uniformly from 1 for each case.
        n_references: healthy starts of the same motor that come with each case.
    """
    generator = np.random.default_rng(seed)
    for number in count():
        cases = np.arange(number * batch_size, (number + 1) * batch_size)
        batch = drawn_starts(recipe, seed, cases, n_references)
        coordinates = space.coordinates(torch.from_numpy(batch.X.reshape(len(batch), -1)))
        if most_noise > 1.0:
            factor = np.exp(generator.uniform(0.0, math.log(most_noise), len(batch)))
            coordinates = with_more_noise(*coordinates, space.freedom, factor, generator)
        yield space.standardise(*coordinates), batch
