"""Small data sets in several files, for the tests of their writing."""

from dataclasses import replace
from pathlib import Path

from motor_env import Timing, load_recipe

SHORT = replace(load_recipe("bench"), timing=Timing(duration_s=0.01))
SHARD_BYTES = 50_000
"""Of a file: some tens of short cases."""


class Stopped(Exception):  # noqa: N818  # it is no error, it stops the writing
    """Raised in the middle of a generation, or in place of a driver's own error."""


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of every file by its path in the folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }
