"""Watch a motor at work: windows of a stream are judged as those of a log.

Each window gives an event. So does a fault of the stream (a malformed line, a gap, a jump of time, a stuck sensor,
silence), which restarts the window.
"""

from __future__ import annotations

import hashlib
import math
import sys
import time
from array import array
from codecs import BOM_UTF8
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from motor_env.common.console import json_text, printable
from motor_env.common.errors import InputError, require_options
from motor_env.common.files import LARGEST_NOTE_BYTES, read_file
from motor_env.diagnosis.operation.sequential_monitor import SequentialMonitor
from motor_env.diagnosis.operation.window_baseline import FEWEST_WINDOWS, learn_windows
from motor_env.diagnosis.operation.windows import averaged, judge_of
from motor_env.diagnosis.readers.headers import LARGEST_CURRENT_A, understand
from motor_env.diagnosis.readers.recording import (
    Recording,
    UnusableError,
    resampled,
    without_lone_outliers,
)
from motor_env.diagnosis.readers.text_block import as_number
from motor_env.diagnosis.streaming.sources import (
    LONGEST_LINE,
    NEW_FILE,
    Notice,
    Piece,
    identity,
    lines,
    source,
)
from motor_env.diagnosis.streaming.state import WINDOW, State
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.data_sheet import Motor, load_motor, save_motor
from motor_env.motor.healthy import Healthy, Windows

STUCK_AFTER = 200
_GAP_STEPS = 20.0
_SAME_STEP = 0.2
_FEWEST_A_WINDOW = 200.0  # samples, while the interval is not known
_LATEST_S = 1e13
_ABSURD, _LARGEST_READING = 1e4, 1e9  # times the largest healthy reading; where none is known
_RAREST = 1e-12  # false alarms a year
_MOST_COLUMNS = 1000
_LONGEST_NAME = 100
_QUANTITIES = ("time", "voltage", "current", "speed")
_NAME_THEM = 'name all columns in their order, such as --columns "t [s],I [mA],U [V],n [rpm]"'
_SECOND = 1.0
_OFTEN = frozenset(("malformed", "gap", "time_jump"))


@dataclass(frozen=True, slots=True)
class Event:
    """Verdict on a window, or a fault of the stream.

    Attributes:
        time_s: end of the window, or time of the fault.
        kind: window, learning, learned, not_learned, another_motor, malformed, gap, time_jump, stuck_sensor, silence,
            unplugged, lost or new_file.
        text: verdict of a window, or description.
        ratios: quantities of the window over the healthy ones.
        reason: why a window is unusable, or a sensor failed.
        fault_kind: kind of the fault, if distinguished within its family.
        also: further simultaneous faults, each by its kind where distinguished.
        undecided: quantities whose doubling would be invisible.
        count: events of this kind since the last shown one.
    """

    time_s: float
    kind: str
    text: str
    ratios: dict[str, float] = field(default_factory=dict)
    reason: str = ""
    fault_kind: str | None = None
    also: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    count: int = 1

    @property
    def name(self) -> str:
        """Name for the counts."""
        return f"{WINDOW}{self.text}" if self.kind == "window" else self.kind

    def as_json(self) -> str:
        """Write it as one line."""
        is_window = self.kind == "window"
        fields = {
            "time_s": self.time_s,
            "event": self.kind,
            "verdict": self.text if is_window else None,
            "kind": self.fault_kind,
            "also": list(self.also),
            "reason": self.reason if is_window else self.text,
            "ratios": {name: round(ratio, 4) for name, ratio in self.ratios.items()},
            "undecided": list(self.undecided),
            "count": self.count if self.count > 1 else None,
        }
        return json_text(
            {name: value for name, value in fields.items() if value not in ("", {}, [], None)}, indent=None
        )


class EventThrottle:
    """Limit events of frequent kinds to one a second, with their count.

    A second of the stream, so that events do not depend on the reading speed, or of the wall clock.
    """

    def __init__(self) -> None:
        self._emitted_s: dict[str, tuple[float, float]] = {}
        self._pending: dict[str, Event] = {}

    def filter(self, events: Iterable[Event], streamed_s: float) -> Iterator[Event]:
        """Yield the events that are due."""
        for event in events:
            if event.kind not in _OFTEN:
                yield event
            else:
                pending = self._pending.get(event.kind)
                self._pending[event.kind] = (
                    event if pending is None else replace(event, count=pending.count + 1)
                )
        if self._pending:
            now_s = (streamed_s, time.monotonic())
            for kind in list(self._pending):
                before_s = self._emitted_s.get(kind, (-math.inf, -math.inf))
                if any(now - before >= _SECOND for now, before in zip(now_s, before_s, strict=True)):
                    self._emitted_s[kind] = now_s
                    yield self._pending.pop(kind)

    def flush(self) -> Iterator[Event]:
        """Yield the pending events at the end."""
        yield from self._pending.values()


