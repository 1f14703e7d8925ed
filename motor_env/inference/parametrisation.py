"""Coordinates of motors around a nominal one, and the exact discrete models there with their slopes.

Coordinates turn a vector of numbers into motors and supplies. The equations of the motor are those of `discretize`;
only their slopes are taken here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motor_env.motor.model import N_STATES, Input, discretize
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray, MotorParameters, require

_FIELDS: dict[str, tuple[str, ...]] = {"supply": (), **QUANTITY_FIELDS}

QUANTITIES = tuple(_FIELDS)
"""What a fit can free: a factor on the supply, or on a parameter; `constants` is one common factor on Kt and Kb."""

# Of a relative change: truncation and rounding of a central difference are both near 1e-10.
_DIFFERENCE = 1e-5


@dataclass(frozen=True, slots=True)
class Coordinates:
    """Coordinates z of motors around a nominal one.

    A factor is exp(scale z) where `logarithmic`, else 1 + scale z; z = 0 is the nominal motor.

    Attributes:
        nominal: the motor at z = 0.
        names: the quantities that are free, of `QUANTITIES`; all others stay at their nominal values.
        scales: relative change of each for a unit of its coordinate, all > 0.
        logarithmic: whether factors are exponentials.
    """

    nominal: MotorParameters
    names: tuple[str, ...]
    scales: tuple[float, ...]
    logarithmic: bool = True

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in _FIELDS]
        require(
            not unknown, f"free must be among {', '.join(QUANTITIES)}, got {', '.join(map(repr, unknown))}"
        )
        require(
            len(set(self.names)) == len(self.names), f"free must be distinct, got {', '.join(self.names)}"
        )
        require(
            len(self.names) == len(self.scales) and all(scale > 0.0 for scale in self.scales),
            f"scales must be one positive number for each of {', '.join(self.names)}, got {self.scales}",
        )

    @classmethod
    def from_names(cls, nominal: MotorParameters, names: tuple[str, ...]) -> Coordinates:
        """Natural logarithms of the factors."""
        return cls(nominal, tuple(names), (1.0,) * len(names))

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    def factors(self, values: FloatArray) -> FloatArray:
        """Factors on the nominal values, shape (..., size), for coordinates of that shape."""
        scaled = values * np.asarray(self.scales)
        factors: FloatArray = np.exp(scaled) if self.logarithmic else 1.0 + scaled
        return factors

    def motors(self, values: FloatArray) -> tuple[MotorParameters, FloatArray]:
        """Motors and supply factors, both of batch shape (...), for coordinates of shape (..., size)."""
        factors = dict(zip(self.names, np.moveaxis(self.factors(values), -1, 0), strict=True))
        supply = factors.pop("supply", np.ones(values.shape[:-1]))
        by_field = {field: factor for name, factor in factors.items() for field in _FIELDS[name]}
        return self.nominal.scaled(**by_field), supply


Model = tuple[FloatArray, FloatArray]
"""A and B of x[k+1] = A x[k] + B [v[k], load[k]], v nominal: the supply's factor is in B; shapes (n, 2, 2)."""


def model_slopes(coordinates: Coordinates, values: FloatArray, dt_s: float) -> tuple[Model, Model]:
    """Exact discrete models at the coordinates (n, size), and their derivatives, each (n, size, 2, 2)."""
    steps = _DIFFERENCE / np.asarray(coordinates.scales)
    size = coordinates.size
    shifted = values[:, None, :] + np.concatenate([np.zeros((1, size)), np.diag(steps), -np.diag(steps)])
    motors, supply = coordinates.motors(shifted)
    model = discretize(motors, dt_s)
    transition = np.broadcast_to(model.transition, (*supply.shape, N_STATES, N_STATES)).copy()
    gain = np.broadcast_to(model.gain, (*supply.shape, N_STATES, len(Input))).copy()
    gain[..., Input.VOLTAGE] *= supply[..., None]
    steps = 2.0 * steps[:, None, None]
    centre = np.ascontiguousarray(transition[:, 0]), np.ascontiguousarray(gain[:, 0])
    up, down = slice(1, 1 + size), slice(1 + size, None)
    return centre, ((transition[:, up] - transition[:, down]) / steps, (gain[:, up] - gain[:, down]) / steps)
