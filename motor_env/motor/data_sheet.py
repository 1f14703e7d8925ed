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

import json
import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from motor_env.errors import InputError
from motor_env.files import write_text
from motor_env.motor.parameters import CATALOGUE, RAD_S_PER_RPM, FloatArray, MotorParameters

Kind = Literal["data_sheet", "identified", "commissioned"]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

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
}
"""SI quantity: the keys that give it, each with its factor to SI."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _MotorTable(_Table):
    resistance_ohm: Positive | None = None
    resistance_mohm: Positive | None = None
    inductance_h: Positive | None = None
    inductance_mh: Positive | None = None
    inductance_uh: Positive | None = None
    torque_constant_n_m_per_a: Positive | None = None
    torque_constant_mnm_per_a: Positive | None = None
    back_emf_constant_v_s_per_rad: Positive | None = None
    back_emf_constant_v_per_krpm: Positive | None = None
    back_emf_constant_mv_per_rpm: Positive | None = None
    speed_constant_rpm_per_v: Positive | None = None
    rotor_inertia_kg_m2: Positive | None = None
    rotor_inertia_g_cm2: Positive | None = None
    rotor_inertia_kg_cm2: Positive | None = None
    viscous_friction_n_m_s_per_rad: NotNegative | None = None
    viscous_friction_mnm_per_krpm: NotNegative | None = None
    no_load_current_a: Positive | None = None
    no_load_current_ma: Positive | None = None
    no_load_speed_rad_s: Positive | None = None
    no_load_speed_rpm: Positive | None = None
    nominal_voltage_v: Positive | None = None
    coulomb_friction_n_m: NotNegative = 0.0
    brush_drop_v: NotNegative = 0.0


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
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


class _SensorTable(_Table):
    current_noise_a: Positive | None = None
    speed_noise_rad_s: Positive | None = None


class _ReferenceTable(_Table):
    starts: Annotated[int, Field(ge=1)]
    degrees_of_freedom: Positive
    quantities: tuple[str, ...]
    values: tuple[Positive, ...]
    log_covariance: tuple[tuple[Finite, ...], ...]
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


class _File(_Table):
    name: str = "motor"
    kind: Kind = "data_sheet"
    motor: _MotorTable
    tolerance: Tolerance = Tolerance()
    sensor: _SensorTable = _SensorTable()
    reference: _ReferenceTable | None = None
    notes: tuple[str, ...] = ()


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
    """

    starts: int
    degrees_of_freedom: float
    quantities: tuple[str, ...]
    values: FloatArray
    log_covariance: FloatArray
    log_noise: float
    log_noise_sd: float
    model: tuple[str, ...] = ()
    model_low: tuple[float, ...] = ()
    model_high: tuple[float, ...] = ()
    sampling_rate_hz: float | None = None
    duration_s: float | None = None
    quiet_s: float | None = None
    ripple_hz: float | None = None
    ripple_constant_v_s: float | None = None
    ripple_log_sd: float | None = None


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


def load_motor(name_or_path: str | Path) -> MotorFile:
    """Motor from a TOML file, or from the catalogue by name.

    Raises:
        InputError: no such file or preset, not TOML, an unknown key, a value out of range, a quantity given twice
            or not at all.
    """
    if str(name_or_path) in CATALOGUE:
        return MotorFile(str(name_or_path), "data_sheet", CATALOGUE[str(name_or_path)])
    path = Path(name_or_path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        presets = ", ".join(sorted(CATALOGUE))
        raise InputError(f"{path}: no such motor file; presets are {presets}") from None
    except (IsADirectoryError, PermissionError) as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text (byte {error.start} is not UTF-8)") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML: {error}") from None
    try:
        table = _File.model_validate(document)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_error(error)}") from None
    return _to_motor(table, path)


