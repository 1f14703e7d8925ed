"""The watch over a running motor, piece by piece: evidence of many directions, lengths and windows, and its alarms.

It has two procedures. The first adds up scores that are calibrated on healthy pieces, and alarms by an e-detector. Its
rate holds as far as its tails do: healthy windows, each judged by what the others teach, must alarm no oftener than
they should. Where they do alarm oftener, the second procedure alarms, which only counts.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.decision import decide
from motor_env.diagnosis.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.running.counting import Counting, promised
from motor_env.diagnosis.running.detector import Detector
from motor_env.diagnosis.running.learned import Learned
from motor_env.diagnosis.running.pieces import Pieces, Sections, end_of, sections_of
from motor_env.diagnosis.running.replay import tails_hold
from motor_env.diagnosis.running.scales import (
    AXES,
    calibrated,
    directions,
    farthest,
    normal_scores,
    places_on_axes,
    reaches,
    untaught_scale,
)
from motor_env.diagnosis.running.windows import WindowJudge, averaged
from motor_env.diagnosis.verdict import Judgement
from motor_env.errors import InputError
from motor_env.fitting.recorded import from_recordings
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray, require
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut

YEAR_S = 365.25 * 86_400.0
CONTEXT = 256
"""Samples before a piece."""
_FEWEST = 2.0  # healthy pieces of a state
_GOES_ON, _SUSPECT = 2.0, 4.0  # scores of a window: a fault goes on; nothing is learned from it
_MOST_LEARNED, _LEARNED_S = 100, 3.0 * 3600.0


class Vigil:
    """Evidence against one healthy motor.

    Args:
        judge: the healthy motor.
        healthy: what it was learned from.
        false_alarms_per_year: of a motor that always runs.
        memory: of an earlier watch; see `memory`.

    Raises:
        InputError: the memory is that of another motor.
    """

    def __init__(
        self,
        judge: WindowJudge,
        healthy: Healthy,
        *,
        false_alarms_per_year: float,
        memory: dict[str, list[float]] | None = None,
    ) -> None:
        windows = judge.windows
        untaught = untaught_scale(healthy.log_covariance, healthy.degrees_of_freedom, healthy.pieces)
        self.judge, self._may_stay = judge, healthy.temperature_k > 0.0
        self._scales = windows.scales or (untaught,)
        self._along, self._healthy = directions(), self._scales[-1].healthy_windows
        self._detector = Detector(len(self._scales), self._along.weights)
        self._pieces = 2 ** self._scales[0].halvings
        self.piece_s, self._fastest = windows.window_s / self._pieces, judge.peaks[2]
        # At most every other window alarms.
        self.windows = max(YEAR_S / false_alarms_per_year / windows.window_s, 2.0)
        self.threshold = self.windows * self._pieces
        self._learned = Learned(self._scales)
        most = np.array(windows.most) if windows.most else np.full(len(AXES), math.inf)
        self._counting = Counting(self._healthy, most, np.zeros(len(AXES)))
        self._at: FloatArray = np.zeros(len(NAMES))
        self._toward, self._quiet, self._drive, self._is_aside = -1, 0.0, 0, False
        self.begin()
        self._holds = tails_hold(windows.replayed, self._healthy * self._pieces)
        self._can_count = bool(windows.most)
        if memory:
            self._remember(memory)

    @property
    def adds_up(self) -> bool:
        """Whether the e-detector alarms; else counting does."""
        return self._holds or self._quiet >= self.threshold or not self._can_count

    @property
    def promise(self) -> str:
        """What holds of the rate of false alarms, in words."""
        return promised(
            self._counting.healthy,
            self.judge.windows.window_s,
            self.windows,
            len(AXES),
            adds_up=self.adds_up if self._can_count else None,
        )

    @property
    def _own(self) -> WindowJudge:
        """The judge of windows that are driven as the last one was."""
        return self.judge.under(self._drive)

    @property
    def goes_on(self) -> bool:
        """Whether the last alarm still goes on."""
        return self._toward >= 0

    def heard(self, recording: Recording, since_s: float) -> bool:
        """Whether what a window says up to now is an alarm.

        Args:
            recording: its samples so far, with some before it.
            since_s: end of what was heard of it before.
        """
        recording = averaged(recording, self.judge.windows.window_s)
        if len(self._scales) == 1 or not self.judge.is_sampled_alike(recording):
            return False
        ends = np.searchsorted(
            recording.time_s, np.append(np.arange(since_s, recording.time_s[-1], self.piece_s), math.inf)
        )
        ends = ends[np.append(True, np.diff(ends) > 1)]
        ends[-1] = len(recording.time_s)
        first = max(int(ends[0]) - CONTEXT, 0)
        try:
            record = from_recordings([cut(recording, slice(first, None))])
        except UnusableError:
            return False
        record = replace(record, hold=self.judge.windows.hold)
        is_alarm = False
        for n in range(len(ends) - 1):
            pair = [int(ends[n]) - first, int(ends[n + 1]) - first]
            self._sections.append(sections_of(self._own, record, self._at, pair))
            is_alarm |= self._piece()
        if is_alarm and not self.adds_up:
            self._detector.forget()
        return is_alarm and self.adds_up

    def _piece(self) -> bool:
        """The last section, and the longer pieces that end with it."""
        self._quiet += 1.0
        for n, scale in enumerate(self._scales[:-1]):
            together = 2 ** (self._scales[0].halvings - scale.halvings)
            if len(self._sections) % together == 0:
                part = Sections.joined(self._sections[-together:])
                for row in zip(*self._scored(n, part.pieces(together, self._at, self._fastest)), strict=True):
                    self._detector.add(n, row[0], together, row[1])
        return self._is_alarm()

    def _scored(self, n: int, pieces: Pieces) -> tuple[FloatArray, FloatArray]:
        """Normal scores of pieces and their reach; none in a state of which too little is known."""
        scale = self._learned.scale(n)
        found = calibrated(scale, pieces, self._along.along)
        scores = normal_scores(scale, pieces.states, found, self.windows)
        is_known = scale.counts[pieces.states] >= _FEWEST
        return scores[is_known], reaches(scale, found, self._along.along)[is_known]

    def _is_alarm(self) -> bool:
        if not self._detector.passes(self.threshold):
            return False
        self._toward, self._quiet = self._detector.strongest[1], 0.0
        return True

    def ended(self, fit: FittedWindow) -> bool:
        """Whether a whole window is, or goes on, an alarm."""
        logs = fit.log_values - self._own.reference.log_values
        pieces = Pieces(logs[None], fit.log_covariance[None], np.zeros(1, dtype=np.intp))
        (scores,), (reach,) = self._scored(len(self._scales) - 1, pieces)
        self._detector.add(len(self._scales) - 1, scores, self._pieces, reach)
        places, allowed, _ = places_on_axes(self._scales[-1], pieces)
        stays = farthest(self._scales[-1], self.windows) if self._may_stay else 0.0
        self._counting.add(places[0] - stays * allowed[0])
        if self._is_alarm():
            self._detector.forget()
        elif scores.max() < _GOES_ON:
            self._toward = -1
        is_counted = self._counting.alarms(self.windows)
        is_alarm = self._toward >= 0 if self.adds_up else is_counted
        if self._toward < 0 and not is_counted and scores.max() < _SUSPECT:
            self._learn(pieces, places[0])
        else:
            self._learned.skip()
        if not is_alarm:
            self._at = logs
        return is_alarm

    def _learn(self, window: Pieces, places: FloatArray) -> None:
        parts: list[Pieces | None] = []
        for scale in self._scales[:-1]:
            together = 2 ** (self._scales[0].halvings - scale.halvings)
            whole = len(self._sections) >= together
            parts.append(
                Sections.joined(self._sections).pieces(together, self._at, self._fastest) if whole else None
            )
        self._learned.hear([*parts, window])
        most = min(_MOST_LEARNED, _LEARNED_S / self.judge.windows.window_s)
        if self._counting.healthy - self._healthy < most:
            self._counting.learn(places)

    def begin(self) -> None:
        """A window begins."""
        self._sections: list[Sections] = []
        self._known = deepcopy(self._detector), self._quiet  # what was known before it

    def cut(self) -> None:
        """The window breaks off, or tells nothing."""
        self._learned.skip()

    def sets_aside(self, window: Recording) -> bool:
        """Whether a window is driven otherwise than healthy ones; then it is no evidence, and teaches nothing.

        If it is driven as in another of several drives, it is heard anew, beside those.
        """
        drive, off = self.judge.drive_of(window)
        self._is_aside = off > 1.0
        if not self._is_aside and drive == self._drive:
            return False
        (self._detector, self._quiet), self._toward = self._known, -1
        self._learned.skip()
        if not self._is_aside:
            self._at, self._drive = np.zeros(len(NAMES)), drive
            self.begin()
            self.heard(window, float(window.time_s[0]))
        return self._is_aside

    def alarm(self, recording: Recording, rate: float) -> Judgement | None:
        """The judgement on what an alarm is about; None where it tells nothing. The evidence begins anew.

        The fault begins in the first of its pieces, which is not fitted where there are more. Where the samples fit no
        fault, as some of them may still be healthy, the evidence names it, unless something else has moved as well.
        Where the window before, or the recording's end, is driven otherwise, or the two are in two ways, the evidence
        waits for the window's end.
        """
        pieces = min(max(math.ceil(self._detector.strongest[2]), 1), self._pieces)
        span_s, fitted_s = pieces * self.piece_s, max(pieces - 1, 1) * self.piece_s
        toward, share = self._toward, float(self._detector.shares[self._toward])
        recording = averaged(recording, self.judge.windows.window_s)
        failed = self.judge.failed_sensor(recording)
        drive, off = self.judge.drive_of(recording)
        if failed is None and (self._is_aside or off > 1.0 or drive != self._drive):
            self._toward = -1
            return None
        self._detector.forget()
        if (judged := failed or self._fitted(recording, fitted_s, rate)) is None:
            return None
        judged = self._along.named(judged, toward, share)
        return replace(judged, begin_s=float(recording.time_s[-1]) - span_s, duration_s=span_s)

    def _fitted(self, recording: Recording, span_s: float, rate: float) -> Judgement | None:
        try:
            record = replace(from_recordings([recording]), hold=self.judge.windows.hold)
        except UnusableError:
            return None
        if (found := end_of(record, span_s, self._own, self._at, self._learned.scale(0))) is None:
            return None
        logs, spread = found
        reference = replace(self._own.reference, log_covariance=spread, excess=1.0)
        return decide(FittedWindow(reference.log_values + logs, spread), reference, rate, alarm=True)

    @property
    def memory(self) -> dict[str, list[float]]:
        """All that a later watch needs to go on."""
        arrays = {
            "at": self._at,
            "counted": np.array([self._counting.healthy, self._toward, self._quiet, self._drive]),
            "most": self._counting.most,
            "rows": self._counting.rows,
            **self._detector.memory,
            **self._learned.memory,
        }
        return {name: np.nan_to_num(array).ravel().tolist() for name, array in arrays.items()}

    def _remember(self, memory: dict[str, list[float]]) -> None:
        if {n: len(row) for n, row in memory.items()} != {n: len(row) for n, row in self.memory.items()}:
            raise InputError("the memory of the state is not that of this motor; give another --state")
        arrays = {name: np.array(row) for name, row in memory.items()}
        healthy, toward, self._quiet, drive = memory["counted"]
        allowed = (
            0 <= healthy < 1e9,
            -1 <= toward < len(self._along.weights),
            0 <= drive < max(len(self.judge.windows.drives), 1),
        )
        try:
            require(all(allowed), "counted is out of range")
            self._learned.remember(arrays)
        except ValueError:
            raise InputError("the memory of the state is that of no watch; give another --state") from None
        self._detector.remember(arrays)
        self._at, self._toward, self._drive = arrays["at"], int(toward), int(drive)
        most = arrays["most"] if self._can_count else self._counting.most
        self._counting = Counting(int(healthy), most, arrays["rows"])
