"""Thousands of hostile files, each given to a command with 1 GB of memory and 20 s: the commands keep their promises.

A command ends with a status from 0 to 3, without a traceback; where it refuses, in one sentence and with nothing
written. Nothing half-written stays. No healthy motor has a fault because of damage that can be seen.
"""

from __future__ import annotations

import json
import shutil
import tomllib
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
from hostile import LONGEST_SENTENCE, Child, damaged, forged, json_of, toml_of
from recording_bytes import bytes_of
from recording_csv import csv_text
from strange_toml import ABSURD, MOTORS, strange

from motor_classifiers import load_task
from motor_env import (
    PAPER_MOTOR,
    Scenario,
    SupplyParameters,
    Timing,
    cli,
    load_motor,
    load_recipe,
    simulate,
    simulate_states,
)

# Reaches in: a note of an unfinished data set holds its recipe.
from motor_env.simulation.named_recipes import recipe_to_dict

EXAMPLES = Path(__file__).parents[1] / "examples"
MOTOR = str(EXAMPLES / "motor.toml")
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


class Kind(NamedTuple):
    """Hostile files of one kind, and the command that reads them.

    Attributes:
        files: how many.
        command: its words; FOLDER stands for the folder of the files, and what it writes goes to FOLDER/out.
        file: name of what is hostile.
        prepare: writes what the command needs besides.
    """

    files: int
    command: str
    file: str
    prepare: Prepare


@cache
def healthy(seed: int = 1) -> dict[str, Any]:
    """Columns of a start of the healthy motor."""
    timing = Timing(sampling_rate_hz=10_000.0, duration_s=0.15, quiet_s=0.05)
    supplied = Scenario(load_motor(MOTOR).parameters, supply=SupplyParameters(12.0), timing=timing)
    start = simulate(supplied, seed=seed, cases=[0])
    current_a = np.round(start.measurements[0, 0], 6)
    return {"time_s": start.time_s, "voltage_v": start.voltage_v[0], "current_a": current_a}


def recording(kind: str) -> Prepare:
    """A damaged recording; its damage shows where the format has checksums, or as what no number is written with."""

    def prepare(folder: Path) -> tuple[bytes, Make]:
        for seed in (2, 3):
            (folder / f"2026-01-0{seed}.csv").write_bytes(bytes_of("csv", healthy(seed)))
        content = bytes_of(kind, healthy())

        def make(rng: Random) -> tuple[bytes, bool]:
            given = damaged(content, rng, most=3)
            return given, kind in ("npz", "mat", "xlsx") or (kind == "csv" and not set(given) <= set(content))

        return content, make

    return prepare


def changed(tree: Any, write: Callable[[Any], str], **options: Any) -> tuple[bytes, Make]:
    """A file of tables and lists, forged twice in three times, else damaged."""
    whole = write(tree).encode()

    def make(rng: Random) -> tuple[bytes, bool]:
        if rng.random() < 0.67:
            return write(forged(tree, rng, most=2, **options)).encode("utf-8", "replace"), False
        return damaged(whole, rng, most=2), False

    return whole, make


def strange_motor(folder: Path) -> tuple[bytes, Make]:
    """A motor file with strange values."""
    (folder / "start.csv").write_bytes(bytes_of("csv", healthy()))
    return MOTORS[0].encode(), lambda rng: (
        strange(MOTORS[int(rng.integers(len(MOTORS)))], rng).encode(),
        False,
    )


def profile(folder: Path) -> tuple[bytes, Make]:
    (folder / "start.csv").write_bytes(bytes_of("csv", healthy()))
    tree = {"column": ["current=current_a:A"], "voltage": 12.0, "shunt_ohm": 0.01, "sensor_lag": 1e-5}
    return changed(tree, toml_of, absurd=ABSURD)


