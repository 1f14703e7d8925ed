"""Decide on a fitted piece: compare its quantities with a reference, by the covariances of both.

The covariance of a fit includes the model's error. That of a reference holds tolerances, temperature and supply, or the
spread between healthy pieces. After an alarm the most probable fault is named, unless its residual is significant or
"other" is more probable. The confidence is a posterior probability.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr, stdtrit

from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.verdict.healthy_motor import Reference
from motor_env.diagnosis.verdict.hypotheses import (
    SECOND_PRIOR,
    Change,
    Difference,
    Explanation,
    Fitted,
    Hypothesis,
    alarm_share,
    compare,
    covariance_at_one_temperature,
    estimate_warming,
    explain,
    explain_by,
    form_hypotheses,
    is_separable,
    joint_share,
    probabilities,
    severity_density,
    severity_of,
    severity_unit,
    shared_rows,
    smallest_changes,
    smallest_detectable,
)
from motor_env.diagnosis.verdict.judgement import (
    NOTHING_ELSE,
    Judgement,
    Verdict,
    describe_findings,
    percent,
)
from motor_env.diagnosis.verdict.load_hypotheses import LOADS
from motor_env.diagnosis.verdict.scaling_errors import (
    describe_scaling_errors,
    find_scaling_errors,
    limit_to_wear,
)
from motor_env.motor.faults import FaultKind, motor_kinds
from motor_env.motor.identifiable import PARAMETERS
from motor_env.motor.parameters import FloatArray

DEFAULT_FALSE_ALARM_RATE = 0.01
_NOTABLE_WARMTH_K = 8.0
# Of a start from rest: standard deviations of its temperature, beyond which K must move as magnets do: per kelvin (1 sd
# about that of ferrite and NdFeB), but in 1 of 20.
_HOT, _MAGNETS, _BEYOND = 2.5, 0.0005, 0.05
_DOUBLED, _TENFOLD = 1.0, 9.0
_LEFT_OVER = 0.01
_MACHINE, _MACHINE_LOG_SD = 5.0, 1.0  # its drag over the motor's own: the median, and the sd of the logarithm
# What inertia and drag of a machine move, and whether upwards.
_BY_MACHINE = {("J", True), ("B", True), ("K^2/J", False), ("B/J", True), ("B/J", False)}
_FALSE_SECOND = 0.01  # rate at which a second fault is named beside a single one
_AS_EXPECTED = "the parameters are as expected, but "
_LEAST_SEEN = 0.25  # of a fault's step, in a quantity as it was fitted
_NAMED = 2.0  # standard deviations of a fault that names an alarm of several pieces


class AlarmLimits(NamedTuple):
    """Limits of the tests, for one rate of false alarms.

    Attributes:
        share: rate of false alarms of one test of the motor.
        z: standard deviations beyond which a fault alarms.
        noise_z: standard deviations beyond which the noise alarms.
    """

    share: float
    z: float
    noise_z: float


def alarm_limits(hypotheses: list[Hypothesis], rate: float, *, tests_noise: bool) -> AlarmLimits:
    """Find the limits of tests that together alarm at a rate; the noise has an equal share."""
    difference = hypotheses[0].difference
    noise = alarm_share(rate, difference.exponents)
    freedom = difference.degrees_of_freedom
    share = joint_share(
        rate - noise if tests_noise else rate, difference.covariance, difference.exponents, freedom
    )
    return AlarmLimits(share, -float(stdtrit(freedom, share)), -float(stdtrit(freedom, noise)))


def decide(fit: Fitted, reference: Reference, rate: float, *, alarm: bool | None = None) -> Judgement:
    """Judge a fit against a reference, at a rate of false alarms per healthy piece.

    The load may be unknown: alarm only if every assumed load does.

    Args:
        fit: of the piece.
        reference: of the healthy motor.
        rate: of false alarms.
        alarm: decision by several pieces; None to decide here.
    """
    hypotheses = form_hypotheses(fit, reference, rate)
    limits = alarm_limits(hypotheses, rate, tests_noise=reference.log_noise is not None)
    # A data sheet is of a motor without a load; there, loads only help to name a fault.
    believed = hypotheses if reference.includes_fit_error else hypotheses[:1]
    quiet = next(
        (hypothesis for hypothesis in believed if not hypothesis.is_alarm(limits.z, limits.share)), None
    )
    if alarm is not None:
        quiet = None if alarm else hypotheses[0]
    hypothesis = quiet or hypotheses[0]
    same_warmth = covariance_at_one_temperature(fit, reference)
    warming, is_plausible = _describe_warming(hypothesis, same_warmth, reference)
    if alarm is None and isinstance(fit, StartFit) and not is_plausible:
        quiet = None
    # As fitted; those of a hypothesis are linearised in the temperature.
    rows, load = shared_rows(fit, reference), hypotheses[0].load
    log_ratios = fit.log_values[rows] - reference.log_values - reference.warmer_k * load.warmth
    healthy = Judgement(
        Verdict.HEALTHY,
        (
            f"no quantity has moved further than {reference.source} and the fit's own error allow",
            *warming,
            *filter(None, (reference.assumed,)),
        ),
        severity=0.0,
        confidence=probabilities(hypothesis.difference, hypothesis.faults)["healthy"],
        fit=fit,
        reference=reference,
        changes=compare(
            reference.names,
            log_ratios,
            same_warmth,
            reference.degrees_of_freedom,
            limits.z,
            is_alarm=quiet is None,
        ),
        smallest_changes=smallest_detectable(believed, reference.own_friction, limits.z),
    )
    if quiet is None:
        limit = limits.z if alarm is None else min(limits.z, _NAMED)
        # At any rate of alarms, a true fault leaves a larger residual in 1 of 100 only.
        left_over = min(rate, _LEFT_OVER)
        found = limit_to_wear(
            _explain_alarm(healthy, reference, hypotheses, log_ratios, limit, rate=left_over)
        )
        noisy = _check_noise(healthy, fit, reference, limits.noise_z)
        if noisy is healthy or found.fault_kind is None or found.fault_kind.is_sensor:
            return found
        reasons = [reason.replace(NOTHING_ELSE, "") for reason in found.reasons]
        reasons.append(noisy.reasons[0].removeprefix(_AS_EXPECTED))
        return replace(found, reasons=tuple(reasons), also=(*found.also, noisy))
    # The scatter of healthy pieces includes loads and the model's error: neither is a defect of this piece.
    own = (fit.white_covariance if reference.includes_fit_error else fit.log_covariance)[np.ix_(rows, rows)]
    by_all, by_piece = (
        smallest_changes(replace(hypothesis.difference, covariance=spread), limits.z)
        for spread in (own if reference.includes_fit_error else hypothesis.difference.covariance, own)
    )
    undecided = tuple(_describe_undecided(by_all, by_piece, reference.source))
    if all(change.verdict == "undecided" for change in healthy.changes):
        undecided = ("the recording determines no quantity: a doubling of any would not show", *undecided)
    elif len(undecided) < len(_CHECKED_FAULTS):
        healthy = replace(healthy, reasons=(*healthy.reasons, *undecided))
        return _check_noise(healthy, fit, reference, limits.noise_z)
    return replace(healthy, verdict=Verdict.UNUSABLE, reasons=undecided, severity=None, confidence=None)


def _explain_alarm(
    healthy: Judgement,
    reference: Reference,
    hypotheses: list[Hypothesis],
    log_ratios: FloatArray,
    limit: float,
    *,
    rate: float,
) -> Judgement:
    """Name the fault that explains an alarm, or none; assume a load only if needed.

    The temperature acts as without a load; with an unknown load too, anything could be explained.
    """

    def suffices(fault: Explanation) -> bool:
        is_told = fault.z > limit and fault.p_left_over > rate and _is_in_table(fault, healthy.changes)
        return is_told and is_separable(first.difference, fault.kind)

    def as_fitted(difference: Difference, faults: list[Explanation]) -> list[Explanation]:
        """Explain what was fitted by the same faults, not what is linearised in the temperature."""
        kinds = [fault.kind for fault in faults]
        return explain_by(replace(difference, log_ratios=log_ratios), kinds)

    first = hypotheses[0]
    scales = find_scaling_errors(first.difference, reference.names, limit, rate)
    scaling = [describe_scaling_errors(scales)] if scales else []
    # Without recordings the reference does not include the sensors' gains.
    gains = [scale.gain for scale in scales if scale.gain is not None and reference.is_taught]
    for hypothesis in hypotheses[:1] if any(map(suffices, first.faults)) else hypotheses:
        difference = replace(first.difference, response=hypothesis.load.response)
        faults = explain(difference)
        probability = probabilities(difference, faults)
        best = max(filter(suffices, faults), key=lambda fault: probability[fault.kind], default=None)
        if best is not None and probability[best.kind] >= probability["other"]:
            if gains:
                probability = probabilities(difference, [*faults, *gains])
                share = sum(probability[gain.kind] for gain in gains)
                scaling[0] += f" (probability {share:.0%}, of {best.kind} {probability[best.kind]:.0%})"
                if share > probability[best.kind]:
                    break
            both = _find_pair(difference, faults, healthy.changes, rate, best.kind)
            named, probability = both or ([best], probability)
            named = as_fitted(difference, named)
            judgement = _name_faults(healthy, reference, named, probability, hypothesis.load.name)
            return replace(judgement, reasons=(*judgement.reasons, *scaling))
    if gains and len(gains) == len(scales):
        probability = probabilities(first.difference, [*first.faults, *gains])
        # Equal explanations differ by rounding: take the first.
        likeliest = max(gains, key=lambda gain: round(probability[gain.kind], 9))
        if sum(probability[gain.kind] for gain in gains) >= probability["other"]:
            judgement = _name_faults(healthy, reference, [likeliest], probability, None)
            return replace(judgement, reasons=(*scaling, *judgement.reasons))
    both = _find_pair(first.difference, first.faults, healthy.changes, rate)
    if both is not None:
        judgement = _name_faults(healthy, reference, as_fitted(first.difference, both[0]), both[1], None)
        if limit_to_wear(judgement) is judgement:
            return replace(judgement, reasons=(*judgement.reasons, *scaling))
    nameable = {fault.kind for fault in first.faults}
    unnamed = tuple(kind for kind in motor_kinds() if kind not in nameable)
    # These cannot be named: a coupled load would look the same.
    unnameable = (
        f"it may be {fault.kind} by {percent(fault.severity, '.0%')} ({fault.kind.finding}), or a coupled load: a"
        " recording of the speed tells which"
        for fault in filter(suffices, explain(first.difference, unnamed))
    )
    is_up = {change.name: change.ratio > 1.0 for change in healthy.changes if change.significant}
    is_loaded = reference.is_bare and is_up not in ({}, {"B/J": False}) and is_up.items() <= _BY_MACHINE
    other = healthy.as_other(
        *((describe_machine(healthy.fit),) if is_loaded else ()),
        *scaling,
        *_describe_changes(healthy.changes, reference.source),
        *unnameable,
        *filter(None, (reference.assumed,)),
    )
    return replace(other, confidence=probabilities(first.difference, first.faults)["other"])


def _describe_warming(
    hypothesis: Hypothesis, same_warmth: FloatArray, reference: Reference
) -> tuple[tuple[str, ...], bool]:
    """Describe a change of the temperature that explains the changes: its posterior mean in kelvin.

    Also return whether it can be, as K falls with it.
    """
    if reference.temperature_k == 0.0:
        return (), True
    difference, warmth = hypothesis.difference, hypothesis.load.warmth
    kelvin, sd = estimate_warming(difference.log_ratios, same_warmth, warmth, reference.temperature_k)
    powers = difference.exponents[:, PARAMETERS.index("K")]
    k = int(np.argmax(np.abs(powers)))
    left = float(difference.log_ratios[k] - kelvin * warmth[k])
    allowed = math.hypot(math.sqrt(same_warmth[k, k]), powers[k] * _MAGNETS * kelvin)
    can_explain = abs(kelvin) < _HOT * reference.temperature_k or abs(left) < allowed * -float(
        stdtrit(difference.degrees_of_freedom, 0.5 * _BEYOND)
    )
    if abs(kelvin) < max(_NOTABLE_WARMTH_K, 2.0 * sd):
        return (), can_explain
    word = "warmer" if kelvin > 0.0 else "colder"
    words = (
        f"the motor is some {abs(kelvin):.0f} K {word} than when it was healthy: that explains its R and K"
    )
    return (words,), can_explain


def _is_in_table(fault: Explanation, changes: tuple[Change, ...]) -> bool:
    """Whether a quantity moved with the fault, or may have, not only beside what the temperature does."""
    rows = zip(changes, fault.direction.tolist(), strict=True)
    return any(
        c.verdict == "undecided" or math.log(c.ratio) / slope > _LEAST_SEEN * fault.step
        for c, slope in rows
        if slope
    )


def _find_pair(
    difference: Difference,
    faults: list[Explanation],
    changes: tuple[Change, ...],
    rate: float,
    kind: FaultKind | None = None,
) -> tuple[list[Explanation], dict[str, float]] | None:
    """Find two faults at once, the stronger one first, and the probabilities with them.

    Each must be significant beside the other and show in the table, and both must leave nothing unexplained: no p-value
    below `rate`. If `kind` explains the difference alone, it is one of the two; else both must explain it better than
    "other".
    """
    limit = -float(stdtrit(difference.degrees_of_freedom, _FALSE_SECOND / max(len(faults) - 1, 1)))
    limit = _NAMED if kind is None else limit
    pairs = {}
    for kinds in combinations([fault.kind for fault in faults], 2):
        same = kinds[0].verdict == kinds[1].verdict or not any(c.excludes_healthy for c in changes)
        pair = [] if same else explain_by(difference, kinds)
        if (
            pair
            and kind in (None, *kinds)
            and min(fault.z for fault in pair) > limit
            and pair[0].p_left_over > rate
            and all(_is_in_table(fault, changes) for fault in pair)
            and all(is_separable(difference, one, other) for one, other in (kinds, kinds[::-1]))
        ):
            pairs["+".join(kinds)] = sorted(pair, key=lambda fault: -fault.z)
    probability = probabilities(difference, faults, pairs)
    best = max(pairs, key=lambda name: probability[name], default="")
    if not best or (kind is None and probability[best] < SECOND_PRIOR * probability["other"]):
        return None
    return pairs[best], probability


def _name_faults(
    healthy: Judgement,
    reference: Reference,
    faults: list[Explanation],
    probability: dict[str, float],
    load: str | None,
) -> Judgement:
    """Judge a piece with faults, of which the first is the verdict; name the load under which they explain it."""
    first, *also = (_name_fault(healthy, reference, fault, probability) for fault in faults)
    is_loaded = any(_share_of_machine(reference, fault) > 0.5 for fault in faults)
    return replace(
        first,
        reasons=(
            *((describe_machine(healthy.fit),) if is_loaded else ()),
            *describe_findings([fault.kind for fault in faults], healthy.changes),
            f"compared with {reference.source}",
            *filter(None, (reference.assumed,)),
            *(() if load is None else (f"the changes fit it if the drag is mostly {LOADS[load]}",)),
        ),
        also=tuple(also),
    )


def _name_fault(
    healthy: Judgement, reference: Reference, fault: Explanation, probability: dict[str, float]
) -> Judgement:
    """Judge a piece with a known fault, alone or beside others; the interval of the severity is Student's."""

    def share(kinds: set[FaultKind]) -> float:
        return sum(each for name, each in probability.items() if kinds & set(name.split("+")))

    verdict, own = Verdict(fault.kind.verdict), severity_unit(fault.kind, reference.own_friction)
    half = -float(stdtrit(reference.degrees_of_freedom, 0.025)) * fault.step_sd
    low, high = (severity_of(fault.kind, fault.step + margin) / own for margin in (-half, half))
    family = share({kind for kind in FaultKind if kind.verdict == verdict})
    return replace(
        healthy,
        verdict=verdict,
        severity=fault.severity / own,
        severity_interval=(low, high),
        confidence=family * (1.0 - _share_of_machine(reference, fault)),
        fault_kind=fault.kind,
        kind_probability=share({fault.kind}),
    )


