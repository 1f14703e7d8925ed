"""The command `motor-env watch`: what it watches, what it keeps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from motor_env.diagnosis.commission import motor_of_windows
from motor_env.errors import InputError
from motor_env.live.screen import showing
from motor_env.live.sources import lines, source
from motor_env.live.state import State
from motor_env.live.watch import Event, Lesson, Watch
from motor_env.motor.data_sheet import Motor, load_motor, save_motor
from motor_env.motor.healthy import Healthy


def run(
    motor: Path,
    name: str | None,
    *,
    false_alarms_per_year: float,
    state: Path | None,
    follow: bool,
    baud: int,
    columns: str | None,
    lesson: Lesson | None,
) -> int:
    """Watch until the lines end or the user ends it; the exit status.

    Raises:
        InputError: the motor was not learned from windows, or a source cannot be read.
    """
    if name is None and follow:
        raise InputError("--follow needs a log; standard input is waited for anyway")
    seen = State.load(state)
    if columns is not None:
        seen.header = columns
    if name is None:
        seen.offset = 0
    known = _windows_of(load_motor(motor)) if lesson is None or motor.exists() else lesson
    watcher = Watch(known, seen, false_alarms_per_year=false_alarms_per_year)
    pieces = source(name, follow=follow, offset=seen.offset, baud=baud)
    with suppress(KeyboardInterrupt), showing(seen.counts) as show:  # Ctrl-C is the usual end of a watch
        for event in watcher.events(lines(pieces, rest=not follow)):
            show(event)
            if event.kind == "learned" and watcher.healthy is not None:
                save_motor(motor_of_windows(watcher.healthy, motor.stem), motor)
            if state is not None and event.kind in ("window", "learned"):
                seen.save(state)
    return int(seen.exit_status)


def watch(
    motor: Motor | str | Path,
    log: str | Path | Iterable[str],
    *,
    false_alarms_per_year: float = 1.0,
) -> Iterator[Event]:
    """Watch a motor at work: yield a verdict on each window, and what is wrong with the stream, as lines come in.

    Args:
        motor: commissioned by windows of logs, or its file.
        log: file with a header and lines of CSV, or such lines as they come.
        false_alarms_per_year: of a healthy motor that always runs.

    Raises:
        InputError: the motor was not learned from windows, or the log cannot be read.
    """
    known = motor if isinstance(motor, Motor) else load_motor(motor)
    if isinstance(log, str | Path):
        pieces = lines(source(str(log), follow=False, offset=0, baud=0))
    else:
        pieces = (f"{line.rstrip()}\n".encode() for line in log)
    yield from Watch(_windows_of(known), State(), false_alarms_per_year=false_alarms_per_year).events(pieces)


def _windows_of(motor: Motor) -> Healthy:
    if motor.healthy is None or motor.healthy.windows is None:
        raise InputError(f"{motor.name}: was not commissioned by windows of the motor at work")
    return motor.healthy
