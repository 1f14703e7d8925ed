"""Parameters of the motor, its supply and its sensors: frozen, validated, in SI units.

A field of `MotorParameters` is a float, or an array: one entry a motor. The textbook motor (paper, part 2B; sign
convention of both sources: motor operation) is

    L di/dt = V - R i - Kb w
    J dw/dt = Kt i - B w - Tload
"""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import StrEnum
from numbers import Real
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import LARGEST_NUMBER, instance, is_one_of, numbers, real, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FloatArray = NDArray[np.float64]


class _OneNumber:
    @staticmethod
    def __get_pydantic_core_schema__(_: Any, handler: Any) -> Any:
        return handler.generate_schema(float)


Floats = Annotated[float | FloatArray, _OneNumber]

RAD_S_PER_RPM = 2.0 * math.pi / 60.0
COPPER_PER_KELVIN = 0.00393
"""Relative rise of a winding's resistance (IEC 60028)."""
MAGNET_PER_KELVIN = -0.001
"""Relative change of both constants with the temperature of ferrite or NdFeB magnets."""
FRICTION_PER_KELVIN = -0.003
"""Relative change of friction per kelvin of the winding, for small motors."""


SMALLEST, LARGEST = 1e-15, 1e12
"""Bounds of a number in a file, in any unit."""


class Channel(StrEnum):
    """A measured quantity: current or speed."""

    CURRENT = "current"
    SPEED = "speed"


def require(condition: bool, sentence: str) -> None:
    """Raise `ValueError(sentence)` unless the condition holds."""
    if not condition:
        raise ValueError(sentence)


def require_finite(name: str, value: Floats) -> Floats:
    """Return the value; `ValueError` unless every entry is finite."""
    return _plain(value, numbers(name, value))


def require_positive(name: str, value: Floats, *, zero_allowed: bool = False, one: bool = False) -> Floats:
    """Return the value; `ValueError` unless every entry is finite and positive (with `one`: a single number)."""
    if type(value) is float and (0.0 < value <= LARGEST_NUMBER or (zero_allowed and value == 0.0)):
        return value
    array = real(name, value, () if one else None)
    good = (array <= LARGEST_NUMBER) & ((array >= 0.0) if zero_allowed else (array > 0.0))
    if not good.all():
        bad = float(array[~good].flat[0])
        bound = f" and at most {LARGEST_NUMBER:g}" if LARGEST_NUMBER < bad < math.inf else ""
        raise ValueError(f"{name} must be finite and {'>=' if zero_allowed else '>'} 0{bound}, got {bad:g}")
    return _plain(value, array)


def common_shape(name: str, *values: Any) -> tuple[int, ...]:
    """Return the batch shape of the values, `()` or `(1,)` for one motor; `ValueError` if they differ."""
    shapes = {getattr(value, "shape", ()) for value in values}
    several = shapes - {(), (1,)}
    if len(several) > 1:
        raise ValueError(f"{name} must have one shape, got {sorted(several)}")
    return several.pop() if several else max(shapes)


def _plain(given: Any, array: FloatArray) -> Floats:
    """Return a number as it was given if arithmetic keeps it exact; else the float or array made of it."""
    if isinstance(given, float) or (isinstance(given, int) and abs(given) < 2**53):
        return given
    return array if array.ndim else float(array)


def require_plausible(value: object, place: str = "") -> None:
    """Raise `ValueError` unless every number in a dataclass is within `LARGEST`.

    Motor parameters must be 0 or at least `SMALLEST`.
    """
    if is_dataclass(value):
        for f in fields(value):
            require_plausible(getattr(value, f.name), f"{place}.{f.name}".lstrip("."))
    elif isinstance(value, tuple):
        for n, entry in enumerate(value):
            require_plausible(entry, f"{place}[{n}]")
    elif isinstance(value, float | int):
        smallest = SMALLEST if place.startswith("motor.") and value != 0.0 else -LARGEST
        if not smallest <= value <= LARGEST:
            raise ValueError(f"{place} must be in {smallest:g} .. {LARGEST:g}, got {reprlib.repr(value)}")


def require_numbers(options: DataclassInstance) -> None:
    """Raise `ValueError` unless each numeric field of a dataclass holds numbers."""
    for f in fields(options):
        value, kind = getattr(options, f.name), str(f.type)
        several = kind.startswith("tuple[float")
        if several:
            require(isinstance(value, tuple | list), f"{f.name} must be numbers, got {shown(value)}")
        elif kind not in ("int", "float") and (kind != "float | None" or value is None):
            continue
        for entry in value if several else (value,):
            is_number = isinstance(entry, Real) and not isinstance(entry, bool | np.timedelta64)
            whole = (
                f"{f.name} must be {'a whole number' if kind == 'int' else 'a number'}, got {shown(entry)}"
            )
            require(is_number and not (isinstance(entry, int) and abs(entry) >= 2**63), whole)


QUANTITY_FIELDS: dict[str, tuple[str, ...]] = {
    "resistance": ("resistance_ohm",),
    "inductance": ("inductance_h",),
    "constants": ("back_emf_constant_v_s_per_rad", "torque_constant_n_m_per_a"),
    "inertia": ("inertia_kg_m2",),
    "friction": ("viscous_friction_n_m_s_per_rad",),
}
"""Parameters that each quantity scales: `constants` is one common factor on Kt and Kb."""


