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
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from motor_env.errors import InputError
from motor_env.files import write_text
from motor_env.motor.parameters import CATALOGUE, RAD_S_PER_RPM, FloatArray, MotorParameters, require
from motor_env.motor.toml_files import (
    ArrayOf,
    Finite,
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
    "coulomb_friction_n_m": {"coulomb_friction_n_m": 1.0},
    "brush_drop_v": {"brush_drop_v": 1.0},
    "nominal_voltage_v": {"nominal_voltage_v": 1.0},
}
"""Quantity: the keys that give it, each with its factor; the first key is the one that is written."""

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

    The defaults are for a motor whose sheet was measured on its own series. A sheet that guarantees +-10 % wants
    0.05 there. The temperature moves R by 0.393 % a kelvin (copper) and the constants by -0.1 % a kelvin (magnets).
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
class StartReference:
    """What healthy starts have taught: where the identifiable quantities lie, and how far the next start may be off.

    Attributes:
        starts: number of starts.
        degrees_of_freedom: of the spread below (Student t); it counts the starts and the prior.
        quantities: names of the quantities (see `motor_env.motor.identifiable`).
        values: their medians over the starts, SI, shape (n,).
        log_covariance: covariance of the logarithm of the *next* start's quantities about these, shape (n, n).
        log_noise: mean logarithm of the noise of the current in A.
        log_noise_sd: standard deviation of the next start's logarithm of the noise.
        model: extensions of the textbook model that the fits used.
        model_low: smallest value of each extension over the starts.
        model_high: largest value of each.
        sampling_rate_hz: of the starts; None where unknown.
        duration_s: what the shortest start holds after its onset.
        quiet_s: what the shortest start holds before it.
        ripple_hz: commutation ripple at the last speed; None where not every start shows it.
        ripple_constant_v_s: K times the ripple's periods a turn, from that ripple; over volt where V is unknown.
        ripple_log_sd: standard deviation of the next start's logarithm of either.
        temperature_k: how much warmer or colder than those a healthy motor may be, one standard deviation.
        temperature_c: temperature of the motor at those starts, where known.
        own_friction: share of the drag that is the motor's own friction, the rest being a load; None if not told.
    """

    starts: Annotated[int, Field(ge=1)]
    degrees_of_freedom: Positive
    quantities: tuple[str, ...]
    values: Annotated[FloatArray, ArrayOf(tuple[Positive, ...])]
    log_covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    log_noise: Finite
    log_noise_sd: Positive
    model: tuple[str, ...] = ()
    model_low: tuple[Positive, ...] = ()
    model_high: tuple[Positive, ...] = ()
    sampling_rate_hz: Positive | None = None
    duration_s: Positive | None = None
    quiet_s: NotNegative | None = None
    ripple_hz: Positive | None = None
    ripple_constant_v_s: Positive | None = None
    ripple_log_sd: Positive | None = None
    temperature_k: NotNegative = 15.0
    temperature_c: Finite | None = None
    own_friction: Annotated[float, Field(gt=0.0, le=1.0)] | None = None

    def __post_init__(self) -> None:
        n, covariance = len(self.quantities), self.log_covariance
        require(
            np.shape(self.values) == (n,) and np.shape(covariance) == (n, n),
            f"reference names {n} quantities; values and log_covariance must have that size",
        )
        require(
            all(len(bound) in (0, len(self.model)) for bound in (self.model_low, self.model_high)),
            "reference.model_low and model_high must have one value for each of reference.model",
        )
        require(
            np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance)[0] > 0.0,
            "reference.log_covariance must be symmetric and positive definite",
        )


@dataclass(frozen=True)
class WindowReference:
    """What windows of a healthy motor at work have taught: R, K, J and the drag of the next window.

    Attributes:
        windows: number of windows.
        window_s: their length.
        degrees_of_freedom: of the spread below (Student t); it counts the windows and the prior.
        values: geometric means of R, K, J, SI, and of the factor on the friction, shape (4,).
        log_covariance: covariance of the logarithms of the *next* window's values about these, shape (4, 4).
        terms: of the joint fit, see `motor_env.operation.terms`.
        physical: values of the joint fit, in the order of `motor_env.operation.kernel`.
        hold: what the voltage does between two samples.
        dt_s: sampling interval of the fit.
        rms_volts: least and largest effective voltage of a window.
        temperature_k: how much warmer or colder a healthy motor may be, one standard deviation.
        peaks: largest voltage, current and speed of the healthy windows; without them no part of a window is judged.
        window_excess: by which factor windows scatter more than is believed of them: what they have taught, or
            their own errors where these are larger (variance).
        excess: by which factor halves, quarters, ... of a window scatter more than is believed of them (variance).
    """

    windows: Annotated[int, Field(ge=1)]
    window_s: Positive
    degrees_of_freedom: Positive
    values: Annotated[FloatArray, ArrayOf(tuple[Positive, ...])]
    log_covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    terms: tuple[str, ...]
    physical: Annotated[FloatArray, ArrayOf(tuple[Finite, ...])]
    hold: Literal["held", "straight", "late"]
    dt_s: Positive
    rms_volts: tuple[Positive, Positive]
    temperature_k: NotNegative = 15.0
    peaks: tuple[Positive, Positive, Positive] | None = None
    window_excess: Positive = 1.0
    excess: tuple[Positive, ...] = ()


