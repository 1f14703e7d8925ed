"""A fleet's false alarms and power beside an oracle that knows the healthy motors' true distribution.

python benchmarks/fleet.py --healthy 3000 --sick 300 --workers 2     # five minutes of one core

Fits are drawn from their own law: the motor's quantities from the spread found in a fleet of real robots, the errors
from the fit's covariance.
"""

import math
import sys
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from typing import NamedTuple

import numpy as np
from cyclopts import run
from tables import keep_table

from motor_env.diagnosis.fleet.learning import PRIOR_SPREAD, combine_with_records, directions_of
from motor_env.diagnosis.fleet.population import HealthyPopulation, Motors, learn_population
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, reference_of_pieces
from motor_env.diagnosis.verdict.healthy_spread import START_SPREAD, next_piece
from motor_env.diagnosis.verdict.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor import identifiable
from motor_env.motor.healthy import Fleet, Healthy, Starts
from motor_env.motor.parameters import FloatArray

FLEETS = (
    (10, 0.0),
    (30, 0.0),
    (100, 0.0),
    (30, 0.2),
    (100, 0.2),
)  # motors, and share of sick ones among them
NOT_SHOWN = (", 3 sd", ", 6 sd")  # gains that fleets have, and the tables leave out
RATE = 0.01
# From motor to motor (R, K, J, drag), from record to record, and of the fits, about as in a fleet of real robots:
# regbot of SebastianBitsch/robobot-project.
BETWEEN = np.diag(np.square([0.065, 0.025, 0.065, 0.30]))
WITHIN = np.diag(np.square([0.02, 0.01, 0.02, 0.10]))
ERROR = np.diag(np.square([0.010, 0.007, 0.010, 0.02]))
CENTRE = np.log([4.0, 0.09, 8e-5, 3.5e-4])
TOTAL = BETWEEN + WITHIN
GAINS = {
    "current gain": np.array([-1.0, 0.0, 1.0, 1.0]),
    "speed gain": np.array([0.0, -1.0, -2.0, -2.0]),
    "voltage gain": np.array([1.0, 1.0, 1.0, 1.0]),
}
BELIEF = (
    identifiable.matrix(NAMES)
    @ identifiable.tolerance_covariance(PRIOR_SPREAD)
    @ identifiable.matrix(NAMES).T
)
WAYS = directions_of(identifiable.matrix(NAMES))


class Fault(NamedTuple):
    """A fault: what is said of it, and how R, K, J and the drag move."""

    name: str
    moves: FloatArray


def faults() -> Iterator[Fault]:
    """Those of the tables."""
    for factor in (1.5, 2.0, 3.0):
        yield Fault(f"friction x {factor:g}", np.array([0.0, 0.0, 0.0, math.log(factor)]))
    yield Fault("R +25 %", np.array([math.log(1.25), 0.0, 0.0, 0.0]))
    yield Fault("K -10 %", np.array([0.0, math.log(0.9), 0.0, 0.0]))
    for (name, way), sd in product(GAINS.items(), (3.0, 4.0, 6.0)):
        size = sd / math.sqrt(way @ np.linalg.solve(TOTAL + ERROR, way))
        yield Fault(f"{name}, {sd:g} sd", size * way)


def drawn(rng: np.random.Generator, count: int) -> FloatArray:
    """Fits of healthy motors."""
    return CENTRE + rng.multivariate_normal(np.zeros(4), TOTAL + ERROR, count)


def core_of(logs: FloatArray) -> HealthyPopulation:
    """What a fleet teaches by its fits, one a motor."""
    n = len(logs)
    errors, places = np.tile(ERROR, (n, 1, 1)), np.zeros(n, dtype=np.intp)
    return learn_population(Motors(logs, errors, np.arange(n), places, BELIEF, np.eye(4) * 0.02**2, WAYS))


def judged(logs: FloatArray, core: HealthyPopulation) -> Judgement:
    """One motor by a core."""
    reference = Reference(
        "sisters",
        NAMES,
        core.centres[0],
        core.next_motor() + core.within,
        core.degrees_of_freedom,
        is_taught=True,
    )
    return decide(FittedWindow(logs, ERROR), reference, RATE)


ORACLE = HealthyPopulation(CENTRE[None], np.zeros((1, 4, 4)), BETWEEN, WITHIN, 1e6, np.ones(1))


class Cell(NamedTuple):
    """Counts of a fleet: healthy ones judged and called faulty, by fleet and oracle; by fault: judged, found."""

    healthy: FloatArray
    by_fault: FloatArray


