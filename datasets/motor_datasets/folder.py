"""Data sets written to a folder: files appear whole or not at all, and an interrupted generation can go on.

A note `unfinished.json` says what is being made; it goes when the manifest comes. On object storage a file is made
locally and then put.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from motor_datasets.card import data_card
from motor_datasets.generate import generate_arrays
from motor_datasets.layout import Plan, PlannedFile, make_plan
from motor_datasets.manifest import MANIFEST, Entry, Manifest, read_manifest, size_and_digest
from motor_datasets.parquet import to_table, write_table
from motor_datasets.remote import Folder, RemotePath, folder_of, whole_file
from motor_env.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipe_files import recipe_to_dict
from motor_env.simulation.recipes import Recipe

UNFINISHED = "unfinished.json"


def generate_dataset(
    recipe: Recipe,
    cases: int,
    seed: int,
    out: str | Path | RemotePath,
    *,
    workers: int = 1,
    resume: bool = False,
    on_progress: Callable[[int], object] = lambda _: None,
) -> Manifest:
    """Write a data set to a folder. The bytes do not depend on the workers, nor on interruptions.

    Args:
        recipe: what to draw from.
        cases: how many cases, those of the recipe's shifts aside.
        seed: the random seed.
        out: folder, or a URL for fsspec (`s3://bucket/prefix`); it must not exist, be empty, or (with `resume`) hold
            the unfinished same data set.
        workers: processes; inside `joblib.parallel_config(backend="dask")` those of that backend.
        resume: finish what an interrupted generation began.
        on_progress: called with the number of cases just written.

    Raises:
        ValueError: fewer than one case or worker, or a seed out of range.
        InputError: `out` holds something else or cannot be used, or a worker was killed.
    """
    require(workers >= 1, f"workers must be >= 1, got {workers}")
    plan = make_plan(recipe, cases, seed)
    folder = folder_of(out)
    if isinstance(folder, RemotePath) and not folder.shared:
        require(
            workers == 1, f"workers must be 1 for {folder}, which other processes do not see, got {workers}"
        )
    finished = _open_folder(folder, plan, resume=resume)
    if finished is not None:
        on_progress(plan.cases_of_all)
        return finished
    entries = {file.path: _whole_entry(folder, file) if resume else None for file in plan.files}
    for entry in entries.values():
        if entry is not None:
            on_progress(entry.rows)
    missing = [file for file in plan.files if entries[file.path] is None]
    for entry in _write_files(missing, folder, plan, workers):
        entries[entry.path] = entry
        on_progress(entry.rows)
    manifest = Manifest(recipe, seed, cases, tuple(entry for entry in entries.values() if entry is not None))
    _write_text(folder / "README.md", data_card(manifest))
    _write_text(folder / MANIFEST, manifest.as_text())
    (folder / UNFINISHED).unlink(missing_ok=True)
    return manifest


def _open_folder(out: Folder, plan: Plan, *, resume: bool) -> Manifest | None:
    """Make or reopen the folder of a data set; the manifest, if it is finished already.

    Raises:
        InputError: the folder holds something that is not overwritten.
    """
    note = out / UNFINISHED
    made = {"recipe": recipe_to_dict(plan.recipe), "seed": plan.seed, "cases": plan.cases}
    wanted = json.dumps(made) + "\n"
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        if not resume:
            hint = "add --resume to finish it" if note.is_file() else "give another folder, or remove it"
            raise InputError(f"{out} exists already and is not overwritten: {hint}")
        if (out / MANIFEST).is_file():
            manifest = read_manifest(out)
            if (manifest.recipe, manifest.seed, manifest.cases) != (plan.recipe, plan.seed, plan.cases):
                raise InputError(f"{out} holds another data set and is not overwritten: give another folder")
            note.unlink(missing_ok=True)
            return manifest
        # Killed before the note was whole: the folder holds nothing but its beginnings.
        names = {path.name for path in out.iterdir()}
        only_begun = names <= {"data", f".{UNFINISHED}.partial"} and not any((out / "data").glob("*"))
        if not only_begun and (not note.is_file() or note.read_text() != wanted):
            raise InputError(f"{out} holds something other than this data set unfinished, and is not touched")
        if isinstance(out, Path):
            for partial in out.rglob(".*.partial"):
                partial.unlink()
    (out / "data").mkdir(parents=True, exist_ok=True)
    _write_text(note, wanted)
    return None


def _write_text(path: Folder, text: str) -> None:
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(text.encode())
        stream.flush()
        os.fsync(stream.fileno())


def _whole_entry(folder: Folder, file: PlannedFile) -> Entry | None:
    """The file that an interrupted generation left whole; None if there is none."""
    path = folder / file.path
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream:
            rows = pq.read_metadata(stream).num_rows
    except pa.ArrowInvalid:
        return None
    return Entry(file.path, file.split, rows, *size_and_digest(path))


def _write_file(folder: Folder, file: PlannedFile, recipe: Recipe, seed: int) -> Entry:
    """Generate and write one file: all that a worker does."""
    own = recipe if file.shift is None else recipe.shifted(file.shift)
    cases = generate_arrays(own, seed, file.case_id(recipe, seed))
    target = folder / file.path
    try:
        with whole_file(target) as temporary:
            write_table(to_table(replace(cases, split=np.full(len(cases), file.split))), temporary)
            size, digest = size_and_digest(temporary)
    except OSError as error:
        why = (os.strerror(error.errno) if error.errno else str(error)).lower()
        raise InputError(f"{target} cannot be written: {why}; what is whole stays, resume it") from error
    return Entry(file.path, file.split, len(cases), size, digest)


def _write_files(files: list[PlannedFile], folder: Folder, plan: Plan, workers: int) -> Iterator[Entry]:
    if workers == 1:
        yield from (_write_file(folder, file, plan.recipe, plan.seed) for file in files)
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    pool: Any = Parallel(n_jobs=workers, return_as="generator_unordered")
    try:
        yield from pool(delayed(_write_file)(folder, file, plan.recipe, plan.seed) for file in files)
    except TerminatedWorkerError:
        raise InputError(
            f"a worker was killed (out of memory?); what is whole in {folder} stays: resume it"
        ) from None


def seconds_per_case(recipe: Recipe, seed: int) -> float:
    """Time to make and write one case here, measured on a thousand."""
    count = 1024
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.parquet"
        write_table(to_table(generate_arrays(recipe, seed, 8)), path)  # compiles, or loads what was compiled
        start = time.perf_counter()
        write_table(to_table(generate_arrays(recipe, seed, count)), path)
        return (time.perf_counter() - start) / count
