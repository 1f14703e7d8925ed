"""Format a diagnosis as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from motor_env.diagnosis.estimation.starts.start_fit import StartFit, constants_at, find_ripple, implausible
from motor_env.diagnosis.readers.recording import Recording
from motor_env.diagnosis.verdict.hypotheses import Fitted
from motor_env.diagnosis.verdict.judgement import JudgedRecording, Judgement, percent
from motor_env.motor.parameters import RAD_S_PER_RPM

TWO_SIDED = 1.96
_LARGEST_LOG = 700.0
UNITS = {
    "R": "ohm",
    "L": "H",
    "K": "V s/rad",
    "J": "kg m2",
    "B": "N m s/rad",
    "K^2/J": "V/(A s)",
    "B/J": "1/s",
    "R/V": "1/A",
    "L/V": "s/A",
    "K/V": "s/rad",
    "K^2/(J V)": "1/(A s)",
    "J/V": "A s3",
    "B/V": "A s2",
}
_EXTENSION_UNITS = {
    "supply_ramp": "s",
    "supply_curve": "of the rise (its middle)",
    "sensor_lag": "s",
    "speed_lag": "s",
    "dead_zone": "A",
    "coulomb": "N m",
    "brush_drop": "V",
}
_PER_VOLT = {"coulomb": "N m/V", "brush_drop": "of the supply"}
"""Units of extensions for an unknown voltage, which counts as 1 V."""


def as_json(diagnosis: JudgedRecording) -> dict[str, Any]:
    """Return one object: regime, verdict of the decisive piece, and all pieces."""
    recording, decisive = diagnosis.recording, diagnosis.decisive
    fit, consistency = decisive.identified, decisive.consistency
    parameters: dict[str, Any] = {} if decisive.fit is None else quantities_json(decisive.fit)
    if fit is not None:
        parameters |= extensions_json(fit) | {
            "onset_s": {"value": fit.onset_s, "unit": "s"},
            "offset_a": {"value": fit.offset_a, "unit": "A"},
        }
    return {
        "file": str(recording.path),
        "taken_for": diagnosis.taken._asdict(),
        **_judgement_json(decisive),
        "parameters": parameters,
        "reference": None if decisive.reference is None else decisive.reference.source,
        "model": None if fit is None else ["textbook", *fit.model],
        "r2_current": None if fit is None else finite_or_none(fit.r2_current),
        "r2_speed": None if fit is None else finite_or_none(fit.r2_speed),
        "residual_autocorrelation": None if fit is None else finite_or_none(fit.lag_one),
        "mean_nis": None if consistency is None else finite_or_none(consistency.mean_square),
        "sensor_noise_a": None if fit is None else finite_or_none(fit.noise_a),
        "consistent": None if consistency is None else consistency.holds,
        "warning": decisive.warning or None,
        "warnings": warnings_of(recording, fit),
        "commutation": None if fit is None else ripple_json(fit, diagnosis.periods_per_turn),
        "columns": list(recording.columns),
        "defects": [] if fit is None else list(fit.defects),
        "pieces_of_recording": diagnosis.of,
        "pieces": [
            {"begin_s": piece.begin_s, "duration_s": piece.duration_s} | _judgement_json(piece)
            for piece in diagnosis.pieces
        ],
    }


def _judgement_json(judgement: Judgement) -> dict[str, Any]:
    """Return the judgement on a piece as an object."""
    return _fault_json(judgement) | {
        "also": [_fault_json(fault) for fault in judgement.also],
        "reasons": list(judgement.reasons),
        "changes": {
            c.name: {"verdict": c.verdict, "ratio": c.ratio, "interval": [c.low, c.high]}
            for c in judgement.changes
        },
        "smallest_changes": {
            kind: finite_or_none(value) for kind, value in judgement.smallest_changes.items()
        },
    }


def _fault_json(fault: Judgement) -> dict[str, Any]:
    """Return verdict, kind, size and confidence."""
    interval = fault.severity_interval
    return {
        "verdict": str(fault.verdict),
        "kind": None if fault.kind is None else str(fault.kind),
        "severity": finite_or_none(fault.severity),
        "severity_interval": None if interval is None else [finite_or_none(end) for end in interval],
        "confidence": finite_or_none(fault.confidence),
    }


def warnings_of(recording: Recording, fit: StartFit | None) -> list[str]:
    """Return warnings on columns and implausible values."""
    return [*recording.warnings, *([] if fit is None else implausible(fit))]


def ripple_json(fit: StartFit, periods_per_turn: float | None) -> dict[str, Any] | None:
    """Return speed and constants by the commutation ripple; None without one."""
    ripple = find_ripple(fit)
    if ripple is None:
        return None
    speed = None if periods_per_turn is None else 2.0 * math.pi * ripple.frequency_hz / periods_per_turn
    constants = {} if speed is None else constants_at(fit, speed)
    return {
        "ripple_hz": ripple.frequency_hz,
        "standard_error_hz": ripple.standard_error_hz,
        "amplitude_a": ripple.amplitude_a,
        "speed_rad_s": speed,
        **{name: {"value": value, "unit": UNITS[name]} for name, value in constants.items()},
    }


def ripple_lines(ripple: Mapping[str, Any] | None) -> list[str]:
    """Describe the commutation ripple in lines; none without a ripple."""
    if ripple is None:
        return []
    line = f"  commutation ripple of {ripple['ripple_hz']:.5g} Hz at the end"
    speed = ripple["speed_rad_s"]
    if speed is None:
        return [f"{line}; with its periods a turn (--ripple-periods-per-turn) it tells the speed, K, J and B"]
    words = ", ".join(f"{name} {row['value']:.4g} {row['unit']}" for name, row in list(ripple.items())[4:])
    return [f"{line}: {speed:.5g} rad/s ({speed / RAD_S_PER_RPM:.0f} rpm), so {words}"]


def quantities_json(fit: Fitted) -> dict[str, Any]:
    """Return the quantities with standard errors and intervals, 95 %."""
    deviations = np.sqrt(np.diag(fit.log_covariance))
    rows = zip(fit.quantity_names, fit.log_values, deviations, strict=True)
    return {
        name: estimate_json(
            math.exp(log),
            math.exp(log) * sd,
            (exp_or_none(log - TWO_SIDED * sd), exp_or_none(log + TWO_SIDED * sd)),
            UNITS[name],
        )
        for name, log, sd in rows
    }


def estimate_json(
    value: float, error: float, interval: tuple[float | None, float | None], unit: str
) -> dict[str, Any]:
    """Return a value with its standard error, interval and unit; None for an infinite number."""
    ends = [finite_or_none(end) for end in interval]
    return {"value": value, "standard_error": finite_or_none(error), "interval": ends, "unit": unit}


def exp_or_none(log: float) -> float | None:
    """Return the factor of a logarithm; None beyond what a number holds."""
    return math.exp(log) if log < _LARGEST_LOG else None


def extensions_json(fit: StartFit) -> dict[str, Any]:
    """Return the extensions with standard errors and intervals, 95 %."""
    units = _EXTENSION_UNITS if fit.start.voltage_known else _EXTENSION_UNITS | _PER_VOLT
    return {
        name: estimate_json(value, error, (value - TWO_SIDED * error, value + TWO_SIDED * error), units[name])
        for name, (value, error) in fit.fitted_extension.items()
    }


def quantity_lines(
    quantities: Mapping[str, Mapping[str, Any]], beside: Mapping[str, str] | None = None
) -> list[str]:
    """Format each quantity as a line, with the text beside it."""
    width = max(map(len, quantities), default=0)
    return [
        f"  {name:<{max(width, 12)}} {row['value']:11.4g} +- {row['standard_error']:.2g} {row['unit']:<12}"
        f" {(beside or {}).get(name, '')}".rstrip()
        for name, row in quantities.items()
    ]


def describe_r2(r2_current: float | None, r2_speed: float | None) -> str:
    """Format the explained shares of current and speed."""
    shares = {"current": r2_current, "speed": r2_speed}
    return "R2 " + ", ".join(f"of the {name} {r2:.4f}" for name, r2 in shares.items() if r2 is not None)


def finite_or_none(value: float | None) -> float | None:
    """Return the number; None for none or an infinite one."""
    return None if value is None or not math.isfinite(value) else float(value)


def as_text(diagnosis: JudgedRecording, *, verbose: bool = False) -> str:
    """Describe a diagnosis for a maintenance engineer; `verbose` adds the quality of the fit."""
    recording, decisive, fit = diagnosis.recording, diagnosis.decisive, diagnosis.decisive.identified
    several = diagnosis.pieces if len(diagnosis.pieces) > 1 else ()
    lines = [
        f"{recording.path}: {headline(decisive)}{_count_agreeing(diagnosis) if several else ''}",
        *(f"  {reason}." for reason in decisive.reasons),
        f"  taken for {diagnosis.taken}",
        *(["  read: " + "; ".join(recording.columns)] if recording.columns else []),
        *(f"  warning: {sentence}" for sentence in warnings_of(recording, fit)),
        *(_piece_line(diagnosis, piece) for piece in several),
        *_piece_table(decisive),
    ]
    if fit is not None:
        lines += ripple_lines(ripple_json(fit, diagnosis.periods_per_turn))
        lines += [f"  noticed: {defect}" for defect in fit.defects]
    if verbose:
        lines += expert_lines(decisive)
    if decisive.smallest_changes:
        smallest = ", ".join(
            f"{kind} {percent(severity, '.0%')}" for kind, severity in decisive.smallest_changes.items()
        )
        own = describe_friction_share(None if decisive.reference is None else decisive.reference.own_friction)
        lines.append(f"  smallest change that this comparison finds in 95 of 100 cases: {smallest} ({own})")
    return "\n".join(lines)


def _count_agreeing(diagnosis: JudgedRecording) -> str:
    """Count the pieces with the same verdict, in words."""
    same = sum(piece.verdict is diagnosis.verdict for piece in diagnosis.pieces)
    word = "windows" if diagnosis.taken.regime == "operation" else "starts"
    judged = "" if len(diagnosis.pieces) == diagnosis.of else f" judged, of {diagnosis.of}"
    return f"; {same} of {len(diagnosis.pieces)} {word}{judged}"


def _piece_line(diagnosis: JudgedRecording, piece: Judgement) -> str:
    """Format one of several pieces: begin, verdict, and changes of its quantities."""
    moved = ", ".join(f"{c.name} {percent(c.ratio - 1.0)}" for c in piece.changes)
    mark = " <" if piece is diagnosis.decisive else ""
    return f"  from {piece.begin_s:.6g} s: {headline(piece)}; {moved or '; '.join(piece.reasons)}{mark}"


def _piece_table(judgement: Judgement) -> list[str]:
    """Format the quantities of a fitted piece with their changes from the reference."""
    fit = judgement.fit
    if fit is None:
        return []
    moved = {
        c.name: f"{percent(c.ratio - 1.0, '+6.1%')} from the reference"
        f" (95 %: {percent(c.low - 1.0)} to {percent(c.high - 1.0)})"
        + (", undecided" if c.verdict == "undecided" else "")
        for c in judgement.changes
    }
    return [
        *quantity_lines(quantities_json(fit), moved),
        *(
            f"  {name:<12} {words}, by the commutation ripple"
            for name, words in moved.items()
            if name not in fit.quantity_names
        ),
    ]


def describe_friction_share(own: float | None) -> str:
    """Name the unit of a bearing fault; `own` is the motor's share of the drag, if known."""
    if own is None:
        return "bearing: of the whole drag, any load included"
    return "bearing: of the motor's own friction" + (f", {own:.0%} of the drag" if own < 1.0 else "")


