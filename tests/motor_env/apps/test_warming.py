"""`warm-up` compiles what commands and environments use; nothing is compiled after it, and what must be is said."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from motor_env.apps.warming import warm_up

EXAMPLES = Path(__file__).parents[3] / "examples"
LISTEN = """
import sys
from numba.core import event

compiled = []


class Listener(event.Listener):
    def on_start(self, event):
        dispatcher = event.data["dispatcher"]
        compiled.append(f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__name__} {event.data['args']}")

    def on_end(self, event):
        pass


listener = Listener()
event.register("numba:compile", listener)
from motor_env.cli import main
"""
DIAGNOSE = f"main(['diagnose', {str(EXAMPLES / 'startup_capture.csv')!r}, '--motor', {str(EXAMPLES / 'motor.toml')!r}])"
HEAVY = ("scipy.stats", "scipy.signal", "pandas", "matplotlib", "jinja2", "pyarrow")
USE = f"""
import json
from pathlib import Path

import gymnasium as gym
import numpy as np

import motor_env
from motor_classifiers.cli.main import main as classifiers
from motor_datasets.cli import main as data_sets

sys.path.insert(0, {str(EXAMPLES)!r})
from make_running_logs import log

{DIAGNOSE}
start = {str(EXAMPLES / "startup_capture.csv")!r}
rows = Path(start).read_text().splitlines()
assert main(["identify", start, "-o", "identified.toml"]) == 0
starts = [f"healthy_{{n}}.csv" for n in range(4)]
rng = np.random.default_rng(1)
for n, name in enumerate(starts):
    cells = [row.split(",") for row in rows[1:]]
    noisy = (f"{{t}},{{v}},{{float(a) * (1 + 0.01 * n) + rng.normal(0.0, 0.01):.5f}}" for t, v, a in cells)
    Path(name).write_text("\\n".join([rows[0], *noisy]))
assert main(["commission", *starts, "-o", "motor.toml"]) == 0
for seed in range(2):
    log(seed).iloc[:4000].round(5).to_csv(f"log_{{seed}}.csv", index=False)
assert main(["identify", "log_0.csv"]) == 0
assert main(["commission", "log_0.csv", "log_1.csv", "--window", "1", "-o", "work.toml"]) == 0
assert main(["diagnose", "log_1.csv", "--motor", "work.toml"]) in (0, 1, 3)
assert main(["watch", "work.toml", "log_1.csv"]) in (0, 1, 3)
table = ["time,R,R_se", *(f"{{n}},{{2.0 + 0.02 * n}},0.01" for n in range(12))]
Path("trend.csv").write_text("\\n".join(table))
assert main(["trend", "trend.csv", "--limit", "R=1.5"]) in (0, 1)
assert data_sets(["generate", "field", "--cases", "20", "--seed", "1", "--out", "set"]) == 0
assert classifiers(["predict", start]) in (0, 1)
for name in ("Monitor", "Probe", "ProbeContinuous", "Drive", "Maintain", "MonitorHard", "MonitorSpeedLoop"):
    for env in (gym.make(f"motor_env/{{name}}-v0"), gym.make_vec(f"motor_env/{{name}}-v0", num_envs=3)):
        env.action_space.seed(1)
        for seed in range(3):
            env.reset(seed=seed)
            env.step(env.action_space.sample())
        if "num_envs" in dir(env):
            for _ in range(30):
                env.step(env.action_space.sample())
"""


def run(
    program: str, folder: Path, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """With an empty cache of what is compiled, if no environment is given."""
    return subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env=environment or os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")},
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )


def test_a_diagnosis_of_a_start_needs_no_heavy_library(tmp_path: Path) -> None:
    program = f"import sys\nfrom motor_env.cli import main\nassert {DIAGNOSE} == 1\n"
    again = run(f"{program}print([name for name in {HEAVY} if name in sys.modules])", tmp_path, os.environ)
    assert again.stdout.splitlines()[-1] == "[]"


def test_a_part_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="there is no part 'coffee'; there are Monitor and Probe, "):
        warm_up(["coffee"])


@pytest.mark.long
@pytest.mark.timeout(600)
def test_nothing_is_compiled_after_the_warm_up(tmp_path: Path) -> None:
    """And before it one line on the standard error says what is, and no line where all stands in the cache."""
    shares = "from motor_env.apps.warming import PARTS, warm_up; warm_up(PARTS[{}::2])"
    for n in range(2):
        assert run(shares.format(n), tmp_path).stderr == ""
    again = run(f"{LISTEN}{USE}\nprint(compiled)", tmp_path)
    assert again.stdout.splitlines()[-1] == "[]"
    assert "compiles" not in again.stderr
    (tmp_path / "alone").mkdir()
    alone = run(LISTEN + DIAGNOSE, tmp_path / "alone")
    assert alone.stderr.count("motor-env compiles") == 1
