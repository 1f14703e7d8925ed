"""Delay of `motor-env watch` on a known motor without load, beside the CUSUM that knows kind and size of the fault.

    python benchmarks/watch_delays.py --runs 40 --out benchmarks/results/watch_delays.json

The motor and the work of `watch.py` at one known temperature, asked for one false alarm an hour and for one a year; the
fault begins anywhere in a window. The CUSUM adds up the likelihood ratio of two Kalman filters of current and speed.
Its threshold is found by simulation for one alarm an hour.
"""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from watch_counts import (
    FAULTS,
    LEARN_S,
    NO_ALARM,
    NOISE_A,
    NOISE_RAD_S,
    WINDOW_S,
    Floats,
    delays_by_fault,
    duty,
    events,
    heavy,
    motion,
    rows_of,
    taught,
    write,
)

from motor_env import FaultKind, KalmanFilter, SensorParameters, run_filter
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import Channel, MotorParameters

SENSOR = SensorParameters((Channel.CURRENT, Channel.SPEED), NOISE_A, NOISE_RAD_S)
HEALTHY_S, FAULTY_S, CALIBRATION_H = 1200, 3600, 50
HOLDS = (6, 16)
SMALL = ((FaultKind.BEARING, 0.1), (FaultKind.WINDING_CONTACT, 0.01), (FaultKind.WINDING_CONTACT, 0.005))


def work(rng: np.random.Generator, *parts: tuple[MotorParameters, int]) -> Floats:
    """Time, voltage, current, speed at 1 Hz of motors, each for so many seconds, shape (n, 4)."""
    volts, x = duty(rng, sum(seconds for _, seconds in parts), HOLDS), np.zeros(2)
    ends = np.cumsum([seconds for _, seconds in parts])[:-1]
    each = zip(parts, np.split(volts, ends), strict=True)
    states = np.concatenate([motion(motor, 1.0, some, None, x) for (motor, _), some in each])
    return rows_of(rng, volts, states)


def logs(motor: MotorParameters, samples: Floats) -> Floats:
    """Log likelihood of each sample."""
    _, volts, *measured = samples.T
    result = run_filter(KalmanFilter.from_parameters(motor, SENSOR, 1.0), np.array(measured), volts)
    out: Floats = -0.5 * (result.nis + np.linalg.slogdet(result.innovation_covariance)[1])
    return out


def ratios(samples: Floats, faulty: MotorParameters) -> Floats:
    """Log likelihood ratio of each sample."""
    return logs(faulty, samples) - logs(heavy(), samples)


def first_alarms(healthy: Healthy, samples: Floats, onset_s: float, rate: str) -> list[tuple[float, str]]:
    """From the fault's begin to the first alarm, its verdict, and that of the next; infinite where there is none."""
    found = (
        (event.time_s - onset_s, event.text)
        for event in events(healthy, [samples], rate)
        if event.time_s > onset_s and event.name not in NO_ALARM
    )
    return [*islice(found, 2), (np.inf, "none"), (np.inf, "none")][:2]


def compared(runs: int) -> list[dict[str, Any]]:
    """Median delays of both, by fault."""
    rng, rows = np.random.default_rng([77, 3]), []
    healthy = taught([work(rng, (heavy(), int(LEARN_S + WINDOW_S)))], steady=True)
    usual = work(rng, (heavy(), CALIBRATION_H * 3600)), float(CALIBRATION_H)
    for row, faulty, best in delays_by_fault(heavy(), (*FAULTS, *SMALL), usual, ratios, HEALTHY_S):
        firsts = []
        ours: dict[str, list[list[tuple[float, str]]]] = {"hour": [], "year": []}
        for _ in range(runs):
            samples = work(rng, (heavy(), HEALTHY_S), (faulty, FAULTY_S))
            firsts.append(best(samples))
            late = samples[rng.integers(int(WINDOW_S)) :]
            for rate, found in ours.items():
                found.append(first_alarms(healthy, late, HEALTHY_S, rate))
        row["best_s"] = float(np.median(firsts))
        for rate, found in ours.items():
            median = float(np.median([first[0] for first, _ in found]))
            row[f"{rate}_s"] = median if np.isfinite(median) else None
        for place, key in enumerate(("named", "named_next")):
            names = [alarms[place][1] for alarms in ours["hour"]]
            row[key] = names.count(FaultKind(row["fault"]).verdict) / runs
        rows.append(row)
        print(json.dumps(rows[-1]), flush=True)
    return rows


def main(*, runs: int = 40, out: Path | None = None) -> None:
    """Write the delays."""
    write(compared(runs), out)


if __name__ == "__main__":
    run(main)
