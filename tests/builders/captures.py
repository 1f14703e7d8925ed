"""Captures of healthy and faulty motors, as good and bad sensors show them, and of what is no motor; made from seeds.

`CAPTURES` holds each with the reference, of `REFERENCES`, that it is judged by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from simulated_captures import DEFECTS, captures
from started_motor import step_start

from motor_env import (
    PAPER_MOTOR,
    Fault,
    FaultKind,
    Motor,
    MotorParameters,
    Recording,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    commission,
    draw,
    load_motor,
    load_recipe,
    simulate,
    simulate_states,
)

# What windows at work teach is written by hand, without the long fits of a commissioning.
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.motor.healthy import Healthy, Windows
from motor_env.motor.parameters import FloatArray

SHEET = load_motor(Path(__file__).parents[2] / "examples" / "motor.toml")
BENCH = Timing(10_000.0, 0.2, 0.05)


def bearing(size: float) -> Fault:
    return Fault(FaultKind.BEARING, size)


def contact(size: float) -> Fault:
    return Fault(FaultKind.WINDING_CONTACT, size)


def with_defect(name: str, *faults: Fault, seed: int = 5) -> Recording:
    """A start of a motor within tolerances that was recorded with a defect."""
    return captures(DEFECTS[name], faults, SHEET.parameters, seed, 1)[0]


def with_speed(*faults: Fault, seed: int = 11) -> Recording:
    """A start of a motor within tolerances with current and speed."""
    sensor = SensorParameters(("current", "speed"), 0.02, 1.0)  # type: ignore[arg-type]  # names become channels
    recipe = load_recipe(
        "bench", motor=SHEET.parameters, supply=SupplyParameters(12.0), sensor=sensor, timing=BENCH
    )
    made = simulate(replace(draw(recipe, seed, np.arange(1)).scenario, faults=faults), seed, [0])
    current, speed = made.measurements[0]
    return Recording(Path("start"), made.time_s, current, np.where(made.time_s > 1e-9, 12.0, 0.0), speed)


def current_alone(
    *faults: Fault, motor: MotorParameters = SHEET.parameters, timing: Timing = BENCH, seed: int = 6
) -> Recording:
    """A start of one motor whose supply, which nobody recorded, scatters by half a percent."""
    supply = SupplyParameters(12.0 * (1.0 + 0.005 * np.random.default_rng(seed).standard_normal()))
    made = simulate(
        Scenario(motor, faults, supply, SensorParameters(current_noise_a=0.02), timing), seed, [0]
    )
    return Recording(Path(f"start-{seed}"), made.time_s, made.measurements[0, 0])


def weak(magnet: float) -> MotorParameters:
    return SHEET.parameters.scaled(back_emf_constant_v_s_per_rad=magnet, torque_constant_n_m_per_a=magnet)


def warmed(kelvin: float, *, friction: float = 0.003) -> MotorParameters:
    return weak(1.0 - 0.001 * kelvin).scaled(
        resistance_ohm=1.0 + 0.00393 * kelvin, viscous_friction_n_m_s_per_rad=1.0 - friction * kelvin
    )


def loaded(load: str, seed: int, motor: MotorParameters = SHEET.parameters) -> Recording:
    """A start under a constant load or a fan, which draw 0.12 of the current at rest."""
    rng, time_s = np.random.default_rng([5, seed]), np.linspace(-0.02, 0.0999, 1200)
    torque = float(0.12 * motor.torque_constant_n_m_per_a * 12.0 / 2.18)
    speed = float(12.0 / SHEET.parameters.back_emf_constant_v_s_per_rad)
    beyond = {"COULOMB": torque} if load == "constant" else {"SQUARE": torque / speed**2}
    states = step_start(motor, time_s, 3e-5, 12.0 * (1.0 + 0.003 * rng.standard_normal()), **beyond)
    return Recording(Path(f"start-{seed}"), time_s, states[:, 0] + 0.01 * rng.standard_normal(len(time_s)))


def in_a_row(*starts: Recording) -> Recording:
    """Several starts in one recording."""
    current = np.concatenate([start.current_a for start in starts])
    volts = [start.voltage_v for start in starts if start.voltage_v is not None]
    time_s: FloatArray = starts[0].dt_s * np.arange(float(len(current)))
    return Recording(Path("two.csv"), time_s, current, np.concatenate(volts) if volts else None)


def started(rng: np.random.Generator) -> Recording:
    """A healthy start with all channels: 0.3 s at 5 kHz, 12 V, after 20 ms."""
    time_s: FloatArray = 2e-4 * np.arange(1500.0)
    return _seen("start", time_s, np.where(time_s >= 0.02, 12.0, 0.0), rng)


def at_work(rng: np.random.Generator, *faults: Fault, seconds: float = 6.0) -> Recording:
    """A log with all channels at 500 Hz, another voltage every 50 ms."""
    time_s: FloatArray = 2e-3 * np.arange(round(500.0 * seconds), dtype=np.float64)
    return _seen("log", time_s, np.repeat(rng.uniform(-10.0, 10.0, len(time_s) // 25), 25), rng, faults)


def _seen(
    name: str, time_s: FloatArray, volts: FloatArray, rng: np.random.Generator, faults: tuple[Fault, ...] = ()
) -> Recording:
    states = simulate_states(PAPER_MOTOR, volts, float(time_s[1]), faults=faults)
    noise = rng.standard_normal((3, len(time_s))) * [[0.02], [0.01], [1.0]]
    return Recording(Path(name), time_s, states[:, 0] + noise[0], volts + noise[1], states[:, 1] + noise[2])


def without(recording: Recording, *columns: str) -> Recording:
    missing: dict[str, Any] = dict.fromkeys(columns)
    return replace(recording, **missing)


def scaled(recording: Recording, **factors: float) -> Recording:
    """A recording with its columns multiplied."""
    columns: dict[str, Any] = {name: getattr(recording, name) * by for name, by in factors.items()}
    return replace(recording, **columns)


def swapped(recording: Recording) -> Recording:
    """Voltage and current taken for each other."""
    assert recording.voltage_v is not None
    return replace(recording, current_a=recording.voltage_v, voltage_v=recording.current_a)


def held(recording: Recording) -> Recording:
    """The current stays where it is at its largest, half-way through."""
    current = recording.current_a.copy()
    current[len(current) // 2 :] = current.max()
    return replace(recording, current_a=current)


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


def _solenoid(volts: FloatArray, dt_s: float) -> FloatArray:
    """L/R of 10 ms, and the dip as the plunger closes."""
    current = _first_order(volts / 2.2, dt_s, 0.01)
    since_s = np.maximum(np.arange(len(volts)) * dt_s - 0.02, 0.0)
    return np.asarray(current - 0.3 * current * np.exp(-(((since_s - 0.015) / 0.003) ** 2)))


def _stepper(volts: FloatArray, dt_s: float) -> FloatArray:
    """One phase in microsteps of 40 Hz, held by a chopper."""
    wave = np.sin(2.0 * np.pi * 40.0 * np.arange(len(volts)) * dt_s)
    return np.asarray(1.5 * np.sign(volts) * wave * (np.abs(volts) > 1.0))


def _brushless(volts: FloatArray, dt_s: float) -> FloatArray:
    """The battery's current of a controller that ramps the speed up and commutates six times a turn."""
    speed = _first_order(np.abs(volts) / 12.0, dt_s, 0.1)
    ripple = 1.0 + 0.4 * np.sin(2.0 * np.pi * np.cumsum(120.0 * speed) * dt_s)
    return np.asarray((3.0 * speed * (1.2 - speed) + 0.4 * speed) * ripple)