@dataclass
class LearningPhase:
    """Collect windows of a healthy motor to learn from.

    Attributes:
        window_s: length of a window.
        learn_s: wanted length of all windows.
        steady: only a fault changes the motor.
        recordings: the windows so far.
    """

    window_s: float
    learn_s: float
    steady: bool = False
    recordings: list[Recording] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0.0 < FEWEST_WINDOWS * self.window_s <= self.learn_s < math.inf:
            raise InputError(
                f"learn must be at least {FEWEST_WINDOWS} windows of {self.window_s:g} s, got {self.learn_s:g} s"
            )

    @property
    def dt_s(self) -> float:
        """Sampling interval; until known, the longest that is allowed."""
        return self.recordings[0].dt_s if self.recordings else self.window_s / _FEWEST_A_WINDOW


# Garbage may look like a header in every line, mostly with the same words.
_meaning = lru_cache(1024)(understand)


class Watch:
    """Turn lines into events.

    Args:
        healthy: statistics of healthy windows, or the phase that learns them.
        state: of the watch so far.
        false_alarms_per_year: of a healthy motor that always runs.

    Raises:
        InputError: the state is of another motor.
    """

    def __init__(
        self, healthy: Healthy | LearningPhase, state: State, *, false_alarms_per_year: float
    ) -> None:
        require_options(false_alarms_per_year=false_alarms_per_year)
        if false_alarms_per_year < _RAREST:
            raise InputError(
                f"false-alarms-per-year must be at least {_RAREST:g}, got {false_alarms_per_year:g}"
            )
        self.state = state
        self.healthy: Healthy | None = None
        self._limits: tuple[float, ...] = (_LATEST_S, _LARGEST_READING, LARGEST_CURRENT_A, _LARGEST_READING)
        self._per_year = false_alarms_per_year
        self._phase: LearningPhase | SequentialMonitor
        if isinstance(healthy, LearningPhase):
            self._phase = healthy
        else:
            self._monitor(healthy, state.memory)
        self._columns: list[tuple[int, float]] = []
        self._window = array("d")
        self._last: list[float] | None = None
        self._same = 0
        self._step_s: float | None = None  # between samples, once it was that of the healthy windows
        self._streamed_s = 0.0  # by the stream's own time, gaps left out
        self._is_begin = True  # whether the next bytes begin a line
        self._throttle = EventThrottle()
        if state.header and not self._read_header(state.header):
            raise InputError(f"columns must name {', '.join(_QUANTITIES)}, got {state.header[:80]!r}")

    def _monitor(self, healthy: Healthy, state: dict[str, list[float]] | None = None) -> None:
        self.healthy = healthy
        if healthy.windows is not None and healthy.windows.peaks is not None:
            largest = (_ABSURD * peak for peak in healthy.windows.peaks)
            self._limits = (_LATEST_S, *map(min, self._limits[1:], largest))
        self._phase = SequentialMonitor(
            judge_of(healthy), healthy, false_alarms_per_year=self._per_year, state=state
        )

    def describe_false_alarm_rate(self) -> str:
        """Describe the rate of false alarms; empty while learning."""
        return "" if isinstance(self._phase, LearningPhase) else self._phase.describe_false_alarm_rate()

    @property
    def _timing(self) -> Windows | LearningPhase:
        return self._phase if isinstance(self._phase, LearningPhase) else self._phase.judge.windows

    def events(self, lines: Iterable[Piece]) -> Iterator[Event]:
        """Yield the events of lines and notices."""
        for line in lines:
            yield from self._throttle.filter(self._count_events(line), self._streamed_s)
        yield from self._throttle.flush()
        if not self._columns and self.state.counts["malformed"]:
            raise InputError(f"no line names the columns time, voltage, current and speed; {_NAME_THEM}")

    def _count_events(self, line: Piece) -> Iterator[Event]:
        if isinstance(line, Notice):
            if line.kind == NEW_FILE:
                self.state.begin()
            events: Iterable[Event] = [self._restart_window(line.kind, line.text)]
            self._last, self._is_begin = None, True
        else:
            is_begin, self._is_begin = self._is_begin, line.endswith(b"\n")
            self.state.advance(line)
            events = self._parse_line(line) if is_begin else ()
        for event in events:
            self.state.counts[event.name] += 1
            yield event

    def _parse_line(self, line: bytes) -> Iterator[Event]:
        # A file may begin with a mark of its encoding, and several may be joined.
        text = line[: LONGEST_LINE + 1].removeprefix(BOM_UTF8).decode("utf-8", "replace").strip()
        if len(line) > LONGEST_LINE:
            yield Event(self._time_s, "malformed", f"longer than {LONGEST_LINE} bytes: {text[:60]}")
            return
        words = text.split(",", _MOST_COLUMNS)
        try:
            sample = [as_number(words[k]) * factor for k, factor in self._columns]
        except (ValueError, IndexError):
            sample = []
        if sample and all(abs(each) <= most for each, most in zip(sample, self._limits, strict=True)):
            yield from self._add_sample(sample)
        # A restarted device repeats its header.
        elif text and text[0] != "#" and not self._read_header(text):
            yield Event(self._time_s, "malformed", text[:60])

    def _add_sample(self, sample: list[float]) -> Iterator[Event]:
        last, self._last = self._last, sample
        if last is not None:
            self._same = self._same + 1 if last[2] == sample[2] and sample[1] else 0
            if self._same == STUCK_AFTER:
                yield self._restart_window(
                    "stuck_sensor", f"{STUCK_AFTER} times the current {sample[2]:.6g} A"
                )
            if self._same >= STUCK_AFTER:
                return
            step = sample[0] - last[0]
            if step <= 0.0:
                yield self._restart_window("time_jump", f"{abs(step):.6g} s back")
            elif step > _GAP_STEPS * self._timing.dt_s:
                yield self._restart_window("gap", f"{step:.6g} s without a sample")
            else:
                self._streamed_s += step
        self._window.extend(sample)
        if sample[0] - self._window[0] >= self._timing.window_s:
            event = self._close_window()
            if isinstance(
                self._phase, SequentialMonitor
            ):  # before the event: the caller saves the state with it
                self.state.memory = self._phase.state_dict
            yield event

    def _close_window(self) -> Event:
        time_s, *columns = np.array(self._window).reshape(-1, len(_QUANTITIES)).T
        self._window, values = array("d"), dict(zip(_QUANTITIES[1:], columns, strict=True))
        for name in ("current", "speed"):
            if values["voltage"].any() and not np.ptp(values[name]):
                text = f"the {name} of a whole window is {values[name][0]:.6g}"
                return self._restart_window("stuck_sensor", text)
        even_s, values, _ = resampled(time_s, values, self._step_s)
        recording = without_lone_outliers(
            Recording(Path("stream"), even_s, values["current"], values["voltage"], values["speed"])
        )
        if abs(recording.dt_s - self._timing.dt_s) < _SAME_STEP * self._timing.dt_s:
            self._step_s = self._timing.dt_s
        if isinstance(self._phase, LearningPhase):
            return self._learn(recording, self._phase)
        try:
            return self._window_event(self._phase.diagnose(recording))
        except UnusableError as error:
            return Event(self._time_s, "window", "unusable", reason=str(error))

    def _learn(self, recording: Recording, phase: LearningPhase) -> Event:
        phase.recordings.append(averaged(recording, phase.window_s))
        learned_s = len(phase.recordings) * phase.window_s
        words = f"{learned_s:g} of {phase.learn_s:g} s"
        if learned_s < phase.learn_s * (1.0 - 1e-9):
            return Event(self._time_s, "learning", words)
        try:
            healthy, _ = learn_windows(phase.recordings, phase.window_s, steady=phase.steady)
        except UnusableError as error:
            phase.recordings.clear()
            return Event(self._time_s, "not_learned", str(error))
        self._monitor(healthy)
        return Event(self._time_s, "learned", f"{words}: {self.describe_false_alarm_rate()}")

    def _window_event(self, window: Judgement) -> Event:
        ratios = {change.name: change.ratio for change in window.changes}
        moved = {change.name for change in window.changes if change.significant}
        # Wear moves only one of them.
        if window.verdict is Verdict.OTHER and {"K", "J"} <= moved:
            return Event(
                self._time_s, "another_motor", "constants and inertia are those of another motor", ratios
            )
        is_told = window.verdict in (Verdict.UNUSABLE, Verdict.SENSOR, Verdict.OTHER)
        return Event(
            self._time_s,
            "window",
            str(window.verdict),
            ratios,
            reason=window.reasons[-1 if window.verdict is Verdict.OTHER else 0] if is_told else "",
            fault_kind=None if window.kind is None else str(window.kind),
            also=tuple(str(fault.kind or fault.verdict) for fault in window.also),
            undecided=tuple(change.name for change in window.changes if change.verdict == "undecided"),
        )

    def _restart_window(self, kind: str, text: str) -> Event:
        self._window = array("d")
        return Event(self._time_s, kind, text)

    @property
    def _time_s(self) -> float:
        return self._last[0] if self._last is not None else 0.0

    def _read_header(self, text: str) -> bool:
        """Return whether a line names the columns; if so, use them.

        Raises:
            InputError: the first such line lacks a column.
        """
        words = text.split(",", _MOST_COLUMNS)
        if self._columns and len(words) < len(_QUANTITIES):
            return False
        meanings = [_meaning(word[:_LONGEST_NAME]) for word in words]
        names = [meaning.quantity for meaning in meanings]
        missing = [quantity for quantity in _QUANTITIES if quantity not in names]
        if not missing:
            places = [names.index(quantity) for quantity in _QUANTITIES]
            self._columns = [(k, meanings[k].factor) for k in places]
            self.state.header = text
        elif len(missing) < len(_QUANTITIES) and not self._columns:
            raise InputError(
                f"the first line must name the columns; {missing[0]} is missing in {text[:80]!r}; {_NAME_THEM}"
            )
        return not missing


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
    """Watch until the lines or the user end it; return the exit status.

    Raises:
        InputError: no windows of the motor, or an unreadable source.
    """
    if name is None and follow:
        raise InputError("--follow needs a log; standard input is waited for anyway")
    healthy = _load_healthy(motor) if learning is None or motor.exists() else learning
    watched = State.load(state, _digest(motor), identity(name))
    watched.header = columns or watched.header
    watcher = Watch(healthy, watched, false_alarms_per_year=false_alarms_per_year)
    if rate := watcher.describe_false_alarm_rate():
        sys.stderr.write(f"{rate}\n")
    before = watched.last_read.encode("latin-1")
    pieces = source(name, follow=follow, baud=baud, offset=watched.offset, last_read=before)
    with suppress(KeyboardInterrupt), showing(watched.counts) as show:  # Ctrl-C is the usual end of a watch
        for event in watcher.events(lines(pieces, rest=not follow)):
            show(event)
            if event.kind == "learned" and watcher.healthy is not None:
                save_motor(motor_of_windows(watcher.healthy, motor.stem), motor)
                watched.motor = _digest(motor)
            if state is not None and event.kind in ("window", "learned", NEW_FILE):
                watched.save(state)
    return int(watched.exit_status)


