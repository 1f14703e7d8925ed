"""Does each term of a fit earn its place? What it gains, and how the motor moves where it is left out.

MOTOR_ENV_RECORDINGS=... python benchmarks/terms.py --rows out/terms.jsonl     # 6 minutes of one core

Each log and start is fitted with all terms, and again without each term that was chosen. Twins are simulated with a
known motor: brushes that take 0, 0.5, 1 or 1.5 V, cogging, Stribeck friction, and a supply that sags within a sample.
"""

import math
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from operation_simulator import PROFILES, Further, Motor, draw_motor, simulate
from tables import keep_table
from verdict_tables import kept_rows

from motor_env.diagnosis.estimation.operation_fit import OperationFit, identify_record
from motor_env.diagnosis.estimation.preprocessing import at_terminals, from_recordings
from motor_env.diagnosis.estimation.starts.start_identification import EXTENSIONS, identify_best
from motor_env.diagnosis.identification import identify
from motor_env.diagnosis.readers.recording import Recording, UnusableError, read_recording

DROPS_V = (0.0, 0.5, 1.0, 1.5)
LOGS = (
    "bench_measured/axem_alone", "bench_measured/axem_gear", "aalborg/square_growing", "lieskjur/startup_120v",
    "regbot/regbot_05_left", "regbot/regbot_25_left",
)  # fmt: skip
STARTS = (
    "production_line/ok_01",
    "production_line/ng_01",
    "oscillo_lab/startup_F0000",
    "aalborg/startup_12v",
)
ALWAYS = ("J", "R", "L", "K", "B", "noise_current", "noise_speed", "noise_voltage")
QUANTITIES = {"R": "R", "K": "K", "J": "J", "drag": "friction"}
HEADER = (
    "term", "logs", "its gain", "R, K, J, friction without it", "twins", "its gain",
    "error of R, K, J, friction with it", "without it", "starts", "its gain",
)  # fmt: skip


def twin(seed: int, number: int, drop_v: float, samples: int = 2000) -> tuple[Motor, Recording]:
    """Simulated motor whose brushes take a known voltage, and a log of it."""
    rng = np.random.default_rng([seed, number])
    motor, cogging = draw_motor(rng), rng.uniform(0.005, 0.02)
    motor = replace(motor, drop=drop_v, stribeck=rng.uniform(0.1, 0.3), further=Further(cogging=cogging))
    profile = PROFILES[number % len(PROFILES)]
    return motor, simulate(motor, profile, rng, samples=samples, supply_ohm=0.1 * motor.ohm)


def truth(motor: Motor, found: OperationFit) -> dict[str, float]:
    """Logarithms of the true quantities, friction at the effective speed of a fit."""
    speed = float(np.sqrt(np.mean(np.square(found.solution.free[0][:, 3]))))
    drag = motor.viscous * speed + motor.coulomb
    true = {"R": motor.ohm, "K": motor.constant, "J": motor.inertia, "drag": drag}
    return {name: math.log(value) for name, value in true.items()}


def log_estimates(found: OperationFit) -> dict[str, list[float]]:
    """Logarithms of value and interval of each quantity that a fit determines."""
    return {
        one.name.split("/")[0]: [math.log(max(x, 1e-300)) for x in (one.value, one.low, one.high)]
        for one in found.quantities
        if one.is_determined and one.name.split("/")[0] in QUANTITIES
    }


def unexplained(found: OperationFit) -> list[float]:
    """Share of each channel's variance that the free run leaves."""
    return [1.0 - r2 for r2 in (found.r2_current, found.r2_speed) if r2 is not None]


def gain(without: Sequence[float], having: Sequence[float]) -> float:
    """By how many percent more is left without a term, in the geometric mean of the channels."""
    return 100.0 * math.expm1(float(np.mean(np.log(without)) - np.mean(np.log(having))))


