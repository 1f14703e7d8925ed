"""False alarms of `motor-env watch` on simulated healthy work.

    python benchmarks/watch.py --hours 500 --seed 1 --out benchmarks/results/watch.json

A run of another seed or temperature is added to what the file holds.

The textbook motor with a heavy flywheel: random duty cycle, load and temperature. Watched at 1 Hz by windows of 10 min
after a commissioning of 5 h, which comes as the text that a device would print. Each 50 h have a commissioning of
their own, since it decides how often its windows alarm. `--temperature allowed` is what the monitor assumes:
commissioned at one temperature, which then wanders by 15 K. `wandering` wanders by 10 K, also while it is commissioned.
`steady` is a test bench: one temperature, no load.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from cyclopts import run
from scipy.signal import lfilter
from watch_counts import (
    LEARN_S,
    RATES,
    WINDOW_S,
    Floats,
    alarms,
    duty,
    events,
    heavy,
    motion,
    rows_of,
    taught,
    wandering,
    warmed,
    write,
)

from motor_env.live.state import State
from motor_env.live.watch import Watch

LOAD_N_M, LOAD_S = 3e-3, 3600.0  # standard deviation and memory of the load: a tenth of the rated torque
WARM_K, WARM_S, WINDING_S, STEP_S = 10.0, 7200.0, 1200.0, 10.0
ALLOWED_K = 15.0
LESSON_H = 50.0
Temperature = Literal["wandering", "allowed", "steady"]


def temperatures(rng: np.random.Generator, windows: int, *, allowed: bool) -> Floats:
    """Temperature at each STEP_S, in kelvin over the usual one: what wanders, followed by a winding."""
    steps = round(WINDOW_S / STEP_S)
    wanders = wandering(rng.standard_normal(windows * steps), 1.0, WARM_S / STEP_S)
    follows = STEP_S / WINDING_S
    kelvin: Floats = lfilter([follows], [1.0, follows - 1.0], wanders)
    kelvin *= (ALLOWED_K if allowed else WARM_K) * math.sqrt(1.0 + WINDING_S / WARM_S)
    if allowed:  # from the usual one on, after the lesson
        first = (int(LEARN_S / WINDOW_S) + 1) * steps
        kelvin[:first] = kelvin[first]
        kelvin -= kelvin[first] * np.exp(-np.maximum(np.arange(len(kelvin)) - first, 0) * STEP_S / WARM_S)
    return kelvin


def work(rng: np.random.Generator, warm_k: Floats, *, load_n_m: float = LOAD_N_M) -> Iterator[Floats]:
    """Time, voltage, current, speed at 1 Hz, a window at a time; shape (n, 4)."""
    n, step = int(WINDOW_S), int(STEP_S)
    samples = step * len(warm_k)
    load = wandering(rng.standard_normal(samples), load_n_m, LOAD_S)
    volts, x = duty(rng, samples, (6, 16)), np.zeros(2)
    states = np.empty((samples, 2))
    for k, kelvin in enumerate(warm_k):
        part = slice(k * step, (k + 1) * step)
        states[part] = motion(warmed(heavy(), kelvin), 1.0, volts[part], load[part], x)
    yield from rows_of(rng, volts, states).reshape(-1, n, 4)


def watched(hours: float, seed: int, temperature: Temperature) -> dict[str, Any]:
    """Alarms on healthy work by the rate that was asked for, and what it cost."""
    place = get_args(Temperature).index(temperature)
    rng, steady = np.random.default_rng([77, seed, place]), temperature == "steady"
    begin_s, learning_s, judged, promises = time.process_time(), 0.0, 0, []
    counts = dict.fromkeys(RATES, 0)
    lesson = int(LEARN_S / WINDOW_S) + 1
    for _ in range(math.ceil(hours / LESSON_H)):
        lesson_s, later = time.process_time(), int(min(hours, LESSON_H) * 3600.0 / WINDOW_S)
        warm_k = temperatures(rng, lesson + later, allowed=temperature == "allowed")
        blocks = list(work(rng, warm_k * (not steady), load_n_m=LOAD_N_M * (not steady)))
        healthy = taught(blocks[:lesson], steady=steady)
        learning_s += time.process_time() - lesson_s
        judged += later
        for name in RATES:
            counts[name] += alarms(events(healthy, blocks[lesson:], name))
        promises.append(Watch(healthy, State(), false_alarms_per_year=RATES["hour"]).promise)
    return {
        "seed": seed,
        "temperature": temperature,
        "hours": judged * WINDOW_S / 3600.0,
        "alarms": counts,
        "promises": promises,
        "cpu_s": {"learning": learning_s, "watching": time.process_time() - begin_s - learning_s},
    }


def main(
    *,
    hours: float = LESSON_H,
    seed: int = 1,
    temperature: Temperature = "wandering",
    out: Path | None = None,
) -> None:
    """Write what a run found."""
    found = watched(hours, seed, temperature)
    print(json.dumps(found))
    others = json.loads(out.read_bytes()) if out is not None and out.exists() else []
    key = (seed, temperature)
    write([*(one for one in others if (one["seed"], one["temperature"]) != key), found], out)


if __name__ == "__main__":
    run(main)
