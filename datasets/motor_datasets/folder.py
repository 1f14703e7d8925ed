"""Data sets in a folder: files appear whole or not at all, and an interrupted generation can go on.

A note `unfinished.json` describes the work until the manifest replaces it. Files for object storage are made locally
first.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from motor_datasets.arrays import at_least_one
from motor_datasets.card import croissant, data_card
from motor_datasets.generate import Plan, PlannedFile, generate_arrays, make_plan
from motor_datasets.manifest import (
    MANIFEST,
    Entry,
    Folder,
    Manifest,
    defect,
    folder_of,
    read_manifest,
    whole_file,
)
from motor_datasets.parquet import to_table, write_table
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_DATA_BYTES, end_with_parent, read_file
from motor_env.motor.parameters import require
from motor_env.simulation.named_recipes import recipe_to_dict
from motor_env.simulation.recipes import Recipe

UNFINISHED = "unfinished.json"
_LEAST_SHARE = 0.3  # of the uncompressed size; the named recipes' files have 0.39 to 0.82 of it


def generate_dataset(
    recipe: Recipe,
    cases: int,
    seed: int,
    out: str | Folder,
    *,
    workers: int = 1,
    resume: bool = False,
    on_progress: Callable[[int], object] = lambda _: None,
) -> Manifest:
    """Write a data set to a folder. The bytes do not depend on the workers, nor on interruptions.

    Args:
        recipe: distribution of the cases.
        cases: their number, without those of the recipe's shifts.
        seed: the random seed.
        out: folder, or a URL for fsspec (`s3://bucket/prefix`); new, empty, or (with `resume`) the same unfinished
            data set.
        workers: processes, or those of `joblib.parallel_config(backend="dask")`.
        resume: continue an interrupted generation.
        on_progress: called with the number of new cases.

    Raises:
        ValueError: fewer than one case or worker, or a seed out of range.
        InputError: `out` cannot be used or holds other files, its disk is too small, or a worker was killed.
    """
    workers = at_least_one("workers", workers)
    plan = make_plan(recipe, cases, seed)
    folder = folder_of(out)
    alone = not isinstance(folder, Path) and folder.protocol == "memory"
    require(
        workers == 1 or not alone,
        f"workers must be 1 for {folder}, which other processes do not see, got {workers}",
    )
    entries = _open_folder(folder, plan, resume=resume)
    for entry in entries.values():
        on_progress(entry.rows)
    missing = [file for file in plan.files if file.path not in entries]
    if missing or not (folder / MANIFEST).is_file():
        _check_space(folder, plan.bytes_uncompressed * len(missing) / len(plan.files))
        _make_files(missing, entries, folder, plan, workers=workers, on_progress=on_progress)
    (folder / UNFINISHED).unlink(missing_ok=True)
    return Manifest(recipe, plan.seed, plan.cases, tuple(entries[file.path] for file in plan.files))


def _check_space(folder: Folder, uncompressed: float) -> None:
    if not isinstance(folder, Path):
        return
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if _LEAST_SHARE * uncompressed > free:
        raise InputError(
            f"{folder}: {uncompressed / 1e9:,.1f} GB of data do not fit onto its disk, which has"
            f" {free / 1e9:,.1f} GB left"
        )


def _make_files(
    missing: list[PlannedFile],
    entries: dict[str, Entry],
    folder: Folder,
    plan: Plan,
    *,
    workers: int,
    on_progress: Callable[[int], object],
) -> None:
    if isinstance(folder, Path):  # object storage has no folders
        (folder / "data").mkdir(parents=True, exist_ok=True)
    due = 0
    try:
        for entry in chain([None], _write_files(missing, folder, plan, workers)):
            if entry is not None:
                entries[entry.path] = entry
            if len(entries) >= due:  # seldom where there are many: a storage writes the note whole each time
                _write_text(folder / UNFINISHED, _note(plan, entries.values()))
                due = len(entries) + 1 + len(entries) // 32
            if entry is not None:
                on_progress(entry.rows)
    except BaseException:
        _remove_partial_files(folder)
        raise
    manifest = Manifest(plan.recipe, plan.seed, plan.cases, tuple(entries[file.path] for file in plan.files))
    _write_text(folder / "README.md", data_card(manifest))
    _write_text(folder / "croissant.json", croissant(manifest))
    _write_text(folder / MANIFEST, manifest.as_text())


def _open_folder(out: Folder, plan: Plan, *, resume: bool) -> dict[str, Entry]:
    """Return the whole files of an interrupted generation, by name."""
    note = out / UNFINISHED
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return {}
    if not resume:
        hint = "add --resume to finish it" if note.is_file() else "give another folder, or remove it"
        raise InputError(f"{out} exists already and is not overwritten: {hint}")
    if (out / MANIFEST).is_file():
        manifest = read_manifest(out)
        if (manifest.recipe, manifest.seed, manifest.cases) != (plan.recipe, plan.seed, plan.cases):
            raise InputError(f"{out} holds another data set and is not overwritten: give another folder")
        recorded = list(manifest.files)
    else:
        # Killed before the note was whole: the folder holds nothing but its beginnings.
        names = {path.name for path in out.iterdir()}
        only_begun = names <= {"data", f".{UNFINISHED}.partial"} and not any((out / "data").glob("*"))
        text = read_file(note, LARGEST_DATA_BYTES).decode(errors="replace") if note.is_file() else ""
        if not only_begun and not text.startswith(_note(plan)):
            raise InputError(f"{out} holds something other than this data set unfinished, and is not touched")
        recorded = list(_recorded(text))
        _remove_partial_files(out)
    planned = {file.path for file in plan.files}
    return {entry.path: entry for entry in recorded if entry.path in planned and not defect(out, entry)}


def _note(plan: Plan, entries: Iterable[Entry] = ()) -> str:
    made = {"recipe": recipe_to_dict(plan.recipe), "seed": plan.seed, "cases": plan.cases}
    return "".join(f"{json.dumps(line)}\n" for line in (made, *map(asdict, entries)))


def _recorded(note: str) -> Iterator[Entry]:
    """Yield the finished files of a note; skip damaged lines."""
    for line in note.splitlines()[1:]:
        with suppress(TypeError, ValueError):
            yield Entry(**json.loads(line))


def _remove_partial_files(folder: Folder) -> None:
    if isinstance(folder, Path):
        for partial in folder.rglob(".*.partial"):
            partial.unlink(missing_ok=True)


def _write_text(path: Folder, text: str) -> None:
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(text.encode())
        stream.flush()
        os.fsync(stream.fileno())


def _write_file(folder: Folder, file: PlannedFile, recipe: Recipe, seed: int) -> Entry:
    """Generate and write one file, the work of a worker."""
    own = recipe if file.shift is None else recipe.shifted(file.shift)
    cases = generate_arrays(own, seed, file.case_id(recipe, seed))
    target = folder / file.path
    try:
        with whole_file(target) as temporary:
            write_table(to_table(replace(cases, split=np.full(len(cases), file.split))), temporary)
            content = temporary.read_bytes()
    except OSError as error:
        why = (os.strerror(error.errno) if error.errno else str(error)).lower()
        raise InputError(f"{target} cannot be written: {why}; what is whole stays, resume it") from error
    return Entry(file.path, file.split, len(cases), len(content), hashlib.sha256(content).hexdigest())


def _write_files(files: list[PlannedFile], folder: Folder, plan: Plan, workers: int) -> Iterator[Entry]:
    if workers == 1:
        yield from (_write_file(folder, file, plan.recipe, plan.seed) for file in files)
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError
    from joblib.parallel import LokyBackend, get_active_backend

    # The workers of a cluster are not ours to end.
    ours = isinstance(get_active_backend()[0], LokyBackend)
    options: dict[str, Any] = {"initializer": end_with_parent} if ours else {}
    pool: Any = Parallel(n_jobs=workers, return_as="generator_unordered", **options)
    try:
        yield from pool(delayed(_write_file)(folder, file, plan.recipe, plan.seed) for file in files)
    except TerminatedWorkerError:
        raise InputError(
            f"a worker was killed (out of memory?); what is whole in {folder} stays: resume it"
        ) from None


def seconds_per_case(recipe: Recipe, seed: int) -> float:
    """Measure the seconds that a case takes on this machine."""
    count = 1024
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.parquet"
        write_table(to_table(generate_arrays(recipe, seed, 8)), path)  # compiles, or loads what was compiled
        start = time.perf_counter()
        write_table(to_table(generate_arrays(recipe, seed, count)), path)
        return (time.perf_counter() - start) / count
