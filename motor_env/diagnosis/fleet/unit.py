"""Judge one motor of a fleet by the others, and update its healthy parameters by its own records."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.commission import intervals
from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.fleet.fits import Reading
from motor_env.diagnosis.fleet.learning import UnitId, at_centre
from motor_env.diagnosis.fleet.population import floor_covariance
from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.verdict.hypotheses import Difference, Fitted
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Fleet, Healthy
from motor_env.motor.parameters import FloatArray


def update_unit(
    files: Sequence[str | Path], fleet_motor: Motor, name: str, *, reading: Reading | None = None
) -> Motor:
    """Learn the healthy motor from its records and its fleet.

    Args:
        files: healthy records of this motor.
        fleet_motor: learned from a fleet, or by this function.
        name: of the motor.
        reading: how the files are read.

    Raises:
        InputError: the motor was not learned from a fleet, or a record cannot be used.
    """
    healthy = fleet_motor.healthy
    if healthy is None or healthy.fleet is None:
        raise InputError("--motor must be a motor file that `motor-env commission --fleet` has written")
    fits = [fit for path in files for fit in _fits(Path(path), fleet_motor, reading or Reading())]
    learned = combine_with_records(
        healthy,
        np.array([fit.log_values for fit in fits]),
        np.array([fit.log_covariance for fit in fits]),
    )
    return replace(fleet_motor, name=name, healthy=learned)


def unit_quantities(motor: Motor) -> dict[str, dict[str, Any]]:
    """List value, interval (95 %) and unit of each quantity.

    Args:
        motor: of `update_unit`.
    """
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was learned
    assert healthy.fleet is not None  # noqa: S101
    return intervals(healthy, np.maximum(healthy.log_covariance - healthy.fleet.log_within, 0.0), 0.05)


def combine_with_records(healthy: Healthy, logs: FloatArray, errors: FloatArray) -> Healthy:
    """Combine a fleet's motor with records.

    Args:
        healthy: statistics of the fleet.
        logs: logarithms of the quantities of each record, shape (n, p).
        errors: their covariance by the fit, shape (n, p, p).
    """
    assert healthy.fleet is not None  # noqa: S101  # the callers have seen to it
    within = _within_covariance(logs, errors, healthy.fleet)
    between = floor_covariance(
        healthy.log_covariance - healthy.fleet.log_within, 1e-6 * healthy.log_covariance
    )
    prior, information = np.linalg.inv(between), np.linalg.inv(within + errors)
    posterior = np.linalg.inv(prior + information.sum(axis=0))
    centre = posterior @ (prior @ np.log(healthy.values) + np.einsum("npq,nq->p", information, logs))
    return replace(
        healthy,
        pieces=len(logs),
        degrees_of_freedom=healthy.degrees_of_freedom + len(logs),
        values=np.exp(centre),
        log_covariance=posterior + within,
        windows=None if healthy.windows is None else at_centre(healthy.windows, centre),
        fleet=replace(healthy.fleet, log_within=within),
    )


def _fits(path: Path, fleet_motor: Motor, reading: Reading) -> list[Fitted]:
    """Fit a record's pieces.

    Raises:
        InputError: it has none, or of other quantities than the fleet's records.
    """
    diagnosis = diagnose(path, fleet_motor, **reading.options)
    fits = [
        piece.fit
        for piece in diagnosis.pieces
        if piece.fit is not None and piece.verdict is not Verdict.UNUSABLE
    ]
    if not fits:
        raise InputError(f"{path}: a healthy record cannot be used: {diagnosis.reasons[0]}")
    names = fleet_motor.healthy.quantities if fleet_motor.healthy is not None else ()
    if any(fit.quantity_names != names for fit in fits):
        raise InputError(f"{path}: its columns are not those of the sisters, which tell {', '.join(names)}")
    return fits


def _within_covariance(logs: FloatArray, errors: FloatArray, fleet: Fleet) -> FloatArray:
    """Estimate the scatter from record to record by the own records and the fleet's."""
    deviations = logs - logs.mean(axis=0)
    scatter = deviations.T @ deviations - max(len(logs) - 1, 0) * errors.mean(axis=0)
    spread = (scatter + PRIOR_WEIGHT * fleet.log_within) / (len(logs) - 1 + PRIOR_WEIGHT)
    return floor_covariance(spread, fleet.log_within / PRIOR_WEIGHT)


_CLEAR = 2.0  # standard deviations
_MOST_ODD = 3
_ALONE = re.compile(",? and nothing else moved")


@dataclass(frozen=True, slots=True)
class FleetUnit:
    """A motor of the fleet, judged by the others.

    Attributes:
        unit_id: machine and motor.
        records: diagnosis of each of its files.
        quantities: of the fleet's records.
        difference: from the healthy population of the other motors; None without a fit.
        common_cause: wrong scale that all motors of its machine share; empty for none.
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
        """Deviations of its quantities from the population, in standard deviations."""
        if self.difference is None:
            return {}
        sd = np.sqrt(np.diag(self.difference.covariance))
        return dict(zip(self.quantities, (self.difference.log_ratios / sd).tolist(), strict=True))

    @property
    def p_value(self) -> float | None:
        """Share of healthy motors at least as far away (Hotelling)."""
        if self.difference is None:
            return None
        deviations = self.difference.log_ratios
        return self.difference.p_value(
            float(deviations @ np.linalg.solve(self.difference.covariance, deviations)), len(deviations)
        )

    @property
    def decisive(self) -> Diagnosis:
        """Choose the decisive record: the surest with a fault, else the first healthy one."""
        faults = [record for record in self.records.values() if record.verdict.is_fault]
        calm = [record for record in self.records.values() if record.verdict is Verdict.HEALTHY]
        rest = next(iter([*calm, *self.records.values()]))
        return max(faults, key=lambda record: record.confidence or 0.0, default=rest)

    @property
    def verdict(self) -> Verdict:
        """Verdict on the motor."""
        return self.decisive.verdict

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
        record = self.decisive
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
        severity = self.decisive.severity
        return f"{severity:+.0%}" if severity and self.verdict.is_fault else ""

    @property
    def why(self) -> str:
        """Give the first reason of a fault, and the common cause of its machine."""
        own = "" if self.verdict is Verdict.HEALTHY else self._reason
        both = (
            f"all motors of {self.unit_id.machine} together: {self.common_cause}" if self.common_cause else ""
        )
        return "; ".join(filter(None, (own, both)))

    @property
    def _reason(self) -> str:
        """Give the first reason, consistent with the quantities that the table names."""
        reason, kind, far = self.decisive.reasons[0], self.decisive.decisive.fault_kind, self._far
        if kind is None or not far:
            return reason
        moved = identifiable.visible_direction(kind, identifiable.matrix(tuple(far)))
        alone = _ALONE.sub("", reason)
        return f"mostly, {alone}" if alone != reason and not moved.all() else reason

    @property
    def shown(self) -> str:
        """Describe the motor in a line; with a failed sensor, without quantities."""
        return self.why if self.verdict is Verdict.SENSOR else self.odd or self.why
