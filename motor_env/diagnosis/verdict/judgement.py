"""Judgements on the pieces of a recording, and the verdict that follows from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from motor_env.common.console import ExitStatus
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.readers.regime import RegimeDecision
from motor_env.diagnosis.verdict.healthy_motor import Reference
from motor_env.diagnosis.verdict.hypotheses import Change, Fitted
from motor_env.filters.consistency import Consistency, check_consistency
from motor_env.motor.faults import FaultKind
from motor_env.motor.identifiable import fault_direction, matrix

SURE_OF_KIND = 0.95
"""Least posterior probability of a named kind."""
_FEWEST_FOR_WHITENESS = 40
NOTHING_ELSE = " and nothing else moved"
_LARGEST = 100.0  # of a quantity that the healthy motor determines


def percent(share: float, form: str = "+.1%") -> str:
    """Format a relative change, up to 10,000 %."""
    return format(share, form) if share <= _LARGEST else f"over {_LARGEST:,.0%}"


class Verdict(StrEnum):
    """Verdict on a recording: healthy, a family of faults, or none."""

    HEALTHY = "healthy"
    BEARING = "bearing"
    WINDING = "winding"
    MAGNET = "magnet"
    SENSOR = "sensor"
    NOISE = "noise"
    OTHER = "other"
    NO_REFERENCE = "no_reference"
    UNUSABLE = "unusable"

    @property
    def is_fault(self) -> bool:
        """Whether it calls for action."""
        return self not in (Verdict.HEALTHY, Verdict.NO_REFERENCE, Verdict.UNUSABLE)

    @property
    def status(self) -> ExitStatus:
        """Exit status of this verdict alone."""
        if self.is_fault:
            return ExitStatus.FAULT
        return ExitStatus.HEALTHY if self is Verdict.HEALTHY else ExitStatus.UNDECIDED

    @classmethod
    def _missing_(cls, value: object) -> Verdict | None:
        """Return the verdict of a registered fault kind."""
        if value not in {kind.verdict for kind in FaultKind}:
            return None
        word = str.__new__(cls, value)
        word._name_, word._value_ = str(value).upper(), str(value)
        return _REGISTERED.setdefault(str(value), word)


_REGISTERED: dict[str, Verdict] = {}


@dataclass(frozen=True, slots=True)
class Judgement:
    """Verdict on one piece of a recording, and its evidence.

    Attributes:
        verdict: on the piece.
        reasons: sentences.
        severity: size of the fault as a fraction; 0 for a healthy motor.
        severity_interval: 95 %.
        confidence: posterior probability of the verdict.
        fault_kind: the most probable kind of the family.
        kind_probability: posterior probability of that kind.
        also: further faults at once, each as a judgement.
        fit: the fitted piece, if any.
        reference: of the comparison.
        changes: of each quantity from the reference.
        smallest_changes: severity of each fault that is found in 95 of 100 cases.
        begin_s: begin of the piece on the recording's clock.
        duration_s: length of the piece.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    severity: float | None = None
    severity_interval: tuple[float, float] | None = None
    confidence: float | None = None
    fault_kind: FaultKind | None = None
    kind_probability: float = 0.0
    also: tuple[Judgement, ...] = ()
    fit: Fitted | None = None
    reference: Reference | None = None
    changes: tuple[Change, ...] = ()
    smallest_changes: dict[str, float] = field(default_factory=dict)
    begin_s: float = 0.0
    duration_s: float = 0.0

    def on(self, piece: Recording) -> Judgement:
        """Return the judgement with the time of its piece."""
        return replace(self, begin_s=float(piece.time_s[0]), duration_s=len(piece.time_s) * piece.dt_s)

    def as_other(self, *reasons: str) -> Judgement:
        """Return the verdict `other` with these reasons, without kind and size."""
        return replace(
            self,
            verdict=Verdict.OTHER,
            reasons=reasons,
            severity=None,
            severity_interval=None,
            fault_kind=None,
            also=(),
        )

    @property
    def kind(self) -> FaultKind | None:
        """Kind of the fault, if it is distinguished from the others of its family."""
        return self.fault_kind if self.kind_probability >= SURE_OF_KIND else None

    @property
    def identified(self) -> StartFit | None:
        """Fit of a start; None for other pieces."""
        return self.fit if isinstance(self.fit, StartFit) else None

    @property
    def consistency(self) -> Consistency | None:
        """Consistency of the fit's innovations; None with too few of them."""
        if self.fit is None or len(self.fit.whitened) <= _FEWEST_FOR_WHITENESS:
            return None
        return check_consistency(self.fit.whitened)

    @property
    def warning(self) -> str:
        """Sentence on an inconsistent fit; empty if consistent."""
        return "" if self.consistency is None else self.consistency.warning


