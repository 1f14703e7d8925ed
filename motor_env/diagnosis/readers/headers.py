"""Meaning of columns' headers: quantity, unit, what the user says instead, and what the numbers rule out."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motor_env.common.arrays import instance
from motor_env.common.errors import InputError
from motor_env.motor.parameters import RAD_S_PER_RPM, FloatArray

QUANTITIES = ("time", "current", "voltage", "speed", "duty")
UNITS: dict[str, dict[str, float]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
        **dict.fromkeys(("ms", "millis", "milliseconds"), 1e-3),
        **dict.fromkeys(("us", "micros", "microseconds"), 1e-6),
        "ns": 1e-9,
        "min": 60.0,
    },
    "current": {**dict.fromkeys(("a", "amp", "amps", "ampere", "amperes"), 1.0), "ma": 1e-3, "ua": 1e-6},
    "voltage": {**dict.fromkeys(("v", "volt", "volts"), 1.0), "mv": 1e-3, "kv": 1e3},
    "speed": {
        **dict.fromkeys(("rad/s", "rad_s", "rad/sec"), 1.0),
        **dict.fromkeys(("rpm", "1/min", "u/min", "min-1"), RAD_S_PER_RPM),
        **dict.fromkeys(("deg/s", "deg_s", "°/s"), math.pi / 180.0),
    },
    "duty": {"1": 1.0, "%": 0.01, "percent": 0.01},
}
"""Factors to SI."""
_UNIT_QUANTITIES = {unit: quantity for quantity, units in UNITS.items() for unit in units}

SI = {"time": "s", "current": "A", "voltage": "V", "speed": "rad/s", "duty": "1"}
NUMBERED = "sequence"
"""The unit of a column that counts samples."""

_WORDS = {
    word: quantity
    for quantity, words in {
        "time": "t time zeit temps tempo tid tiempo timestamp x-axis",
        "current": "i ia i_a current armature_current strom ankerstrom courant corrente corriente iarm",
        "voltage": "v u va ua vin voltage spannung tension tensao tensão voltaje supply",
        "speed": "w n omega ω speed velocity drehzahl vitesse velocidade velocidad angular_speed wm",
        "duty": "duty duty_cycle pwm",
    }.items()
    for word in words.split()
}
_SAID = {
    kind: re.compile(pattern)
    for kind, pattern in {
        "time": r"time|stamp$|zeit|temps$|tiempo|tempo$|clock",
        "current": r"current|curr$|strom|courant|corrent|corrient|(?<!st)amp(s|eres?)?$",
        "voltage": r"volt|spannung|tension|tens[aã]o|supply|batter|vbat",
        "speed": r"speed|velo|drehzahl|vitesse|geschwindig|rpm$|tacho|vel$|omega|frequen",
        "duty": r"duty|pwm|tastgrad|throttle",
        "reference": r"ref(erence)?$|setpoint|target|command|cmd|desired|soll|limit|demand|consigne|max(imum)?$",
        "other": r"temp(eratur|$)|posi|pos$|angle|angul|winkel|theta|encoder|enc$|torque|moment|couple$|power|leistung"
        r"|puissance|pressure|druck|acc(el|$)|gyro|turnrate|mag$|pose|tilt|mission|state|status|mode$|error|fehler|flag"
        r"|event|count|tick|case$|ambient|distance|line$|force|kraft|vibration|sound|humidity|dir(ection)?$|enable",
    }.items()
}
"""What other words of a name say: a reference is wanted, not measured; another is no quantity here."""
_PART = re.compile(r"[A-Z]+(?![a-zß-ÿ])|[A-Zß-ÿ]?[a-zß-ÿ]+|\d+|[ωΩ]")
_CHANNEL = re.compile(r"(?i)\b(ch|channel|kanal|canal|c|a|ain|in|probe|input)[ _.]*(\d+|[a-d])(?![a-z0-9])")
_COUNTED = frozenset(("counts", "count", "adc", "lsb", "digits", "digit", "units"))
_COUNTERS = frozenset(["index", "sequence", "sample", "samples", "point", "nr", "no", "#"])
_NO_UNIT = frozenset(("", "value", "values", "raw", "none", "-"))  # in a row of units
_UNIT_IN_HEADER = re.compile(
    r"^(?P<name>.*?)\s*(?:[\(\[](?P<bracket>[^\)\]]*)[\)\]]|\bin\s+(?P<word>\S+))\s*$"
)
_QUOTIENT = re.compile(r"^(?P<name>[^/]+?)\s*/\s*(?P<unit>\S+)$")  # I / mA, as DIN 461 wants it
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_CHOICE = re.compile(
    r"^(?P<column>.+?)(?::(?P<unit>[^:*]+?))?"
    rf"(?:\s*(?P<mark>[*/])\s*(?P<scale>{_NUMBER}))?(?:\s*(?P<sign>[-+])\s*(?P<offset>{_NUMBER}))?\s*$"
)
LARGEST_CURRENT_A = 1_000.0
LARGE_CURRENT_A = 100.0
"""Beyond it a current that the user named is warned of."""
_MANY_WHOLE = 20
"""Different whole numbers, of a converter's or a clock's counts."""
_FEWEST_LEVELS = 50  # of numbers whose rounding can be told from noise
_MOST_COMPARED = 20_000  # samples


@dataclass(frozen=True, slots=True)
class ColumnChoice:
    """Choice of a column: `current=CH2:mA`, `current=3:mA`, `current=CH2*10-0.05`.

    Attributes:
        quantity: of `QUANTITIES`.
        text: all that stands behind the equals sign.
        column: header or number of the column.
        unit: of its numbers; None to take that of the header.
        scale: factor on the numbers in V, A, s and so on.
        offset: added after that.
        sampling_rate_hz: of a time that no column holds.
    """

    quantity: str
    text: str
    column: str
    unit: str | None = None
    scale: float | None = None
    offset: float = 0.0
    sampling_rate_hz: float | None = None

    @classmethod
    def parse(cls, text: str) -> ColumnChoice:
        """Parse the option's text.

        Raises:
            InputError: not of the form quantity=column:unit*scale+offset, or an unknown quantity or unit.
        """
        instance("text", text, str)
        quantity, equals, rest = text.partition("=")
        column, _, last = rest.strip().rpartition(":")
        if column and unit_quantity(last) == quantity:  # before a unit such as 1/min is taken for a quotient
            return cls(quantity, rest.strip(), column, last)
        match = _CHOICE.match(rest.strip())
        by_zero = match is not None and match["mark"] == "/" and float(match["scale"]) == 0.0
        if not equals or quantity not in QUANTITIES or match is None or by_zero:
            raise InputError(
                "--column must read QUANTITY=COLUMN, QUANTITY=COLUMN:UNIT or QUANTITY=COLUMN*SCALE+OFFSET with"
                f" QUANTITY one of {', '.join(QUANTITIES)}, got {text!r}"
            )
        unit, scale, offset = match["unit"], match["scale"], match["offset"]
        choice = cls(
            quantity,
            rest.strip(),
            match["column"].strip(),
            unit,
            None if scale is None else float(scale) ** (-1.0 if match["mark"] == "/" else 1.0),
            0.0 if offset is None else float(match["sign"] + offset),
        )
        if (
            unit is not None
            and unit_quantity(unit) != quantity
            and (choice.scale is None or not unit_quantity(unit))
        ):
            raise InputError(
                f"--column {quantity}: the unit must be one of {', '.join(UNITS[quantity])}, got {unit!r}"
            )
        return choice

    @classmethod
    def sampled(cls, sampling_rate_hz: float) -> ColumnChoice:
        """Choose an even time, whatever the columns say.

        Raises:
            InputError: the rate is not positive.
        """
        if not 0.0 < sampling_rate_hz < float("inf"):
            raise InputError(f"sampling-rate must be > 0, got {sampling_rate_hz:g}")
        return cls("time", "", "", sampling_rate_hz=sampling_rate_hz)


class Meaning(NamedTuple):
    """Meaning of a header.

    Attributes:
        quantity: of the name, or of the unit where the name says nothing; None where neither does.
        factor: to SI.
        unit: as written; empty where none is stated.
        name: without the unit.
    """

    quantity: str | None
    factor: float
    unit: str
    name: str


def unit_key(unit: str) -> str:
    """Return a unit as the tables here spell it."""
    return unit.strip().replace("µ", "u").replace("μ", "u").lower()


def unit_quantity(unit: str) -> str | None:
    """Return the quantity that has a unit; None for no unit of a recording."""
    return _UNIT_QUANTITIES.get(unit_key(unit))


def is_unit_cell(cell: str) -> bool:
    """Whether a cell may stand in a row of units."""
    key = unit_key(cell.strip("()[] "))
    return key in _NO_UNIT or key in (NUMBERED, "hz") or unit_quantity(key) is not None


def understand(header: str, unit: str = "") -> Meaning:
    """Interpret a header such as `current_a`, `I (mA)`, `Speed [rpm]`, `t_ms`, and a unit that stands elsewhere."""
    name = header.strip()
    match = _UNIT_IN_HEADER.match(name)
    if match:
        name = match["name"].strip()
        unit = unit or match["bracket"] or match["word"] or ""
    elif (quotient := _QUOTIENT.match(name)) and _word(quotient["name"]) in _WORDS:
        name, unit = quotient["name"], unit or quotient["unit"]
    word = _word(name)
    if not unit:
        word, unit = _split(word)
    elif unit_key(unit) in _NO_UNIT:
        unit = ""
    if unit_key(unit) == NUMBERED or (not unit and word in _COUNTERS):
        return Meaning(None, 1.0, NUMBERED, name)
    quantity = _WORDS.get(word)
    measured = unit_quantity(unit)
    is_open = quantity is None and measured != "duty" and unit_key(unit) != "min"
    if is_open and measured and not is_other(name, measured):
        quantity = measured
    if unit and quantity != measured:  # a current in volt is a probe's
        quantity = None
    return Meaning(quantity, UNITS[measured][unit_key(unit)] if measured else 1.0, unit, name)


def name_parts(name: str) -> list[str]:
    """Return the words and numbers of a name, in small letters: `MotorCurrent_2` has three."""
    return [part.lower() for part in _PART.findall(name)]


def kinds_named(name: str) -> frozenset[str]:
    """Return the quantities that words or single letters of a name say, `reference` and `other` included."""
    parts = name_parts(name)
    return _words_of(name) | {_WORDS[part] for part in (*parts, _word(name)) if part in _WORDS}


def is_other(name: str, quantity: str, words: frozenset[str] | None = None) -> bool:
    """Return whether a name's words rule a quantity out: `Gyro x`, `Current setpoint`.

    Args:
        name: of the column.
        quantity: in doubt.
        words: what the name says, by default its words: a letter counts less than a unit.
    """
    words = _words_of(name) if words is None else words
    if "reference" in words and quantity in ("current", "speed"):
        return True
    return bool(words - {"reference"}) and quantity not in words


def _words_of(name: str) -> frozenset[str]:
    parts = name_parts(name)
    return frozenset(kind for kind, pattern in _SAID.items() if any(map(pattern.search, parts)))


def is_channel(name: str) -> bool:
    """Return whether a name is an instrument's channel."""
    return bool(_CHANNEL.search(name))


