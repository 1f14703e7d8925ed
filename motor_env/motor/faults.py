"""Faults: their kinds (what scales which parameter), and faults as values: how much, since when, with what effect."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np

from motor_env.common.arrays import instance, is_one_of, number, real, shown
from motor_env.motor.parameters import (
    QUANTITY_FIELDS,
    FloatArray,
    Floats,
    MotorParameters,
    require,
    require_positive,
)

HEALTHY = "healthy"
"""The label of a motor without a fault."""

ENTRY_POINTS = "motor_env.fault_kinds"
"""Entry points of installed packages whose modules register kinds: they are loaded when kinds are first asked for."""

NOISE = "noise"
"""The quantity that a fault of a sensor changes: the variance of the noise."""

SENSOR = "sensor"
"""The verdict of all kinds that change what is read and not the motor."""

_RESERVED = (HEALTHY, "no_reference", "other", "unusable", SENSOR)  # verdicts that are no registered kind's
_LARGEST_POWER = 100.0
_WORD = re.compile("[a-z][a-z0-9_]{0,39}")
_KINDS: dict[str, FaultKind] = {}


class _Registry(type):
    def __iter__(cls) -> Iterator[Any]:
        """All kinds: those of the package, then those registered from outside."""
        _load_entry_points()
        return iter(_KINDS.values())


class FaultKind(str, metaclass=_Registry):
    """Kind of fault: a string that knows which parameters it changes.

    `FaultKind("bearing")` looks a kind up, and iterating over `FaultKind` gives all.

    Attributes:
        powers: power of (1 + severity) on each quantity, of `QUANTITY_FIELDS` or noise (the variance of the noise).
            Where all are negative, a quantity is multiplied by (1 - severity)^-power: the severity is what is lost.
            None for a sensor's failure.
        verdict: its word, which kinds may share.
        finding: one sentence of a diagnosis: what moved, and where to look.

    Raises:
        ValueError: no such kind.
    """

    BEARING: ClassVar[FaultKind]
    WINDING_CONTACT: ClassVar[FaultKind]
    WINDING_SHORT: ClassVar[FaultKind]
    NOISE: ClassVar[FaultKind]
    MAGNET: ClassVar[FaultKind]

    powers: Mapping[str, float]
    verdict: str
    finding: str

    def __new__(cls, name: str) -> Self:
        """The registered kind of that name."""
        instance("kind", name, str)
        require(name in _KINDS or name in cls, f"kind must be one of {', '.join(_KINDS)}, got {name[:40]!r}")
        return _KINDS[name]  # type: ignore[return-value]  # there are no subclasses

    def __reduce__(self) -> tuple[Any, ...]:
        """Unpickled in another process, a kind registers itself there."""
        if self.is_sensor:
            return FaultKind, (str(self),)
        return register_fault_kind, (str(self), dict(self.powers), self.verdict, self.finding)

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __setattr__(self, name: str, value: object) -> None:
        """A kind is one for the whole process: nothing changes it."""
        raise AttributeError(f"a fault kind cannot be changed: {name} of {self}")

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        """In a file it is one of the names."""
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(cls, core_schema.str_schema())

    @property
    def motor_powers(self) -> dict[str, float]:
        """Its powers on the motor's quantities: none where only the noise changes."""
        return {quantity: power for quantity, power in self.powers.items() if quantity != NOISE}

    @property
    def changes_noise(self) -> bool:
        """Whether it changes the variance of a noise source."""
        return NOISE in self.powers

    @property
    def is_sensor(self) -> bool:
        """Whether a sensor failed: it changes what is read, and nothing else."""
        return self.verdict == SENSOR

    @property
    def component(self) -> str:
        """What an agent declares: its verdict, or the sensor that failed, as current_sensor."""
        return f"{self.partition('_')[0]}_sensor" if self.is_sensor else self.verdict

    @property
    def loses(self) -> bool:
        """Whether the severity is a share that is lost, below 1."""
        return bool(self.powers) and all(power < 0.0 for power in self.powers.values())

    def factor(self, quantity: str, severity: Floats) -> Floats:
        """What a fault multiplies a quantity by."""
        power = self.powers.get(quantity, 0.0)
        if power == 0.0:
            return 1.0
        base = 1.0 - severity if self.loses else 1.0 + severity
        size = base * base ** (abs(power) - 1.0)  # to the last bit for the powers 1 and 2
        return size if self.loses or power > 0.0 else 1.0 / size

    def direction(self, quantities: Iterable[str]) -> FloatArray:
        """How the logarithms of the quantities move with a unit of `log_size`, shape (n,)."""
        return np.array([self.powers.get(quantity, 0.0) for quantity in quantities])

    def log_size(self, severity: Floats) -> FloatArray:
        """How far a fault moves along its direction: log(1 + s), or -log(1 - s) of what is lost."""
        size: FloatArray = -np.log1p(-severity) if self.loses else np.log1p(severity)
        return size

    def severity(self, log_size: Floats) -> FloatArray:
        """The inverse of `log_size`."""
        severity: FloatArray = -np.expm1(-log_size) if self.loses else np.expm1(log_size)
        return severity

    def require_severity(self, severity: Floats) -> None:
        """Raise `ValueError` unless a fault of this kind can be so large."""
        largest = severity if isinstance(severity, float) else float(np.max(severity, initial=0.0))
        if self.is_sensor and not self.endswith(_WITHOUT_END) and largest > 1.0:
            raise ValueError(f"severity of {self} must be <= 1, got {largest:g}")
        if largest >= 1.0 and self.loses:
            raise ValueError(f"severity of {self} must be < 1, got {largest:g}")


