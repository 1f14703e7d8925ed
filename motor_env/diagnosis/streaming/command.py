"""The command `motor-env watch`: what it watches, keeps and shows: a screen on a terminal, JSON lines otherwise."""

from __future__ import annotations

import hashlib
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from motor_env.common.console import printable
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_NOTE_BYTES, read_file
from motor_env.diagnosis.streaming.sources import NEW_FILE, identity, lines, source
from motor_env.diagnosis.streaming.state import State
from motor_env.diagnosis.streaming.watch import Event, LearningPhase, Watch
from motor_env.diagnosis.verdict.motor_files import motor_of_windows
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
    learning: LearningPhase | None,
) -> int:
    """Watch until the lines end or the user ends it; return the exit status.

    Raises:
        InputError: the motor was not learned from windows, or a source cannot be read.
    """
    if name is None and follow:
        raise InputError("--follow needs a log; standard input is waited for anyway")
    known = _known(motor) if learning is None or motor.exists() else learning
    seen = State.load(state, _digest(motor), identity(name))
    seen.header = columns or seen.header
    watcher = Watch(known, seen, false_alarms_per_year=false_alarms_per_year)
    if rate := watcher.describe_false_alarm_rate():
        sys.stderr.write(f"{rate}\n")
    before = seen.last_read.encode("latin-1")
    pieces = source(name, follow=follow, baud=baud, offset=seen.offset, last_read=before)
    with suppress(KeyboardInterrupt), showing(seen.counts) as show:  # Ctrl-C is the usual end of a watch
        for event in watcher.events(lines(pieces, rest=not follow)):
            show(event)
            if event.kind == "learned" and watcher.healthy is not None:
                save_motor(motor_of_windows(watcher.healthy, motor.stem), motor)
                seen.motor = _digest(motor)
            if state is not None and event.kind in ("window", "learned", NEW_FILE):
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
    healthy = _windows_of(motor if isinstance(motor, Motor) else load_motor(motor))
    if isinstance(log, str | Path):
        pieces = lines(source(str(log), follow=False, baud=0))
    else:
        pieces = (f"{line.rstrip()}\n".encode() for line in log)
    yield from Watch(healthy, State(), false_alarms_per_year=false_alarms_per_year).events(pieces)


def _digest(motor: Path) -> str:
    """Digest the motor file, which was read; empty where there is none, since it is to be learned."""
    return hashlib.sha256(read_file(motor, LARGEST_NOTE_BYTES)).hexdigest() if motor.exists() else ""


def _known(motor: Path) -> Healthy:
    """Load what windows have taught of the motor of a file."""
    try:
        return _windows_of(load_motor(motor))
    except InputError as error:
        if motor.exists():
            raise
        cure = "`motor-env commission` writes one from logs of the healthy motor, --learn 10min from its first minutes"
        raise InputError(f"{error}; {cure}") from None


def _windows_of(motor: Motor) -> Healthy:
    if motor.healthy is None or motor.healthy.windows is None:
        raise InputError(f"{motor.name}: was not commissioned by windows of the motor at work")
    return motor.healthy


@contextmanager
def showing(counts: Counter[str]) -> Iterator[Callable[[Event], None]]:
    """Yield the function that shows an event; the counts are those of all events."""
    if not sys.stdout.isatty():
        yield _line
        return
    from rich.console import Group
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    latest: deque[Event] = deque(maxlen=8)
    with Live(Text("waiting for the first window")) as screen:

        def show(event: Event) -> None:
            latest.append(event)
            table = Table("time (s)", "event", "what", "moved", expand=True)
            for each in latest:
                moved = ", ".join(f"{name} {ratio - 1.0:+.1%}" for name, ratio in each.ratios.items())
                kind = each.kind if each.count == 1 else f"{each.count} {each.kind}"
                words = (f"{each.time_s:.6g}", kind, f"{each.text} {each.reason}", moved)
                table.add_row(*(Text(printable(word)) for word in words), style=_style(each))
            screen.update(Group(table, Text(", ".join(f"{n} {name}" for name, n in counts.most_common()))))

        yield show


def _line(event: Event) -> None:
    sys.stdout.write(event.as_json() + "\n")
    sys.stdout.flush()


def _style(event: Event) -> str:
    if event.kind != "window" or event.text == "unusable":
        return "yellow" if event.kind not in ("learning", "learned") else ""
    return "green" if event.text == "healthy" else "bold red"