THINGS: dict[str, Callable[[FloatArray, float], FloatArray]] = {
    "resistor": lambda volts, _: volts / 2.2,
    "blocked rotor": lambda volts, dt_s: _first_order(volts / 2.18, dt_s, 0.238e-3 / 2.18),
    "solenoid": _solenoid,
    "lamp": _lamp,
    "capacitor": lambda volts, dt_s: (volts - _first_order(volts, dt_s, 0.02)) / 2.2,
    "stepper": _stepper,
    "brushless": _brushless,
    "supply at its limit": lambda volts, _: np.sign(volts) * (np.abs(volts) > 1.0) * 3.0,
}
"""Current of what is no brushed motor, from its voltage and the sampling interval."""


def thing(name: str, like: Recording, rng: np.random.Generator) -> Recording:
    """What is no motor, connected to the supply of a recording; its shaft sensor shows 0."""
    assert like.voltage_v is not None
    clean = np.where(np.abs(like.voltage_v) < 0.1, 0.0, like.voltage_v)
    current = THINGS[name](clean, like.dt_s) + 0.02 * rng.standard_normal(len(clean))
    return replace(like, path=Path(name), current_a=current, speed_rad_s=rng.standard_normal(len(clean)))


def taught_by_windows() -> Motor:
    """The paper's motor, as windows of a second at work would have taught it."""
    p, physical = PAPER_MOTOR, np.zeros(index.N_VALUES)
    known = (p.resistance_ohm, p.inductance_h, p.back_emf_constant_v_s_per_rad, p.inertia_kg_m2)
    physical[[index.R, index.L, index.K, index.J]] = [float(np.mean(one)) for one in known]
    physical[index.B] = float(np.mean(p.viscous_friction_n_m_s_per_rad))
    physical[[index.NOISE_I, index.NOISE_W]] = 0.02, 1.0
    terms = ("R", "K", "J", "B", "noise_current", "noise_speed")
    windows = Windows(1.0, terms, physical, "late", 2e-3, 200.0, (3.0, 9.0), (10.0, 6.0, 430.0))
    quantities = physical[[index.R, index.K, index.J, index.B]]
    spread = np.diag([0.005, 0.005, 0.005, 0.06]) ** 2
    healthy = Healthy(20, 23.0, ("R", "K", "J", "B"), quantities, spread, temperature_k=0.0, windows=windows)
    return replace(load_motor("paper"), healthy=healthy)