def expert_lines(judgement: Judgement) -> list[str]:
    """Describe the quality of the fit."""
    fit, consistency = judgement.identified, judgement.consistency
    lines = []
    if fit is not None:
        lines += quantity_lines(extensions_json(fit))
        lines.append(
            f"  fit: {describe_r2(fit.r2_current, fit.r2_speed)}; model {' + '.join(['textbook', *fit.model])}"
        )
        judged = (
            "what the sensor shows: it hides small currents" if fit.is_hidden else "the filter's innovations"
        )
        lines.append(f"  judged by {judged}; sensor noise {fit.noise_a:.3g} A")
    if consistency is not None:
        lines.append(f"  mean normalised innovation squared (NIS) {consistency.mean_square:.2f}")
    if judgement.warning:
        # The fit's errors come from the autocorrelated residual, not from the filter.
        allowed = "; the verdict allows for it" if judgement.reference is not None else ""
        lines.append(f"  {judgement.warning}{allowed}")
    return lines


def headline(judgement: Judgement) -> str:
    """Format verdict, severity and confidence in one line, of further faults too."""
    return "; also ".join(map(_fault_words, (judgement, *judgement.also)))


def _fault_words(fault: Judgement) -> str:
    words, interval = str(fault.verdict), fault.severity_interval
    if fault.kind is not None and str(fault.kind) != words:
        words += f" ({fault.kind})"
    if fault.severity and fault.verdict.is_fault:
        words += f" {percent(fault.severity, '+.0%')}"
        if interval is not None:
            words += f" (95 %: {percent(interval[0], '+.0%')} to {percent(interval[1], '+.0%')})"
    if fault.confidence is not None:
        words += f", confidence {fault.confidence:.2f}"
    return words
