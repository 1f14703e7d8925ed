"""Motor TOML: one schema for a data sheet, an identified and a commissioned motor; data-sheet units in, SI inside.

name = "RE 25, 12 V"
kind = "data_sheet"                  # or "identified", "commissioned"

[motor]
resistance_ohm = 2.18
inductance_mh = 0.238
torque_constant_mnm_per_a = 23.5
speed_constant_rpm_per_v = 406.0
rotor_inertia_g_cm2 = 10.7
no_load_current_ma = 26.3            # the friction is derived from the no-load point: B = Kt i0 / w0
no_load_speed_rpm = 4860.0
nominal_voltage_v = 12.0

[tolerance]                          # relative standard deviations; what is not given has the default
resistance = 0.02
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, make_dataclass
from pathlib import Path
from types import NoneType
from typing import ClassVar, Literal, get_args

import numpy as np

from motor_env.common.arrays import instance, is_one_of, shown
from motor_env.common.errors import InputError
from motor_env.common.files import write_text
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import CATALOGUE, RAD_S_PER_RPM, MotorParameters, require, require_positive
from motor_env.motor.toml_files import (
    NotNegative,
    OneLine,
    Positive,
    from_dict,
    read_toml,
    toml_text,
)

Kind = Literal["data_sheet", "identified", "commissioned"]
_UNITS: dict[str, dict[str, float]] = {
    "resistance_ohm": {"resistance_ohm": 1.0, "resistance_mohm": 1e-3},
    "inductance_h": {"inductance_h": 1.0, "inductance_mh": 1e-3, "inductance_uh": 1e-6},
    "torque_constant_n_m_per_a": {"torque_constant_n_m_per_a": 1.0, "torque_constant_mnm_per_a": 1e-3},
    "back_emf_constant_v_s_per_rad": {
        "back_emf_constant_v_s_per_rad": 1.0,
        "back_emf_constant_v_per_krpm": 1e-3 / RAD_S_PER_RPM,
        "back_emf_constant_mv_per_rpm": 1e-3 / RAD_S_PER_RPM,
    },
    "inertia_kg_m2": {"rotor_inertia_kg_m2": 1.0, "rotor_inertia_g_cm2": 1e-7, "rotor_inertia_kg_cm2": 1e-4},
    "viscous_friction_n_m_s_per_rad": {
        "viscous_friction_n_m_s_per_rad": 1.0,
        "viscous_friction_mnm_per_krpm": 1e-6 / RAD_S_PER_RPM,
    },
    "no_load_current_a": {"no_load_current_a": 1.0, "no_load_current_ma": 1e-3},
    "no_load_speed_rad_s": {"no_load_speed_rad_s": 1.0, "no_load_speed_rpm": RAD_S_PER_RPM},
    "speed_constant_rpm_per_v": {"speed_constant_rpm_per_v": 1.0},
    "mechanical_time_constant_s": {"mechanical_time_constant_s": 1.0, "mechanical_time_constant_ms": 1e-3},
    "coulomb_friction_n_m": {"coulomb_friction_n_m": 1.0},
    "brush_drop_v": {"brush_drop_v": 1.0},
    "nominal_voltage_v": {"nominal_voltage_v": 1.0},
}
"""Quantity: the keys that give it, each with its factor; the first key is the one that is written."""

# Of two numbers of a sheet for one quantity: sheets round, and K falls with warmth.
_LARGEST_DISAGREEMENT = 0.10
_MAY_BE_ZERO = ("viscous_friction_n_m_s_per_rad", "coulomb_friction_n_m", "brush_drop_v")
_MotorTable = make_dataclass(
    "_MotorTable",
    [
        (key, (NotNegative if quantity in _MAY_BE_ZERO else Positive) | None, None)
        for quantity, keys in _UNITS.items()
        for key in keys
    ],
)


@dataclass(frozen=True)
class Tolerance:
    """Relative standard deviations of a healthy motor about its data sheet, and of the temperature in kelvin.

    A sheet that guarantees +-10 % wants 0.05. Temperature moves R by 0.393 % a kelvin, the constants by -0.1 %.
    """

    supply: NotNegative = 0.01
    resistance: NotNegative = 0.02
    inductance: NotNegative = 0.10
    constants: NotNegative = 0.01
    inertia: NotNegative = 0.02
    friction: NotNegative = 0.03
    temperature_k: NotNegative = 10.0


@dataclass(frozen=True)
class _SensorTable:
    current_noise_a: Positive | None = None
    speed_noise_rad_s: Positive | None = None


@dataclass(frozen=True, slots=True)
class Motor:
    """A motor as its file describes it.

    Attributes:
        name: of the motor.
        kind: where the numbers come from.
        parameters: in SI units.
        nominal_voltage_v: voltage of the start, where known.
        tolerance: how far a healthy motor may be off the parameters.
        current_noise_a: standard deviation of a current sample, where known.
        speed_noise_rad_s: standard deviation of a speed sample, where known.
        coulomb_friction_n_m: Coulomb friction torque.
        brush_drop_v: voltage drop of the brushes.
        healthy: of a commissioned motor.
        notes: for the reader of the file.
        assumed: keys whose values were not measured, each with its source.
    """

    name: str
    kind: Kind
    parameters: MotorParameters
    nominal_voltage_v: float | None = None
    tolerance: Tolerance = field(default_factory=Tolerance)
    current_noise_a: float | None = None
    speed_noise_rad_s: float | None = None
    coulomb_friction_n_m: float = 0.0
    brush_drop_v: float = 0.0
    healthy: Healthy | None = None
    notes: tuple[str, ...] = ()
    assumed: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        instance("name", self.name, str)
        kinds = get_args(Kind)
        require(
            is_one_of(self.kind, kinds), f"kind must be one of {', '.join(kinds)}, got {shown(self.kind)}"
        )
        instance("parameters", self.parameters, MotorParameters)
        instance("healthy", self.healthy, (Healthy, NoneType))
        for name in ("nominal_voltage_v", "current_noise_a", "speed_noise_rad_s"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, require_positive(name, getattr(self, name), one=True))
        for name in ("coulomb_friction_n_m", "brush_drop_v"):
            value = require_positive(name, getattr(self, name), zero_allowed=True, one=True)
            object.__setattr__(self, name, value)

    def dry_share(self, speed_rad_s: float) -> float:
        """Coulomb friction over viscous friction at a speed, Tc / (B w); no viscous friction counts as 1e-300."""
        viscous = max(float(np.mean(self.parameters.viscous_friction_n_m_s_per_rad)), 1e-300)
        return self.coulomb_friction_n_m / speed_rad_s / viscous


@dataclass(frozen=True)
class _File:
    """A motor file as it stands."""

    motor: _MotorTable  # type: ignore[valid-type]  # made from the table of units
    name: OneLine = "motor"
    kind: Kind = "data_sheet"
    notes: tuple[OneLine, ...] = ()
    tolerance: Tolerance = field(default_factory=Tolerance)
    sensor: _SensorTable = field(default_factory=_SensorTable)
    healthy: Healthy | None = None
    assumed: dict[OneLine, OneLine] = field(default_factory=dict)

    __pydantic_config__: ClassVar = {"extra": "forbid"}  # for the tables too


def load_motor(name_or_path: str | Path) -> Motor:
    """Motor from a TOML file, or from the catalogue by name.

    Raises:
        InputError: no such file or preset, not TOML, an unknown key, a value out of range, a quantity given twice or
            not.
    """
    instance("name_or_path", name_or_path, (str, Path))
    if str(name_or_path) in CATALOGUE:
        return Motor(str(name_or_path), "data_sheet", CATALOGUE[str(name_or_path)])
    path = Path(name_or_path)
    content = read_toml(path, f"no such motor file; presets are {', '.join(sorted(CATALOGUE))}")
    try:
        return _to_motor(from_dict(_File, content, "the motor file"))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _to_motor(file: _File) -> Motor:
    si: dict[str, float] = {}
    for quantity, keys in _UNITS.items():
        stated = [key for key in keys if getattr(file.motor, key) is not None]
        require(len(stated) < 2, f"motor gives {' and '.join(stated)}; give one of them")
        if stated:
            si[quantity] = getattr(file.motor, stated[0]) * keys[stated[0]]
    constants = _constants(si)
    _time_constant_fits(si | constants)
    for quantity, usual_key in (
        ("resistance_ohm", "resistance_ohm"),
        ("inductance_h", "inductance_mh"),
        ("inertia_kg_m2", "rotor_inertia_g_cm2"),
    ):
        require(quantity in si, f"motor.{usual_key} is missing")
    si |= constants
    si["viscous_friction_n_m_s_per_rad"] = _friction(si)
    unknown = [key for key in file.assumed if getattr(file.motor, key, None) is None]
    require(not unknown, f"assumed.{', '.join(unknown)} is no value of the table motor")
    return Motor(
        file.name,
        file.kind,
        MotorParameters(**{f.name: si[f.name] for f in fields(MotorParameters)}),
        nominal_voltage_v=si.get("nominal_voltage_v"),
        tolerance=file.tolerance,
        **asdict(file.sensor),
        coulomb_friction_n_m=si.get("coulomb_friction_n_m", 0.0),
        brush_drop_v=si.get("brush_drop_v", 0.0),
        healthy=file.healthy,
        notes=file.notes,
        assumed=file.assumed,
    )


def _constants(si: Mapping[str, float]) -> dict[str, float]:
    """Torque and back-EMF constant; in SI units they are one number, so either stands for the other."""
    names = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad")
    stated = {name: si[name] for name in names if name in si}
    if "speed_constant_rpm_per_v" in si:
        require(
            names[1] not in si,
            "motor gives speed_constant_rpm_per_v and a back-EMF constant; give one of them",
        )
        stated[names[1]] = 1.0 / (si["speed_constant_rpm_per_v"] * RAD_S_PER_RPM)
    require(bool(stated), "motor.torque_constant_mnm_per_a (or motor.speed_constant_rpm_per_v) is missing")
    constants = dict.fromkeys(names, next(iter(stated.values()))) | stated
    torque, back_emf = constants.values()
    require(
        _agree(torque, back_emf),
        f"motor gives a torque constant of {torque:.4g} N m/A and a back-EMF constant of {back_emf:.4g} V s/rad, which"
        " are one number in SI units; correct one, or leave it out",
    )
    return constants


def _agree(first: float, second: float) -> bool:
    return abs(math.log(first / second)) <= _LARGEST_DISAGREEMENT


def _time_constant_fits(si: Mapping[str, float]) -> None:
    """Refuse a mechanical time constant that is not R J / (Kt Kb) of the others."""
    stated = si.get("mechanical_time_constant_s")
    if stated is None or not {"resistance_ohm", "inertia_kg_m2"} <= si.keys():
        return
    torque, back_emf = si["torque_constant_n_m_per_a"], si["back_emf_constant_v_s_per_rad"]
    follows = si["resistance_ohm"] * si["inertia_kg_m2"] / (torque * back_emf)
    require(
        _agree(stated, follows),
        f"motor gives a mechanical time constant of {1e3 * stated:.4g} ms, but R J / (Kt Kb) of its resistance, inertia"
        f" and constants is {1e3 * follows:.4g} ms; correct the one that is wrong",
    )


def _friction(si: Mapping[str, float]) -> float:
    """Viscous friction: given, or from the no-load point, where Kt i0 = Tc + B w0."""
    if "viscous_friction_n_m_s_per_rad" in si:
        return si["viscous_friction_n_m_s_per_rad"]
    require(
        "no_load_current_a" in si,
        "motor.viscous_friction_n_m_s_per_rad is missing, and so is motor.no_load_current_ma,"
        " from which it can be derived",
    )
    current, speed = si["no_load_current_a"], si.get("no_load_speed_rad_s")
    if speed is None:
        require("nominal_voltage_v" in si, "motor.no_load_speed_rpm (or motor.nominal_voltage_v) is missing")
        induced_v = si["nominal_voltage_v"] - si.get("brush_drop_v", 0.0) - si["resistance_ohm"] * current
        speed = induced_v / si["back_emf_constant_v_s_per_rad"]
    torque = si["torque_constant_n_m_per_a"] * current - si.get("coulomb_friction_n_m", 0.0)
    friction = torque / speed if speed > 0.0 else math.nan
    require(friction >= 0.0, f"the no-load point leaves no viscous friction, got {friction:g} N m s/rad")
    return friction


def save_motor(motor: Motor, path: str | Path) -> None:
    """Write a motor file in SI units; `load_motor` reads it back to the bit.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(Path(path), to_toml(motor))


