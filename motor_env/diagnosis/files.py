"""From files to diagnoses: the steps of `motor-env diagnose`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.diagnosis import report
from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE, Diagnosis, Verdict
from motor_env.diagnosis.diagnose import diagnose, unusable_reason
from motor_env.diagnosis.healthy_motor import disagreement, fit_healthy, learn_reference, odd_one_out
from motor_env.diagnosis.page import page
from motor_env.errors import InputError
from motor_env.files import write_text
from motor_env.identification.identify import Identified
from motor_env.motor.data_sheet import MotorFile, StartReference, load_motor
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit

_LONGEST_NAME = 50  # of a page: a file's name has 255 bytes


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one file: a diagnosis, or the sentence why it could not be read."""

    path: Path
    diagnosis: Diagnosis | None
    error: str | None = None
    periods_per_turn: float | None = None
    is_bug: bool = False

    def as_json(self) -> dict[str, Any]:
        """One object; a file that could not be read has the verdict unusable, and the error."""
        if self.diagnosis is not None:
            return report.as_json(self.diagnosis, self.periods_per_turn)
        return {
            "file": str(self.path),
            "verdict": "unusable",
            "severity": None,
            "confidence": None,
            "parameters": {},
            "r2_current": None,
            "error": self.error,
        }

    def as_text(self, *, verbose: bool = False) -> str:
        """What a maintenance engineer reads; empty for a file that could not be read."""
        if self.diagnosis is None:
            return ""
        return report.as_text(self.diagnosis, self.periods_per_turn, verbose=verbose)


def fit_files(
    paths: Sequence[Path],
    word: str,
    columns: Sequence[ColumnChoice] = (),
    *,
    fewest: int = 1,
    start: int | None = None,
    **options: Any,
) -> list[Identified]:
    """Fit the healthy starts of files as `fit_healthy` does; a file may hold several.

    Raises:
        InputError: one of them cannot be read or used, or no motor explains it; they are fewer than `fewest`, or hold
            different columns. `word` is what the user calls them.
    """
    starts = [part for path in paths for part in _healthy_starts(path, word, columns, start)]
    if len(starts) < fewest:
        raise InputError(f"commissioning needs at least {fewest} healthy starts, got {len(starts)}")
    try:
        fits = fit_healthy(starts, **options)
    except UnusableError as error:
        raise InputError(f"a healthy {word} cannot be used: {error}") from None
    if len({fit.quantity_names for fit in fits}) > 1:
        raise InputError(f"the healthy {word}s hold different columns; give such that agree")
    for number, part in enumerate(starts):
        reason = unusable_reason(fits[number]) or odd_one_out(fits, number)
        if reason is not None:
            raise InputError(f"{part.path}: a healthy {word} cannot be used: {reason}")
    reason = disagreement(fits)
    if reason is not None:
        raise InputError(f"the healthy {word}s cannot be used: {reason}")
    return fits


def _healthy_starts(
    path: Path, word: str, columns: Sequence[ColumnChoice], start: int | None
) -> list[Recording]:
    try:
        return chosen_starts(read_recording(path, columns), start)
    except UnusableError as error:
        raise InputError(f"{path}: a healthy {word} cannot be used: {error}") from None


def _learn(
    healthy: Sequence[Path], motor: MotorFile | None, voltage_v: float | None, **options: Any
) -> StartReference:
    """Reference from healthy recordings; what they do not tell is the motor's."""
    if voltage_v is None and motor is not None:
        voltage_v = motor.nominal_voltage_v
    constant = None if motor is None else float(np.mean(motor.parameters.torque_constant_n_m_per_a))
    return learn_reference(fit_files(healthy, "recording", voltage_v=voltage_v, constant=constant, **options))


