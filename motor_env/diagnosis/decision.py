"""The decision on a fitted recording: its quantities against a reference, with every uncertainty in the balance.

The fit gives the logarithms of what the recording can tell, with a covariance that knows of the model's error; the
reference gives where a healthy motor lies, with the covariance of its tolerances, the temperature and the supply, or
of the spread between healthy starts. Their difference has the sum of both covariances. After an alarm the most
probable fault is named, unless what it leaves unexplained is itself significant or "other" is more probable still. The
confidence is the posterior probability of the verdict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy.special import stdtr, stdtrit

from motor_env.diagnosis.explanations import (
    Change,
    Explanation,
    alarm_share,
    compare,
    explain,
    is_its_own,
    probabilities,
    severity_of,
    significance_limit,
    smallest_changes,
)
from motor_env.diagnosis.filter_check import FilterCheck
from motor_env.diagnosis.healthy_motor import Reference
from motor_env.diagnosis.loaded import LOADS
from motor_env.diagnosis.views import View, covariance_at_one_temperature, smallest_of, unit_of, views_of
from motor_env.identification.identify import Identified
from motor_env.motor.faults import FaultKind, motor_kinds
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.recording import Recording

DEFAULT_FALSE_ALARM_RATE = 0.01
_TELLING_WARMTH_K = 8.0
_DOUBLED = 1.0


class Verdict(StrEnum):
    """What is said of a recording."""

    HEALTHY = "healthy"
    BEARING = "bearing"
    WINDING = "winding"
    MAGNET = "magnet"
    NOISE = "noise"
    OTHER = "other"
    NO_REFERENCE = "no_reference"
    UNUSABLE = "unusable"

    @property
    def is_fault(self) -> bool:
        """Whether it calls for action."""
        return self not in (Verdict.HEALTHY, Verdict.NO_REFERENCE, Verdict.UNUSABLE)

    @classmethod
    def _missing_(cls, value: object) -> Verdict | None:
        """The word of a fault kind that was registered from outside the package."""
        if value not in {kind.verdict for kind in FaultKind}:
            return None
        word = str.__new__(cls, value)
        word._name_, word._value_ = str(value).upper(), str(value)
        return _REGISTERED.setdefault(str(value), word)


_REGISTERED: dict[str, Verdict] = {}


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The verdict on one recording, and what it rests on."""

    recording: Recording
    verdict: Verdict
    reasons: tuple[str, ...]
    severity: float | None = None
    severity_low: float | None = None
    severity_high: float | None = None
    confidence: float | None = None
    fault_kind: FaultKind | None = None
    identified: Identified | None = None
    reference: Reference | None = None
    changes: tuple[Change, ...] = ()
    smallest_changes: dict[str, float] = field(default_factory=dict)
    filter_check: FilterCheck | None = None

    @property
    def warning(self) -> str:
        """That the recording is not consistent with the fitted model, in one sentence; empty where it is."""
        if self.filter_check is None or self.filter_check.consistency is None:
            return ""
        return self.filter_check.consistency.warning


def decide(
    recording: Recording, fit: Identified, reference: Reference, check: FilterCheck, rate: float
) -> Diagnosis:
    """The diagnosis of a fit against a reference, at a rate of false alarms per healthy recording.

    Nobody may have told what makes the drag: an alarm is one only if it is one whatever the drag is.
    """
    freedom, share = reference.degrees_of_freedom, alarm_share(rate, fit.exponents)
    limit = significance_limit(rate, fit.exponents, freedom)
    views = views_of(fit, reference, rate)
    # A data sheet speaks of a motor without a load; there, loads only help to name what stands out.
    believed = views if reference.includes_fit_error else views[:1]
    quiet = next((view for view in believed if not view.is_alarm(limit, share)), None)
    view = quiet or views[0]
    same_warmth, log_ratios = covariance_at_one_temperature(fit, reference), views[0].difference.log_ratios
    changes = compare(fit.quantity_names, log_ratios, same_warmth, freedom, math.inf if quiet else limit)
    healthy = Diagnosis(
        recording,
        Verdict.HEALTHY,
        (
            f"no quantity has moved further than {reference.source} and the fit's own error allow",
            *_warmth_reason(view, same_warmth, reference),
        ),
        severity=0.0,
        confidence=probabilities(view.difference, view.faults)["healthy"],
        identified=fit,
        reference=reference,
        changes=changes,
        filter_check=check,
        smallest_changes=smallest_of(believed, reference.own_friction, limit),
    )
    if quiet is None:
        return _with_alarm(healthy, views, limit, rate)
    # Healthy starts may scatter by their load; that is no defect of this recording.
    spread = fit.log_covariance if reference.includes_fit_error else view.difference.covariance
    unseen = _unseen_fault(smallest_changes(replace(view.difference, covariance=spread), limit))
    if unseen is not None:
        return replace(healthy, verdict=Verdict.UNUSABLE, reasons=(unseen,), severity=None, confidence=None)
    return _with_noise(healthy, fit, reference, limit)


