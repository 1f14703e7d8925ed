"""A fitted piece against a healthy motor, for each idea of what its drag is: nobody may have told of a load."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from motor_env.diagnosis.explanations import (
    Difference,
    Explanation,
    alarm_share,
    explain,
    smallest_changes,
)
from motor_env.diagnosis.healthy_motor import Reference, with_normal
from motor_env.diagnosis.loaded import Drag, drags
from motor_env.fitting.starts.start_fit import StartFit as Identified
from motor_env.fitting.uncertainty import excess_covariance as beyond
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

NAMES = ("R", "K", "J", "B")
"""What a window tells; B is the drag over the speed."""
EXPONENTS = quantities.matrix(NAMES)
_HOTTEST_K = 100.0
# Of a quantity when it gets warmer or colder: far from the model it follows no straight line.
_LEAST_FACTOR = 0.5


@dataclass(frozen=True, slots=True)
class FittedWindow:
    """A fitted window: logarithms of R, K, J and of the drag over the speed, shape (4,), their covariance, innovations.

    The innovations of current and speed are over their standard deviations, shape (n, 2); none of a short piece.
    """

    quantity_names: ClassVar[tuple[str, ...]] = NAMES
    exponents: ClassVar[FloatArray] = EXPONENTS
    log_values: FloatArray
    log_covariance: FloatArray
    whitened: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def white_covariance(self) -> FloatArray:
        """The covariance, which is that of white residuals."""
        return self.log_covariance


Fitted = Identified | FittedWindow
"""A fitted piece of a recording: a start, or a window of a motor at work."""


class View(NamedTuple):
    """A piece against its reference, for one idea of what its drag is; `faults` are what may explain it."""

    drag: Drag
    difference: Difference
    faults: list[Explanation]

    def is_alarm(self, limit: float, share: float) -> bool:
        """Whether a fault or the whole stands out."""
        d = self.difference
        p_value = d.p_value(d.squared_distance, len(d.log_ratios))
        return any(fault.z > limit for fault in self.faults) or p_value < share


def views_of(fit: Fitted, reference: Reference, rate: float) -> list[View]:
    """A fit against a reference at a rate of false alarms: without a load, and as it looks under each load.

    Only a start is looked at under loads: the fit of a motor at work has terms for them.
    """
    rows, same_warmth = shared(fit, reference), covariance_at_one_temperature(fit, reference)
    exponents, freedom, views = fit.exponents[rows], reference.degrees_of_freedom, []
    share = alarm_share(rate, exponents)
    if isinstance(fit, Identified):
        found = drags(fit, reference.own_friction)
    else:
        found = [Drag(None, fit.exponents, reference.own_friction or 1.0)]
    for each in found:
        drag = replace(each, response=each.response[rows])
        ratios = fit.log_values[rows] - reference.log_values - reference.warmer_k * drag.warmth
        straight = _straightened(ratios, same_warmth, drag.warmth, reference.temperature_k)
        warmer = reference.temperature_k**2 * np.outer(drag.warmth, drag.warmth)
        covariance = with_normal(same_warmth, warmer, share, freedom)
        difference = Difference(straight, covariance, exponents, freedom, drag.response)
        views.append(View(drag, difference, explain(difference)))
    return views


def _straightened(
    ratios: FloatArray, spread: FloatArray, warmth: FloatArray, temperature_k: float
) -> FloatArray:
    """Logarithms that move in proportion to the temperature: the factors do, their logarithms a little less."""
    if temperature_k == 0.0:
        return ratios
    kelvin, _ = kelvin_of(ratios, spread, warmth, temperature_k)
    warm = np.maximum(warmth * min(max(kelvin, -_HOTTEST_K), _HOTTEST_K), _LEAST_FACTOR - 1.0)
    return np.asarray(ratios + warm - np.log1p(warm), dtype=np.float64)


def kelvin_of(
    ratios: FloatArray, spread: FloatArray, warmth: FloatArray, temperature_k: float
) -> tuple[float, float]:
    """How much warmer a motor seems, by the posterior mean and its standard deviation."""
    slope = np.linalg.solve(spread, warmth)
    precision = float(slope @ warmth) + temperature_k**-2
    return float(slope @ ratios) / precision, 1.0 / math.sqrt(precision)


def shared(fit: Fitted, reference: Reference) -> list[int]:
    """Rows of the fit's quantities of which the reference speaks."""
    return [fit.quantity_names.index(name) for name in reference.names]


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


def covariance_at_one_temperature(fit: Fitted, reference: Reference) -> FloatArray:
    """Covariance of the difference between this piece and a healthy motor that is as warm.

    Healthy pieces hold errors of fits like this one. Where this one tells less than they did, being shorter or
    noisier, what its own error is beyond theirs is added.
    """
    healthy, rows = reference.log_covariance, shared(fit, reference)
    own = fit.white_covariance if reference.includes_fit_error else fit.log_covariance
    error = own[np.ix_(rows, rows)]
    added = beyond(healthy, error) if reference.includes_fit_error else error
    return np.asarray((healthy + added) * reference.excess, dtype=np.float64)