def diagnose_files(
    files: Sequence[Path],
    *,
    motor: str | None = None,
    healthy: Sequence[Path] = (),
    voltage_v: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    out: Path | None = None,
    columns: Sequence[ColumnChoice] = (),
    circuit: Circuit | None = None,
    start: int | None = None,
    periods_per_turn: float | None = None,
    temperature_c: float | None = None,
    progress: Callable[[Path], None] = lambda path: None,
) -> list[Outcome]:
    """Diagnose each start of each file; one that cannot be read does not stop the others.

    Args:
        files: recordings.
        motor: motor file, or name of a catalogue motor.
        healthy: healthy recordings of the same motor.
        voltage_v: level of the supply, for recordings without a voltage.
        false_alarm_rate: per healthy recording.
        out: folder for one HTML page a start; none are written without it.
        columns: columns named by the user.
        circuit: what is known of the measuring circuit.
        start: number of the start in files that hold several; all of them unless given.
        periods_per_turn: periods of the commutation ripple in a turn, for the true speed.
        temperature_c: of the motor, where measured.
        progress: told each file before it is read.

    Raises:
        InputError: the motor, a healthy recording or the folder cannot be used.
    """
    if not files:
        raise InputError("give at least one recording")
    if not 0.0 < false_alarm_rate < 0.5:
        raise InputError(f"false-alarm-rate must lie between 0 and 0.5, got {false_alarm_rate:g}")
    if voltage_v is not None and not 0.0 < voltage_v < float("inf"):
        raise InputError(f"voltage must be > 0, got {voltage_v:g}")
    loaded = None if motor is None else load_motor(motor)
    if periods_per_turn is not None and not 0.0 < periods_per_turn < float("inf"):
        raise InputError(f"ripple-periods-per-turn must be > 0, got {periods_per_turn:g}")
    learned = _learn(healthy, loaded, voltage_v, columns=columns, circuit=circuit) if healthy else None
    from_starts = learned is not None or (loaded is not None and loaded.reference is not None)
    outcomes: list[Outcome] = []

    def judged(recording: Recording) -> Outcome:
        diagnosis = diagnose(
            recording,
            loaded,
            learned,
            voltage_v=voltage_v,
            false_alarm_rate=false_alarm_rate,
            circuit=circuit,
            temperature_c=temperature_c,
        )
        return Outcome(recording.path, diagnosis, None, periods_per_turn)

    for path in files:
        progress(path)
        try:
            recording = read_recording(path, columns)
            parts = chosen_starts(recording, start, also_work=not from_starts)
        except UnusableError as error:
            outcomes.append(Outcome(path, Diagnosis(recording, Verdict.UNUSABLE, (str(error),))))
            continue
        except Exception as error:  # noqa: BLE001  # whatever it is, it is said, and the others keep their verdicts
            outcomes.append(_failure(path, error))
            continue
        for part in parts:
            try:
                outcomes.append(judged(part))
            except Exception as error:  # noqa: BLE001  # the same
                outcomes.append(_failure(part.path, error))
                continue
            if out is not None:
                page_path = picture_of(part.path, out, len(outcomes)).with_suffix(".html")
                outcomes[-1] = _with_page(outcomes[-1], page_path)
    return outcomes


def _failure(path: Path, error: Exception) -> Outcome:
    sentence, is_bug = why_not(path, error)
    return Outcome(path, None, sentence, is_bug=is_bug)


def _with_page(outcome: Outcome, path: Path) -> Outcome:
    """Write its page; a verdict without one is better than none.

    Raises:
        InputError: the page cannot be written.
    """
    try:
        if outcome.diagnosis is not None:
            write_text(path, page(outcome.diagnosis, outcome.periods_per_turn))
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001  # values that cannot be drawn
        sentence, is_bug = why_not(outcome.path, error, "drawn")
        return replace(outcome, error=sentence, is_bug=is_bug)
    return outcome


def picture_of(recording: Path, folder: Path, number: int) -> Path:
    """Where the picture of the n-th recording goes."""
    return folder / f"{number:03d}-{recording.name.replace('.', '-')[:_LONGEST_NAME]}.png"


def why_not(path: Path, error: Exception, word: str = "judged") -> tuple[str, bool]:
    """What is said of a file that cannot be read, on which the numerics give up, or which shows a bug: true then."""
    if isinstance(error, InputError):
        return str(error), False
    words = " ".join(str(error).split())
    if isinstance(error, (ValueError, ArithmeticError, LookupError)):  # values far from any motor
        return f"{path}: cannot be {word} ({words})", False
    traceback.print_exception(error)
    return f"{path}: cannot be {word} ({type(error).__name__}: {words})", True
