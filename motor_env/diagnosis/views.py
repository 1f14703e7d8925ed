"""A start against a healthy motor, for each idea of what its drag is: nobody may have told of a load."""

from __future__ import annotations

from typing import NamedTuple

from motor_env.diagnosis.explanations import (
    Difference,
    Explanation,
    alarm_share,
    explain,
    smallest_changes,
)
from motor_env.diagnosis.healthy_motor import Reference, beyond, warmer, white_error
from motor_env.diagnosis.loaded import Drag, drags
from motor_env.identification.identify import Identified
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray


class View(NamedTuple):
    """A start against its reference, for one idea of what its drag is; `faults` are what may explain it."""

    drag: Drag
    difference: Difference
    faults: list[Explanation]

    def is_alarm(self, limit: float, share: float) -> bool:
        """Whether a fault or the whole stands out."""
        d = self.difference
        p_value = d.p_value(d.squared_distance, len(d.log_ratios))
        return any(fault.z > limit for fault in self.faults) or p_value < share


def views_of(fit: Identified, reference: Reference, rate: float) -> list[View]:
    """A fit against a reference at a rate of false alarms: without a load, and as it looks under each load."""
    same_warmth, share = covariance_at_one_temperature(fit, reference), alarm_share(rate, fit.exponents)
    freedom, views = reference.degrees_of_freedom, []
    for drag in drags(fit, reference.own_friction):
        log_ratios = fit.log_values - reference.log_values - reference.warmer_k * drag.warmth
        covariance = warmer(same_warmth, reference.temperature_k * drag.warmth, share, freedom)
        difference = Difference(log_ratios, covariance, fit.exponents, freedom, drag.response)
        views.append(View(drag, difference, explain(difference)))
    return views


def smallest_of(views: list[View], own: float | None, limit: float) -> dict[str, float]:
    """Smallest severity of each fault that is found in 95 of 100 cases, whatever the drag is.

    Where the motor's `own` share of the drag is known, a bearing fault is one of its own friction.
    """
    smallest: dict[str, float] = {}
    for view in views:
        for kind, severity in smallest_changes(view.difference, limit).items():
            smallest[kind] = max(severity, smallest.get(kind, 0.0))
    return {kind: severity / unit_of(kind, own) for kind, severity in smallest.items()}


def unit_of(kind: str, own: float | None) -> float:
    """What a severity that shows in the whole drag is divided by: that of a bearing fault is of its own friction."""
    return own if own is not None and kind == FaultKind.BEARING else 1.0


def covariance_at_one_temperature(fit: Identified, reference: Reference) -> FloatArray:
    """Covariance of the difference between this start and a healthy motor that is as warm.

    Healthy starts hold errors of fits like this one. Where this start tells less than they did, being shorter or
    noisier, what its own error is beyond theirs is added.
    """
    healthy = reference.log_covariance
    if not reference.includes_fit_error:
        return healthy + fit.log_covariance
    return healthy + beyond(healthy, white_error(fit))