def describe_findings(kinds: Sequence[FaultKind], changes: Sequence[Change]) -> Iterator[str]:
    """Describe what faults moved and where to look, and what moved that they do not move, by its interval."""
    powers, of_sensor = np.array([fault_direction(k) for k in kinds]), any(k.is_sensor for k in kinds)
    moved = [change for change in changes if change.excludes_healthy and not of_sensor]
    beside = [change for change in moved if not np.any(powers @ matrix((change.name,)).T)]
    is_decided = all(change.verdict != "undecided" for change in changes)
    for kind in kinds:
        what, colon, where = kind.finding.partition(":")
        alone = len(kinds) == 1 and not beside and not of_sensor and is_decided
        yield f"{what}{NOTHING_ELSE if alone else ''}{colon}{where}"
    for change in beside:
        yield (
            f"{change.name} changed, too, by {percent(change.ratio - 1.0)} ({percent(change.low - 1.0)} to"
            f" {percent(change.high - 1.0)}): a further fault, or the model's error beside so large a one"
        )


@dataclass(frozen=True, slots=True)
class JudgedRecording:
    """Verdict on a recording, by judgements on its pieces; for attributes see `diagnose.Diagnosis`."""

    recording: Recording
    taken: RegimeDecision
    pieces: tuple[Judgement, ...]
    of: int = 1
    periods_per_turn: float | None = None

    @property
    def decisive(self) -> Judgement:
        """The piece that decides the verdict.

        It is the surest of the most frequent fault, else the first healthy one, else the first.
        """
        faults = [piece for piece in self.pieces if piece.verdict.is_fault]
        count = Counter(piece.verdict for piece in faults)
        healthy = (piece for piece in self.pieces if piece.verdict is Verdict.HEALTHY)
        calm = next(healthy, self.pieces[0])
        return max(faults, key=lambda piece: (count[piece.verdict], piece.confidence or 0.0), default=calm)

    @property
    def verdict(self) -> Verdict:
        """Verdict of the decisive piece."""
        return self.decisive.verdict

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences."""
        return self.decisive.reasons

    @property
    def severity(self) -> float | None:
        """Size of the fault."""
        return self.decisive.severity

    @property
    def confidence(self) -> float | None:
        """Posterior probability of the verdict."""
        return self.decisive.confidence

    @property
    def kind(self) -> FaultKind | None:
        """Kind of the fault, if distinguished from others of its family."""
        return self.decisive.kind

    @property
    def changes(self) -> tuple[Change, ...]:
        """Change of each quantity from the reference."""
        return self.decisive.changes

    @property
    def severity_interval(self) -> tuple[float, float] | None:
        """Interval of the severity, 95 %; None without one."""
        return self.decisive.severity_interval

    @property
    def also(self) -> tuple[Judgement, ...]:
        """Further faults at once."""
        return self.decisive.also

    @property
    def smallest_changes(self) -> dict[str, float]:
        """Severity of each fault that is found in 95 of 100 cases."""
        return self.decisive.smallest_changes
