"""Stated lives under laws of wear that the model has and lacks: a table of docs/trend.md.

python benchmarks/trend_laws.py --histories 100
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from cyclopts import run
from tables import print_table
from verdict_tables import HERE, How, Said, counted

from motor_env.motor.parameters import COPPER_PER_KELVIN, FloatArray
from motor_env.prognosis.estimates import Series
from motor_env.prognosis.trend import judge as judge_trend

LIMIT, DAYS, ERROR = 1.25, 400, 0.005
Law = Callable[[np.random.Generator, FloatArray], FloatArray]


def drift(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """A straight line and a random walk."""
    walk = 0.003 * np.cumsum(rng.standard_normal(len(day)))
    return np.asarray(1.0 + 10.0 ** rng.uniform(-3.0, -2.0) * day + walk)


def random_walk(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """Chance alone."""
    return np.asarray(1.0 + 0.01 * np.cumsum(rng.standard_normal(len(day))))


def accelerating(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """Exponential growth."""
    return np.asarray(1.0 + 0.002 * np.expm1(day / rng.uniform(8.0, 20.0)))


def steps(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """Small jumps at random times."""
    jumps = (rng.random(len(day)) < 0.03) * rng.uniform(0.03, 0.10, len(day))
    return np.asarray(1.0 + np.cumsum(jumps))


def repair(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """A drift from a repair on that undid the one before."""
    rate, when = 10.0 ** rng.uniform(-2.5, -2.0), rng.uniform(8.0, 12.0)
    return np.asarray(1.0 + rate * np.where(day < when, day, day - when))


def season(rng: np.random.Generator, day: FloatArray) -> FloatArray:
    """Copper through the year, 12 K up and down; the motor never wears."""
    return np.asarray(np.exp(COPPER_PER_KELVIN * 12.0 * np.sin(2.0 * math.pi * (day / 365.0 + rng.random()))))


LAWS: dict[str, Law] = {
    "drift": drift,
    "random walk": random_walk,
    "accelerating": accelerating,
    "steps": steps,
    "repair": repair,
    "season": season,
}


def history(law: Law, rng: np.random.Generator) -> tuple[str, bool, bool]:
    """What is said of one history, whether the stated interval holds the life, and whether a jump is told."""
    truth = law(rng, np.arange(float(DAYS)))
    last = int(rng.integers(15, 61))
    beyond = np.flatnonzero(truth >= LIMIT)
    if len(beyond) and beyond[0] <= last:
        return "failed before", False, False
    life = float(beyond[0] - last) if len(beyond) else math.inf
    seen = truth[:last] + ERROR * rng.standard_normal(last)
    # R moves with the temperature, which is not recorded.
    name = "R" if law is season else "friction"
    found = judge_trend(Series(name, np.arange(float(last)), seen, np.full(last, ERROR)), (LIMIT,))
    if not found.forecasts:
        return "too few", False, "jump" in found.sentence
    forecast = found.forecasts[0]
    told = "reached" if forecast.reached else "no trend"
    if forecast.trends and not forecast.reached:
        told = "withheld" if forecast.withheld else "life"
    holds = forecast.life.low <= life + 1.0 and life <= forecast.life.high
    return told, holds, "jump" in found.sentence


def judge(number: int, histories: int, seed: int) -> Said:
    """What is said of one history."""
    place, k = divmod(number, histories)
    name = list(LAWS)[place]
    told, holds, jump = history(LAWS[name], np.random.default_rng([seed, place, k]))
    marks = [mark for mark, is_so in (("hold", told == "life" and holds), ("jump told", jump)) if is_so]
    return [((name,), told), *(((name, "also"), mark) for mark in marks)]


def main(*, histories: int = 100, seed: int = 5, how: How = HERE) -> None:
    """Print the table.

    Args:
        histories: of each law.
        seed: of all that is drawn.
        how: options of every table.
    """
    of = {"histories": histories, "seed": seed}
    counts = counted(partial(judge, **of), len(LAWS) * histories, how, of=of)
    said = ("life", "hold", "no trend", "withheld", "too few", "reached", "failed before", "jump told")
    header = ("law", "lives stated", *said[1:])
    rows = ([name, *(str(counts[(name,)][words]) for words in said)] for name in LAWS)
    print_table(f"{histories} histories a law, 90 % intervals", header, rows)


if __name__ == "__main__":
    run(main)
