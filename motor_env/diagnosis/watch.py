"""A motor at work watched sample by sample: windows of a stream are judged as windows of a log are.

Lines come in, lines go out: one for each window (healthy, or what moved), and one at once for what is wrong with the
stream: a line that is no sample, a gap, a jump of time, a stuck sensor, silence. Those begin a new window.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.diagnosis.windows import NAMES, judge_windows
from motor_env.errors import InputError
from motor_env.files import write_text
from motor_env.motor.data_sheet import WindowReference
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import understand
from motor_env.recordings.recording import Recording, evened

YEAR_S = 365.25 * 86_400.0
STUCK_AFTER = 200
_GAP_STEPS = 20.0
_QUANTITIES = ("time", "voltage", "current", "speed")


@dataclass(frozen=True, slots=True)
class Event:
    """What is said: a verdict on a window, or what is wrong with the stream.

    Attributes:
        time_s: end of the window, or when it was seen.
        kind: window, malformed, gap, time_jump, stuck_sensor or silence.
        text: verdict of a window; else what was seen.
        ratios: quantities of the window over the healthy ones.
    """

    time_s: float
    kind: str
    text: str
    ratios: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> str:
        """One line."""
        said: dict[str, Any] = {"time_s": self.time_s, "event": self.kind}
        said |= {"verdict" if self.kind == "window" else "reason": self.text}
        if self.ratios:
            said["ratios"] = self.ratios
        return json.dumps(said)


@dataclass
class State:
    """What has been seen so far; a file keeps it over a restart.

    Attributes:
        offset: bytes of the growing file that are judged.
        counts: verdicts of windows and kinds of other events.
        header: first line of the stream.
    """

    offset: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    header: str = ""

    @classmethod
    def load(cls, path: Path | None) -> State:
        """From its file; new where there is none.

        Raises:
            InputError: the file is no state of this command.
        """
        if path is None or not path.exists():
            return cls()
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(int(content["offset"]), Counter(content["counts"]), str(content["header"]))
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path}: is no state of watch; give another file") from None

    def save(self, path: Path) -> None:
        """Write it whole."""
        content = {"offset": self.offset, "counts": dict(self.counts), "header": self.header}
        write_text(path, json.dumps(content))

    @property
    def faults(self) -> int:
        """Windows with a fault."""
        return sum(n for name, n in self.counts.items() if name.startswith("window ")) - sum(
            self.counts[f"window {name}"] for name in ("healthy", "unusable")
        )


class Watch:
    """Takes lines, gives events.

    Args:
        reference: what windows of the healthy motor have taught.
        state: what has been seen so far.
        false_alarms_per_year: of a healthy motor that always runs; each window has its share.
    """

    def __init__(self, reference: WindowReference, state: State, *, false_alarms_per_year: float) -> None:
        if not 0.0 < false_alarms_per_year < math.inf:
            raise InputError(f"false-alarms-per-year must be > 0, got {false_alarms_per_year:g}")
        self.reference, self.state = reference, state
        self.rate = min(false_alarms_per_year * reference.window_s / YEAR_S, 0.5)
        self._columns: dict[str, tuple[int, float]] = {}
        self._window: list[list[float]] = []
        self._last: list[float] | None = None
        self._same = 0
        if state.header:
            self._read_header(state.header)

    def lines(self, lines: Iterable[bytes | None]) -> Iterator[Event]:
        """Events of lines; None stands for a while without any."""
        for line in lines:
            if line is None:
                events: Iterable[Event] = [self._broken("silence", "no line comes: is the cable in?")]
            else:
                self.state.offset += len(line)
                events = self._line(line.decode("utf-8", "replace").strip())
            for event in events:
                name = f"window {event.text}" if event.kind == "window" else event.kind
                self.state.counts[name] += 1
                yield event

    def _line(self, text: str) -> Iterator[Event]:
        if not text or text.startswith("#"):
            return
        if not self._columns:
            self._read_header(text)
            return
        words = text.split(",")
        try:
            sample = [float(words[k]) * factor for k, factor in self._columns.values()]
        except (ValueError, IndexError):
            sample = [math.nan]
        if not all(map(math.isfinite, sample)):
            if text != self.state.header:  # a device that begins anew says its header again
                yield Event(self._time_s, "malformed", text[:60])
            return
        yield from self._sample(sample)

    def _sample(self, sample: list[float]) -> Iterator[Event]:
        step, last, usual = sample[0] - self._time_s, self._last, self.reference.dt_s
        if last is not None and step <= 0.0:
            yield self._broken("time_jump", f"{-step:.6g} s back")
        elif last is not None and step > _GAP_STEPS * usual:
            yield self._broken("gap", f"{step:.6g} s without a sample")
        self._last = sample
        self._same = self._same + 1 if last is not None and last[2] == sample[2] and sample[1] else 0
        if self._same >= STUCK_AFTER:
            if self._same == STUCK_AFTER:
                yield self._broken("stuck_sensor", f"{STUCK_AFTER} times the current {sample[2]:.6g} A")
                self._last = sample
            return
        self._window.append(sample)
        if sample[0] - self._window[0][0] >= self.reference.window_s:
            yield self._judged()
            self._window = []

    def _judged(self) -> Event:
        columns = np.array(self._window).T
        even, values, _ = evened(columns[0], dict(zip(_QUANTITIES[1:], columns[1:], strict=True)))
        recording = Recording(Path("stream"), even, values["current"], values["voltage"], values["speed"])
        try:
            [verdict, *_] = judge_windows(recording, self.reference, self.rate)
        except UnusableError:
            return Event(self._time_s, "window", "unusable")
        ratios = {name: change.ratio for name, change in zip(NAMES, verdict.changes, strict=False)}
        return Event(self._time_s, "window", verdict.verdict, ratios)

    def _broken(self, kind: str, text: str) -> Event:
        event = Event(self._time_s, kind, text)
        self._window, self._last = [], None
        return event

    @property
    def _time_s(self) -> float:
        return self._last[0] if self._last is not None else 0.0

    def _read_header(self, text: str) -> None:
        """Columns of the first line.

        Raises:
            InputError: a column is missing.
        """
        found: dict[str, tuple[int, float]] = {}
        for k, word in enumerate(text.split(",")):
            meaning = understand(word)
            if meaning.quantity in _QUANTITIES:
                found.setdefault(meaning.quantity, (k, meaning.factor))
        for quantity in _QUANTITIES:
            if quantity not in found:
                raise InputError(
                    f"the first line must name the columns; {quantity} is missing in {text[:80]!r}"
                )
        self._columns = {quantity: found[quantity] for quantity in _QUANTITIES}
        self.state.header = text
