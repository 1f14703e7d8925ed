"""A second simulator of a motor at work, for benchmarks/operation.py: it shares no line with the package's own.

Classical Runge-Kutta at 50 kHz or finer; smooth Stribeck friction, brush drop, torque ripple of the commutator, winding
that warms, loads, speed and current loops, coasting with an open circuit, sensors of 12 bits with noise and offset.

Further switches add what the fitted model does not have: stiction with presliding (LuGre: Canudas de Wit et al. 1995),
cogging, torque ripple, gears whose friction grows with the torque, brushes whose resistance falls with the current, an
encoder whose speed is held between its edges, and converters of 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from motor_env.diagnosis.readers.recording import Recording

Floats = NDArray[np.float64]
PROFILES = (
    "steps",
    "reversals",
    "staircase",
    "prbs",
    "sine",
    "speed loop",
    "current loop",
    "averaged pwm",
    "coasting",
    "standstill",
)
LOADS = ("none", "constant", "square", "walk")
"""And `dry`: a constant load that only brakes, such as a conveyor; the constant one also pulls, such as a hoist."""
FINEST_HZ = 50_000.0
KNEE = 0.004  # of the stall current, at which the brush drop sets in
SLIDING = 0.002  # of the speed without load, at which dry friction sets in
VOLTAGE_NOISE = 5e-4  # of the supply, as much as hides the steps of the converter
SWITCHES = ("presliding", "cogging", "ripple", "gear", "brushes", "encoder", "8 bits")
_TEETH, _SEGMENTS = 14.0, 12.0  # periods a turn, of cogging and of the commutator
_SLOWEST_EDGE = 0.1  # mechanical time constants without an edge after which the shown speed falls


@dataclass(frozen=True)
class Further:
    """What the fitted model does not have; 0 where it is switched off.

    Attributes:
        bristle_rad: by how much the motor turns before it slides.
        cogging: torque over the stall torque.
        ripple: of torque and back-EMF, share.
        gear: torque lost, over the torque of the motor.
        brushes: largest voltage at the brushes over the supply; half of it at a tenth of the stall current.
        edges: of the encoder, a turn.
        bits: of the converters; 0 for those of `simulate`.
    """

    bristle_rad: float = 0.0
    cogging: float = 0.0
    ripple: float = 0.0
    gear: float = 0.0
    brushes: float = 0.0
    edges: int = 0
    bits: int = 0


def draw_further(rng: np.random.Generator, switches: Collection[str] = SWITCHES) -> Further:
    """Sizes of what is switched on; one switch does not change the draw of another."""
    sizes = {
        "presliding": {"bristle_rad": 10.0 ** rng.uniform(-2.3, -1.5)},
        "cogging": {"cogging": rng.uniform(0.005, 0.02)},
        "ripple": {"ripple": rng.uniform(0.02, 0.05)},
        "gear": {"gear": rng.uniform(0.05, 0.15)},
        "brushes": {"brushes": rng.uniform(0.02, 0.08)},
        "encoder": {"edges": int(rng.choice([12, 48, 200]))},
        "8 bits": {"bits": 8},
    }
    chosen = {name: value for switch in switches for name, value in sizes[switch].items()}
    return Further(**chosen)


@dataclass(frozen=True)
class Motor:
    """A motor in SI units; `heat` K/J and `cool` 1/s are the winding's."""

    volts: float
    ohm: float
    henry: float
    constant: float
    inertia: float
    viscous: float
    coulomb: float
    stribeck: float
    drop: float
    ripple: float
    heat: float
    cool: float
    noise_a: float
    noise_w: float
    further: Further = Further()

    @property
    def mechanical_s(self) -> float:
        """Mechanical time constant."""
        return self.inertia * self.ohm / self.constant**2

    @property
    def speed(self) -> float:
        """Speed without load."""
        return self.volts / self.constant

    @property
    def stall_a(self) -> float:
        """Current at standstill."""
        return self.volts / self.ohm


