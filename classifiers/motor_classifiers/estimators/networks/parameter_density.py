"""What a network learns of a motor's parameters, given fault and severity: a normal density of their logarithms.

Given the fault, a start is nearly linear in the few per cent by which parameters scatter, so their posterior is nearly
normal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from motor_datasets.arrays import Dataset
from motor_env.motor.parameters import FloatArray

PARAMETERS = (
    "voltage_v",
    "resistance_ohm",
    "back_emf_constant_v_s_per_rad",
    "inertia_kg_m2",
    "viscous_friction_n_m_s_per_rad",
)
"""Parameters that scatter from motor to motor, in the order of the columns."""

N_OUT = len(PARAMETERS) * (len(PARAMETERS) + 3) // 2
"""Numbers of a density: its mean, and the lower triangle of the matrix that makes deviations standard normal."""

_BELOW = torch.tril_indices(len(PARAMETERS), len(PARAMETERS), -1)
_CONSTANT = 1e-9  # spread of a logarithm below which a parameter is known


class Scales(NamedTuple):
    """What makes the logarithms of the parameters comparable, shape (n_parameters,) each."""

    center: FloatArray
    width: FloatArray

    @classmethod
    def of(cls, batch: Dataset) -> Scales:
        """Means and widths over the cases of a recipe; a parameter that does not scatter keeps the width 1."""
        logs = logarithms(batch)
        width = logs.std(axis=0)
        return cls(logs.mean(axis=0), np.where(width > _CONSTANT, width, 1.0))

    def standard(self, batch: Dataset) -> torch.Tensor:
        """Standardised logarithms of the parameters, shape (n, n_parameters)."""
        return torch.from_numpy((logarithms(batch) - self.center) / self.width).float()


def logarithms(batch: Dataset) -> FloatArray:
    """Logarithms of the parameters of each motor, shape (n, n_parameters)."""
    return np.log(np.column_stack([batch.parameters[name] for name in PARAMETERS]))


def given_fault(kinds: torch.Tensor, position: torch.Tensor, n_kinds: int) -> torch.Tensor:
    """What the network is told of the fault: the position of its kind in its range, 0 for all others, (n, n_kinds)."""
    told = position.new_zeros(len(kinds), n_kinds)
    told[torch.arange(len(kinds)), kinds] = position
    return told


def _whitening(outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Means (n, p) and lower triangular matrices (n, p, p)."""
    size = len(PARAMETERS)
    matrix = torch.diag_embed(torch.exp(outputs[:, size : 2 * size]))
    matrix[:, _BELOW[0], _BELOW[1]] = outputs[:, 2 * size :]
    return outputs[:, :size], matrix


def parameter_loss(outputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean negative log density of standardised logarithms, up to a constant; outputs (n, N_OUT), targets (n, p)."""
    mean, matrix = _whitening(outputs)
    white = (matrix @ (targets - mean)[:, :, None])[:, :, 0]
    size = len(PARAMETERS)
    return (0.5 * white.square().sum(dim=1) - outputs[:, size : 2 * size].sum(dim=1)).mean()


def drawn(outputs: torch.Tensor, scales: Scales, rng: np.random.Generator) -> FloatArray:
    """One draw of the parameters from each density, shape (n, n_parameters), in SI units."""
    mean, matrix = _whitening(outputs)
    white = torch.from_numpy(rng.standard_normal(mean.shape)).to(mean.dtype)
    away = torch.linalg.solve_triangular(matrix, white[:, :, None], upper=False)[:, :, 0]
    values: FloatArray = np.exp(scales.center + scales.width * (mean + away).numpy())
    return values
