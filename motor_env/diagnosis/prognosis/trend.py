"""Judge trends of a motor's quantities against limits.

Each quantity is relative to the mean of its first estimates, without repairs and at one temperature.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d

from motor_env.common.errors import InputError
from motor_env.diagnosis.prognosis.degradation import (
    FEWEST_ESTIMATES,
    TREND_PROBABILITY,
    Degradation,
    RemainingLife,
    fit_degradation,
)
from motor_env.motor import identifiable
from motor_env.motor.parameters import FloatArray

DEFAULT_LIMITS = (0.75, 1.25)
"""Default limits, as factors on the reference: the paper's larger fault level. L has none."""

CLOSE_SHARE = 0.8
"""Share of the way beyond which a limit is close."""

CLOSE_PROBABILITY = 0.25
"""Least probability of lying beyond that share, low because a missed limit costs more than an inspection."""


@dataclass(frozen=True, slots=True)
class Series:
    """Estimates of one quantity.

    Attributes:
        name: the quantity.
        time: rising, in `unit`, shape (n,).
        estimate: shape (n,).
        standard_error: shape (n,).
        unit: of the time.
        start: date of time 0, where dates are known.
    """

    name: str
    time: FloatArray
    estimate: FloatArray
    standard_error: FloatArray
    unit: str = "days"
    start: datetime | None = None


@dataclass(frozen=True, slots=True)
class Forecast:
    """One quantity and one limit.

    Attributes:
        factor: the limit over the reference.
        reached: whether the last level lies beyond it with a probability >= 0.5.
        close: the same for `CLOSE_SHARE` of the way and `CLOSE_PROBABILITY`.
        trends: whether it degrades with a probability >= `TREND_PROBABILITY`.
        wear: the fitted degradation of estimate / reference.
        life: remaining life; valid only if `has_remaining_life`.
        withheld: reason against a remaining life; empty for none.
    """

    factor: float
    reached: bool
    close: bool
    trends: bool
    wear: Degradation
    life: RemainingLife
    withheld: str = ""

    @property
    def has_remaining_life(self) -> bool:
        """Whether the remaining life is given."""
        return self.trends and not (self.reached or self.withheld)


@dataclass(frozen=True, slots=True)
class Trend:
    """One quantity judged.

    Attributes:
        series: its estimates.
        reference: mean of the first estimates.
        forecasts: one for each limit; none with too few estimates.
        sentence: the result in words.
    """

    series: Series
    reference: float
    forecasts: tuple[Forecast, ...]
    sentence: str

    @property
    def leading(self) -> Forecast | None:
        """Return the most urgent limit: reached, trending, or close, the earliest first."""
        return min(
            (
                forecast
                for forecast in self.forecasts
                if forecast.reached or forecast.trends or forecast.close
            ),
            key=lambda forecast: (not forecast.reached, not forecast.trends, forecast.life.median),
            default=None,
        )

    @property
    def state(self) -> str:
        """Return `reached`, `trending`, `close`, `steady`, or `unknown` with too few estimates or no limit."""
        if (forecast := self.leading) is not None:
            return "reached" if forecast.reached else "trending" if forecast.trends else "close"
        return "steady" if self.forecasts else "unknown"


