"""Looks at a motor at work while a window still fills: a fault that shows is said at once.

A look is at the last half of a window's length, the last quarter and so on; each as soon as a quarter of it is new.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from motor_env.diagnosis.decision import decide
from motor_env.diagnosis.learning import PRIOR_WEIGHT
from motor_env.diagnosis.running.windows import (
    NAMES,
    WARMTH,
    FittedWindow,
    WindowJudge,
    averaged,
    is_closed,
)
from motor_env.diagnosis.verdict import Judgement
from motor_env.diagnosis.views import views_of
from motor_env.fitting.record import Record
from motor_env.fitting.recorded import FEWEST, from_recordings
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut

_LOOKS = 4  # while a part of that length passes
_MOST_STEPS = 15
_SETTLED = 0.1  # a step that is shorter, in squared standard deviations, ends them
_TAILS = 80.0
_ANYWHERE = 0.5  # standard deviation of a logarithm


@dataclass(frozen=True, slots=True)
class Looks:
    """Looks at the last samples of a running motor.

    Attributes:
        judge: the healthy motor, learned from windows.
        rate: of false alarms of all looks while a window passes.
        at: how far R, K, J and the drag were from the healthy ones in the last window, logarithms, shape (4,).
    """

    judge: WindowJudge
    rate: float
    at: FloatArray

    @property
    def every_s(self) -> float:
        """Time from one look to the next; infinite where the commissioning has taught nothing of looks."""
        halvings = len(self.judge.windows.excess)
        return float(self.judge.windows.window_s) / math.ldexp(_LOOKS, halvings) if halvings else math.inf

    def due(self, number: int) -> list[int]:
        """How often the window is halved for look number 1, 2, ...: one length or several, the longest first."""
        most = len(self.judge.windows.excess)
        return [k for k in range(1, most + 1) if number % 2 ** (most - k) == 0]

    def needed_s(self, halvings: int) -> float:
        """How many seconds a look needs."""
        return max(math.ldexp(self.judge.windows.window_s, -halvings), (FEWEST + 2) * self.judge.windows.dt_s)

    def at_end(self, recording: Recording, due: Sequence[int]) -> Judgement | None:
        """The first alarm of looks at the end of a recording; None where all is well."""
        recording = averaged(recording, self.judge.windows.window_s)
        if not self.judge.is_sampled_alike(recording):
            return None
        try:
            record = from_recordings([recording])
        except UnusableError:
            return None
        record = replace(record, hold=self.judge.windows.hold)
        lengths = [round(self.judge.windows.window_s / 2**k / record.dt_s) for k in due]
        samples = len(record.voltage_v)
        parts = [record.part(samples - n, n) for n in lengths if n <= samples]
        if not parts:
            return None
        for part, judged in zip(parts, self.judgements(parts, due[-len(parts) :]), strict=True):
            if judged is not None:
                n = len(part.voltage_v)
                span_s = n * record.dt_s
                # A short part may be too steady to show that a sensor failed: the longest one is asked as well.
                parts_of = (cut(recording, slice(-n, None)), recording)
                judged = next(filter(None, map(self.judge.failed_sensor, parts_of)), judged)
                return replace(judged, begin_s=float(recording.time_s[-1]) - span_s, duration_s=span_s)
        return None

    def judgements(self, parts: Sequence[Record], halvings: Sequence[int]) -> Iterator[Judgement | None]:
        """Yield the alarm of each part, or None; part i has the window's length over 2**halvings[i].

        The first step of a fit tells nearly always that all is well. Else the motor may only be warmer than it was: the
        steps go on to the healthy motor that explains the part best, and one more from there. An alarm is confirmed,
        and gets its name, where steps end that may go anywhere.
        """
        healthy = self.judge.reference.log_covariance
        warm = np.outer(WARMTH, WARMTH) * self.judge.reference.temperature_k**2
        firsts = self.judge.first_steps(parts, self.at)
        for part, k, first in zip(parts, halvings, firsts, strict=True):
            found = self._decided(*first, k) if is_closed(part) else None
            for prior in (healthy + warm, np.eye(len(NAMES)) * _ANYWHERE**2):
                if found is not None:
                    found = self._decided(*self._settled(part, prior), k)
            yield found

    def _settled(self, part: Record, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A step from where steps settle under a belief about the logarithms, with its spread."""
        ((ratios, spread),) = self.judge.first_steps([part], self.at)
        for _ in range(_MOST_STEPS):
            at, before = prior @ np.linalg.solve(prior + spread, ratios), ratios
            ((ratios, spread),) = self.judge.first_steps([part], at)
            # On the way a fault of one quantity looks like changes of several.
            if (ratios - before) @ np.linalg.solve(spread, ratios - before) < _SETTLED:
                break
        return ratios, spread

    def _decided(self, ratios: FloatArray, spread: FloatArray, halvings: int) -> Judgement | None:
        spread, rate = spread * self.judge.windows.excess[halvings - 1], self._rate(halvings)
        # No test stands out farther than the whole; most looks end here.
        if ratios @ np.linalg.solve(spread, ratios) < special.ndtri(rate) ** 2:
            return None
        reference = replace(
            self.judge.reference,
            log_covariance=spread,
            degrees_of_freedom=self._freedom(spread, halvings),
            excess=1.0,
        )
        fit = FittedWindow(reference.log_values + ratios, spread)
        # Each test has less than the whole rate: else none of them can alarm.
        whole = -float(special.stdtrit(reference.degrees_of_freedom, rate))
        if not views_of(fit, reference, rate)[0].is_alarm(whole, rate):
            return None
        judged = decide(fit, reference, rate)
        return judged if judged.verdict.is_fault else None

    def _rate(self, halvings: int) -> float:
        """Rate of false alarms of one look. All lengths have an equal share.

        Looks that overlap alarm together: all of them in a share of 1 - rate^0.2 / 2 of the sum of their rates, by
        simulation (0.65 to 0.94 for rates of 1/6 to 2e-5).
        """
        together: float = 1.0 - 0.5 * self.rate**0.2
        return self.rate / together / len(self.judge.windows.excess) / math.ldexp(_LOOKS, halvings)

    def _freedom(self, spread: FloatArray, halvings: int) -> float:
        """Degrees of freedom of a look's spread, of which a share was learned from windows (Satterthwaite 1946).

        What parts of windows teach counts for at most _TAILS: the innovations of a motor that is known by a fit have
        heavier tails than normal ones.
        """
        learned = self.judge.reference.log_covariance * self.judge.windows.excess[halvings - 1]
        share = float(np.trace(np.linalg.solve(spread, learned))) / len(NAMES)
        freedom = self.judge.reference.degrees_of_freedom
        pieces = freedom + 1.0 - PRIOR_WEIGHT
        parts = math.ldexp(len(NAMES) * pieces, halvings)
        return 1.0 / (share**2 / freedom + 1.0 / min(parts, _TAILS))
