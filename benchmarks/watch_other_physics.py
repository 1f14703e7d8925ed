"""False alarms of `motor-env watch`, and faults that it tells, on motors whose physics the fit does not have.

    python benchmarks/watch_other_physics.py --motors 40 --hours 0.5 --workers 2 --rows out/watch_other_physics.jsonl
    python benchmarks/watch_other_physics.py --motors 10 --otherwise --rows out/watch_otherwise.jsonl
    python benchmarks/watch_other_physics.py --motors 10 --every-drive --rows out/watch_every_drive.jsonl

Motors of operation_simulator.py with all its switches on, each at work under one profile at 100 Hz. Windows of 20 s, a
commissioning of 200 s, one false alarm an hour asked for. A run that was stopped goes on where it was. With --otherwise
each motor is then driven for 100 s in each of running_windows.UNDER, and for 100 s as it was after each of them. With
--every-drive it is commissioned by 40 s under each; then it is driven so, and under each with a fault for 100 s.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from kept_rows import kept_rows
from operation_simulator import PROFILES, SWITCHES, Motor, draw_motor, simulate
from running_windows import UNDER, changed
from scipy.stats import poisson
from tables import keep_table
from watch_counts import ALARM_HEADER, RATES, alarm_row, alarms, due, lines

from motor_env.live.state import State
from motor_env.live.watch import LearningPhase, Watch

WINDOW_S, LEARN_S, DT_S = 20.0, 200.0, 0.01
BLOCK_S, PAUSE_S = 100.0, 1.0
SUPPORT = {"yes": "if the fitted tails hold", "no": "is not supported"}
HEADER = (
    "profile",
    *ALARM_HEADER,
    "on one motor",
    "motors beyond 99 %",
    "unusable windows",
    "rate supported",
)


WORDS = ("healthy", "unusable", "alarms")
FAULTS = ("R +25 %", "friction × 2", "K −10 %")
HEADER_OTHERWISE = ("driven", "hours", "alarms due", *WORDS, "motors that alarm")
HEADER_EVERY_DRIVE = (*HEADER_OTHERWISE, *(f"{fault} is told" for fault in FAULTS))


def one(job: tuple[int, int, float]) -> dict[str, Any]:
    """One motor: alarms behind its commissioning, their names, and what was promised."""
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


def under_drives(job: tuple[int, int, bool]) -> dict[str, Any]:
    """What was said of one motor's windows under several drives; it was commissioned under one, or under each."""
    seed, number, every_drive = job
    rng, profile = np.random.default_rng([seed, number]), PROFILES[number % len(PROFILES)]
    motor, own = draw_motor(rng, SWITCHES), dict[str, Any](profile=profile)
    under = {name: own | options for name, options in UNDER.items()}
    drives: list[tuple[str, float, dict[str, Any], Motor]] = [("", LEARN_S + WINDOW_S, own, motor)]
    if every_drive:
        drives = [("", LEARN_S / len(UNDER) + 0.1, options, motor) for options in under.values()]
    for name, options in under.items():
        drives += [(name, BLOCK_S, options, motor), ("the same", BLOCK_S, own, motor)]
    if every_drive:
        for name, options in under.items():
            for fault in FAULTS:
                worn, _ = changed(motor)[fault]
                drives += [(f"{name}, {fault}", BLOCK_S, options, worn), ("", WINDOW_S + 0.1, own, motor)]
    begins, blocks, end_s = [], list[Any](), 0.0
    for _, length_s, options, it in drives:
        recording = simulate(it, rng=rng, samples=round(length_s / DT_S), dt_s=DT_S, usual=motor, **options)
        begins.append(end_s)
        columns = (recording.time_s + end_s, recording.voltage_v, recording.current_a, recording.speed_rad_s)
        blocks.append(np.column_stack([np.asarray(column) for column in columns]))
        end_s = float(blocks[-1][-1, 0]) + PAUSE_S
    watch = Watch(LearningPhase(WINDOW_S, LEARN_S), State(), false_alarms_per_year=RATES["hour"])
    said = Counter[str]()
    for event in watch.events(lines(blocks, b"%.2f,%.6g,%.6g,%.6g\n")):
        if event.kind in ("window", "another_motor"):
            name = drives[int(np.searchsorted(begins, event.time_s, side="right")) - 1][0]
            word = event.name.removeprefix("window ")
            said[f"{name}, {word if word in ('healthy', 'unusable') else 'alarms'}"] += 1
    return {"number": number, "profile": profile, "said": said}


def rows_by_drive(found: list[dict[str, Any]], faults: Collection[str]) -> Iterator[list[str]]:
    """Rows of the table of motors under several drives."""
    for name in UNDER:
        each = [Counter({word: row["said"].get(f"{name}, {word}", 0) for word in WORDS}) for row in found]
        hours = len(each) * BLOCK_S / 3600.0 * (len(UNDER) + 1 if name == "the same" else 1)
        counts = [str(sum(one[word] for one in each)) for word in WORDS]
        alarmed = sum(one["alarms"] > 0 for one in each)
        told = [
            f"{sum(row['said'].get(f'{name}, {fault}, alarms', 0) > 0 for row in found)} of {len(each)}"
            for fault in faults
        ]
        yield [name, f"{hours:.2g}", f"{hours:.2g}", *counts, f"{alarmed} of {len(each)}", *told]


def rows_by_profile(found: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Rows of the table, and one of all."""
    for profile in (*PROFILES, "all"):
        some = [row for row in found if profile in (row["profile"], "all")]
        if some:
            total = alarm_row(
                profile, "hour", sum(row["hours"] for row in some), sum(row["alarms"] for row in some)
            )
            beyond = sum(row["alarms"] > poisson.ppf(0.99, due("hour", row["hours"])) for row in some)
            by = Counter(row["by"] for row in some)
            unusable = sum(row["names"].get("window unusable", 0) for row in some)
            yield [
                *total,
                f"{max(row['alarms'] for row in some)} at most",
                f"{beyond} of {len(some)}",
                f"{unusable * WINDOW_S / 3600.0 / sum(row['hours'] for row in some):.0%}",
                ", ".join(f"{how} {count}" for how, count in sorted(by.items())),
            ]


def main(
    *,
    motors: int = 40,
    hours: float = 0.5,
    seed: int = 5,
    otherwise: bool = False,
    every_drive: bool = False,
    workers: int = 1,
    rows: Path | None = None,
) -> None:
    """Watch the motors and keep the table.

    Args:
        motors: number.
        hours: that each is watched.
        seed: of the motors.
        otherwise: drive the motors otherwise than when they were commissioned.
        every_drive: commission them under each of these drives.
        workers: processes.
        rows: file of a JSON line a motor; those that it holds are not watched again.
    """
    if otherwise or every_drive:
        them = {number: (seed, number, every_drive) for number in range(motors)}
        said = kept_rows(under_drives, them, lambda row: row["number"], workers, rows)
        header = HEADER_EVERY_DRIVE if every_drive else HEADER_OTHERWISE
        name = "watched_every_drive" if every_drive else "watched_otherwise"
        keep_table("operation", name, header, rows_by_drive(said, FAULTS if every_drive else ()))
        return
    jobs = {number: (seed, number, hours) for number in range(motors)}
    known = kept_rows(one, jobs, lambda row: row["number"], workers, rows)
    keep_table("operation", "watched", HEADER, rows_by_profile(known))


if __name__ == "__main__":
    run(main)
