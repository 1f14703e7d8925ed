"""A kind of fault goes everywhere by its one entry: one of the package, and one registered from outside."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from recording_csv import write_csv

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    Scenario,
    SensorParameters,
    Timing,
    simulate,
)

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "own-fault.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
(MODULE,) = [block for block in BLOCKS if block.startswith("# my_faults.py")]
RECIPE = """
base = "bench"
[sensor]
channels = ["current", "speed"]
[[classes]]
[[classes]]
kind = "{kind}"
severity = 0.2
[[classes]]
kind = "bearing"
severity = 0.2
"""
WORKERS = """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from motor_env import load_recipe
from motor_env.inference.posterior import SeverityPrior, severity_posterior
from motor_datasets import generate_arrays
import numpy as np

if __name__ == "__main__":
    from my_faults import FOULING
    recipe = load_recipe("recipe.toml")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        theirs = pool.submit(generate_arrays, recipe, 5, 6).result()
    ours = generate_arrays(recipe, 5, 6)
    assert (theirs.X == ours.X).all()
    faulty = ours.X[ours.class_index == 1]
    found = severity_posterior(recipe, SeverityPrior(FOULING, 0.0, 0.4), faulty)
    assert np.abs(found.mean - 0.2).max() < 0.05, found.mean
"""


def run(*arguments: str, cwd: Path, status: int = 0) -> str:
    """Standard output of a Python process that has the folder on its path."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(cwd), *sys.path])}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a package with a fault kind of its own would install: a module, and its entry point."""
    folder = tmp_path_factory.mktemp("outside")
    info = folder / "my_faults-0.1.dist-info"
    info.mkdir()
    for path, text in (
        (folder / "my_faults.py", MODULE),
        (info / "METADATA", "Metadata-Version: 2.1\nName: my-faults\nVersion: 0.1\n"),
        (info / "entry_points.txt", "[motor_env.fault_kinds]\nmy_faults = my_faults\n"),
    ):
        path.write_text(text, encoding="utf-8")
    return folder


def test_the_page_runs(tmp_path: Path) -> None:
    printed = run("-W", "error", "-c", "\n".join(BLOCKS), cwd=tmp_path)
    assert "('bearing', 'fouling')" in printed
    assert "matched_fouling_25" in printed


def test_a_kind_in_a_worker_process(folder: Path) -> None:
    (folder / "recipe.toml").write_text(RECIPE.format(kind="fouling"), encoding="utf-8")
    (folder / "workers.py").write_text(WORKERS, encoding="utf-8")
    run("workers.py", cwd=folder)


def start(folder: Path, kind: str, severity: float) -> str:
    """A start of a motor that has the fault, current and speed; the name of its file."""
    faults = (Fault(FaultKind.MAGNET, severity),) if kind == "magnet" else ()
    inertia = {} if kind == "magnet" else {"inertia_kg_m2": 1.0 + severity}
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 1.0)
    motor, timing = PAPER_MOTOR.scaled(**inertia), Timing(10_000.0, 0.2, 0.02)
    made = simulate(Scenario(motor, faults, sensor=sensor, timing=timing), 3, [0])
    readings = dict(zip(("current_a", "speed_rad_s"), made.measurements[0], strict=True))
    columns = {"time_s": made.time_s, "voltage_v": made.voltage_v[0]} | readings
    return write_csv(folder / f"{kind}.csv", columns).name


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["magnet", "fouling"])
def test_a_kind_in_every_command(kind: str, folder: Path) -> None:
    (folder / "recipe.toml").write_text(RECIPE.format(kind=kind), encoding="utf-8")
    data, model = f"{kind}-data", f"{kind}.model"
    assert kind in run("-m", "motor_datasets", "describe", "recipe.toml", cwd=folder)
    generate = ("generate", "recipe.toml", "--cases", "200", "--seed", "1", "--out", data)
    run("-m", "motor_datasets", *generate, cwd=folder)
    run("-m", "motor_classifiers", "train", data, "--out", model, cwd=folder)
    scores = json.loads(run("-m", "motor_classifiers", "evaluate", model, data, "--json", cwd=folder))
    assert scores["accuracy"] > 0.9, scores
    judged = ("predict", start(folder, kind, 0.2), "--model", model, "--json")
    assert f'"{kind}"' in run("-m", "motor_classifiers", *judged, cwd=folder, status=1)


def test_diagnose_names_it_where_the_speed_is_recorded(folder: Path) -> None:
    """In one process, which knows both kinds."""
    kinds = ("magnet", "fouling")
    starts = [start(folder, kind, 0.1) for kind in kinds]
    answer = run("-m", "motor_env", "diagnose", *starts, "--motor", "paper", "--json", cwd=folder, status=1)
    for kind, found in zip(kinds, json.loads(answer), strict=True):
        assert (found["verdict"], found["kind"]) == (kind, kind)
        assert found["severity"] == pytest.approx(0.1, abs=0.04)
        assert kind in found["smallest_changes"]
