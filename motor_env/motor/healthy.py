"""Statistics of a motor's healthy recordings: the table `healthy` of a motor file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from motor_env.motor.parameters import FloatArray, require
from motor_env.motor.toml_files import ArrayOf, Finite, NotNegative, Positive


@dataclass(frozen=True, slots=True)
class Starts:
    """How healthy starts were recorded and fitted.

    Attributes:
        log_noise: mean logarithm of the current's noise in A.
        log_noise_sd: standard deviation of the next start's logarithm of the noise.
        model: extensions of the textbook model that the fits used.
        model_low: smallest value of each extension over the starts.
        model_high: largest value of each.
        sampling_rate_hz: of the starts; None where unknown.
        duration_s: of the shortest start, after its onset.
        quiet_s: the same before the onset.
        ripple_hz: commutation ripple at the last speed; None unless every start has one.
        ripple_constant_v_s: K times the ripple's periods a turn; over volt where V is unknown.
        ripple_log_sd: standard deviation of the logarithm of either in the next start.
        direction: common sign of the current; 0 if the starts differ.
        turned: columns whose sign is opposite to the voltage.
    """

    log_noise: Finite
    log_noise_sd: Positive
    model: tuple[str, ...] = ()
    model_low: tuple[Positive, ...] = ()
    model_high: tuple[Positive, ...] = ()
    sampling_rate_hz: Positive | None = None
    duration_s: Positive | None = None
    quiet_s: NotNegative | None = None
    ripple_hz: Positive | None = None
    ripple_constant_v_s: Positive | None = None
    ripple_log_sd: Positive | None = None
    direction: Literal[-1, 0, 1] = 0
    turned: tuple[Literal["current_a", "speed_rad_s", "voltage_v"], ...] = ()

    def __post_init__(self) -> None:
        require(
            all(len(bound) in (0, len(self.model)) for bound in (self.model_low, self.model_high)),
            "healthy.starts.model_low and model_high must have one value for each of healthy.starts.model",
        )


@dataclass(frozen=True, slots=True)
class ScoreCalibration:
    """Calibration of the scores of `watch` on healthy windows: of log R, K, J and B over the healthy values.

    Attributes:
        windows: number of healthy windows.
        covariance: of scores whitened by the fit's own error, shape (4, 4).
        degrees_of_freedom: of the Student-t tails.
        drift_covariance: of a healthy motor's drift, shape (4, 4).
        tails_hold: whether the windows, judged by leave-one-out, keep the rate of the tails.
    """

    windows: Annotated[int, Field(ge=2)]
    covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    degrees_of_freedom: Positive
    drift_covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    tails_hold: bool = False

    def __post_init__(self) -> None:
        require(
            np.shape(self.covariance) == np.shape(self.drift_covariance) == (4, 4),
            "healthy.windows.calibration: the covariances must be 4 by 4",
        )
        require(
            bool(np.linalg.eigvalsh(self.covariance)[0] > 0.0)
            and np.linalg.eigvalsh(self.drift_covariance)[0] >= -1e-12,
            "healthy.windows.calibration: covariance must be positive definite, drift_covariance must not be negative",
        )


@dataclass(frozen=True, slots=True)
class OperatingCondition:
    """Operating condition of a healthy motor, and the distribution of the next window under it.

    Attributes:
        pieces: indices of its healthy windows.
        moved: `condition_features` of (some of) them, shape (n, 3, 17).
        values: geometric means of R, K, J and B over them, SI, shape (4,).
        log_covariance: of the logarithms of the next window's, shape (4, 4).
        degrees_of_freedom: of that covariance (Student t).
    """

    pieces: tuple[Annotated[int, Field(ge=0)], ...]
    moved: Annotated[FloatArray, ArrayOf(tuple[tuple[tuple[Finite, ...], ...], ...])]
    values: Annotated[FloatArray, ArrayOf(tuple[Positive, ...])]
    log_covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    degrees_of_freedom: Positive

    def __post_init__(self) -> None:
        require(
            np.shape(self.moved)[1:] == (3, 17),
            "healthy.windows.drives.moved must hold 3 rows of 17 numbers of each window",
        )
        require(np.shape(self.values) == (4,), "healthy.windows.drives.values must have 4 numbers")
        covariance = self.log_covariance
        require(
            np.shape(covariance) == (4, 4)
            and np.allclose(covariance, covariance.T)
            and bool(np.linalg.eigvalsh(covariance)[0] > 0.0),
            "healthy.windows.drives.log_covariance must be 4 by 4 and positive definite",
        )


@dataclass(frozen=True, slots=True)
class Windows:
    """How healthy windows of the motor at work were recorded and fitted.

    Attributes:
        window_s: their length.
        terms: of the joint fit, see `motor_env.diagnosis.estimation.terms`.
        physical: values of the joint fit, in the order of `motor_env.diagnosis.estimation.parameter_index`.
        hold: shape of the voltage between two samples.
        dt_s: sampling interval of the fit.
        speed_rad_s: effective speed, at which the drag over the speed is the quantity B.
        rms_volts: least and largest effective voltage of a window; None if unknown.
        peaks: largest voltage, current and speed; None if unknown.
        window_excess: variance of the windows' scatter over the predicted one.
        drives: operating conditions; none where only a fault changes the parameters.
        alike: largest `condition_distance` within one condition.
        calibration: of the scores of `watch`; None for windows not compared.
        one_way: whether the motor turns one way only.
    """

    window_s: Positive
    terms: tuple[str, ...]
    physical: Annotated[FloatArray, ArrayOf(tuple[Finite, ...])]
    hold: Literal["held", "straight", "late"]
    dt_s: Positive
    speed_rad_s: Positive
    rms_volts: tuple[Positive, Positive] | None = None
    peaks: tuple[Positive, Positive, Positive] | None = None
    window_excess: Positive = 1.0
    drives: tuple[OperatingCondition, ...] = ()
    alike: Positive = 1.0
    calibration: ScoreCalibration | None = None
    one_way: bool = False


@dataclass(frozen=True, slots=True)
class Fleet:
    """Fleet whose motors define the healthy one.

    Attributes:
        motors: their number.
        log_within: covariance of the logarithms between records of one motor, shape (n, n).
    """

    motors: Annotated[int, Field(ge=1)]
    log_within: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]


@dataclass(frozen=True, slots=True)
class Healthy:
    """Distribution of the quantities of a healthy motor's next start or window.

    Attributes:
        pieces: number of healthy starts, or of windows.
        degrees_of_freedom: of the spread below (Student t), from pieces and prior.
        quantities: names (see `motor_env.motor.identifiable`).
        values: geometric means over the pieces, SI, shape (n,).
        log_covariance: of the logarithms of the *next* piece about these, shape (n, n).
        temperature_k: standard deviation of the temperature.
        temperature_c: temperature during the pieces, where known.
        own_friction: share of the drag that is the motor's, not the load's; None if unknown.
        starts: of starts; None for windows.
        windows: of windows; None for starts.
        fleet: source of the statistics; `log_covariance` is then between motors, without fit errors. None for own
            pieces.
    """

    pieces: Annotated[int, Field(ge=1)]
    degrees_of_freedom: Positive
    quantities: tuple[str, ...]
    values: Annotated[FloatArray, ArrayOf(tuple[Positive, ...])]
    log_covariance: Annotated[FloatArray, ArrayOf(tuple[tuple[Finite, ...], ...])]
    temperature_k: NotNegative = 15.0
    temperature_c: Finite | None = None
    own_friction: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    starts: Starts | None = None
    windows: Windows | None = None
    fleet: Fleet | None = None

    def __post_init__(self) -> None:
        n, covariance = len(self.quantities), self.log_covariance
        require(
            np.shape(self.values) == (n,) and np.shape(covariance) == (n, n),
            f"healthy names {n} quantities; values and log_covariance must have that size",
        )
        require(
            np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance)[0] > 0.0,
            "healthy.log_covariance must be symmetric and positive definite",
        )
        require(
            self.fleet is None or np.shape(self.fleet.log_within) == (n, n),
            f"healthy.fleet.log_within must have the size of the {n} quantities",
        )
        require(
            (self.starts is None) != (self.windows is None),
            "healthy must have one of the tables starts and windows",
        )

    def under(self, drive: OperatingCondition) -> Healthy:
        """Return the statistics under one of the operating conditions."""
        return replace(
            self,
            pieces=len(drive.pieces),
            values=drive.values,
            log_covariance=drive.log_covariance,
            degrees_of_freedom=drive.degrees_of_freedom,
        )