@dataclass(frozen=True, slots=True)
class MotorParameters:
    """The textbook brushed DC motor (paper, part 2B).

    Attributes:
        resistance_ohm: armature (terminal) resistance R.
        inductance_h: armature inductance L.
        back_emf_constant_v_s_per_rad: back-EMF constant Kb.
        torque_constant_n_m_per_a: torque constant Kt.
        inertia_kg_m2: rotor inertia J.
        viscous_friction_n_m_s_per_rad: viscous friction B (0 is allowed).

    Raises:
        ValueError: a value is not finite, or not positive.
    """

    resistance_ohm: Floats
    inductance_h: Floats
    back_emf_constant_v_s_per_rad: Floats
    torque_constant_n_m_per_a: Floats
    inertia_kg_m2: Floats
    viscous_friction_n_m_s_per_rad: Floats

    def __post_init__(self) -> None:
        for name in self.__slots__:
            zero_allowed = name == "viscous_friction_n_m_s_per_rad"
            value = require_positive(name, getattr(self, name), zero_allowed=zero_allowed)
            object.__setattr__(self, name, value)
        _ = self.batch_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Common shape of the fields: `()` for one motor, `(n_motors,)` for a batch."""
        return common_shape("all fields of a batch", *(getattr(self, name) for name in self.__slots__))

    def scaled(self, **factors: Floats) -> Self:
        """Return parameters with the named fields multiplied by the given factors."""
        for name in factors.keys() - set(self.__slots__):
            raise ValueError(f"factors must be of {', '.join(self.__slots__)}, got {name:.60}")
        return replace(self, **{name: getattr(self, name) * factor for name, factor in factors.items()})

    def motor(self, index: int) -> Self:
        """Return motor `index` of a batch, with plain floats."""
        shape = self.batch_shape
        values = {f.name: float(np.broadcast_to(getattr(self, f.name), shape)[index]) for f in fields(self)}
        return replace(self, **values)

    @property
    def electrical_time_constant_s(self) -> Floats:
        """L / R."""
        return self.inductance_h / self.resistance_ohm

    @property
    def mechanical_time_constant_s(self) -> Floats:
        """J R / (Kt Kb + R B), with the inductance neglected."""
        stiffness = self.torque_constant_n_m_per_a * self.back_emf_constant_v_s_per_rad
        damping = self.resistance_ohm * self.viscous_friction_n_m_s_per_rad
        return self.inertia_kg_m2 * self.resistance_ohm / (stiffness + damping)


@dataclass(frozen=True, slots=True)
class SensorParameters:
    """Measured channels and their white noise.

    Attributes:
        channels: measured channels, in the order of every array.
        current_noise_a: standard deviation of a current sample.
        speed_noise_rad_s: standard deviation of a speed sample.
    """

    channels: tuple[Channel, ...] = (Channel.CURRENT,)
    current_noise_a: float = 0.02
    speed_noise_rad_s: float = 1.0

    def __post_init__(self) -> None:
        instance("channels", self.channels, (tuple, list))
        strange = [channel for channel in self.channels if not is_one_of(channel, Channel)]
        require(not strange, f"channels must be of {', '.join(Channel)}, got {shown(strange)}")
        object.__setattr__(self, "channels", tuple(Channel(channel) for channel in self.channels))
        require(len(self.channels) > 0, "channels must name at least one of current, speed, got none")
        require(
            len(set(self.channels)) == len(self.channels),
            f"channels must be distinct, got {', '.join(self.channels)}",
        )
        for name in ("current_noise_a", "speed_noise_rad_s"):
            value = require_positive(name, getattr(self, name), zero_allowed=True, one=True)
            object.__setattr__(self, name, value)

    @property
    def noise_std(self) -> FloatArray:
        """Return the noise standard deviation of each channel, shape (n_channels,)."""
        by_channel = {Channel.CURRENT: self.current_noise_a, Channel.SPEED: self.speed_noise_rad_s}
        return np.array([by_channel[channel] for channel in self.channels])

    def with_noise(self, factor: float) -> SensorParameters:
        """Return this sensor with `factor` times the noise."""
        current, speed = factor * self.current_noise_a, factor * self.speed_noise_rad_s
        return replace(self, current_noise_a=current, speed_noise_rad_s=speed)

    @property
    def observation(self) -> FloatArray:
        """Return the observation matrix C of z = C x + v, shape (n_channels, 2); [1 0] for current alone."""
        rows = {Channel.CURRENT: (1.0, 0.0), Channel.SPEED: (0.0, 1.0)}
        return np.array([rows[channel] for channel in self.channels])


@dataclass(frozen=True, slots=True)
class SupplyParameters:
    """The supply: a step of `voltage_v` at time 0.

    Attributes:
        voltage_v: level after the step.
    """

    voltage_v: Floats = 12.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "voltage_v", require_finite("voltage_v", self.voltage_v))


PAPER_MOTOR = MotorParameters(
    resistance_ohm=2.18,
    inductance_h=0.238e-3,
    back_emf_constant_v_s_per_rad=0.02352,
    torque_constant_n_m_per_a=0.0235,
    inertia_kg_m2=1.07e-6,
    viscous_friction_n_m_s_per_rad=12e-7,
)
"""The paper's table (part 2B); a maxon RE 25, 12 V, 10 W (order number 118743)."""

PAPER_MATRICES_MOTOR = PAPER_MOTOR.scaled(resistance_ohm=2.06 / 2.18, inductance_h=10.0)
"""Parameters of the paper's printed discrete matrices, at a sampling time of 10 ms (docs/paper.md)."""

PAPER_MATRICES_DT_S = 10e-3

CATALOGUE: dict[str, MotorParameters] = {
    "paper": PAPER_MOTOR,
    "paper-matrices": PAPER_MATRICES_MOTOR,
}
"""Catalogue presets by name."""
