"""C99 source of a monitor from Jinja2 templates: library, self test, CMake and Arduino files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import dlsim

from motor_env.embedded.arithmetic import (
    LARGEST,
    STATISTIC_BITS,
    Numbers,
    SampleVerdict,
    Steps,
    Values,
    answers,
    fixed_point,
    floating,
    readings_of,
)
from motor_env.embedded.monitor import Monitor
from motor_env.errors import InputError
from motor_env.files import write_text
from motor_env.pages.html import render

_HEALTHY_CHECKS, _FAULTY_CHECKS, _MOST_DOUBLINGS = 8, 8, 60
_RESERVED = frozenset(["monitor", "sample", "number", "main", "loop", "setup"])


class Check(NamedTuple):
    """One sample of the self test."""

    readings: Values
    statistic: Values
    verdict: str


def write_library(
    monitor: Monitor, folder: Path, *, steps: Steps | None, name: str, wanted: str
) -> list[Path]:
    """Write the C library of a monitor.

    Args:
        monitor: what it computes.
        folder: where; its files are replaced.
        steps: what one count of a reading is worth in fixed point; None for single precision.
        name: of the library, and the first part of the names in it.
        wanted: the rate of false alarms in words.

    Returns:
        The files.

    Raises:
        InputError: the name is no lower-case C name, or a file cannot be written.
        ValueError: the steps do not suit the ranges.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name) or name in _RESERVED:
        raise InputError(f"name must be a C name of lower-case letters such as motor_monitor, got {name!r}")
    numbers = floating(monitor) if steps is None else fixed_point(monitor, steps)
    values = _values(monitor, numbers, name, wanted)
    files = {
        f"src/{name}.h": "monitor.h.j2",
        f"src/{name}.c": "monitor.c.j2",
        "test/self_test.c": "self_test.c.j2",
        f"examples/{name}_watch/{name}_watch.ino": "sketch.ino.j2",
        "CMakeLists.txt": "CMakeLists.txt.j2",
        "library.properties": "library.properties.j2",
    }
    for path, template in files.items():
        text = render("motor_env.embedded", template, filters={"literal": literal}, **values)
        write_text(folder / path, f"{text}\n")
    return [folder / path for path in files]


def _values(monitor: Monitor, n: Numbers, name: str, wanted: str) -> dict[str, Any]:
    rate_hz = 1.0 / monitor.kalman.model.dt_s
    gains = np.concatenate([row.factors for row in (*n.gain, *n.white)], axis=1)
    return {
        "n": n,
        "name": name,
        "title": "Monitor of " + re.sub(r"[^\w .,:+-]", "_", monitor.motor.name, flags=re.ASCII),
        "rule": re.sub(r"[*/]", "_", repr(monitor.rule)),
        "wanted": wanted,
        "fixed": n.is_fixed,
        "number": "int32_t" if n.is_fixed else "float",
        "cusum": n.halves.size > 0,
        "m": n.n_channels,
        "two_channels": n.n_channels == 2,
        "scheduled": len(gains) > 1,
        "gains": gains,
        "rate_hz": f"{rate_hz:.9g}",
        "period_us": round(1e6 / rate_hz),
        "counts": Steps(*(literal(np.float32(size)) for size in n.readings)),  # type: ignore[arg-type]
        "statistic_bits": STATISTIC_BITS,
        "memory_share": np.float32(2.0**-n.memory),
        "statistic_count": literal(np.float32(2.0**-STATISTIC_BITS if n.is_fixed else 1.0)),
        "largest": LARGEST,
        "slack": 0 if n.is_fixed else "1e-3f",
        "checks": checks(monitor, n),
    }


def literal(value: Any) -> str:
    """A number as C source; single precision keeps every bit."""
    return f"{int(value)}" if isinstance(value, np.integer) or value.dtype == np.int64 else f"{value!s}f"


def checks(monitor: Monitor, n: Numbers) -> list[Check]:
    """Samples of a healthy start, then of a current that is off by so much that it alarms, then one out of range."""
    model, sensor, voltage_v = (
        monitor.kalman.model,
        monitor.kalman.observation,
        monitor.limits.voltage_v / 2.0,
    )
    read = (model.transition, model.gain[:, :1], sensor @ model.transition, sensor @ model.gain[:, :1])
    _, expected, _ = dlsim((*read, model.dt_s), np.full(_HEALTHY_CHECKS + _FAULTY_CHECKS, voltage_v))
    noise = np.sqrt(np.diag(monitor.kalman.measurement_covariance))[:, None]
    for off in np.ldexp(4.0, range(_MOST_DOUBLINGS)):
        measured = expected.T + noise * np.where(np.arange(len(expected)) % 2, -0.5, 0.5)
        measured[0, _HEALTHY_CHECKS:] += off * noise[0]
        measured[0, -1] = 4.0 * monitor.limits.current_a
        readings = readings_of(n, measured[None], voltage_v)
        (verdicts,), (statistics,) = answers(n, readings)
        if SampleVerdict.FAULT in verdicts or off > monitor.limits.current_a / noise[0]:
            break
    samples = zip(readings[0].T, statistics, verdicts.tolist(), strict=True)
    return [Check(reading, statistic, SampleVerdict(verdict).name) for reading, statistic, verdict in samples]