def to_toml(motor: Motor) -> str:
    """The text of a motor file."""
    content = asdict(motor)
    content |= content.pop("parameters")
    first_keys = {quantity: next(iter(keys)) for quantity, keys in _UNITS.items() if quantity in content}
    top = {"name": motor.name, "kind": motor.kind, "notes": motor.notes}
    tables = {
        "motor": {key: content[quantity] for quantity, key in first_keys.items()},
        "tolerance": content["tolerance"],
        "sensor": {f.name: content[f.name] for f in fields(_SensorTable)},
    }
    if motor.kind != "data_sheet":
        tables["assumed"] = content["assumed"]
    if motor.healthy is not None:
        whole = content["healthy"]
        parts = {name: whole.pop(name) for name in ("starts", "windows", "fleet")}
        tables["healthy"] = whole
        below = {name: parts["windows"].pop(name) for name in ("drives", "calibration") if parts["windows"]}
        tables |= {f"healthy.{name}": part for name, part in parts.items() if part is not None}
        tables |= {f"healthy.windows.{name}": part for name, part in below.items() if part}
    return toml_text(top, tables)


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
    """The motor's parameters for a simulation; warns of guesses that do not spoil it.

    Raises:
        ValueError: the voltage is unknown, or speeds are needed and the torque constant is a guess.
    """
    require(
        _V not in motor.assumed,
        f"{motor.name}: its voltage is unknown, so that nothing of it can be simulated: commission or identify it with"
        " --voltage",
    )
    if _K[0] in motor.assumed:
        message = (
            f"{motor.name}: torque constant, inertia and friction are assumed ({motor.assumed[_K[0]]}); commission or"
            " identify it with a speed, or with --torque-constant"
        )
        require(not needs_speed, message)
        warnings.warn(f"{message}. Currents are right, speeds and torques are not", stacklevel=3)
    return motor.parameters


def lines(assumed: Mapping[str, str]) -> list[str]:
    """One line for each assumed value."""
    return [f"  assumed: {key}, {source}" for key, source in assumed.items()]
