"""Thousands of hostile files, each given to a command with 1 GB of memory and 20 s: the commands keep their promises.

A command ends with a status from 0 to 3, without a traceback; where it refuses, in one sentence and with nothing
written. Nothing half-written stays. No healthy motor has a fault because of damage that can be seen.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hostile import LONGEST_SENTENCE, Child, damaged, forged, json_of, toml_of
from recording_bytes import bytes_of
from strange_toml import ABSURD, MOTORS, strange

from motor_classifiers import load_task
from motor_env import (
    Scenario,
    SupplyParameters,
    Timing,
    load_motor,
    load_recipe,
    simulate,
)

# Reaches in: a note of an unfinished data set holds its recipe.
from motor_env.simulation.named_recipes import recipe_to_dict

MOTOR = str(Path(__file__).parents[1] / "examples" / "motor.toml")
SECONDS, MEMORY, SEED = 20, 10**9, 5
Random = np.random.Generator
READ = """
import io, traceback
from contextlib import redirect_stderr, redirect_stdout
from {program} import main
def read(path):
    out, err = io.StringIO(), io.StringIO()
    given = [argument.replace("FOLDER", str(path)) for argument in {arguments!r}]
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = main(given)
        except BaseException:
            status = -1
            err.write(traceback.format_exc())
    return json.dumps([status, out.getvalue(), err.getvalue()])
