"""Lines of a stream, windows that taught a motor, and a judge of windows that says what it is told to."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

# Reaches in: a judgement and what windows taught are written by hand.
from motor_env import Recording
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.streaming import watch as watching
from motor_env.diagnosis.streaming.sources import Piece
from motor_env.diagnosis.verdict.hypotheses import Change
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.healthy import Healthy, Windows

HEADER = b"speed_rpm,t_ms,voltage_mv,current_ma\n"
WINDOWS = Windows(0.0995, (), np.zeros(index.N_VALUES), "held", 1e-3, 50.0, (11.0, 13.0))
TAUGHT = Healthy(10, 13.0, ("R", "K", "J", "B"), np.ones(4), np.eye(4) * 1e-4, windows=WINDOWS)


def samples(count: int, first_ms: float = 0.0) -> list[Piece]:
    """Every millisecond; none of the columns stands still."""
    return [f"{500 + k % 5},{first_ms + k},{12_000 + k},{100 + k % 7}\n".encode() for k in range(count)]


def joined(pieces: Sequence[Piece]) -> bytes:
    """As they stand in a file."""
    return b"".join(piece for piece in pieces if isinstance(piece, bytes))


def changes(*ratios: float, moved: str = "") -> tuple[Change, ...]:
    """Over R, K, J and B, of which some have moved."""
    return tuple(
        Change(name, ratio, 0.9, 1.1, "moved" if name in moved else "healthy")
        for name, ratio in zip("RKJB", ratios, strict=True)
    )


def judged(word: str, *ratios: float, **more: Any) -> Judgement:
    """A judgement on a window."""
    return Judgement(Verdict(word), ("because",), changes=changes(*ratios), **more)


HEALTHY = judged("healthy", 1.01, 0.98, 1.02, 1.0)


class Judge:
    """In the place of the monitor: notes what it is given, and says what it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *verdicts: Judgement | Exception) -> None:
        self.given: list[Recording] = []
        self.verdicts = list(verdicts)
        self.made: list[tuple[float, dict[str, list[float]] | None]] = []
        monkeypatch.setattr(watching, "judge_of", lambda healthy: SimpleNamespace(windows=healthy.windows))
        monkeypatch.setattr(watching, "SequentialMonitor", self.monitor())

    def monitor(self) -> Any:
        outer = self

        class FakeMonitor:
            def __init__(self, judge: Any, _: Healthy, *, false_alarms_per_year: float, state: Any) -> None:
                self.judge = judge
                outer.made.append((false_alarms_per_year, state))

            def diagnose(self, window: Recording) -> Judgement:
                outer.given.append(window)
                verdict = outer.verdicts.pop(0) if outer.verdicts else HEALTHY
                if isinstance(verdict, Exception):
                    raise verdict
                return verdict

            def describe_false_alarm_rate(self) -> str:
                return "one an hour"

            @property
            def state_dict(self) -> dict[str, list[float]]:
                return {"judged": [float(len(outer.given))]}

        return FakeMonitor
