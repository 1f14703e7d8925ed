"""What a motor file does not know: values that a recording could not tell, where they come from, and who needs them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

from motor_env.motor.data_sheet import Motor
from motor_env.motor.parameters import MotorParameters, require

_K = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad")
_J, _B, _V = "rotor_inertia_kg_m2", "viscous_friction_n_m_s_per_rad", "nominal_voltage_v"
_GUESS = "a guess, 1/100 of the voltage: the current alone tells K^2/J and B/J, not K, J and B"


def assumptions(quantities: Sequence[str], *, has_voltage: bool) -> dict[str, str]:
    """Key and source of each value of a motor file that starts with these quantities do not tell."""
    assumed: dict[str, str] = {}
    if not any(name in ("K", "K/V") for name in quantities):
        assumed |= dict.fromkeys(_K, _GUESS)
        assumed[_J] = "follows from the guess of the torque constant and the measured K^2/J"
        assumed[_B] = "follows from that inertia and the measured B/J"
    if not has_voltage:
        assumed[_V] = "unknown: the supply counts as 1 V, and R, L, K, J and B are per volt"
    return assumed


def usable_parameters(motor: Motor, *, needs_speed: bool) -> MotorParameters:
    """The motor's parameters, for a simulation; a guess that spoils it is refused, one that does not is warned of.

    Raises:
        ValueError: the voltage is unknown, or speeds are needed and the torque constant is a guess.
    """
    require(
        _V not in motor.assumed,
        f"{motor.name}: its voltage is unknown, so that nothing of it can be simulated: commission or identify it with"
        " --voltage",
    )
    if _K[0] in motor.assumed:
        told = (
            f"{motor.name}: torque constant, inertia and friction are assumed ({motor.assumed[_K[0]]}); commission or"
            " identify it with a speed, or with --torque-constant"
        )
        require(not needs_speed, told)
        warnings.warn(f"{told}. Currents are right, speeds and torques are not", stacklevel=3)
    return motor.parameters


def lines(assumed: Mapping[str, str]) -> list[str]:
    """One line for each assumed value."""
    return [f"  assumed: {key}, {source}" for key, source in assumed.items()]
