"""The first fit of a record of a fleet: it chooses its terms by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.hypotheses import NAMES
from motor_env.diagnosis.running.drives import rms_volts
from motor_env.diagnosis.running.lessons import effective_speed, known_of
from motor_env.diagnosis.running.windows import averaged
from motor_env.errors import InputError
from motor_env.fitting.identify import identify_operation
from motor_env.fitting.recorded import at_terminals
from motor_env.fitting.starts.choice import NUISANCES, identify_best
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, recording_of
from motor_env.recordings.regime import taken_for
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit, Start, prepare

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
        """These as arguments of `motor_env.diagnose`."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def start(self, path: Path) -> Start:
        """The first start of a file, as it is fitted."""
        (part,) = chosen_starts(recording_of(path, self.columns), 1)
        return prepare(part, self.voltage_v, self.circuit)

    def log(self, path: Path) -> Recording:
        """A log, with neighbours averaged where it is long."""
        recording = at_terminals(recording_of(path, self.columns), self.voltage_v, self.circuit)
        return averaged(recording, len(recording.time_s) * recording.dt_s)


class First(NamedTuple):
    """The first fit of a record; `trouble` says why there is none.

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


def first_look(reading: Reading, path: Path) -> tuple[str, tuple[str, ...]]:
    """What a file is, start or operation, and how its columns were understood."""
    try:
        recording = recording_of(path, reading.columns)
        return taken_for(recording, reading.regime).regime, recording.columns
    except InputError:
        return "start", ()  # the first fit says why it cannot be read


def first_fit(reading: Reading, path: Path) -> First:
    """The first fit of a file, or why there is none."""
    try:
        if reading.regime == "start":
            fit = identify_best(reading.start(path), NUISANCES)
            reason = explain_unusable(fit)
            if reason is not None:
                return First(reason)
            return First("", fit.model, fit.quantity_names, tuple(fit.log_values.tolist()))
        log = reading.log(path)
        found = identify_operation([log])
    except REASONS as error:
        return First(str(error).removeprefix(f"{path}: "))
    if not found.record.seen.all() or found.r2_current is None:
        return First("the current tells no motor")
    return First(
        names=found.solution.names,
        quantities=NAMES,
        values=tuple(known_of(found.solution).tolist()),
        hold=found.record.hold,
        speed_rad_s=effective_speed(found),
        rms_volts=rms_volts(log),
        duration_s=len(log.time_s) * log.dt_s,
        dt_s=log.dt_s,
        peaks=found.record.peaks,
    )
