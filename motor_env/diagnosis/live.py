"""The command `motor-env watch`: where lines come from, what is shown, what is kept."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from motor_env.console import ExitStatus, printable
from motor_env.diagnosis.watch import Event, State, Watch
from motor_env.errors import InputError
from motor_env.motor.data_sheet import load_motor

_PAUSE_S, _SILENCE_S = 0.2, 5.0


def run(
    motor: Path, log: Path | None, *, false_alarms_per_year: float, state: Path | None, follow: bool
) -> int:
    """Watch until the lines end; the exit status.

    Raises:
        InputError: the motor was not learned from windows, or a file cannot be read.
    """
    reference = load_motor(motor).operation
    if reference is None:
        raise InputError(f"{motor}: was not commissioned with --window")
    if log is None and follow:
        raise InputError("--follow needs a log; standard input is waited for anyway")
    seen = State.load(state)
    if log is None:
        seen.offset = 0
    watch = Watch(reference, seen, false_alarms_per_year=false_alarms_per_year)
    lines: Iterable[bytes | None] = sys.stdin.buffer if log is None else _growing(log, seen.offset, follow)
    for event in _shown(watch.lines(lines), seen):
        if state is not None and event.kind == "window":
            seen.save(state)
    if seen.faults:
        return int(ExitStatus.FAULT)
    return int(ExitStatus.UNDECIDED if seen.counts["window unusable"] else ExitStatus.HEALTHY)


def _growing(log: Path, offset: int, follow: bool) -> Iterator[bytes | None]:
    """Lines of a file, whole ones only; None after a while without any."""
    with log.open("rb") as file:
        file.seek(offset)
        silent_s = 0.0
        while True:
            place = file.tell()
            line = file.readline()
            if line.endswith(b"\n") or (line and not follow):
                silent_s = 0.0
                yield line
            elif not follow:
                return
            else:
                file.seek(place)
                time.sleep(_PAUSE_S)
                if silent_s <= _SILENCE_S < silent_s + _PAUSE_S:
                    yield None
                silent_s += _PAUSE_S


def _shown(events: Iterator[Event], state: State) -> Iterator[Event]:
    if not sys.stdout.isatty():
        for event in events:
            sys.stdout.write(event.as_json() + "\n")
            sys.stdout.flush()
            yield event
        return
    from rich.live import Live
    from rich.text import Text

    with Live(Text("learned; waiting for the first window")) as screen:
        for event in events:
            moved = ", ".join(f"{name} {ratio - 1.0:+.1%}" for name, ratio in event.ratios.items())
            counts = ", ".join(f"{n} {name}" for name, n in state.counts.most_common())
            style = "green" if event.text == "healthy" else "bold red" if event.kind == "window" else "yellow"
            screen.update(
                Text(printable(f"{event.time_s:.6g} s  {event.kind}: {event.text}  {moved}\n{counts}"), style)
            )
            yield event
