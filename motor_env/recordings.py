"""Reading recordings of real motors: time and current, and voltage and speed where they were measured."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motor_env.console import InputError
from motor_env.parameters import FloatArray

LARGEST_FILE_BYTES = 500_000_000
FEWEST_SAMPLES = 20
COLUMNS = ("time_s", "current_a", "voltage_v", "speed_rad_s")


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording, in SI units, on an even time axis.

    Attributes:
        path: where it was read from.
        time_s: shape (n_samples,), evenly spaced.
        current_a: shape (n_samples,).
        voltage_v: shape (n_samples,), or None where it was not recorded.
        speed_rad_s: shape (n_samples,), or None where it was not recorded.
        columns: how each column was understood, sentences for the user.
    """

    path: Path
    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray | None = None
    speed_rad_s: FloatArray | None = None
    columns: tuple[str, ...] = ()

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))


def read_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises:
        InputError: the file is missing, empty, binary, lacks a column, or holds a value that is no finite number, or a
            time axis that does not rise.
    """
    path = Path(path)
    rows = _rows(path)
    header = [name.strip() for name in rows[0][1]]
    index = _column_index(path, header, rows[0][0])
    table = _numbers(path, rows[1:], index)
    return _recording(
        path, {name: table[:, k] for k, name in enumerate(index)}, [line for line, _ in rows[1:]]
    )


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, each with its line number."""
    text = _text(path)
    try:
        reader = csv.reader(text.splitlines())
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: is not a table of comma-separated values ({error})") from None
    if not rows:
        raise InputError(f"{path}: is empty")
    return rows


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise InputError(f"{path}: is larger than {LARGEST_FILE_BYTES // 1_000_000} MB")
        text = path.read_bytes().decode("utf-8-sig")
        if "\0" in text:
            raise InputError(f"{path}: is not text (it holds bytes of value 0)")
        return text
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({(error.strerror or str(error)).lower()})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text (byte {error.start} is not UTF-8)") from None


def _column_index(path: Path, header: list[str], line: int) -> dict[str, int]:
    for name in ("time_s", "current_a"):
        if name not in header:
            found = ", ".join(repr(cell[:30]) for cell in header[:8])
            raise InputError(f"{path}, line {line}: the column {name} is missing, found {found}")
    twice = [name for name in COLUMNS if header.count(name) > 1]
    if twice:
        raise InputError(f"{path}, line {line}: the column {twice[0]} stands there twice")
    return {name: header.index(name) for name in COLUMNS if name in header}


def _numbers(path: Path, rows: list[tuple[int, list[str]]], index: dict[str, int]) -> FloatArray:
    table = np.empty((len(rows), len(index)))
    for n, (line, row) in enumerate(rows):
        for k, (name, column) in enumerate(index.items()):
            if column >= len(row):
                raise InputError(f"{path}, line {line}: the column {name} has no value")
            table[n, k] = _number(path, line, name, row[column])
    return table


def _number(path: Path, line: int, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise InputError(
            f"{path}, line {line}: the column {name} must hold numbers, got {cell[:40]!r}"
        ) from None
    if not math.isfinite(value):
        raise InputError(
            f"{path}, line {line}: the column {name} must hold finite numbers, got {cell[:40]!r}"
        )
    return value


def _recording(path: Path, columns: dict[str, FloatArray], lines: list[int]) -> Recording:
    """Check the time axis and even it out."""
    time = columns["time_s"]
    if len(time) < FEWEST_SAMPLES:
        raise InputError(f"{path}: must hold at least {FEWEST_SAMPLES} samples, got {len(time)}")
    steps = np.diff(time)
    if not (steps > 0.0).all():
        bad = int(np.argmax(steps <= 0.0)) + 1
        raise InputError(
            f"{path}, line {lines[bad]}: the column time_s must rise, got {time[bad]:.10g} after {time[bad - 1]:.10g}"
        )
    even, evened = _even(time)
    if evened:
        columns = {name: np.interp(even, time, values) for name, values in columns.items()}
    return Recording(
        path=path,
        time_s=even,
        current_a=columns["current_a"],
        voltage_v=columns.get("voltage_v"),
        speed_rad_s=columns.get("speed_rad_s"),
    )


def _even(time_s: NDArray[np.float64]) -> tuple[FloatArray, bool]:
    """An even time axis at the median step, and whether the samples must be interpolated to lie on it."""
    steps = np.diff(time_s)
    line = np.linspace(time_s[0], time_s[-1], len(time_s))
    step = line[1] - line[0]
    if np.max(np.abs(line - time_s)) < 0.5 * step:
        return line, bool(np.max(np.abs(line - time_s)) > 0.02 * step)
    step = float(np.median(steps))
    count = int(min((time_s[-1] - time_s[0]) / step, 4 * len(time_s)))
    return np.linspace(time_s[0], time_s[-1], count + 1), True
