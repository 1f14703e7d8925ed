"""From files to diagnoses: the steps of `motor-env diagnose`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.console import ExitStatus
from motor_env.common.errors import InputError, require_options
from motor_env.common.files import write_text
from motor_env.diagnosis.commission import commission
from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import read_recording
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.motor.data_sheet import Motor, load_motor

_LONGEST_NAME = 50  # of a page: a file's name has 255 bytes


@dataclass(frozen=True, slots=True)
class Outcome:
    """Diagnosis of one file, or the reason why there is none."""

    path: Path
    diagnosis: Diagnosis | None = None
    error: str | None = None
    is_bug: bool = False

    @property
    def status(self) -> ExitStatus:
        """Exit status of this file alone."""
        if self.diagnosis is None or self.is_bug:
            return ExitStatus.BUG if self.is_bug else ExitStatus.BAD_INPUT
        return self.diagnosis.verdict.status

    def as_json(self) -> dict[str, Any]:
        """Return one JSON object; an unreadable file is unusable, with its error."""
        unread: dict[str, Any] = {
            "file": str(self.path),
            "verdict": "unusable",
            "error": self.error,
            "pieces": [],
        }
        return unread if self.diagnosis is None else self.diagnosis.to_json()


def diagnose_files(
    files: Sequence[Path],
    *,
    motor: str | None = None,
    healthy: Sequence[Path] = (),
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    out: Path | None = None,
    columns: Sequence[ColumnChoice] = (),
    periods_per_turn: float | None = None,
    progress: Callable[[Path], None] = lambda path: None,
    **options: Any,
) -> list[Outcome]:
    """Diagnose each file; one that cannot be read does not stop the others.

    Args:
        files: recordings.
        motor: motor file, or name of a catalogue motor.
        healthy: healthy recordings of the same motor.
        false_alarm_rate: per healthy recording.
        out: folder for one HTML page a recording; None for no pages.
        columns: columns named by the user.
        periods_per_turn: of the commutation ripple, for the true speed.
        progress: called with each file before it is read.
        options: of `diagnose`.

    Raises:
        InputError: the motor, a healthy recording or the folder cannot be used.
    """
    require_options(false_alarm_rate=false_alarm_rate, ripple_periods_per_turn=periods_per_turn)
    known = None if motor is None else load_motor(motor)
    if healthy:
        if known is not None and options.get("voltage_v") is None:
            options["voltage_v"] = known.nominal_voltage_v
        known = _learn_motor(healthy, known, columns, options)
    options |= {"false_alarm_rate": false_alarm_rate, "periods_per_turn": periods_per_turn}
    outcomes: list[Outcome] = []
    for number, path in enumerate(files, 1):
        progress(path)
        outcome, html = Outcome(path), ""
        try:
            judged = diagnose(read_recording(path, columns), known, **options)
            outcome = Outcome(path, judged)
            html = "" if out is None else judged.page()
        except Exception as error:  # noqa: BLE001  # whatever it is, it is said, and the others keep their verdicts
            sentence, is_bug = explain_failure(
                path, error, "judged" if outcome.diagnosis is None else "drawn"
            )
            outcome = replace(outcome, error=sentence, is_bug=is_bug)
        if out is not None and html:
            write_text(page_path(path, out, number), html)
        outcomes.append(outcome)
    return outcomes


def _learn_motor(
    healthy: Sequence[Path], motor: Motor | None, columns: Sequence[ColumnChoice], options: dict[str, Any]
) -> Motor:
    """Commission a motor on healthy recordings, with the torque constant of another motor file."""
    constant = None if motor is None else float(np.mean(motor.parameters.torque_constant_n_m_per_a))
    shared = {name: options[name] for name in ("voltage_v", "circuit", "regime") if name in options}
    return commission(
        healthy, "this motor", columns, word="recording", fewest=1, constant=constant, **shared
    ).motor


def page_path(recording: Path, folder: Path, number: int) -> Path:
    """Return the path of the page of the n-th recording."""
    return folder / f"{number:03d}-{recording.name.replace('.', '-')[:_LONGEST_NAME]}.html"


def explain_failure(path: Path, error: Exception, word: str = "judged") -> tuple[str, bool]:
    """Explain in a sentence why a file has no verdict, and whether that is a bug."""
    if isinstance(error, InputError):
        return str(error), False
    words = " ".join(str(error).split())
    if isinstance(error, (ValueError, ArithmeticError, LookupError)):  # values far from any motor
        return f"{path}: cannot be {word} ({words})", False
    traceback.print_exception(error)
    return f"{path}: cannot be {word} ({type(error).__name__}: {words})", True