def register_fault_kind(
    name: str, powers: Mapping[str, float], verdict: str | None = None, finding: str | None = None
) -> FaultKind:
    """Add a kind of fault; from then on it can stand wherever a kind stands (docs/howto/own-fault.md).

    Args:
        name: a word of a-z, 0-9 and _.
        powers: see `FaultKind`; `{"friction": 1.0}` for a friction that is up by the severity.
        verdict: the word for it; its name by default.
        finding: what a diagnosis says; by default what is up and down.

    Raises:
        ValueError: a name or verdict that is no such word or taken; no powers, or of unknown quantities; a finding of
            several lines.
    """
    known = [*QUANTITY_FIELDS, NOISE]
    words: dict[str, Any] = {"name": name, "verdict": name if verdict is None else verdict}
    for field, word in words.items():
        require(
            isinstance(word, str) and _WORD.fullmatch(word) is not None and word not in _RESERVED,
            f"{field} of a fault kind must be a word of a-z, 0-9 and _, and none of {', '.join(_RESERVED)},"
            f" got {shown(word)}",
        )
    instance("powers", powers, Mapping)
    given: Mapping[str, Any] = powers
    for quantity, power in given.items():
        require(quantity in known, f"powers of {name} must be of {', '.join(known)}, got {quantity!r}")
        size = number(f"power of {quantity}", power, least=-_LARGEST_POWER, most=_LARGEST_POWER)
        require(size != 0.0, f"power of {quantity} must be other than 0, got {power!r}")
    require(bool(powers), f"powers of {name} must name a quantity of {', '.join(known)}, got none")
    kind = str.__new__(FaultKind, name)
    said: Any = _moved_words(powers) if finding is None else finding
    vars(kind).update(powers=MappingProxyType(dict(powers)), verdict=verdict or name, finding=said)
    require(
        isinstance(said, str) and said.isprintable(),
        f"finding of {name} must be one line of text, got {said!r:.60}",
    )
    for other in _KINDS.values():  # a word is the verdict of one kind or family alone
        for one, family in ((kind, other), (other, kind)):
            require(
                str(one) != family.verdict or one.verdict == family.verdict,
                f"{one} is the name of a fault kind of verdict {one.verdict}, and cannot be the verdict of {family}",
            )
    old = _KINDS.setdefault(name, kind)
    require(vars(old) == vars(kind), f"fault kind {name} is registered already, with {dict(old.powers)}")
    return old


def _moved_words(powers: Mapping[str, float]) -> str:
    up = [quantity for quantity, power in powers.items() if power > 0.0]
    down = [quantity for quantity in powers if quantity not in up]
    parts = [f"{' and '.join(names)} {way}" for names, way in ((up, "up"), (down, "down")) if names]
    return ", ".join(parts)


@cache
def _load_entry_points() -> None:
    """Import the modules that installed packages name for their kinds."""
    from importlib.metadata import entry_points

    for entry_point in entry_points(group=ENTRY_POINTS):
        entry_point.load()


def motor_kinds() -> tuple[FaultKind, ...]:
    """The kinds that change the motor's parameters."""
    return tuple(kind for kind in FaultKind if kind.motor_powers)