@dataclass(frozen=True, slots=True)
class MotorFile:
    """A motor as its file describes it.

    Attributes:
        name: name of the motor.
        kind: where the numbers come from.
        parameters: the textbook parameters in SI units.
        nominal_voltage_v: voltage of the start, where known.
        tolerance: how far a healthy motor may be off the parameters.
        current_noise_a: standard deviation of a current sample, where known.
        speed_noise_rad_s: standard deviation of a speed sample, where known.
        coulomb_friction_n_m: Coulomb friction torque.
        brush_drop_v: voltage drop of the brushes.
        reference: what commissioning learned, for a commissioned motor.
        notes: sentences for the reader of the file.
        operation: what commissioning learned from windows of the motor at work.
        assumed: keys of the file's table `motor` whose values were not measured, each with its source.
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
    reference: StartReference | None = None
    notes: tuple[str, ...] = ()
    operation: WindowReference | None = None
    assumed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _File:
    """A motor file as it stands."""

    motor: _MotorTable  # type: ignore[valid-type]  # made from the table of units
    name: OneLine = "motor"
    kind: Kind = "data_sheet"
    notes: tuple[OneLine, ...] = ()
    tolerance: Tolerance = field(default_factory=Tolerance)
    sensor: _SensorTable = field(default_factory=_SensorTable)
    reference: StartReference | None = None
    operation: WindowReference | None = None
    assumed: dict[OneLine, OneLine] | None = None

    __pydantic_config__: ClassVar = {"extra": "forbid"}  # for the tables too


def load_motor(name_or_path: str | Path) -> MotorFile:
    """Motor from a TOML file, or from the catalogue by name.

    Raises:
        InputError: no such file or preset, not TOML, an unknown key, a value out of range, a quantity given twice
            or not at all.
    """
    if str(name_or_path) in CATALOGUE:
        return MotorFile(str(name_or_path), "data_sheet", CATALOGUE[str(name_or_path)])
    path = Path(name_or_path)
    content = read_toml(path, f"no such motor file; presets are {', '.join(sorted(CATALOGUE))}")
    try:
        return _to_motor(from_dict(_File, content, "the motor file"))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _to_motor(file: _File) -> MotorFile:
    si: dict[str, float] = {}
    for quantity, keys in _UNITS.items():
        given = [key for key in keys if getattr(file.motor, key) is not None]
        require(len(given) < 2, f"motor gives {' and '.join(given)}; give one of them")
        if given:
            si[quantity] = getattr(file.motor, given[0]) * keys[given[0]]
    for quantity, usual_key in (
        ("resistance_ohm", "resistance_ohm"),
        ("inductance_h", "inductance_mh"),
        ("inertia_kg_m2", "rotor_inertia_g_cm2"),
    ):
        require(quantity in si, f"motor.{usual_key} is missing")
    si |= _constants(si)
    si["viscous_friction_n_m_s_per_rad"] = _friction(si)
    return MotorFile(
        file.name,
        file.kind,
        MotorParameters(**{f.name: si[f.name] for f in fields(MotorParameters)}),
        nominal_voltage_v=si.get("nominal_voltage_v"),
        tolerance=file.tolerance,
        **asdict(file.sensor),
        coulomb_friction_n_m=si.get("coulomb_friction_n_m", 0.0),
        brush_drop_v=si.get("brush_drop_v", 0.0),
        reference=file.reference,
        operation=file.operation,
        notes=file.notes,
        assumed=_assumed(file),
    )


def _assumed(file: _File) -> dict[str, str]:
    """What the file says to be assumed; older files do not say it, their references and notes do."""
    if file.assumed is not None:
        unknown = [key for key in file.assumed if getattr(file.motor, key, None) is None]
        require(not unknown, f"assumed.{', '.join(unknown)} is no value of the table motor")
        return file.assumed
    told = file.reference.quantities if file.reference is not None else ()
    has_speed = file.operation is not None or "K" in told or (not told and not file.notes)
    if file.kind == "data_sheet" or has_speed:
        return {}
    source = "written by a version that did not say: its starts may not tell it"
    names = ("torque_constant_n_m_per_a", "rotor_inertia_kg_m2", "viscous_friction_n_m_s_per_rad")
    per_volt = ("nominal_voltage_v",) if any("/V" in name for name in told) else ()
    return dict.fromkeys((*names, *per_volt), source)


def _constants(si: Mapping[str, float]) -> dict[str, float]:
    """Torque and back-EMF constant; in SI units they are one number, so either stands for the other."""
    names = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad")
    given = {name: si[name] for name in names if name in si}
    if "speed_constant_rpm_per_v" in si:
        require(
            names[1] not in si,
            "motor gives speed_constant_rpm_per_v and a back-EMF constant; give one of them",
        )
        given[names[1]] = 1.0 / (si["speed_constant_rpm_per_v"] * RAD_S_PER_RPM)
    require(bool(given), "motor.torque_constant_mnm_per_a (or motor.speed_constant_rpm_per_v) is missing")
    return dict.fromkeys(names, next(iter(given.values()))) | given


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
        induced_v = si["nominal_voltage_v"] - si["resistance_ohm"] * current
        speed = induced_v / si["back_emf_constant_v_s_per_rad"]
    torque = si["torque_constant_n_m_per_a"] * current - si.get("coulomb_friction_n_m", 0.0)
    friction = torque / speed if speed > 0.0 else math.nan
    require(friction >= 0.0, f"the no-load point leaves no viscous friction, got {friction:g} N m s/rad")
    return friction


def save_motor(motor: MotorFile, path: str | Path) -> None:
    """Write a motor file in SI units; `load_motor` reads the same motor back, to the last bit.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(Path(path), to_toml(motor))


def to_toml(motor: MotorFile) -> str:
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
    if motor.reference is not None:
        tables["reference"] = content["reference"]
    if motor.operation is not None:
        tables["operation"] = content["operation"]
    return toml_text(top, tables)