def watch(
    motor: Motor | str | Path,
    log: str | Path | Iterable[str],
    *,
    false_alarms_per_year: float = 1.0,
) -> Iterator[Event]:
    """Watch a motor at work: yield verdicts on windows and faults of the stream as lines arrive.

    Args:
        motor: commissioned at work, or its file.
        log: CSV file with a header, or its lines.
        false_alarms_per_year: of a healthy motor that always runs.

    Raises:
        InputError: no windows of the motor, or an unreadable log.
    """
    healthy = _windows_of(motor if isinstance(motor, Motor) else load_motor(motor))
    if isinstance(log, str | Path):
        pieces = lines(source(str(log), follow=False, baud=0))
    else:
        pieces = (f"{line.rstrip()}\n".encode() for line in log)
    yield from Watch(healthy, State(), false_alarms_per_year=false_alarms_per_year).events(pieces)


def _digest(motor: Path) -> str:
    return hashlib.sha256(read_file(motor, LARGEST_NOTE_BYTES)).hexdigest() if motor.exists() else ""


def _load_healthy(motor: Path) -> Healthy:
    try:
        return _windows_of(load_motor(motor))
    except InputError as error:
        if motor.exists():
            raise
        cure = "`motor-env commission` writes one from logs of the healthy motor, --learn 10min from its first minutes"
        raise InputError(f"{error}; {cure}") from None


