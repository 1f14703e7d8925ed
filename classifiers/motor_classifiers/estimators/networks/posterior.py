"""Network of a posterior (signal coordinates and a perceptron), and its training."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from typing import Any, Self

import numpy as np
import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from motor_classifiers.estimators.cases import Arrays, loaded_module
from motor_classifiers.estimators.networks.epoch_classifier import perceptron
from motor_classifiers.estimators.networks.signal_space import SignalSpace
from motor_classifiers.estimators.networks.training import Batch, Loss, OnStep, initialise, train
from motor_env.motor.parameters import require

_LAST_SHARE, _LARGER = 0.3, 4  # the last steps have larger batches: less noise where it matters
_WARM_UP = 100  # steps
_AVERAGED = 0.999  # share that stays of the moving average of the weights (Polyak & Juditsky 1992)
_AVERAGE_BEGINS = 20


class Posterior(nn.Module):
    """Map from flattened cases to the numbers of a posterior: signal coordinates, then a perceptron."""

    def __init__(self, space: SignalSpace, *, n_hidden: int, n_layers: int, n_out: int) -> None:
        super().__init__()
        self.space = space
        self.network = perceptron(space.n_coordinates, n_hidden, n_layers, n_out)

    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """Return outputs of the network, shape (n_cases, n_out)."""
        outputs: torch.Tensor = self.network(self.space(X))
        return outputs

    def learn(
        self,
        batches: Callable[[int, int], Iterator[Batch]],
        loss: Loss,
        generator: torch.Generator,
        *,
        steps: int,
        batch_size: int,
        learning_rate: float,
        weight_decay: float = 0.0,
        on_step: OnStep = lambda count: None,
    ) -> None:
        """Minimise the mean loss by AdamW with a cosine schedule (Loshchilov & Hutter 2019).

        The result is a moving average of the weights.

        Args:
            batches: makes a stream from its number (0 first, 1 for the last steps) and batch size.
            loss: of outputs and targets.
            generator: of the initial weights.
            steps: number of batches.
            batch_size: cases of a batch; the last ones are four times as large.
            learning_rate: highest rate.
            weight_decay: of AdamW.
            on_step: called after each step with the cases of its batch.
        """
        network = self.network
        initialise(network, generator)
        nn.init.zeros_(network[-1].weight)  # type: ignore[arg-type]  # the last layer is linear
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=1.0, weight_decay=weight_decay, betas=(0.9, 0.99)
        )
        average = AveragedModel(network, avg_fn=_moving_average)

        def rate(step: int) -> float:
            falling = 0.5 * (1.0 + math.cos(math.pi * step / steps))
            return learning_rate * min(1.0, step / _WARM_UP) * falling

        def after(count: int) -> None:
            average.update_parameters(network)
            on_step(count)

        many = batch_schedule(batches, batch_size, steps)
        train(network, many, loss, LambdaLR(optimiser, rate), on_step=after)
        network.load_state_dict(average.module.state_dict())

    @classmethod
    def from_arrays(
        cls, arrays: Arrays, *, sees_noise: Any, n_features: int, sizes: tuple[Any, Any, int]
    ) -> Self:
        """Restore the network of a file.

        Args:
            arrays: of its part of the file.
            sees_noise: as of `SignalSpace`.
            n_features: values of a case.
            sizes: width of a hidden layer, hidden layers, outputs.

        Raises:
            ValueError, KeyError, TypeError, RuntimeError: values or arrays of a wrong type or shape.
        """
        require(type(sees_noise) is bool, f"sees_noise must be true or false, got {sees_noise!r}")
        types = {values.dtype for values in arrays.values()}
        require(
            types <= {np.dtype(np.float32), np.dtype(np.float64)}, "its numbers are no floating-point ones"
        )
        require(bool((arrays["space.noise"] > 0.0).all()), "its noise must be > 0")
        require(bool((arrays["space.variance"] >= 0.0).all()), "its variances must be >= 0")
        require(not sees_noise or arrays["space.level"][1] > 0.0, "its spread of the noise must be > 0")
        with torch.device("meta"):
            space = SignalSpace(n_features, len(arrays["space.directions"]), sees_noise=sees_noise)
        posterior = cls(space, n_hidden=sizes[0], n_layers=sizes[1], n_out=sizes[2])
        loaded_module(posterior, arrays)
        return posterior


def batch_schedule(
    make: Callable[[int, int], Iterator[Batch]], batch_size: int, steps: int
) -> Iterable[Batch]:
    """Yield the batches of a training: `make(0, size)`, then larger ones of `make(1, size)`."""
    last = round(_LAST_SHARE * steps)
    return chain(islice(make(0, batch_size), steps - last), islice(make(1, _LARGER * batch_size), last))


def total_cases(batch_size: int, steps: int) -> int:
    """Count the cases of the batches of `batch_schedule`."""
    last = round(_LAST_SHARE * steps)
    return batch_size * (steps - last + _LARGER * last)


def _moving_average(
    average: torch.Tensor, weight: torch.Tensor, n_averaged: torch.Tensor | int
) -> torch.Tensor:
    """Update the moving average of a weight, whose memory grows with the steps."""
    done = int(n_averaged)
    return average.lerp(weight, 1.0 - min(_AVERAGED, done / (done + _AVERAGE_BEGINS)))
