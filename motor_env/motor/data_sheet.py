"""Motor TOML: one schema for data sheets, identified and commissioned motors; data-sheet units in, SI inside.

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

[tolerance]                          # relative standard deviations; missing ones have defaults
resistance = 0.02
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from types import NoneType
from typing import ClassVar, Literal, get_args

import numpy as np

from motor_env.common.arrays import instance, is_one_of, shown
from motor_env.common.errors import InputError
from motor_env.common.files import write_text
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import CATALOGUE, MotorParameters, require, require_positive
from motor_env.motor.sheet_numbers import UNITS, complete, in_si
from motor_env.motor.toml_files import (
    NotNegative,
    OneLine,
    Positive,
    from_dict,
    read_toml,
    toml_text,
)

Kind = Literal["data_sheet", "identified", "commissioned"]
_MAY_BE_ZERO = ("viscous_friction_n_m_s_per_rad", "coulomb_friction_n_m", "brush_drop_v")
_MotorTable = make_dataclass(
    "_MotorTable",
    [
        (key, (NotNegative if quantity in _MAY_BE_ZERO else Positive) | None, None)
        for quantity, keys in UNITS.items()
        for key in keys
    ],
)


@dataclass(frozen=True)
class Tolerance:
    """Relative standard deviations of a healthy motor about its data sheet, and of the temperature in kelvin.

    For a guaranteed +-10 % take 0.05. Temperature moves R by 0.393 % a kelvin, the constants by -0.1 %. No-load
    currents scatter more: a friction that follows from one has 30 %, unless the file says otherwise.
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
        tolerance: of healthy motors about the parameters.
        current_noise_a: standard deviation of a current sample, where known.
        speed_noise_rad_s: standard deviation of a speed sample, where known.
        coulomb_friction_n_m: Coulomb friction torque.
        brush_drop_v: voltage drop of the brushes.
        healthy: statistics of a commissioned motor.
        notes: free text.
        assumed: keys whose values were neither measured nor on the sheet, with their sources.
        usual_tolerances: tolerances that the file leaves out, with their sources.
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
    usual_tolerances: Mapping[str, str] = field(default_factory=dict)

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

    @property
    def guesses(self) -> tuple[str, ...]:
        """Parameters that the data sheet leaves open, so that their values are guesses."""
        names = _TOLERANCE_OF if self.kind == "data_sheet" else ()
        return tuple(name for name in names if next(iter(UNITS[name])) in self.assumed)

    def with_guesses_of(self, parameters: MotorParameters) -> Motor:
        """Return the motor with its guesses replaced by the values in `parameters`."""
        told = {name: getattr(parameters, name) for name in self.guesses}
        return replace(self, parameters=replace(self.parameters, **told))

    def dry_share(self, speed_rad_s: float) -> float:
        """Return Coulomb over viscous friction at a speed, Tc / (B w); no viscous friction counts as 1e-300."""
        viscous = max(float(np.mean(self.parameters.viscous_friction_n_m_s_per_rad)), 1e-300)
        return self.coulomb_friction_n_m / speed_rad_s / viscous


@dataclass(frozen=True)
class _File:
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
    """Return a motor from a TOML file, or from the catalogue by name.

    Raises:
        InputError: no such file or preset, not TOML, an unknown key, a value out of range, a quantity twice or
            missing.
    """
    instance("name_or_path", name_or_path, (str, Path))
    if str(name_or_path) in CATALOGUE:
        motor = Motor(str(name_or_path), "data_sheet", CATALOGUE[str(name_or_path)])
        return replace(motor, usual_tolerances=dict.fromkeys(_TOLERANCES, "usual"))
    path = Path(name_or_path)
    content = read_toml(path, f"no such motor file; presets are {', '.join(sorted(CATALOGUE))}")
    try:
        return _to_motor(from_dict(_File, content, "the motor file"), content.get("tolerance", {}))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _to_motor(file: _File, given: Collection[str]) -> Motor:
    numbers = {key: number for key, number in asdict(file.motor).items() if number is not None}
    si, is_sheet = in_si(numbers), file.kind == "data_sheet"
    notes, guessed = complete(si, numbers, may_guess=is_sheet)
    usual, wide = {name: "usual" for name in _TOLERANCES if name not in given}, dict[str, float]()
    if _B not in si:
        si[_B] = _friction(si)
        if "friction" not in given:
            wide["friction"], usual["friction"] = _NO_LOAD, "from a no-load current, and those scatter"
    if is_sheet and si[_B] == 0.0 == si.get("coulomb_friction_n_m", 0.0):
        guessed.append(_B)
    wide |= {_TOLERANCE_OF[quantity]: _GUESSED for quantity in guessed}
    usual |= {_TOLERANCE_OF[quantity]: _MISSING for quantity in guessed}
    if guessed:
        lacking = " and ".join("friction, as its friction is 0" if name == _B else name for name in guessed)
        notes.append(
            f"the sheet does not give {lacking}: a recording's own value counts, and no change of it shows;"
            " motor-env commission start1.csv start2.csv start3.csv -o motor.toml learns all from healthy starts"
        )
    unknown = [key for key in file.assumed if key not in numbers]
    require(not unknown, f"assumed.{', '.join(unknown)} is no value of the table motor")
    return Motor(
        file.name,
        file.kind,
        MotorParameters(**{f.name: si[f.name] for f in fields(MotorParameters)}),
        nominal_voltage_v=si.get("nominal_voltage_v"),
        tolerance=replace(file.tolerance, **wide) if is_sheet else file.tolerance,
        usual_tolerances=usual if is_sheet else {},
        **asdict(file.sensor),
        coulomb_friction_n_m=si.get("coulomb_friction_n_m", 0.0),
        brush_drop_v=si.get("brush_drop_v", 0.0),
        healthy=file.healthy,
        notes=(*file.notes, *notes) if is_sheet else file.notes,
        assumed={**file.assumed, **{next(iter(UNITS[quantity])): _MISSING for quantity in guessed}},
    )