FaultKind.BEARING = register_fault_kind(  # paper, part 4
    "bearing",
    {"friction": 1.0},
    finding="friction is up: look at the bearings, the lubricant and the load",
)
FaultKind.WINDING_CONTACT = register_fault_kind(  # the paper's numbers: a bad contact or brush
    "winding_contact",
    {"resistance": 1.0},
    verdict="winding",
    finding="resistance is up: look at brushes, commutator and connections, and at the winding's temperature",
)
FaultKind.WINDING_SHORT = register_fault_kind(  # a share of the turns is shorted (Isermann 2006, table 7.1.3)
    "winding_short",
    {"resistance": -1.0, "inductance": -2.0, "constants": -1.0},
    verdict="winding",
    finding="resistance, inductance and flux are down together: look for shorted turns",
)
FaultKind.NOISE = register_fault_kind("noise", {NOISE: 1.0})  # paper, part 3B
FaultKind.MAGNET = register_fault_kind(  # demagnetised: less flux, so both constants fall
    "magnet",
    {"constants": -1.0},
    finding="torque and back-EMF constant are down: look at the magnets and their temperature",
)
BUILT_IN_KINDS = tuple(_KINDS.values())
"""The kinds of the package. Their order is that of the random numbers of a case: new ones stand at the end."""


def _sensor(name: str, finding: str) -> FaultKind:
    kind = str.__new__(FaultKind, name)
    vars(kind).update(powers=MappingProxyType({}), verdict=SENSOR, finding=finding)
    return _KINDS.setdefault(name, kind)


_WITHOUT_END = ("gain", "offset", "drift")  # a severity of these may be above 1
_DEAD = "look at its supply, cable and connector, and at the channel of the recorder"
_SCALE = "look at {}, and at the range that the recorder was set to"
_REVERSED = "{} reads with the wrong sign: look at the direction of {}, and at the order of its leads"
_STUCK = "{} no longer moves: look at its cable, and whether the recorder repeats the last sample"
_CLIPPED = "{} stands at the end of its range: choose a larger range, {}"
_DRIFT = "{} drifts away from what it was: let its sensor warm up, and balance it anew"
SENSOR_KINDS = (
    _sensor("current_dead", f"the current's sensor shows nothing: {_DEAD}; or the circuit is open"),
    _sensor("current_gain", f"the current's scale is wrong: {_SCALE.format('probe and shunt')}"),
    _sensor("current_offset", "the current is off by a constant: balance its sensor while the motor stands"),
    _sensor("current_drift", _DRIFT.format("the current")),
    _sensor("current_polarity", _REVERSED.format("the current", "the probe")),
    _sensor("current_stuck", _STUCK.format("the current")),
    _sensor("current_clipped", _CLIPPED.format("the current", "or look at the limit of the supply")),
    _sensor("speed_dead", f"the speed's sensor shows nothing: {_DEAD}"),
    _sensor("speed_gain", f"the speed's scale is wrong: {_SCALE.format('pulses a turn, gear and coupling')}"),
    _sensor("speed_offset", "the speed is off by a constant: balance its sensor while the motor stands"),
    _sensor("speed_drift", _DRIFT.format("the speed")),
    _sensor("speed_polarity", _REVERSED.format("the speed", "the encoder's channels or of the tachometer")),
    _sensor("speed_stuck", _STUCK.format("the speed")),
    _sensor("speed_clipped", _CLIPPED.format("the speed", "or look at the counter of the encoder")),
    _sensor(
        "voltage_gain",
        "the motor has another voltage than was recorded: look at the divider, or at battery and supply where the"
        " voltage is a command",
    ),
    _sensor(
        "voltage_polarity",
        "the voltage reads with the wrong sign, or the motor's leads are exchanged: look at the direction of both",
    ),
    _sensor(
        "swapped",
        "a column is that of another quantity or of another motor: look at the order of the channels",
    ),
)
"""What fails before motors do: kinds of the verdict `sensor`."""


ALWAYS = -math.inf
"""The onset of a fault that is there from the beginning."""


