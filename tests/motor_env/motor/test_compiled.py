"""A numba cache that is damaged or cannot be written: a command runs without it and says so once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from motor_env.motor import compiled

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


@pytest.mark.parametrize("can_link_only", [False, True])
def test_parts_give_the_same_whether_they_are_only_linked_or_made_machine_code(
    can_link_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if can_link_only and not compiled._CAN_LINK_ONLY:
        pytest.skip("numba's inner parts have changed: parts are compiled as numba does")
    monkeypatch.setattr(compiled, "_CAN_LINK_ONLY", can_link_only)

    @compiled.njit(is_part=True)
    def inner(value: float) -> float:
        return np.exp(value) + 1.0

    @compiled.njit(is_part=True, forceinline=True)
    def part(value: float) -> float:
        return inner(value) / 3.0

    @compiled.njit()
    def total(values: np.ndarray) -> float:
        sum_ = 0.0
        for value in values:
            sum_ += part(value)
        return sum_

    values = np.linspace(-1.0, 1.0, 7)
    assert total(values) == sum(((np.exp(values) + 1.0) / 3.0).tolist())
    (made,) = part.overloads.values()
    assert bool(made.library.get_pointer_to_function(made.fndesc.llvm_func_name)) is not can_link_only


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
