"""Verdicts on starts under a load, of motors commissioned on five healthy starts: a table of docs/recordings.md.

python benchmarks/loaded_starts.py --motors 12

Motors, loads and sensors are those of operation_simulator.py: Stribeck friction, brush drop, ripple, 12 bits. The load
scatters from start to start.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
from cyclopts import run
from operation_simulator import Motor, draw_motor, simulate
from tables import print_table

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.healthy_motor import fit_healthy, learn_reference
from motor_env.recordings.recording import Recording

CHANGES = {
    "healthy": {},
    "healthy, 25 K warmer": {},
    "R +25 %": {"ohm": 1.25},
    "friction +50 %": {"viscous": 1.5, "coulomb": 1.5},
    "K -10 %": {"constant": 0.9},
    "J +25 %": {"inertia": 1.25},
}
LOADS = ("none", "constant", "square")
HEALTHY = 5
LONG = 10.0  # of the mechanical time constant
SAMPLES = 2000


def start(
    motor: Motor, healthy: Motor, rng: np.random.Generator, load: str, spread: float, warm_k: float
) -> Recording:
    """One start; the load is that of the healthy motor, with its scatter."""
    torque = 0.15 * healthy.constant * healthy.stall_a * (1.0 + spread * rng.standard_normal())
    dt_s = LONG * healthy.mechanical_s / SAMPLES
    return simulate(
        motor, "start", rng, load=load, samples=SAMPLES, dt_s=dt_s, warm_k=warm_k, torque_n_m=torque
    )


def verdicts(number: int, seed: int, load: str, spread: float, *, has_speed: bool) -> dict[str, str]:
    """The verdict on one start of each change."""
    rng = np.random.default_rng([seed, number])
    healthy = draw_motor(rng)

    def recorded(motor: Motor, warm_k: float = 0.0) -> Recording:
        recording = start(motor, healthy, rng, load, spread, warm_k)
        return recording if has_speed else replace(recording, speed_rad_s=None)

    learned = learn_reference(fit_healthy([recorded(healthy) for _ in range(HEALTHY)]))
    found = {}
    for name, factors in CHANGES.items():
        motor = replace(healthy, **{key: getattr(healthy, key) * factor for key, factor in factors.items()})
        found[name] = str(diagnose(recorded(motor, 25.0 if "warmer" in name else 0.0), None, learned).verdict)
    return found


def main(*, motors: int = 12, seed: int = 0, spread: float = 0.02) -> None:
    """Print a table for each load, with and without the speed.

    Args:
        motors: of each table.
        seed: of all that is drawn.
        spread: of the load from start to start.
    """
    for load in LOADS:
        for has_speed in (False, True):
            counts = {name: Counter[str]() for name in CHANGES}
            for number in range(motors):
                for name, verdict in verdicts(number, seed, load, spread, has_speed=has_speed).items():
                    counts[name][verdict] += 1
            rows = [
                (name, ", ".join(f"{word} {n}" for word, n in count.most_common()))
                for name, count in counts.items()
            ]
            title = f"Load: {load}; {'current and speed' if has_speed else 'current'}"
            print_table(title, ("one start with", "verdicts"), rows)


if __name__ == "__main__":
    run(main)
