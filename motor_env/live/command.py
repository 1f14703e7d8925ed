"""The command `motor-env watch`: what it watches, what it keeps."""

from __future__ import annotations

from pathlib import Path

from motor_env.diagnosis.running.logs import commissioned
from motor_env.errors import InputError
from motor_env.live.screen import showing
from motor_env.live.sources import lines, source
from motor_env.live.state import State
from motor_env.live.watch import Lesson, Watch
from motor_env.motor.data_sheet import WindowReference, load_motor, save_motor

_KEPT = ("window", "learned")


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
    watch = Watch(_reference(motor, lesson), seen, false_alarms_per_year=false_alarms_per_year)
    pieces = source(name, follow=follow, offset=seen.offset, baud=baud)
    try:
        with showing(seen.counts) as show:
            for event in watch.events(lines(pieces, rest=not follow)):
                show(event)
                if event.kind == "learned" and isinstance(watch.reference, WindowReference):
                    save_motor(commissioned(watch.reference, motor.stem), motor)
                if state is not None and event.kind in _KEPT:
                    seen.save(state)
    except KeyboardInterrupt:  # the usual end of a watch
        pass
    return int(seen.exit_status)


def _reference(motor: Path, lesson: Lesson | None) -> WindowReference | Lesson:
    """Of the motor file; where there is none yet and the stream shall teach, what is to be learned."""
    if lesson is not None and not motor.exists():
        return lesson
    reference = load_motor(motor).operation
    if reference is None:
        raise InputError(f"{motor}: was not commissioned with --window")
    return reference
