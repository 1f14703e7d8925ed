"""The training loop of all networks: on one thread, with its own generator, bit by bit reproducible."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from sklearn.utils import check_random_state
from torch import nn
from torch.optim.lr_scheduler import LRScheduler

Batch = tuple[torch.Tensor, torch.Tensor]
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
OnStep = Callable[[int], object]
"""Called after a step with the cases of its batch."""

_LARGEST_SEED = 2**31 - 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread, for a fixed order of sums."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def seed_of(random_state: int | np.random.RandomState | None) -> int:
    """Return a seed below 2^31 from a random state of scikit-learn."""
    return int(check_random_state(random_state).randint(_LARGEST_SEED))


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw weights by He et al. (2015), with zero biases, from the generator; existing weights stay."""
    if not any(values.is_meta for values in network.parameters()):
        return
    network.to_empty(device="cpu")
    for layer in network.modules():
        if isinstance(layer, nn.Conv1d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.BatchNorm1d):
            layer.reset_parameters()


def train(
    network: nn.Module,
    batches: Iterable[Batch],
    loss: Loss,
    schedule: LRScheduler,
    *,
    on_step: OnStep = lambda count: None,
) -> None:
    """Take one step of the optimiser for each batch.

    Args:
        network: with initial weights.
        batches: inputs and targets; they end when the training ends.
        loss: from outputs and targets to a number.
        schedule: of the learning rate; its optimiser is the one that steps.
        on_step: called after each step with the cases of its batch.
    """
    network.train()
    for inputs, targets in batches:
        schedule.optimizer.zero_grad()
        loss(network(inputs), targets).backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        schedule.optimizer.step()
        schedule.step()
        on_step(len(targets))
    network.eval()
