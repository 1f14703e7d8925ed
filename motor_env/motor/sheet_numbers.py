"""Numbers of a data sheet: units, derived values, contradictions and gaps."""

from __future__ import annotations

import math
from collections.abc import Mapping

from motor_env.motor.parameters import RAD_S_PER_RPM, require

_OUNCE_KG, _INCH_M, _G = 0.45359237 / 16.0, 0.0254, 9.80665
_TORQUES = {"n_m": 1.0, "mnm": 1e-3, "oz_in": _OUNCE_KG * _G * _INCH_M, "kg_cm": _G * 1e-2, "g_cm": _G * 1e-5}


def _torques(name: str, per: str = "", factor: float = 1.0) -> dict[str, float]:
    return {f"{name}_{unit}{per}": size * factor for unit, size in _TORQUES.items()}


def _of(units: Mapping[str, float], *names: str) -> dict[str, float]:
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
    "speed_constant_rpm_per_v": _of({"rpm_per_v": 1.0, "krpm_per_v": 1e3}, "speed_constant", "kv"),
    "stall_current_a": _of(_CURRENTS, "stall_current"),
    "stall_torque_n_m": _torques("stall_torque"),
    "mechanical_time_constant_s": _of(_TIMES, "mechanical_time_constant"),
    "electrical_time_constant_s": _of(_TIMES, "electrical_time_constant"),
    "coulomb_friction_n_m": _torques("coulomb_friction"),
    "brush_drop_v": {"brush_drop_v": 1.0},
    "nominal_voltage_v": {"nominal_voltage_v": 1.0},
}
"""Keys of each quantity with their factors to SI; the first key is the one that is written."""

# Of two numbers of a sheet for one quantity: sheets round, and K falls with warmth. Points of a curve are read roughly.
_LARGEST_DISAGREEMENT, _REFUSED = 0.10, 0.30
_KT, _KB = "torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad"
_R, _L, _J, _SPEED = "resistance_ohm", "inductance_h", "inertia_kg_m2", "speed_constant_rpm_per_v"
_TINY = 1e-300
_USUAL_S = {"mechanical": 0.02, "electrical": 0.001}  # time constants


