"""Results of the whole product, written down: are they the same before and after a change that should change none?

python benchmarks/golden.py record --out out/golden/before
python benchmarks/golden.py record --out out/golden/after
python benchmarks/golden.py compare out/golden/before out/golden/after

MOTOR_ENV_RECORDINGS names the folder of the real recordings; without it they are left out. To record other code than
the installed one (an older checkout, say), put its three package folders in front: PYTHONPATH=OLD:OLD/datasets:
OLD/classifiers. What is recorded is reached through the three commands, `gymnasium.make` and what the packages export,
so that modules may move. Both records must come from the same machine and the same versions of the dependencies.

A record is a folder of JSON files, one an item, in a folder for each tolerance (TOLERANCES). `compare` prints one line
an item and exits with 1 where one is missing, or differs by more than its tolerance; what only the second record has
is told and is no error. `record --only datasets` makes one part anew, `compare --only learned` looks at one folder.
What is recorded stands in golden_items.py. All of it takes some seven minutes.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from golden_items import PARTS, plain

import motor_env

TOLERANCES = {
    "datasets": 0.0,
    "environments": 0.0,
    "figures": 0.0,
    "filters": 1e-9,
    "paper": 1e-9,
    "recordings": 1e-6,
    "opinions": 1e-6,
    "learned": 0.03,
}
"""Largest relative difference of a number by folder; of `learned` the largest difference of an accuracy."""

LEARNED = "learned"
TINY = 1e-15  # rounding about zero is no relative difference
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
EXAMPLE_FILES = ("startup_capture.csv", "motor.toml")
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def write(out: Path, name: str, value: Any) -> str:
    """Write one item."""
    path = out / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain(value), indent=1), encoding="utf-8")
    return name


def record(out: Path, only: str | None) -> int:
    """Write the items of all parts, or of one."""
    print(f"recording {Path(motor_env.__file__).parent}", flush=True)
    real = os.environ.get("MOTOR_ENV_RECORDINGS")
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        for name in EXAMPLE_FILES:
            shutil.copy(EXAMPLES / name, scratch)
        if real:
            (scratch / "real").symlink_to(real)
        for title, part in PARTS.items():
            if only in (None, title):
                begin = time.perf_counter()
                names = [write(out, name, value) for name, value in part(scratch)]
                print(f"{title}: {len(names)} items, {time.perf_counter() - begin:.0f} s", flush=True)
    return 0


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a JSON document, and the length of every list, by its place."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from leaves(entry, f"{place}.{key}")
    elif isinstance(value, list):
        yield f"{place}.length", len(value)
        for n, entry in enumerate(value):
            yield from leaves(entry, f"{place}[{n}]")
    else:
        yield place, value


def distance(old: Any, new: Any) -> float:
    """Relative difference of two numbers or of the numbers in two texts; infinite where no number says it."""
    if repr(old) == repr(new):
        return 0.0
    if isinstance(old, str) and isinstance(new, str) and NUMBER.sub("", old) == NUMBER.sub("", new):
        pairs = zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
        return max(printed_distance(one, other) for one, other in pairs)
    if not (isinstance(old, int | float) and isinstance(new, int | float)):
        return math.inf
    gap = max(abs(old - new) - TINY, 0.0) / max(abs(old), abs(new), TINY)
    return gap if math.isfinite(gap) else math.inf


def printed_distance(old: str, new: str) -> float:
    """Relative difference of two printed numbers; none where the last decimal is rounded to its neighbour."""
    mantissa, _, exponent = old.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    near = decimals > 0 and abs(float(old) - float(new)) < 1.5 * 10.0 ** (int(exponent or 0) - decimals)
    return 0.0 if near else distance(float(old), float(new))


def judge(section: str, old: Any, new: Any) -> tuple[bool, str]:
    """Whether an item holds, and the words that say so."""
    if json.dumps(old, sort_keys=True) == json.dumps(new, sort_keys=True):
        return True, "same to the bit"
    before, after, tolerance = dict(leaves(old)), dict(leaves(new)), TOLERANCES[section]
    sizes = {
        place: distance(value, after[place]) if place in after else math.inf
        for place, value in before.items()
    }
    if section == LEARNED:
        sizes = {p: abs(before[p] - after[p]) for p in sizes if p.endswith(".accuracy") and p in after}
    wrong = [place for place, size in sizes.items() if size > tolerance]
    if tolerance == 0.0:
        wrong = [place for place, value in before.items() if repr(value) != repr(after.get(place))]
    worst = max(sizes, key=lambda place: sizes[place], default="")
    said = f"largest difference {sizes.get(worst, 0.0):.2g} at {worst}"
    said += "".join([f"; added {place}" for place in after if place not in before][:5])
    if not wrong:
        return True, said
    shown = [f"\n    {place}: {before[place]!r:.90} -> {after.get(place)!r:.90}" for place in wrong[:5]]
    return False, f"DIFFERENT in {len(wrong)} places, {said}{''.join(shown)}"


def compare(old: Path, new: Path, only: str | None) -> int:
    """Print a line an item; 1 if one is missing or differs by more than its tolerance."""
    failed = 0
    found = {path.relative_to(folder) for folder in (old, new) for path in folder.rglob("*.json")}
    files = sorted(file for file in found if only in (None, file.parts[0]))
    for file in files:
        name = str(file.with_suffix(""))
        if not (old / file).exists():
            print(f"{name}: only in {new}")
            continue
        holds, said = False, f"MISSING in {new}"
        if (new / file).exists():
            holds, said = judge(
                file.parts[0], *(json.loads((at / file).read_text(encoding="utf-8")) for at in (old, new))
            )
        failed += not holds
        print(f"{name}: {said}")
    print(f"{len(files)} items, {failed} failed")
    return int(failed > 0)


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    actions = parser.add_subparsers(dest="action", required=True)
    one = actions.add_parser("record", help="write the results to a folder")
    one.add_argument("--out", type=Path, required=True)
    one.add_argument("--only", choices=PARTS)
    two = actions.add_parser("compare", help="compare two folders")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    two.add_argument("--only", choices=TOLERANCES)
    options = parser.parse_args()
    if options.action == "record":
        return record(options.out, options.only)
    return compare(options.old, options.new, options.only)


if __name__ == "__main__":
    sys.exit(main())
