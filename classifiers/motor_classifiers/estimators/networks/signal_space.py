"""Coordinates of a start: its deviation from nominal along the few directions in which starts differ.

In white noise nothing else enters the likelihood; the remainder gives the noise level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count

import numpy as np
import torch
from torch import nn

from motor_classifiers.estimators.reference_starts import referenced_starts
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe, Spread

_FAMILY_SEED = 0xFA317  # of the starts that span the family; no data set is drawn with it
_FAMILY_SIZE = 2000
_VISIBLE = 0.1  # root mean square along a direction, in units of the noise
_FEWEST, _MOST = 10, 32  # more directions teach a network little, and slow it
_QUIETEST = 0.5  # noise variance; a sensor quieter than any in training is taken for one of the quietest
_SMALLEST_NOISE = 1e-6  # of the cases' own scatter, where nothing is left outside their directions


class SignalSpace(nn.Module):
    """Standardised coordinates of transients, shape (n_cases, n_coordinates).

    Each coordinate is divided by its standard deviation over the recipe's starts, noise included. With `sees_noise`,
    the noise level outside the directions is the last coordinate.

    Args:
        n_features: values of a case.
        n_components: number of directions.
        sees_noise: whether the noise level is unknown, and may identify a class.

    Attributes:
        nominal: start of the nominal motor, shape (n_features,).
        noise: standard deviation of each value's noise, shape (n_features,).
        directions: orthonormal in units of the noise, shape (n_components, n_features).
        center: mean of each coefficient, shape (n_components,).
        variance: its variance over noise-free starts, shape (n_components,).
        level: mean and standard deviation of the logarithm of the noise's variance, shape (2,).
    """

    nominal: torch.Tensor
    noise: torch.Tensor
    directions: torch.Tensor
    center: torch.Tensor
    variance: torch.Tensor
    level: torch.Tensor

    def __init__(self, n_features: int, n_components: int, *, sees_noise: bool) -> None:
        super().__init__()
        self.sees_noise = sees_noise
        shapes = {
            "nominal": (n_features,),
            "noise": (n_features,),
            "directions": (n_components, n_features),
            "center": (n_components,),
            "variance": (n_components,),
            "level": (2,),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.ones(shape, dtype=torch.float64))

    @classmethod
    def from_recipe(
        cls, recipe: Recipe, n_components: int | None, *, sees_noise: bool, n_references: int = 0
    ) -> SignalSpace:
        """Fit directions, means and variances to a recipe's noise-free starts with `n_references` starts each.

        Raises:
            ValueError: a recipe of motors at work.
        """
        recipe.require_step()
        # The steps of a converter, without noise, would pass for hundreds of directions.
        field = None if recipe.field is None else replace(recipe.field, adc_bits=0)
        silent = replace(recipe, sensor=recipe.sensor.with_noise(0.0), field=field)
        sound = replace(silent, spread=Spread(), classes=(FaultClass(),), healthy_starts=0, field=None)
        nominal = generate_arrays(sound, _FAMILY_SEED, 1).X.reshape(-1).astype(np.float64)
        draw = partial(referenced_starts, n_references=n_references) if n_references else generate_arrays
        family = draw(silent, _FAMILY_SEED, np.arange(_FAMILY_SIZE)).X
        nominal = np.tile(nominal, 1 + n_references)
        noise = np.tile(np.repeat(recipe.sensor.noise_std, recipe.timing.n_samples), 1 + n_references)
        deviation = family.reshape(_FAMILY_SIZE, -1) - nominal
        return cls._spanned(deviation, nominal, noise, n_components, sees_noise=sees_noise)

    @classmethod
    def from_cases(cls, flat: FloatArray, n_components: int | None) -> SignalSpace:
        """Fit directions to given cases about their mean; the remainder is the noise."""
        n_components = _FEWEST if n_components is None else n_components
        nominal = flat.mean(axis=0)
        scatter = flat - nominal
        singular = np.linalg.svd(scatter, compute_uv=False)
        left = np.sqrt(np.square(singular[n_components:]).sum() / flat.size)
        noise = max(float(left), _SMALLEST_NOISE * float(np.sqrt(np.square(scatter).mean())), 1e-30)
        return cls._spanned(scatter, nominal, np.full(flat.shape[1], noise), n_components, sees_noise=False)

    @classmethod
    def _spanned(
        cls,
        scatter: FloatArray,
        nominal: FloatArray,
        noise: FloatArray,
        n_components: int | None,
        *,
        sees_noise: bool,
    ) -> SignalSpace:
        """Return coordinates from deviations of noise-free starts, shape (n_starts, n_features)."""
        deviation = scatter / noise
        singular, directions = np.linalg.svd(deviation, full_matrices=False)[1:]
        if n_components is None:
            visible = int((singular > _VISIBLE * np.sqrt(len(deviation))).sum())
            n_components = min(max(visible, _FEWEST), _MOST)
        directions = directions[: min(n_components, len(noise) - sees_noise)]
        # Within those, the principal axes of the coefficients: then one number each makes them comparable.
        coefficients = deviation @ directions.T
        center = coefficients.mean(axis=0)
        axes = np.linalg.svd(coefficients - center, full_matrices=False)[2]
        rotated = (coefficients - center) @ axes.T
        space = cls(len(noise), len(axes), sees_noise=sees_noise)
        values = {
            "nominal": nominal,
            "noise": noise,
            "directions": axes @ directions,
            "center": axes @ center,
            "variance": rotated.var(axis=0),
        }
        for name, value in values.items():
            getattr(space, name).copy_(torch.from_numpy(np.asarray(value)))
        return space

    def observe_level(self, standardised: torch.Tensor) -> None:
        """Centre and scale the noise-level coordinate, from coordinates of noisy cases."""
        if self.sees_noise:
            log_level = standardised[:, -1] * self.level[1] + self.level[0]
            self.level.copy_(torch.stack([log_level.mean(), log_level.std()]))

    @property
    def n_coordinates(self) -> int:
        """Number of coordinates."""
        return len(self.center) + self.sees_noise

    @property
    def freedom(self) -> int:
        """Degrees of freedom outside the directions."""
        return len(self.noise) - len(self.center)

    def coordinates(self, X: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return coefficients in units of the noise, (n, n_components), and squares left outside, (n,)."""
        deviation = (X - self.nominal) / self.noise
        coefficients = deviation @ self.directions.T
        if not self.sees_noise:
            return coefficients, coefficients.new_zeros(len(coefficients))
        left = deviation - coefficients @ self.directions
        return coefficients, left.square().sum(dim=1)

    def standardise(self, coefficients: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
        """Scale coordinates to unit variance over the recipe's starts."""
        if not self.sees_noise:
            return (coefficients - self.center) / torch.sqrt(self.variance + 1.0)
        level = (energy / self.freedom).clamp(min=_QUIETEST)
        scaled = (coefficients - self.center) / torch.sqrt(self.variance + level[:, None])
        log_level = (torch.log(level) - self.level[0]) / self.level[1]
        return torch.cat([scaled, log_level[:, None]], dim=1)

    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """Return standardised coordinates of flattened cases, shape (n_cases, n_coordinates)."""
        return self.standardise(*self.coordinates(X))


def with_more_noise(
    coefficients: torch.Tensor,
    energy: torch.Tensor,
    freedom: int,
    factor: FloatArray,
    generator: np.random.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return `SignalSpace.coordinates` of starts under more noise.

    White noise along orthonormal directions is white. Outside, the noise n adds to the remainder v:
    |v + n|^2 is (|v| + n_1)^2 plus a chi-square with one degree of freedom less.

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
    """Yield batches of standardised coordinates, and the cases with their truth.

    Args:
        space: in single precision.
        recipe: distribution of the cases.
        seed: of the stream.
        batch_size: cases of a batch.
        most_noise: largest factor on the recipe's noise, log-uniform from 1 on.
        n_references: healthy starts of the same motor with each case.
    """
    generator = np.random.default_rng(seed)
    for number in count():
        cases = np.arange(number * batch_size, (number + 1) * batch_size)
        batch = referenced_starts(recipe, seed, cases, n_references)
        coordinates = space.coordinates(torch.from_numpy(batch.X.reshape(len(batch), -1)))
        if most_noise > 1.0:
            factor = np.exp(generator.uniform(0.0, math.log(most_noise), len(batch)))
            coordinates = with_more_noise(*coordinates, space.freedom, factor, generator)
        yield space.standardise(*coordinates), batch
