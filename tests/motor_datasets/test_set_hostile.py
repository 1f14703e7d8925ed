"""Hostile arguments of `motor_datasets`: the right answer, or one sentence."""

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Row, public_names
from small_sets import SHORT

import motor_datasets
from motor_datasets import (
    generate_arrays,
    generate_dataset,
    load,
    split_of,
    stream,
    to_pandas,
    to_torch,
    to_torch_iterable,
)


def generated(folder: Path, **changes: Any) -> tuple[int, int]:
    """Cases and bytes of a data set in a folder of its own."""
    arguments: dict[str, Any] = {"recipe": SHORT, "cases": 4, "seed": 1, "out": folder / "set"} | changes
    place = Path(arguments["out"]) if isinstance(arguments["out"], str) else arguments["out"]
    made = generate_dataset(**arguments)
    for path in sorted(place.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    place.rmdir()
    return made.cases, made.bytes


def first(**changes: Any) -> Any:
    """The samples of the first batch of a stream, if it has one."""
    return [
        batch.X for batch in islice(stream(**{"recipe": SHORT, "seed": 1, "batch_size": 4, **changes}), 1)
    ]


CASES = np.array([3, 1, 4])
ROWS = [
    Row.of("generate_arrays", "recipe", lambda value: generate_arrays(value, 1, 2).X, SHORT),
    Row.of("generate_arrays", "seed", lambda value: generate_arrays(SHORT, value, 2).X, 7),
    Row.of(
        "generate_arrays",
        "cases",
        lambda value: generate_arrays(SHORT, 1, value).X,
        3,
        also=(0, -1, 2**40, 2**62),
    ),
    Row.of("generate_arrays", "cases", lambda value: generate_arrays(SHORT, 1, value).X, CASES, "one short"),
    Row.of("split_of", "seed", lambda value: split_of(value, [1, 2]), 7),
    Row.of(
        "split_of",
        "motor_id",
        lambda value: split_of(1, value),
        CASES,
        "one short",
        "empty",
        "no samples",
        "more axes",
    ),
    Row.of("stream", "recipe", lambda value: first(recipe=value), SHORT),
    Row.of("stream", "seed", lambda value: first(seed=value), 7),
    Row.of("stream", "batch_size", lambda value: first(batch_size=value), 4, also=(0, -1)),
    Row.of("stream", "split", lambda value: first(split=value), "train", "None"),
    Row.of("stream", "batches", lambda value: first(batches=value), 2, "None", also=(-1,)),
    Row.of("stream", "share", lambda value: first(share=value), (0, 1), also=((0, 0), (1.5, 2), (0,), 3)),
]


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_hostile_arguments_of_data_sets(row: Row) -> None:
    assert row.defects() == []


@pytest.mark.parametrize("name", ["recipe", "cases", "seed", "workers"])
def test_hostile_arguments_of_a_written_set(name: str, tmp_path: Path) -> None:
    good: Any = {"recipe": SHORT, "cases": 4, "seed": 1, "workers": 1}[name]
    row = Row.of(
        "generate_dataset", name, lambda value: generated(tmp_path, **{name: value}), good, "-1", "0"
    )
    assert row.defects() == []
    assert not list(tmp_path.iterdir())  # nothing half-written


def test_what_is_no_folder_and_no_data_set_is_refused() -> None:
    nothings: tuple[Any, ...] = (None, 3, b"x", ["a"])
    for nothing in nothings:
        with pytest.raises(ValueError, match="the folder must be a path or a URL, got"):
            load(nothing)
        for turn in (to_pandas, to_torch):
            with pytest.raises(TypeError, match="dataset must be of type Dataset, got"):
                turn(nothing)


def test_every_public_function_has_a_row() -> None:
    public = public_names(Path(motor_datasets.__file__).with_name("__init__.pyi"))
    elsewhere = {"Dataset", "load", "Split", "generate_dataset", "to_pandas", "to_torch", "to_torch_iterable"}
    assert public == {row.name for row in ROWS} | elsewhere
    with pytest.raises(ValueError, match="batch_size must be"):
        next(iter(to_torch_iterable(SHORT, 1, 0)))
