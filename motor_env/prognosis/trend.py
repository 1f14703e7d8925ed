"""Trends of a motor's parameters over its starts: judging them against limits, saying what follows.

Each quantity is set in relation to its reference, the mean of its first estimates, and judged by `degradation`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np

from motor_env.errors import InputError
from motor_env.prognosis.estimates import Series
from motor_env.prognosis.laws import at_one_temperature, earliest, last_jump, since, withheld
from motor_env.prognosis.wear import (
    FEWEST_ESTIMATES,
    TREND_PROBABILITY,
    Degradation,
    RemainingLife,
    degradation,
)

DEFAULT_LIMITS = (0.75, 1.25)
"""Limits of a quantity for which none is given, as factors on its reference: the paper's larger fault level.

There are none of L, which no fault moves alone and few starts tell.
"""


@dataclass(frozen=True, slots=True)
class Forecast:
    """How a quantity stands to one limit.

    Attributes:
        factor: the limit over the reference.
        reached: whether the last level lies beyond it, with a probability of at least one half.
        trends: whether there is a drift towards it (posterior probability at least 95 %).
        wear: the fitted degradation of estimate / reference.
        life: remaining life; it means something only where `trends` and nothing is withheld.
        withheld: why no remaining life is told, in words; empty where it is.
    """

    factor: float
    reached: bool
    trends: bool
    wear: Degradation
    life: RemainingLife
    withheld: str = ""

    @property
    def is_told(self) -> bool:
        """Whether the remaining life is told."""
        return not (self.reached or self.withheld)


@dataclass(frozen=True, slots=True)
class Trend:
    """One quantity judged.

    Attributes:
        series: its estimates.
        reference: mean of the first estimates.
        forecasts: one for each limit; none where there are too few estimates.
        sentence: what follows, in words.
    """

    series: Series
    reference: float
    forecasts: tuple[Forecast, ...]
    sentence: str

    @property
    def leading(self) -> Forecast | None:
        """The limit that matters: reached, or trended to, the earliest first."""
        return min(
            (forecast for forecast in self.forecasts if forecast.reached or forecast.trends),
            key=lambda forecast: (not forecast.reached, forecast.life.median),
            default=None,
        )

    @property
    def state(self) -> str:
        """`reached`, `trending`, `steady`, or `unknown` with too few estimates or no limit."""
        if self.leading is not None:
            return "reached" if self.leading.reached else "trending"
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
        factors: limits as factors on the reference, each different from 1; `DEFAULT_LIMITS` if None.
        level: probability that the interval of the remaining life is to hold.
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
    jump, restart = last_jump(relative), ""
    if jump is not None:
        relative = since(relative, jump[0])
        at, start = float(relative.time[0]), series.start
        moment = f"{at:.4g} {series.unit}" if start is None else f"{start + timedelta(days=at):%Y-%m-%d}"
        restart = f"a jump of {_percent(jump[1])} at {moment} (a repair or a step), judged since then: "
    if len(relative.time) < FEWEST_ESTIMATES:
        return Trend(
            series,
            reference,
            (),
            f"{restart}too few estimates for a trend: {len(relative.time)},"
            f" at least {FEWEST_ESTIMATES} are needed",
        )
    if factors is None:
        factors = () if series.name.startswith("L") else DEFAULT_LIMITS
    forecasts = []
    for factor in factors:
        wear = degradation(
            relative.time,
            relative.estimate,
            relative.standard_error,
            factor,
            sign=math.copysign(1.0, factor - 1.0),
        )
        life = wear.remaining_life(level)
        reached = life.probability_reached >= 0.5
        trends = wear.probability_trend >= TREND_PROBABILITY
        if trends and not reached:
            life = life._replace(low=min(life.low, earliest(relative, wear)))
        reason = withheld(relative, wear, knows_temperature=temperature is not None) if trends else ""
        forecasts.append(Forecast(factor, reached, trends, wear, life, reason))
    return Trend(series, reference, tuple(forecasts), restart + _sentence(series, forecasts))


def _sentence(series: Series, forecasts: Sequence[Forecast]) -> str:
    change = float(series.estimate[-1] / np.mean(series.estimate[:3]) - 1.0)
    for forecast in sorted(forecasts, key=lambda forecast: not forecast.reached):
        limit = _percent(forecast.factor - 1.0)
        if forecast.reached:
            share = 100.0 * forecast.life.probability_reached
            return f"the limit at {limit} is reached, with a probability of {share:.0f} %"
        if forecast.trends:
            return (
                f"trends to the limit at {limit}, by "
                f"{_percent(forecast.wear.mean_drift, digits=2)} of the reference a {series.unit.removesuffix('s')}: "
                f"{describe(forecast, series.unit)}"
            )
    if not forecasts:
        return f"no limit is given, so nothing is judged: last change {_percent(change)}"
    likely = max(forecast.wear.probability_trend for forecast in forecasts)
    return (
        f"no trend: last change {_percent(change)}; probability of a drift to a limit "
        f"{100.0 * likely:.0f} %, below {100.0 * TREND_PROBABILITY:.0f} %; no remaining life is given"
    )


def describe(forecast: Forecast, unit: str) -> str:
    """The remaining life in words, or why none is told."""
    life, share = forecast.life, f"{100.0 * forecast.life.level:.0f} %"
    if forecast.withheld:
        return f"no remaining life is told, for {forecast.withheld}"
    if math.isinf(life.high):
        return (
            f"not before {life.low:.3g} {unit} (lower end of the {share} interval; no upper end, "
            f"it is reached at all with {100.0 * life.probability_ever:.0f} %)"
        )
    return f"reached in {life.median:.3g} {unit} ({share} interval {life.low:.3g} to {life.high:.3g})"


def _percent(value: float, digits: int = 0) -> str:
    return f"{100.0 * value:+.{digits}f} %"


def parse_limits(options: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """Limits from options such as `B/J=1.5` or `R=0.9,1.1`.

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
