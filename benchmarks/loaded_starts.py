"""Verdicts on starts under a load that scatters, of warmer motors behind a resistance (docs/results/verdicts.md).

python benchmarks/loaded_starts.py --motors 216     # four minutes of one core
python benchmarks/loaded_starts.py --motors 108 --other-physics --rows out/starts_other_physics.jsonl

Motors and sensors are those of operation_simulator.py: Stribeck friction, brush drop, ripple, 10 bits. Each motor is
commissioned on five healthy starts, every other one is told what it draws without the load. Each start that is judged
has a load and a temperature of its own. With --other-physics the motors have all of SWITCHES, and 8 bits.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from cyclopts import run
from operation_simulator import SWITCHES, Motor, draw_motor, simulate
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted, verdict_names, words_of

from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE, alarm_limits
from motor_env.diagnosis.verdict.healthy_motor import to_motor
from motor_env.diagnosis.verdict.healthy_spread import fit_healthy, learn_starts
from motor_env.diagnosis.verdict.hypotheses import form_hypotheses
from motor_env.motor.identifiable import PARAMETERS

HEALTHY = "nothing changed"
CHANGES = {
    "R +25 %": {"ohm": 1.25},
    "friction +50 %": {"viscous": 1.5, "coulomb": 1.5},
    "K -10 %": {"constant": 0.9},
    "J +25 %": {"inertia": 1.25},
}
LOADS = ("none", "dry", "square")
SPREADS = (0.02, 0.1, 0.3)
COMMISSIONED, JUDGED = 5, 10
LONG = 10.0  # of the mechanical time constant
SAMPLES, BITS = 2000, 10
LOAD, SUPPLY, WARMEST_K = 0.15, 0.1, 40.0  # of the stall torque, of R, and how much warmer
SURE = 2.576  # standard deviations: 99.5 %


class Bench:
    """One motor with its load, its supply and its sensors."""

    def __init__(self, seed: int, number: int, *, other_physics: bool) -> None:
        self.rng = np.random.default_rng([seed, number])
        self.healthy = draw_motor(self.rng, SWITCHES if other_physics else ())
        self.load, self.has_speed = LOADS[number % 3], number // 3 % 2 == 0
        self.spread = SPREADS[number // 6 % 3]
        self.supply_ohm = float(self.rng.uniform(0.0, SUPPLY)) * self.healthy.ohm
        self.torque = LOAD * self.healthy.constant * self.healthy.stall_a
        friction = self.healthy.coulomb + self.healthy.viscous * self.healthy.speed
        self.own = 1.0 if self.load == "none" else friction / (friction + self.torque)
        self.told = number // 18 % 2 == 1

    def start(self, motor: Motor, warm_k: float) -> Recording:
        """One start; its load scatters evenly."""
        torque = self.torque * (1.0 + self.spread * self.rng.uniform(-1.0, 1.0))
        recording = simulate(
            motor,
            "start",
            self.rng,
            load=self.load,
            samples=SAMPLES,
            dt_s=LONG * self.healthy.mechanical_s / SAMPLES,
            bits=BITS,
            warm_k=warm_k,
            torque_n_m=torque,
            supply_ohm=self.supply_ohm,
        )
        return recording if self.has_speed else replace(recording, speed_rad_s=None)

    def shows(self, change: str, found: Diagnosis) -> bool:
        """Whether a test of this change alone finds it in 99.5 of 100 starts, by the covariance that was learned."""
        fit, reference, rate = found.decisive.fit, found.decisive.reference, DEFAULT_FALSE_ALARM_RATE
        if fit is None or reference is None:
            return False
        factors = CHANGES[change]
        by_parameter = {
            "R": factors.get("ohm", 1.0),
            "K": factors.get("constant", 1.0),
            "J": factors.get("inertia", 1.0),
            "B": 1.0 + self.own * (factors.get("viscous", 1.0) - 1.0),
        }
        logs = np.log([by_parameter.get(name, 1.0) for name in PARAMETERS])
        hypotheses = form_hypotheses(fit, reference, rate)
        needed = alarm_limits(hypotheses, rate, tests_noise=reference.log_noise is not None).z + SURE
        steps = [
            (hypothesis.load.response @ logs, hypothesis.difference.inverse) for hypothesis in hypotheses
        ]
        return all(step @ inverse @ step > needed**2 for step, inverse in steps)


def judge(number: int, seed: int, *, other_physics: bool) -> Said:
    """What one motor's starts are called, by load, channels, scatter, whether told, change, and whether it shows."""
    bench = Bench(seed, number, other_physics=other_physics)
    fits = fit_healthy([prepare(bench.start(bench.healthy, 0.0)) for _ in range(COMMISSIONED)])
    learned = learn_starts(fits)
    if bench.told:
        learned = replace(learned, own_friction=bench.own)
    known = to_motor(fits, "this motor", healthy=learned)
    channels = "current and speed" if bench.has_speed else "current"
    said: Said = []
    for change in [*[HEALTHY] * JUDGED, *CHANGES]:
        factors = CHANGES.get(change, {}).items()
        motor = replace(bench.healthy, **{key: getattr(bench.healthy, key) * by for key, by in factors})
        found = diagnose(bench.start(motor, float(bench.rng.uniform(0.0, WARMEST_K))), known)
        shows = "shows" if change != HEALTHY and bench.shows(change, found) else "may not show"
        cell = (bench.load, channels, str(bench.spread), str(bench.told), change, shows)
        said.append((cell, verdict_names(found)))
    return said


def rows(counts: Counts) -> Iterator[list[str]]:
    """Rows of the table: for each change and load how many starts were called what, where it shows and elsewhere."""
    found = counts.by(4, 0, 5)
    for change, load in product((HEALTHY, *CHANGES), LOADS):
        both = [found.get((change, load, shows), Counter[str]()) for shows in ("shows", "may not show")]
        if any(both):
            yield [change, load, str(sum(one.total() for one in both)), *map(words_of, both)]


def main(*, motors: int = 216, seed: int = 0, other_physics: bool = False, how: How = HERE) -> None:
    """Judge motors and keep the table.

    Args:
        motors: how many.
        seed: of all that is drawn.
        other_physics: motors with all switches.
        how: options of every table.
    """
    of = {"seed": seed} | ({"other_physics": True} if other_physics else {})
    counts = counted(partial(judge, seed=seed, other_physics=other_physics), motors, how, of=of)
    header = ("one start with", "load", "starts", "verdicts where it shows", "elsewhere")
    name = "loaded-starts-other-physics" if other_physics else "loaded-starts"
    keep_table("verdicts", name, header, rows(counts))


if __name__ == "__main__":
    run(main)
