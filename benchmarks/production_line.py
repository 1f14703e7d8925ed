"""False alarms and misses on the production line's recordings, commissioned on many choices of five good starts.

MOTOR_ENV_RECORDINGS=... python benchmarks/production_line.py     # 20 minutes
"""

import os
import random
from functools import cache, partial
from itertools import combinations
from pathlib import Path

from cyclopts import run
from tables import keep_table
from verdict_tables import HERE, How, Said, counted

from motor_env import commission, diagnose
from motor_env.diagnosis.readers.recording import Recording, read_recording


@cache
def recordings() -> tuple[dict[Path, Recording], dict[Path, Recording]]:
    """The good and the bad ones."""
    folder = Path(os.environ["MOTOR_ENV_RECORDINGS"]) / "production_line"
    good, bad = (
        {path: read_recording(path) for path in sorted(folder.glob(f"{k}_*.csv"))} for k in ("ok", "ng")
    )
    return good, bad


def judge(number: int, choices: int, seed: int) -> Said:
    """What is said of all others after a commissioning on five good starts."""
    good, bad = recordings()
    chosen = random.Random(seed).sample(list(combinations(good, 5)), choices)[number]  # noqa: S311 - no secret
    motor = commission(list(chosen), "motor 5499").motor
    said: Said = []
    for kind, paths in (("good", good.keys() - chosen), ("bad", bad.keys())):
        for path in sorted(paths):
            found = diagnose((good | bad)[path], motor)
            said.append(((kind, path.stem), "fault" if found.verdict.is_fault else "none"))
    return said


def main(*, choices: int = 252, seed: int = 7, how: How = HERE) -> None:
    """Judge and keep the table: all choices take 20 minutes.

    Args:
        choices: of the 252 choices of five, drawn at random.
        seed: of the draw.
        how: options of every table.
    """
    of = {"seed": seed, "choices": choices}
    counts = counted(partial(judge, **of), choices, how, of=of)
    good, bad = counts[("good",)], counts[("bad",)]
    rows = [
        ["good starts, others than the five", str(good.total()), str(good["fault"])],
        ["bad starts", str(bad.total()), str(bad["fault"])],
    ]
    keep_table("verdicts", "production line", ("starts", "judged", "alarms"), rows)


if __name__ == "__main__":
    run(main)
