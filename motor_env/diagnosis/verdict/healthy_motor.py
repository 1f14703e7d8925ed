"""Distribution of a healthy motor's quantities, by its data sheet or healthy recordings; motor files of fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from motor_env.common.errors import InputError
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import OperationFit
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.estimation.starts.start_prior import hides_inductance
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Motor, assumptions
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray, MotorParameters

NORMAL_DOF = 1e6  # of a covariance that is known
SHEET_NOISE_SD = 0.10
MEASURED_TEMPERATURE_K = 4.0
"""Standard deviation of the winding's temperature about a measured one."""
_FRICTION, _VOLTAGE = identifiable.PARAMETERS.index("B"), identifiable.PARAMETERS.index("V")


@dataclass(frozen=True, slots=True)
class Reference:
    """Distribution of a healthy motor's quantities, for one kind of recording.

    Attributes:
        source: in words, for the user.
        names: the quantities.
        log_values: logarithms of the quantities of a healthy motor, shape (n,).
        log_covariance: of the next healthy piece at this temperature, shape (n, n); with the fit's own error only if
            `includes_fit_error`.
        degrees_of_freedom: of that covariance.
        log_noise: logarithm of the noise of the current; None if unknown.
        log_noise_sd: its standard deviation from start to start.
        model: extensions to fit; None to choose by evidence.
        includes_fit_error: the covariance was estimated from fits.
        temperature_k: standard deviation of the temperature; 0 if the covariance includes it.
        warmer_k: temperature above that of `log_values`.
        own_friction: the motor's own share of the drag; None if unknown.
        excess: factor on covariance and fit error of healthy pieces.
        is_taught: learned from recordings, sensors included.
        is_bare: of a motor without a machine, as on a data sheet.
        assumed: what a data sheet does not give, in words.
    """

    source: str
    names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    degrees_of_freedom: float = NORMAL_DOF
    log_noise: float | None = None
    log_noise_sd: float = SHEET_NOISE_SD
    model: tuple[str, ...] | None = None
    includes_fit_error: bool = False
    temperature_k: float = 0.0
    warmer_k: float = 0.0
    own_friction: float | None = None
    excess: float = 1.0
    is_taught: bool = False
    is_bare: bool = False
    assumed: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Quantities of a healthy motor by name."""
        return dict(zip(self.names, np.exp(self.log_values).tolist(), strict=True))

    @property
    def time_constant_s(self) -> float:
        """Mechanical time constant R J / K^2; infinite if the quantities do not determine it."""
        exponents = identifiable.matrix(self.names)
        wanted = np.array(
            [{"R": 1.0, "J": 1.0, "K": -2.0}.get(name, 0.0) for name in identifiable.PARAMETERS]
        )
        powers = wanted @ np.linalg.pinv(exponents)
        return math.exp(powers @ self.log_values) if np.allclose(powers @ exponents, wanted) else math.inf


class ReferenceShift(NamedTuple):
    """Shift of a healthy piece's linear fit from its motor file.

    Attributes:
        driving: share s of the voltage behind a brush drop that the fit lacks. As s V = R i + L di/dt + K w, a linear
            motor with R, L, K, J and B over s has the same current and speed.
        friction: ratio of drag over speed, at the piece's speed and the file's.
        friction_log_sd: standard deviation of its logarithm.
    """

    driving: float = 1.0
    friction: float = 1.0
    friction_log_sd: float = 0.0

    @property
    def logs(self) -> FloatArray:
        """Logarithms of R, L, K, J, B and V over those of the file."""
        logs = np.full(len(identifiable.PARAMETERS), -math.log(self.driving))
        logs[_VOLTAGE] = 0.0
        logs[_FRICTION] += math.log(self.friction)
        return logs


def reference_of(
    motor: Motor,
    names: tuple[str, ...],
    *,
    are_starts: bool = True,
    temperature_c: float | None = None,
    shift: ReferenceShift | None = None,
) -> Reference | None:
    """Return a motor's distribution of the quantities of a piece; None if it has none of them.

    Args:
        motor: data sheet, identified or commissioned motor.
        names: wanted quantities; the reference may have fewer.
        are_starts: a start, not a window.
        temperature_c: of the motor, if measured; used if that of the healthy pieces is known too.
        shift: of the piece's fit from the file.
    """
    if motor.healthy is not None:
        return reference_of_pieces(
            motor.healthy,
            names,
            motor.name,
            are_starts=are_starts,
            temperature_c=temperature_c,
            shift=shift,
        )
    exponents = identifiable.matrix(names)
    if exponents[:, _VOLTAGE].any():
        return None
    # V is the recorded one. Its tolerance scales the current, which acts on all but ratios such as B/J.
    scale = exponents.sum(axis=1)
    logs = identifiable.logarithms(motor.parameters, motor.nominal_voltage_v or 1.0)
    shift = shift or ReferenceShift()
    logs += shift.logs
    kind = "data sheet" if motor.kind == "data_sheet" else f"{motor.kind} motor"
    return Reference(
        source=motor.name if motor.name.startswith(kind) else f"{kind} {motor.name}",
        names=names,
        log_values=exponents @ logs,
        log_covariance=exponents @ identifiable.tolerance_covariance(motor.tolerance) @ exponents.T
        + motor.tolerance.supply**2 * np.outer(scale, scale)
        + shift.friction_log_sd**2 * np.outer(exponents[:, _FRICTION], exponents[:, _FRICTION]),
        log_noise=None if motor.current_noise_a is None else math.log(motor.current_noise_a),
        own_friction=1.0,
        is_bare=motor.kind == "data_sheet",
        assumed=_describe_assumed(motor),
    )


def _describe_assumed(motor: Motor) -> str:
    """Describe the tolerances that a data sheet does not give, by their source; empty if it gives all."""
    groups: dict[str, list[str]] = {}
    for name, source in motor.usual_tolerances.items():
        size = getattr(motor.tolerance, name)
        words = f"temperature {size:g} K" if name == "temperature_k" else f"{name} {size:.0%}"
        groups.setdefault(source, []).append(words)
    told = "; ".join(f"{', '.join(words)} ({source})" for source, words in groups.items())
    return f"tolerances (1 sd) that the motor file does not give are assumed: {told}" if told else ""


def reference_of_pieces(
    healthy: Healthy,
    names: tuple[str, ...],
    motor: str,
    *,
    are_starts: bool = True,
    temperature_c: float | None = None,
    shift: ReferenceShift | None = None,
) -> Reference | None:
    """Return the distribution of healthy pieces, see `reference_of`.

    If both temperatures are known, the reference is at that of the piece. Only healthy pieces of the same kind include
    the errors of this fit.
    """
    # Each wanted quantity as powers of the known ones: K^2/J of K and J, where the healthy starts had a speed.
    known, wanted = identifiable.matrix(healthy.quantities), identifiable.matrix(names)
    powers = wanted @ np.linalg.pinv(known)
    follow: NDArray[np.bool_] = np.all(np.isclose(powers @ known, wanted), axis=1)
    if not follow.any():
        return None
    powers = powers[follow]
    spread_k, warmer_k = healthy.temperature_k, 0.0
    if temperature_c is not None and healthy.temperature_c is not None:
        spread_k, warmer_k = min(spread_k, MEASURED_TEMPERATURE_K), temperature_c - healthy.temperature_c
    same_kind = are_starts == (healthy.starts is not None)
    starts = healthy.starts if are_starts else None
    return Reference(
        source=_describe_source(healthy, motor),
        names=tuple(name for name, is_known in zip(names, follow.tolist(), strict=True) if is_known),
        log_values=powers @ np.log(healthy.values) + wanted[follow] @ (shift or ReferenceShift()).logs,
        log_covariance=powers @ healthy.log_covariance @ powers.T,
        degrees_of_freedom=healthy.degrees_of_freedom,
        log_noise=None if starts is None else starts.log_noise,
        log_noise_sd=SHEET_NOISE_SD if starts is None else starts.log_noise_sd,
        model=None if starts is None else starts.model,
        includes_fit_error=same_kind and healthy.fleet is None,
        temperature_k=spread_k,
        warmer_k=warmer_k,
        own_friction=healthy.own_friction,
        is_taught=True,
        excess=healthy.windows.window_excess if healthy.windows is not None and same_kind else 1.0,
    )


def _describe_source(healthy: Healthy, motor: str) -> str:
    """Describe the healthy pieces in words."""
    if healthy.fleet is not None:
        return f"{healthy.fleet.motors} sisters of {motor}"
    if healthy.windows is None:
        return f"{healthy.pieces} healthy starts of {motor}"
    all_of_them = sum(len(drive.pieces) for drive in healthy.windows.drives)
    if healthy.pieces < all_of_them:
        return (
            f"{healthy.pieces} of {all_of_them} healthy windows of {motor} under the same operating condition"
        )
    return f"{healthy.pieces} healthy windows of {motor}"


def add_normal_spread(covariance: FloatArray, normal: FloatArray, share: float, freedom: float) -> FloatArray:
    """Add the covariance of a normal spread, such as the temperature's, to one of Student's t.

    A quantile of the sum is at most the root of the sum of the squared quantiles, so the normal part is weighted by
    their squared ratio.

    Args:
        covariance: shape (n, n).
        normal: covariance of the known spread, shape (n, n).
        share: rate of false alarms of one test.
        freedom: degrees of freedom of the first.
    """
    ratio = float(ndtri(share) / stdtrit(freedom, share))
    return np.asarray(covariance + ratio**2 * normal, dtype=np.float64)


_DIFFERENT = 2.0  # standard errors
_UNDETERMINED = 0.5  # standard deviation of a logarithm
_SMALL = 1e-3


def to_motor(
    fits: Sequence[StartFit],
    name: str,
    *,
    healthy: Healthy | None = None,
    constant: float | None = None,
) -> Motor:
    """Return the motor of fits of its starts: the geometric mean of their parameters.

    Args:
        fits: of starts.
        name: of the motor.
        healthy: statistics of the starts, for a commissioned motor.
        constant: known torque constant in N m/A, for starts without a speed.
    """
    start = fits[0].start
    mean = {
        field: float(np.exp(np.mean([math.log(max(getattr(fit.parameters, field), 1e-300)) for fit in fits])))
        for field in MotorParameters.__dataclass_fields__
    }
    known = fits[0].quantity_names if constant is None else ("K",)
    return Motor(
        name=name,
        kind="identified" if healthy is None else "commissioned",
        parameters=MotorParameters(**mean),
        nominal_voltage_v=float(np.mean([fit.start.level_v for fit in fits])),
        current_noise_a=float(np.exp(np.mean([math.log(max(fit.noise_a, 1e-12)) for fit in fits]))),
        coulomb_friction_n_m=_mean_if_significant(fits, "coulomb"),
        brush_drop_v=_mean_if_significant(fits, "brush_drop"),
        healthy=healthy,
        notes=()
        if start.voltage_known and start.speed_rad_s is not None
        else tuple(describe_undetermined(fits[0])),
        assumed=assumptions(known, has_voltage=start.voltage_known),
    )


def _mean_if_significant(fits: Sequence[StartFit], name: str) -> float:
    """Average an extension over fits; 0 if it is within two standard errors of 0."""
    each = [fit.fitted_extension.get(name, (0.0, 0.0)) for fit in fits]
    mean, error = np.mean(each, axis=0)[0], float(np.linalg.norm([e for _, e in each])) / len(each)
    return float(mean) if mean > _DIFFERENT * error else 0.0


def describe_undetermined(fit: StartFit) -> list[str]:
    """Describe what this recording leaves undetermined."""
    deviations = np.sqrt(np.diag(fit.log_covariance))
    limits = {
        "the voltage is unknown: everything is per volt, the supply counts as 1 V": not fit.start.voltage_known,
        "the current alone determines K^2/J and B/J, not K, J and B (K down looks like J and B up): K is assumed": (
            fit.start.speed_rad_s is None
        ),
        "all but B/J include a brush drop: brushes that take 5 % of the supply make them 5 % larger": (
            "brush_drop" not in fit.model
        ),
        "J includes the loss of a gear: one that takes 10 % of the torque makes it 11 % larger, K^2/J smaller": True,
        "a supply that rises slowly, a lag of the sensor and L look alike: L is hardly determined": hides_inductance(
            fit.model
        ),
    }
    return [sentence for sentence, holds in limits.items() if holds] + [
        f"{name} is not determined by this recording (its standard error is {100 * s:.0f} %)"
        for name, s in zip(fit.quantity_names, deviations, strict=True)
        if s > _UNDETERMINED
    ]


def motor_of_log(fit: OperationFit, name: str) -> Motor:
    """Return the motor that was identified at work.

    Raises:
        InputError: current or speed was not recorded.
    """
    if not fit.record.recorded.all():
        raise InputError("a motor file needs current and speed: the parameters are not known one by one")
    values = fit.solution.values
    return replace(
        _motor_of(values, name),
        nominal_voltage_v=fit.record.peaks[0],
        current_noise_a=float(values[index.NOISE_I]),
        speed_noise_rad_s=float(values[index.NOISE_W]),
        notes=fit.notes,
    )


def motor_of_windows(healthy: Healthy, name: str) -> Motor:
    """Return the motor that was commissioned on windows."""
    windows = healthy.windows
    assert windows is not None  # noqa: S101  # it was learned from them
    motor = _motor_of(windows.physical, name)
    volts = 1.0 if windows.peaks is None else windows.peaks[0]
    drag = float(windows.physical[index.B]) * windows.speed_rad_s
    return replace(
        motor,
        kind="commissioned",
        healthy=healthy,
        coulomb_friction_n_m=_unless_small(motor.coulomb_friction_n_m, drag),
        brush_drop_v=_unless_small(motor.brush_drop_v, volts),
    )


def _unless_small(value: float, beside: float) -> float:
    """Return 0 for a negligible value: a bounded fit never reaches 0."""
    return value if value > _SMALL * beside else 0.0


def _motor_of(values: FloatArray, name: str) -> Motor:
    """Return the motor of a fit's physical values, shape (N_VALUES,)."""
    return Motor(
        name=name,
        kind="identified",
        parameters=MotorParameters(
            resistance_ohm=float(values[index.R]),
            inductance_h=float(values[index.L]),
            back_emf_constant_v_s_per_rad=float(values[index.K]),
            torque_constant_n_m_per_a=float(values[index.K]),
            inertia_kg_m2=float(values[index.J]),
            viscous_friction_n_m_s_per_rad=float(values[index.B]),
        ),
        coulomb_friction_n_m=float(values[index.COULOMB]),
        brush_drop_v=float(values[index.DROP]),
    )
