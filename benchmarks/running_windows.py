"""Verdicts on simulated motors at work: commissioned by windows in one profile, judged in the same.

    python benchmarks/running_windows.py --motors 40
    python benchmarks/running_windows.py --motors 30 --other-physics
    python benchmarks/running_windows.py --motors 30 --other-physics --window-s 20
    python benchmarks/running_windows.py --motors 30 --other-physics --every-drive
    python benchmarks/running_windows.py --motors 20 --other-physics --every-drive --window-s 20
    python benchmarks/running_windows.py --motors 12 --other-physics --one-way

Random motors and profiles from the independent simulator in operation_simulator.py, with speed and without a load. Each
is commissioned by 10 windows of 40 mechanical time constants, and judged by records of 3, at one false alarm in 100.
With other physics the motors have all of its SWITCHES, and are judged in other profiles, under other controllers, too.
Windows of a length in seconds are sampled at 100 Hz. Their faults, and severe ones, are judged in the own one alone.
With --every-drive motors are commissioned by one record of 2 windows under each, and all but severe faults are judged
under each. With --one-way they never turn back, and are commissioned and judged with each of LOADED.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
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
SLOW_S = 0.01
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


def judge(number: int, seed: int, *, other_physics: bool, window_s: float | None, every_drive: bool) -> Said:
    """Verdicts on one motor, commissioned in one profile, or under each drive."""
    rng = np.random.default_rng([seed, number])
    motor = draw_motor(rng, SWITCHES if other_physics else ())
    learned = PROFILES[number % len(PROFILES)]
    dt_s = DT * motor.mechanical_s if window_s is None else SLOW_S
    window = WINDOW if window_s is None else round(window_s / SLOW_S)
    recorded = partial(simulate, rng=rng, dt_s=dt_s, usual=motor)
    drives = (UNDER if every_drive else OWN).values()
    try:
        logs = [
            recorded(motor, samples=LEARNED // len(drives) * window, **({"profile": learned} | drive))
            for drive in drives
        ]
        healthy, _ = learn_windows(logs, window * dt_s)
    except UnusableError as error:
        return [(("commissioning", learned), str(error))]
    known, said = motor_of_windows(healthy, "this motor"), Said()
    for name, (other, right) in changed(motor).items():
        is_everywhere = right == "healthy" or every_drive or window_s is None
        is_own = not other_physics or name in SEVERE or not is_everywhere
        for under, options in OWN.items() if is_own else UNDER.items():
            warm_k = WARM_K if "K more" in name else 0.0
            drive = {"profile": learned} | options
            log = recorded(other, samples=JUDGED * window, warm_k=warm_k, **drive)
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


def rows(counts: Counts, unders: Iterable[str]) -> Iterator[list[str]]:
    """What was judged right, and what else was said."""
    for name, (_, right) in changed(draw_motor(np.random.default_rng(0))).items():
        for under in unders:
            if not (said := counts[(name, under)]):
                continue
            others = ", ".join(f"`{verdict}` {n}" for verdict, n in said.most_common() if verdict != right)
            yield [name, under, f"`{right}`", f"{said[right]} of {said.total()}", others or "-"]


def main(
    *,
    motors: int = 20,
    seed: int = 1,
    other_physics: bool = False,
    window_s: float | None = None,
    every_drive: bool = False,
    one_way: bool = False,
    how: How = HERE,
) -> None:
    """Judge motors and keep the table of docs/results/operation.md.

    Args:
        motors: how many, of all profiles in turn.
        seed: of them.
        other_physics: motors with all switches, also judged under other drives than they were commissioned in.
        window_s: length of a window; by default 40 mechanical time constants.
        every_drive: commissioned by a record under each drive, not in one profile.
        one_way: never turning back, with each of several loads.
        how: options of every table.
    """
    of: dict[str, Any] = {"seed": seed} | ({"other_physics": True} if other_physics else {})
    if window_s is not None:
        of["window_s"] = window_s
    if every_drive:
        of["every_drive"] = True
    if one_way:
        if every_drive or window_s is not None:
            raise SystemExit("--one-way goes with neither --every-drive nor --window-s")
        of["one_way"] = True
        judged = partial(judge_one_way, seed=seed, other_physics=other_physics)
    else:
        judged = partial(
            judge, seed=seed, other_physics=other_physics, window_s=window_s, every_drive=every_drive
        )
    counts = counted(judged, motors, how, of=of)
    print(*counts[("commissioning",)].elements(), sep="\n")
    header = ("changed", "load" if one_way else "judged in", "right verdict", "said", "else")
    name = "windows_other_physics" if other_physics else "windows"
    name += "_one_way" if one_way else ("" if window_s is None else "_longer")
    name += "_every_drive" if every_drive else ""
    keep_table(
        "operation", name, header, rows(counts, LOADED if one_way else UNDER if other_physics else OWN)
    )


if __name__ == "__main__":
    run(main)