def one(job: tuple[int, float, int, int, int]) -> Cell:
    """A fleet, and fresh motors judged by it."""
    size, share, seed, healthy, sick = job
    rng, every = np.random.default_rng([size, round(100 * share), seed]), list(faults())
    logs = drawn(rng, size)
    for n in range(round(share * size)):
        logs[n] += every[rng.integers(len(every))].moves
    core = core_of(logs)
    counts = np.zeros(3)
    for fit in drawn(rng, healthy):
        counts += [1, judged(fit, core).verdict.is_fault, judged(fit, ORACLE).verdict.is_fault]
    rows = np.zeros((len(every), 3))
    for row, fault in zip(rows, every, strict=True):
        for fit in drawn(rng, sick) + fault.moves:
            found, known = judged(fit, core), judged(fit, ORACLE)
            row += [1, found.verdict.is_fault, known.verdict.is_fault]
    return Cell(counts, rows)


def smallest_faults(motors: int) -> Iterator[list[str]]:
    """Median smallest bearing and winding fault by the number of own healthy records, and by what else is known."""
    rng = np.random.default_rng(33)
    units = Healthy(
        30,
        33.0,
        NAMES,
        np.exp(CENTRE),
        TOTAL * (1.0 + 1.0 / 30.0),
        0.0,
        fleet=Fleet(30, WITHIN),
        starts=Starts(0.0, 0.1),
    )
    for count in (0, 1, 2, 3, 10):
        found: dict[str, list[dict[str, float]]] = {"sisters": [], "own": []}
        for own in CENTRE + rng.multivariate_normal(np.zeros(4), BETWEEN, motors):
            logs = own + rng.multivariate_normal(np.zeros(4), WITHIN + ERROR, count + 1)
            today, records = FittedWindow(logs[0], ERROR), [FittedWindow(one, ERROR) for one in logs[1:]]
            known = combine_with_records(units, logs[1:], np.tile(ERROR, (count, 1, 1))) if count else units
            reference = reference_of_pieces(known, NAMES, "this motor")
            assert reference is not None
            found["sisters"].append(decide(today, reference, RATE).smallest_changes)
            if count:
                centre, covariance, freedom = next_piece(records, START_SPREAD)
                alone = Reference("own", NAMES, centre, covariance, freedom, includes_fit_error=True)
                found["own"].append(decide(today, alone, RATE).smallest_changes)
        cells = [
            f"{np.median([one[kind] for one in each]):.0%}" if each else "-"
            for each in found.values()
            for kind in ("bearing", "winding_contact")
        ]
        yield [str(count), *cells]


def main(*, healthy: int = 3000, sick: int = 300, workers: int = 1) -> None:
    """Judge fresh motors by simulated fleets and keep the tables of docs/fleet.md.

    Args:
        healthy: number of healthy motors judged in each cell, at least.
        sick: number of motors with each fault, in each cell.
        workers: processes.
    """
    header = [
        "own records",
        "bearing, 30 sisters",
        "winding, 30 sisters",
        "bearing, own alone",
        "winding, own alone",
    ]
    keep_table("fleet-power", "own", header, smallest_faults(100))
    alarms = []
    found = defaultdict[str, list[str]](list)
    with ProcessPoolExecutor(workers) as pool:
        for size, share in FLEETS:
            fleets = max(healthy // 10, 1)
            each = max(math.ceil(sick / fleets), 1)
            jobs = [(size, share, seed, 10, each) for seed in range(fleets)]
            cells = list(pool.map(one, jobs, chunksize=4))
            counts = np.sum([cell.healthy for cell in cells], axis=0)
            by_fault = np.sum([cell.by_fault for cell in cells], axis=0)
            share_of = counts[1:] / counts[0]
            half = 1.96 * np.sqrt(np.var([cell.healthy[1] / 10.0 for cell in cells]) / len(cells))
            rates = (share_of[0], half, share_of[1])
            alarms.append([str(size), f"{share:.0%}", f"{counts[0]:.0f}", *(f"{one:.2%}" for one in rates)])
            for fault, row in zip(faults(), by_fault / by_fault[:, :1], strict=True):
                found[fault.name].append(f"{row[1]:.2f} of {row[2]:.2f}")
            print(alarms[-1], file=sys.stderr, flush=True)
    keep_table("fleet-power", "alarms", ["motors", "sick", "judged", "false alarms", "±", "oracle"], alarms)
    header = [f"{size}, {share:.0%}" for size, share in FLEETS]
    shown = ([fault, *cells] for fault, cells in found.items() if not fault.endswith(NOT_SHOWN))
    keep_table("fleet-power", "power", ["fault", *header], shown)


if __name__ == "__main__":
    run(main)
