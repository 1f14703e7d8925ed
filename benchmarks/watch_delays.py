"""Delay of `motor-env watch` on a known motor without load, beside the CUSUM that knows kind and size of the fault.

    python benchmarks/watch_delays.py --runs 40 --out benchmarks/results/watch_delays.json

The motor and the work of `watch.py` at one known temperature, asked for one false alarm an hour; the fault begins
anywhere in a window. The CUSUM adds up the likelihood ratio of two Kalman filters of current and speed. Its threshold
is found by simulation for the same rate.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from watch import FAULTS, LEARN_S, NOISE_A, NOISE_RAD_S, RATES, WINDOW_S, Floats, duty, heavy, lines, moved
from watch_c import alarms_of, best_threshold

from motor_env import Fault, KalmanFilter, SensorParameters, run_filter
from motor_env.live.state import State
from motor_env.live.watch import Lesson, Watch
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.faults import apply_fault
from motor_env.motor.model import discretize
from motor_env.motor.parameters import Channel, MotorParameters

SENSOR = SensorParameters((Channel.CURRENT, Channel.SPEED), NOISE_A, NOISE_RAD_S)
HEALTHY_S, FAULTY_S, CALIBRATION_H = 1200, 3600, 50
HOLDS = (6, 16)


def work(rng: np.random.Generator, *parts: tuple[MotorParameters, int]) -> Floats:
    """Time, voltage, current, speed at 1 Hz of motors, each for so many seconds, shape (n, 4)."""
    volts, x = duty(rng, sum(seconds for _, seconds in parts), HOLDS), np.zeros(2)
    states, first = [], 0
    for motor, seconds in parts:
        model = discretize(motor, 1.0)
        inputs = np.stack([volts[first : first + seconds], np.zeros(seconds)], axis=1)
        states.append(moved(model.transition, model.gain, inputs, x))
        first += seconds
    noise = rng.standard_normal((len(volts), 2)) * (NOISE_A, NOISE_RAD_S)
    return np.column_stack([np.arange(len(volts)) + 1.0, volts, np.concatenate(states) + noise])


def logs(motor: MotorParameters, samples: Floats) -> Floats:
    """Log likelihood of each sample."""
    _, volts, *measured = samples.T
    result = run_filter(KalmanFilter.from_parameters(motor, SENSOR, 1.0), np.array(measured), volts)
    out: Floats = -0.5 * (result.nis + np.linalg.slogdet(result.innovation_covariance)[1])
    return out


def taught(rng: np.random.Generator) -> WindowReference:
    """What the healthy motor teaches in 5 h as on a test bench."""
    watch = Watch(Lesson(WINDOW_S, LEARN_S, steady=True), State(), false_alarms_per_year=1.0)
    stream = lines(iter([work(rng, (heavy(), int(LEARN_S + WINDOW_S)))]))
    next(event for event in watch.events(stream) if event.kind == "learned")
    if not isinstance(watch.reference, WindowReference):
        raise TypeError("nothing was learned")
    return watch.reference


def first_alarm(reference: WindowReference, samples: Floats, onset_s: float) -> tuple[float, str]:
    """From the fault's begin to the first alarm, and its kind; infinite where there is none."""
    watch = Watch(reference, State(), false_alarms_per_year=RATES["hour"])
    alarms = (
        (event.time_s - onset_s, event.text)
        for event in watch.events(lines(iter([samples])))
        if event.time_s > onset_s and event.name not in ("window healthy", "window unusable")
    )
    return next(alarms, (np.inf, "none"))


def compared(runs: int) -> list[dict[str, Any]]:
    """Median delays of both, by fault."""
    rng, rows = np.random.default_rng([77, 3]), []
    reference = taught(rng)
    usual = work(rng, (heavy(), CALIBRATION_H * 3600))
    for kind, severity in FAULTS:
        faulty = apply_fault(heavy(), Fault(kind, severity))
        threshold = best_threshold(logs(faulty, usual) - logs(heavy(), usual), CALIBRATION_H)
        best, ours = [], []
        for _ in range(runs):
            samples = work(rng, (heavy(), HEALTHY_S), (faulty, FAULTY_S))
            ratios = logs(faulty, samples) - logs(heavy(), samples)
            best.append(alarms_of(ratios[HEALTHY_S:], threshold)[1] + 1)
            late = samples[rng.integers(int(WINDOW_S)) :]
            ours.append(first_alarm(reference, late, HEALTHY_S))
        delays, names = zip(*ours, strict=True)
        rows.append(
            {
                "fault": str(kind),
                "severity": severity,
                "best_s": float(np.median(best)),
                "watch_s": float(np.median(delays)),
                "named": names.count(str(kind)) / runs,
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the delays."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    found = compared(options.runs)
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