def estimates(write: Callable[[Any], str]) -> Prepare:
    """A table of estimates."""
    rows = [
        {"time": f"2026-01-{day:02}", "parameter": name, "estimate": 1.0 + 0.01 * day, "standard_error": 0.01}
        for day in range(1, 13)
        for name in ("R", "B/J")
    ]
    return lambda _: changed(rows, write)


def csv_of(rows: Any) -> str:
    """A list of tables as CSV, as far as it is one."""
    names = ("time", "parameter", "estimate", "standard_error")
    lines = [",".join(str(row.get(name, "")) for name in names) for row in rows if isinstance(row, dict)]
    return "\n".join([",".join(names), *lines]) + "\n"


def unfinished(folder: Path) -> tuple[bytes, Make]:
    """The note of an interrupted generation."""
    (folder / "set/data").mkdir(parents=True)
    note = [{"recipe": recipe_to_dict(load_recipe("bench")), "seed": 1, "cases": 5}]
    return changed(note, lambda rows: "".join(json_of(row) + "\n" for row in rows))


@cache
def learned() -> tuple[bytes, bytes]:
    """A motor file that was learned from logs of a motor at work, and another log."""
    with TemporaryDirectory() as name:
        folder, rng = Path(name), np.random.default_rng(1)
        for n, seconds in enumerate((20.0, 3.0)):
            volts = np.repeat(rng.uniform(-10.0, 10.0, round(20 * seconds)), 25)
            current_a, speed_rad_s = simulate_states(PAPER_MOTOR, volts, 0.002).T
            columns = {
                "time_s": 0.002 * np.arange(len(volts)),
                "voltage_v": np.round(volts, 4),
                "current_a": np.round(current_a + rng.normal(0.0, 0.02, len(volts)), 4),
                "speed_rad_s": np.round(speed_rad_s + rng.normal(0.0, 1.0, len(volts)), 3),
            }
            (folder / f"{n}.csv").write_text(csv_text(columns))
        motor = folder / "motor.toml"
        assert cli.main(["commission", str(folder / "0.csv"), "--window", "1", "-o", str(motor)]) == 0
        return motor.read_bytes(), (folder / "1.csv").read_bytes()


def watched(file: str) -> Prepare:
    """What `watch` reads: its log, its motor or its state, each damaged or forged."""

    def prepare(folder: Path) -> tuple[bytes, Make]:
        for name, content in zip(("motor.toml", "log.csv"), learned(), strict=True):
            (folder / name).write_bytes(content)
        paths = [str(folder / name) for name in ("motor.toml", "log.csv", "state.json")]
        cli.main(["watch", *paths[:2], "--state", paths[2]])
        whole = (folder / file).read_bytes()
        if file == "motor.toml":
            return changed(tomllib.loads(whole.decode()), toml_of, absurd=ABSURD)
        if file == "state.json":
            return changed(json.loads(whole), json_of)

        def make(rng: Random) -> tuple[bytes, bool]:
            given = damaged(whole, rng, most=3)
            return given, not set(given) <= set(whole)

        return whole, make

    return prepare


def answers(folder: Path) -> tuple[bytes, Make]:
    """A table of answers to a frozen task."""
    whole = ("case,severity\n" + "".join(f"{n},0.1\n" for n in range(load_task("severity").n_test))).encode()
    return whole, lambda rng: (damaged(whole, rng, most=3), False)


