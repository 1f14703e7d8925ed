"""Error against the number of starts learned from, peers with an hour each among them: `python benchmarks/scaling.py`.

`enter [TASK/METHOD/N ...]` trains, answers and scores on frozen tasks; what is kept in benchmarks/results/scaling is
not done again. Networks and MiniRocket need `make .venv-bench/.ready peers`. `page` draws the picture and writes the
table. N counts the first training starts of the task, however many there are; the largest N of a peer takes an hour of
CPU time or what memory holds.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cyclopts import run
from matplotlib.figure import Figure
from peers import command, environment, export_starts
from tables import keep_table

from motor_classifiers.scoring.frozen_tasks import load_task, score_answers
from motor_classifiers.scoring.judging import judge
from motor_classifiers.scoring.task import ClassTask
from motor_datasets.arrays import Dataset
from motor_env.common.files import write_text
from motor_env.common.plotting import drawing, save
from motor_env.motor.parameters import FloatArray

FOLDER = Path(__file__).resolve().parent
KEPT = FOLDER / "results" / "scaling"
TASKS = ("bench", "field", "operation")
SIZES = (500, 2_000, 8_000, 32_000)
CPU_S = dict(zip(SIZES, (40, 120, 240, 600), strict=True))
HOUR_S = 3600
METHODS = ("npe", "convolution", "minirocket", "support_vectors", "physical-logistic")
PICTURE = FOLDER.parent / "docs" / "images" / "scaling.svg"
TICKS = (5, 10, 20, 40, 80)
Scored = dict[str, Any]
MOST = {"npe": 1_000_000, "convolution": 1_000_000, "minirocket": 32_000}
"""Starts of the largest training of each peer: those that an hour shows often enough, or that memory holds."""


def entries() -> list[str]:
    """Every entry as TASK/METHOD/N, the largest ones first."""
    large = [f"{task}/{method}/{MOST[method]}" for task in reversed(TASKS) for method in MOST]
    small = [f"{task}/{method}/{n}" for n in SIZES for task in TASKS for method in METHODS]
    return list(dict.fromkeys([*large, *small]))


def _theta(train: Dataset) -> FloatArray:
    """What NPE estimates beside the class: resistance and friction of the motor, without its fault."""
    names = ("resistance_ohm", "viscous_friction_n_m_s_per_rad")
    return np.log(np.column_stack([train.parameters[name] for name in names]))


def _apart(task: ClassTask, method: str) -> tuple[FloatArray, dict[str, Any]]:
    """Answers of a peer in its own environment, and what they took."""
    with tempfile.TemporaryDirectory() as folder:
        cases, target = Path(folder) / "cases.npz", Path(folder) / "answers.npz"
        train = task.train()
        export_starts(train, task.starts(), cases, theta=_theta(train))
        del train
        call = command(cases, target, method)
        if method != "minirocket":
            seconds = CPU_S.get(task.n_train, HOUR_S)
            script = [FOLDER.parent / ".venv-bench" / "bin" / "python", FOLDER / "network_peers.py"]
            call = [str(each) for each in (*script, cases, target, method, seconds)]
        subprocess.run(call, env=environment(), check=True)
        with np.load(target) as arrays:
            facts: dict[str, Any] = json.loads(str(arrays["facts"]))
            if method == "minirocket":
                return arrays[method].astype(np.float64), facts["methods"][method]
            return arrays["probabilities"].astype(np.float64), facts


def enter(entry: str) -> None:
    """Make one entry: answers, and their score."""
    name, method, n = entry.split("/")
    path = KEPT / name / f"{method}-{n}.json"
    if path.is_file():
        return
    whole = load_task(name)
    assert isinstance(whole, ClassTask)
    task, facts = replace(whole, n_train=int(n)), dict[str, Any]()
    if method in MOST:
        shares, facts = _apart(task, method)
    else:
        full = method if method == "physical-logistic" else f"{FOLDER / 'sklearn_methods.py'}:{method}"
        answer = judge(full, task, 0)
        shares, facts = answer.probabilities, {"cpu_s": round(answer.train.seconds)}
    scored = score_answers(whole, shares / shares.sum(axis=1, keepdims=True))
    write_text(path, json.dumps(scored | {"n_train": int(n), "training": facts}, indent=1) + "\n")
    print(f"{entry}: {scored['value']:.2f}", file=sys.stderr, flush=True)


def kept() -> dict[str, dict[str, dict[int, Scored]]]:
    """What is kept, by task, method and number of starts."""
    found: dict[str, dict[str, dict[int, Scored]]] = {}
    for path in sorted(KEPT.glob("*/*.json")):
        scored = json.loads(path.read_bytes())
        method = path.stem.rpartition("-")[0]
        found.setdefault(scored["task"], {}).setdefault(method, {})[scored["n_train"]] = scored
    return found


def best_possible(name: str) -> tuple[float, float]:
    """Between which errors the best possible lies, %; on `bench` it is known."""
    known = kept()[name]["physical-logistic"][SIZES[0]]
    return tuple(known["bracket"]) if "bracket" in known else (known["limit"], known["limit"])


def draw(path: Path) -> None:
    """Error against the number of starts, a panel a task."""
    every = kept()
    with drawing():
        figure = Figure(figsize=(12.0, 4.6), layout="constrained")
        panels = figure.subplots(1, len(every), squeeze=False)[0]
        for panel, (name, methods) in zip(panels, every.items(), strict=True):
            for method in METHODS:
                sizes = sorted(methods.get(method, {}))
                rows = [methods[method][n] for n in sizes]
                values = [row["value"] for row in rows]
                reach = [
                    [row["value"] - row["low"] for row in rows],
                    [row["high"] - row["value"] for row in rows],
                ]
                panel.errorbar(sizes, values, reach, marker="o", markersize=3.5, linewidth=1.6, label=method)
            low, high = best_possible(name)
            panel.axhspan(low - 0.1, high + 0.1, color="0.6", label="best possible")
            panel.set(xscale="log", yscale="log", title=name, xlabel="starts learned from")
            panel.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS], minor=False)
            panel.minorticks_off()
            panel.set_ylim(0.85 * low, 85.0)
        panels[0].set_ylabel("error rate, %")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize="small"
        )
        save(figure, path)


def page() -> None:
    """Draw the picture, and keep the table of the largest trainings."""
    draw(PICTURE)
    rows = []
    for name, methods in kept().items():
        low, high = best_possible(name)
        for method, n in MOST.items():
            if n in methods.get(method, {}):
                one = methods[method][n]
                facts = one["training"]
                value = f"{one['value']:.2f} ({one['low']:.2f} to {one['high']:.2f})"
                rows.append(
                    [
                        name, method, f"{n:,}", f"{facts.get('cpu_s', facts.get('train_s')) / 60.0:.0f}", value,
                        f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}", facts.get("chosen", ""),
                    ]
                )  # fmt: skip
    header = (
        "task",
        "peer",
        "starts",
        "CPU minutes",
        "error rate, %",
        "best possible",
        "chosen on starts held back",
    )
    keep_table("leaderboard", "hour", header, rows)


def main(what: Literal["enter", "page"], /, *entry: str) -> None:
    """Make the entries that are missing, or the picture and the table of what is there."""
    if what == "page":
        page()
        return
    for each in entry or entries():
        enter(each)


if __name__ == "__main__":
    run(main)
