"""A numba cache that is damaged or cannot be written: a command runs without it and says so once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

NO_FOLDER = "import numba.core.caching as c; c.CacheImpl._locator_classes = []\n"
NOTICE = "numba's cache cannot be read or written: compiling without it\n"
PROGRAM = """
from motor_env import PAPER_MOTOR, discretize
print(discretize(PAPER_MOTOR, 1e-4).transition.tolist())
"""


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )


def test_a_cache_without_a_folder_is_done_without(tmp_path: Path) -> None:
    answer = run(NO_FOLDER + PROGRAM, tmp_path)
    assert answer.stdout.startswith("[[0.")
    assert answer.stderr == NOTICE


@pytest.mark.long
def test_a_damaged_cache_is_made_anew(tmp_path: Path) -> None:
    whole = run(PROGRAM, tmp_path)
    assert whole.stderr == ""
    for kind in ("nbi", "nbc"):
        files = list(tmp_path.rglob(f"*.{kind}"))
        assert files
        for file in files:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        damaged = run(PROGRAM, tmp_path)
        assert (damaged.stdout, damaged.stderr) == (whole.stdout, NOTICE)
    again = run(PROGRAM, tmp_path)
    assert (again.stdout, again.stderr) == (whole.stdout, "")
