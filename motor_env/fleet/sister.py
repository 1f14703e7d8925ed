"""A motor of a fleet, judged by the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motor_env.diagnosis.diagnose import Diagnosis
from motor_env.diagnosis.verdict import Verdict
from motor_env.fleet.names import Place

_CLEAR = 2.0  # standard deviations
_MOST_ODD = 3


@dataclass(frozen=True, slots=True)
class Sister:
    """A motor of the fleet, judged by the others.

    Attributes:
        place: machine and motor.
        records: diagnosis of each of its files.
        ratios: of its quantities over those of a healthy sister.
        off: how far each lies from the core, in standard deviations of another healthy motor.
        p_value: of healthy sisters this share is as odd; None where no fit tells.
    """

    place: Place
    records: dict[Path, Diagnosis]
    ratios: dict[str, float]
    off: dict[str, float]
    p_value: float | None

    @property
    def telling(self) -> Diagnosis:
        """The record that the verdict rests on: the surest of those with a fault."""
        faults = [one for one in self.records.values() if one.verdict.is_fault]
        calm = [one for one in self.records.values() if one.verdict is Verdict.HEALTHY]
        rest = next(iter([*calm, *self.records.values()]))
        return max(faults, key=lambda one: one.confidence or 0.0, default=rest)

    @property
    def verdict(self) -> Verdict:
        """Of the motor."""
        return self.telling.verdict

    @property
    def odd(self) -> str:
        """What is odd: the quantities that lie farthest from the core's."""
        far = sorted(self.off, key=lambda name: -abs(self.off[name]))
        named = [name for name in far if abs(self.off[name]) > _CLEAR][:_MOST_ODD]
        return ", ".join(f"{name} {self.ratios[name] - 1.0:+.0%}" for name in named)

    def to_json(self) -> dict[str, Any]:
        """One object for programs."""
        one = self.telling
        return {
            "motor": self.place.name,
            "machine": self.place.machine,
            "files": [str(path) for path in self.records],
            "verdict": str(one.verdict),
            "kind": None if one.kind is None else str(one.kind),
            "severity": one.severity,
            "severity_interval": one.severity_interval,
            "confidence": one.confidence,
            "p_value": self.p_value,
            "ratios": self.ratios,
            "standard_deviations": self.off,
            "reasons": list(one.reasons),
        }

    @property
    def shown_severity(self) -> str:
        """Severity of its fault as the table shows it; empty without one."""
        severity = self.telling.severity
        return f"{severity:+.0%}" if severity and self.verdict.is_fault else ""

    @property
    def why(self) -> str:
        """The first reason of a verdict that is not healthy."""
        return "" if self.verdict is Verdict.HEALTHY else self.telling.reasons[0]
