"""Do two records of one motor agree? Differences of what `identify` tells of each, over its 95 % intervals.

MOTOR_ENV_RECORDINGS=... python benchmarks/repeatability.py --workers 2

Real motors that were recorded several times, and motors of a simulator whose physics the fit does not have. A row of
the table is a set of motors. The width is the median half of an interval of the difference, and the scatter the robust
standard deviation of the differences times 1.96: intervals of the right size have the ratio 1 where the differences are
normal. Where a few records are far worse than the others, that scatter is the others'. So the table also says by what
all intervals could be multiplied for 95 % to hold.
"""

import math
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from operation_simulator import PROFILES, SWITCHES, draw_motor, simulate
from tables import keep_table
from verdict_tables import kept_rows

from motor_env.common.errors import InputError
from motor_env.diagnosis.identification import identify
from motor_env.diagnosis.readers.recording import Recording

QUANTITIES = ("R", "L", "K", "J", "drag")
HEADER = ("records", "pairs", "quantities", "hold", "95 % hold at", "beyond 4 sd", "width over scatter")
NAMES = {
    "R/V": "R", "L/V": "L", "K/V": "K", "J V": "J", "J/K^2": "J", "K^2/J": "J", "K^2/(J V)": "J",
}  # fmt: skip
"""Quantities of which the level is the motor's alone, whatever they are told over."""
_TWO_SIDED, _FAR = 1.96, 4.0
_TOLD = math.exp(2.0 * _TWO_SIDED * 0.5)
"""High over low end of an interval whose quantity is told: a standard deviation of one half in the logarithm."""
_ROBUST = 1.4826
"""Median of absolute values to standard deviation."""


def real() -> Iterator[tuple[str, str, Path]]:
    """Set, motor and file of each real record that has a repeat of the same motor, rotor and sensors."""
    folder = Path(os.environ["MOTOR_ENV_RECORDINGS"])
    for path in sorted((folder / "production_line").glob("*.csv")):
        yield "production_line", path.stem[:2], path
    for path in sorted((folder / "jhg").glob("*.csv")):
        yield "jhg", "jhg", path
    found = defaultdict(list)
    for path in sorted((folder / "regbot").glob("*.csv")):
        parts = path.stem.split("_")
        found[f"{parts[1]}_{parts[-1]}"].append(path)
    for motor, paths in found.items():
        yield from (("regbot", motor, path) for path in paths if len(paths) > 1)


def simulated(seed: int, number: int, profile: str) -> Recording:
    """One record of one motor of the further simulator; every profile is one of its records."""
    motor = draw_motor(np.random.default_rng([seed, number]), SWITCHES)
    rng = np.random.default_rng([seed, number, PROFILES.index(profile)])
    return simulate(motor, profile, rng, samples=2000)


def told(of: Path | Recording) -> dict[str, tuple[float, float]]:
    """Logarithm and its standard deviation of each quantity that a record determines."""
    volts, regime = None, "auto"
    if isinstance(of, Path) and of.parent.name == "jhg":
        volts = abs(int(of.stem.removeprefix("pwm_")) - 1800) / 150.0
    if isinstance(of, Path) and of.parent.name == "regbot":
        regime = "operation"
    try:
        rows = identify(of, voltage_v=volts, regime=regime).parameters
    except InputError:
        return {}
    found = {}
    for name, row in rows.items():
        low, high = (math.nan if end is None else end for end in row["interval"])
        sign = -1.0 if name in ("K^2/J", "K^2/(J V)") else 1.0
        if low > 0.0 and high < _TOLD * low and NAMES.get(name, name) in QUANTITIES:
            found[NAMES.get(name, name)] = (
                sign * math.log(row["value"]),
                math.log(high / low) / (2.0 * _TWO_SIDED),
            )
    return found


def one(job: tuple[str, str, Any]) -> dict[str, Any]:
    """What a record tells."""
    kind, motor, of = job
    recording = of if isinstance(of, Path) else simulated(*of)
    name = of.stem if isinstance(of, Path) else of[-1]
    return {"set": kind, "motor": motor, "record": name, "told": told(recording)}


def differences(rows: Sequence[dict[str, Any]]) -> list[tuple[str, float, float]]:
    """Quantity, difference and its standard deviation, for each pair of records of one motor."""
    motors = defaultdict(list)
    for row in rows:
        motors[row["set"], row["motor"]].append(row["told"])
    return [
        (name, a[name][0] - b[name][0], math.hypot(a[name][1], b[name][1]))
        for repeats in motors.values()
        for a, b in combinations(repeats, 2)
        for name in QUANTITIES
        if name in a and name in b
    ]


def cells(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One row of the table."""
    pairs = differences(rows)
    off = np.array([abs(d) / sd for _, d, sd in pairs])
    ratios = []
    for name in QUANTITIES:
        own = np.array([(d, sd) for quantity, d, sd in pairs if quantity == name])
        if len(own):
            scatter = max(_ROBUST * float(np.median(np.abs(own[:, 0]))), 1e-12)
            ratios += [float(np.median(own[:, 1])) / scatter] * len(own)
    counted = {(row["set"], row["motor"]) for row in rows}
    sizes = [sum((row["set"], row["motor"]) == motor for row in rows) for motor in counted]
    return [
        str(len(rows)), str(sum(n * (n - 1) // 2 for n in sizes)), str(len(off)),
        f"{np.mean(off <= _TWO_SIDED):.0%}", f"{np.quantile(off, 0.95) / _TWO_SIDED:.2f}",
        str(int(np.sum(off > _FAR))), f"{np.median(ratios):.2f}",
    ]  # fmt: skip


def main(*, motors: int = 40, seed: int = 0, workers: int = 1, rows: Path | None = None) -> None:
    """Fit every record and keep the table.

    Args:
        motors: simulated ones; each is recorded under every profile.
        seed: of them.
        workers: processes.
        rows: file of a JSON line a record; those that it holds are not fitted again.
    """
    jobs: dict[tuple[str, str, str], tuple[str, str, Any]] = {}
    if "MOTOR_ENV_RECORDINGS" in os.environ:
        jobs |= {(kind, motor, path.stem): (kind, motor, path) for kind, motor, path in real()}
    for n, profile in product(range(motors), PROFILES):
        jobs["other physics", str(n), profile] = ("other physics", str(n), (seed, n, profile))
    known = kept_rows(one, jobs, lambda row: (row["set"], row["motor"], row["record"]), workers, rows)
    sets = list(dict.fromkeys(row["set"] for row in known))
    of_real = [row for row in known if row["set"] != "other physics"]
    shown = [[name, *cells([row for row in known if row["set"] == name])] for name in sets]
    if of_real:
        shown.append(["all real", *cells(of_real)])
    keep_table("motors-at-work", "repeats", ["set", *HEADER], shown)


if __name__ == "__main__":
    run(main)