class NoiseSource(StrEnum):
    """Where a noise fault enters (paper, part 3B)."""

    MEASUREMENT = "measurement"
    PROCESS = "process"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault: its kind, its severity, when it begins and how it grows.

    Attributes:
        kind: bearing: friction B up by the severity. winding_contact: resistance R up by the severity (bad contact or
            brush). winding_short: a fraction of the turns equal to the severity is shorted. noise: the variance of
            `noise_source` up by the severity. magnet: both constants down by the severity. `SENSOR_KINDS` change what
            is read (`simulation.sensor_faults`).
        severity: relative size, 0.25 for 25 %; a float, or one entry a motor. Below 1 where something is lost.
        onset_s: time from the supply's step to the onset; the fault acts in intervals that begin at or after it.
        growth_s: time over which the severity rises linearly from 0; 0 for an abrupt fault.
        noise_source: for kinds that change the noise only.
        changes_s: times at which it ends and returns in turn, ascending, shape of the severity and then n_changes;
            with each return it grows anew. None: it stays.

    Raises:
        ValueError: a severity out of range, times that are no numbers or of another shape, or growth without an onset.
    """

    kind: FaultKind
    severity: Floats
    onset_s: float = ALWAYS
    growth_s: float = 0.0
    noise_source: NoiseSource = NoiseSource.MEASUREMENT
    changes_s: FloatArray | None = None

    def __post_init__(self) -> None:
        kind, source, changes_s = self.kind, self.noise_source, self.changes_s
        onset_s = self.onset_s if type(self.onset_s) is float else float(real("onset_s", self.onset_s, ()))
        severity = require_positive("severity", self.severity, zero_allowed=True)
        growth_s = require_positive("growth_s", self.growth_s, zero_allowed=True, one=True)
        if type(kind) is not FaultKind:
            kind = FaultKind(kind)
        if type(source) is not NoiseSource:
            if not is_one_of(source, NoiseSource):
                raise ValueError(f"noise_source must be one of {', '.join(NoiseSource)}, got {shown(source)}")
            source = NoiseSource(str(source))
        kind.require_severity(severity)
        if math.isnan(onset_s):
            raise ValueError("onset_s must be a number, got nan")
        if growth_s and math.isinf(onset_s):
            raise ValueError(f"growth_s must be 0 for a fault that is always there, got {growth_s:g}")
        if changes_s is not None:
            changes_s = real("changes_s", changes_s, (*np.shape(severity), "n_changes"))
            ascends = bool((changes_s[..., 1:] >= changes_s[..., :-1]).all() and (changes_s >= onset_s).all())
            require(ascends, "changes_s must ascend from onset_s on")
        values = (kind, severity, onset_s, growth_s, source, changes_s)
        for name, value in zip(self.__slots__, values, strict=True):
            object.__setattr__(self, name, value)

    @property
    def is_constant(self) -> bool:
        """Whether the severity never changes."""
        return self.onset_s == ALWAYS and self.changes_s is None

    def age_at(self, time_s: FloatArray) -> FloatArray:
        """Time since it last set in, of the sampling intervals that begin at the given times; below 0: it does not act.

        `fraction_at` has its shape: (n_times,), or (n_motors, n_times) where changes are those of several motors.
        """
        # Intervals begin on a grid of floats: an onset meant to be on the grid must not slip by a rounding error.
        slack = 1e-9 * np.maximum(1.0, np.abs(time_s))
        age: FloatArray = time_s - self.onset_s + slack
        if self.changes_s is not None:
            for m, change_s in enumerate(np.moveaxis(self.changes_s, -1, 0)[..., None]):
                since = time_s - change_s + slack
                age = np.where(since < 0.0, age, since if m % 2 else -math.inf)
        return age

    def fraction_at(self, time_s: FloatArray) -> FloatArray:
        """Share of the severity reached in the sampling intervals that begin at the given times, 0 to 1."""
        age = self.age_at(time_s)
        if self.growth_s == 0.0:
            return (age >= 0.0).astype(np.float64)
        return np.clip(age / self.growth_s, 0.0, 1.0)


def apply_fault(parameters: MotorParameters, fault: Fault) -> MotorParameters:
    """Parameters of the motor with the fault at its full severity: each quantity times its factor."""
    return parameters.scaled(
        **{
            field: fault.kind.factor(quantity, fault.severity)
            for quantity in fault.kind.motor_powers
            for field in QUANTITY_FIELDS[quantity]
        }
    )


def apply_faults(parameters: MotorParameters, faults: Iterable[Fault]) -> MotorParameters:
    """Parameters of the motor with all the faults at their full severities."""
    for fault in faults:
        parameters = apply_fault(parameters, fault)
    return parameters


def noise_variance_factor(faults: Iterable[Fault], source: NoiseSource, time_s: FloatArray) -> FloatArray:
    """Factor on the variance of a noise source in the intervals that begin at `time_s`: the product of all factors.

    Returns:
        Shape (1, n_times), or (n_motors, n_times) where a severity is an array.
    """
    factor = np.ones((1, len(time_s)))
    for fault in faults:
        if fault.kind.changes_noise and fault.noise_source is source:
            severity = np.reshape(fault.severity, (-1, 1)) * fault.fraction_at(time_s)
            factor = factor * fault.kind.factor(NOISE, severity)
    return factor
