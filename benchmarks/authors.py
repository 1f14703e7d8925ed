"""What `identify` tells of real motors, beside what their authors say of them.

MOTOR_ENV_RECORDINGS=... python benchmarks/authors.py     # 3 minutes of one core
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cyclopts import run
from tables import keep_table

from motor_env.common.errors import InputError
from motor_env.diagnosis.identification import identify

AUTHORS = {
    "bench_measured/axem_alone": {
        "R": "0.69 ohm, rotor locked", "K": "0.0293 N m/A, by a lever", "brush_drop": "0.7 V above 1 A, rotor locked"
    },
    "bench_measured/axem_gear": {"R": "as above", "K": "as above", "brush_drop": "as above"},
    "lieskjur/startup_120v": {"R": "0.6 ohm"},
    "aalborg/square_growing": {"brush_drop": "1.1 V"},
    "regbot": {"R": "3.3 ohm", "K": "0.0105 V s/rad", "J": "1.3e-6 kg m2"},
}  # fmt: skip
GEAR = 9.69  # of the robots, whose speed is that of the wheel


def identified(path: Path, regime: str = "auto") -> dict[str, tuple[float, float, float]]:
    """Value and interval of each quantity that a recording tells; none where no motor explains it."""
    try:
        rows = identify(path, regime=regime).parameters
    except InputError:
        return {}
    return {name: (row["value"], *row["interval"]) for name, row in rows.items()}


def rows(folder: Path, every: int) -> Iterator[list[str]]:
    """Rows of the table; of the fleet the median, at the motor's own shaft, and half of all robots about it."""
    for name, says in AUTHORS.items():
        if not (folder / name).is_dir():
            found = identified(folder / f"{name}.csv")
            for quantity, said in says.items():
                value, low, high = found[quantity]
                yield [name, quantity, said, f"{value:.3g}", f"{low:.3g} to {high:.3g}"]
            continue
        fits = [identified(path, "operation") for path in sorted((folder / name).glob("*.csv"))[::every]]
        for quantity, said in says.items():
            at_motor = {"K": GEAR, "J": GEAR**2}.get(quantity, 1.0)
            values = [fit[quantity][0] / at_motor for fit in fits if {"R", "K", "J"} <= fit.keys()]
            low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
            yield [
                f"{name}, median of {len(values)}",
                quantity,
                said,
                f"{middle:.3g}",
                f"{low:.3g} to {high:.3g}",
            ]


def main(*, every: int = 1) -> None:
    """Identify the motors and keep the table of docs/results/verdicts.md.

    Args:
        every: of the fleet each so many-th record.
    """
    if "MOTOR_ENV_RECORDINGS" not in os.environ:
        sys.exit("MOTOR_ENV_RECORDINGS does not name the folder of the recordings")
    header = ["recording", "quantity", "its authors", "identified", "interval"]
    keep_table("verdicts", "authors", header, rows(Path(os.environ["MOTOR_ENV_RECORDINGS"]), every))


if __name__ == "__main__":
    run(main)
