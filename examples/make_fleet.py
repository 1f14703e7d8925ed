"""Writes logs of a SIMULATED fleet: robots with a left and a right motor, some of them sick.

    python examples/make_fleet.py out/fleet

Each robot runs the same test of a second; voltage, current and speed are recorded 1000 times a second. The motors
differ as those of a real fleet do: R by 6 %, K by 2.5 %, J by 6 % and the friction by 20 % (1 sd).
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from motor_env import PAPER_MOTOR, Fault, simulate_states

DT_S, ROBOTS = 0.001, 20
LEVELS_V = (0.0, 4.0, 10.0, -10.0, -4.0, 8.0)
SICK = {
    "03_left": Fault("bearing", 1.5),
    "07_right": Fault("winding_contact", 0.4),
    "12_left": Fault("bearing", 2.5),
}
"""Friction up to 2.5 and 3.5 times, and a winding's resistance up by 40 %."""


def log(rng: np.random.Generator, faults: tuple[Fault, ...]) -> pd.DataFrame:
    """What the sensors of one motor see: 20 mA and 1 rad/s of noise."""
    spread = np.exp(rng.normal(0.0, [0.06, 0.025, 0.06, 0.2]))
    constant = PAPER_MOTOR.back_emf_constant_v_s_per_rad * spread[1]
    motor = replace(
        PAPER_MOTOR,
        resistance_ohm=PAPER_MOTOR.resistance_ohm * spread[0],
        back_emf_constant_v_s_per_rad=constant,
        torque_constant_n_m_per_a=constant,
        inertia_kg_m2=PAPER_MOTOR.inertia_kg_m2 * spread[2],
        viscous_friction_n_m_s_per_rad=PAPER_MOTOR.viscous_friction_n_m_s_per_rad * spread[3],
    )
    voltage_v = np.repeat(LEVELS_V, 170)
    current_a, speed_rad_s = simulate_states(motor, voltage_v, DT_S, faults=faults).T
    return pd.DataFrame(
        {
            "time_s": DT_S * np.arange(len(voltage_v)),
            "voltage_v": voltage_v,
            "current_a": current_a + rng.normal(0.0, 0.02, len(voltage_v)),
            "speed_rad_s": speed_rad_s + rng.normal(0.0, 1.0, len(voltage_v)),
        }
    )


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for robot in range(1, ROBOTS + 1):
        for side, motor in enumerate(("left", "right")):
            name = f"{robot:02d}_{motor}"
            rng = np.random.default_rng([robot, side])
            log(rng, (SICK[name],) if name in SICK else ()).round(5).to_csv(
                folder / f"{name}.csv", index=False
            )