def judge(
    series: Series,
    factors: Sequence[float] | None = None,
    level: float = 0.9,
    reference_count: int = 3,
    temperature: Series | None = None,
) -> Trend:
    """Judge one quantity against limits.

    Args:
        series: its estimates.
        factors: limits over the reference, not 1; `DEFAULT_LIMITS` if None.
        level: probability of the interval of the remaining life.
        reference_count: number of first estimates whose mean is the reference.
        temperature: in degrees Celsius, where recorded.

    Raises:
        InputError: the reference is 0.
    """
    if temperature is not None:
        series = at_one_temperature(series, temperature)
    reference = float(np.mean(series.estimate[:reference_count]))
    if reference == 0.0:
        raise InputError(f"{series.name}: the first estimates are 0; limits are relative to them")
    relative = replace(
        series,
        estimate=series.estimate / reference,
        standard_error=series.standard_error / abs(reference),
    )
    if factors is None:
        factors = () if series.name.startswith("L") else DEFAULT_LIMITS
    forecasts, counts = [], [len(relative.time)]
    for factor in factors:
        # A jump away from the limit is a repair; one towards it is wear in a step.
        away = last_jump(relative, -math.copysign(1.0, factor - 1.0))
        recent = relative if away is None else starting_at(relative, away[0])
        counts.append(len(recent.time))
        if len(recent.time) < FEWEST_ESTIMATES:
            continue
        wear = fit_degradation(
            recent.time,
            recent.estimate,
            recent.standard_error,
            factor,
            sign=math.copysign(1.0, factor - 1.0),
            limit_errors=abs(factor) / math.sqrt(min(reference_count, len(series.time))),
        )
        life = wear.remaining_life(level)
        trends = wear.probability_trend >= TREND_PROBABILITY
        reason = reason_withheld(recent, wear, knows_temperature=temperature is not None)
        forecasts.append(
            Forecast(
                factor,
                reached=life.probability_reached >= 0.5,
                close=wear.probability_beyond(CLOSE_SHARE) >= CLOSE_PROBABILITY,
                trends=trends,
                wear=wear,
                life=life,
                withheld=reason if trends else "",
            )
        )
    trend = Trend(series, reference, tuple(forecasts), "")
    too_few = not forecasts and min(counts) < FEWEST_ESTIMATES
    sentence = (
        f"too few estimates for a trend: {min(counts)}, at least {FEWEST_ESTIMATES} are needed"
        if too_few
        else _sentence(trend)
    )
    return replace(trend, sentence=_jump(relative, factors) + sentence)


def _jump(relative: Series, factors: Sequence[float]) -> str:
    """Describe the last jump, and its effect on limits on the other side."""
    jump = last_jump(relative)
    if jump is None:
        return ""
    at, start = float(relative.time[jump[0]]), relative.start
    moment = f"{at:.4g} {relative.unit}" if start is None else f"{start + timedelta(days=at):%Y-%m-%d}"
    words = f"a jump of {_percent(jump[1])} at {moment} (a repair or a step)"
    away = [factor for factor in factors if (factor - 1.0) * jump[1] < 0.0]
    return words + (
        f", judged since then against {' and '.join(_percent(f - 1.0) for f in away)}: " if away else ": "
    )


def _sentence(trend: Trend) -> str:
    series, leading = trend.series, trend.leading
    change = float(series.estimate[-1] / trend.reference - 1.0)
    if not trend.forecasts:
        return f"no limit is given, so nothing is judged: last change {_percent(change)}"
    if leading is None:
        likely = max(forecast.wear.probability_trend for forecast in trend.forecasts)
        return (
            f"no trend: last change {_percent(change)}; probability of a drift to a limit "
            f"{100.0 * likely:.0f} %, below {100.0 * TREND_PROBABILITY:.0f} %; no remaining life is given"
        )
    limit = _percent(leading.factor - 1.0)
    if leading.reached:
        reached = 100.0 * leading.life.probability_reached
        return f"the limit at {limit} is reached, with a probability of {reached:.0f} %"
    likely = leading.wear.probability_beyond(CLOSE_SHARE)
    near = f"above {100.0 * CLOSE_SHARE:.0f} % of the way to it with a probability of {100.0 * likely:.0f} %"
    if not leading.trends:
        return f"close to the limit at {limit}: {near}; no clear trend, so no remaining life is given"
    return (
        f"trends to the limit at {limit}, by "
        f"{_percent(leading.wear.mean_drift, digits=2)} of the reference a {series.unit.removesuffix('s')}: "
        f"{describe(leading, series.unit)}{f'; {near}' if leading.close else ''}"
    )


def describe(forecast: Forecast, unit: str) -> str:
    """Describe the remaining life, or the reason against it."""
    life, share = forecast.life, f"{100.0 * forecast.life.level:.0f} %"
    if forecast.withheld:
        return f"no remaining life is given: {forecast.withheld}"
    if math.isinf(life.high):
        return (
            f"not before {life.low:.3g} {unit} (lower end of the {share} interval; no upper end, "
            f"it is reached at all with {100.0 * life.probability_ever:.0f} %)"
        )
    interval = f"{share} interval {life.low:.3g} to {life.high:.3g}"
    return f"reached in {life.median:.3g} {unit} from the last estimate ({interval})"