def _with_alarm(healthy: Diagnosis, views: list[View], limit: float, rate: float) -> Diagnosis:
    """The fault that explains an alarm, or that none does; a load is thought of where nothing does without one.

    The warmth is that of a motor without a load: where the load is open as well, too much would explain too much.
    """

    def suffices(fault: Explanation) -> bool:
        return fault.z > limit and fault.p_left_over > rate and is_its_own(first.difference, fault.kind)

    first = views[0]
    for view in views[:1] if any(map(suffices, first.faults)) else views:
        difference = replace(first.difference, response=view.drag.response)
        faults = explain(difference)
        probability = probabilities(difference, faults)
        best = max(filter(suffices, faults), key=lambda fault: probability[fault.kind], default=None)
        if best is not None and probability[best.kind] >= probability["other"]:
            return _with_fault(healthy, best, difference.degrees_of_freedom, probability, view.drag.load)
    named = {fault.kind for fault in first.faults}
    unnamed = tuple(kind for kind in motor_kinds() if kind not in named)
    alike = map(_alike_reason, filter(suffices, explain(first.difference, unnamed)))
    reasons = (*_other_reasons(healthy.changes, _source(healthy)), *alike)
    confidence = probabilities(first.difference, first.faults)["other"]
    return replace(healthy, verdict=Verdict.OTHER, reasons=reasons, severity=None, confidence=confidence)


def _warmth_reason(view: View, same_warmth: FloatArray, reference: Reference) -> tuple[str, ...]:
    """That another temperature explains the changes, where it does so by itself: its posterior mean in kelvin."""
    if reference.temperature_k == 0.0:
        return ()
    warmth = view.drag.warmth
    solved = np.linalg.solve(same_warmth, warmth)
    sd = 1.0 / math.sqrt(float(solved @ warmth) + reference.temperature_k**-2)
    kelvin = sd**2 * float(solved @ view.difference.log_ratios)
    if abs(kelvin) < max(_TELLING_WARMTH_K, 2.0 * sd):
        return ()
    word = "warmer" if kelvin > 0.0 else "colder"
    return (
        f"the motor is some {abs(kelvin):.0f} K {word} than at the healthy starts: that explains its R, K and friction",
    )


def _source(diagnosis: Diagnosis) -> str:
    return "nothing" if diagnosis.reference is None else diagnosis.reference.source


def _with_fault(
    healthy: Diagnosis,
    fault: Explanation,
    freedom: float,
    probability: dict[str, float],
    load: str | None,
) -> Diagnosis:
    """The diagnosis of a known fault; the interval of its severity is that of Student's t."""
    verdict, half = Verdict(fault.kind.verdict), -float(stdtrit(freedom, 0.025)) * fault.step_sd
    own = unit_of(fault.kind, None if healthy.reference is None else healthy.reference.own_friction)
    return replace(
        healthy,
        verdict=verdict,
        reasons=(
            fault.kind.finding,
            f"compared with {_source(healthy)}",
            *(() if load is None else (f"the changes fit it if the drag is mostly {LOADS[load]}",)),
        ),
        severity=fault.severity / own,
        severity_low=severity_of(fault.kind, fault.step - half) / own,
        severity_high=severity_of(fault.kind, fault.step + half) / own,
        confidence=sum(probability.get(kind, 0.0) for kind in motor_kinds() if kind.verdict == verdict),
        fault_kind=fault.kind,
    )


def _with_noise(healthy: Diagnosis, fit: Identified, reference: Reference, limit: float) -> Diagnosis:
    """The diagnosis of a noisy current, where it is noisier than the reference's by more than `limit`."""
    if reference.log_noise is None:
        return healthy
    # Coarse steps, a rectifier, a dead zone and a converter's ripple change the noise seen: it tells nothing. Healthy
    # starts were recorded with the same sensor, and hold the same.
    alignment = fit.start.alignment
    coarse = alignment.quantum_a > math.exp(reference.log_noise)
    hides = alignment.rectified or fit.extension.dead_zone_a > 0.0 or bool(fit.start.lines)
    if (coarse or hides) and not reference.includes_fit_error:
        return healthy
    z = (math.log(max(fit.noise_a, 1e-12)) - reference.log_noise) / reference.log_noise_sd
    if z <= limit:
        return healthy
    ratio = math.exp(z * reference.log_noise_sd)
    reason = f"the parameters are as expected, but the current's noise is {ratio:.2f} times the reference's"
    confidence = float(stdtr(reference.degrees_of_freedom, z))
    return replace(
        healthy, verdict=Verdict.NOISE, reasons=(reason,), severity=ratio**2 - 1.0, confidence=confidence
    )


def _unseen_fault(smallest: dict[str, float]) -> str | None:
    """Why a recording cannot be called healthy: a doubled friction or resistance would not show in it."""
    for kind, quantity in ((FaultKind.BEARING, "friction"), (FaultKind.WINDING_CONTACT, "resistance")):
        if smallest[str(kind)] > _DOUBLED:
            return (
                f"the recording is too coarse, too noisy or too short to tell the {quantity}: only a rise of"
                f" {smallest[str(kind)]:.0%} would show"
            )
    return None


def _alike_reason(fault: Explanation) -> str:
    """A fault that explains the difference, and cannot be named because a coupled load would look the same."""
    return (
        f"it may be {fault.kind} by {fault.severity:.0%} ({fault.kind.finding}), or a coupled load: a recording of the"
        " speed tells which"
    )


def _other_reasons(changes: tuple[Change, ...], source: str) -> tuple[str, ...]:
    moved = [c for c in changes if c.significant] or sorted(
        changes, key=lambda c: abs(math.log(c.ratio)) / math.log(c.high / c.low), reverse=True
    )[:1]
    words = [
        f"{c.name} is {'up' if c.ratio > 1.0 else 'down'} by {abs(c.ratio - 1.0):.0%}"
        f" ({c.low - 1.0:+.0%} to {c.high - 1.0:+.0%})"
        for c in moved
    ]
    hint = (
        "; K down looks the same as J and B up in the current alone"
        if any(c.name.startswith("K^2") for c in moved)
        else ""
    )
    return (
        "; ".join(words) + hint,
        f"no single known fault explains this, compared with {source}",
    )
