"""What a watch says, and how often."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from motor_env.console import json_text
from motor_env.live.state import WINDOW

SECOND = 1.0
_OFTEN = frozenset(("malformed", "gap", "time_jump"))
"""Kinds that garbage gives with every line."""


@dataclass(frozen=True, slots=True)
class Event:
    """What is said: a verdict on a window, or what is wrong with the stream.

    Attributes:
        time_s: end of the window, or when it was seen.
        kind: window, learning, learned, not_learned, another_motor, malformed, gap, time_jump, stuck_sensor, silence,
            unplugged, lost or new_file.
        text: verdict of a window; else what was seen.
        ratios: quantities of the window over the healthy ones.
        reason: why a window is unusable, or what shows that a sensor failed.
        span_s: of a verdict before the window's end: how many seconds it is about.
        fault_kind: kind of the fault, where it can be told from others of its family.
        undecided: quantities of a window of which a doubling would not show.
        count: how many of this kind there were since one was last said; this is the latest of them.
    """

    time_s: float
    kind: str
    text: str
    ratios: dict[str, float] = field(default_factory=dict)
    reason: str = ""
    span_s: float | None = None
    fault_kind: str | None = None
    undecided: tuple[str, ...] = ()
    count: int = 1

    @property
    def name(self) -> str:
        """By which it is counted."""
        return f"{WINDOW}{self.text}" if self.kind == "window" else self.kind

    def as_json(self) -> str:
        """One line."""
        is_window = self.kind == "window"
        said = {
            "time_s": self.time_s,
            "event": self.kind,
            "verdict": self.text if is_window else None,
            "kind": self.fault_kind,
            "reason": self.reason if is_window else self.text,
            "ratios": {name: round(ratio, 4) for name, ratio in self.ratios.items()},
            "span_s": self.span_s,
            "undecided": list(self.undecided),
            "count": self.count if self.count > 1 else None,
        }
        return json_text(
            {name: value for name, value in said.items() if value not in ("", {}, [], None)}, indent=None
        )


class Seldom:
    """Says at most one event a second of a kind that garbage gives with every line, and how many there were.

    A second of the stream or of the wall clock: the first so that a log is told the same way however fast it is read,
    the second so that a stream of nothing but garbage is told at all.
    """

    def __init__(self) -> None:
        self._said_s: dict[str, tuple[float, float]] = {}
        self._held: dict[str, Event] = {}

    def told(self, events: Iterable[Event], streamed_s: float) -> Iterator[Event]:
        """Those that are said now, and those that were held back and are due."""
        for event in events:
            if event.kind not in _OFTEN:
                yield event
            else:
                held = self._held.get(event.kind)
                self._held[event.kind] = event if held is None else replace(event, count=held.count + 1)
        if self._held:
            now_s = (streamed_s, time.monotonic())
            for kind in list(self._held):
                before_s = self._said_s.get(kind, (-math.inf, -math.inf))
                if any(now - before >= SECOND for now, before in zip(now_s, before_s, strict=True)):
                    self._said_s[kind] = now_s
                    yield self._held.pop(kind)

    def rest(self) -> Iterator[Event]:
        """What is still held back when the lines end."""
        yield from self._held.values()
