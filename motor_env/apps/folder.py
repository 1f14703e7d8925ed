"""Recordings of one motor in a folder: a verdict on each as it appears, and a trend of its starts at the end."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from motor_env.common.console import ExitStatus, json_text, printable, worst
from motor_env.common.errors import InputError
from motor_env.diagnosis.file_verdicts import Outcome, diagnose_files
from motor_env.diagnosis.prognosis.trend_report import DateSource, Trends, date_of, trend
from motor_env.diagnosis.readers.tables import ENDINGS
from motor_env.motor.data_sheet import load_motor

_FEWEST_STARTS = 3
_PAUSE_S, _PAUSES = 0.5, 4  # through which a file must stand still


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """Return the files, and a folder's files with endings of recordings, by name.

    Raises:
        InputError: there is none.
    """
    found = [file for path in paths for file in (_files(path) if path.is_dir() else [path])]
    if not found:
        raise InputError(f"the folder holds no recording: no file that ends with {', '.join(ENDINGS)}")
    return found


def _files(folder: Path) -> list[Path]:
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in ENDINGS and not file.name.startswith(".") and file.is_file()
    )


def trend_of(outcomes: Sequence[Outcome], voltage_v: float | None = None, **reading: Any) -> Trends | None:
    """Find the trends of the starts, by the dates in their names, else in their order; None without any.

    Args:
        outcomes: of one motor's recordings, in the order of time.
        voltage_v: level of the supply where none was recorded.
        reading: of `trend`: how the files are read.
    """
    starts = [
        outcome.path
        for outcome in outcomes
        if outcome.path.exists()  # else it is gone since
        and outcome.diagnosis is not None
        and outcome.diagnosis.taken.regime == "start"
        and len(outcome.diagnosis.pieces) == 1
        and outcome.diagnosis.verdict.status in (ExitStatus.HEALTHY, ExitStatus.FAULT)
    ]
    date: DateSource = "order" if None in [date_of(path.name) for path in starts] else "name"
    if len(starts) >= _FEWEST_STARTS:
        with suppress(InputError):
            return trend(starts, voltage_v=voltage_v, date=date, **reading)
    return None


def appearing(folder: Path, *, follow: bool, sleep: Callable[[float], None] = time.sleep) -> Iterator[Path]:
    """Yield the recordings of a folder; with `follow` those that appear or change, too, once they stand still."""
    stood: dict[Path, tuple[tuple[int, int], int]] = {}
    while True:
        for path in _files(folder):
            with suppress(FileNotFoundError):  # it is gone again
                now = path.stat()
                stamp = (now.st_size, now.st_mtime_ns)
                before, pauses = stood.get(path, (stamp, -1))
                stood[path] = (stamp, pauses + 1 if stamp == before else 0)
                if stood[path][1] == follow * _PAUSES:
                    yield path
        if not follow:
            return
        sleep(_PAUSE_S)


def watch_folder(motor: Path, folder: Path, *, follow: bool) -> int:
    """Print a verdict on each recording as a line of JSON, and the trends at the end.

    Raises:
        InputError: the motor cannot be used.
    """
    known = load_motor(motor)
    outcomes: dict[Path, Outcome] = {}
    with suppress(KeyboardInterrupt):  # the usual end of a watch
        for path in appearing(folder, follow=follow):
            (outcomes[path],) = diagnose_files([path], motor=str(motor))
            _print(_event(outcomes[path]))
    found = trend_of([*outcomes.values()], known.nominal_voltage_v)
    for each in () if found is None else found.to_json():
        _print(
            {
                "event": "trend",
                "quantity": each["quantity"],
                "state": each["state"],
                "reason": each["sentence"],
            }
        )
    return int(worst(outcome.status for outcome in outcomes.values()))


def _event(outcome: Outcome) -> dict[str, Any]:
    event: dict[str, Any] = {"file": str(outcome.path), "event": "recording"}
    if (judged := outcome.diagnosis) is None:
        return event | {"verdict": "unusable", "reason": outcome.error}
    kind = {} if judged.kind is None else {"kind": str(judged.kind)}
    ratios = {change.name: round(change.ratio, 4) for change in judged.decisive.changes}
    event |= {"verdict": str(judged.verdict), **kind, "reason": judged.decisive.reasons[0]}
    return event | ({"ratios": ratios} if ratios else {})


def _print(event: dict[str, Any]) -> None:
    sys.stdout.write(printable(json_text(event, indent=None)) + "\n")
    sys.stdout.flush()
