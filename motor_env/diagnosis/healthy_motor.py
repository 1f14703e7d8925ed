"""Distribution of a healthy motor's quantities: from its data sheet, or from healthy pieces of its recordings.

Its spread for a piece whose fit tells less, and for a warmer motor, stand here, too.
"""

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
"""How far a winding may be off a measured temperature, one standard deviation."""
_FRICTION, _VOLTAGE = quantities.PARAMETERS.index("B"), quantities.PARAMETERS.index("V")


@dataclass(frozen=True, slots=True)
class Reference:
    """Distribution of a healthy motor's quantities, as far as one kind of recording can tell them.

    Attributes:
        source: in words, for the user.
        names: the quantities.
        log_values: logarithms of the quantities of a healthy motor, shape (n,).
        log_covariance: covariance of the next healthy piece about them, equally warm, shape (n, n); without the fit's
            own error, unless `includes_fit_error`.
        degrees_of_freedom: of that covariance.
        log_noise: logarithm of the noise of the current, or None where unknown.
        log_noise_sd: its standard deviation from start to start.
        model: extensions to fit with, or None to choose by evidence.
        includes_fit_error: the covariance was estimated from fits, and holds their errors already.
        temperature_k: standard deviation of the temperature; 0 where the covariance holds it.
        warmer_k: how much warmer the motor is than the values say.
        own_friction: share of the drag that is the motor's own friction; None where a load was not told.
        excess: by which factor healthy pieces scatter more than covariance and fit say (variance).
        is_taught: recordings have taught it, its sensors too; a data sheet says nothing of sensors.
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
        """The quantities of a healthy motor by name."""
        return dict(zip(self.names, np.exp(self.log_values).tolist(), strict=True))

    @property
    def time_constant_s(self) -> float:
        """Mechanical time constant R J / K^2 of a healthy motor; infinite where the quantities do not tell it."""
        exponents = quantities.matrix(self.names)
        wanted = np.array([{"R": 1.0, "J": 1.0, "K": -2.0}.get(name, 0.0) for name in quantities.PARAMETERS])
        powers = wanted @ np.linalg.pinv(exponents)
        return math.exp(powers @ self.log_values) if np.allclose(powers @ exponents, wanted) else math.inf


class ReferenceShift(NamedTuple):
    """How the motor of a piece differs from what a motor file says, for the same healthy motor.

    Attributes:
        driving: share s of the voltage that a brush drop leaves, where the piece's fit has no such term.
            s V = R i + L di/dt + K w is V = (R/s) i + (L/s) di/dt + (K/s) w: a linear motor with R, L, K, J and B over
            s draws the same current, and turns as fast.
        friction: drag over the piece's speed, over that of the speed that the file's friction belongs to.
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
    """What a motor file says of the quantities of a piece; None where it speaks of none of them.

    Args:
        motor: data sheet, identified or commissioned motor.
        names: quantities that the piece tells; the reference may have fewer of them.
        are_starts: the piece is a start, no window of a motor at work.
        temperature_c: of the motor, where measured; it counts where that of the healthy pieces is known too.
        shift: how the piece's motor differs from what the file says.
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
    """What healthy pieces say of a piece, see `reference_of`.

    Where both temperatures are known the healthy motor is taken at this one, with what is left unknown of it. Pieces of
    another kind hold errors of other fits: they do not count for those of this one.
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
    """What a piece is compared with, in words."""
    if healthy.fleet is not None:
        return f"{healthy.fleet.motors} sisters of {motor}"
    if healthy.windows is None:
        return f"{healthy.pieces} healthy starts of {motor}"
    all_of_them = sum(len(drive.pieces) for drive in healthy.windows.drives)
    if healthy.pieces < all_of_them:
        return f"{healthy.pieces} of {all_of_them} healthy windows of {motor} that are driven alike"
    return f"{healthy.pieces} healthy windows of {motor}"


def add_normal_spread(covariance: FloatArray, normal: FloatArray, share: float, freedom: float) -> FloatArray:
    """A covariance of Student's t with that of a known normal spread added, as of the temperature.

    The quantile of a sum of t and normal lies below the root of the sum of their squared quantiles. So the normal part
    counts in the ratio of the two quantiles.

    Args:
        covariance: shape (n, n).
        normal: covariance of the known spread, shape (n, n).
        share: rate of false alarms of one test.
        freedom: degrees of freedom of the first.
    """
    ratio = float(ndtri(share) / stdtrit(freedom, share))
    return np.asarray(covariance + ratio**2 * normal, dtype=np.float64)