def _first_error(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{where} is not a key of a motor file"
    if first["type"] == "missing":
        return f"{where} is missing"
    message = first["msg"][0].lower() + first["msg"][1:]
    return f"{where}: {message}, got {first['input']!r}"


def _to_motor(table: _File, path: Path) -> MotorFile:
    si = {quantity: _one_of(table.motor, quantity, keys, path) for quantity, keys in _UNITS.items()}
    torque, back_emf = _constants(table.motor, si, path)
    values = {
        "resistance_ohm": _needed(si["resistance_ohm"], "resistance_ohm", path),
        "inductance_h": _needed(si["inductance_h"], "inductance_mh", path),
        "back_emf_constant_v_s_per_rad": back_emf,
        "torque_constant_n_m_per_a": torque,
        "inertia_kg_m2": _needed(si["inertia_kg_m2"], "rotor_inertia_g_cm2", path),
        "viscous_friction_n_m_s_per_rad": _friction(table.motor, si, torque, back_emf, path),
    }
    return MotorFile(
        name=table.name,
        kind=table.kind,
        parameters=MotorParameters(**values),
        nominal_voltage_v=table.motor.nominal_voltage_v,
        tolerance=table.tolerance,
        current_noise_a=table.sensor.current_noise_a,
        speed_noise_rad_s=table.sensor.speed_noise_rad_s,
        coulomb_friction_n_m=table.motor.coulomb_friction_n_m,
        brush_drop_v=table.motor.brush_drop_v,
        reference=None if table.reference is None else _to_reference(table.reference, path),
        notes=table.notes,
    )


def _one_of(table: _MotorTable, quantity: str, keys: dict[str, float], path: Path) -> float | None:
    given = [key for key in keys if getattr(table, key) is not None]
    if len(given) > 1:
        raise InputError(f"{path}: motor gives {' and '.join(given)}; give one of them")
    return float(getattr(table, given[0])) * keys[given[0]] if given else None


def _needed(value: float | None, key: str, path: Path) -> float:
    if value is None:
        raise InputError(f"{path}: motor.{key} is missing")
    return value


def _constants(table: _MotorTable, si: dict[str, float | None], path: Path) -> tuple[float, float]:
    """Torque and back-EMF constant; in SI units they are one number, so either stands for the other."""
    torque, back_emf = si["torque_constant_n_m_per_a"], si["back_emf_constant_v_s_per_rad"]
    if table.speed_constant_rpm_per_v is not None:
        if back_emf is not None:
            raise InputError(
                f"{path}: motor gives speed_constant_rpm_per_v and a back-EMF constant; give one of them"
            )
        back_emf = 1.0 / (table.speed_constant_rpm_per_v * RAD_S_PER_RPM)
    first = torque if torque is not None else back_emf
    if first is None:
        raise InputError(
            f"{path}: motor.torque_constant_mnm_per_a (or motor.speed_constant_rpm_per_v) is missing"
        )
    return first, back_emf if back_emf is not None else first


def _friction(
    table: _MotorTable, si: dict[str, float | None], torque: float, back_emf: float, path: Path
) -> float:
    """Viscous friction: given, or from the no-load point, where Kt i0 = Tc + B w0."""
    given, current, speed = (
        si[name] for name in ("viscous_friction_n_m_s_per_rad", "no_load_current_a", "no_load_speed_rad_s")
    )
    if given is not None:
        return given
    if current is None:
        raise InputError(
            f"{path}: motor.viscous_friction_n_m_s_per_rad is missing, and so is motor.no_load_current_ma,"
            " from which it can be derived"
        )
    if speed is None:
        if table.nominal_voltage_v is None:
            raise InputError(f"{path}: motor.no_load_speed_rpm (or motor.nominal_voltage_v) is missing")
        speed = (table.nominal_voltage_v - (si["resistance_ohm"] or 0.0) * current) / back_emf
    friction = (torque * current - table.coulomb_friction_n_m) / speed if speed > 0.0 else math.nan
    if not friction >= 0.0:
        raise InputError(f"{path}: the no-load point leaves no viscous friction, got {friction:g} N m s/rad")
    return friction


def _to_reference(table: _ReferenceTable, path: Path) -> StartReference:
    n = len(table.quantities)
    if [len(row) for row in table.log_covariance] != [n] * n or len(table.values) != n:
        raise InputError(
            f"{path}: reference names {n} quantities; values and log_covariance must have that size"
        )
    if any(len(bound) not in (0, len(table.model)) for bound in (table.model_low, table.model_high)):
        raise InputError(
            f"{path}: reference.model_low and model_high must have one value for each of reference.model"
        )
    covariance = np.array(table.log_covariance, dtype=np.float64)
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InputError(f"{path}: reference.log_covariance must be symmetric and positive definite")
    values = np.array(table.values, dtype=np.float64)
    return StartReference(**table.model_dump() | {"values": values, "log_covariance": covariance})


def save_motor(motor: MotorFile, path: str | Path) -> None:
    """Write a motor file in SI units; `load_motor` reads the same motor back, to the last bit.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(Path(path), to_toml(motor))


def to_toml(motor: MotorFile) -> str:
    """The text of a motor file."""
    p = motor.parameters
    table: dict[str, Any] = {
        "resistance_ohm": p.resistance_ohm,
        "inductance_h": p.inductance_h,
        "torque_constant_n_m_per_a": p.torque_constant_n_m_per_a,
        "back_emf_constant_v_s_per_rad": p.back_emf_constant_v_s_per_rad,
        "rotor_inertia_kg_m2": p.inertia_kg_m2,
        "viscous_friction_n_m_s_per_rad": p.viscous_friction_n_m_s_per_rad,
        "coulomb_friction_n_m": motor.coulomb_friction_n_m,
        "brush_drop_v": motor.brush_drop_v,
        "nominal_voltage_v": motor.nominal_voltage_v,
    }
    sections: list[tuple[str, dict[str, Any]]] = [
        ("", {"name": motor.name, "kind": motor.kind, "notes": list(motor.notes)}),
        ("motor", table),
        ("tolerance", {key: getattr(motor.tolerance, key) for key in Tolerance.__dataclass_fields__}),
        (
            "sensor",
            {"current_noise_a": motor.current_noise_a, "speed_noise_rad_s": motor.speed_noise_rad_s},
        ),
    ]
    if motor.reference is not None:
        keys = StartReference.__dataclass_fields__
        sections.append(("reference", {key: getattr(motor.reference, key) for key in keys}))
    return "\n".join(_section(name, values) for name, values in sections)


def _section(name: str, values: dict[str, Any]) -> str:
    lines = [f"{key} = {_toml_value(value)}" for key, value in values.items() if value is not None]
    return "\n".join([f"[{name}]", *lines] if name else lines) + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(entry) for entry in value) + "]"
    return repr(int(value)) if isinstance(value, int) else repr(float(value))
