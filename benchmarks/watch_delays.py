"""Delay of `motor-env watch` on a known motor without load, beside the CUSUM that knows kind and size of the fault.

    python benchmarks/watch_delays.py --runs 12

The textbook motor with a heavy flywheel on a test bench: a random duty cycle at 1 Hz, and nothing else moves. It comes
as the text that a device would print, in windows of 10 min after a commissioning of 5 h. One false alarm is asked for
in an hour, and in a year; the fault begins anywhere in a window. The CUSUM adds up the likelihood ratio of two Kalman
filters of current and speed. Its threshold is found by simulation for one alarm an hour.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from cyclopts import run
from tables import keep_table
from watch_counts import NO_ALARM, RATES, Floats, delays_by_fault, duty, heavy, lines, motion

from motor_env import FaultKind, KalmanFilter, SensorParameters, run_filter
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import LearningPhase, Watch
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import Channel, MotorParameters

NOISE_A, NOISE_RAD_S = 0.02, 1.0
SENSOR = SensorParameters((Channel.CURRENT, Channel.SPEED), NOISE_A, NOISE_RAD_S)
WINDOW_S, LEARN_S = 600.0, 5 * 3600.0
HEALTHY_S, FAULTY_S, CALIBRATION_H = 1200, 3600, 50
HOLDS = (6, 16)
FAULTS = (
    (FaultKind.BEARING, 0.25),
    (FaultKind.BEARING, 0.5),
    (FaultKind.BEARING, 1.0),
    (FaultKind.WINDING_CONTACT, 0.1),
    (FaultKind.WINDING_CONTACT, 0.25),
    (FaultKind.BEARING, 0.1),
    (FaultKind.WINDING_CONTACT, 0.01),
    (FaultKind.WINDING_CONTACT, 0.005),
)
ASKED = {"hour": RATES["hour"], "year": 1.0}
HEADER = ("fault", "best CUSUM, hour (s)", "`watch`, hour (s)", "year (s)", "named at once")


def work(rng: np.random.Generator, *parts: tuple[MotorParameters, int]) -> Floats:
    """Time, voltage, current, speed at 1 Hz of motors, each for so many seconds, shape (n, 4)."""
    volts, x = duty(rng, sum(seconds for _, seconds in parts), HOLDS), np.zeros(2)
    ends = np.cumsum([seconds for _, seconds in parts])[:-1]
    each = zip(parts, np.split(volts, ends), strict=True)
    states = np.concatenate([motion(motor, 1.0, some, x) for (motor, _), some in each])
    shown = states + rng.standard_normal(states.shape) * (NOISE_A, NOISE_RAD_S)
    return np.column_stack([np.arange(len(volts)) + 1.0, volts, shown])


def taught(samples: Floats) -> Healthy:
    """Learn a healthy motor at work as `watch --learn` does, from what a device prints."""
    watch = Watch(LearningPhase(WINDOW_S, LEARN_S, steady=True), State(), false_alarms_per_year=1.0)
    next(event for event in watch.events(lines([samples])) if event.kind == "learned")
    if watch.healthy is None:
        raise TypeError("nothing was learned")
    return watch.healthy


def logs(motor: MotorParameters, samples: Floats) -> Floats:
    """Log likelihood of each sample."""
    _, volts, *measured = samples.T
    result = run_filter(KalmanFilter.from_parameters(motor, SENSOR, 1.0), np.array(measured), volts)
    out: Floats = -0.5 * (result.nis + np.linalg.slogdet(result.innovation_covariance)[1])
    return out


def ratios(samples: Floats, faulty: MotorParameters) -> Floats:
    """Log likelihood ratio of each sample."""
    return logs(faulty, samples) - logs(heavy(), samples)


def first_alarm(healthy: Healthy, samples: Floats, onset_s: float, rate: str) -> tuple[float, str]:
    """Measure the time from the fault's begin to the first alarm, and its verdict; infinite where there is none."""
    watch = Watch(healthy, State(), false_alarms_per_year=ASKED[rate])
    for event in watch.events(lines([samples])):
        if event.time_s > onset_s and event.name not in NO_ALARM:
            return event.time_s - onset_s, event.text
    return np.inf, "none"


def compared(runs: int) -> Iterator[tuple[str, float, list[str]]]:
    """Measure for each fault a row of median delays; yield its kind and size, too."""
    rng = np.random.default_rng([77, 3])
    healthy = taught(work(rng, (heavy(), int(LEARN_S + WINDOW_S))))
    usual = work(rng, (heavy(), CALIBRATION_H * 3600)), float(CALIBRATION_H)
    for fault, faulty, best in delays_by_fault(heavy(), FAULTS, usual, ratios, HEALTHY_S):
        kind, severity = fault
        firsts = []
        ours: dict[str, list[tuple[float, str]]] = {rate: [] for rate in ASKED}
        for _ in range(runs):
            samples = work(rng, (heavy(), HEALTHY_S), (faulty, FAULTY_S))
            firsts.append(best(samples))
            late = samples[rng.integers(int(WINDOW_S)) :]
            for rate, found in ours.items():
                found.append(first_alarm(healthy, late, HEALTHY_S, rate))
        ours_s = [float(np.median([delay for delay, _ in found])) for found in ours.values()]
        row = [
            f"{kind} +{severity:.1%}",
            f"{np.median(firsts):.3g}",
            *(f"{delay:.4g}" if np.isfinite(delay) else "none in an hour" for delay in ours_s),
            f"{sum(verdict == kind.verdict for _, verdict in ours['hour']) / runs:.0%}",
        ]
        print(*row, sep=", ", file=sys.stderr, flush=True)
        yield str(kind), severity, row


def main(*, runs: int = 40) -> None:
    """Measure the delays and keep the table."""
    keep_table("watch", "delays", HEADER, (row for _, _, row in sorted(compared(runs))))


if __name__ == "__main__":
    run(main)
