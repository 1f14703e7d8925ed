"""Name the motor that a file is of, and say how that motor stands among the others of its fleet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.diagnose import Diagnosis
from motor_env.diagnosis.verdict.hypotheses import Difference
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor import identifiable

_GROUPS = ("machine", "motor", "repeat")


class UnitId(NamedTuple):
    """Machine and place of a motor.

    Attributes:
        machine: that the motor is part of.
        motor: its place in the machine, such as left or right; empty where machines have one motor each.
    """

    machine: str
    motor: str = ""

    @property
    def name(self) -> str:
        """Join both, as tables show it."""
        return f"{self.machine} {self.motor}".strip()


def unit_ids(files: Sequence[Path], group: str | None) -> list[UnitId]:
    """Read machine and motor from each file's name.

    Args:
        files: recordings.
        group: regular expression searched in a file's name without its ending, with named groups machine, motor and
            repeat; without it each file is a machine of its own.

    Raises:
        InputError: no regular expression, one without these groups, or a name that it does not match.
    """
    if group is None:
        return [UnitId(path.stem) for path in files]
    try:
        pattern = re.compile(group)
    except re.error as error:
        raise InputError(f"--group must be a regular expression, got {group!r} ({error})") from None
    known = set(pattern.groupindex)
    if not known or known - set(_GROUPS):
        raise InputError(f"--group must have named groups of {', '.join(_GROUPS)}, got {sorted(known)}")
    if not known & {"machine", "motor"}:
        raise InputError("--group must have a group machine or motor: a repeat alone tells no motor")
    found = []
    for path in files:
        match = pattern.search(path.stem)
        if match is None:
            raise InputError(f"{path}: --group {group!r} does not match its name")
        parts = match.groupdict(default="")
        # Motors without machines are machines of one motor each.
        machine = parts.get("machine") or parts.get("motor", "")
        found.append(UnitId(machine, parts.get("motor", "") if "machine" in known else ""))
    return found


_CLEAR = 2.0  # standard deviations
_MOST_ODD = 3
_ALONE = re.compile(",? and nothing else moved")


@dataclass(frozen=True, slots=True)
class FleetUnit:
    """A motor of the fleet, judged by the others.

    Attributes:
        unit_id: machine and motor.
        records: diagnosis of each of its files.
        quantities: that the fleet's records tell.
        difference: from the healthy population of the other motors; None without a fit.
        common_cause: what all motors of its machine show together; empty for nothing.
    """

    unit_id: UnitId
    records: dict[Path, Diagnosis]
    quantities: tuple[str, ...]
    difference: Difference | None = None
    common_cause: str = ""

    @property
    def ratios(self) -> dict[str, float]:
        """Divide its quantities by those of a healthy motor; empty without a fit."""
        if self.difference is None:
            return {}
        return dict(zip(self.quantities, np.exp(self.difference.log_ratios).tolist(), strict=True))

    @property
    def deviations(self) -> dict[str, float]:
        """Count standard deviations of another healthy motor between each quantity and the population."""
        if self.difference is None:
            return {}
        sd = np.sqrt(np.diag(self.difference.covariance))
        return dict(zip(self.quantities, (self.difference.log_ratios / sd).tolist(), strict=True))

    @property
    def p_value(self) -> float | None:
        """Compute the share of healthy motors that lie as far off (Hotelling)."""
        if self.difference is None:
            return None
        deviations = self.difference.log_ratios
        return self.difference.p_value(
            float(deviations @ np.linalg.solve(self.difference.covariance, deviations)), len(deviations)
        )

    @property
    def telling(self) -> Diagnosis:
        """Choose the record that the verdict rests on: the surest of those with a fault."""
        faults = [record for record in self.records.values() if record.verdict.is_fault]
        calm = [record for record in self.records.values() if record.verdict is Verdict.HEALTHY]
        rest = next(iter([*calm, *self.records.values()]))
        return max(faults, key=lambda record: record.confidence or 0.0, default=rest)

    @property
    def verdict(self) -> Verdict:
        """Verdict on the motor."""
        return self.telling.verdict

    @property
    def odd(self) -> str:
        """List the quantities that lie farthest from the population."""
        ratios = self.ratios
        return ", ".join(f"{name} {ratios[name] - 1.0:+.0%}" for name in self._far)

    @property
    def _far(self) -> list[str]:
        deviations = self.deviations
        far = sorted(deviations, key=lambda name: -abs(deviations[name]))[:_MOST_ODD]
        return [name for name in far if abs(deviations[name]) > _CLEAR]

    def to_json(self) -> dict[str, Any]:
        """Build one object for programs."""
        record = self.telling
        return {
            "motor": self.unit_id.name,
            "machine": self.unit_id.machine,
            "files": [str(path) for path in self.records],
            "verdict": str(record.verdict),
            "kind": None if record.kind is None else str(record.kind),
            "severity": record.severity,
            "severity_interval": record.severity_interval,
            "confidence": record.confidence,
            "p_value": self.p_value,
            "ratios": self.ratios,
            "standard_deviations": self.deviations,
            "reasons": list(record.reasons),
            "together": self.common_cause or None,
        }

    @property
    def shown_severity(self) -> str:
        """Format the severity of its fault; empty without one."""
        severity = self.telling.severity
        return f"{severity:+.0%}" if severity and self.verdict.is_fault else ""

    @property
    def why(self) -> str:
        """Give the first reason of a verdict that is not healthy, and what the machine's motors show together."""
        own = "" if self.verdict is Verdict.HEALTHY else self._reason
        both = (
            f"all motors of {self.unit_id.machine} together: {self.common_cause}" if self.common_cause else ""
        )
        return "; ".join(filter(None, (own, both)))

    @property
    def _reason(self) -> str:
        """Give the verdict's first reason, without denying other quantities that the table names."""
        reason, kind, far = self.telling.reasons[0], self.telling.decisive.fault_kind, self._far
        if kind is None or not far:
            return reason
        moved = identifiable.visible_direction(kind, identifiable.matrix(tuple(far)))
        alone = _ALONE.sub("", reason)
        return f"mostly, {alone}" if alone != reason and not moved.all() else reason

    @property
    def shown(self) -> str:
        """Describe it in a line on the screen; of a failed sensor, quantities say nothing."""
        return self.why if self.verdict is Verdict.SENSOR else self.odd or self.why
