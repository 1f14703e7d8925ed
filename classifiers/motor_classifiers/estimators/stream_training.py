"""Training that never sees a case twice: fresh starts of a recipe at every step, nothing stored."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, count, islice

import numpy as np
import torch
from torch import nn

from motor_classifiers.estimators.perceptron import initialise, perceptron
from motor_classifiers.estimators.reference_starts import drawn_starts
from motor_classifiers.estimators.signal_space import SignalSpace
from motor_datasets.arrays import Dataset
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

Batch = tuple[torch.Tensor, torch.Tensor]
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

_LAST_SHARE, _LARGER = 0.3, 4  # the last steps have larger batches: less noise where it matters
_WARM_UP = 100  # steps
_AVERAGED = 0.999  # share that stays of the moving average of the weights (Polyak & Juditsky 1992)
_AVERAGE_BEGINS = 20


class Posterior(nn.Module):
    """Coordinates of a transient and a perceptron on them: from flattened cases to the numbers of a posterior."""

    def __init__(self, space: SignalSpace, n_hidden: int, n_layers: int, n_out: int) -> None:
        super().__init__()
        self.space = space
        self.network = perceptron(space.n_coordinates, n_hidden, n_layers, n_out)

    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """Outputs of the network, shape (n_cases, n_out)."""
        outputs: torch.Tensor = self.network(self.space(X))
        return outputs


def louder(
    coefficients: torch.Tensor,
    energy: torch.Tensor,
    freedom: int,
    factor: FloatArray,
    generator: np.random.Generator,
) -> Batch:
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
        found = space.coordinates(torch.from_numpy(batch.X.reshape(len(batch), -1)))
        if most_noise > 1.0:
            factor = np.exp(generator.uniform(0.0, math.log(most_noise), len(batch)))
            found = louder(*found, space.freedom, factor, generator)
        yield space.standardise(*found), batch


def growing(make: Callable[[int, int], Iterator[Batch]], batch_size: int, steps: int) -> Iterable[Batch]:
    """The batches of a training: `make(part, batch_size)` begins a stream, and another one for the last steps."""
    last = round(_LAST_SHARE * steps)
    return chain(islice(make(0, batch_size), steps - last), islice(make(1, _LARGER * batch_size), last))


def total_cases(batch_size: int, steps: int) -> int:
    """Cases of the batches of a training."""
    last = round(_LAST_SHARE * steps)
    return batch_size * (steps - last + _LARGER * last)


def train_on_batches(
    network: nn.Sequential,
    batches: Iterable[Batch],
    loss: Loss,
    generator: torch.Generator,
    *,
    steps: int,
    learning_rate: float,
    weight_decay: float = 0.0,
    on_step: Callable[[int], object] = lambda done: None,
) -> None:
    """Minimise the mean loss by AdamW, the rate falling along a cosine (Loshchilov & Hutter 2019).

    What is kept is a moving average of the weights: it forgets the steps' noise, as larger batches would.
    """
    initialise(network, generator)
    nn.init.zeros_(network[-1].weight)  # type: ignore[arg-type]  # the last layer is linear
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=learning_rate, weight_decay=weight_decay, betas=(0.9, 0.99)
    )
    average = copy.deepcopy(network)
    network.train()
    for step, (inputs, targets) in enumerate(batches):
        rate = learning_rate * min(1.0, step / _WARM_UP) * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        for group in optimiser.param_groups:
            group["lr"] = rate
        optimiser.zero_grad()
        loss(network(inputs), targets).backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimiser.step()
        kept = min(_AVERAGED, step / (step + _AVERAGE_BEGINS))
        with torch.no_grad():
            for mean, weight in zip(average.parameters(), network.parameters(), strict=True):
                mean.lerp_(weight, 1.0 - kept)
        on_step(step + 1)
    network.load_state_dict(average.state_dict())
    network.eval()