def _percent(value: float, digits: int = 0) -> str:
    return f"{100.0 * value:+.{digits}f} %"


def parse_limits(options: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """Parse limits from options such as `B/J=1.5` or `R=0.9,1.1`.

    Raises:
        InputError: an option of another form.
    """
    limits: dict[str, tuple[float, ...]] = {}
    for option in options:
        name, equals, values = option.partition("=")
        try:
            factors = tuple(float(value) for value in values.split(","))
        except ValueError:
            factors = ()
        if not equals or not factors or not all(math.isfinite(f) and f != 1.0 for f in factors):
            raise InputError(
                f"--limit must look like B/J=1.5 or R=0.9,1.1 (factors on the reference), got {option!r}"
            )
        limits[name] = factors
    return limits


_BESIDE, _FEWEST = 8, 3  # estimates on either side of a jump
_JUMP = 6.0
_MAD = 1.4826
_UNKNOWN_TEMPERATURE_K = 30.0
"""Largest temperature change that goes unrecorded."""
_KNOWN = {
    name
    for has_voltage, has_speed in product((False, True), repeat=2)
    for name in identifiable.names(has_voltage=has_voltage, has_speed=has_speed)
}


def at_one_temperature(series: Series, temperature: Series) -> Series:
    """Correct estimates to the first temperature, by copper, magnets and friction."""
    kelvin = np.interp(series.time, temperature.time, temperature.estimate)
    factor = np.exp(-_per_kelvin(series.name) * (kelvin - kelvin[0]))
    return replace(series, estimate=series.estimate * factor, standard_error=series.standard_error * factor)


def _per_kelvin(name: str) -> float:
    return float(identifiable.warmth_direction(identifiable.matrix((name,)))[0]) if name in _KNOWN else 0.0


def last_jump(series: Series, sign: float = 0.0) -> tuple[int, float] | None:
    """Find index and size of the last jump; None without one. `sign` selects a direction.

    A straight line with a step is fitted to eight estimates on either side. A jump is a step of six robust standard
    deviations.
    """
    n = len(series.time)
    if n < _BESIDE:
        return None
    fits = []
    for k in range(_FEWEST, n - _FEWEST + 1):
        around = slice(max(k - _BESIDE, 0), k + _BESIDE)
        time = series.time[around] - series.time[k]
        design = np.stack([np.ones(len(time)), time / np.ptp(time), time >= 0.0], axis=1)
        covariance = np.linalg.inv(design.T @ design)
        fits.append(((covariance @ (design.T @ series.estimate[around]))[2], math.sqrt(covariance[2, 2])))
    height, error = np.array(fits).T
    z = height / error
    spread = max(_MAD * float(np.median(np.abs(z))), 0.5 * float(np.median(series.standard_error)))
    size = np.abs(z) / max(spread, 1e-9 * float(np.ptp(series.estimate)), 1e-9)
    wanted = (size > _JUMP) & (sign * height >= 0.0)
    peaks = np.flatnonzero(wanted & (size == maximum_filter1d(size, 2 * _FEWEST + 1)))
    return (_FEWEST + int(peaks[-1]), float(height[peaks[-1]])) if len(peaks) else None


def starting_at(series: Series, first: int) -> Series:
    """Select the estimates from index `first` on."""
    return replace(
        series,
        time=series.time[first:],
        estimate=series.estimate[first:],
        standard_error=series.standard_error[first:],
    )


def reason_withheld(series: Series, wear: Degradation, *, knows_temperature: bool) -> str:
    """Explain why no remaining life is given; empty if it is.

    Args:
        series: relative to the reference, without jumps.
        wear: fitted degradation.
        knows_temperature: whether the estimates are at one temperature.
    """
    change = abs(wear.mean_level - float(series.estimate[:_FEWEST].mean()))
    if not knows_temperature and change < abs(_per_kelvin(series.name)) * _UNKNOWN_TEMPERATURE_K:
        return f"a change of the temperature by {_UNKNOWN_TEMPERATURE_K:.0f} K would explain it"
    return ""