def _share_of_machine(reference: Reference, fault: Explanation) -> float:
    """Return the probability that a bearing fault against a data sheet is a machine, which brakes the bare motor alike.

    Beforehand both are equally likely, and the machine's drag over the motor's own is log-normal.
    """
    if not (reference.is_bare and fault.kind == FaultKind.BEARING and fault.step > 0.0):
        return 0.0
    added = math.expm1(fault.step)
    deviation = math.log(added / _MACHINE) / _MACHINE_LOG_SD
    density = math.exp(-0.5 * deviation**2) / math.sqrt(2.0 * math.pi) / _MACHINE_LOG_SD
    machine = density * (1.0 + added) / added  # by the step instead of the logarithm of the added drag
    return float(machine / (machine + severity_density(fault.step)))


def describe_machine(fit: Fitted | None) -> str:
    """Describe that a coupled machine looks like friction, and what to do."""
    recordings = "start1.csv start2.csv start3.csv" if isinstance(fit, StartFit) else "log1.csv log2.csv"
    return (
        "a coupled machine looks the same, as a data sheet is of the bare motor: uncouple it and record again, or"
        f" learn the motor in its machine while it is healthy: motor-env commission {recordings} -o motor.toml"
    )


def _check_noise(healthy: Judgement, fit: Fitted, reference: Reference, limit: float) -> Judgement:
    """Judge the noise of the current; `limit` is in standard deviations."""
    if reference.log_noise is None or not isinstance(fit, StartFit):
        return healthy
    # Coarse steps, a rectifier and a dead zone change the measured noise. Healthy starts were recorded with the
    # same sensor, so they remain comparable, but perhaps in a finer range: steps alone add up to a quarter of their
    # square to the variance, where the last bit toggles.
    quantum, usual = fit.start.alignment.quantum_a, math.exp(reference.log_noise)
    if (quantum > usual or fit.is_hidden) and not reference.includes_fit_error:
        return healthy
    if fit.noise_a**2 - usual**2 <= 0.25 * quantum**2:
        return healthy
    z = (math.log(max(fit.noise_a, 1e-12)) - reference.log_noise) / reference.log_noise_sd
    if z <= limit:
        return healthy
    ratio = math.exp(z * reference.log_noise_sd)
    return replace(
        healthy,
        verdict=Verdict.NOISE,
        reasons=(f"{_AS_EXPECTED}the current's noise is {ratio:.2f} times the reference's",),
        severity=ratio**2 - 1.0,
        confidence=float(stdtr(reference.degrees_of_freedom, z)),
    )


