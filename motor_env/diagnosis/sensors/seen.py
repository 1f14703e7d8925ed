"""What the sensors of a motor showed side by side, and what those of a healthy motor would show under its voltage."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from motor_env.fitting import ekf as kernel, parameter_index as places
from motor_env.fitting.record import Record
from motor_env.motor.parameters import FloatArray

_HELD = 1e9  # times the inertia: the rotor stays where it is


class Seen(NamedTuple):
    """What was recorded, side by side.

    Attributes:
        dt_s: sampling interval.
        voltage_v: shape (n,).
        current_a, speed_rad_s: shape (n,); None for a channel without a column.
        has_sign: whether the sign of the voltage is known.
        at_work: whether it is a log. The offset of a start is no failure: the quiet part before it tells it.
        is_taught: whether recordings have taught the healthy motor. A data sheet says nothing of the sensors of a
            start: which sign is forwards, and how far a range goes.
    """

    dt_s: float
    voltage_v: FloatArray
    current_a: FloatArray | None
    speed_rad_s: FloatArray | None
    has_sign: bool = True
    at_work: bool = True
    is_taught: bool = True

    def since(self, first: int) -> Seen:
        """The record from a sample on."""
        current, speed = (None if one is None else one[first:] for one in (self.current_a, self.speed_rad_s))
        return self._replace(voltage_v=self.voltage_v[first:], current_a=current, speed_rad_s=speed)


def free_run(
    physical: FloatArray, voltage_v: FloatArray, dt_s: float, *, from_rest: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Current and speed of a motor of these physical values under a voltage, from its steady state or from rest."""
    values = physical.copy()
    values[[places.NOISE_I, places.NOISE_W]], values[places.NOISE_V : places.WALK + 1] = 1.0, 0.0
    n = len(voltage_v)
    marks = np.append(kernel.REST if from_rest else kernel.STEADY, np.zeros(n - 1))
    table = Record(dt_s, voltage_v, np.zeros((n, 2)), np.zeros(2), marks).predict(values, learn=False)[0]
    return table[:, 2], table[:, 3]


def held_current(physical: FloatArray, voltage_v: FloatArray, dt_s: float) -> FloatArray:
    """Current of a rotor that is held: that of the winding alone, without brushes, shape (n,)."""
    values = physical.copy()
    values[places.J], values[places.DROP] = _HELD * physical[places.J], 0.0
    return free_run(values, voltage_v, dt_s, from_rest=True)[0]


def size(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def likeness(one: FloatArray | None, other: FloatArray | None, *, about: float | None = None) -> float:
    """Correlation, about the means unless given; 0 where one of them does not move or is not there."""
    if one is None or other is None:
        return 0.0
    a, b = (each - (each.mean() if about is None else about) for each in (one, other))
    product = size(a) * size(b)
    return float(np.mean(a * b)) / product if product > 0.0 else 0.0