def draw_motor(rng: np.random.Generator, switches: Collection[str] = ()) -> Motor:
    """A motor of 6 to 48 V, with what of SWITCHES is on."""
    volts = float(rng.choice([6.0, 12.0, 24.0, 48.0]))
    stall, speed = 10.0 ** rng.uniform(-0.2, 1.5), 10.0 ** rng.uniform(2.0, 2.8)
    mechanical = 10.0 ** rng.uniform(-1.8, -0.6)
    electrical = mechanical / 10.0 ** rng.uniform(1.0, 2.0)
    ohm, constant = volts / stall, volts / speed
    drag = constant * stall * rng.uniform(0.02, 0.06)
    dry = rng.uniform(0.2, 0.8)
    return Motor(
        volts=volts,
        ohm=ohm,
        henry=electrical * ohm,
        constant=constant,
        inertia=mechanical * constant**2 / ohm,
        viscous=(1.0 - dry) * drag / speed,
        coulomb=dry * drag,
        stribeck=rng.uniform(0.0, 0.1),
        drop=float(rng.choice([0.0, rng.uniform(0.01, 0.05)])) * volts,
        ripple=rng.uniform(0.0, 0.01),
        heat=rng.uniform(0.2, 2.0) / (volts * stall * 0.05 * 60.0),
        cool=1.0 / rng.uniform(30.0, 300.0),
        noise_a=stall * 10.0 ** rng.uniform(-2.7, -2.0),
        noise_w=speed * 10.0 ** rng.uniform(-3.0, -2.0),
        further=draw_further(rng.spawn(1)[0], switches),
    )


# Without numba's counts of who holds an array, which `motor_env.motor.compiled` explains; so no array is made inside.
@njit(error_model="numpy", _nrt=False, forceinline=True)
def _slope(x: Floats, volts: float, open_: bool, load: float, square: float, c: Floats, out: Floats) -> None:
    i, w, angle, warm, bristle = x[0], x[1], x[2], x[3], x[4]
    ohm, constant = c[0] * (1.0 + 0.00393 * warm), c[2] * (1.0 - 0.001 * warm)
    pace, cold = c[12], 1.0 - 0.003 * warm
    slow = math.exp(-((w / (5.0 * pace)) ** 2))
    dry = c[5] * (1.0 + c[6] * slow)
    turning = math.tanh(w / pace) if c[14] > 0.0 or c[18] > 0.0 or c[15] <= 0.0 else 0.0
    if c[15] > 0.0:
        stiffness = c[5] / c[15]
        slid = w - stiffness * abs(w) / dry * bristle
        damping = math.sqrt(stiffness * c[3]) * slow
        friction = (stiffness * bristle + damping * slid + c[4] * w) * cold + c[14] * turning
    else:
        slid = 0.0
        friction = (dry * turning + c[4] * w) * cold + c[14] * turning
    # c[8] is of the torque alone; c[17] is of the flux, and so of torque and back-EMF.
    segment = math.cos(_SEGMENTS * angle)
    flux = constant * (1.0 + c[17] * segment)
    torque = flux * i * (1.0 + c[8] * segment) - friction - load - square * w * abs(w)
    cogging = c[16] * math.sin(_TEETH * angle) if c[16] > 0.0 else 0.0
    torque -= cogging + c[18] * abs(flux * i) * turning
    brushes = c[19] * i / (abs(i) + c[20]) if c[19] > 0.0 else 0.0
    dropped = c[7] * math.tanh(i / c[11]) if c[7] > 0.0 else 0.0
    drop = (ohm + c[13]) * i + dropped + brushes
    out[0] = 0.0 if open_ else (volts - drop - flux * w) / c[1]
    out[1], out[2], out[3], out[4] = torque / c[3], w, c[9] * ohm * i * i - c[10] * warm, slid