def fit_with_and_without(job: tuple[str, Any]) -> dict[str, Any]:
    """What is chosen in a record, and the fits without each of it."""
    kind, of = job
    row: dict[str, Any] = {"kind": kind, "case": str(of), "without": {}}
    try:
        if kind == "starts":
            ((_, fit),) = identify(of).starts
            for name in fit.model:
                left = tuple(other for other in EXTENSIONS if other != name)
                row["without"][name] = {"gain": gain(identify_best(fit.start, left).misfit, fit.misfit)}
            return row
        motor, log = twin(*of) if kind == "twins" else (None, at_terminals(read_recording(of)))
        record = from_recordings([log])
        found = identify_record(record)
        row |= {"told": log_estimates(found), "true": {} if motor is None else truth(motor, found)}
        for name in (name for name in found.solution.names if name not in ALWAYS):
            try:
                less = identify_record(record, (name,))
            except UnusableError as error:
                row["without"][name] = {"error": str(error)}
                continue
            row["without"][name] = {
                "gain": gain(unexplained(less), unexplained(found)),
                "told": log_estimates(less),
            }
    except UnusableError as error:
        row["error"] = str(error)
    return row


def jobs(seed: int, twins: int) -> Iterator[tuple[str, Any]]:
    """Recordings at hand, and twins."""
    folder = os.environ.get("MOTOR_ENV_RECORDINGS")
    if folder is None:
        print("no recordings: MOTOR_ENV_RECORDINGS does not name their folder", file=sys.stderr)
    else:
        for kind, names in (("logs", LOGS), ("starts", STARTS)):
            yield from ((kind, Path(folder) / f"{name}.csv") for name in names)
    for number in range(twins):
        yield "twins", (seed, number, DROPS_V[number % len(DROPS_V)])


def _median(values: list[float], unit: str = "") -> str:
    return f"{np.median(values):.2g}{unit}" if values else "-"


def _errors(rows: list[dict[str, Any]], name: str, *, without: bool) -> str:
    """Median distance from the truth of twins, or of logs from the fit with the term, of each quantity."""
    cells = []
    for quantity in QUANTITIES:
        off = []
        for row in rows:
            fit = row["without"][name].get("told", {}) if without else row["told"]
            true = row["true"].get(quantity, row["told"].get(quantity, [math.nan])[0])
            if quantity in fit and quantity in row["told"]:
                off.append(100.0 * abs(math.expm1(fit[quantity][0] - true)))
        cells.append(_median(off))
    return ", ".join(cells) + " %"


def cells(rows: list[dict[str, Any]], name: str) -> list[str]:
    """Row of the table of one term."""
    out = [name]
    for kind in ("logs", "twins", "starts"):
        every = [row for row in rows if row["kind"] == kind and "error" not in row]
        having = [row for row in every if name in row["without"]]
        gains = [row["without"][name]["gain"] for row in having if "gain" in row["without"][name]]
        out += [f"{len(having)} of {len(every)}", _median(gains, " %")]
        if kind == "logs":
            out.append(_errors(having, name, without=True) if having else "-")
        if kind == "twins":
            out += [_errors(having, name, without=without) if having else "-" for without in (False, True)]
    return out


def held(rows: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Share of the intervals of twins that hold, by the voltage that their brushes take."""
    twins = [row for row in rows if row["kind"] == "twins" and "error" not in row]
    for drop in DROPS_V:
        some = [row for row in twins if row["case"].endswith(f", {drop})")]
        shares = []
        for name in QUANTITIES:
            known = [(row["told"][name], row["true"][name]) for row in some if name in row["told"]]
            shares.append(f"{sum(low <= true <= high for (_, low, high), true in known)} of {len(known)}")
        yield [f"{drop:g} V", str(len(some)), *shares]


def main(*, twins: int = 8, seed: int = 78, workers: int = 1, rows: Path | None = None) -> None:
    """Fit all with and without each term, and keep the tables of docs/results/motors-at-work.md.

    Args:
        twins: number of simulated logs.
        seed: of them.
        workers: processes.
        rows: file of a JSON line a record; those that it holds are not fitted again.
    """
    every = {(kind, str(of)): (kind, of) for kind, of in jobs(seed, twins)}
    known = kept_rows(fit_with_and_without, every, lambda row: (row["kind"], row["case"]), workers, rows)
    failed = [(row["case"], row["error"]) for row in known if "error" in row]
    print(f"\n{len(known)} records, {len(failed)} not fitted", *failed, sep="\n  ")
    counts: defaultdict[str, int] = defaultdict(int)
    for row in known:
        for name in row["without"]:
            counts[name] += 1
    ordered = sorted(counts, key=lambda name: (-counts[name], name))
    keep_table("motors-at-work", "terms", HEADER, (cells(known, name) for name in ordered))
    keep_table("motors-at-work", "drops", ["brushes take", "twins", *QUANTITIES.values()], held(known))


if __name__ == "__main__":
    run(main)
