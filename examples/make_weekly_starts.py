"""Writes 20 starts of a SIMULATED motor, one a week: its friction grows by 1.5 % of its healthy value each week.

    python examples/make_weekly_starts.py out/starts

Each file has the name of its day (2026-01-05.csv), the voltage, and the current with 20 mA of noise, at 5 kHz.
"""

import sys
from datetime import date, timedelta
from pathlib import Path

import pandas as pd

from motor_env import Fault, Scenario, Timing, load_motor, simulate

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    motor = load_motor(Path(__file__).parent / "motor.toml").parameters
    timing = Timing(sampling_rate_hz=5000.0, duration_s=0.3, quiet_s=0.05)
    for week in range(20):
        worn = Scenario(motor, (Fault("bearing", 0.015 * week),), timing=timing)
        start = simulate(worn, seed=1, cases=[week])
        table = pd.DataFrame(
            {"time_s": start.time_s, "voltage_v": start.voltage_v[0], "current_a": start.measurements[0, 0]}
        )
        day = date(2026, 1, 5) + timedelta(weeks=week)
        table.round(5).to_csv(folder / f"{day.isoformat()}.csv", index=False)