def _windows_of(motor: Motor) -> Healthy:
    if motor.healthy is None or motor.healthy.windows is None:
        bare = "is a data sheet" if motor.kind == "data_sheet" else "was identified, not commissioned"
        origin = bare if motor.healthy is None else "was learned from starts"
        raise InputError(
            f"{motor.name}: {origin}; watching a motor at work needs one learned from logs:"
            " motor-env commission log1.csv log2.csv -o motor.toml"
        )
    return motor.healthy


@contextmanager
def showing(counts: Counter[str]) -> Iterator[Callable[[Event], None]]:
    """Yield a function that shows an event beside all counts."""
    if not sys.stdout.isatty():
        yield _print_line
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
                what = f"{' + '.join((each.text, *each.also))} {each.reason}"
                words = (f"{each.time_s:.6g}", kind, what, moved)
                table.add_row(*(Text(printable(word)) for word in words), style=_style(each))
            screen.update(Group(table, Text(", ".join(f"{n} {name}" for name, n in counts.most_common()))))

        yield show


def _print_line(event: Event) -> None:
    sys.stdout.write(event.as_json() + "\n")
    sys.stdout.flush()


def _style(event: Event) -> str:
    if event.kind != "window" or event.text == "unusable":
        return "yellow" if event.kind not in ("learning", "learned") else ""
    return "green" if event.text == "healthy" else "bold red"
