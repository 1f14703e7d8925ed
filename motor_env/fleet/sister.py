"""A motor of a fleet, judged by the others."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.diagnosis.diagnose import Diagnosis
from motor_env.diagnosis.hypotheses import Difference
from motor_env.diagnosis.verdict import Verdict
from motor_env.fleet.names import Place
from motor_env.motor import identifiable

_CLEAR = 2.0  # standard deviations
_MOST_ODD = 3
_ALONE = re.compile(",? and nothing else moved")


@dataclass(frozen=True, slots=True)
class Sister:
    """A motor of the fleet, judged by the others.

    Attributes:
        place: machine and motor.
        records: diagnosis of each of its files.
        quantities: that the fleet's records tell.
        apart: how far it lies from the core of its sisters, as healthy motors scatter; None where no fit tells.
        together: what all motors of its machine show together; empty for nothing.
    """

    place: Place
    records: dict[Path, Diagnosis]
    quantities: tuple[str, ...]
    apart: Difference | None = None
    together: str = ""

    @property
    def ratios(self) -> dict[str, float]:
        """Its quantities over those of a healthy sister; none where no fit tells."""
        if self.apart is None:
            return {}
        return dict(zip(self.quantities, np.exp(self.apart.log_ratios).tolist(), strict=True))

    @property
    def off(self) -> dict[str, float]:
        """How far each lies from the core, in standard deviations of another healthy motor."""
        if self.apart is None:
            return {}
        sd = np.sqrt(np.diag(self.apart.covariance))
        return dict(zip(self.quantities, (self.apart.log_ratios / sd).tolist(), strict=True))

    @property
    def p_value(self) -> float | None:
        """Share of healthy sisters that are as odd (Hotelling)."""
        if self.apart is None:
            return None
        off = self.apart.log_ratios
        return self.apart.p_value(float(off @ np.linalg.solve(self.apart.covariance, off)), len(off))

    @property
    def telling(self) -> Diagnosis:
        """The record that the verdict rests on: the surest of those with a fault."""
        faults = [one for one in self.records.values() if one.verdict.is_fault]
        calm = [one for one in self.records.values() if one.verdict is Verdict.HEALTHY]
        rest = next(iter([*calm, *self.records.values()]))
        return max(faults, key=lambda one: one.confidence or 0.0, default=rest)

    @property
    def verdict(self) -> Verdict:
        """Verdict on the motor."""
        return self.telling.verdict

    @property
    def odd(self) -> str:
        """What is odd: the quantities that lie farthest from the core's."""
        ratios = self.ratios
        return ", ".join(f"{name} {ratios[name] - 1.0:+.0%}" for name in self._far)

    @property
    def _far(self) -> list[str]:
        off = self.off
        far = sorted(off, key=lambda name: -abs(off[name]))[:_MOST_ODD]
        return [name for name in far if abs(off[name]) > _CLEAR]

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
            "together": self.together or None,
        }

    @property
    def shown_severity(self) -> str:
        """Severity of its fault as the table shows it; empty without one."""
        severity = self.telling.severity
        return f"{severity:+.0%}" if severity and self.verdict.is_fault else ""

    @property
    def why(self) -> str:
        """The first reason of a verdict that is not healthy, and what the machine's motors show together."""
        own = "" if self.verdict is Verdict.HEALTHY else self._own
        both = f"all motors of {self.place.machine} together: {self.together}" if self.together else ""
        return "; ".join(filter(None, (own, both)))

    @property
    def _own(self) -> str:
        """The verdict's first reason; where the table names other quantities beside those of the fault, it says so."""
        reason, kind, far = self.telling.reasons[0], self.telling.decisive.fault_kind, self._far
        if kind is None or not far:
            return reason
        moved = identifiable.visible_direction(kind, identifiable.matrix(tuple(far)))
        alone = _ALONE.sub("", reason)
        return f"mostly, {alone}" if alone != reason and not moved.all() else reason

    @property
    def shown(self) -> str:
        """What the table on the screen says of it; of a sensor that failed, quantities say nothing."""
        return self.why if self.verdict is Verdict.SENSOR else self.odd or self.why
