"""False alarms of `motor-env watch` on a simulated healthy motor, by the second simulator of a motor at work.

    python benchmarks/watch.py --windows 1000

Each log has its own random duty cycle and load, and its own temperature (10 K, 1 sd).
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

import numpy as np
from operation_simulator import draw_motor, simulate

from motor_env.diagnosis.watch import YEAR_S, State, Watch
from motor_env.diagnosis.windows import learn_windows

WINDOW = 300
A_LOG = 10


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the verdicts, and how many alarms one an hour and one a day would be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--load", default="constant")
    options = parser.parse_args(arguments)
    rng = np.random.default_rng([77, 2])
    motor = draw_motor(rng)
    dt_s = motor.mechanical_s / 10.0

    def log(count: int, warm_k: float = 0.0, load: str = options.load) -> list[bytes]:
        recording = simulate(
            motor, "averaged pwm", rng, load=load, samples=WINDOW * count, dt_s=dt_s, warm_k=warm_k
        )
        assert recording.voltage_v is not None
        assert recording.speed_rad_s is not None
        columns = (recording.time_s, recording.voltage_v, recording.current_a, recording.speed_rad_s)
        rows = zip(*columns, strict=True)
        return [b"t,v,i,w\n", *(",".join(map(repr, map(float, row))).encode() for row in rows)]

    learned = [simulate(motor, "averaged pwm", rng, load="none", samples=1500, dt_s=dt_s) for _ in range(2)]
    reference = learn_windows(learned, WINDOW * dt_s)
    for name, a_year in (("hour", 8766.0), ("day", 365.25)):
        counts: Counter[str] = Counter()
        for _ in range(options.windows // A_LOG // 2):
            state = State()
            list(
                Watch(reference, state, false_alarms_per_year=a_year).lines(
                    log(A_LOG + 1, float(rng.normal(0.0, 10.0)))
                )
            )
            counts += state.counts
        hours = (
            sum(n for what, n in counts.items() if what.startswith("window")) * reference.window_s / 3600.0
        )
        print(
            f"one a {name}: {dict(counts)} in {hours:.3g} h, where {hours * a_year * 3600 / YEAR_S:.2g} are due"
        )


if __name__ == "__main__":
    main()
