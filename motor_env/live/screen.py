"""What a user sees of a watch: a live screen on a terminal, JSON lines otherwise."""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from motor_env.console import printable
from motor_env.live.watch import Event

_LATEST = 8


@contextmanager
def showing(counts: Counter[str]) -> Iterator[Callable[[Event], None]]:
    """Yields the function that shows an event; the counts are those of all events."""
    if not sys.stdout.isatty():
        yield _line
        return
    from rich.console import Group
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    latest: deque[Event] = deque(maxlen=_LATEST)
    with Live(Text("waiting for the first window")) as screen:

        def show(event: Event) -> None:
            latest.append(event)
            table = Table("time (s)", "event", "what", "moved", expand=True)
            for each in latest:
                moved = ", ".join(f"{name} {ratio - 1.0:+.1%}" for name, ratio in each.ratios.items())
                words = (f"{each.time_s:.6g}", each.kind, f"{each.text} {each.reason}", moved)
                table.add_row(*(Text(printable(word)) for word in words), style=_style(each))
            total = ", ".join(f"{n} {name}" for name, n in counts.most_common())
            screen.update(Group(table, Text(total)))

        yield show


def _line(event: Event) -> None:
    sys.stdout.write(event.as_json() + "\n")
    sys.stdout.flush()


def _style(event: Event) -> str:
    if event.kind != "window" or event.text == "unusable":
        return "yellow" if event.kind not in ("learning", "learned") else ""
    return "green" if event.text == "healthy" else "bold red"
