"""A kind of fault goes everywhere by its one entry: one of the package, and one registered from outside."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from recording_csv import write_csv

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    Recipe,
    Scenario,
    SensorParameters,
    Timing,
    simulate,
)
from motor_env.simulation.recipes import FaultClass

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
import pickle, sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from motor_env import FaultKind, load_recipe
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
    path = os.pathsep.join([str(cwd), *sys.path])
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a package with a fault kind of its own would install: a module, and its entry point."""
    folder = tmp_path_factory.mktemp("outside")
    (folder / "my_faults.py").write_text(MODULE, encoding="utf-8")
    info = folder / "my_faults-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-faults\nVersion: 0.1\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(
        "[motor_env.fault_kinds]\nmy_faults = my_faults\n", encoding="utf-8"
    )
    return folder


def test_the_page_runs(tmp_path: Path) -> None:
    printed = run("-W", "error", "-c", "\n".join(BLOCKS), cwd=tmp_path)
    assert "('bearing', 'fouling')" in printed
    assert "matched_fouling_25" in printed


def test_a_kind_in_a_worker_process(folder: Path) -> None:
    (folder / "recipe.toml").write_text(RECIPE.format(kind="fouling"), encoding="utf-8")
    (folder / "workers.py").write_text(WORKERS, encoding="utf-8")
    run("workers.py", cwd=folder)


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["magnet", "fouling"])
def test_a_kind_in_every_command(kind: str, folder: Path) -> None:
    (folder / "recipe.toml").write_text(RECIPE.format(kind=kind), encoding="utf-8")
    data, model = f"{kind}-data", f"{kind}.model"
    described = run("-m", "motor_datasets", "describe", "recipe.toml", cwd=folder)
    assert kind in described
    generate = ("generate", "recipe.toml", "--cases", "200", "--seed", "1", "--out", data)
    run("-m", "motor_datasets", *generate, cwd=folder)
    run("-m", "motor_classifiers", "train", data, "--out", model, cwd=folder)
    scores = json.loads(run("-m", "motor_classifiers", "evaluate", model, data, "--json", cwd=folder))
    assert scores["accuracy"] > 0.9, scores
    judged = ("predict", "start.csv", "--model", model, "--json")
    assert f'"{kind}"' in run("-m", "motor_classifiers", *judged, cwd=_start(folder, kind, 0.2), status=1)


def test_an_environment_lets_an_agent_declare_a_weak_magnet() -> None:
    classes = (FaultClass(), FaultClass(FaultKind.MAGNET, 0.2))
    recipe = Recipe("weak", classes=classes, sensor=SensorParameters(current_noise_a=0.005))
    env = gym.make("motor_env/Probe-v0", recipe=recipe)
    assert env.unwrapped.setup.kinds == ("magnet",)  # type: ignore[attr-defined]  # of our environments
    names = env.unwrapped.setup.observed  # type: ignore[attr-defined]
    for seed in range(6):
        env.reset(seed=seed)
        over, evidence = False, 0.0
        while not over:
            observation, _, over, _, info = env.step(1)
            evidence = max(evidence, float(observation[names.index("evidence_magnet")]))
        assert (evidence > 1.0) == (info["label"] == "magnet"), (seed, evidence, info)


def _start(folder: Path, kind: str, severity: float) -> Path:
    """The folder with a start of a motor that has the fault, current and speed, in start.csv."""
    faults = (Fault(FaultKind.MAGNET, severity),) if kind == "magnet" else ()
    inertia = {} if kind == "magnet" else {"inertia_kg_m2": 1.0 + severity}
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.02, 1.0)
    scenario = Scenario(
        PAPER_MOTOR.scaled(**inertia), faults, sensor=sensor, timing=Timing(10_000.0, 0.2, 0.02)
    )
    start = simulate(scenario, 3, [0])
    current, speed = start.measurements[0]
    columns = {
        "time_s": start.time_s,
        "voltage_v": start.voltage_v[0],
        "current_a": current,
        "speed_rad_s": speed,
    }
    write_csv(folder / "start.csv", columns)
    return folder


def test_diagnose_names_it_where_the_speed_is_recorded(folder: Path) -> None:
    """In one process, which knows both kinds."""
    kinds = ("magnet", "fouling")
    starts = [(_start(folder, kind, 0.1) / "start.csv").rename(folder / f"{kind}.csv").name for kind in kinds]
    answer = run("-m", "motor_env", "diagnose", *starts, "--motor", "paper", "--json", cwd=folder, status=1)
    for kind, found in zip(kinds, json.loads(answer), strict=True):
        assert (found["verdict"], found["kind"]) == (kind, kind)
        assert found["severity"] == pytest.approx(0.1, abs=0.04)
        assert kind in found["smallest_changes"]