_CHECKED_FAULTS = {FaultKind.BEARING: "friction", FaultKind.WINDING_CONTACT: "resistance"}


def _describe_undecided(smallest: dict[str, float], by_piece: dict[str, float], source: str) -> Iterator[str]:
    """Describe quantities whose doubling would not show, because of the piece or of its reference."""
    for kind, quantity in _CHECKED_FAULTS.items():
        severity = smallest.get(str(kind))
        if severity is None:
            yield f"the {quantity} is undecided: it cannot be compared with {source}"
        elif severity > _DOUBLED:
            shown = f"only a rise of {severity:.0%}" if severity < _TENFOLD else "not even a tenfold one"
            why = f"{source} allows too much to decide it"
            if by_piece[str(kind)] > _DOUBLED:
                why = "the recording is too coarse, too noisy or too short to decide it"
            yield f"the {quantity} is undecided: {why}, {shown} would show"


def _describe_changes(changes: tuple[Change, ...], source: str) -> tuple[str, ...]:
    moved = [c for c in changes if c.significant] or sorted(
        changes, key=lambda c: abs(math.log(c.ratio)) / math.log(c.high / c.low), reverse=True
    )[:1]
    words = [
        f"{c.name} is {'up' if c.ratio > 1.0 else 'down'} by {percent(abs(c.ratio - 1.0), '.0%')}"
        f" ({percent(c.low - 1.0, '+.0%')} to {percent(c.high - 1.0, '+.0%')})"
        for c in moved
    ]
    if any(c.name.startswith("K^2") for c in moved):
        words.append("K down looks the same as J and B up in the current alone")
    # Friction moves with any load; two other quantities move together if it is another motor.
    several = len({c.name[0] for c in moved if c.significant} - {"B"}) > 1
    return (
        "; ".join(words),
        ("is this the right motor? N" if several else "n")
        + f"o single known fault explains this, compared with {source}",
    )
