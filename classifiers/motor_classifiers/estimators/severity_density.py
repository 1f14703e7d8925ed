"""The density of a severity between two bounds: a normal one, cut at the bounds.

The logarithm of a transient's likelihood is nearly quadratic in the severity once the nuisances are integrated out, so
two numbers, which a network gives, are enough (docs/classifiers.md). Everything is summed over one fine grid, in steps
that ONNX has too. Severities here run from 0 (the smallest of the range) to 1 (the largest).
"""

from __future__ import annotations

import math

import torch

PARAMETERS = 2
"""Numbers of a density: where it lies, and the logarithm of how wide it is."""

_GRID = 201
_MIDDLE, _LOG_WIDTH = 0.5, -1.0  # of a network's zeros


def grid_like(parameters: torch.Tensor) -> torch.Tensor:
    """The grid of positions, in the type of the parameters."""
    return torch.linspace(0.0, 1.0, _GRID, dtype=parameters.dtype)


def _log_density(parameters: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Without the normalisation; parameters (..., 2), position (..., n) or (n,)."""
    off = (position - _MIDDLE - parameters[..., :1]) * torch.exp(-_LOG_WIDTH - parameters[..., 1:2])
    return -0.5 * off.square()


def _log_mass(parameters: torch.Tensor) -> torch.Tensor:
    """Logarithm of each grid point's share of the prior, by the trapezoid's rule."""
    edge = torch.arange(_GRID) % (_GRID - 1) == 0
    mass = torch.where(edge, 0.5, 1.0) / (_GRID - 1)
    return torch.log(mass.to(parameters.dtype))


def negative_log_likelihood(parameters: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Of each position, shape (n,), under its density, (n, 2), relative to the uniform prior."""
    total = torch.logsumexp(_log_density(parameters, grid_like(parameters)) + _log_mass(parameters), dim=-1)
    return total - _log_density(parameters, position[:, None])[:, 0]


def weights(parameters: torch.Tensor) -> torch.Tensor:
    """Probability of each grid point, shape (..., n_grid)."""
    return torch.softmax(_log_density(parameters, grid_like(parameters)) + _log_mass(parameters), dim=-1)


def mean(share: torch.Tensor) -> torch.Tensor:
    """Mean position of weights, shape (...)."""
    return share @ grid_like(share)


def quantile(share: torch.Tensor, probability: float) -> torch.Tensor:
    """Position below which the weights hold the probability, shape (...)."""
    if not 0.0 < probability < 1.0 or math.isnan(probability):
        raise ValueError(f"probability must be in (0, 1), got {probability:g}")
    # Half of a point's weight lies on either side of it.
    cumulated = torch.cumsum(share, dim=-1) - 0.5 * share
    above = (cumulated < probability).sum(dim=-1, keepdim=True).clamp(1, _GRID - 1)
    high = torch.gather(cumulated, -1, above)
    low = torch.gather(cumulated, -1, above - 1)
    between = ((probability - low) / (high - low).clamp(min=1e-30)).clamp(0.0, 1.0)
    return ((above - 1 + between) / (_GRID - 1))[..., 0].to(share.dtype)