def _learned(starts: list[Recording], **known: Any) -> Motor:
    return commission([replace(one, path=Path(f"{n}")) for n, one in enumerate(starts)], **known).motor


@cache
def by_starts() -> Motor:
    """Commissioned from five starts of their currents alone."""
    return _learned([current_alone(seed=seed) for seed in range(5)])


@cache
def by_sensors() -> Motor:
    """Commissioned from three starts with all channels."""
    return _learned([started(np.random.default_rng(seed)) for seed in range(3)])


@cache
def under(load: str) -> Motor:
    """Commissioned from five starts under a load."""
    return _learned([loaded(load, seed) for seed in range(5)], voltage_v=12.0)


def _as_warm() -> Motor:
    """As if the motor were always as warm: a change of 15 K would hide R +25 % at 2 kHz."""
    motor = by_starts()
    assert motor.healthy is not None
    return replace(motor, healthy=replace(motor.healthy, temperature_k=0.0))


REFERENCES: dict[str, Callable[[], Motor]] = {
    "sheet": lambda: SHEET,
    "starts": by_starts,
    "starts as warm": _as_warm,
    "sensors": by_sensors,
    "constant load": partial(under, "constant"),
    "fan": partial(under, "fan"),
    "windows": taught_by_windows,
}


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _no_speed(recording: Recording) -> Recording:
    return without(recording, "speed_rad_s")


