"""The first answers: CPU seconds of whole processes, against one that imports numpy, scipy.stats and pandas.

That one took 1.4 s where a diagnosis of the README's example took 3.1 with compiled code in the cache and 14.4 without.
The bars are 2.0 and 9.1 of those seconds for the diagnosis, 0.5 for `--help` and 0.25 for `import motor_env`.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from result import Result

ROOT = Path(__file__).resolve().parents[1]
REPEATS = 5
PEER, PEER_SECONDS = "import numpy, scipy.stats, pandas", 1.4
DIAGNOSE = ("-m", "motor_env", "diagnose", "examples/startup_capture.csv", "--motor", "examples/motor.toml")
ROWS = {
    "diagnose, compiled before": (DIAGNOSE, 2.0),
    "diagnose, nothing compiled": (DIAGNOSE, 9.1),
    "motor-env --help": (("-m", "motor_env", "--help"), 0.5),
    "import motor_env": (("-c", "import motor_env"), 0.25),
}
"""What is run, and how long it may take where the peer takes PEER_SECONDS."""


def cpu_seconds(arguments: tuple[str, ...], cache: str) -> float:
    """User and system time of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    paths = os.pathsep.join([str(ROOT), str(ROOT / "datasets"), str(ROOT / "classifiers")])
    finished = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={
            **{name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")},
            "NUMBA_CACHE_DIR": cache,
            "PYTHONPATH": paths,
        },
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if finished.returncode not in (0, 1):  # 1: a fault
        raise RuntimeError(f"{' '.join(arguments)} ended with {finished.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run() -> list[Result]:
    """Each in turn with the peer, several times; the least of each counts."""
    results = []
    with tempfile.TemporaryDirectory() as kept:
        cpu_seconds(DIAGNOSE, kept)
        for name, (arguments, limit) in ROWS.items():
            ours, peers = [], []
            for _ in range(REPEATS):
                peers.append(cpu_seconds(("-c", PEER), kept))
                with tempfile.TemporaryDirectory() as fresh:
                    ours.append(cpu_seconds(arguments, fresh if "nothing" in name else kept))
            bar = round(PEER_SECONDS / limit, 2)
            results.append(Result(name, 1.0 / min(ours), 1.0 / min(peers), PEER, bar))
    return results
