"""Simulated captures with the defects of real ones, one at a time: what a diagnosis must see through, or refuse.

Each capture is a start of its own motor, drawn within the tolerances of `bench`, with time, current and the voltage
that was commanded; the truth stays here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from motor_env.diagnosis.readers.recording import Recording, resampled
from motor_env.motor.faults import Fault, apply_faults
from motor_env.motor.parameters import FloatArray, MotorParameters, SensorParameters, SupplyParameters
from motor_env.simulation.fast_path import measure
from motor_env.simulation.named_recipes import BENCH_SPREAD
from motor_env.simulation.nonlinear import Effects
from motor_env.simulation.random_streams import Stream, normals
from motor_env.simulation.sampling import apply_factors
from motor_env.simulation.sensor import SensorChain
from motor_env.simulation.simulate import Scenario, Timing, simulate_states

_SUBSTEPS = 16
SUPPLY_V = 12.0  # nominal; it is what the recordings claim
Reshape = Callable[[FloatArray, FloatArray, np.random.Generator], tuple[FloatArray, FloatArray]]
"""From time and current to time and current."""


@dataclass(frozen=True, slots=True)
class Defect:
    """One thing that is wrong with a capture.

    Attributes:
        words: what the diagnosis should notice, a part of its sentence; empty where there is nothing to notice.
        effects: of supply and motor.
        chain: of the current sensor.
        noise_a: standard deviation of the current's noise.
        lag_s: time constant of the current sensor, before it is sampled.
        pwm_hz: the supply is a converter of twice the voltage that is on half the time; 0 for none.
        shunt_ohm: in series with the motor.
        quiet_s: time before the start.
        reshape: what happens to the readings afterwards.
        judged: False where no verdict is possible: the recording must be called unusable.
    """

    words: str = ""
    effects: Effects | None = None
    chain: SensorChain | None = None
    noise_a: float = 0.02
    lag_s: float = 0.0
    pwm_hz: float = 0.0
    shunt_ohm: float = 0.0
    quiet_s: float = 0.1
    reshape: Reshape = field(default=lambda time_s, current_a, _: (time_s, current_a))
    judged: bool = True


def _jitter(
    time_s: FloatArray, current_a: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Samples that are read up to 0.3 of an interval early or late, with the time at which they were read."""
    late = rng.uniform(-0.3, 0.3, len(time_s)) * (time_s[1] - time_s[0])
    return time_s + late, np.interp(time_s + late, time_s, current_a)


def _spike(
    time_s: FloatArray, current_a: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """One sample that is 8 A off."""
    wild = current_a.copy()
    wild[int(rng.integers(len(wild)))] += 8.0
    return time_s, wild


def _hum(
    time_s: FloatArray, current_a: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Mains of 50 or 60 Hz of the noise's size, and half of that at twice the frequency."""
    phase = 2.0 * np.pi * rng.choice([50.0, 60.0]) * time_s + rng.uniform(0.0, 2.0 * np.pi)
    return time_s, current_a + 0.02 * np.sin(phase) + 0.01 * np.sin(2.0 * phase)


def _high_pass(
    time_s: FloatArray, current_a: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """A probe that is coupled by a capacitor, with a time constant of 20 to 200 ms."""
    kept = np.exp(-(time_s[1] - time_s[0]) / 10.0 ** rng.uniform(-1.7, -0.7))
    return time_s, lfilter([kept, -kept], [1.0, -kept], current_a)


DEFECTS: dict[str, Defect] = {
    "none": Defect(),
    "offset": Defect(chain=SensorChain(offset_a=0.25)),
    "noise": Defect(noise_a=0.03),
    "saturation": Defect("saturation", chain=SensorChain(range_a=3.0), judged=False),
    "rectification": Defect(
        "rectification", reshape=lambda time_s, current_a, _: (time_s, np.maximum(current_a, 0.0))
    ),
    "quantisation": Defect("quantisation", chain=SensorChain(range_a=6.4, adc_bits=8)),
    "pwm": Defect("PWM ripple", pwm_hz=17_000.0),
    "supply ramp": Defect("supply ramp", effects=Effects(ramp_s=0.005)),
    "sensor lag": Defect("lag", lag_s=0.0003),
    "series shunt": Defect(shunt_ohm=0.22),
    "jitter": Defect("uneven", reshape=_jitter),
    "onset between samples": Defect(effects=Effects(delay_s=0.00006)),
    "negative times": Defect(reshape=lambda time_s, current_a, _: (time_s - 7.5, current_a)),
    "reversed": Defect(reshape=lambda time_s, current_a, _: (time_s, -current_a)),
    "a wild sample": Defect("outlier", reshape=_spike),
    "no quiet part": Defect(quiet_s=0.0),
    "no start": Defect(reshape=lambda time_s, current_a, _: (time_s, current_a - current_a), judged=False),
    "mains hum": Defect("hum of the mains", reshape=_hum),
    "coupled by a capacitor": Defect("AC-coupled", reshape=_high_pass, judged=False),
}
"""The defects by name, each alone."""


def captures(
    defect: Defect, faults: tuple[Fault, ...], motor: MotorParameters, seed: int, count: int
) -> list[Recording]:
    """Recorded starts with one defect.

    Args:
        defect: what is wrong with the captures.
        faults: what is wrong with the motors.
        motor: the nominal motor.
        seed: the random seed.
        count: number of captures.
    """
    numbers = np.arange(count)
    factors = 1.0 + BENCH_SPREAD.std * normals(seed, Stream.MOTOR, numbers, 5)
    motors = apply_factors(motor, factors)
    motors = replace(motors, resistance_ohm=motors.resistance_ohm + defect.shunt_ohm)
    timing = Timing(10_000.0, 0.2, defect.quiet_s)
    scenario = Scenario(
        motors,
        faults,
        SupplyParameters(SUPPLY_V * factors[:, 0]),
        SensorParameters(current_noise_a=defect.noise_a),
        timing,
    )
    if defect.pwm_hz > 0.0 or defect.lag_s > 0.0:
        readings = _finely(scenario, defect, seed, count)
    else:
        effects, chain = defect.effects, defect.chain
        measured = measure(scenario, seed, numbers, effects=effects, chain=chain, nominal=motor)[:, 0]
        readings = measured.astype(np.float64)
    recordings = []
    for n, row in enumerate(readings):
        time_s, current_a = defect.reshape(timing.time_s, row, np.random.default_rng([seed, n]))
        even, columns, notes = resampled(time_s, {"current": current_a})
        # Samples at uneven times become a few more or fewer on the even axis.
        shown = np.minimum(np.arange(len(even)), timing.n_samples - 1)
        commanded = np.where(timing.time_s > 1e-9, SUPPLY_V, 0.0)[shown]
        recordings.append(
            Recording(Path(f"simulated-{n}"), even, columns["current"], commanded, columns=notes)
        )
    return recordings


def _finely(scenario: Scenario, defect: Defect, seed: int, count: int) -> FloatArray:
    """Currents from sixteen steps a sample: of a converter that is on for half of each period, of a lagging sensor."""
    timing = scenario.timing
    dt_s = timing.dt_s / _SUBSTEPS
    edges = np.arange(timing.n_samples * _SUBSTEPS + 1) * dt_s - timing.n_quiet * timing.dt_s
    driven = (edges[1:] > 0.5 * dt_s).astype(np.float64)
    if defect.pwm_hz > 0.0:
        periods = np.maximum(edges, 0.0) * defect.pwm_hz
        on = np.floor(periods) * 0.5 + np.minimum(periods % 1.0, 0.5)
        driven = driven * 2.0 * np.diff(on) / (dt_s * defect.pwm_hz)
    voltage = np.asarray(scenario.supply.voltage_v)[:, None] * driven
    current = simulate_states(apply_faults(scenario.parameters, scenario.faults), voltage, dt_s)[..., 0]
    if defect.lag_s > 0.0:
        kept = np.exp(-dt_s / defect.lag_s)
        between = 0.5 * (current + np.concatenate([np.zeros((count, 1)), current[:, :-1]], axis=1))
        current = lfilter([1.0 - kept], [1.0, -kept], between, axis=1)
    noise = normals(seed, Stream.MEASUREMENT, np.arange(count), timing.n_samples)
    out: FloatArray = current[:, _SUBSTEPS - 1 :: _SUBSTEPS] + scenario.sensor.current_noise_a * noise
    return out