_JUDGED = [name for name, defect in DEFECTS.items() if defect.judged]
_SHORT, _SLOW, _BRIEF = Timing(10_000.0, 0.03, 0.01), Timing(2_000.0, 0.2, 0.05), Timing(2_000.0, 0.04, 0.01)
CAPTURES: dict[str, tuple[str, Callable[[], Recording]]] = {
    **{
        f"{name}: {'bearing' if n % 2 == 0 else 'contact'} 30 %": (
            "sheet", partial(with_defect, name, bearing(0.3) if n % 2 == 0 else contact(0.3))
        )
        for n, name in enumerate(_JUDGED)
    },
    **{
        f"{name}: healthy": ("sheet", partial(with_defect, name))
        for name in ("none", "pwm", "sensor lag", "quantisation", "jitter")
    },
    **{
        f"{name}: contact 30 %": ("sheet", partial(with_defect, name, contact(0.3)))
        for name, defect in DEFECTS.items() if not defect.judged
    },
    "shorted turns 15 %": ("sheet", partial(with_defect, "none", Fault(FaultKind.WINDING_SHORT, 0.15))),
    "noise tripled": ("sheet", partial(with_defect, "none", Fault(FaultKind.NOISE, 2.0))),
    "a weak magnet": ("sheet", lambda: replace(
        with_defect("none"), current_a=current_alone(motor=weak(0.7), timing=Timing(10_000.0, 0.2, 0.1)).current_a
    )),
    "with a speed: healthy": ("sheet", with_speed),
    "with a speed: bearing 35 %": ("sheet", partial(with_speed, bearing(0.35))),
    "with a speed: contact 35 %": ("sheet", partial(with_speed, contact(0.35))),
    "with a speed: shorted turns 15 %": ("sheet", partial(with_speed, Fault(FaultKind.WINDING_SHORT, 0.15))),
    "with a speed: noise tripled": ("sheet", partial(with_speed, Fault(FaultKind.NOISE, 2.0))),
    "short: healthy": ("starts as warm", partial(current_alone, timing=_SHORT)),
    "short: contact 25 %": ("starts as warm", partial(current_alone, contact(0.25), timing=_SHORT)),
    "slow: healthy": ("starts as warm", partial(current_alone, timing=_SLOW)),
    "slow: contact 25 %": ("starts as warm", partial(current_alone, contact(0.25), timing=_SLOW)),
    "slow and short: healthy": ("starts as warm", partial(current_alone, timing=_BRIEF)),
    "slow and short: contact 25 %": ("starts as warm", partial(current_alone, contact(0.25), timing=_BRIEF)),
    "weak magnet, learned": ("starts as warm", partial(current_alone, motor=weak(0.9))),
    "20 K colder": ("starts", partial(current_alone, motor=warmed(-20.0))),
    "25 K warmer": ("starts", partial(current_alone, motor=warmed(25.0))),
    "15 K warmer: contact 25 %": ("starts", partial(current_alone, contact(0.25), motor=warmed(15.0))),
    "constant load: contact 25 %": (
        "constant load", partial(loaded, "constant", 7, SHEET.parameters.scaled(resistance_ohm=1.25))
    ),
    "constant load, 35 K warmer": ("constant load", partial(loaded, "constant", 8, warmed(35.0, friction=0.0))),
    "fan: healthy": ("fan", partial(loaded, "fan", 6)),
    "fan: contact 25 %": ("fan", partial(loaded, "fan", 7, SHEET.parameters.scaled(resistance_ohm=1.25))),
    "two starts, then contact 30 %": (
        "sheet", lambda: in_a_row(with_defect("none"), with_defect("none", contact(0.3)))
    ),
    "two starts without a voltage": (
        "sheet", lambda: without(in_a_row(with_defect("none"), with_defect("none", contact(0.3))), "voltage_v")
    ),
    "all channels: healthy": ("sensors", lambda: started(_rng(7))),
    "current 35 % high": ("sensors", lambda: scaled(started(_rng(7)), current_a=1.35)),
    "speed 20 % low": ("sensors", lambda: scaled(started(_rng(7)), speed_rad_s=0.8)),
    "voltage 15 % high": ("sensors", lambda: scaled(started(_rng(7)), voltage_v=1.15)),
    "current in mA, learned": ("sensors", lambda: scaled(started(_rng(7)), current_a=1000.0)),
    "clock half as fast": ("sensors", lambda: scaled(started(_rng(7)), time_s=2.0)),
    "current stuck": ("sensors", lambda: held(started(_rng(7)))),
    "current dead": ("sensors", lambda: scaled(started(_rng(7)), current_a=0.0)),
    "log: current reversed": ("sheet", lambda: scaled(at_work(_rng(3)), current_a=-1.0)),
    "log: speed dead": ("sheet", lambda: scaled(at_work(_rng(3)), speed_rad_s=0.0)),
    "log: current offset by 1.5 A": (
        "sheet", lambda: replace(one := at_work(_rng(3)), current_a=one.current_a + 1.5)
    ),
    "log: columns swapped": ("sheet", lambda: swapped(at_work(_rng(3)))),
    "log: speed in degrees": ("sheet", lambda: scaled(at_work(_rng(3), seconds=2.0), speed_rad_s=180.0 / math.pi)),
    "speed in rpm": ("sheet", lambda: scaled(started(_rng(12)), speed_rad_s=30.0 / math.pi)),
    "twice the current": ("sheet", lambda: scaled(started(_rng(12)), current_a=2.0)),
    "half the voltage": ("sheet", lambda: scaled(started(_rng(12)), voltage_v=0.5)),
    "current in mA": ("sheet", lambda: _no_speed(scaled(started(_rng(12)), current_a=1000.0))),
    "half the rate": (
        "sheet", lambda: without(scaled(started(_rng(12)), time_s=2.0), "speed_rad_s", "voltage_v")
    ),
    "columns swapped": ("sheet", lambda: _no_speed(swapped(started(_rng(12))))),
    **{
        name: ("sheet", partial(lambda one: _no_speed(thing(one, started(_rng(12)), _rng(13))), name))
        for name in THINGS
    },
    "blocked rotor, learned": ("sensors", lambda: thing("blocked rotor", started(_rng(51)), _rng(52))),
    "work: healthy": ("windows", lambda: at_work(_rng(1), seconds=3.0)),
    "work: bearing 100 %": ("windows", lambda: at_work(_rng(1), bearing(1.0), seconds=3.0)),
    "work: contact 25 %": ("windows", lambda: at_work(_rng(1), contact(0.25), seconds=3.0)),
}  # fmt: skip
