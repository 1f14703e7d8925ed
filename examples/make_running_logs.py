"""Writes logs of a SIMULATED motor at work: two healthy ones, and one whose friction doubles half-way.

    python examples/make_running_logs.py out/logs

A controller sets another voltage every 50 ms; voltage, current and speed are recorded 500 times a second.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from motor_env import PAPER_MOTOR, Fault, simulate_states

DT_S, DURATION_S = 0.002, 20.0


def log(seed: int, faults: tuple[Fault, ...] = ()) -> pd.DataFrame:
    """What the sensors see: 20 mA and 1 rad/s of noise."""
    rng = np.random.default_rng(seed)
    time_s = DT_S * np.arange(round(DURATION_S / DT_S))
    voltage_v = np.repeat(rng.uniform(-10.0, 10.0, len(time_s) // 25), 25)
    current_a, speed_rad_s = simulate_states(PAPER_MOTOR, voltage_v, DT_S, faults=faults).T
    return pd.DataFrame(
        {
            "time_s": time_s,
            "voltage_v": voltage_v,
            "current_a": current_a + rng.normal(0.0, 0.02, len(time_s)),
            "speed_rad_s": speed_rad_s + rng.normal(0.0, 1.0, len(time_s)),
        }
    )


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    worn = (Fault("bearing", 1.0, onset_s=DURATION_S / 2),)
    for seed, (name, faults) in enumerate({"healthy_1": (), "healthy_2": (), "today": worn}.items()):
        log(seed, faults).round(5).to_csv(folder / f"{name}.csv", index=False)
