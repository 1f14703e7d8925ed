"""False alarms and misses on the production line's recordings, commissioned on many choices of five good starts.

MOTOR_ENV_RECORDINGS=... python benchmarks/production_line.py --choices 20
"""

import os
import random
from collections import Counter
from itertools import combinations
from pathlib import Path

from cyclopts import run

from motor_env.diagnosis.commission import commission
from motor_env.diagnosis.diagnose import diagnose
from motor_env.recordings.recording import read_recording


def main(*, choices: int = 252, skip: int = 0, seed: int = 7) -> None:
    """Print the counts as they grow: all choices take an hour.

    Args:
        choices: of the 252 choices of five, drawn at random.
        skip: of them, the first ones: to go on, or side by side.
        seed: of the draw.
    """
    folder = Path(os.environ["MOTOR_ENV_RECORDINGS"]) / "production_line"
    good, bad = sorted(folder.glob("ok_*.csv")), sorted(folder.glob("ng_*.csv"))
    recordings = {path: read_recording(path) for path in (*good, *bad)}
    every = list(combinations(good, 5))
    some = random.Random(seed).sample(every, min(choices, len(every)))  # noqa: S311 - no secret
    alarms, missed, signs, judged = Counter[str](), Counter[str](), Counter[str](), 0
    some = some[skip:]
    for number, chosen in enumerate(some, start=1):
        motor = commission(list(chosen), "motor 5499").motor
        for path in good:
            if path not in chosen:
                judged += 1
                alarms[path.stem] += diagnose(recordings[path], motor).verdict.is_fault
        for path in bad:
            found = diagnose(recordings[path], motor)
            missed[path.stem] += not found.verdict.is_fault
            signs.update(
                f"{c.name} {'up' if c.ratio > 1.0 else 'down'}" for c in found.changes if c.significant
            )
        if number % 20 == 0 or number == len(some):
            wrong = f"{sum(alarms.values())} alarms on {judged} other good starts {dict(+alarms)}"
            lost = f"missed {sum(missed.values())} of {number * len(bad)} bad ones"
            print(f"{number} choices: {wrong}; {lost}; moved {dict(signs)}", flush=True)


if __name__ == "__main__":
    run(main)
