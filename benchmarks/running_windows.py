"""Verdicts on simulated motors at work: commissioned by windows in one profile, judged in the same.

    python benchmarks/running_windows.py --motors 40     # four minutes of one core
    python benchmarks/running_windows.py --motors 30 --other-physics
    python benchmarks/running_windows.py --motors 30 --other-physics --every-drive
    python benchmarks/running_windows.py --motors 12 --other-physics --one-way

Four tables of docs/results/motors-at-work.md. Random motors and profiles from the
independent simulator in operation_simulator.py, with speed and without a load. Each is commissioned by 10 windows of 40
mechanical time constants, and judged by records of 3, at one false alarm in 100. With other physics the motors have all
of its SWITCHES, and are judged in other profiles, under other controllers, too, severe faults in the own one alone.
With --every-drive motors are commissioned by one record of 2 windows under each. With --one-way they never turn back,
and are commissioned and judged with each of LOADED.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from cyclopts import run
from operation_simulator import PROFILES, SWITCHES, Motor, draw_motor, simulate
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows

WINDOW, LEARNED, JUDGED, RATE = 400, 10, 3, 0.01
DT = 0.1  # of the mechanical time constant
WARM_K = 20.0
UNDER: dict[str, dict[str, Any]] = {
    "the same": {},
    "speed loop": {"profile": "speed loop"},
    "soft speed loop": {"profile": "speed loop", "stiffness": 0.3},
    "current loop": {"profile": "current loop"},
    "steps": {"profile": "steps"},
}
"""Drives in which motors of other physics are judged."""
OWN: dict[str, dict[str, Any]] = {"the same": {}}
LOADED = ("none", "dry", "constant", "square", "walk")
LOAD = 0.05  # of the stall torque; of one that walks, the standard deviation after a window
SEVERE = ("R × 2", "friction × 2", "friction × 4", "K −30 %", "J × 2")


def changed(motor: Motor) -> dict[str, tuple[Motor, str]]:
    """Motors to judge by what has changed, with the right verdict."""

    def friction(times: float) -> tuple[Motor, str]:
        return replace(motor, viscous=times * motor.viscous, coulomb=times * motor.coulomb), "bearing"

    return {
        "nothing changed": (motor, "healthy"),
        f"{WARM_K:.0f} K more": (motor, "healthy"),
        "R +25 %": (replace(motor, ohm=1.25 * motor.ohm), "winding"),
        "friction +50 %": friction(1.5),
        "K −10 %": (replace(motor, constant=0.9 * motor.constant), "magnet"),
        "J +25 %": (replace(motor, inertia=1.25 * motor.inertia), "other"),
        "R × 2": (replace(motor, ohm=2.0 * motor.ohm), "winding"),
        "friction × 2": friction(2.0),
        "friction × 4": friction(4.0),
        "K −30 %": (replace(motor, constant=0.7 * motor.constant), "magnet"),
        "J × 2": (replace(motor, inertia=2.0 * motor.inertia), "other"),
    }


def judge(number: int, seed: int, *, other_physics: bool, every_drive: bool) -> Said:
    """Verdicts on one motor, commissioned in one profile, or under each drive."""
    rng = np.random.default_rng([seed, number])
    motor = draw_motor(rng, SWITCHES if other_physics else ())
    learned, dt_s = PROFILES[number % len(PROFILES)], DT * motor.mechanical_s
    recorded = partial(simulate, rng=rng, dt_s=dt_s, usual=motor)
    drives = (UNDER if every_drive else OWN).values()
    try:
        logs = [
            recorded(motor, samples=LEARNED // len(drives) * WINDOW, **({"profile": learned} | drive))
            for drive in drives
        ]
        healthy, _ = learn_windows(logs, WINDOW * dt_s)
    except UnusableError as error:
        return [(("commissioning", learned), str(error))]
    known, said = motor_of_windows(healthy, "this motor"), Said()
    for name, (other, _) in changed(motor).items():
        for under, options in (OWN if not other_physics or name in SEVERE else UNDER).items():
            warm_k = WARM_K if "K more" in name else 0.0
            drive = {"profile": learned} | options
            log = recorded(other, samples=JUDGED * WINDOW, warm_k=warm_k, **drive)
            found = diagnose(log, known, false_alarm_rate=RATE, regime="operation")
            said.append(((name, under, learned), found.verdict))
    return said


def judge_one_way(number: int, seed: int, *, other_physics: bool) -> Said:
    """Verdicts on one motor that never turns back, with each load."""
    rng = np.random.default_rng([seed, number])
    motor = draw_motor(rng, SWITCHES if other_physics else ())
    dt_s, said = DT * motor.mechanical_s, Said()

    def log(worn: Motor, load: str, windows: int, warm_k: float = 0.0) -> Recording:
        torque = LOAD * motor.constant * motor.stall_a * (math.sqrt(windows) if load == "walk" else 1.0)
        known: dict[str, Any] = {"usual": motor, "dt_s": dt_s, "load": load, "torque_n_m": torque}
        return simulate(worn, "one way", rng, samples=windows * WINDOW, warm_k=warm_k, **known)

    for load in LOADED:
        try:
            healthy, _ = learn_windows([log(motor, load, LEARNED // 2) for _ in range(2)], WINDOW * dt_s)
        except UnusableError as error:
            said.append((("commissioning", load), str(error)))
            continue
        known = motor_of_windows(healthy, "this motor")
        for name, (worn, _) in changed(motor).items():
            record = log(worn, load, JUDGED, WARM_K if "K more" in name else 0.0)
            found = diagnose(record, known, false_alarm_rate=RATE, regime="operation")
            said.append(((name, load, load), found.verdict))
    return said


def cell(said: Counter[str], right: str) -> str:
    """How many were judged right, and what else was said."""
    others = [f"`{verdict}` {n}" for verdict, n in said.most_common() if verdict != right]
    return ", ".join([str(said[right]), *others]) if said else ""


def rows(counts: Counts, unders: tuple[str, ...]) -> Iterator[list[str]]:
    """A row for each change: the right verdict, and what was said in each drive or with each load."""
    for name, (_, right) in changed(draw_motor(np.random.default_rng(0))).items():
        yield [name, f"`{right}`", *(cell(counts[(name, under)], right) for under in unders)]


def main(
    *,
    motors: int = 20,
    seed: int = 1,
    other_physics: bool = False,
    every_drive: bool = False,
    one_way: bool = False,
    how: How = HERE,
) -> None:
    """Judge motors and keep the table of docs/results/motors-at-work.md.

    Args:
        motors: how many, of all profiles in turn.
        seed: of them.
        other_physics: motors with all switches, also judged under other drives than they were commissioned in.
        every_drive: commissioned by a record under each drive, not in one profile.
        one_way: never turning back, with each of several loads.
        how: options of every table.
    """
    if one_way and every_drive:
        raise SystemExit("--one-way does not go with --every-drive")
    asked = {"other_physics": other_physics, "every_drive": every_drive, "one_way": one_way}
    chosen = [name for name, is_on in asked.items() if is_on]
    judged = (
        partial(judge_one_way, seed=seed, other_physics=other_physics)
        if one_way
        else partial(judge, seed=seed, other_physics=other_physics, every_drive=every_drive)
    )
    counts = counted(judged, motors, how, of={"seed": seed, **dict.fromkeys(chosen, True)})
    print(*counts[("commissioning",)].elements(), sep="\n")
    unders = LOADED if one_way else tuple(UNDER if other_physics else OWN)
    named = [f"load: {under}" if one_way else under for under in unders]
    keep_table(
        "motors-at-work", "_".join(("windows", *chosen)), ("changed", "right", *named), rows(counts, unders)
    )


if __name__ == "__main__":
    run(main)
