"""False alarms and delays of the C code of `export-c`, compiled with gcc, on simulated hours of a known motor.

    python benchmarks/watch_c.py --hours 200

The textbook motor with ten times its inertia, current at 100 Hz, a random duty cycle; every alarm begins the sum anew.
A delay is compared with the CUSUM of the likelihood ratio of two Kalman filters, which knows kind and size of the
fault; its threshold is found by simulation for the same number of false alarms.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from controllers import tool
from cyclopts import run
from numba import njit
from numpy.typing import NDArray
from tables import keep_table
from watch_counts import (
    ALARM_HEADER,
    RATES,
    VOLTS,
    Floats,
    alarm_row,
    delays_by_fault,
    duty,
    heavy,
    motion,
)

from motor_env import FaultKind, KalmanFilter, Motor, SensorParameters
from motor_env.diagnosis.embedded.monitor import CusumBank, Monitor, monitor_of, steady_schedule
from motor_env.diagnosis.embedded.source import write_library
from motor_env.diagnosis.embedded.twin import Numbers, fixed_point, floating, readings_of
from motor_env.motor.parameters import MotorParameters

RATE_HZ, INERTIA = 100.0, 10.0
SENSOR = SensorParameters(current_noise_a=0.02)
CASES, BLOCK_S = 10, 600.0
FAULTS = (
    (FaultKind.BEARING, 0.25),
    (FaultKind.BEARING, 0.5),
    (FaultKind.BEARING, 1.0),
    (FaultKind.WINDING_CONTACT, 0.05),
    (FaultKind.WINDING_CONTACT, 0.1),
    (FaultKind.WINDING_CONTACT, 0.25),
)
HOLDS = (5, 16)  # samples
RULES = {"bank": CusumBank(), "--shift 0.5": CusumBank((0.5,), ())}
DRIVES = {"one direction": 0.1, "both directions": -1.0}
"""Least share of the voltage."""
DELAYS, HEALTHY_S = 200, 10.0
CALIBRATION_H = 50.0
RUN = """
#include <string.h>
#include "m.h"
long size(void) { return (long)sizeof(m); }
void begin(m *monitor) { m_init(monitor); }
long run(m *monitor, long count, const m_sample *samples, long *first)
{
    long k, alarms = 0;
    *first = -1;
    for (k = 0; k < count; ++k) {
        if (m_step(monitor, samples[k]) == M_FAULT) {
            if (alarms++ == 0) { *first = k; }
            memset(monitor->sums, 0, sizeof monitor->sums);
        }
    }
    return alarms;
}
"""


class Compiled:
    """The exported library of a monitor, compiled."""

    def __init__(self, monitor: Monitor, folder: Path, *, arithmetic: str) -> None:
        steps = monitor.limits.counts() if arithmetic == "fixed" else None
        self.numbers: Numbers = floating(monitor) if steps is None else fixed_point(monitor, steps)
        write_library(monitor, folder, steps=steps, name="m", wanted="see the benchmark")
        (folder / "run.c").write_text(RUN, encoding="utf-8")
        library = folder / "run.so"
        sources = [folder / "run.c", folder / "src" / "m.c"]
        options: list[str | Path] = [
            "-O2",
            "-ffp-contract=off",
            "-shared",
            "-fPIC",
            "-I",
            folder / "src",
            "-o",
            library,
        ]
        subprocess.run([tool("gcc"), *sources, *options], check=True)
        self.library = ctypes.CDLL(str(library))
        self.library.run.restype = self.library.size.restype = ctypes.c_long

    def begun(self) -> ctypes.Array[ctypes.c_char]:
        """A monitor at its begin."""
        monitor = ctypes.create_string_buffer(self.library.size())
        self.library.begin(monitor)
        return monitor

    def run(
        self, monitor: ctypes.Array[ctypes.c_char], current_a: Floats, voltage_v: Floats
    ) -> tuple[int, int]:
        """Number of alarms, and the sample of the first or -1."""
        readings = readings_of(self.numbers, current_a[None, None], voltage_v)[0].T
        dtype = np.int32 if readings.dtype == np.int64 else np.float32
        samples: NDArray[Any] = np.ascontiguousarray(readings, dtype=dtype)
        first = ctypes.c_long()
        alarms = self.library.run(
            monitor, ctypes.c_long(len(samples)), ctypes.c_void_p(samples.ctypes.data), ctypes.byref(first)
        )
        return int(alarms), first.value


def exported(folder: Path, arithmetic: str, a_year: float, rule: CusumBank = RULES["bank"]) -> Compiled:
    """The C code of the motor for a number of false alarms a year."""
    folder.mkdir()
    monitor = monitor_of(
        Motor("textbook", "data_sheet", heavy(INERTIA)),
        RATE_HZ,
        rule=rule,
        sensor=SENSOR,
        voltage_v=VOLTS,
        false_alarms_per_year=a_year,
    )
    return Compiled(monitor, folder, arithmetic=arithmetic)


def current(motor: MotorParameters, rng: np.random.Generator, volts: Floats, x: Floats) -> Floats:
    """What the sensor shows of a motor; `x` is left as its last state."""
    states = motion(motor, 1.0 / RATE_HZ, volts, x)
    shown: Floats = states[:, 0] + SENSOR.current_noise_a * rng.standard_normal(len(volts))
    return shown


def false_alarms(
    codes: dict[tuple[str, str], Compiled], hours: float, rng: np.random.Generator
) -> Iterator[list[str]]:
    """A row of the table for the code of each arithmetic and rate: alarms of healthy motors."""
    block, counts = int(BLOCK_S * RATE_HZ), dict.fromkeys(codes, 0)
    blocks = round(hours * 3600.0 / BLOCK_S / CASES)
    for _ in range(CASES):
        x, monitors = np.zeros(2), {name: code.begun() for name, code in codes.items()}
        for _ in range(blocks):
            volts = duty(rng, block, HOLDS)
            shown = current(heavy(INERTIA), rng, volts, x)
            for name, code in codes.items():
                counts[name] += code.run(monitors[name], shown, volts)[0]
    for (arithmetic, rate), count in counts.items():
        yield alarm_row(f"C, {arithmetic}; known motor, no load", rate, hours, count)


class Belief(NamedTuple):
    """A Kalman filter with its last gain."""

    transition: Floats
    gain: Floats
    correction: Floats
    variance: float

    @classmethod
    def of_motor(cls, motor: MotorParameters) -> Belief:
        """From a motor."""
        kalman = KalmanFilter.from_parameters(motor, SENSOR, 1.0 / RATE_HZ)
        steps = steady_schedule(kalman)
        correction = np.ascontiguousarray(steps.gain[-1, :, 0])
        return cls(
            kalman.model.transition,
            kalman.model.gain,
            correction,
            float(steps.innovation_covariance[-1, 0, 0]),
        )


@njit(cache=True)
def likelihood_ratios(z: Floats, volts: Floats, healthy: Belief, faulty: Belief) -> Floats:
    """Logarithm of the likelihood ratio of each sample."""
    out, states = np.empty(len(z)), np.zeros((2, 2))
    for k in range(len(z)):
        logs = np.zeros(2)
        for n in range(2):
            belief = healthy if n == 0 else faulty
            a, g, x = belief.transition, belief.gain, states[n]
            i = a[0, 0] * x[0] + a[0, 1] * x[1] + g[0, 0] * volts[k]
            w = a[1, 0] * x[0] + a[1, 1] * x[1] + g[1, 0] * volts[k]
            error = z[k] - i
            logs[n] = -0.5 * (error * error / belief.variance + np.log(belief.variance))
            x[0], x[1] = i + belief.correction[0] * error, w + belief.correction[1] * error
        out[k] = logs[1] - logs[0]
    return out


def delays(codes: dict[str, Compiled], rng: np.random.Generator, drive: str) -> Iterator[list[str]]:
    """Median delays in seconds of codes for one false alarm an hour, and of the best CUSUM: a row a fault."""
    healthy, least = Belief.of_motor(heavy(INERTIA)), DRIVES[drive]
    onset, n = int(HEALTHY_S * RATE_HZ), int(BLOCK_S * RATE_HZ)
    beliefs = cache(Belief.of_motor)

    def ratios(samples: tuple[Floats, Floats], faulty: MotorParameters) -> Floats:
        out: Floats = likelihood_ratios(*samples, healthy, beliefs(faulty))
        return out

    volts = duty(rng, int(CALIBRATION_H * 3600.0 * RATE_HZ), HOLDS, least=least)
    usual = (current(heavy(INERTIA), rng, volts, np.zeros(2)), volts), CALIBRATION_H
    for (kind, severity), faulty, best in delays_by_fault(heavy(INERTIA), FAULTS, usual, ratios, onset):
        found: list[list[float]] = []
        for _ in range(DELAYS):
            now, x = duty(rng, n, HOLDS, least=least), np.zeros(2)
            before = current(heavy(INERTIA), rng, now[:onset], x)
            after = current(faulty, rng, now[onset:], x)
            samples = [best((np.concatenate([before, after]), now))]
            for code in codes.values():
                monitor = code.begun()
                code.run(monitor, before, now[:onset])
                first = code.run(monitor, after, now[onset:])[1]
                samples.append(first + 1 if first >= 0 else np.inf)
            found.append([count / RATE_HZ for count in samples])
        medians = np.median(found, axis=0).tolist()
        shown = [f"{median:.3g}" if np.isfinite(median) else "never" for median in medians]
        yield [drive, f"{kind} +{severity:.0%}", *shown, f"{medians[1] / medians[0]:.1f}"]


def main(*, hours: float = 50.0) -> None:
    """Count alarms, measure delays, and keep the tables of docs/results/exported-c.md."""
    # Each part has its own random numbers.
    counting, *driving = (np.random.default_rng([77, 19, part]) for part in (0, 2, 3))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        codes = {
            (arithmetic, rate): exported(folder / f"{arithmetic}-{rate}", arithmetic, a_year)
            for arithmetic in ("fixed", "float")
            for rate, a_year in RATES.items()
        }
        rules = {rule: exported(folder / rule, "fixed", RATES["hour"], RULES[rule]) for rule in RULES}
        keep_table(
            "exported-c", "false alarms", ("monitor", *ALARM_HEADER), false_alarms(codes, hours, counting)
        )
        keep_table(
            "exported-c",
            "delays",
            ("duty cycle", "fault", "the best CUSUM", "bank", "`--shift 0.5`", "bank over best"),
            (row for drive, rng in zip(DRIVES, driving, strict=True) for row in delays(rules, rng, drive)),
        )


if __name__ == "__main__":
    run(main)