def in_si(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return quantities in SI units; a resistance may follow from the stall current.

    Raises:
        ValueError: a quantity is given twice.
    """
    si: dict[str, float] = {}
    for quantity, keys in UNITS.items():
        stated = [key for key in keys if key in numbers]
        require(len(stated) < 2, f"motor gives {' and '.join(stated)}; give one of them")
        if stated:
            si[quantity] = numbers[stated[0]] * keys[stated[0]]
    if "stall_current_a" in si and _volts(si) > 0.0:
        si.setdefault(_R, _volts(si) / si["stall_current_a"])
    return si


def _volts(si: Mapping[str, float]) -> float:
    """Return the nominal voltage behind the brushes; at most 0 if unknown."""
    return si.get("nominal_voltage_v", 0.0) - si.get("brush_drop_v", 0.0)


def complete(
    si: dict[str, float], numbers: Mapping[str, float], *, may_guess: bool
) -> tuple[list[str], list[str]]:
    """Add constants, inductance and inertia from the others; return notes, and which are guesses.

    Raises:
        ValueError: a quantity is missing, or two contradict each other.
    """
    require(_R in si, "motor.resistance_ohm is missing (or stall_current_a with nominal_voltage_v)")
    require(
        not {_KB, _SPEED} <= si.keys(),
        "motor gives a speed constant and a back-EMF constant; give one of them",
    )
    notes, guessed = _add_constants(si, numbers), []
    squared = max(si[_KT] * si[_KB], _TINY)
    for quantity, key, word, formula, factor in (
        (_J, "rotor_inertia_g_cm2", "mechanical", "R J / (Kt Kb)", squared / si[_R]),
        (_L, "inductance_mh", "electrical", "L / R", si[_R]),
    ):
        stated = si.get(f"{word}_time_constant_s")
        if stated is None and quantity not in si:
            require(may_guess, f"motor.{key} is missing")
            guessed.append(quantity)
        follows = si.setdefault(quantity, (stated or _USUAL_S[word]) * factor) / factor
        require(
            stated is None or _apart(stated, follows) <= _LARGEST_DISAGREEMENT,
            f"motor gives a time constant of {1e3 * (stated or 0.0):.4g} ms, but {formula} of its other numbers is"
            f" {1e3 * follows:.4g} ms; correct the one that is wrong",
        )
    for doubt, is_far in _doubts(numbers).items():
        hint = _unit_hint(numbers)
        require(not (is_far and may_guess and hint), f"motor: {doubt}, which no motor has{hint}")
        notes.append(f"{doubt}, unlike a usual motor's: is the unit right?")
    return notes, guessed


def _add_constants(si: dict[str, float], numbers: Mapping[str, float]) -> list[str]:
    """Add torque and back-EMF constant, by default from the no-load point or the stall; return notes."""
    (words, one), *others = _constants(si).items() or (("", 0.0),)
    require(
        one > 0.0,
        "motor.torque_constant_mnm_per_a (or motor.speed_constant_rpm_per_v) is missing, and neither a no-load point"
        " with nominal_voltage_v nor stall_torque_n_m with stall_current_a gives it",
    )
    notes = []
    for other_words, other in others:
        doubt = (
            f"motor gives {words.format(one)} and {other_words.format(other)}, which are one number in SI units;"
            f" correct one, or leave it out{_unit_hint(numbers)}"
        )
        apart = _apart(one, other)
        require(apart < (_LARGEST_DISAGREEMENT if other_words == _BACK_EMF else _REFUSED), doubt)
        notes += [doubt] if apart >= _LARGEST_DISAGREEMENT else []
    back_emf = _constants(si).get(_BACK_EMF, one)
    si |= {_KT: si.get(_KT, back_emf), _KB: back_emf}
    return notes


_BACK_EMF = "a back-EMF constant of {:.4g} V s/rad"


def _constants(si: Mapping[str, float]) -> dict[str, float]:
    """Return the torque or back-EMF constant by each way to derive it, in words."""
    found, volts = {}, _volts(si)
    if _KT in si:
        found["a torque constant of {:.4g} N m/A"] = si[_KT]
    if _KB in si or _SPEED in si:
        found[_BACK_EMF] = si.get(_KB) or 1.0 / max(si[_SPEED] * RAD_S_PER_RPM, _TINY)
    if volts > 0.0 and {_R, "no_load_current_a", "no_load_speed_rad_s"} <= si.keys():
        induced = max(volts - si[_R] * si["no_load_current_a"], 1e-6 * volts)
        found["a no-load point where (V - R i0) / w0 is {:.4g} V s/rad"] = induced / si["no_load_speed_rad_s"]
    if {"stall_torque_n_m", "stall_current_a"} <= si.keys():
        found["a stall torque over current of {:.4g} N m/A"] = si["stall_torque_n_m"] / si["stall_current_a"]
    return found


def _doubts(numbers: Mapping[str, float]) -> dict[str, bool]:
    """What follows from the numbers of a sheet and no usual motor has, in words; and whether it is far from it."""
    si = in_si(numbers)
    resistance, constant = si[_R], next(iter(_constants(si).values()))
    drawn, speed = (si.get(name, math.nan) for name in ("no_load_current_a", "no_load_speed_rad_s"))
    volts = _volts(si) if _volts(si) > 0.0 else constant * speed + resistance * drawn
    follows = {  # least and largest, and how far beyond them is far
        "L / R is {:.3g} s": (si.get(_L, math.nan) / resistance, 1e-6, 0.1, 1.0),
        "R J / K^2 is {:.3g} s": (resistance * si.get(_J, math.nan) / constant**2, 1e-4, 30.0, 1.0),
        "V / K is {:.3g} rpm": (volts / constant / RAD_S_PER_RPM, 50.0, 2e5, 10.0),
        "R i0 / V is {:.3g}": (resistance * drawn / volts, 0.0, 0.5, 1.0),
    }
    return {
        words.format(value): not low / far <= value <= high * far
        for words, (value, low, high, far) in follows.items()
        if 0.0 < value < low or value > high
    }


def _unit_hint(numbers: Mapping[str, float]) -> str:
    """Name the keys of other units with which nothing is in doubt and no constant contradicts another; or empty."""
    found: dict[str, str] = {}
    for key, number in numbers.items():
        others = {k: numbers[k] for k in numbers if k != key}
        for other in next(keys for keys in UNITS.values() if key in keys):
            changed = others | {other: number}
            constants = _constants(in_si(changed)).values()
            if _apart(min(constants), max(constants)) < _LARGEST_DISAGREEMENT and not _doubts(changed):
                found.setdefault(key, f"{key} = {number:g} looks like {other}")
    return f": {', or '.join(found.values())}" if found else ""


def _apart(first: float, second: float) -> float:
    return max(first, second) / max(min(first, second), _TINY) - 1.0
