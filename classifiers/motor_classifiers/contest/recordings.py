"""The task `recordings` of motor-bench: verdicts on real recordings that the user brings, with their truth."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from motor_classifiers.scoring.metrics import interval, resampling_weights
from motor_classifiers.scoring.task import mean_figures
from motor_env.errors import InputError
from motor_env.files import LARGEST_TABLE_BYTES, read_file, read_json

MOST_RECORDINGS = 20_000
COLUMNS = ("file", "motor", "verdict")
_SILENT = "unusable"


def score_recordings(truth: Path | str, said: Path | str) -> list[dict[str, Any]]:
    """Share of recordings with a wrong verdict, and of those without one, of each method.

    Intervals draw motors, each with all its recordings.

    Args:
        truth: CSV with the columns file, motor and verdict (healthy, bearing, winding, noise).
        said: JSON of `motor-classifiers predict --json` or `motor-env diagnose --json`: a list of objects with `file`
            and `verdict`; what stands under `model_based` is a second method.

    Returns:
        One row a method: `method`, `n_recordings`, `n_motors`, `wrong` with `low` and `high` (95 %), `silent`.

    Raises:
        InputError: a file cannot be read, or names a recording twice, or not all of them.
    """
    rows = _truth(Path(truth))
    motors = np.unique([row["motor"] for row in rows], return_inverse=True)[1]
    right = np.array([row["verdict"] for row in rows])
    weights = resampling_weights(len(rows), 0, groups=motors)
    counts = {"n_recordings": len(rows), "n_motors": int(motors.max()) + 1}
    scored = []
    for method, verdicts in _said(Path(said)).items():
        missing = [row["file"] for row in rows if row["file"] not in verdicts]
        if missing:
            raise InputError(
                f"{said}: has no verdict of {method} on {len(missing)} recordings, the first is {missing[0]}"
            )
        answers = np.array([verdicts[row["file"]] for row in rows])
        percent = interval(mean_figures((answers != right).astype(np.float64), weights))
        wrong = {name: end / 100.0 for name, end in zip(("wrong", "low", "high"), percent, strict=True)}
        scored.append({"method": method, **counts, **wrong, "silent": float((answers == _SILENT).mean())})
    return scored


def _truth(path: Path) -> list[dict[str, str]]:
    content = read_file(path, LARGEST_TABLE_BYTES)
    try:
        lines = csv.DictReader(io.StringIO(content.decode("utf-8"), newline=""))
        rows = [{name: str(row.get(name) or "").strip() for name in COLUMNS} for row in lines]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    if not rows or any(not value for row in rows for value in row.values()):
        raise InputError(f"{path}: must have the columns {', '.join(COLUMNS)} and a value in each row")
    if len(rows) > MOST_RECORDINGS:
        raise InputError(f"{path}: must name at most {MOST_RECORDINGS} recordings, got {len(rows)}")
    _require_once(path, (row["file"] for row in rows))
    return rows


def _said(path: Path) -> dict[str, dict[str, str]]:
    """Verdicts by method and file."""
    rows = read_json(path, LARGEST_TABLE_BYTES)
    try:
        _require_once(path, (str(row["file"]) for row in rows))
        given = {"method": {str(row["file"]): str(row.get("verdict", _SILENT)) for row in rows}}
        if all(row.get("model_based") for row in rows):
            given["model_based"] = {str(row["file"]): str(row["model_based"]["verdict"]) for row in rows}
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: must be a JSON list of objects with file and verdict ({error})") from None
    return given


def _require_once(path: Path, names: Iterable[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{path}: {name} stands in it twice")
        seen.add(name)