@njit(cache=True, error_model="numpy", _nrt=False)
def _run(
    wanted: Floats, mode: int, free: Floats, load: Floats, square: float, c: Floats, fine: int, h: float, limit: float,
    gains: Floats, out: Floats, room: Floats,
) -> None:  # fmt: skip
    """Modes: 0 voltage, 1 speed loop, 2 current loop; the controller runs once a sample and holds its voltage."""
    x, k1, total, y = room[0], room[1], room[2], room[3]
    integral, time, edge_s, held, edges = 0.0, 0.0, 0.0, 0.0, c[21] / (2.0 * math.pi)
    last = math.nan  # where the last edge was
    for k in range(wanted.shape[0]):
        volts = wanted[k]
        shown = x[1]
        if edges > 0.0:
            # Without an edge for long the motor is slower than the last one said.
            waited = time - edge_s
            shown = held if waited < c[22] else math.copysign(min(abs(held), 1.0 / (edges * waited)), held)
        if mode > 0:
            error = wanted[k] - (shown if mode == 1 else x[0])
            integral += gains[1] * error
            integral = min(max(integral, -limit), limit)
            volts = min(max(gains[0] * error + integral, -limit), limit)
        open_ = free[k] > 0.0
        if open_:
            x[0] = 0.0
            volts = c[2] * x[1]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = volts - c[13] * x[0], x[0], shown, x[3]
        for _ in range(fine):
            before = x[2]
            for n in range(5):
                total[n], y[n] = 0.0, x[n]
            for stage in range(4):
                _slope(y, volts, open_, load[k], square, c, k1)
                weight = 1.0 if stage in (0, 3) else 2.0
                for n in range(5):
                    total[n] += weight * k1[n] / 6.0
                    y[n] = x[n] + (h if stage == 2 else 0.5 * h) * k1[n]
            for n in range(5):
                x[n] += h * total[n]
            time += h
            if edges > 0.0 and math.floor(before * edges) != math.floor(x[2] * edges):
                line = max(math.floor(before * edges), math.floor(x[2] * edges)) / edges
                now = time - h * (x[2] - line) / (x[2] - before)
                # The first edge tells no speed, nor does one that is passed again the other way.
                is_next = abs(line - last) * edges > 0.5
                held = math.copysign(1.0 / (edges * max(now - edge_s, h)), x[2] - before) if is_next else 0.0
                edge_s, last = now, line


