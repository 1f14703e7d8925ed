"""What is wrong with a recording: a kind for programs, a text for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class UnusableError(ValueError):
    """A recording that can be read but not judged; the message says why."""


class DefectKind(StrEnum):
    """What a recording can show of its sensor and its supply."""

    SATURATION = "saturation"
    QUANTISATION = "quantisation"
    RECTIFICATION = "rectification"
    WILD_SAMPLE = "wild_sample"
    PWM_RIPPLE = "pwm_ripple"
    SUPPLY_RAMP = "supply_ramp"
    SENSOR_LAG = "sensor_lag"
    SPEED_LAG = "speed_lag"
    DEAD_ZONE = "dead_zone"


@dataclass(frozen=True, slots=True)
class Defect:
    """One defect of a recording."""

    kind: DefectKind
    text: str

    def __str__(self) -> str:
        return self.text
