"""Verdicts on starts under a load that scatters, of warmer motors behind a resistance: a table of docs/recordings.md.

python benchmarks/loaded_starts.py --motors 216

Motors and sensors are those of operation_simulator.py: Stribeck friction, brush drop, ripple, 10 bits. Each motor is
commissioned on five healthy starts, every other one is told what it draws without the load. Each start that is judged
has a load and a temperature of its own.
"""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
from cyclopts import run
from operation_simulator import Motor, draw_motor, simulate
from tables import KEPT, keep_table

from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE, Diagnosis
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.explanations import significance_limit
from motor_env.diagnosis.healthy_motor import fit_healthy, learn_reference
from motor_env.diagnosis.views import views_of
from motor_env.motor.identifiable import PARAMETERS
from motor_env.recordings.recording import Recording

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
COUNTS = KEPT.parent / "loaded_starts.json"


class Bench:
    """One motor with its load, its supply and its sensors."""

    def __init__(self, seed: int, number: int) -> None:
        self.rng = np.random.default_rng([seed, number])
        self.healthy = draw_motor(self.rng)
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
        fit, reference, rate = found.identified, found.reference, DEFAULT_FALSE_ALARM_RATE
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
        needed = significance_limit(rate, fit.exponents, reference.degrees_of_freedom) + SURE
        steps = [
            (view.drag.response @ logs, view.difference.inverse) for view in views_of(fit, reference, rate)
        ]
        return all(step @ inverse @ step > needed**2 for step, inverse in steps)


def judged(seed: int, number: int) -> list[str]:
    """What one motor's starts are called, each as load; channels; change; whether it shows; verdict."""
    bench = Bench(seed, number)
    learned = learn_reference(fit_healthy([bench.start(bench.healthy, 0.0) for _ in range(COMMISSIONED)]))
    if bench.told:
        learned = replace(learned, own_friction=bench.own)
    row = (
        f"{bench.load}; {'current and speed' if bench.has_speed else 'current'}; {bench.spread}; {bench.told}"
    )
    found = []
    for change in [*[HEALTHY] * JUDGED, *CHANGES]:
        factors = CHANGES.get(change, {}).items()
        motor = replace(bench.healthy, **{key: getattr(bench.healthy, key) * by for key, by in factors})
        diagnosis = diagnose(bench.start(motor, float(bench.rng.uniform(0.0, WARMEST_K))), None, learned)
        shows = change != HEALTHY and bench.shows(change, diagnosis)
        found.append(f"{row}; {change}; {'shows' if shows else 'may not show'}; {diagnosis.verdict}")
    return found


def rows(counts: Counter[str]) -> list[list[str]]:
    """Rows of the table: for each change and load how many starts were called what, where it shows and elsewhere."""
    kinds: dict[tuple[str, str], Counter[str]] = {}
    for key, n in counts.items():
        load, _, _, _, change, shows, verdict = key.split("; ")
        kinds.setdefault((change, load), Counter())[f"{shows}: {verdict}"] += n

    def verdicts(one: Counter[str], shows: str) -> str:
        return ", ".join(
            f"{key.split(': ')[1]} {n}" for key, n in one.most_common() if key.startswith(f"{shows}:")
        )

    order = [HEALTHY, *CHANGES]
    ordered = sorted(kinds.items(), key=lambda pair: (order.index(pair[0][0]), LOADS.index(pair[0][1])))
    return [
        [*names, str(one.total()), verdicts(one, "shows"), verdicts(one, "may not show")]
        for names, one in ordered
    ]


def main(*, motors: int = 216, seed: int = 0) -> None:
    """Go on from the motors that benchmarks/results/loaded_starts.json has, and print the table.

    Args:
        motors: in all.
        seed: of all that is drawn.
    """
    kept = json.loads(COUNTS.read_bytes() if COUNTS.is_file() else '{"motors": 0, "starts": {}}')
    counts = Counter[str](kept["starts"])
    for number in range(kept["motors"], motors):
        counts.update(judged(seed, number))
        text = json.dumps({"motors": number + 1, "starts": dict(sorted(counts.items()))}, indent=1)
        COUNTS.write_text(text + "\n", encoding="utf-8")
    header = ("one start with", "load", "starts", "verdicts where it shows", "elsewhere")
    keep_table("recordings", "loaded-starts", header, rows(counts))


if __name__ == "__main__":
    run(main)
