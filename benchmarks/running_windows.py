"""Verdicts on simulated motors at work: commissioned by windows in one profile, judged in the same.

    python benchmarks/running_windows.py --motors 60
    python benchmarks/running_windows.py --motors 40 --other-physics

Random motors and profiles from the independent simulator in operation_simulator.py, with speed and without a load. Each
is commissioned by 10 windows of 40 mechanical time constants, and judged by records of 3, at one false alarm in 100.
With other physics the motors have all of its SWITCHES, are commissioned in a speed loop, and are judged in it, in one of
other gains, in a current loop, and in steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from cyclopts import run
from operation_simulator import PROFILES, SWITCHES, Motor, draw_motor, simulate
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.motor_files import motor_of_windows
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.recordings.defects import UnusableError

WINDOW, LEARNED, JUDGED, RATE = 400, 10, 3, 0.01
DT = 0.1  # of the mechanical time constant
WARM_K = 20.0


def changed(motor: Motor) -> dict[str, tuple[Motor, str]]:
    """Motors to judge by what has changed, with the right verdict."""
    return {
        "nothing changed": (motor, "healthy"),
        f"{WARM_K:.0f} K more": (motor, "healthy"),
        "R +25 %": (replace(motor, ohm=1.25 * motor.ohm), "winding"),
        "friction +50 %": (
            replace(motor, viscous=1.5 * motor.viscous, coulomb=1.5 * motor.coulomb),
            "bearing",
        ),
        "K −10 %": (replace(motor, constant=0.9 * motor.constant), "magnet"),
        "J +25 %": (replace(motor, inertia=1.25 * motor.inertia), "other"),
    }


def judge(number: int, seed: int) -> Said:
    """Verdicts on one motor in one profile."""
    rng = np.random.default_rng([seed, number])
    motor, profile = draw_motor(rng), PROFILES[number % len(PROFILES)]
    dt_s = DT * motor.mechanical_s
    recorded = partial(simulate, profile=profile, rng=rng, dt_s=dt_s)
    try:
        healthy, _ = learn_windows([recorded(motor, samples=LEARNED * WINDOW)], WINDOW * dt_s)
    except UnusableError as error:
        return [(("commissioning", profile), str(error))]
    known, said = motor_of_windows(healthy, "this motor"), Said()
    for name, (other, _) in changed(motor).items():
        log = recorded(other, samples=JUDGED * WINDOW, warm_k=WARM_K if "K more" in name else 0.0)
        found = diagnose(log, known, false_alarm_rate=RATE, regime="operation")
        said.append(((name, profile), found.verdict))
    return said


def rows(counts: Counts) -> Iterator[list[str]]:
    """What was judged right, and what else was said."""
    for name, (_, right) in changed(draw_motor(np.random.default_rng(0))).items():
        said = counts[(name,)]
        others = ", ".join(f"`{verdict}` {n}" for verdict, n in said.most_common() if verdict != right)
        yield [name, f"`{right}`", f"{said[right]} of {said.total()}", others or "-"]


def main(*, motors: int = 20, seed: int = 1, how: How = HERE) -> None:
    """Judge motors and keep the table of docs/results/operation.md.

    Args:
        motors: how many, of all profiles in turn.
        seed: of them.
        how: options of every table.
    """
    counts = counted(partial(judge, seed=seed), motors, how, of={"seed": seed})
    print(*counts[("commissioning",)].elements(), sep="\n")
    keep_table("operation", "windows", ("changed", "right verdict", "said", "else"), rows(counts))


if __name__ == "__main__":
    run(main)
