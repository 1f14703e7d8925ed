"""Small data sets in several files, for the tests of their writing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motor_datasets import Dataset, generate_dataset, load
from motor_datasets.arrays import LABELS
from motor_env import InputError, Timing, load_recipe

SHORT = replace(load_recipe("bench"), timing=Timing(duration_s=0.01))
SHARD_BYTES = 50_000
"""Of a file: some tens of short cases."""
SMALL_SHARDS = (
    "import sys; from motor_datasets import cli, generate as g; g._SHARD_BYTES = 2**19; sys.exit(cli.main())"
)
"""The command, with files of half a megabyte."""


class Stopped(Exception):  # noqa: N818  # it is no error, it stops the writing
    """Raised in the middle of a generation, or in place of a driver's own error."""


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of every file by its path in the folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def assert_same(one: Dataset, other: Dataset) -> None:
    """The same cases, bit for bit."""
    for name in ("X", *LABELS):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    for name, values in one.parameters.items():
        assert np.array_equal(other.parameters[name], values), name


def interrupted(place: Path | str, cases: int, after: int) -> None:
    """Begin a data set, and stop after so many files."""
    seen = []

    def stop(count: int) -> None:
        seen.append(count)
        if len(seen) == after:
            raise Stopped

    with pytest.raises(Stopped):
        generate_dataset(SHORT, cases, 1, place, on_progress=stop)


def assert_goes_on(place: Any, cases: int, content: Callable[[Any], object], whole: Path) -> None:
    """What was interrupted is no data set; the same order alone makes the same bytes of it, and changes none again."""
    with pytest.raises(InputError, match="no data set"):
        load(place)
    for seed, resume, words in ((1, False, "--resume"), (2, True, "something other")):
        with pytest.raises(InputError, match=words):
            generate_dataset(SHORT, cases, seed, place, resume=resume)
    for _ in range(2):  # the second time it is finished already: nothing happens
        generate_dataset(SHORT, cases, 1, place, resume=True)
        assert content(place) == files_of(whole)
    for other in ((SHORT, cases + 1, 1), (SHORT, cases, 2), (replace(SHORT, name="other"), cases, 1)):
        with pytest.raises(InputError, match="another data set"):
            generate_dataset(*other, place, resume=True)
    assert content(place) == files_of(whole)
