"""Alarms and delays of monitors on simulated work: shared by watch_delays, watch_c and watch_other_physics.

The textbook motor with more inertia and a random duty cycle, healthy or with a fault; alarms beside those that are due;
delays beside the CUSUM that knows kind and size of the fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.stats import poisson

from motor_env import PAPER_MOTOR, Fault, FaultKind
from motor_env.diagnosis.operation.sequential_monitor import YEAR_S
from motor_env.diagnosis.streaming.watch import Event
from motor_env.motor.faults import apply_fault
from motor_env.motor.model import discretize
from motor_env.motor.parameters import MotorParameters

Floats = NDArray[np.float64]
Samples = TypeVar("Samples")
FLYWHEEL = 1000.0  # times the rotor's inertia
VOLTS = 12.0
RATES = {"hour": YEAR_S / 3600.0, "day": YEAR_S / 86_400.0}
"""False alarms a year that are asked for."""
NO_ALARM = ("window healthy", "window unusable")
ALARM_HEADER = ("asked for", "hours", "alarms due", "1 to 99 % of Poisson's", "alarms")


def heavy(inertia: float = FLYWHEEL) -> MotorParameters:
    """The textbook motor with a flywheel."""
    return PAPER_MOTOR.scaled(inertia_kg_m2=inertia)


@njit(cache=True)
def moved(transition: Floats, gain: Floats, volts: Floats, x: Floats) -> Floats:
    """States after each sample; `x` is left as the last of them."""
    out = np.empty((len(volts), 2))
    for k in range(len(volts)):
        i = transition[0, 0] * x[0] + transition[0, 1] * x[1] + gain[0] * volts[k]
        w = transition[1, 0] * x[0] + transition[1, 1] * x[1] + gain[1] * volts[k]
        x[0], x[1] = i, w
        out[k] = x
    return out


def duty(rng: np.random.Generator, samples: int, holds: tuple[int, int], *, least: float = -1.0) -> Floats:
    """A random share of the voltage, least .. 1, held for a random while."""
    lengths = rng.integers(holds[0], holds[1] + 1, samples // holds[0] + 1)
    levels: Floats = np.repeat(VOLTS * rng.uniform(least, 1.0, len(lengths)), lengths)[:samples]
    return levels


def motion(motor: MotorParameters, dt_s: float, volts: Floats, x: Floats) -> Floats:
    """Current and speed after each sample; `x` is left as the last of them."""
    model = discretize(motor, dt_s)
    states: Floats = moved(model.transition, model.gain[:, 0], volts, x)
    return states


def lines(blocks: Iterable[Floats], form: bytes = b"%.0f,%.5g,%.5g,%.6g\n") -> Iterator[bytes]:
    """What a device prints."""
    yield b"time_s,voltage_v,current_a,speed_rad_s\n"
    for block in blocks:
        for row in block.tolist():
            yield form % tuple(row)


def alarms(said: Iterable[Event]) -> int:
    """Alarms; what follows one without a healthy window between is the same."""
    count, was = 0, False
    for event in said:
        is_alarm = event.kind in ("window", "another_motor") and event.name not in NO_ALARM
        count += is_alarm and not was
        if is_alarm or event.name in NO_ALARM:
            was = is_alarm
    return count


def due(rate: str, hours: float) -> float:
    """Alarms that are due on healthy work."""
    return hours * 3600.0 * RATES[rate] / YEAR_S


def alarm_row(what: str, rate: str, hours: float, alarms: int) -> list[str]:
    """Alarms beside those that are due, and the limits of chance."""
    expected = due(rate, hours)
    low, high = (int(poisson.ppf(share, expected)) for share in (0.01, 0.99))
    asked = f"one {'an' if rate == 'hour' else 'a'} {rate}"
    return [what, asked, f"{hours:g}", f"{round(expected, 2):g}", f"{low} to {high}", str(alarms)]


@njit(cache=True)
def alarms_of(ratios: Floats, threshold: float) -> tuple[int, int]:
    """Alarms of a CUSUM that begins anew after each, and the sample of the first or -1."""
    total, count, first = 0.0, 0, -1
    for k in range(len(ratios)):
        total = max(0.0, total + ratios[k])
        if total > threshold:
            first = k if count == 0 else first
            count += 1
            total = 0.0
    return count, first


def best_threshold(ratios: Floats, wanted: int) -> float:
    """Threshold at which healthy samples alarm so often, by bisection."""
    low, high = 0.0, 40.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if alarms_of(ratios, middle)[0] > wanted else (low, middle)
    return high


def delays_by_fault(
    motor: MotorParameters,
    faults: Iterable[tuple[FaultKind, float]],
    usual: tuple[Samples, float],
    ratios: Callable[[Samples, MotorParameters], Floats],
    onset: int,
) -> Iterator[tuple[tuple[FaultKind, float], MotorParameters, Callable[[Samples], float]]]:
    """For each fault: kind and size, the faulty motor, and the samples that the best CUSUM needs in a record.

    Args:
        motor: the healthy one.
        faults: kind and severity.
        usual: healthy work, and how often the CUSUM may alarm in it.
        ratios: log likelihood ratios of samples, of a faulty motor over the healthy one.
        onset: sample of a record at which the fault begins.
    """
    healthy, wanted = usual
    for kind, severity in faults:
        faulty = apply_fault(motor, Fault(kind, severity))
        threshold = best_threshold(ratios(healthy, faulty), round(wanted))

        def best(samples: Samples, faulty: MotorParameters = faulty, threshold: float = threshold) -> float:
            first = alarms_of(ratios(samples, faulty)[onset:], threshold)[1]
            return first + 1 if first >= 0 else math.inf

        yield (kind, severity), faulty, best