"""
PROGRAMS = {
    "motor-env": "motor_env.cli",
    "motor-datasets": "motor_datasets.cli",
    "motor-classifiers": "motor_classifiers.cli.main",
}
Make = Callable[[Random], tuple[bytes, bool]]
"""The content of a file, and whether its damage can be seen."""
Prepare = Callable[[Path], tuple[bytes, Make]]
"""Writes what a command needs besides a file; returns the good content of the file, and what makes hostile ones."""


@cache
def healthy(seed: int = 1, kind: str = "csv") -> bytes:
    """A start of the healthy motor as a file."""
    timing = Timing(sampling_rate_hz=10_000.0, duration_s=0.15, quiet_s=0.05)
    start = simulate(
        Scenario(load_motor(MOTOR).parameters, supply=SupplyParameters(12.0), timing=timing), seed, [0]
    )
    current_a = np.round(start.measurements[0, 0], 6)
    return bytes_of(kind, {"time_s": start.time_s, "voltage_v": start.voltage_v[0], "current_a": current_a})


def bytewise(content: bytes, kind: str = "csv") -> tuple[bytes, Make]:
    """A damaged file; it shows where the format has checksums, or as what no number is written with."""

    def make(rng: Random) -> tuple[bytes, bool]:
        given = damaged(content, rng, most=3)
        return given, kind in ("npz", "mat", "xlsx") or (kind == "csv" and not set(given) <= set(content))

    return content, make


def treewise(tree: Any, write: Callable[[Any], str], **options: Any) -> tuple[bytes, Make]:
    """A file of tables and lists, forged twice in three times, else damaged."""
    whole = write(tree).encode()

    def make(rng: Random) -> tuple[bytes, bool]:
        if rng.random() < 0.67:
            return write(forged(tree, rng, most=2, **options)).encode("utf-8", "replace"), False
        return damaged(whole, rng, most=2), False

    return whole, make


def recording(kind: str) -> Prepare:
    def prepare(folder: Path) -> tuple[bytes, Make]:
        for seed in (2, 3):
            (folder / f"2026-01-0{seed}.csv").write_bytes(healthy(seed))
        return bytewise(healthy(kind=kind), kind)

    return prepare


def motor(folder: Path) -> tuple[bytes, Make]:
    (folder / "start.csv").write_bytes(healthy())
    return MOTORS[0].encode(), lambda rng: (strange(MOTORS[int(rng.integers(2))], rng).encode(), False)


def profile(folder: Path) -> tuple[bytes, Make]:
    (folder / "start.csv").write_bytes(healthy())
    tree = {"column": ["current=current_a:A"], "voltage": 12.0, "shunt_ohm": 0.01, "sensor_lag": 1e-5}
    return treewise(tree, toml_of, absurd=ABSURD)


ESTIMATES = [
    {"time": f"2026-01-{day:02}", "parameter": name, "estimate": 1.0 + 0.01 * day, "standard_error": 0.01}
    for day in range(1, 13)
    for name in ("R", "B/J")
]


def csv_of(rows: Any) -> str:
    """A list of tables as CSV, as far as it is one."""
    lines = [
        ",".join(str(row.get(name, "")) for name in ESTIMATES[0]) for row in rows if isinstance(row, dict)
    ]
    return "\n".join([",".join(ESTIMATES[0]), *lines]) + "\n"


def unfinished(folder: Path) -> tuple[bytes, Make]:
    """The note of an interrupted generation."""
    (folder / "set/data").mkdir(parents=True)
    note = [{"recipe": recipe_to_dict(load_recipe("bench")), "seed": 1, "cases": 5}]
    return treewise(note, lambda rows: "".join(json_of(row) + "\n" for row in rows))


def answers(_: Path) -> tuple[bytes, Make]:
    """A table of answers to a frozen task."""
    rows = (f"{n},0.1\n" for n in range(load_task("severity").n_test))
    return bytewise(("case,severity\n" + "".join(rows)).encode(), "answers")


class Kind(NamedTuple):
    """How many files, the command that reads them in FOLDER, what is hostile, and what it needs besides."""

    files: int
    command: str
    file: str
    prepare: Prepare


DIAGNOSE = f"motor-env diagnose FOLDER/{{}} --motor {MOTOR}"
OF_A_MOTOR = "--motor FOLDER/m.toml --out FOLDER/out --json"
LOGS = "FOLDER/a.csv FOLDER/2026-01-02.csv FOLDER/2026-01-03.csv"
TREND = "motor-env trend FOLDER/{} --out FOLDER/out/t.html"
KINDS = {
    **{
        f"recording.{kind}": Kind(
            500 if kind == "csv" else 200,
            DIAGNOSE.format(f"a.{kind}") + " --out FOLDER/out --json",
            f"a.{kind}",
            recording(kind),
        )
        for kind in ("csv", "npz", "npy", "mat", "parquet", "h5", "xlsx")
    },
    "identify": Kind(150, "motor-env identify FOLDER/a.csv -o FOLDER/out/m.toml", "a.csv", recording("csv")),
    "commission": Kind(100, f"motor-env commission {LOGS} -o FOLDER/out/m.toml", "a.csv", recording("csv")),
    "trend": Kind(100, "motor-env trend FOLDER --out FOLDER/out/t.html", "2026-01-01.csv", recording("csv")),
    "trend of a table": Kind(125, TREND.format("a.csv"), "a.csv", lambda _: treewise(ESTIMATES, csv_of)),
    "trend of JSON": Kind(125, TREND.format("a.json"), "a.json", lambda _: treewise(ESTIMATES, json_of)),
    "profile": Kind(100, DIAGNOSE.format("start.csv") + " --profile FOLDER/p.toml", "p.toml", profile),
    "motor": Kind(340, f"motor-env diagnose FOLDER/start.csv {OF_A_MOTOR}", "m.toml", motor),
    "export-c": Kind(
        100, "motor-env export-c FOLDER/m.toml --rate-hz 1000 --shift 0.5 --out FOLDER/out", "m.toml", motor
    ),
    "unfinished": Kind(
        50,
        "motor-datasets generate bench --cases 5 --seed 1 --out FOLDER/set --resume",
        "set/unfinished.json",
        unfinished,
    ),
    "answers": Kind(160, "motor-classifiers score severity FOLDER/answers.csv", "answers.csv", answers),
}


def defect(said: str, *, seen: bool, new: set[Path]) -> str:
    """What is wrong with the end of a command; empty where nothing is."""
    if not said.startswith("["):
        return said
    status, out, err = json.loads(said)
    lines = err.splitlines()
    wrong = {
        f"status {status}": status not in (0, 1, 2, 3),
        "a traceback": "Traceback" in out + err,
        "a fault": status == 1 and seen,
        "half-written files": any(path.name.startswith(".") for path in new),
        "files of a refusal": status == 2 and bool(new),
        "no sentence": status == 2 and (len(lines) != 1 or len(lines[0]) > LONGEST_SENTENCE),
    }
    words = ", ".join(words for words, holds in wrong.items() if holds)
    return words and f"{words}: {said[:2000]}"


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", KINDS)
def test_commands_keep_their_promises(name: str, tmp_path: Path) -> None:
    kind, whole, run = KINDS[name], tmp_path / "whole", tmp_path / "run"
    run.mkdir()
    good, make = kind.prepare(run)
    run.rename(whole)
    program, *arguments = kind.command.split()
    found = {}
    with Child(READ.format(program=PROGRAMS[program], arguments=arguments), SECONDS, MEMORY) as child:
        for number in range(-1, kind.files):  # the first one is good
            shutil.rmtree(run, ignore_errors=True)
            shutil.copytree(whole, run)
            rng = np.random.default_rng([SEED, max(number, 0)])
            content, seen = (good, False) if number < 0 else make(rng)
            (run / kind.file).write_bytes(content)
            before = set(run.rglob("*"))
            said = child.outcome(run)
            assert number >= 0 or said[1] in "013", f"the good file is not read: {said}"
            new = {path for path in run.rglob("*") if path.is_file()} - before
            if wrong := defect(said, seen=seen, new=new):
                found[number] = wrong
    assert found == {}
