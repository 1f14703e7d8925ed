"""Trends of a motor whose law of wear the model has, or lacks: the table of docs/results/remaining-life.md.

python benchmarks/trend_laws.py --histories 400     # two minutes of one core

A history is judged once, after 10 to 60 daily estimates, at a random moment between 30 and 98 % of the nominal life;
one that has failed before is drawn anew.
"""

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from cyclopts import run
from tables import keep_table
from verdict_tables import HERE, How, Said, counted

from motor_env.diagnosis.prognosis.trend import Series, judge as judge_trend
from motor_env.motor.parameters import COPPER_PER_KELVIN, FloatArray

LIMIT, REACH = 1.25, 0.25
HORIZON, SUBSTEPS = 40, 8  # lives beyond 40 times what is seen count as infinite; substeps of a day
NOISES = (0.02, 0.05)
Law = Callable[[np.random.Generator, FloatArray, float], FloatArray]


def drift(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """A straight line and a random walk of 2 % of the reference over the life."""
    walk = 0.02 * np.sqrt(np.diff(day, prepend=0.0) / end) * rng.standard_normal(len(day))
    return REACH * day / end + np.cumsum(walk)


def exponential(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """Exponential growth, 3 to 6 of its time constants long."""
    growth = rng.uniform(3.0, 6.0)
    return np.asarray(REACH * np.expm1(np.minimum(growth * day / end, 50.0)) / math.expm1(growth))


def power(rng: np.random.Generator, day: FloatArray, end: float, *, exponent: float) -> FloatArray:
    """A power of the time."""
    return np.asarray(REACH * (day / end) ** exponent)


def random_walk(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """Chance alone: 8 % of the reference over the nominal life."""
    return np.cumsum(0.08 * np.sqrt(np.diff(day, prepend=0.0) / end) * rng.standard_normal(len(day)))


def repair(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """A drift from a repair on that undid the one before."""
    when = rng.uniform(0.15, 0.3) * end  # before it is judged
    return REACH / end * np.where(day < when, day, day - when)


def healthy(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """No wear."""
    return np.zeros(len(day))


def season(rng: np.random.Generator, day: FloatArray, end: float) -> FloatArray:
    """Copper through the year, 12 K up and down, with no temperature recorded; the motor never wears."""
    return np.expm1(COPPER_PER_KELVIN * 12.0 * np.sin(2.0 * math.pi * (day / 365.0 + rng.random())))


LAWS: dict[str, Law] = {
    "drift": drift,
    "exponential": exponential,
    "power 2": partial(power, exponent=2.0),
    "power 0.5": partial(power, exponent=0.5),
    "drift with a repair": repair,
    "random walk": random_walk,
    "season of ±12 K, no wear": season,
    "healthy": healthy,
}


class History(NamedTuple):
    """One motor until it is judged, and what nobody knows of it.

    Attributes:
        seen: true change at the daily estimates, shape (n,).
        life: days from the last of them until the limit is first reached.
        way: how far the last of them is on the way to the limit.
    """

    seen: FloatArray
    life: float
    way: float


def draw(law: Law, rng: np.random.Generator) -> History:
    """A motor that has not failed when it is judged."""
    while True:
        last = int(rng.integers(9, 60))
        now = last * SUBSTEPS
        day = np.arange(HORIZON * now) / SUBSTEPS
        change = law(rng, day, last / rng.uniform(0.3, 0.98))
        # The limit is a factor on the mean of the first three levels.
        reference = float(change[: 3 * SUBSTEPS : SUBSTEPS].mean())
        reach = LIMIT * (1.0 + reference) - 1.0
        beyond = np.flatnonzero(change >= reach)
        if not len(beyond) or beyond[0] > now:
            life = float(day[beyond[0]] - last) if len(beyond) else math.inf
            return History(
                change[: now + 1 : SUBSTEPS], life, float((change[now] - reference) / (reach - reference))
            )


def verdicts(name: str, noise: float, rng: np.random.Generator) -> list[str]:
    """What is said of one history, and how it stands to the truth."""
    seen, life, way = draw(LAWS[name], rng)
    n = len(seen)
    estimates = 1.0 + seen + noise * rng.standard_normal(n)
    # R moves with the temperature, which is not recorded.
    quantity = "R" if LAWS[name] is season else "friction"
    found = judge_trend(Series(quantity, np.arange(float(n)), estimates, np.full(n, noise)), (LIMIT,))
    said = ["case"]
    said += ["far"] if way >= 0.6 else []
    said += ["nearly"] if way >= 0.8 else []
    if found.forecasts:
        (one,) = found.forecasts
        if one.trends and one.has_remaining_life:
            said += ["life", "life far"] if way >= 0.6 else ["life"]
            said += (
                ["too early"] if life > one.life.high else ["too late"] if life < one.life.low else ["hold"]
            )
            said += ["median late"] if one.life.median > 2.0 * life else []
        near = one.reached or one.close
        said += ["near"] if near else []
        said += ["near nearly"] if near and way >= 0.8 else []
    return said


def judge(number: int, histories: int, seed: int) -> Said:
    """What is said of one history."""
    place, k = divmod(number, histories)
    law, noise = divmod(place, len(NOISES))
    name = list(LAWS)[law]
    said = verdicts(name, NOISES[noise], np.random.default_rng([seed, law, noise, k]))
    return [((name, f"{100 * NOISES[noise]:g} %"), word) for word in said]


def row(cell: tuple[str, ...], count: Counter[str]) -> list[str]:
    """One law and noise."""

    def share(part: str, whole: str) -> str:
        return f"{100.0 * count[part] / count[whole]:.0f} %" if count[whole] else "–"

    return [
        *cell,
        share("life", "case"),
        share("hold", "life"),
        f"{count['too early']} / {count['too late']}",
        share("life far", "far"),
        share("near", "case"),
        share("near nearly", "nearly"),
    ]


def main(*, histories: int = 400, seed: int = 5, how: How = HERE) -> None:
    """Print the table and keep it.

    Args:
        histories: of each law and noise.
        seed: of all that is drawn.
        how: options of every table.
    """
    of = {"histories": histories, "seed": seed}
    counts = counted(partial(judge, **of), len(LAWS) * len(NOISES) * histories, how, of=of)
    header = (
        "law",
        "noise",
        "remaining life given",
        "interval holds (claimed 90 %)",
        "limit later / earlier",
        "given beyond 60 % of the way",
        "called close",
        "of those beyond 80 % of the way",
    )
    keep_table(
        "remaining-life", "laws", header, (row(cell, count) for cell, count in counts.by(0, 1).items())
    )


if __name__ == "__main__":
    run(main)