KINDS = {
    **{
        f"recording.{kind}": Kind(
            500 if kind == "csv" else 200,
            f"motor-env diagnose FOLDER/a.{kind} --motor {MOTOR} --out FOLDER/out --json",
            f"a.{kind}",
            recording(kind),
        )
        for kind in ("csv", "npz", "npy", "mat", "parquet", "h5", "xlsx")
    },
    "identify": Kind(150, "motor-env identify FOLDER/a.csv -o FOLDER/out/m.toml", "a.csv", recording("csv")),
    "commission": Kind(
        100,
        "motor-env commission FOLDER/a.csv FOLDER/2026-01-02.csv FOLDER/2026-01-03.csv -o FOLDER/out/m.toml",
        "a.csv",
        recording("csv"),
    ),
    "trend of recordings": Kind(
        100, "motor-env trend FOLDER --out FOLDER/out/t.html", "2026-01-01.csv", recording("csv")
    ),
    "trend of a table": Kind(
        125, "motor-env trend FOLDER/a.csv --out FOLDER/out/t.html", "a.csv", estimates(csv_of)
    ),
    "trend of JSON": Kind(
        125, "motor-env trend FOLDER/a.json --out FOLDER/out/t.html", "a.json", estimates(json_of)
    ),
    "profile": Kind(
        100, f"motor-env diagnose FOLDER/start.csv --motor {MOTOR} --profile FOLDER/p.toml", "p.toml", profile
    ),
    "motor": Kind(
        340,
        "motor-env diagnose FOLDER/start.csv --motor FOLDER/m.toml --out FOLDER/out --json",
        "m.toml",
        strange_motor,
    ),
    "export-c": Kind(
        100,
        "motor-env export-c FOLDER/m.toml --rate-hz 1000 --shift 0.5 --out FOLDER/out",
        "m.toml",
        strange_motor,
    ),
    **{
        f"watch {file}": Kind(
            count, f"motor-env watch FOLDER/motor.toml FOLDER/log.csv{state}", file, watched(file)
        )
        for file, count, state in (
            ("motor.toml", 100, ""),
            ("log.csv", 200, ""),
            ("state.json", 220, " --state FOLDER/state.json"),
        )
    },
    "unfinished": Kind(
        50,
        "motor-datasets generate bench --cases 5 --seed 1 --out FOLDER/set --resume",
        "set/unfinished.json",
        unfinished,
    ),
    "answers": Kind(160, "motor-classifiers score severity FOLDER/answers.csv", "answers.csv", answers),
}


PROMISE = "one false alarm in"
"""What `watch` says at its start, before it has read anything."""


def defect(said: str, *, seen: bool, new: set[Path]) -> str:
    """What is wrong with the end of a command; empty where nothing is."""
    if not said.startswith("["):
        return said
    status, out, err = json.loads(said)
    lines = [line for line in err.splitlines() if PROMISE not in line]
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


def defects(name: str, folder: Path) -> tuple[list[str], Counter[str]]:
    """What is wrong with the ends of a command on the files of one kind, and its exit statuses."""
    kind, whole, run = KINDS[name], folder / "whole", folder / "run"
    run.mkdir()
    good, make = kind.prepare(run)
    run.rename(whole)
    program, *arguments = kind.command.split()
    read = READ.format(program=PROGRAMS[program], arguments=arguments)

    def end(child: Child, content: bytes | None, number: int = 0) -> tuple[str, str]:
        """What a command said, and what is wrong with it."""
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(whole, run)
        given, seen = make(np.random.default_rng([SEED, number])) if content is None else (content, False)
        (run / kind.file).write_bytes(given)
        before = set(run.rglob("*"))
        said = child.outcome(run)
        return said, defect(said, seen=seen, new={path for path in run.rglob("*") if path.is_file()} - before)

    found, statuses = [], Counter[str]()
    with Child(read, SECONDS, MEMORY) as child:
        said, wrong = end(child, good)
        assert said[1] in "013", f"{name}: the good file is not read: {said}"
        assert not wrong
        for number in range(kind.files):
            said, wrong = end(child, None, number)
            statuses[said.partition(",")[0].strip("[")] += 1
            if wrong:
                found.append(f"{name} {number}: {wrong}")
    return found, statuses


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", KINDS)
def test_commands_keep_their_promises(name: str, tmp_path: Path) -> None:
    found, statuses = defects(name, tmp_path)
    print(f"{name}: {dict(statuses)}")  # noqa: T201  # for those who count
    assert found == []