def _friction(si: Mapping[str, float]) -> float:
    """Return viscous friction from the no-load point, where Kt i0 = Tc + B w0."""
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
    """Write a motor file in SI units; `load_motor` reads back the same bits.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(Path(path), to_toml(motor))


def to_toml(motor: Motor) -> str:
    """Return the text of a motor file."""
    content = asdict(motor)
    content |= content.pop("parameters")
    first_keys = {quantity: next(iter(keys)) for quantity, keys in UNITS.items() if quantity in content}
    top = {"name": motor.name, "kind": motor.kind, "notes": motor.notes}
    tables = {
        "motor": {key: content[quantity] for quantity, key in first_keys.items()},
        "tolerance": content["tolerance"],
        "sensor": {f.name: content[f.name] for f in fields(_SensorTable)},
    }
    if motor.kind != "data_sheet" or motor.assumed:
        tables["assumed"] = content["assumed"]
    if motor.healthy is not None:
        whole = content["healthy"]
        parts = {name: whole.pop(name) for name in ("starts", "windows", "fleet")}
        tables["healthy"] = whole
        below = {name: parts["windows"].pop(name) for name in ("drives", "calibration") if parts["windows"]}
        tables |= {f"healthy.{name}": part for name, part in parts.items() if part is not None}
        tables |= {f"healthy.windows.{name}": part for name, part in below.items() if part}
    return toml_text(top, tables)


_TOLERANCES = tuple(f.name for f in fields(Tolerance))
_NO_LOAD, _GUESSED = 0.3, 1.5  # tolerance of friction from a no-load current; of a guess
_J, _B, _V = "rotor_inertia_kg_m2", "viscous_friction_n_m_s_per_rad", "nominal_voltage_v"
_TOLERANCE_OF = {"inductance_h": "inductance", "inertia_kg_m2": "inertia", _B: "friction"}
_MISSING = "a guess, as the sheet has none"
_K = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad")
_GUESS = "a guess, 1/100 of the voltage: the current alone determines K^2/J and B/J, not K, J and B"


def assumptions(quantities: Sequence[str], *, has_voltage: bool) -> dict[str, str]:
    """Return key and source of each assumed value of a motor file that starts cannot determine."""
    assumed: dict[str, str] = {}
    if not any(name in ("K", "K/V") for name in quantities):
        assumed |= dict.fromkeys(_K, _GUESS)
        assumed[_J] = "follows from the guess of the torque constant and the measured K^2/J"
        assumed[_B] = "follows from that inertia and the measured B/J"
    if not has_voltage:
        assumed[_V] = "unknown: the supply counts as 1 V, and R, L, K, J and B are per volt"
    return assumed


def require_told(motor: Motor) -> None:
    """Raise `ValueError` for a data sheet that lacks what a simulation needs."""
    lacking = [name for name in motor.guesses if name != _B]  # without friction a motor can be simulated
    require(
        not lacking,
        f"{motor.name}: the data sheet lacks {' and '.join(lacking)}, so that nothing of it can be simulated:"
        " add it, or commission the motor",
    )


def usable_parameters(motor: Motor, *, needs_speed: bool) -> MotorParameters:
    """Return the motor's parameters for a simulation; warn of harmless guesses.

    Raises:
        ValueError: the voltage or a value is unknown, or speeds are needed and the torque constant is a guess.
    """
    require_told(motor)
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
    """Return one line for each assumed value."""
    return [f"  assumed: {key}, {source}" for key, source in assumed.items()]
