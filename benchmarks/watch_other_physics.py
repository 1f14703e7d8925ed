"""False alarms of `motor-env watch` on motors whose physics the fit does not have.

    python benchmarks/watch_other_physics.py --motors 40 --hours 0.5 --workers 2 --rows out/watch_other_physics.jsonl

Motors of operation_simulator.py with all its switches on, each at work under one profile at 100 Hz. Windows of 20 s, a
commissioning of 200 s, one false alarm an hour asked for. A run that was stopped goes on where it was.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from operation_simulator import PROFILES, SWITCHES, draw_motor, simulate
from scipy.stats import poisson
from tables import keep_table
from verdict_tables import kept_rows
from watch_counts import ALARM_HEADER, RATES, alarm_row, alarms, due, lines

from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import LearningPhase, Watch

WINDOW_S, LEARN_S, DT_S = 20.0, 200.0, 0.01
SUPPORT = {"yes": "if the fitted tails hold", "no": "is not supported"}
HEADER = (
    *ALARM_HEADER,
    "on one motor",
    "motors beyond 99 %",
    "unusable windows",
    "rate supported",
)


def one(job: tuple[int, int, float]) -> dict[str, Any]:
    """Watch one motor: alarms behind its commissioning, their names, and whether the rate is supported."""
    seed, number, hours = job
    rng, profile = np.random.default_rng([seed, number]), PROFILES[number % len(PROFILES)]
    samples = round((LEARN_S + 2.0 * WINDOW_S + 3600.0 * hours) / DT_S)
    recording = simulate(draw_motor(rng, SWITCHES), profile, rng, samples=samples, dt_s=DT_S)
    columns = (recording.time_s, recording.voltage_v, recording.current_a, recording.speed_rad_s)
    block = np.column_stack([np.asarray(column) for column in columns])
    watch = Watch(LearningPhase(WINDOW_S, LEARN_S), State(), false_alarms_per_year=RATES["hour"])
    said = list(watch.events(lines([block], b"%.2f,%.6g,%.6g,%.6g\n")))
    names = Counter(event.name for event in said if event.kind in ("window", "another_motor"))
    promise = next((event.text for event in said if event.kind == "learned"), "")
    return {
        "number": number,
        "profile": profile,
        "hours": hours,
        "alarms": alarms(said),
        "names": {name: count for name, count in names.items() if name != "window healthy"},
        "by": next((how for how, words in SUPPORT.items() if words in promise), "nothing learned"),
    }


def row(found: list[dict[str, Any]]) -> list[str]:
    """Make the row of all motors."""
    hours = sum(one["hours"] for one in found)
    by = Counter(one["by"] for one in found)
    unusable = sum(one["names"].get("window unusable", 0) for one in found)
    return [
        *alarm_row("all", "hour", hours, sum(one["alarms"] for one in found))[1:],
        f"{max(one['alarms'] for one in found)} at most",
        f"{sum(one['alarms'] > poisson.ppf(0.99, due('hour', one['hours'])) for one in found)} of {len(found)}",
        f"{unusable * WINDOW_S / 3600.0 / hours:.0%}",
        ", ".join(f"{how} {count}" for how, count in sorted(by.items())),
    ]


def main(
    *,
    motors: int = 40,
    hours: float = 0.5,
    seed: int = 5,
    workers: int = 1,
    rows: Path | None = None,
) -> None:
    """Watch the motors and keep the table.

    Args:
        motors: number.
        hours: that each is watched.
        seed: of the motors.
        workers: processes.
        rows: file of a JSON line a motor; those that it holds are not watched again.
    """
    jobs = {number: (seed, number, hours) for number in range(motors)}
    known = kept_rows(one, jobs, lambda row: row["number"], workers, rows)
    keep_table("operation", "watched", HEADER, [row(known)])


if __name__ == "__main__":
    run(main)
