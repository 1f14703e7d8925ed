"""Motors at work: errors against the Cramer-Rao bound and coverage of the intervals, beside least squares.

python benchmarks/operation.py --records 1000 --workers 2 --rows out/operation.jsonl     # 22 minutes of one core

A run that was stopped goes on where it was. Every record has its own motor, profile and load, from the independent
simulator in operation_simulator.py. A quantity counts where the bound says that the record tells it to better than a
half of its value. The ratio is the median of |error| over that of a normal error with the bound's standard deviation.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from operation_simulator import KNEE, LOADS, PROFILES, SLIDING, VOLTAGE_NOISE, Motor, draw_motor, simulate
from tables import keep_table
from verdict_tables import kept_rows

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.model_selection import initial_problems
from motor_env.diagnosis.estimation.operation_fit import OperationFit, identify_operation
from motor_env.diagnosis.estimation.problem import motor_unknowns
from motor_env.diagnosis.estimation.terms import terms
from motor_env.diagnosis.estimation.uncertainty import information_covariance, secants
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.motor.parameters import FloatArray

QUANTITIES = ("R", "L", "K", "J", "B", "coulomb", "brush_drop", "load_constant", "load_square")
HEADER = (
    "quantities",
    "error over the bound",
    "95 % intervals that hold",
    "least squares",
)
TOLD = 0.5
NORMAL_MEDIAN = 0.6745


def truth(motor: Motor, load: str, samples: int, dt_s: float, *, has_speed: bool) -> FloatArray:
    """The simulated motor as the fit's vector of values."""
    k = index
    rated, values = 0.15 * motor.constant * motor.stall_a, np.zeros(k.N_VALUES)
    values[[k.R, k.L, k.K, k.J]] = motor.ohm, motor.henry, motor.constant, motor.inertia
    values[[k.B, k.COULOMB, k.DROP]] = motor.viscous, motor.coulomb, motor.drop
    values[[k.KNEE, k.STRIBECK, k.SLIDING]] = KNEE * motor.stall_a, motor.stribeck, SLIDING * motor.speed
    values[k.LOAD] = rated if load == "constant" else 0.0
    values[k.SQUARE] = rated / motor.speed**2 if load == "square" else 0.0
    values[k.WALK] = rated / math.sqrt(samples * dt_s) if load == "walk" else 0.0
    values[k.NOISE_I] = math.hypot(motor.noise_a, 2.0 * 2.1 * motor.stall_a / 4096 / math.sqrt(12.0))
    values[k.NOISE_V] = math.hypot(VOLTAGE_NOISE, 2.0 * 1.2 / 4096 / math.sqrt(12.0)) * motor.volts
    values[k.NOISE_W] = math.hypot(motor.noise_w, 2.0 * 1.2 * motor.speed / 4096 / math.sqrt(12.0))
    if not has_speed:
        c = motor.constant
        values[[k.K, k.J, k.B, k.COULOMB, k.LOAD, k.SQUARE, k.WALK]] /= [c, c**2, c**2, c, c, c**3, c]
        values[k.SLIDING] *= c
    return values


def bound(found: OperationFit, true: FloatArray) -> dict[str, tuple[float, float]]:
    """True unknown and its Cramer-Rao standard deviation, in the fit's units, for the fit's unknowns."""
    problem = found.solution.problem
    every = terms(found.record, problem.known)
    free = [term for term in problem.free if term.name != "load_walk"]
    free += [
        every[name]
        for name in ("load_constant", "load_square", "load_walk")
        if true[every[name].place] > 0.0 and every[name] not in free
    ]
    same = replace(problem, record=replace(problem.record, hold="held"), known=true, free=tuple(free))
    at = np.array(
        [
            math.log(max(true[t.place], 1e-9 * t.unit) / t.unit) if t.is_log else true[t.place] / t.unit
            for t in free
        ]
    )
    spread = np.sqrt(np.diag(information_covariance(same, at, secants(same, at))))
    return {free[n].name: (at[n], float(spread[row])) for row, n in enumerate(motor_unknowns(same))}


def one(job: tuple[int, int]) -> dict[str, Any]:
    """One record: errors over the bound, and whether the intervals hold the truth."""
    seed, number = job
    rng = np.random.default_rng([seed, number])
    motor, profile = draw_motor(rng), PROFILES[number % len(PROFILES)]
    load, has_speed = str(rng.choice(LOADS)), bool(rng.random() < 0.6)
    recording = simulate(motor, profile, rng, load=load, samples=2000)
    if not has_speed:
        recording = replace(recording, speed_rad_s=None)
    row: dict[str, Any] = {"number": number, "profile": profile, "load": load, "speed": has_speed}
    try:
        found = identify_operation([recording])
    except UnusableError as error:
        return row | {"error": str(error)}
    true = truth(motor, load, 2000, recording.dt_s, has_speed=has_speed)
    problem, theta = found.solution.problem, found.solution.theta
    spread = np.sqrt(np.diag(found.covariance))
    rows = {problem.names[n]: (theta[n], spread[r]) for r, n in enumerate(motor_unknowns(problem))}
    regressed, begin = initial_problems(found.record)[0]
    least = regressed.values(begin)
    for name, (at, sd) in bound(found, true).items():
        if name not in QUANTITIES or name not in rows:
            continue
        term = next(t for t in problem.free if t.name == name)
        told = sd < TOLD if term.is_log else sd < TOLD * abs(at)
        estimate, own = rows[name]
        row[name] = {
            "told": bool(told),
            "error": float(abs(estimate - at) / sd),
            "held": bool(abs(estimate - at) <= 1.96 * own),
        }
        value, place = float(least[term.place]), float(true[term.place])
        if value and place > 0.0:
            unit = math.log(value / place) if term.is_log else (value - place) / term.unit
            row[name]["ls"] = float(abs(unit) / sd)
    return row


def cells_by(rows: list[dict[str, Any]], key: str) -> Iterator[list[str]]:
    """Medians and coverage by a key, and over all; rows of a table."""
    groups: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        for name in QUANTITIES:
            if name in row and row[name]["told"]:
                groups[name if key == "quantity" else row[key]].append(row[name])
    order = {"profile": PROFILES, "quantity": QUANTITIES}[key]
    named = [(name, groups[name]) for name in order if name in groups]
    for name, cells in [*named, ("all", [cell for _, group in named for cell in group])]:
        ratios = ([cell[m] for cell in cells if m in cell] for m in ("error", "ls"))
        medians = [f"{np.median(one) / NORMAL_MEDIAN:.2f}" if one else "-" for one in ratios]
        held = np.mean([cell["held"] for cell in cells])
        yield [name, str(len(cells)), medians[0], f"{held:.1%}", *medians[1:]]


def main(*, records: int = 100, seed: int = 0, workers: int = 1, rows: Path | None = None) -> None:
    """Fit the records and keep the tables of docs/results/motors-at-work.md.

    Args:
        records: number of random motors.
        seed: of them.
        workers: processes.
        rows: file of a JSON line a record; those that it holds are not fitted again.
    """
    jobs = {number: (seed, number) for number in range(records)}
    known = kept_rows(one, jobs, lambda row: row["number"], workers, rows)
    failed = [row for row in known if "error" in row]
    print(f"\n{len(known)} records, {len(failed)} not fitted", *failed, sep="\n  ")
    for key in ("profile", "quantity"):
        keep_table("motors-at-work", key, [key, *HEADER], cells_by(known, key))


if __name__ == "__main__":
    run(main)
