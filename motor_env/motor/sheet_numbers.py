"""The numbers of a data sheet: their units, what follows from them, what they contradict and what they lack."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from motor_env.motor.parameters import RAD_S_PER_RPM, require

_OUNCE_KG, _INCH_M, _G = 0.45359237 / 16.0, 0.0254, 9.80665
_TORQUES = {
    "n_m": 1.0,
    "mnm": 1e-3,
    "oz_in": _OUNCE_KG * _G * _INCH_M,
    "kg_cm": _G * 1e-2,
    "g_cm": _G * 1e-5,
}


def _torques(name: str, per: str = "", factor: float = 1.0) -> dict[str, float]:
    """Keys of a torque, or of a torque over another unit."""
    return {f"{name}_{unit}{per}": size * factor for unit, size in _TORQUES.items()}


def _of(units: Mapping[str, float], *names: str) -> dict[str, float]:
    """Keys of a quantity that has several names."""
    return {f"{name}_{unit}": size for name in names for unit, size in units.items()}


_CURRENTS, _TIMES = {"a": 1.0, "ma": 1e-3}, {"s": 1.0, "ms": 1e-3}
UNITS: dict[str, dict[str, float]] = {
    "resistance_ohm": {"resistance_ohm": 1.0, "resistance_mohm": 1e-3},
    "inductance_h": {"inductance_h": 1.0, "inductance_mh": 1e-3, "inductance_uh": 1e-6},
    "torque_constant_n_m_per_a": _torques("torque_constant", "_per_a"),
    "back_emf_constant_v_s_per_rad": {
        "back_emf_constant_v_s_per_rad": 1.0,
        "back_emf_constant_v_per_krpm": 1e-3 / RAD_S_PER_RPM,
        "back_emf_constant_mv_per_rpm": 1e-3 / RAD_S_PER_RPM,
    },
    "inertia_kg_m2": {
        "rotor_inertia_kg_m2": 1.0,
        "rotor_inertia_g_cm2": 1e-7,
        "rotor_inertia_kg_cm2": 1e-4,
        "rotor_inertia_oz_in_s2": _TORQUES["oz_in"],
        "rotor_inertia_oz_in2": _OUNCE_KG * _INCH_M**2,
    },
    "viscous_friction_n_m_s_per_rad": {
        "viscous_friction_n_m_s_per_rad": 1.0,
        **_torques("viscous_friction", "_per_krpm", 1e-3 / RAD_S_PER_RPM),
    },
    "no_load_current_a": _of(_CURRENTS, "no_load_current", "free_current"),
    "no_load_speed_rad_s": _of(
        {"rad_s": 1.0, "rpm": RAD_S_PER_RPM, "krpm": 1e3 * RAD_S_PER_RPM}, "no_load_speed", "free_speed"
    ),
    "speed_constant_rpm_per_v": {
        "speed_constant_rpm_per_v": 1.0,
        "speed_constant_krpm_per_v": 1e3,
        "kv_rpm_per_v": 1.0,
    },
    "stall_current_a": _of(_CURRENTS, "stall_current"),
    "stall_torque_n_m": _torques("stall_torque"),
    "mechanical_time_constant_s": _of(_TIMES, "mechanical_time_constant"),
    "electrical_time_constant_s": _of(_TIMES, "electrical_time_constant"),
    "coulomb_friction_n_m": _torques("coulomb_friction"),
    "brush_drop_v": {"brush_drop_v": 1.0},
    "nominal_voltage_v": {"nominal_voltage_v": 1.0},
}
"""Quantity: the keys that give it, each with its factor; the first key is the one that is written."""

# Of two numbers of a sheet for one quantity: sheets round, and K falls with warmth. Points of a curve are read roughly.
_LARGEST_DISAGREEMENT, _REFUSED = 0.10, 0.30
_K = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad")
_SPEED_CONSTANT, _J, _L = "speed_constant_rpm_per_v", "inertia_kg_m2", "inductance_h"
_USUAL_NO_LOAD = 0.03  # of the stall current
_USUAL_S = {_J: 0.02, _L: 0.001}  # mechanical and electrical time constant


def in_si(numbers: Mapping[str, float]) -> dict[str, float]:
    """Quantities in SI units, of the numbers by their keys.

    Raises:
        ValueError: a quantity is given twice.
    """
    si: dict[str, float] = {}
    for quantity, keys in UNITS.items():
        stated = [key for key in keys if key in numbers]
        require(len(stated) < 2, f"motor gives {' and '.join(stated)}; give one of them")
        if stated:
            si[quantity] = numbers[stated[0]] * keys[stated[0]]
    return si


def complete(
    si: dict[str, float], numbers: Mapping[str, float], *, may_guess: bool
) -> tuple[list[str], list[str]]:
    """Add resistance, constants, inductance and inertia that the others tell.

    Args:
        si: quantities, to which they are added.
        numbers: by their keys, as they were given.
        may_guess: whether an inductance or an inertia that nothing tells is guessed.

    Returns:
        Notes on what is odd, and the guessed quantities.

    Raises:
        ValueError: a quantity is missing, or two contradict each other.
    """
    behind_v = si.get("nominal_voltage_v", 0.0) - si.get("brush_drop_v", 0.0)
    if behind_v > 0.0 and "stall_current_a" in si:
        si.setdefault("resistance_ohm", behind_v / si["stall_current_a"])
    require(
        "resistance_ohm" in si,
        "motor.resistance_ohm is missing (or motor.stall_current_a with motor.nominal_voltage_v)",
    )
    notes = _add_constants(si, numbers, behind_v)
    guessed = [quantity for quantity in (_J, _L) if not _follows_from_time(si, quantity)]
    for quantity, usual_key in ((_L, "inductance_mh"), (_J, "rotor_inertia_g_cm2")):
        require(may_guess or quantity not in guessed, f"motor.{usual_key} is missing")
    return [*notes, *_odd(si, guessed, behind_v)], guessed


def _add_constants(si: dict[str, float], numbers: Mapping[str, float], behind_v: float) -> list[str]:
    """Add torque and back-EMF constant; return notes on points that contradict them a little.

    In SI units they are one number, so either stands for the other. Without both it follows from the no-load point, or
    from the stall.
    """
    stated = {name: si[name] for name in _K if name in si}
    if _SPEED_CONSTANT in si:
        require(_K[1] not in si, "motor gives a speed constant and a back-EMF constant; give one of them")
        stated[_K[1]] = 1.0 / (si[_SPEED_CONSTANT] * RAD_S_PER_RPM)
    points = {}
    if behind_v > 0.0 and {"no_load_current_a", "no_load_speed_rad_s"} <= si.keys():
        stall = behind_v / si["resistance_ohm"]
        require(
            si["no_load_current_a"] < stall,
            f"motor gives a no-load current of {si['no_load_current_a']:.4g} A, and its resistance lets {stall:.4g} A"
            " flow at standstill; correct one",
        )
        induced_v = behind_v - si["resistance_ohm"] * si["no_load_current_a"]
        points["(V - R i0) / w0 of its no-load point"] = (
            induced_v / si["no_load_speed_rad_s"],
            "no_load_speed_rad_s",
            -1.0,
        )
    if {"stall_torque_n_m", "stall_current_a"} <= si.keys():
        points["its stall torque over the stall current"] = (
            si["stall_torque_n_m"] / si["stall_current_a"],
            "stall_torque_n_m",
            1.0,
        )
    require(
        bool(stated or points),
        "motor.torque_constant_mnm_per_a (or motor.speed_constant_rpm_per_v) is missing, and neither a no-load point"
        " with motor.nominal_voltage_v nor a stall torque and current tell it",
    )
    one = next(iter([*stated.values(), *(value for value, *_ in points.values())]))
    torque, back_emf = (stated.get(name, one) for name in _K)
    require(
        _agree(torque, back_emf),
        f"motor gives a torque constant of {torque:.4g} N m/A and a back-EMF constant of {back_emf:.4g} V s/rad, which"
        f" are one number in SI units; correct one, or leave it out"
        f"{_unit_hint(numbers, _keys_of(torque) | {_K[0]: back_emf})}",
    )
    notes = []
    for words, (value, quantity, power) in points.items():
        apart = max(value, back_emf) / min(value, back_emf) - 1.0
        wanted = _keys_of(value) | {_K[0]: value, quantity: si[quantity] * (back_emf / value) ** power}
        contradiction = (
            f"motor gives a constant of {back_emf:.4g} V s/rad, but {words} is {value:.4g}; correct the one that is"
            f" wrong{_unit_hint(numbers, wanted)}"
        )
        require(apart < _REFUSED, contradiction)
        notes += [contradiction] if apart >= _LARGEST_DISAGREEMENT else []
    si |= zip(_K, (torque, back_emf), strict=True)
    return notes


def _keys_of(back_emf: float) -> dict[str, float]:
    return {_K[1]: back_emf, _SPEED_CONSTANT: 1.0 / (back_emf * RAD_S_PER_RPM)}


def _unit_hint(numbers: Mapping[str, float], wanted: Mapping[str, float]) -> str:
    """Name the key of another unit with which a number would give the wanted quantity; empty if none does."""
    for quantity, value in wanted.items():
        for key in UNITS[quantity].keys() & numbers.keys():
            for other, factor in UNITS[quantity].items():
                if _agree(numbers[key] * factor, value):
                    return f": {key} = {numbers[key]:g} looks like {other}"
    return ""


def _agree(first: float, second: float) -> bool:
    return abs(math.log(first / second)) <= _LARGEST_DISAGREEMENT


def _follows_from_time(si: dict[str, float], quantity: str) -> bool:
    """Whether inertia or inductance are given, or follow from their time constant; else a usual one is added.

    Raises:
        ValueError: both are given, and contradict each other.
    """
    squared = si[_K[0]] * si[_K[1]]
    word, formula, factor = {
        _J: (
            "mechanical",
            "R J / (Kt Kb) of its resistance, inertia and constants",
            squared / si["resistance_ohm"],
        ),
        _L: ("electrical", "L / R of its inductance and resistance", si["resistance_ohm"]),
    }[quantity]
    stated = si.get(f"{word}_time_constant_s")
    if quantity in si and stated is not None:
        follows = si[quantity] / factor
        require(
            _agree(stated, follows),
            f"motor gives an {word} time constant of {1e3 * stated:.4g} ms, but {formula} is {1e3 * follows:.4g} ms;"
            " correct the one that is wrong",
        )
    is_known = quantity in si or stated is not None
    si.setdefault(quantity, (_USUAL_S[quantity] if stated is None else stated) * factor)
    return is_known


def _odd(si: Mapping[str, float], guessed: list[str], behind_v: float) -> Iterator[str]:
    """Note numbers that no usual motor has: mostly a unit or a decimal point is wrong."""
    squared = si[_K[0]] * si[_K[1]]
    rows = {
        "L / R": (si[_L] / si["resistance_ohm"], 0.0, 0.1, "s", _L),
        "R J / (Kt Kb)": (si["resistance_ohm"] * si[_J] / squared, 1e-4, 10.0, "s", _J),
        "the no-load speed V / K": (behind_v / si[_K[1]] / RAD_S_PER_RPM or 1e3, 50.0, 2e5, "rpm", ""),
    }
    for words, (value, low, high, unit, quantity) in rows.items():
        if not low <= value <= high and quantity not in guessed:
            yield f"{words} is {value:.4g} {unit}, which no usual motor has: are the units right?"