def wanted(
    profile: str, motor: Motor, n: int, dt: float, rng: np.random.Generator
) -> tuple[Floats, int, Floats]:
    """What is commanded at each sample, the mode of the drive, and where the circuit is open; "one way" are levels."""
    hold = max(int(motor.mechanical_s * rng.uniform(1.5, 4.0) / dt), 3)
    short, blocks, time = max(hold // 3, 2), n // hold + 1, np.arange(n) * dt
    mode = {"speed loop": 1, "current loop": 2}.get(profile, 0)
    open_ = np.zeros(n)
    command, unit, length = rng.uniform(0.4, 1.0, blocks), motor.volts, hold
    match profile:
        case "start":
            command, length = (np.arange(n) >= n // 10).astype(float), 1
        case "steps":
            command = rng.uniform(0.2, 1.0, blocks) * (rng.random(blocks) < 0.7)
        case "reversals":
            command = command * np.resize([1.0, -1.0], blocks)
        case "staircase":
            stairs = np.concatenate([np.arange(1, 6), np.arange(5, -6, -1), np.arange(-5, 1)])
            command = np.resize(stairs, blocks) / 5.0
        case "prbs":
            command, length = rng.choice([-0.7, 0.9], n // short + 1), short
        case "sine":
            turns = 0.5 / motor.mechanical_s * time
            command, length = 0.5 * np.sin(turns) + 0.3 * np.sin(2.7 * turns), 1
        case "speed loop":
            command, unit = rng.uniform(-0.7, 0.7, blocks), motor.speed
        case "current loop":
            command = np.resize([0.25, -0.25], blocks) * rng.uniform(0.5, 1.0, blocks)
            unit = motor.stall_a
        case "averaged pwm":
            command = np.round(255.0 * rng.uniform(-1.0, 1.0, blocks)) / 255.0
        case "coasting":
            open_ = np.repeat(np.resize([0.0, 0.0, 1.0], blocks), hold)[:n]
        case "standstill":
            command = np.where(rng.random(blocks) < 0.4, 0.015, rng.uniform(-1.0, 1.0, blocks))
    return np.repeat(command, length)[:n] * unit, mode, open_


def simulate(
    motor: Motor,
    profile: str,
    rng: np.random.Generator,
    *,
    load: str = "none",
    samples: int = 3000,
    dt_s: float | None = None,
    bits: int = 12,
    warm_k: float = 0.0,
    torque_n_m: float | None = None,
    supply_ohm: float = 0.0,
    stiffness: float = 1.0,
    usual: Motor | None = None,
) -> Recording:
    """One recording of a motor at work.

    Args:
        motor: simulated.
        profile: of PROFILES, or a start.
        rng: of motor, drive and sensors.
        load: of LOADS, or dry.
        samples: number.
        dt_s: sampling interval; drawn if None.
        bits: of the converters.
        warm_k: how much warmer than usual the whole motor is.
        torque_n_m: of the load, at the speed without load; 15 % of the stall torque if None.
        supply_ohm: resistance of the supply; the voltage is recorded behind it.
        stiffness: gains of the controller, times the usual ones.
        usual: motor that drive, load and sensors were made for, which know of no fault; this one if None.
    """
    usual = usual or motor
    dt = dt_s or usual.mechanical_s / 10.0 ** rng.uniform(0.6, 1.6)
    if warm_k:
        motor = warmed(motor, warm_k)
    fine = math.ceil(dt * max(FINEST_HZ, 30.0 * motor.ohm / motor.henry))
    command, mode, open_ = wanted(profile, usual, samples, dt, rng)
    rated = usual.constant * usual.stall_a * 0.15 if torque_n_m is None else torque_n_m
    torque = np.zeros(samples)
    if load == "constant":
        torque += rated
    if load == "walk":
        torque = rated * np.cumsum(rng.standard_normal(samples)) / math.sqrt(samples)
    constants = np.array(
        [motor.ohm, motor.henry, motor.constant, motor.inertia, motor.viscous, motor.coulomb, motor.stribeck,
         motor.drop, motor.ripple, motor.heat, motor.cool, KNEE * usual.stall_a, SLIDING * usual.speed, supply_ohm,
         rated if load == "dry" else 0.0, *_further(usual)]
    )  # fmt: skip
    gain = stiffness * (0.5 * usual.volts / usual.speed * 6.0 if mode == 1 else 0.5 * usual.ohm)
    gains = np.array([gain, gain * min(dt / usual.mechanical_s, 0.3)])
    out = np.empty((samples, 4))
    _run(command, mode, open_, torque, rated / usual.speed**2 if load == "square" else 0.0, constants, fine,
         dt / fine, motor.volts, gains, out, np.zeros((4, 5)))  # fmt: skip
    return recorded(usual, profile, out, dt=dt, rng=rng, bits=usual.further.bits or bits)


def _further(motor: Motor) -> tuple[float, ...]:
    """Constants of what the fitted model does not have, as `_slope` and `_run` take them."""
    of, stall = motor.further, motor.constant * motor.stall_a
    slowest = _SLOWEST_EDGE * motor.mechanical_s
    return (of.bristle_rad, of.cogging * stall, of.ripple, of.gear, of.brushes * motor.volts,
            0.1 * motor.stall_a, float(of.edges), slowest)  # fmt: skip


def recorded(
    motor: Motor, name: str, out: Floats, *, dt: float, rng: np.random.Generator, bits: int
) -> Recording:
    """What sensors with noise, offset and a converter show."""

    def converted(values: Floats, full: float) -> Floats:
        step = 2.0 * full / 2**bits
        rounded: Floats = np.round(values / step) * step
        return rounded

    n = len(out)
    current = (
        out[:, 1] + motor.noise_a * rng.standard_normal(n) + 0.001 * motor.stall_a * rng.standard_normal()
    )
    speed = out[:, 2] + motor.noise_w * rng.standard_normal(n)
    return Recording(
        Path(name),
        np.arange(n, dtype=np.float64) * dt,
        converted(current, 2.1 * motor.stall_a),
        converted(out[:, 0] + VOLTAGE_NOISE * motor.volts * rng.standard_normal(n), 1.2 * motor.volts),
        converted(speed, 1.2 * motor.speed),
    )


def warmed(motor: Motor, kelvin: float) -> Motor:
    """A copy of the motor at another temperature."""
    friction = 1.0 - 0.003 * kelvin
    return replace(
        motor,
        ohm=motor.ohm * (1.0 + 0.00393 * kelvin),
        constant=motor.constant * (1.0 - 0.001 * kelvin),
        viscous=motor.viscous * friction,
        coulomb=motor.coulomb * friction,
    )
