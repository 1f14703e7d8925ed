"""A diagnosis for people and for programs: table, sentences, JSON, picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from motor_env import console
from motor_env.diagnosis import Diagnosis, Verdict
from motor_env.identification import Identified

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


def exit_status(diagnoses: list[Diagnosis], *, unreadable: bool) -> int:
    """0: all healthy; 1: any fault; 2: any input unreadable; 3: no fault, but some undecided."""
    if unreadable:
        return int(console.ExitStatus.BAD_INPUT)
    if any(d.verdict.is_fault for d in diagnoses):
        return int(console.ExitStatus.FAULT)
    if any(d.verdict is not Verdict.HEALTHY for d in diagnoses):
        return int(console.ExitStatus.UNDECIDED)
    return int(console.ExitStatus.HEALTHY)


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """One object: file, verdict, severity, confidence, parameters, r2_current, and what they rest on."""
    fit, check = diagnosis.identified, diagnosis.filter_check
    return {
        "file": str(diagnosis.recording.path),
        "verdict": str(diagnosis.verdict),
        "fault_kind": None if diagnosis.fault_kind is None else str(diagnosis.fault_kind),
        "severity": _number(diagnosis.severity),
        "severity_interval": _interval(diagnosis.severity_low, diagnosis.severity_high),
        "confidence": _number(diagnosis.confidence),
        "reasons": list(diagnosis.reasons),
        "parameters": {} if fit is None else _parameters(fit),
        "changes": {
            c.name: {"ratio": c.ratio, "interval": [c.low, c.high], "significant": c.significant}
            for c in diagnosis.changes
        },
        "smallest_changes": diagnosis.smallest_changes,
        "reference": None if diagnosis.reference is None else diagnosis.reference.source,
        "model": None if fit is None else ["textbook", *fit.model],
        "r2_current": None if fit is None else _number(fit.r2_current),
        "r2_speed": None if fit is None else _number(fit.r2_speed),
        "residual_autocorrelation": None if fit is None else _number(fit.lag_one),
        "mean_nis": None if check is None else _number(check.mean_nis),
        "sensor_noise_a": None if check is None else _number(check.sensor_noise_a),
        "model_error_a": None if check is None else _number(check.model_error_a),
        "columns": list(diagnosis.recording.columns),
        "defects": [] if fit is None else list(fit.defects),
    }


def _parameters(fit: Identified) -> dict[str, Any]:
    out: dict[str, Any] = {
        name: {"value": float(value), "standard_error": float(error), "unit": UNITS[name]}
        for name, value, error in zip(fit.quantity_names, fit.values, fit.standard_errors, strict=True)
    }
    for name, (value, error) in fit.fitted_extension.items():
        out[name] = {"value": value, "standard_error": error, "unit": EXTENSION_UNITS[name]}
    out["onset_s"] = {"value": fit.onset_s, "unit": "s"}
    out["offset_a"] = {"value": fit.offset_a, "unit": "A"}
    return out


EXTENSION_UNITS = {
    "supply_ramp": "s",
    "supply_curve": "of the rise (its middle)",
    "sensor_lag": "s",
    "speed_lag": "s",
    "coulomb": "N m",
    "brush_drop": "V",
}


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _interval(low: float | None, high: float | None) -> list[float] | None:
    return None if low is None or high is None else [low, high]


def as_text(diagnosis: Diagnosis) -> str:
    """What a maintenance engineer reads."""
    lines = [f"{diagnosis.recording.path}: {headline(diagnosis)}"]
    lines += [f"  {reason}." for reason in diagnosis.reasons]
    lines.append("  read: " + "; ".join(diagnosis.recording.columns))
    fit, check = diagnosis.identified, diagnosis.filter_check
    if fit is not None:
        changes = {change.name: change for change in diagnosis.changes}
        for name, value, error in zip(fit.quantity_names, fit.values, fit.standard_errors, strict=True):
            line = f"  {name:<10} {value:11.4g} +- {error:.2g} {UNITS[name]:<12}"
            if name in changes:
                c = changes[name]
                line += f" {c.ratio - 1.0:+6.1%} from the reference (95 %: {c.low - 1.0:+.1%} to {c.high - 1.0:+.1%})"
            lines.append(line.rstrip())
        for name, (value, error) in fit.fitted_extension.items():
            lines.append(f"  {name:<10} {value:11.4g} +- {error:.2g} {EXTENSION_UNITS[name]}")
        speed = "" if fit.r2_speed is None else f", of the speed {fit.r2_speed:.4f}"
        lines.append(
            f"  fit: R2 of the current {fit.r2_current:.4f}{speed}; model {' + '.join(['textbook', *fit.model])}"
        )
        lines += [f"  noticed: {defect}" for defect in fit.defects]
    if check is not None:
        lines.append(
            f"  filter: sensor noise {check.sensor_noise_a:.3g} A, model error {check.model_error_a:.3g} A,"
            f" mean NIS {check.mean_nis:.2f} (with the sensor's noise alone {check.sensor_only_nis:.2f})"
        )
    if diagnosis.smallest_changes:
        told = ", ".join(f"{kind} {severity:.0%}" for kind, severity in diagnosis.smallest_changes.items())
        lines.append(f"  smallest change that this comparison finds in 95 of 100 cases: {told}")
    return "\n".join(lines)


def headline(diagnosis: Diagnosis) -> str:
    """Verdict, severity and confidence in one line."""
    words = str(diagnosis.verdict)
    if diagnosis.severity and diagnosis.verdict.is_fault:
        words += f" {diagnosis.severity:+.0%}"
        if diagnosis.severity_low is not None and diagnosis.severity_high is not None:
            words += f" (95 %: {diagnosis.severity_low:+.0%} to {diagnosis.severity_high:+.0%})"
    if diagnosis.confidence is not None:
        words += f", confidence {diagnosis.confidence:.2f}"
    return words


def plot(diagnosis: Diagnosis, path: Path) -> None:
    """Measured, fitted and expected current, residual, and the filter's innovation.

    Raises:
        InputError: the file cannot be written.
    """
    from motor_env.files import replacing
    from motor_env.plotting import COLOUR, drawing, save, subplots

    fit, check = diagnosis.identified, diagnosis.filter_check
    if fit is None or check is None:
        return
    with drawing():
        figure, (top, middle, bottom) = subplots(3, height_in=8.5, height_ratios=(2.2, 1.0, 1.0))
        time_ms = 1e3 * (fit.start.time_s - fit.onset_s)
        colour = COLOUR.get(str(diagnosis.verdict), COLOUR["other"])
        top.plot(time_ms, fit.start.current_a, color=COLOUR["measured"], linewidth=1.2, label="measured")
        top.plot(time_ms, fit.expected[:, 0], color=colour, label="fitted")
        top.set_ylabel("current (A)")
        top.set_title(f"{diagnosis.recording.path.name}: {headline(diagnosis)}")
        top.legend(loc="upper right")
        middle.plot(time_ms, fit.residual_a, color=colour, linewidth=0.8)
        middle.set_ylabel("residual (A)")
        whitened = check.result.whitened[..., 0]
        begin = len(time_ms) - whitened.shape[-1]
        bottom.plot(time_ms[begin:], np.ravel(whitened), color=COLOUR["other"], linewidth=0.8)
        for level in (-3.0, 3.0):
            bottom.axhline(level, color=COLOUR["threshold"], linestyle="--", linewidth=1.0)
        bottom.set_ylabel("innovation (sigma)")
        bottom.set_xlabel("time after the start (ms)")
        figure.align_ylabels()
        with replacing(path) as temporary:
            save(figure, temporary)
