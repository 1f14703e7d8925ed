"""Write a monitor as C99 from Jinja2 templates: library, self test, CMake and Arduino files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import dlsim

from motor_env.common.errors import InputError
from motor_env.common.files import filling, require_own_output, write_text
from motor_env.common.pages import render
from motor_env.diagnosis.embedded.monitor import DEAD_AFTER, Monitor, Readings
from motor_env.diagnosis.embedded.twin import (
    LARGEST,
    NOTHING_BITS,
    SOMETHING_BITS,
    STATISTIC_BITS,
    Numbers,
    SampleVerdict,
    Values,
    fixed_point,
    floating,
    readings_of,
    run_twin,
)

_HEALTHY_CHECKS, _FAULTY_CHECKS, _MOST_DOUBLINGS = 8, 8, 60
_RESERVED = (
    # C, C++ and what their compilers define, which cannot name a type,
    " auto break case char const continue default do double else enum extern float for goto if inline int long"
    " register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while"
    " alignas alignof asm bool constexpr false nullptr static_assert thread_local true typeof typeof_unqual"
    " and and_eq bitand bitor catch char8_t char16_t char32_t class co_await co_return co_yield compl concept"
    " consteval constinit const_cast decltype delete dynamic_cast explicit export friend mutable namespace new"
    " noexcept not not_eq operator or or_eq private protected public reinterpret_cast requires static_cast template"
    " this throw try typeid typename using virtual wchar_t xor xor_eq linux unix"
    # and what the library, its test and its sketch call something.
    " began_us begin c clamped count current due_us factors failed forward gains growth innovation is_lit is_reading"
    " k last loop lost main micros millis monitor most not_negative number off product reading rounded same sample"
    " setup shift side slow speed state statistic stuck sum sums total value values verdict voltage white wrong "
)
_MARK = "author=motor-env export-c\n"


class Check(NamedTuple):
    """Sample of the self test."""

    readings: Values
    statistic: Values
    verdict: str


def write_library(
    monitor: Monitor, folder: Path, *, steps: Readings | None, name: str, wanted: str
) -> list[Path]:
    """Write the C library of a monitor, complete or not at all.

    Args:
        monitor: the monitor.
        folder: new, empty, or an earlier library.
        steps: size of one count of each reading (fixed point); None for single precision.
        name: of the library, and prefix of its names.
        wanted: rate of false alarms in words.

    Returns:
        The files.

    Raises:
        InputError: no valid name, other files in the folder, a number that does not fit, or an unwritable file.
        ValueError: the steps do not suit the ranges.
    """
    if (
        not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name)
        or f" {name} " in _RESERVED
        or re.fullmatch(r"u?int\w*_t", name)
    ):
        raise InputError(
            f"name must be a C name of lower-case letters such as motor_monitor, and no word of C, got {name!r}"
        )
    require_own_output(folder, "library.properties", _MARK, command="export-c")
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
    with filling(folder) as unfinished:
        for path, template in files.items():
            text = render("motor_env.diagnosis.embedded", template, filters={"literal": literal}, **values)
            write_text(unfinished / path, f"{text}\n")
    return [folder / path for path in files]


def _values(monitor: Monitor, n: Numbers, name: str, wanted: str) -> dict[str, Any]:
    rate_hz = 1.0 / monitor.kalman.model.dt_s
    gains = np.concatenate([row.factors for row in (*n.gain, *n.white)])
    return {
        "n": n,
        "name": name,
        "title": "Monitor of " + re.sub(r"[^\w .,:+-]", "_", monitor.motor.name, flags=re.ASCII),
        "rule": repr(monitor.rule),
        "wanted": wanted,
        "fixed": n.is_fixed,
        "number": "int32_t" if n.is_fixed else "float",
        "m": n.n_channels,
        "two_channels": n.n_channels == 2,
        "gains": gains,
        "rate_hz": f"{rate_hz:.9g}",
        "period_us": round(1e6 / rate_hz),
        "counts": Readings(*(literal(np.float32(size)) for size in n.readings)),  # type: ignore[arg-type]
        "memory_share": np.float32(2.0**-n.memory),
        "nothing_bits": NOTHING_BITS,
        "nothing_share": np.float32(2.0**-NOTHING_BITS),
        "something_bits": SOMETHING_BITS,
        "something_share": np.float32(2.0**-SOMETHING_BITS),
        "statistic_count": literal(np.float32(2.0**-STATISTIC_BITS if n.is_fixed else 1.0)),
        "largest": LARGEST,
        "slack": 0 if n.is_fixed else "1e-3f",
        "dead_after": DEAD_AFTER,
        "stuck_after": n.stuck_after,
        "checks": checks(monitor, n),
    }


def literal(value: Any) -> str:
    """Format a number as C source; single precision keeps every bit.

    Raises:
        InputError: it is no number of 32 bits.
    """
    is_whole = isinstance(value, np.integer) or value.dtype == np.int64
    if not np.isfinite(value) or (is_whole and abs(int(value)) >= 2**31):
        raise InputError(
            f"motor, voltage, noise and counts give a number that 32 bits do not hold ({value:g});"
            " give other counts, or --arithmetic float"
        )
    return f"{int(value)}" if is_whole else f"{value!s}f"


def checks(monitor: Monitor, n: Numbers) -> list[Check]:
    """Make samples: a healthy start, a current that alarms, one out of range."""
    model, sensor, voltage_v = (
        monitor.kalman.model,
        monitor.kalman.observation,
        monitor.limits.voltage_v / 2.0,
    )
    read = (model.transition, model.gain[:, :1], sensor @ model.transition, sensor @ model.gain[:, :1])
    _, expected, _ = dlsim((*read, model.dt_s), np.full(_HEALTHY_CHECKS + _FAULTY_CHECKS, voltage_v))
    noise = np.sqrt(np.diag(monitor.kalman.measurement_covariance))[:, None]
    for offset in np.ldexp(4.0, range(_MOST_DOUBLINGS)):
        measured = expected.T + noise * np.where(np.arange(len(expected)) % 2, -0.5, 0.5)
        measured[0, _HEALTHY_CHECKS:] += offset * noise[0]
        measured[0, -1] = 4.0 * monitor.limits.current_a
        readings = readings_of(n, measured[None], voltage_v)
        (verdicts,), (statistics,) = run_twin(n, readings)
        if SampleVerdict.FAULT in verdicts or offset > monitor.limits.current_a / noise[0]:
            break
    samples = zip(readings[0].T, statistics, verdicts.tolist(), strict=True)
    return [Check(reading, statistic, SampleVerdict(verdict).name) for reading, statistic, verdict in samples]
