"""Recordings that are not those of a healthy or faulty motor: other things, and motors that were read wrongly.

Each is made of random numbers that are handed in. The motor is the paper's. Nothing here is a fault.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env import PAPER_MOTOR, Recording, simulate_states
from motor_env.motor.parameters import FloatArray

WRONG_SCALES: dict[str, dict[str, float]] = {
    "speed in rpm": {"speed_rad_s": 60.0 / (2.0 * np.pi)},
    "speed in deg/s": {"speed_rad_s": 180.0 / np.pi},
    "speed in rev/s": {"speed_rad_s": 1.0 / (2.0 * np.pi)},
    "speed in thousands of rpm": {"speed_rad_s": 0.06 / (2.0 * np.pi)},
    "speed of both edges": {"speed_rad_s": 2.0},
    "current in mA": {"current_a": 1000.0},
    "current of a probe of ten": {"current_a": 10.0},
    "current of a tenth": {"current_a": 0.1},
    "twice the current": {"current_a": 2.0},
    "voltage in mV": {"voltage_v": 1000.0},
    "voltage of a probe of ten": {"voltage_v": 0.1},
    "half the voltage": {"voltage_v": 0.5},
    "twice the sampling rate": {"time_s": 0.5},
    "half the sampling rate": {"time_s": 2.0},
    "time in ms": {"time_s": 1000.0},
}
"""Factors of columns of a healthy motor: units, probes, dividers and clocks that are read wrongly."""


def started(rng: np.random.Generator) -> Recording:
    """A healthy start: 0.3 s at 5 kHz, 12 V, after 20 ms."""
    time_s: FloatArray = 2e-4 * np.arange(1500.0)
    voltage_v = np.where(time_s >= 0.02, 12.0, 0.0)
    return _seen("start", time_s, voltage_v, rng)


def at_work(rng: np.random.Generator) -> Recording:
    """A healthy log: 6 s at 500 Hz, another voltage every 50 ms."""
    time_s: FloatArray = 2e-3 * np.arange(3000.0)
    return _seen("log", time_s, np.repeat(rng.uniform(-10.0, 10.0, len(time_s) // 25), 25), rng)


def _seen(name: str, time_s: FloatArray, voltage_v: FloatArray, rng: np.random.Generator) -> Recording:
    states = simulate_states(PAPER_MOTOR, voltage_v, float(time_s[1]))
    noise = rng.standard_normal((3, len(time_s))) * [[0.02], [0.01], [1.0]]
    return Recording(
        Path(name), time_s, states[:, 0] + noise[0], voltage_v + noise[1], states[:, 1] + noise[2]
    )


def scaled(recording: Recording, **factors: float) -> Recording:
    """A recording with its columns multiplied."""
    columns: dict[str, Any] = {name: getattr(recording, name) * by for name, by in factors.items()}
    return replace(recording, **columns)


def swapped(recording: Recording) -> Recording:
    """Voltage and current taken for each other."""
    assert recording.voltage_v is not None
    return replace(recording, current_a=recording.voltage_v, voltage_v=recording.current_a)


def _first_order(drive: FloatArray, dt_s: float, time_constant_s: float) -> FloatArray:
    out, share = np.zeros(len(drive)), -np.expm1(-dt_s / time_constant_s)
    for n in range(1, len(drive)):
        out[n] = out[n - 1] + share * (drive[n - 1] - out[n - 1])
    return out


def _lamp(volts: FloatArray, dt_s: float) -> FloatArray:
    """A filament: ten times the resistance when hot; it warms by its power in some 50 ms and cools by radiation."""
    current, warmth = np.zeros(len(volts)), 0.0
    for n, v in enumerate(volts):
        current[n] = v / (2.2 * (1.0 + 9.0 * warmth))
        warmth += dt_s / 0.05 * (v * current[n] / 6.5 - warmth**4)
        warmth = min(max(warmth, 0.0), 1.2)
    return current


def _capacitor(volts: FloatArray, dt_s: float) -> FloatArray:
    return (volts - _first_order(volts, dt_s, 0.02)) / 2.2


def _solenoid(volts: FloatArray, dt_s: float) -> FloatArray:
    """L/R of 10 ms, and the dip as the plunger closes."""
    current = _first_order(volts / 2.2, dt_s, 0.01)
    since_s = np.maximum(np.arange(len(volts)) * dt_s - 0.02, 0.0)
    return np.asarray(current - 0.3 * current * np.exp(-(((since_s - 0.015) / 0.003) ** 2)))


def _stepper(volts: FloatArray, dt_s: float) -> FloatArray:
    """One phase in microsteps of 40 Hz, held by a chopper."""
    time_s = np.arange(len(volts)) * dt_s
    return np.asarray(np.sign(volts) * 1.5 * np.sin(2.0 * np.pi * 40.0 * time_s) * (np.abs(volts) > 1.0))


def _brushless(volts: FloatArray, dt_s: float) -> FloatArray:
    """The battery's current of a controller that ramps the speed up and commutates six times a turn."""
    speed = _first_order(np.abs(volts) / 12.0, dt_s, 0.1)
    ripple = 1.0 + 0.4 * np.sin(2.0 * np.pi * np.cumsum(120.0 * speed) * dt_s)
    return np.asarray((3.0 * speed * (1.2 - speed) + 0.4 * speed) * ripple)


def _mains(volts: FloatArray, dt_s: float) -> FloatArray:
    """A load at the mains through a rectifier."""
    wave = np.abs(4.0 * np.sin(2.0 * np.pi * 50.0 * np.arange(len(volts)) * dt_s))
    return np.asarray(wave * (np.abs(volts) > 1.0))


THINGS: dict[str, Callable[[FloatArray, float], FloatArray]] = {
    "resistor": lambda volts, _: volts / 2.2,
    "blocked rotor": lambda volts, dt_s: _first_order(volts / 2.18, dt_s, 0.238e-3 / 2.18),
    "coil": lambda volts, dt_s: _first_order(volts / 2.2, dt_s, 5e-3),
    "solenoid": _solenoid,
    "lamp": _lamp,
    "capacitor": _capacitor,
    "stepper": _stepper,
    "brushless": _brushless,
    "mains": _mains,
    "supply at its limit": lambda volts, _: np.sign(volts) * (np.abs(volts) > 1.0) * 3.0,
}
"""Current of what is no brushed motor, from its voltage and the sampling interval."""


def thing(name: str, like: Recording, rng: np.random.Generator) -> Recording:
    """What is no motor, connected to the supply of a recording; its shaft sensor shows 0."""
    assert like.voltage_v is not None
    assert like.speed_rad_s is not None
    clean = np.where(np.abs(like.voltage_v) < 0.1, 0.0, like.voltage_v)
    current = THINGS[name](clean, like.dt_s) + 0.02 * rng.standard_normal(len(clean))
    return replace(like, path=Path(name), current_a=current, speed_rad_s=rng.standard_normal(len(clean)))
