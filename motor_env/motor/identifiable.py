"""Products of powers of the parameters that a recording determines.

From the current alone, R, L, K^2/J and B/J (K^2 = Kt Kb): scaling K by a, and J and B by a^2, leaves the current as it
is. With the speed: R, L, K, J and B. With the voltage unknown: each over V.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from motor_env.motor.data_sheet import Tolerance
from motor_env.motor.faults import FaultKind, motor_kinds
from motor_env.motor.parameters import (
    COPPER_PER_KELVIN,
    FRICTION_PER_KELVIN,
    MAGNET_PER_KELVIN,
    FloatArray,
    MotorParameters,
)

_QUANTITY_OF = {
    "R": "resistance",
    "L": "inductance",
    "K": "constants",
    "J": "inertia",
    "B": "friction",
    "V": "supply",
}
PARAMETERS = tuple(_QUANTITY_OF)
"""Order of the logarithms; K is the geometric mean of Kt and Kb."""

_NAMES = {
    (True, False): ("R", "L", "K^2/J", "B/J"),
    (True, True): ("R", "L", "K", "J", "B"),
    (False, False): ("R/V", "L/V", "K^2/(J V)", "B/J"),
    (False, True): ("R/V", "L/V", "K/V", "J/V", "B/V"),
}


def names(*, has_voltage: bool, has_speed: bool) -> tuple[str, ...]:
    """Return the names of the identifiable quantities: each a product of parameters over another."""
    return _NAMES[has_voltage, has_speed]


def matrix(quantities: tuple[str, ...]) -> FloatArray:
    """Return the exponents of (R, L, K, J, B, V) in each named quantity, shape (n_quantities, 6)."""
    sides = [name.replace("K^2", "KK").partition("/") for name in quantities]
    return np.array(
        [[float(above.count(p) - below.count(p)) for p in PARAMETERS] for above, _, below in sides]
    )


def logarithms(parameters: MotorParameters, voltage_v: float) -> FloatArray:
    """Return the logarithms of (R, L, K, J, B, V)."""
    p = parameters
    constant = np.sqrt(np.multiply(p.back_emf_constant_v_s_per_rad, p.torque_constant_n_m_per_a))
    friction = np.maximum(p.viscous_friction_n_m_s_per_rad, 1e-300)
    values = [p.resistance_ohm, p.inductance_h, constant, p.inertia_kg_m2, friction, voltage_v]
    out: FloatArray = np.log(np.array(values, dtype=np.float64))
    return out


def warmth_direction(exponents: FloatArray, own: float = 1.0) -> FloatArray:
    """Return the change of the quantities' logarithms per kelvin of warming, shape (n,).

    Args:
        exponents: of (R, L, K, J, B, V) in each quantity, shape (n, 6).
        own: share of the drag that is the motor's own friction.
    """
    friction = own * FRICTION_PER_KELVIN
    moved: FloatArray = exponents @ [COPPER_PER_KELVIN, 0.0, MAGNET_PER_KELVIN, 0.0, friction, 0.0]
    return moved


def tolerance_covariance(tolerance: Tolerance) -> FloatArray:
    """Return the covariance of the logarithms (R, L, K, J, B, V) of healthy motors, with temperature."""
    t = tolerance
    spread = np.array([t.resistance, t.inductance, t.constants, t.inertia, t.friction, t.supply])
    heat = t.temperature_k * np.array([COPPER_PER_KELVIN, 0.0, MAGNET_PER_KELVIN, 0.0, 0.0, 0.0])
    out: FloatArray = np.diag(spread**2) + np.outer(heat, heat)
    return out


def tolerance_std(tolerance: Tolerance) -> dict[str, float]:
    """Return the relative standard deviation of each quantity of `QUANTITY_FIELDS` and the supply, with temperature."""
    std = np.sqrt(np.diag(tolerance_covariance(tolerance)))
    return dict(zip(_QUANTITY_OF.values(), std.tolist(), strict=True))


def fault_direction(kind: FaultKind) -> FloatArray:
    """Return the change of the logarithms (R, L, K, J, B, V) per unit of the fault's logarithm, shape (6,)."""
    return kind.direction(_QUANTITY_OF.values())


def visible_direction(kind: FaultKind, exponents: FloatArray) -> FloatArray:
    """Return the change of the identifiable quantities' logarithms; `exponents` come from `matrix`."""
    direction: FloatArray = exponents @ fault_direction(kind)
    return direction


def nameable_kinds(exponents: FloatArray) -> tuple[FaultKind, ...]:
    """Return the kinds that no coupled load (J and B up together) imitates.

    From the current alone, K down by 10 % (a weak magnet) looks exactly like J and B up by 23.5 %.
    """
    return _nameable(np.ascontiguousarray(exponents, dtype=np.float64).tobytes(), motor_kinds())


@lru_cache(maxsize=64)
def _nameable(exponents: bytes, kinds: tuple[FaultKind, ...]) -> tuple[FaultKind, ...]:
    powers: FloatArray = np.frombuffer(exponents).reshape(-1, len(PARAMETERS))
    load = powers @ np.array([float(name in "JB") for name in PARAMETERS])
    return tuple(
        kind for kind in kinds if not np.allclose(_unit(visible_direction(kind, powers)), _unit(load))
    )


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-300)
