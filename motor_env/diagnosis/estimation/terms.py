"""Table of a recorded motor's unknowns: index, unit, bounds and prior of each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.record import Record
from motor_env.motor.parameters import FloatArray

LONGEST_CURRENT_LAG_S = 0.01
LONGEST_SPEED_LAG_S = 0.1
_WIDEST = 12.0  # of a logarithm
_OFFSET_PRIOR = 0.003
_CURVE_PRIOR_SD = 1.5
_SEEN_LAG = 0.5  # of an interval
_LARGEST_DEAD_ZONE = 0.35  # of the current's span: what hides more is no sensor
_KNEE_PRIOR, _STRIBECK_PRIOR = 0.01, 0.2  # of the largest current or speed; of the dry friction
_LARGEST_DROP = 0.4  # of the largest voltage: under few volts brushes take less


class PhysicalBound(NamedTuple):
    """Largest size that physics allows a term, and where that is known from."""

    most: float
    unit: str
    source: str


_BRUSHES = "IEC 60034-2-1 counts 0.3 V for a brush of metal graphite, 1 V for one of carbon"
PHYSICAL_BOUNDS = {
    "brush_drop": PhysicalBound(1.5, "V in all", _BRUSHES),
    "brush_drop_high": PhysicalBound(2.5, "V in all", _BRUSHES),
    "brush_knee": PhysicalBound(
        0.5, "of the largest current", "a contact's resistance falls with it (Holm 1967)"
    ),
    "gear_loss": PhysicalBound(0.5, "of the torque", "a gear that loses half holds itself"),
}
"""By term; of the brush drop above HIGH_SUPPLY_V, too. Frictions and a fan take power, and are never below 0."""
HIGH_SUPPLY_V = 60.0


@dataclass(frozen=True, slots=True)
class Term:
    """One unknown.

    Attributes:
        name: as the reports say it.
        place: in the vector of values.
        unit: what 1 stands for, SI; of a logarithm the value at 0.
        low, high: bounds in that unit.
        is_log: whether the unknown is the logarithm of the value over its unit.
        prior_sd: prior standard deviation about `prior_mean`, in the unit; infinite for none.
        usual: usual size where a motor has the term, in the unit.
        prior_mean: in the unit.
        slope_at: size over which the slope at 0 is taken, in the unit: a lag far below an interval does not show in it.
        bound: what `high` stands for, where physics sets it.
    """

    name: str
    place: int
    unit: float
    low: float
    high: float
    is_log: bool = False
    prior_sd: float = math.inf
    usual: float = 1.0
    prior_mean: float = 0.0
    slope_at: float = 1e-4
    bound: PhysicalBound | None = None

    def value(self, theta: float) -> float:
        """Return the SI value of the unknown."""
        return self.unit * math.exp(theta) if self.is_log else self.unit * theta


def terms(
    record: Record, start: FloatArray, peaks: tuple[float, float, float] | None = None
) -> dict[str, Term]:
    """Return all unknowns of a record.

    Args:
        record: what is fitted.
        start: initial values, which give the units, shape (parameter_index.N_VALUES,).
        peaks: largest voltage, current and speed, where they are not those of the record.
    """
    volts, amps, speed = record.peaks if peaks is None else peaks
    ohm, constant, dt = start[index.R], start[index.K], record.dt_s
    amps = max(amps, 1e-3 * volts / ohm) if record.recorded[0] else volts / ohm
    speed = max(speed, 1e-3 * volts / constant) if record.recorded[1] else volts / constant
    torque, reach = constant * amps, 0.5 * record.duration_s / dt
    drop = PHYSICAL_BOUNDS["brush_drop_high" if volts > HIGH_SUPPLY_V else "brush_drop"]
    drop = drop._replace(most=max(drop.most, record.brush_drop_v))
    knee, gear = PHYSICAL_BOUNDS["brush_knee"], PHYSICAL_BOUNDS["gear_loss"]
    largest = min(drop.most / volts, _LARGEST_DROP)
    every = [
        Term("R", index.R, ohm, -5.0, 5.0, is_log=True),
        Term("L", index.L, ohm * dt, 0.0, reach),
        Term("K", index.K, constant, -5.0, 5.0, is_log=True),
        Term("J", index.J, start[index.J], -7.0, 7.0, is_log=True),
        Term("B", index.B, torque / speed, 0.0, 20.0),
        Term("coulomb", index.COULOMB, torque, 0.0, 0.9),
        Term(
            "brush_drop",
            index.DROP,
            volts,
            0.0,
            largest,
            prior_sd=0.1,
            bound=drop if largest < _LARGEST_DROP else None,
        ),
        Term(
            "brush_knee",
            index.KNEE,
            amps,
            0.0,
            knee.most,
            prior_sd=_KNEE_PRIOR,
            usual=_KNEE_PRIOR,
            bound=knee,
        ),
        Term("stribeck", index.STRIBECK, 1.0, 0.0, 2.0, prior_sd=_STRIBECK_PRIOR),
        Term("coulomb_knee", index.SLIDING, speed, 0.0, 0.05, prior_sd=_KNEE_PRIOR),
        Term("gear_loss", index.GEAR, 1.0, 0.0, gear.most, usual=0.1, bound=gear),
        Term("load_constant", index.LOAD, torque, -2.0, 2.0, prior_sd=0.3, usual=0.3),
        Term("load_square", index.SQUARE, torque / speed**2, 0.0, 20.0, usual=0.3),
        Term("offset_current", index.OFFSET_I, amps, -0.2, 0.2, prior_sd=_OFFSET_PRIOR),
        Term("offset_speed", index.OFFSET_W, speed, -0.1, 0.1, prior_sd=_OFFSET_PRIOR),
        Term("supply_resistance", index.SOURCE, ohm, 0.0, 1.0, usual=0.1),
        Term("sensor_lag", index.LAG_I, dt, 0.0, min(LONGEST_CURRENT_LAG_S / dt, reach), slope_at=_SEEN_LAG),
        Term("speed_lag", index.LAG_W, dt, 0.0, min(LONGEST_SPEED_LAG_S / dt, reach)),
        Term(
            "noise_current", index.NOISE_I, start[index.NOISE_I], _least(record, 0, start), 5.0, is_log=True
        ),
        Term("noise_speed", index.NOISE_W, start[index.NOISE_W], _least(record, 1, start), 5.0, is_log=True),
        Term("noise_voltage", index.NOISE_V, 0.003 * volts, -6.0, 4.0, is_log=True),
        Term("noise_torque", index.NOISE_T, 0.01 * torque, -6.0, 4.0, is_log=True),
        Term("load_walk", index.WALK, 0.05 * torque / math.sqrt(record.duration_s), -6.0, 6.0, is_log=True),
    ]
    if record.is_start:
        every += [
            Term("R", index.R, ohm, -_WIDEST, _WIDEST, is_log=True),
            Term("L", index.L, start[index.L], -_WIDEST, _WIDEST, is_log=True),
            Term("K", index.K, constant, -_WIDEST, _WIDEST, is_log=True),
            Term("J", index.J, start[index.J], -_WIDEST, _WIDEST, is_log=True),
            Term("B", index.B, start[index.B], -_WIDEST, _WIDEST, is_log=True),
            Term("coulomb", index.COULOMB, torque, 0.0, 100.0),
            Term("brush_drop", index.DROP, volts, 0.0, min(drop.most / volts, 0.9), usual=0.05, bound=drop),
            Term("sensor_lag", index.LAG_I, dt, 0.0, reach, usual=2.0),
            Term("speed_lag", index.LAG_W, dt, 0.0, reach, usual=2.0),
            Term("onset", index.ONSET, dt, -1.0, 1.0),
            Term("delay", index.DELAY, 1.0, -1.0, 1.0),
            Term("supply_ramp", index.RISE, dt, 0.0, 2.0 * reach),
            Term("dead_zone", index.ZONE, amps, 0.0, _LARGEST_DEAD_ZONE, usual=0.15),
        ]
        every += [
            Term(f"curve_{n + 1}", place, 1.0, -_WIDEST, _WIDEST, is_log=True, prior_sd=_CURVE_PRIOR_SD)
            for n, place in enumerate(range(index.CURVE.start, index.CURVE.stop))
        ]
    return {term.name: term for term in every}


def _least(record: Record, channel: int, start: FloatArray) -> float:
    """Return the least logarithm of a channel's noise over its first guess: no reading is finer than its steps."""
    rounding = max(record.steps[channel] / math.sqrt(12.0), 1e-300)
    finest = rounding / max(start[index.NOISE_I + channel], 1e-300)
    return min(max(math.log(finest), -5.0), 0.0)


SHAPES = {"brush_knee": "brush_drop", "stribeck": "coulomb", "coulomb_knee": "coulomb"}
"""Shape parameters of brush drop and dry friction, fitted with their parent under a prior that keeps them small."""
NOISES = ("noise_current", "noise_speed", "noise_voltage", "noise_torque", "load_walk")
"""They set the weights, and are no quantities of the motor."""
