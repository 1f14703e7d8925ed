"""A numba cache that is damaged or cannot be written: a command runs without it and says so once."""

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
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_a_damaged_cache_is_made_anew(kind: str, tmp_path: Path) -> None:
    whole = run(PROGRAM, tmp_path)
    for file in tmp_path.rglob(f"*.{kind}"):
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    damaged, again = run(PROGRAM, tmp_path), run(PROGRAM, tmp_path)
    assert [each.stdout for each in (damaged, again)] == [whole.stdout] * 2
    assert [each.stderr for each in (whole, damaged, again)] == ["", NOTICE, ""]


SOURCES = {
    "helper.py": """
from motor_env.motor.compiled import njit
@njit(cache=True, forceinline=True)
def scaled(value):
    return 2.0 * value
""",
    "kernel.py": """
import numpy as np
from motor_env.motor.compiled import njit
from helper import scaled
from constants import OFFSET, RECORD
@njit(cache=True)
def answer(value):
    return scaled(value) + OFFSET + np.zeros(1, RECORD).itemsize
""",
    "constants.py": "import numpy as np\nOFFSET, RECORD = 5.0, np.dtype([('speed', 'f8')])",
    "notes.py": "0",
}
ASK = """
import os, sys
from motor_env.motor.compiled import njit
njit()(lambda value: 2.0 * value)(1.0)
sys.dont_write_bytecode = True
sys.path.insert(0, sys.argv[1])
for line in sys.stdin:
    if os.fork() == 0:  # a process of its own for each answer; numba is loaded and ready
        import notes
        import kernel
        print(kernel.answer(1.0), sum(kernel.answer.stats.cache_hits.values()), flush=True)
        os._exit(0)
    os.wait()
"""
EDITS = (
    ("notes.py", "0", "1", "15.0 1"),  # not used by what is compiled
    ("helper.py", "2.0 *", "3.0 *", "16.0 0"),
    ("helper.py", "forceinline=True", "inline='always'", "16.0 0"),
    ("constants.py", "5.0", "6.0", "17.0 0"),
    ("constants.py", "f8", "f4", "13.0 0"),
    ("kernel.py", "+ OFFSET", "- OFFSET", "1.0 0"),
)


def test_an_edit_is_compiled_and_nothing_else(tmp_path: Path) -> None:
    """What a function calls and reads counts wherever it stands; numba's own key, time and size, sees no change."""
    for name, text in SOURCES.items():
        (tmp_path / name).write_text(text)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    with subprocess.Popen(
        [sys.executable, "-c", ASK, str(tmp_path)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as asked:
        assert asked.stdin is not None
        assert asked.stdout is not None
        asked.stdin.write("\n")
        assert asked.stdout.readline() == "15.0 0\n"
        for name, before, after, expected in EDITS:
            path = tmp_path / name
            stat = path.stat()
            path.write_text(path.read_text().replace(before, after))
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            asked.stdin.write("\n")
            assert asked.stdout.readline() == f"{expected}\n", name


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_compiled_code_stays_within_its_arrays(tmp_path: Path) -> None:
    """Hostile arguments, filters, rules and simulation, each read of an array checked; compiled anew: minutes."""
    tests = Path(__file__).parents[1]
    files = (
        "test_hostile_arguments",
        "filters/test_kalman",
        "detection/test_rules",
        "simulation/test_fast_path",
    )
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-m", "not long"]
        + [str(tests / f"{name}.py") for name in files],
        env=os.environ | {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        cwd=tests.parents[1],
    )
    assert found.returncode == 0, found.stdout[-3000:]
