"""Two faults at once: are both named, and is a second one named where there is none (docs/results/verdicts.md)?

python benchmarks/joint_faults.py --motors 24     # three minutes of one core
python benchmarks/joint_faults.py --single --motors 24     # single faults alone

Each motor has a start with each fault. Those of random_motors.py are judged by five healthy starts and by their data
sheet. Those of loaded_starts.py share no line with the package, and are judged by five healthy starts: half of them
with the speed; half of them have what the model lacks.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from cyclopts import run
from loaded_starts import COMMISSIONED, Bench
from random_motors import HEALTHY, starts
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted, verdict_names, words_of

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.verdict.healthy_motor import to_motor
from motor_env.diagnosis.verdict.healthy_spread import fit_healthy, learn_starts
from motor_env.motor.faults import FaultKind

SINGLE: dict[str, dict[str, float]] = {
    "bearing +50 %": {"bearing": 0.5},
    "bearing +200 %": {"bearing": 2.0},
    "contact +25 %": {"winding_contact": 0.25},
    "contact +100 %": {"winding_contact": 1.0},
    "short 15 %": {"winding_short": 0.15},
    "magnet 15 %": {"magnet": 0.15},
}
JOINT: dict[str, dict[str, float]] = {
    "bearing +50 %, contact +25 %": {"bearing": 0.5, "winding_contact": 0.25},
    "bearing +200 %, contact +25 %": {"bearing": 2.0, "winding_contact": 0.25},
    "bearing +50 %, contact +100 %": {"bearing": 0.5, "winding_contact": 1.0},
    "bearing +100 %, short 15 %": {"bearing": 1.0, "winding_short": 0.15},
    "bearing +100 %, magnet 15 %": {"bearing": 1.0, "magnet": 0.15},
    "contact +25 %, magnet 15 %": {"winding_contact": 0.25, "magnet": 0.15},
}
QUANTITIES = {
    "resistance": ("resistance_ohm", "ohm"),
    "inductance": ("inductance_h", "henry"),
    "constants": ("back_emf_constant_v_s_per_rad", "constant"),
    "friction": ("friction", "viscous"),
}
"""The names of a quantity in either simulator; the torque constant and dry friction go with them."""


def factors(faults: dict[str, float], simulator: int) -> dict[str, float]:
    """What faults multiply, by the names of a simulator."""
    out: dict[str, float] = {}
    for quantity, names in QUANTITIES.items():
        each = (FaultKind(kind).factor(quantity, severity) for kind, severity in faults.items())
        out[names[simulator]] = math.prod(map(float, each))
    beside = ("torque_constant_n_m_per_a", "back_emf_constant_v_s_per_rad"), ("coulomb", "viscous")
    return out | {beside[simulator][0]: out[beside[simulator][1]]}


def judge(number: int, seed: int, faults: dict[str, dict[str, float]]) -> Said:
    """What one motor of each simulator is called with each of its faults."""
    rng = np.random.default_rng([seed, number])
    recordings, sheet = starts(rng, {name: factors(each, 0) for name, each in faults.items()})
    fits = fit_healthy([prepare(each) for each in recordings[:HEALTHY]])
    known = {
        "own physics, healthy starts": to_motor(fits, "this motor", healthy=learn_starts(fits)),
        "own physics, data sheet": sheet,
    }
    pairs = [(by, motor, r) for r in recordings[HEALTHY:] for by, motor in known.items()]
    bench = Bench(seed, number, other_physics=number % 2 == 1)
    fits = fit_healthy([prepare(bench.start(bench.healthy, 0.0)) for _ in range(COMMISSIONED)])
    learned = to_motor(fits, "this motor", healthy=learn_starts(fits))
    channels = "current and speed" if bench.has_speed else "current"
    for name, each in faults.items():
        changed = {key: getattr(bench.healthy, key) * by for key, by in factors(each, 1).items()}
        start = bench.start(replace(bench.healthy, **changed), float(rng.uniform(0.0, 20.0)))
        pairs.append(
            (f"other physics, {channels}", learned, replace(start, path=recordings[0].path.with_name(name)))
        )
    return [((by, r.path.name), verdict_names(diagnose(r, motor))) for by, motor, r in pairs]


def agreement(found: set[str], truth: set[str]) -> str:
    """How what is named agrees with the truth; empty if nothing of it is named."""
    if found == truth:
        return "right"
    named_so = "one of two" if found < truth else "a false fault beside"
    return named_so if found & truth else ""


def rows(counts: Counts, faults: dict[str, dict[str, float]]) -> Iterator[list[str]]:
    """Rows of the table: how often all faults were named and nothing else, a part, or what is not there."""
    for name, each in faults.items():
        truth = {FaultKind(kind).verdict for kind in each}
        for by, one in sorted(counts.by(0, 1).items()):
            if by[1] != name:
                continue
            said = Counter[str]()
            for words, n in one.items():
                found = set(words.split(" + "))
                said[agreement(found, truth) or words] += n
            yield [name, by[0], words_of(said)]


def main(*, motors: int = 24, seed: int = 0, single: bool = False, how: How = HERE) -> None:
    """Judge motors and keep the table.

    Args:
        motors: how many of each simulator.
        seed: of all that is drawn.
        single: single faults alone.
        how: options of every table.
    """
    faults = SINGLE if single else JOINT
    counts = counted(
        partial(judge, seed=seed, faults=faults), motors, how, of={"seed": seed, "single": single}
    )
    name = "single faults" if single else "joint faults"
    keep_table(
        "verdicts", name, ("one start with", "motors, judged by", "what is named"), rows(counts, faults)
    )


if __name__ == "__main__":
    run(main)
