"""Headers of columns: which quantity, in which unit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from motor_env.errors import InputError
from motor_env.motor.parameters import RAD_S_PER_RPM

QUANTITIES = ("time", "current", "voltage", "speed", "duty")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "current": {"a": 1.0, "ma": 1e-3, "ua": 1e-6},
    "voltage": {"v": 1.0, "mv": 1e-3, "kv": 1e3},
    "speed": {
        **dict.fromkeys(("rad/s", "rad_s", "rad/sec"), 1.0),
        **dict.fromkeys(("rpm", "1/min", "u/min", "min-1"), RAD_S_PER_RPM),
        **dict.fromkeys(("deg/s", "deg_s", "°/s"), math.pi / 180.0),
    },
    "duty": {"1": 1.0, "%": 0.01, "percent": 0.01},
}
"""Factors to SI."""

_WORDS = {
    quantity: frozenset(words.split())
    for quantity, words in {
        "time": "t time zeit temps tempo tid tiempo timestamp seconds second x-axis",
        "current": "i ia i_a current armature_current strom ankerstrom courant corrente corriente iarm amps "
        "ampere",
        "voltage": "v u va ua vin voltage spannung tension tensao tensão voltaje volts volt supply",
        "speed": "w n omega ω speed velocity drehzahl vitesse velocidade velocidad rpm angular_speed wm",
        "duty": "duty duty_cycle pwm",
    }.items()
}
_UNIT_IN_HEADER = re.compile(
    r"^(?P<name>.*?)\s*(?:[\(\[](?P<bracket>[^\)\]]*)[\)\]]|\bin\s+(?P<word>\S+))\s*$"
)


@dataclass(frozen=True, slots=True)
class ColumnChoice:
    """A column that the user names: `current=CH2:mA`, or by number `current=3:mA`."""

    quantity: str
    column: str
    unit: str | None = None

    @classmethod
    def parse(cls, text: str) -> ColumnChoice:
        """From the option's text.

        Raises:
            InputError: not of the form quantity=column:unit, or an unknown quantity or unit.
        """
        quantity, equals, rest = text.partition("=")
        column, _, unit = rest.rpartition(":") if ":" in rest else (rest, "", "")
        if not equals or quantity not in QUANTITIES or not column:
            raise InputError(
                f"--column must read QUANTITY=COLUMN or QUANTITY=COLUMN:UNIT with QUANTITY one of"
                f" {', '.join(QUANTITIES)}, got {text!r}"
            )
        known = UNITS[quantity]
        if unit and _unit_key(unit) not in known:
            raise InputError(f"--column {quantity}: the unit must be one of {', '.join(known)}, got {unit!r}")
        return cls(quantity, column, unit or None)

    @property
    def factor(self) -> float | None:
        """Factor to SI of the unit; None without one."""
        return None if self.unit is None else UNITS[self.quantity][_unit_key(self.unit)]


def _unit_key(unit: str) -> str:
    return unit.strip().replace("µ", "u").replace("μ", "u").lower()


def is_unit(word: str) -> bool:
    """Whether a word is a unit of something that a recording may hold."""
    return _unit_key(word) in {"hz", *(unit for units in UNITS.values() for unit in units)}


def understand(header: str) -> tuple[str | None, float]:
    """Quantity and factor to SI of a header such as `current_a`, `I (mA)`, `Speed [rpm]`, `t_ms`; None if unknown."""
    name, unit = header.strip(), ""
    match = _UNIT_IN_HEADER.match(name)
    if match:
        name, unit = match["name"].strip(), _unit_key(match["bracket"] or match["word"] or "")
    word = name.lower().replace(" ", "_").strip("_:")
    for quantity in QUANTITIES:
        units, words = UNITS[quantity], _WORDS[quantity]
        if word in words:
            own = units.get(word, 1.0) if quantity == "speed" else 1.0
            if not unit:
                return quantity, own
            return (quantity, units[unit]) if unit in units else (None, 1.0)
        for suffix, factor in sorted(units.items(), key=lambda item: -len(item[0])):
            stem = word.removesuffix(f"_{suffix}")
            if not unit and stem != word and (stem in words or stem.split("_")[-1] in words):
                return quantity, factor
    if unit:
        for quantity in ("current", "speed", "voltage", "time"):
            if unit in UNITS[quantity] and not (quantity == "time" and unit == "min"):
                return quantity, UNITS[quantity][unit]
    return None, 1.0
