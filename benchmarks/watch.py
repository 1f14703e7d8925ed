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

import argparse
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
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

from motor_env import PAPER_MOTOR, Fault, FaultKind
from motor_env.diagnosis.running import lessons, looks as looking, windows
from motor_env.diagnosis.running.looks import Looks
from motor_env.diagnosis.running.windows import from_healthy, judge_windows
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
from motor_env.operation.identify import identify_operation
from motor_env.operation.record import from_recordings
from motor_env.operation.window import fit_window
from motor_env.recordings.recording import Recording

Floats = NDArray[np.float64]
FLYWHEEL = 1000.0  # times the rotor's inertia
VOLTS, NOISE_A, NOISE_RAD_S = 12.0, 0.02, 1.0
LOAD_N_M, LOAD_S = 3e-3, 3600.0  # standard deviation and memory of the load: a tenth of the rated torque
WARM_K, WARM_S, WINDING_S, STEP_S = 10.0, 7200.0, 1200.0, 10.0
ALLOWED_K = 15.0
WINDOW_S, LEARN_S, LESSON_H = 600.0, 5 * 3600.0, 50.0
FAULTS = (
    (FaultKind.BEARING, 0.25),
    (FaultKind.BEARING, 0.5),
    (FaultKind.BEARING, 1.0),
    (FaultKind.WINDING_CONTACT, 0.1),
    (FaultKind.WINDING_CONTACT, 0.25),
)
RUNS, MOST_WINDOWS = 5, 12
TEMPERATURES = ("wandering", "allowed", "steady")
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


def temperatures(rng: np.random.Generator, windows: int, *, allowed: bool) -> Floats:
    """Of each STEP_S, in kelvin over the usual one: what wanders, followed by a winding."""
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
    inputs, states = np.stack([volts, load], axis=1), np.empty((samples, 2))
    for k, kelvin in enumerate(warm_k):
        part = slice(k * step, (k + 1) * step)
        model = discretize(apply_faults(warmed(heavy(), kelvin), faults), 1.0)
        states[part] = moved(model.transition, model.gain, inputs[part], x)
    shown = states + rng.standard_normal(states.shape) * (NOISE_A, NOISE_RAD_S)
    rows = np.column_stack([np.arange(samples) + 1.0, volts, shown])
    yield from rows.reshape(-1, n, 4)


def lines(blocks: Iterator[Floats]) -> Iterator[bytes]:
    """What a device prints."""
    yield b"time_s,voltage_v,current_a,speed_rad_s\n"
    for block in blocks:
        for row in block.tolist():
            yield b"%.0f,%.5g,%.5g,%.6g\n" % tuple(row)


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
    """Of rows of time, voltage, current, speed."""
    time_s, volts, current_a, speed = np.ascontiguousarray(samples.T)
    return Recording(Path("stream"), time_s, current_a, volts, speed)


def alarms(
    reference: WindowReference, rate: float, samples: Floats, before: Floats, at: Floats
) -> tuple[list[str], Floats]:
    """What `watch` says of a window, and before that of its looks, which are made at once here; where it is."""
    record = replace(from_recordings([recording_of(np.concatenate([before, samples]))]), hold=reference.hold)
    looks = Looks(reference, rate / 2.0, at)
    each = looks.every_s
    places = [(n, k) for n in range(1, round(WINDOW_S / each)) for k in looks.due(n)]
    counts = [round(WINDOW_S / 2**k) for _, k in places]
    ends = [len(before) + int(n * each) for n, _ in places]
    parts = [record.part(end - count, count) for end, count in zip(ends, counts, strict=True)]
    verdicts = looks.verdicts(parts, [k for _, k in places])
    early = next((f"early {verdict}" for verdict, _ in verdicts if verdict != "healthy"), None)
    (window,) = judge_windows(recording_of(samples), reference, rate / 2.0)
    if window.verdict == "healthy":
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
    steps = shared(
        lambda *given: list(from_healthy(*given)),
        key=lambda parts, _, at: (len(parts), parts[0].readings.tobytes(), at.tobytes()),
    )
    with (
        mock.patch.object(lessons, "identify_operation", once),
        mock.patch.object(windows, "fit_window", fits),
        mock.patch.object(looking, "from_healthy", steps),
    ):
        for _ in range(round(hours / LESSON_H)):
            lesson_s = time.process_time()
            count = lesson + int(LESSON_H * 3600.0 / WINDOW_S)
            warm_k = temperatures(rng, count, allowed=temperature == "allowed")
            blocks = list(work(rng, warm_k * (not steady), load_n_m=LOAD_N_M * (not steady)))
            watch = Watch(Lesson(WINDOW_S, LEARN_S, steady=steady), State(), false_alarms_per_year=1.0)
            next(event for event in watch.events(lines(iter(blocks[:lesson]))) if event.kind == "learned")
            if not isinstance(watch.reference, WindowReference):
                raise TypeError("nothing was learned")
            learning_s += time.process_time() - lesson_s
            at = dict.fromkeys(RATES, np.zeros(4))
            for before, samples in pairwise(blocks[lesson - 1 :]):
                judged += 1
                for name, a_year in RATES.items():
                    rate = a_year * WINDOW_S / YEAR_S
                    half = before[len(before) // 2 :]
                    said, at[name] = alarms(watch.reference, rate, samples, half, at[name])
                    counts[name].update(said)
    return {
        "seed": seed,
        "temperature": temperature,
        "hours": judged * WINDOW_S / 3600.0,
        "events": {name: dict(count) for name, count in counts.items()},
        "cpu_s": {"learning": learning_s, "watching": time.process_time() - begin_s - learning_s},
        "faults": detected(watch.reference, rng) if temperature == "wandering" else [],
    }


def detected(reference: WindowReference | Lesson, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Windows until the first alarm after a fault, at one false alarm an hour, under varying load and temperature."""
    rows = []
    for kind, severity in FAULTS:
        firsts: list[tuple[int, str]] = []
        for _ in range(RUNS):
            watch = Watch(reference, State(), false_alarms_per_year=RATES["hour"])
            warm_k = temperatures(rng, MOST_WINDOWS, allowed=False)
            stream = watch.events(lines(work(rng, warm_k, Fault(kind, severity))))
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
    parser.add_argument("--hours", type=float, default=LESSON_H)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--temperature", choices=TEMPERATURES, default="wandering")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    found = watched(options.hours, options.seed, options.temperature)
    print(json.dumps(found))
    if options.out is not None:
        others = json.loads(options.out.read_bytes()) if options.out.exists() else []
        key = (options.seed, options.temperature)
        runs = [*(run for run in others if (run["seed"], run["temperature"]) != key), found]
        options.out.write_text(json.dumps(runs, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
