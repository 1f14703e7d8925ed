"""Base of the three commands: one-sentence errors, exit statuses, progress, JSON."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, CycloptsError, Parameter, Token

if TYPE_CHECKING:
    from rich.progress import ProgressColumn


_CLOSED_PIPE = 128 + 13  # as a shell reports SIGPIPE, which Windows does not have


def _whole(_: type[int], tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    try:
        return int(text if text.isascii() and "_" not in text else "")
    except ValueError:
        raise ValueError(f"must be a whole number, got {text!r}") from None


Whole = Annotated[int, Parameter(converter=_whole)]
"""An option's whole number; cyclopts alone would round 1.5 to 2."""


class ExitStatus(IntEnum):
    """Exit statuses of every command."""

    HEALTHY = 0
    FAULT = 1
    BAD_INPUT = 2
    UNDECIDED = 3
    BUG = 70  # EX_SOFTWARE of sysexits.h; Python's own 1 would read as a fault of the motor


_WORST_FIRST = (
    ExitStatus.BUG,
    ExitStatus.BAD_INPUT,
    ExitStatus.FAULT,
    ExitStatus.UNDECIDED,
    ExitStatus.HEALTHY,
)


def worst(statuses: Iterable[ExitStatus]) -> ExitStatus:
    """Return the worst exit status of several files; undecided without any."""
    return min(statuses, key=_WORST_FIRST.index, default=ExitStatus.UNDECIDED)


def run(app: App, arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status.

    Bad input gives one sentence on standard error and status 2, an unexpected error its traceback and status 70.
    SIGTERM ends it as Ctrl-C does, so nothing half written stays.
    """
    app.default_parameter = Parameter(negative=())  # no --no-json, and no --empty-files
    app.suppress_keyboard_interrupt = False  # otherwise cyclopts exits before anything can be said
    for name in ("stdout", "stderr"):  # closed by the shell: what is said goes nowhere
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115  # to the end
    _received.clear()
    try:
        _heed_termination()
        status = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read is gone, and the rest of it goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _CLOSED_PIPE
    except KeyboardInterrupt as interrupt:
        return _end_interrupted(app, *_received, *interrupt.args)
    except Exception as error:  # noqa: BLE001  # whatever it is must not end with the exit status of a verdict
        if _received:
            return _end_interrupted(app, *_received)
        if (message := _sentence(error)) is None:
            traceback.print_exc()
            return int(ExitStatus.BUG)
    else:
        return int(status) if isinstance(status, int) else 0
    print(f"{app.name[0]}: {printable(message)}", file=sys.stderr)
    return int(ExitStatus.BAD_INPUT)


_received: list[int] = []
"""Signals that have ended the command; a library under import may replace their exceptions by its own."""


def _end_interrupted(app: App, number: int = signal.SIGINT, *_: object) -> int:
    print(f"{app.name[0]}: interrupted", file=sys.stderr)
    return 128 + number


def _heed_termination() -> None:
    def interrupt(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one ends at once
        _received.append(number)
        raise KeyboardInterrupt(number)

    # A handler that somebody else has set stays.
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, interrupt)


def printable(text: str) -> str:
    """Remove control and unencodable characters from a text, such as a file's name."""
    return "".join(
        letter if letter.isprintable() or letter in "\n\t" else letter.encode("unicode_escape").decode()
        for letter in text
    )


PATIENCE_S, LATER_S = 1.0, 10.0
"""Without a terminal: when somebody who waits is told what for, and when again; from then on ever more rarely."""


@contextmanager
def working(
    words: str, total: float | None = None, *columns: ProgressColumn
) -> Iterator[Callable[..., None]]:
    """Tell on standard error what is worked on and how far it is: by a bar on a terminal, elsewhere by lines.

    Yields:
        Function that takes `advance`, `completed`, `total` or `description`.
    """
    if not sys.stderr.isatty():
        with _progress_lines(_Work(words, total)) as update:
            yield update
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    text = TextColumn("{task.description}", markup=False)
    usual = (text, BarColumn(30), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*usual, *columns, console=Console(stderr=True)) as bar:
        yield partial(bar.update, bar.add_task(words, total=total))


@dataclass
class _Work:
    """What is worked on, and how far it is."""

    description: str
    total: float | None
    completed: float = 0.0
    begin_s: float | None = None

    def update(self, advance: float = 0.0, **changes: Any) -> None:
        if self.begin_s is None:
            self.begin_s = time.monotonic()
        for name, value in changes.items():
            setattr(self, name, value)
        self.completed += advance

    @property
    def line(self) -> str:
        if self.begin_s is None or not self.total or not self.completed:
            return f"{self.description} ..."
        left_s = (time.monotonic() - self.begin_s) * (self.total / self.completed - 1.0)
        return f"{self.description} ... {self.completed / self.total:.0%}, about {left_s:.0f} s left"


@contextmanager
def _progress_lines(work: _Work) -> Iterator[Callable[..., None]]:
    """Tell of work by lines on standard error until it is done."""
    done = threading.Event()

    def tell() -> None:
        wait_s = PATIENCE_S
        while not done.wait(wait_s):
            print(work.line, file=sys.stderr, flush=True)
            wait_s = max(2.0 * wait_s, LATER_S)

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield work.update
    finally:
        done.set()
        teller.join()


_NO_ROOM = ("failed to map segment", "allocate memory")  # of a library, as the loader says it


def _sentence(error: Exception) -> str | None:
    """Return the sentence for bad input and for too little memory; None for a bug."""
    if isinstance(error, CycloptsError):
        return " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or str(error)).lower()}"
    if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_ROOM):
        return f"there is too little memory ({' '.join(str(error).split()) or 'no room left'})"
    return str(error) if isinstance(error, ValueError | OSError) else None


def json_text(value: Any, *, indent: int | None = 1) -> str:
    """Format a result as JSON, on one line without `indent`; infinite numbers and nan become null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
