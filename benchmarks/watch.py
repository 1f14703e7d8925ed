"""False alarms of `motor-env watch` on simulated healthy work.

    python benchmarks/watch.py --hours 500 --seed 1 --out benchmarks/results/watch.json

A run of another seed or temperature is added to what the file holds.

The textbook motor with a heavy flywheel: random duty cycle, load and temperature. Watched at 1 Hz by windows of 10 min
after a commissioning of 5 h, which comes as the text that a device would print. Each 50 h have a commissioning of their
own, since it decides how often its windows alarm; the joint fit, which gives what all windows share, is that of the
first. `--temperature allowed` is what the monitor assumes: commissioned at one temperature, which then wanders by 15 K.
`wandering` wanders by 10 K, also while it is commissioned. `steady` is a test bench: one temperature, no load.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy.signal import lfilter
from watch_counts import (
    FAULTS,
    LEARN_S,
    RATES,
    WINDOW_S,
    Floats,
    duty,
    events,
    heavy,
    motion,
    options,
    rows_of,
    taught,
    wandering,
    warmed,
    write,
)

from motor_env import Fault
from motor_env.diagnosis.running import lessons, windows
from motor_env.diagnosis.running.looks import Looks
from motor_env.diagnosis.running.windows import WindowJudge, judge_of
from motor_env.diagnosis.verdict import Verdict
from motor_env.fitting.identify import identify_operation
from motor_env.fitting.recorded import from_recordings
from motor_env.fitting.window import fit_window
from motor_env.live.watch import YEAR_S
from motor_env.motor.faults import apply_faults
from motor_env.motor.healthy import Healthy
from motor_env.recordings.recording import Recording

LOAD_N_M, LOAD_S = 3e-3, 3600.0  # standard deviation and memory of the load: a tenth of the rated torque
WARM_K, WARM_S, WINDING_S, STEP_S = 10.0, 7200.0, 1200.0, 10.0
ALLOWED_K = 15.0
LESSON_H = 50.0
RUNS, MOST_WINDOWS = 5, 12
TEMPERATURES = ("wandering", "allowed", "steady")


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


def work(
    rng: np.random.Generator, warm_k: Floats, *faults: Fault, load_n_m: float = LOAD_N_M
) -> Iterator[Floats]:
    """Time, voltage, current, speed at 1 Hz, a window at a time; shape (n, 4)."""
    n, step = int(WINDOW_S), int(STEP_S)
    samples = step * len(warm_k)
    load = wandering(rng.standard_normal(samples), load_n_m, LOAD_S)
    volts, x = duty(rng, samples, (6, 16)), np.zeros(2)
    states = np.empty((samples, 2))
    for k, kelvin in enumerate(warm_k):
        part = slice(k * step, (k + 1) * step)
        motor = apply_faults(warmed(heavy(), kelvin), faults)
        states[part] = motion(motor, 1.0, volts[part], load[part], x)
    yield from rows_of(rng, volts, states).reshape(-1, n, 4)


def shared(fit: Callable[..., Any], key: Callable[..., Any]) -> Callable[..., Any]:
    """A fit that is made once for arguments of one key: the last result is kept."""
    last: dict[Any, Any] = {}

    def once(*given: Any, **options: Any) -> Any:
        if key(*given) not in last:
            last.clear()
            last[key(*given)] = fit(*given, **options)
        return last[key(*given)]

    return once


def recording_of(samples: Floats) -> Recording:
    """A recording from rows of time, voltage, current, speed."""
    time_s, volts, current_a, speed = np.ascontiguousarray(samples.T)
    return Recording(Path("stream"), time_s, current_a, volts, speed)


def alarms(
    judge: WindowJudge, rate: float, samples: Floats, before: Floats, at: Floats
) -> tuple[list[str], Floats]:
    """What `watch` says of a window, and before that of its looks, which are made at once here; where it is."""
    record = from_recordings([recording_of(np.concatenate([before, samples]))])
    record = replace(record, hold=judge.windows.hold)
    looks = Looks(judge, rate / 2.0, at)
    each = looks.every_s
    places = [(n, k) for n in range(1, round(WINDOW_S / each)) for k in looks.due(n)]
    counts = [round(WINDOW_S / 2**k) for _, k in places]
    ends = [len(before) + int(n * each) for n, _ in places]
    parts = [record.part(end - count, count) for end, count in zip(ends, counts, strict=True)]
    judgements = looks.judgements(parts, [k for _, k in places])
    early = next((f"early {one.verdict}" for one in judgements if one is not None), None)
    ((window,), _) = judge.judge(recording_of(samples), rate / 2.0)
    if window.verdict is Verdict.HEALTHY:
        at = np.log([change.ratio for change in window.changes])
    return [f"window {window.verdict}", *([early] if early else [])], at


def watched(hours: float, seed: int, temperature: str) -> dict[str, Any]:
    """Events of healthy work by the rate that was asked for, and what it cost."""
    place = TEMPERATURES.index(temperature)
    rng, steady = np.random.default_rng([77, seed, place]), temperature == "steady"
    begin_s, learning_s, judged = time.process_time(), 0.0, 0
    counts = {name: Counter[str]() for name in RATES}
    lesson = int(LEARN_S / WINDOW_S) + 1
    once = shared(identify_operation, key=lambda _: None)
    # Both rates judge the same windows: the fits and steps, which are the work, are made once for them.
    fits = shared(fit_window, key=lambda record, *_: record.readings.tobytes())
    first_steps = WindowJudge.first_steps
    steps = shared(
        lambda *given: list(first_steps(*given)),
        key=lambda _, parts, at: (len(parts), parts[0].readings.tobytes(), at.tobytes()),
    )
    with (
        mock.patch.object(lessons, "identify_operation", once),
        mock.patch.object(windows, "fit_window", fits),
        mock.patch.object(WindowJudge, "first_steps", steps),
    ):
        for _ in range(round(hours / LESSON_H)):
            lesson_s = time.process_time()
            count = lesson + int(LESSON_H * 3600.0 / WINDOW_S)
            warm_k = temperatures(rng, count, allowed=temperature == "allowed")
            blocks = list(work(rng, warm_k * (not steady), load_n_m=LOAD_N_M * (not steady)))
            healthy = taught(blocks[:lesson], steady=steady)
            judge = judge_of(healthy)
            learning_s += time.process_time() - lesson_s
            at = dict.fromkeys(RATES, np.zeros(4))
            for before, samples in pairwise(blocks[lesson - 1 :]):
                judged += 1
                for name, a_year in RATES.items():
                    rate = a_year * WINDOW_S / YEAR_S
                    half = before[len(before) // 2 :]
                    said, at[name] = alarms(judge, rate, samples, half, at[name])
                    counts[name].update(said)
    return {
        "seed": seed,
        "temperature": temperature,
        "hours": judged * WINDOW_S / 3600.0,
        "events": {name: dict(count) for name, count in counts.items()},
        "cpu_s": {"learning": learning_s, "watching": time.process_time() - begin_s - learning_s},
        "faults": detected(healthy, rng) if temperature == "wandering" else [],
    }


def detected(healthy: Healthy, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Windows until the first alarm after a fault, at one false alarm an hour, under varying load and temperature."""
    rows = []
    for kind, severity in FAULTS:
        firsts: list[tuple[int, str]] = []
        for _ in range(RUNS):
            warm_k = temperatures(rng, MOST_WINDOWS, allowed=False)
            stream = enumerate(events(healthy, work(rng, warm_k, Fault(kind, severity))), 1)
            numbered = ((n, event.text) for n, event in stream if event.text != "healthy")
            firsts.append(next(numbered, (MOST_WINDOWS, "none")))
        counts, names = zip(*firsts, strict=True)
        rows.append(
            {"fault": str(kind), "severity": severity, "windows": counts, "named": dict(Counter(names))}
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Write what a run found."""
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=LESSON_H)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--temperature", choices=TEMPERATURES, default="wandering")
    asked = parser.parse_args(arguments)
    found = watched(asked.hours, asked.seed, asked.temperature)
    print(json.dumps(found))
    key, kept = (asked.seed, asked.temperature), asked.out is not None and asked.out.exists()
    others = json.loads(asked.out.read_bytes()) if kept else []
    write([*(run for run in others if (run["seed"], run["temperature"]) != key), found], asked.out)


if __name__ == "__main__":
    main()