def is_no_unit(unit: str) -> bool:
    """Return whether the text in a unit's place says none: empty, `raw`, `counts`."""
    return unit_key(unit) in _NO_UNIT | _COUNTED


def _word(name: str) -> str:
    return name.strip().lower().replace(" ", "_").strip("_:#")


def _split(word: str) -> tuple[str, str]:
    """Split `current_ma`, `rpm` into word and unit; a word that is no quantity keeps its ending."""
    if unit_quantity(word) is not None and len(word) > 1:
        return word, word
    for unit, quantity in _UNIT_QUANTITIES.items():
        stem = word.removesuffix(f"_{unit}")
        for name in (stem, stem.split("_")[-1]):
            if stem != word and _WORDS.get(name) == quantity:
                return name, unit
    return word, ""


def has_counts(values: FloatArray, averaged: int = 1) -> bool:
    """Return whether numbers are counts: whole, or whole times `averaged` for means."""
    sums = values * averaged
    is_whole = np.abs(sums - np.round(sums)) <= 1e-6 * (averaged > 1)
    return bool(np.all(is_whole)) and len(np.unique(sums)) > _MANY_WHOLE


@np.errstate(over="ignore", invalid="ignore")  # of numbers that nobody measured
def follows(values: FloatArray, other: FloatArray, of: str) -> bool:
    """Return whether numbers are computed from others: a linear function of them, to rounding.

    Args:
        values: those of the current.
        other: those of another quantity.
        of: which. A current that falls as the speed rises may be an ideal motor's.
    """
    each = -(-len(values) // _MOST_COMPARED)
    values, other = values[::each], other[::each]
    span, other_span = float(np.ptp(values)), float(np.ptp(other))
    if not span or not other_span:
        return False
    y, x = (values - values.mean()) / span, (other - other.mean()) / other_span
    slope = float(x @ y / (x @ x))
    error = float(np.max(np.abs(y - slope * x)))
    if not error <= 0.05 or error > 1e-6 + 0.6 * (_step(y) + _step(x)):  # the slope is 1 or -1 then
        return False
    sizes = np.abs(values) - np.abs(values).mean(), np.abs(other) - np.abs(other).mean()
    return of != "speed" or float(sizes[0] @ sizes[1]) > 0.0


def _step(values: FloatArray) -> float:
    """Return the rounding step of numbers; 0 for few levels."""
    levels = np.unique(values)
    return float(np.min(np.diff(levels))) if len(levels) >= _FEWEST_LEVELS else 0.0
