"""Distribution of a healthy motor's quantities: from its data sheet, or from healthy pieces of its recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from motor_env.motor import identifiable as quantities
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray

NORMAL_DOF = 1e6  # of a covariance that is known
SHEET_NOISE_SD = 0.10
MEASURED_TEMPERATURE_K = 4.0
"""Standard deviation of the winding's temperature about a measured one."""
_FRICTION, _VOLTAGE = quantities.PARAMETERS.index("B"), quantities.PARAMETERS.index("V")


@dataclass(frozen=True, slots=True)
class Reference:
    """Distribution of a healthy motor's quantities that one kind of recording determines.

    Attributes:
        source: in words, for the user.
        names: the quantities.
        log_values: logarithms of the quantities of a healthy motor, shape (n,).
        log_covariance: of the next equally warm healthy piece, shape (n, n); without the fit's own error, unless
            `includes_fit_error`.
        degrees_of_freedom: of that covariance.
        log_noise: logarithm of the noise of the current; None if unknown.
        log_noise_sd: its standard deviation from start to start.
        model: extensions to fit with; None to choose by evidence.
        includes_fit_error: the covariance was estimated from fits, so it includes their errors.
        temperature_k: standard deviation of the temperature; 0 if the covariance includes it.
        warmer_k: how much warmer the motor is than at `log_values`.
        own_friction: the motor's own share of the drag; None if unknown.
        excess: factor on the variance of healthy pieces beyond covariance and fit.
        is_taught: learned from recordings, sensors included; a data sheet says nothing of sensors.
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

    @property
    def values(self) -> dict[str, float]:
        """Quantities of a healthy motor by name."""
        return dict(zip(self.names, np.exp(self.log_values).tolist(), strict=True))

    @property
    def time_constant_s(self) -> float:
        """Mechanical time constant R J / K^2 of a healthy motor; infinite if the quantities do not determine it."""
        exponents = quantities.matrix(self.names)
        wanted = np.array([{"R": 1.0, "J": 1.0, "K": -2.0}.get(name, 0.0) for name in quantities.PARAMETERS])
        powers = wanted @ np.linalg.pinv(exponents)
        return math.exp(powers @ self.log_values) if np.allclose(powers @ exponents, wanted) else math.inf


class ReferenceShift(NamedTuple):
    """Difference between the linear fit of a piece and the motor file of the same healthy motor.

    Attributes:
        driving: share s of the voltage that a brush drop leaves, if the fit has no such term.
            s V = R i + L di/dt + K w is V = (R/s) i + (L/s) di/dt + (K/s) w: a linear motor with R, L, K, J and B over
            s draws the same current and turns as fast.
        friction: drag over speed, at the piece's speed over that at the file's.
        friction_log_sd: standard deviation of its logarithm.
    """

    driving: float = 1.0
    friction: float = 1.0
    friction_log_sd: float = 0.0

    @property
    def logs(self) -> FloatArray:
        """Logarithms of R, L, K, J, B and V over those of the file."""
        logs = np.full(len(quantities.PARAMETERS), -math.log(self.driving))
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
    """Return a motor file's distribution of the quantities of a piece; None if it has none of them.

    Args:
        motor: data sheet, identified or commissioned motor.
        names: quantities of the piece; the reference may have fewer.
        are_starts: the piece is a start, not a window of a motor at work.
        temperature_c: of the motor, where measured; used if that of the healthy pieces is known too.
        shift: difference between the piece's fit and the file.
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
    exponents = quantities.matrix(names)
    if exponents[:, _VOLTAGE].any():
        return None
    # V is held at what the recording says; its tolerance scales the current, so it acts on all but ratios like B/J.
    scale = exponents.sum(axis=1)
    logs = quantities.logarithms(motor.parameters, motor.nominal_voltage_v or 1.0)
    shift = shift or ReferenceShift()
    logs += shift.logs
    return Reference(
        source=f"{'data sheet' if motor.kind == 'data_sheet' else f'{motor.kind} motor'} {motor.name}",
        names=names,
        log_values=exponents @ logs,
        log_covariance=exponents @ quantities.tolerance_covariance(motor.tolerance) @ exponents.T
        + motor.tolerance.supply**2 * np.outer(scale, scale)
        + shift.friction_log_sd**2 * np.outer(exponents[:, _FRICTION], exponents[:, _FRICTION]),
        log_noise=None if motor.current_noise_a is None else math.log(motor.current_noise_a),
        own_friction=1.0,
    )


def reference_of_pieces(
    healthy: Healthy,
    names: tuple[str, ...],
    motor: str,
    *,
    are_starts: bool = True,
    temperature_c: float | None = None,
    shift: ReferenceShift | None = None,
) -> Reference | None:
    """Return the distribution that healthy pieces give, see `reference_of`.

    If both temperatures are known, the healthy motor is taken at that of the piece. Healthy pieces of the other kind do
    not stand for the errors of this fit.
    """
    # Each wanted quantity as powers of the known ones: K^2/J of K and J, where the healthy starts had a speed.
    known, wanted = quantities.matrix(healthy.quantities), quantities.matrix(names)
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
        return f"{healthy.pieces} of {all_of_them} healthy windows of {motor} that are driven alike"
    return f"{healthy.pieces} healthy windows of {motor}"


def add_normal_spread(covariance: FloatArray, normal: FloatArray, share: float, freedom: float) -> FloatArray:
    """Add the covariance of a normal spread, as that of the temperature, to one of Student's t.

    The quantile of a sum of t and normal is at most the root of the sum of their squared quantiles. So the normal part
    is weighted by the squared ratio of the two quantiles.

    Args:
        covariance: shape (n, n).
        normal: covariance of the known spread, shape (n, n).
        share: rate of false alarms of one test.
        freedom: degrees of freedom of the first.
    """
    ratio = float(ndtri(share) / stdtrit(freedom, share))
    return np.asarray(covariance + ratio**2 * normal, dtype=np.float64)
