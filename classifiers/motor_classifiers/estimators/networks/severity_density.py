"""Density of a severity from a network: normal, truncated to the range.

A transient's log-likelihood is nearly quadratic in the severity, so two numbers suffice. Sums run over one fine grid,
by operations of ONNX. Positions run from 0 to 1 over the range.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from motor_env.inference.posterior import SeverityPrior
from motor_env.motor.faults import FaultKind
from motor_env.simulation.recipes import FaultClass, Recipe

PARAMETERS = 2
"""Numbers of a density: location, and logarithm of the width."""

_GRID = 201
_MIDDLE, _LOG_WIDTH = 0.5, -1.0  # of a network's zeros
_ALWAYS = (FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT)
_LEAST_RANGE, _BEYOND, _LARGEST_LOSS = 0.30, 1.2, 0.95


def severity_priors(recipe: Recipe) -> tuple[SeverityPrior, ...]:
    """Return ranges of severities by kind: from 0 to 30 %, or to 1.2 times the largest of the recipe's classes."""
    largest: dict[FaultKind, float] = dict.fromkeys(_ALWAYS, _LEAST_RANGE)
    for part in (part for c in recipe.classes for part in c.parts):
        if part.kind is not None:
            top = _BEYOND * part.largest_severity
            largest[part.kind] = max(largest.get(part.kind, 0.0), top)
    return tuple(
        SeverityPrior(kind, 0.0, min(to, _LARGEST_LOSS) if kind.loses else to) for kind, to in largest.items()
    )


def severity_recipe(recipe: Recipe, *, with_healthy: bool = False) -> Recipe:
    """Return the recipe with one class a kind, its severity uniform over the range of `severity_priors`.

    Args:
        recipe: motor, nuisances, faults and sensor.
        with_healthy: whether to append a healthy class that is never drawn, for reference starts.
    """
    classes = [FaultClass(p.kind, 0.0, severity_to=p.largest) for p in severity_priors(recipe)]
    if with_healthy:
        classes.append(FaultClass(weight=0.0))
    return replace(recipe, classes=tuple(classes), healthy_starts=0, shifts=())


def grid_like(parameters: torch.Tensor) -> torch.Tensor:
    """Return the grid of positions, in the type of the parameters."""
    return torch.linspace(0.0, 1.0, _GRID, dtype=parameters.dtype)


def _log_density(parameters: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Return the unnormalised log density; parameters (..., 2), position (..., n) or (n,)."""
    deviation = (position - _MIDDLE - parameters[..., :1]) * torch.exp(-_LOG_WIDTH - parameters[..., 1:2])
    return -0.5 * deviation.square()


def _log_mass(parameters: torch.Tensor) -> torch.Tensor:
    edge = torch.arange(_GRID) % (_GRID - 1) == 0
    mass = torch.where(edge, 0.5, 1.0) / (_GRID - 1)
    return torch.log(mass.to(parameters.dtype))


def negative_log_likelihood(parameters: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Return the loss of each position, shape (n,), under its density, (n, 2), relative to the uniform prior."""
    total = torch.logsumexp(_log_density(parameters, grid_like(parameters)) + _log_mass(parameters), dim=-1)
    return total - _log_density(parameters, position[:, None])[:, 0]


def weights(parameters: torch.Tensor) -> torch.Tensor:
    """Return the probability of each grid point, shape (..., n_grid)."""
    return torch.softmax(_log_density(parameters, grid_like(parameters)) + _log_mass(parameters), dim=-1)


def mean(share: torch.Tensor) -> torch.Tensor:
    """Return the mean position of weights, shape (...)."""
    return share @ grid_like(share)


def quantile(share: torch.Tensor, probability: float) -> torch.Tensor:
    """Return the position quantile of weights, shape (...)."""
    # Half of a point's weight lies on either side of it.
    cumulated = torch.cumsum(share, dim=-1) - 0.5 * share
    above = (cumulated < probability).sum(dim=-1, keepdim=True).clamp(1, _GRID - 1)
    high = torch.gather(cumulated, -1, above)
    low = torch.gather(cumulated, -1, above - 1)
    between = ((probability - low) / (high - low).clamp(min=1e-30)).clamp(0.0, 1.0)
    return ((above - 1 + between) / (_GRID - 1))[..., 0].to(share.dtype)


def summary(parameters: torch.Tensor, tail: float) -> torch.Tensor:
    """Return mean, lower and upper quantile with tails `tail`, shape (3, ...)."""
    share = weights(parameters)
    return torch.stack([mean(share), quantile(share, tail), quantile(share, 1.0 - tail)])


def severity_loss(outputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Return the mean negative log-likelihood of severities under the densities of their kinds.

    Args:
        outputs: shape (n, n_kinds * 2).
        targets: index of the kind and position in its range, shape (n, 2).
    """
    densities = outputs.reshape(len(outputs), -1, PARAMETERS)
    own = densities[torch.arange(len(outputs)), targets[:, 0].long()]
    return negative_log_likelihood(own, targets[:, 1]).mean()
