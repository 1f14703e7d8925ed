"""Writes examples/startup_capture.csv: a SIMULATED oscilloscope capture of a start with a worn bearing.

    python examples/make_startup_capture.py

The motor is examples/motor.toml with 30 % more friction. The capture has what a scope adds: 100 ms of quiet before the
trigger, 20 mA of noise and an offset of 3 mA.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motor_env import Fault, FaultKind, Scenario, SupplyParameters, Timing, simulate
from motor_env.motor.data_sheet import load_motor

FOLDER = Path(__file__).parent
OFFSET_A = 0.003


def main() -> None:
    """Simulate and write."""
    motor = load_motor(FOLDER / "motor.toml")
    scenario = Scenario(
        parameters=motor.parameters,
        faults=(Fault(FaultKind.BEARING, 0.30),),
        supply=SupplyParameters(12.0),
        timing=Timing(sampling_rate_hz=10_000.0, duration_s=0.2, quiet_s=0.1),
    )
    start = simulate(scenario, seed=2026, cases=[0])
    current_a = np.round(start.measurements[0, 0] + OFFSET_A, 4)
    rows = np.column_stack([start.time_s, start.voltage_v[0], current_a])
    with (FOLDER / "startup_capture.csv").open("w", encoding="utf-8", newline="\n") as file:
        file.write("time_s,voltage_v,current_a\n")
        for time_s, voltage_v, amps in rows:
            file.write(f"{time_s:.4f},{voltage_v:g},{amps:.4f}\n")


if __name__ == "__main__":
    main()
