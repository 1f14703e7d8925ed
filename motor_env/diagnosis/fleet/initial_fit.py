"""Fit each record of a fleet by itself, and keep these fits in a file so that a stopped run goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import IO, Any, NamedTuple

from pydantic import TypeAdapter

from motor_env.common.errors import InputError
from motor_env.common.files import read_file
from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.estimation.operation_fit import identify_operation
from motor_env.diagnosis.estimation.preprocessing import at_terminals
from motor_env.diagnosis.estimation.starts.start_identification import NUISANCES, identify_best
from motor_env.diagnosis.operation.operating_conditions import rms_volts
from motor_env.diagnosis.operation.window_baseline import effective_speed, known_of
from motor_env.diagnosis.operation.windows import averaged
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import Recording, recording_of
from motor_env.diagnosis.readers.regime import taken_for
from motor_env.diagnosis.readers.start import Circuit, Start, chosen_starts, prepare
from motor_env.diagnosis.verdict.hypotheses import NAMES

REASONS = (ValueError, ArithmeticError, LookupError)
"""What a fit raises on values far from any motor."""


@dataclass(frozen=True, slots=True)
class Reading:
    """How the records are read.

    Attributes:
        columns: named by the user.
        regime: start, operation, or auto.
        voltage_v: level of the supply where none was recorded.
        circuit: what is known of the measuring circuit.
    """

    columns: Sequence[ColumnChoice] = ()
    regime: str = "auto"
    voltage_v: float | None = None
    circuit: Circuit | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Return these as arguments of `motor_env.diagnose`."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def start(self, path: Path) -> Start:
        """Read the first start of a file."""
        (part,) = chosen_starts(recording_of(path, self.columns), 1)
        return prepare(part, self.voltage_v, self.circuit)

    def log(self, path: Path) -> Recording:
        """Read a log; average neighbours where it is long."""
        recording = at_terminals(recording_of(path, self.columns), self.voltage_v, self.circuit)
        return averaged(recording, len(recording.time_s) * recording.dt_s)


class InitialFit(NamedTuple):
    """First fit of a record; `trouble` says why there is none.

    Attributes:
        names: of the terms.
        quantities: that it tells.
        values: physical values, or the quantities' logarithms of a start.
        hold: of the voltage.
        speed_rad_s: effective speed.
        rms_volts: effective voltage.
        duration_s, dt_s: of the record, and of its samples.
        peaks: largest voltage, current and speed.
    """

    trouble: str = ""
    names: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    hold: str = "held"
    speed_rad_s: float = 0.0
    rms_volts: float = 0.0
    duration_s: float = 0.0
    dt_s: float = 0.0
    peaks: tuple[float, float, float] = (1.0, 1.0, 1.0)


def classify_record(reading: Reading, path: Path) -> tuple[str, tuple[str, ...]]:
    """Say whether a file is a start or operation, and how its columns were understood."""
    try:
        recording = recording_of(path, reading.columns)
        return taken_for(recording, reading.regime).regime, recording.columns
    except InputError:
        return "start", ()  # the first fit says why it cannot be read


def fit_record(reading: Reading, path: Path) -> InitialFit:
    """Fit a file by itself."""
    try:
        if reading.regime == "start":
            fit = identify_best(reading.start(path), NUISANCES)
            reason = explain_unusable(fit)
            if reason is not None:
                return InitialFit(reason)
            return InitialFit("", fit.model, fit.quantity_names, tuple(fit.log_values.tolist()))
        log = reading.log(path)
        fitted = identify_operation([log])
    except REASONS as error:
        return InitialFit(str(error).removeprefix(f"{path}: "))
    if not fitted.record.seen.all() or fitted.r2_current is None:
        return InitialFit("the current tells no motor")
    return InitialFit(
        names=fitted.solution.names,
        quantities=NAMES,
        values=tuple(known_of(fitted.solution).tolist()),
        hold=fitted.record.hold,
        speed_rad_s=effective_speed(fitted),
        rms_volts=rms_volts(log),
        duration_s=len(log.time_s) * log.dt_s,
        dt_s=log.dt_s,
        peaks=fitted.record.peaks,
    )


_MARK = "motor-env fleet"
_LARGEST_BYTES = 2_000_000_000
_FIRST: TypeAdapter[InitialFit] = TypeAdapter(InitialFit)


class FitCache:
    """First fits by file, in memory and in a file of JSON lines.

    A fit counts as long as its file has the same size and time, and is read in the same way.

    Args:
        path: of the file; None for memory alone.
        reading: how the records are read.

    Raises:
        InputError: the file is another's, or damaged before its last line.
    """

    def __init__(self, path: Path | None, reading: Reading) -> None:
        self.path = path
        self.reading = sha256(repr(reading).encode()).hexdigest()[:16]
        self.found: dict[str, InitialFit] = {}
        self.file: IO[str] | None = None
        if path is not None and path.exists():
            self._read(path)

    def _read(self, path: Path) -> None:
        content = bytes(read_file(path, _LARGEST_BYTES))
        *lines, last = content.split(b"\n")
        head = self._head().encode()
        # The first line may have been cut short by the end of the process, too.
        if (lines[0] if lines else head[: len(last)]) != (head if lines else last):
            raise InputError(f"{path}: holds no fits of records that were read like these; give another file")
        for number, line in enumerate(lines[1:], 2):
            try:
                row = json.loads(line)
                self.found[str(row["record"])] = _FIRST.validate_python(row["first"])
            except (ValueError, LookupError, TypeError, RecursionError):
                raise InputError(f"{path}: line {number} is no kept fit; give another file") from None
        if last:
            os.truncate(path, len(content) - len(last))

    def _head(self) -> str:
        return json.dumps({"kept by": _MARK, "reading": self.reading})

    def __enter__(self) -> FitCache:
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.file = self.path.open("a", encoding="utf-8")
            if not self.found and self.path.stat().st_size == 0:
                print(self._head(), file=self.file, flush=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.file is not None:
            self.file.close()

    def __contains__(self, path: Path) -> bool:
        return _record(path) in self.found

    def __getitem__(self, path: Path) -> InitialFit:
        return self.found[_record(path)]

    def add(self, path: Path, first: InitialFit) -> None:
        """Keep a fit."""
        self.found[_record(path)] = first
        if self.file is not None:
            row = {"record": _record(path), "first": first._asdict()}
            print(json.dumps(row), file=self.file, flush=True)


def _record(path: Path) -> str:
    """Name a file by path, size and time."""
    try:
        stat = path.stat()
    except OSError:
        return str(path)
    return f"{path} {stat.st_size} {stat.st_mtime_ns}"
