"""From recordings to motor files: `motor-env identify` and `motor-env commission`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.diagnose import unusable_reason
from motor_env.diagnosis.explanations import significance_limit
from motor_env.diagnosis.files import fit_files
from motor_env.diagnosis.healthy_motor import learn_reference, reference_from_starts
from motor_env.diagnosis.report import (
    UNITS,
    extensions_json,
    model_words,
    of_the_drag,
    quality,
    quantities_json,
    quantity_lines,
    ripple_json,
    ripple_lines,
    warnings_of,
)
from motor_env.diagnosis.views import smallest_of, views_of
from motor_env.errors import InputError
from motor_env.identification.identify import Identified
from motor_env.identification.model_choice import EXTENSIONS, identify_best
from motor_env.identification.residuals import AMBIGUOUS
from motor_env.motor.assumptions import assumptions, lines as lines_of
from motor_env.motor.data_sheet import MotorFile, StartReference
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import MotorParameters
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit, prepare

FEWEST_STARTS = 3
_DIFFERENT = 2.0  # standard errors
_NO_LOAD = 1.2  # of the current with the load: the same motor, within its friction's changes
_WARMTH = "R +0.39 %, K -0.1 % and friction -0.3 % a kelvin come on top of that"
_SPREAD = (
    "  the spread between starts is believed to be 2 % before any start is seen, worth 4 starts: few starts give wide"
    " intervals, more starts narrow them"
)


@dataclass(frozen=True, slots=True)
class Commissioned:
    """A commissioned motor, the fits that it comes from, and the smallest changes that it will show."""

    motor: MotorFile
    fits: tuple[Identified, ...]
    smallest: dict[str, float]


def identify_file(
    path: Path,
    columns: Sequence[ColumnChoice] = (),
    *,
    voltage_v: float | None = None,
    circuit: Circuit | None = None,
    start: int | None = None,
    constant: float | None = None,
) -> list[tuple[Recording, Identified]]:
    """Read a recording and fit each of its starts, or one of them, with the model that the evidence prefers.

    It is taken for starts, whatever its voltage does.

    Raises:
        InputError: it cannot be read, or holds no start.
    """
    parts = chosen_starts(read_recording(path, columns), start, also_work=True)
    try:
        return [
            (part, identify_best(prepare(part, voltage_v, circuit), EXTENSIONS, constant=constant))
            for part in parts
        ]
    except UnusableError as error:
        raise InputError(f"{path}: {error}") from None


def commission(
    paths: Sequence[Path],
    name: str,
    columns: Sequence[ColumnChoice] = (),
    *,
    voltage_v: float | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    circuit: Circuit | None = None,
    temperature_c: float | None = None,
    start: int | None = None,
    constant: float | None = None,
    no_load_current_a: float | None = None,
) -> Commissioned:
    """Learn a motor from healthy starts; a file may hold several, of which `start` chooses one.

    Where the speed was not recorded, `constant` is the torque constant that the user knows. `no_load_current_a` is
    what the motor draws uncoupled from its load; it tells which share of the drag is the motor's own friction.

    Raises:
        InputError: fewer than three, one that cannot be read or fitted, or such that hold different columns.
    """
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError("a healthy start is given twice: it would make the spread look smaller than it is")
    circumstances: dict[str, Any] = {"voltage_v": voltage_v, "circuit": circuit, "constant": constant}
    fits = fit_files(paths, "start", columns, fewest=FEWEST_STARTS, start=start, **circumstances)
    reference = replace(learn_reference(fits), temperature_c=temperature_c)
    if no_load_current_a is not None:
        reference = replace(reference, own_friction=_own_friction(fits, no_load_current_a))
    motor = to_motor(fits, name, kind="commissioned", reference=reference, constant=constant)
    known = reference_from_starts(reference, reference.quantities, name, temperature_c)
    limit = significance_limit(false_alarm_rate, fits[0].exponents, reference.degrees_of_freedom)
    views = [] if known is None else views_of(fits[0], known, false_alarm_rate)
    smallest = smallest_of(views, reference.own_friction, limit)
    return Commissioned(motor, tuple(fits), smallest)


def _own_friction(fits: Sequence[Identified], no_load_current_a: float) -> float:
    """Share of the drag that is the motor's own friction, by its currents without and with the load.

    Raises:
        InputError: it draws less with the load.
    """
    running = float(np.mean([steady_state(fit.parameters, fit.start.level_v)[0] for fit in fits]))
    if not no_load_current_a <= _NO_LOAD * running:
        raise InputError(
            f"no-load-current must be at most the {running:.3g} A that the motor draws at the end of these starts,"
            f" got {no_load_current_a:g}"
        )
    return min(no_load_current_a / running, 1.0)


def to_motor(
    fits: Sequence[Identified],
    name: str,
    *,
    kind: Any = "identified",
    reference: StartReference | None = None,
    constant: float | None = None,
) -> MotorFile:
    """Motor file of fits of one motor: the geometric mean of their parameters.

    Where the speed was not recorded, `constant` is the torque constant that the user knows.
    """
    mean = {
        field: float(np.exp(np.mean([math.log(max(getattr(fit.parameters, field), 1e-300)) for fit in fits])))
        for field in MotorParameters.__dataclass_fields__
    }
    known = fits[0].start.voltage_known
    assumed = assumptions(fits[0].quantity_names, has_voltage=known)
    if constant is not None:
        assumed = {key: source for key, source in assumed.items() if key == "nominal_voltage_v"}
    return MotorFile(
        name=name,
        kind=kind,
        parameters=MotorParameters(**mean),
        nominal_voltage_v=float(np.mean([fit.start.level_v for fit in fits])),
        current_noise_a=float(np.exp(np.mean([math.log(max(fit.noise_a, 1e-12)) for fit in fits]))),
        coulomb_friction_n_m=_if_told(fits, "coulomb"),
        brush_drop_v=_if_told(fits, "brush_drop"),
        reference=reference,
        notes=() if known and fits[0].start.speed_rad_s is not None else tuple(not_told(fits[0])),
        assumed=assumed,
    )


def _if_told(fits: Sequence[Identified], name: str) -> float:
    """Mean of an extension over fits, or 0 where it is not different from 0 by two standard errors."""
    each = [fit.fitted_extension.get(name, (0.0, 0.0)) for fit in fits]
    mean, error = np.mean(each, axis=0)[0], float(np.linalg.norm([e for _, e in each])) / len(each)
    return float(mean) if mean > _DIFFERENT * error else 0.0


def not_told(fit: Identified) -> list[str]:
    """What this recording cannot tell, in sentences."""
    sentences = []
    if not fit.start.voltage_known:
        sentences.append("the voltage is unknown: everything is per volt, the supply counts as 1 V")
    if fit.start.speed_rad_s is None:
        sentences.append(
            "the current alone tells K^2/J and B/J, not K, J and B (K down looks like J and B up): K is assumed"
        )
    if fit.start.voltage_v is None:
        sentences.append("a step cannot tell a brush drop from a lower supply")
    if fit.start.voltage_v is None and AMBIGUOUS & set(fit.model):
        sentences.append("a supply that rises slowly, a lag of the sensor and L look alike: L is hardly told")
    sigma = np.sqrt(np.diag(fit.log_covariance))
    sentences += [
        f"{name} is not told by this recording (its standard error is {100 * s:.0f} %)"
        for name, s in zip(fit.quantity_names, sigma, strict=True)
        if s > 0.5
    ]
    return sentences


def identified_text(recording: Recording, fit: Identified, periods_per_turn: float | None = None) -> str:
    """Parameters, correlations and what cannot be told; one sentence where the fit explains nothing."""
    reason = unusable_reason(fit)
    if reason is not None:
        return f"{recording.path}: unusable: {reason}"
    names, correlation = fit.quantity_names, fit.correlation
    pairs = [
        f"{names[i]} with {names[j]} {correlation[i, j]:+.2f}" for i in range(len(names)) for j in range(i)
    ]
    lines = [
        f"{recording.path}: model {model_words(fit.model)}",
        "  read: " + "; ".join(recording.columns),
        *quantity_lines(quantities_json(fit) | extensions_json(fit)),
        "  correlations: " + ", ".join(pairs),
        f"  {quality(fit)}; residual's autocorrelation at one sample {fit.lag_one:.2f}",
        *ripple_lines(fit, periods_per_turn),
        *(f"  warning: {sentence}" for sentence in warnings_of(recording, fit)),
        *(f"  noticed: {defect}" for defect in fit.defects),
        *(f"  note: {sentence}" for sentence in not_told(fit)),
    ]
    return "\n".join(lines)


def identified_json(
    recording: Recording, fit: Identified, periods_per_turn: float | None = None
) -> dict[str, Any]:
    """The same as one object."""
    return {
        "file": str(recording.path),
        "unusable": unusable_reason(fit),
        "model": ["textbook", *fit.model],
        "parameters": quantities_json(fit),
        "extensions": extensions_json(fit),
        "correlations": fit.correlation.tolist(),
        "r2_current": fit.r2_current,
        "r2_speed": fit.r2_speed,
        "residual_autocorrelation": fit.lag_one,
        "commutation": ripple_json(fit, periods_per_turn),
        "onset_s": fit.onset_s,
        "offset_a": fit.offset_a,
        "columns": list(recording.columns),
        "defects": [str(defect) for defect in fit.defects],
        "not_told": not_told(fit),
        "warnings": warnings_of(recording, fit),
    }


def commissioned_text(result: Commissioned, rate: float) -> str:
    """What was learned, with the interval of the next healthy start."""
    reference = result.motor.reference
    if reference is None:
        return ""
    freedom = reference.degrees_of_freedom
    half = -float(stdtrit(freedom, rate / 2.0)) * np.sqrt(np.diag(reference.log_covariance))
    explained = [fit.r2_current for fit in result.fits]
    smallest = ", ".join(f"{kind} {severity:.1%}" for kind, severity in result.smallest.items())
    interval = f"({1.0 - rate:.0%}, Student t, {freedom:.0f} degrees)"
    head = f"{reference.starts} healthy starts, model {model_words(reference.model)}"
    lines = [
        f"{head}; prediction interval of the next healthy start {interval}",
        *(
            f"  {name:<12} {value:11.4g} {UNITS[name]:<12} {math.exp(-h) - 1.0:+.1%} to {math.exp(h) - 1.0:+.1%}"
            for name, value, h in zip(reference.quantities, reference.values, half, strict=True)
        ),
        f"  R2 of the current {min(explained):.4f} to {max(explained):.4f}",
        f"  smallest change that is found in 95 of 100 cases: {smallest} ({of_the_drag(reference.own_friction)})",
        f"  a motor that is warmer or colder by {reference.temperature_k:.0f} K (1 sd) is healthy too: {_WARMTH}",
        _SPREAD,
        *lines_of(result.motor.assumed),
    ]
    return "\n".join(lines)
