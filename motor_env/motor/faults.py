"""Faults as values: what is wrong, how much, since when, and what that does to the parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from motor_env.common.arrays import real, shown
from motor_env.motor.fault_kinds import (
    BUILT_IN_KINDS,
    ENTRY_POINTS,
    HEALTHY,
    NOISE,
    SENSOR_KINDS,
    FaultKind,
    motor_kinds,
    register_fault_kind,
)
from motor_env.motor.parameters import (
    QUANTITY_FIELDS,
    FloatArray,
    Floats,
    MotorParameters,
    require,
    require_positive,
)

__all__ = [
    # Of kinds.
    "BUILT_IN_KINDS",
    "ENTRY_POINTS",
    "HEALTHY",
    "SENSOR_KINDS",
    "FaultKind",
    "motor_kinds",
    "register_fault_kind",
    # Of faults.
    "ALWAYS",
    "Fault",
    "NoiseSource",
    "apply_fault",
    "apply_faults",
    "noise_variance_factor",
]

ALWAYS = -math.inf
"""The onset of a fault that is there from the beginning."""


class NoiseSource(StrEnum):
    """Where a noise fault enters (paper, part 3B)."""

    MEASUREMENT = "measurement"
    PROCESS = "process"


_SOURCES = tuple(NoiseSource)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault: its kind, its severity, when it begins and how it grows.

    Attributes:
        kind: bearing: friction B up by the severity. winding_contact: resistance R up by the severity (bad contact or
            brush). winding_short: a fraction of the turns equal to the severity is shorted. noise: the variance of
            `noise_source` up by the severity. magnet: torque and back-EMF constant down by the severity. Those of
            sensors (`SENSOR_KINDS`) change what is read: see `motor_env.simulation.failed_sensors`.
        severity: relative size, 0.25 for 25 %; a float, or one entry a motor. Below 1 where something is lost.
        onset_s: time of the onset, counted from the step of the supply; `ALWAYS` for a fault that was always there.
            The fault acts in every sampling interval that begins at or after it.
        growth_s: time over which the severity rises linearly from 0; 0 for an abrupt fault.
        noise_source: for kinds that change the noise only.

    Raises:
        ValueError: a severity is negative (or not below 1 where something is lost), a time is not a number, or a
            fault that is always there grows.
    """

    kind: FaultKind
    severity: Floats
    onset_s: float = ALWAYS
    growth_s: float = 0.0
    noise_source: NoiseSource = NoiseSource.MEASUREMENT

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", FaultKind(self.kind))
        if str(self.noise_source) not in _SOURCES:
            raise ValueError(
                f"noise_source must be one of {', '.join(_SOURCES)}, got {shown(self.noise_source)}"
            )
        object.__setattr__(self, "noise_source", NoiseSource(str(self.noise_source)))
        severity = require_positive("severity", self.severity, zero_allowed=True)
        object.__setattr__(self, "severity", severity)
        self.kind.require_severity(severity)
        onset_s = float(real("onset_s", self.onset_s, ()))
        require(not math.isnan(onset_s), "onset_s must be a number, got nan")
        object.__setattr__(self, "onset_s", onset_s)
        growth_s = require_positive("growth_s", self.growth_s, zero_allowed=True, one=True)
        object.__setattr__(self, "growth_s", growth_s)
        require(
            self.growth_s == 0.0 or math.isfinite(self.onset_s),
            f"growth_s must be 0 for a fault that is always there, got {self.growth_s:g}",
        )

    @property
    def is_constant(self) -> bool:
        """Whether the severity never changes."""
        return self.onset_s == ALWAYS

    def fraction_at(self, time_s: FloatArray) -> FloatArray:
        """Share of the severity reached in the sampling intervals that begin at the given times, 0 to 1."""
        # Intervals begin on a grid of floats: an onset meant to be on the grid must not slip by a rounding error.
        elapsed = time_s - self.onset_s + 1e-9 * np.maximum(1.0, np.abs(time_s))
        if self.growth_s == 0.0:
            return (elapsed >= 0.0).astype(np.float64)
        return np.clip(elapsed / self.growth_s, 0.0, 1.0)


def apply_fault(parameters: MotorParameters, fault: Fault) -> MotorParameters:
    """Parameters of the motor with the fault at its full severity: each quantity times its factor."""
    return parameters.scaled(
        **{
            field: fault.kind.factor(quantity, fault.severity)
            for quantity in fault.kind.motor_powers
            for field in QUANTITY_FIELDS[quantity]
        }
    )


def apply_faults(parameters: MotorParameters, faults: Iterable[Fault]) -> MotorParameters:
    """Parameters of the motor with all the faults at their full severities."""
    for fault in faults:
        parameters = apply_fault(parameters, fault)
    return parameters


def noise_variance_factor(faults: Iterable[Fault], source: NoiseSource, time_s: FloatArray) -> FloatArray:
    """Factor on the variance of a noise source in the intervals that begin at `time_s`: the product of all factors.

    Returns:
        Shape (1, n_times), or (n_motors, n_times) where a severity is an array.
    """
    factor = np.ones((1, len(time_s)))
    for fault in faults:
        if fault.kind.changes_noise and fault.noise_source is source:
            severity = np.reshape(fault.severity, (-1, 1)) * fault.fraction_at(time_s)
            factor = factor * fault.kind.factor(NOISE, severity)
    return factor
