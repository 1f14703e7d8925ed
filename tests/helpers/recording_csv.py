"""Recordings as text, written in one place."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from motor_env import Recording

QUANTITIES = ("time_s", "voltage_v", "current_a", "speed_rad_s")


def csv_text(
    columns: Mapping[str, Any],
    *,
    form: str | Callable[[float], str] = repr,
    mark: str = ",",
    decimal: str = ".",
) -> str:
    """A header and rows.

    Args:
        columns: numbers by header.
        form: of a number, as for `format`; `repr` keeps every bit.
        mark: between cells.
        decimal: point or comma.
    """
    write = form if callable(form) else f"{{:{form}}}".format
    table = np.column_stack([np.asarray(column, dtype=np.float64) for column in columns.values()])
    rows = (mark.join(map(write, row)).replace(".", decimal) for row in table.tolist())
    return "\n".join([mark.join(columns), *rows]) + "\n"


def write_csv(path: Path, columns: Mapping[str, Any], **options: Any) -> Path:
    """Write a recording of columns by header, as `csv_text` does."""
    path.write_text(csv_text(columns, **options), encoding="utf-8")
    return path


def write_recording(path: Path, recording: Recording) -> str:
    """Write what a recording has: time, voltage, current, speed; returns the path as a command line takes it."""
    columns = {name: getattr(recording, name) for name in QUANTITIES}
    return str(write_csv(path, {name: values for name, values in columns.items() if values is not None}))
