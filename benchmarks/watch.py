"""False alarms of `motor-env watch` and of the C code of `export-c` on simulated healthy work.

    python benchmarks/watch.py --hours 500 --seed 1 --out benchmarks/results/watch.json

A run of another seed, with a commissioning of its own, is added to what the file holds.

The textbook motor with a heavy flywheel: random duty cycle, load and temperature, which change slowly. Watched at 1 Hz
by windows of 10 min after a commissioning of 5 h of the same work. What comes is the text that a device would print.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numba import njit
from numpy.typing import NDArray

from motor_env import PAPER_MOTOR, Fault, FaultKind
from motor_env.diagnosis import windows
from motor_env.live.state import State
from motor_env.live.watch import YEAR_S, Lesson, Watch
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.faults import apply_faults
from motor_env.motor.model import discretize
from motor_env.motor.parameters import (
    COPPER_PER_KELVIN,
    FRICTION_PER_KELVIN,
    MAGNET_PER_KELVIN,
    MotorParameters,
)
from motor_env.operation.record import Record

Floats = NDArray[np.float64]
FLYWHEEL = 1000.0  # times the rotor's inertia
VOLTS, NOISE_A, NOISE_RAD_S = 12.0, 0.02, 1.0
LOAD_N_M, LOAD_S = 3e-3, 3600.0  # standard deviation and memory of the load: a tenth of the rated torque
WARM_K, WARM_S = 10.0, 7200.0
WINDOW_S, LEARN_S = 600.0, 5 * 3600.0
FAULTS = (
    (FaultKind.BEARING, 0.25),
    (FaultKind.BEARING, 0.5),
    (FaultKind.BEARING, 1.0),
    (FaultKind.WINDING_CONTACT, 0.1),
    (FaultKind.WINDING_CONTACT, 0.25),
)
RUNS, MOST_WINDOWS = 5, 12
RATES = {"hour": YEAR_S / 3600.0, "day": YEAR_S / 86_400.0}


def heavy(inertia: float = FLYWHEEL) -> MotorParameters:
    """The textbook motor with a flywheel."""
    return replace(PAPER_MOTOR, inertia_kg_m2=inertia * PAPER_MOTOR.inertia_kg_m2)


def warmed(motor: MotorParameters, kelvin: float) -> MotorParameters:
    """The same motor at another temperature."""
    magnets = 1.0 + MAGNET_PER_KELVIN * kelvin
    return replace(
        motor,
        resistance_ohm=motor.resistance_ohm * (1.0 + COPPER_PER_KELVIN * kelvin),
        back_emf_constant_v_s_per_rad=motor.back_emf_constant_v_s_per_rad * magnets,
        torque_constant_n_m_per_a=motor.torque_constant_n_m_per_a * magnets,
        viscous_friction_n_m_s_per_rad=motor.viscous_friction_n_m_s_per_rad
        * (1.0 + FRICTION_PER_KELVIN * kelvin),
    )


@njit(cache=True)
def wandering(shocks: Floats, sd: float, memory: float) -> Floats:
    """An Ornstein-Uhlenbeck process: standard deviation, memory in samples."""
    out, decay = np.empty_like(shocks), math.exp(-1.0 / memory)
    value = sd * shocks[0]
    for k in range(len(shocks)):
        value = decay * value + sd * math.sqrt(1.0 - decay * decay) * shocks[k]
        out[k] = value
    return out


@njit(cache=True)
def moved(transition: Floats, gain: Floats, inputs: Floats, x: Floats) -> Floats:
    """States after each sample; `x` is left as the last of them."""
    out = np.empty((len(inputs), 2))
    for k in range(len(inputs)):
        i = (
            transition[0, 0] * x[0]
            + transition[0, 1] * x[1]
            + gain[0, 0] * inputs[k, 0]
            + gain[0, 1] * inputs[k, 1]
        )
        w = (
            transition[1, 0] * x[0]
            + transition[1, 1] * x[1]
            + gain[1, 0] * inputs[k, 0]
            + gain[1, 1] * inputs[k, 1]
        )
        x[0], x[1] = i, w
        out[k] = x
    return out


def duty(rng: np.random.Generator, samples: int, holds: tuple[int, int], *, least: float = -1.0) -> Floats:
    """A random share of the voltage, least .. 1, held for a random while."""
    lengths = rng.integers(holds[0], holds[1] + 1, samples // holds[0] + 1)
    levels: Floats = np.repeat(VOLTS * rng.uniform(least, 1.0, len(lengths)), lengths)[:samples]
    return levels


def work(rng: np.random.Generator, hours: float, *faults: Fault) -> Iterator[Floats]:
    """Time, voltage, current, speed at 1 Hz, a window at a time; shape (n, 4)."""
    samples, n = int(hours * 3600.0), int(WINDOW_S)
    load = wandering(rng.standard_normal(samples), LOAD_N_M, LOAD_S)
    warm_k = wandering(rng.standard_normal(samples // n), WARM_K, WARM_S / n)
    volts, x = duty(rng, samples, (6, 16)), np.zeros(2)
    for k, kelvin in enumerate(warm_k):
        part = slice(k * n, (k + 1) * n)
        model = discretize(apply_faults(warmed(heavy(), kelvin), faults), 1.0)
        states = moved(model.transition, model.gain, np.stack([volts[part], load[part]], axis=1), x)
        noise = rng.standard_normal((n, 2)) * (NOISE_A, NOISE_RAD_S)
        yield np.column_stack([np.arange(part.start, part.stop) + 1.0, volts[part], states + noise])


def lines(blocks: Iterator[Floats]) -> Iterator[bytes]:
    """What a device prints."""
    yield b"time_s,voltage_v,current_a,speed_rad_s\n"
    for block in blocks:
        for row in block.tolist():
            yield b"%.0f,%.5g,%.5g,%.6g\n" % tuple(row)


def fitted_once(fit: Callable[..., Any]) -> Callable[..., Any]:
    """Lets watches at several rates share the fit of a window."""
    last: dict[bytes, Any] = {}

    def shared(record: Record, *rest: Any) -> Any:
        key = record.readings.tobytes()
        if key not in last:
            last.clear()
            last[key] = fit(record, *rest)
        return last[key]

    return shared


def watched(hours: float, seed: int) -> dict[str, Any]:
    """Events of healthy work by the rate that was asked for, and what it cost."""
    rng = np.random.default_rng([77, seed])
    begin_s = time.process_time()
    stream = lines(work(rng, hours + LEARN_S / 3600.0))
    first = Watch(Lesson(WINDOW_S, LEARN_S), State(), false_alarms_per_year=1.0)
    learned = next(event for event in first.events(stream) if event.kind == "learned")
    learned_s, peak_kb = time.process_time() - begin_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    counts = {name: Counter[str]() for name in RATES}
    state = {name: State(header=first.state.header) for name in RATES}
    each = {
        name: Watch(first.reference, state[name], false_alarms_per_year=a_year)
        for name, a_year in RATES.items()
    }
    # Both rates judge the same windows: the fit, which is the work, is made once for them.
    with mock.patch.object(windows, "_window", fitted_once(windows._window)):  # noqa: SLF001  # see above
        for line in stream:
            for name, watch in each.items():
                counts[name].update(event.name for event in watch.events([line]))
    watching_s = time.process_time() - begin_s - learned_s
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_kb
    judged = sum(n for what, n in counts["day"].items() if what.startswith("window"))
    return {
        "seed": seed,
        "hours": judged * WINDOW_S / 3600.0,
        "learned_at_s": learned.time_s,
        "events": {name: dict(count) for name, count in counts.items()},
        "faults": detected(first.reference, rng),
        "cpu_s": {"learning": learned_s, "watching": watching_s},
        "memory_grew_kb": grown_kb,
    }


def detected(reference: WindowReference | Lesson, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Windows until the first alarm after a fault, at one false alarm an hour, under varying load and temperature."""
    rows = []
    for kind, severity in FAULTS:
        firsts: list[tuple[int, str]] = []
        for _ in range(RUNS):
            watch = Watch(reference, State(), false_alarms_per_year=RATES["hour"])
            stream = watch.events(lines(work(rng, MOST_WINDOWS / 6.0, Fault(kind, severity))))
            numbered = ((n, event.text) for n, event in enumerate(stream, 1) if event.text != "healthy")
            firsts.append(next(numbered, (MOST_WINDOWS, "none")))
        counts, names = zip(*firsts, strict=True)
        rows.append(
            {"fault": str(kind), "severity": severity, "windows": counts, "named": dict(Counter(names))}
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Write what a run found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    found = watched(options.hours, options.seed)
    print(json.dumps(found))
    if options.out is not None:
        others = json.loads(options.out.read_bytes()) if options.out.exists() else []
        runs = [*(run for run in others if run["seed"] != options.seed), found]
        options.out.write_text(json.dumps(runs, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
