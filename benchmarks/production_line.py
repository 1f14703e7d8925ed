"""False alarms and misses on the production line's recordings, commissioned on many choices of five good starts.

MOTOR_ENV_RECORDINGS=... python benchmarks/production_line.py --choices 20
"""

import os
import random
from functools import cache, partial
from itertools import combinations
from pathlib import Path

from cyclopts import run
from tables import keep_table
from verdict_tables import HERE, Counts, How, Said, counted

from motor_env import commission, diagnose
from motor_env.recordings.recording import Recording, read_recording


@cache
def recordings() -> tuple[dict[Path, Recording], dict[Path, Recording]]:
    """The good and the bad ones."""
    folder = Path(os.environ["MOTOR_ENV_RECORDINGS"]) / "production_line"
    good, bad = (
        {path: read_recording(path) for path in sorted(folder.glob(f"{k}_*.csv"))} for k in ("ok", "ng")
    )
    return good, bad


def judge(number: int, choices: int, skip: int, seed: int) -> Said:
    """What is said of all others after a commissioning on five good starts, and what moves in the bad ones."""
    good, bad = recordings()
    every = list(combinations(good, 5))
    some = random.Random(seed).sample(every, min(choices, len(every)))  # noqa: S311 - no secret
    chosen = some[skip + number]
    motor = commission(list(chosen), "motor 5499").motor
    said: Said = []
    for kind, paths in (("good", good.keys() - chosen), ("bad", bad.keys())):
        for path in sorted(paths):
            found = diagnose((good | bad)[path], motor)
            said.append(((kind, path.stem), "fault" if found.verdict.is_fault else "none"))
            if kind == "bad":
                moved = (c for c in found.changes if c.significant)
                said += [(("moved",), f"{c.name} {'up' if c.ratio > 1.0 else 'down'}") for c in moved]
    return said


def summary(counts: Counts) -> str:
    """The counts in one line."""
    alarms = {
        cell[1]: one["fault"] for cell, one in counts.cells.items() if cell[0] == "good" and one["fault"]
    }
    good, bad = counts[("good",)], counts[("bad",)]
    wrong = f"{good['fault']} alarms on {good.total()} other good starts {alarms}"
    lost = f"missed {bad['none']} of {bad.total()} bad ones"
    return f"{counts.cases} choices: {wrong}; {lost}; moved {dict(counts[('moved',)])}"


def main(*, choices: int = 252, skip: int = 0, seed: int = 7, how: How = HERE) -> None:
    """Print the counts as they grow: all choices take an hour.

    Args:
        choices: of the 252 choices of five, drawn at random.
        skip: of them, the first ones: to go on, or side by side.
        seed: of the draw.
        how: options of every table.
    """
    number = min(choices, len(list(combinations(recordings()[0], 5)))) - skip

    def tell(_: int, __: Said, counts: Counts) -> None:
        if counts.cases % 20 == 0 or counts.cases == number:
            print(summary(counts), flush=True)

    of = {"seed": seed, "choices": choices, "skip": skip}
    counts = counted(partial(judge, **of), number, how, of=of, tell=tell)
    good, bad = counts[("good",)], counts[("bad",)]
    rows = [
        ["good starts, others than the five", str(good.total()), str(good["fault"])],
        ["bad starts", str(bad.total()), str(bad["fault"])],
    ]
    keep_table("recordings", "production line", ("starts", "judged", "alarms"), rows)


if __name__ == "__main__":
    run(main)
