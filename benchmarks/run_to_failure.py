"""Synthetic runs to failure: a bearing that wears from start to start, and what each start lets one see of it.

Wear is the severity of the core's bearing fault, a Wiener process with drift from its onset on (Whitmore 1995). Each
start is a simulated transient of the motor with that fault; its friction is fitted as on a real start. The truth
(wear, drift, onset, time of failure) and the estimates are separate objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.inference.fit import fit
from motor_env.inference.parametrisation import Coordinates
from motor_env.inference.sensitivities import Observed
from motor_env.motor.faults import Fault, FaultKind
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray, SensorParameters
from motor_env.prognosis.wear import TREND_PROBABILITY, degradation
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.simulate import Scenario, Timing, simulate

_SUBSTEPS = 8  # of a day, from start to start; crossings between them are drawn from the Brownian bridge
_MOST_STARTS = 1 << 20
_LEAST_FRICTION = 0.2  # of the nominal one: a bearing does not run in to nothing
LEVEL = 0.9  # probability of a central interval with two ends
FEWEST_STARTS = 8  # before a run is judged
TIMING = Timing(sampling_rate_hz=2_000.0, duration_s=0.1)
FREE = ("resistance", "friction")
"""What is fitted to a start of the paper's motor."""


@dataclass(frozen=True, slots=True)
class WearRecipe:
    """What a run is drawn from, with a start a day. Wear is relative: 0.25 is 25 % more friction than nominal.

    Attributes:
        drift_per_day: mean growth of the wear.
        drift_spread: standard deviation of the logarithm of the drift from motor to motor.
        diffusion: standard deviation of the wear's random part after one day.
        diffusion_spread: standard deviation of the logarithm of the diffusion from motor to motor.
        onset_days: the growth begins at a uniform time between these two.
        limit: wear at which the motor has failed.
        starts: number of starts that are recorded.
        horizon: the wear is followed for `horizon` times as long as starts are recorded.
        sensor: channels and noise.
    """

    drift_per_day: float = 0.01
    drift_spread: float = 0.5
    diffusion: float = 0.02
    diffusion_spread: float = 0.5
    onset_days: tuple[float, float] = (0.0, 20.0)
    limit: float = 0.5
    starts: int = 60
    horizon: float = 20.0
    sensor: SensorParameters = field(default_factory=SensorParameters)


class Runs(NamedTuple):
    """The truth of n runs.

    Attributes:
        cases: case numbers, shape (n,).
        wear: at each start, shape (n, starts).
        failure_days: when the wear first reached the limit, infinite where it did not, shape (n,).
    """

    cases: NDArray[np.int64]
    wear: FloatArray
    failure_days: FloatArray


class Estimates(NamedTuple):
    """What the starts let one see: friction over nominal friction, minus 1.

    Attributes:
        wear: estimated, shape (n, starts).
        standard_error: shape (n, starts).
    """

    wear: FloatArray
    standard_error: FloatArray


def _walk(
    recipe: WearRecipe, drift: FloatArray, diffusion: FloatArray, onset: FloatArray, numbers: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Wear at the starts, shape (n, starts), and first passage, (n,), from normal and uniform numbers (2, n, steps).

    A substep from a to b, both below the limit, crosses it with the Brownian bridge's probability,
    exp(-2 (limit - a) (limit - b) / (diffusion^2 dt)).
    """
    (noise, uniform), dt = numbers, 1.0 / _SUBSTEPS
    steps = np.arange(noise.shape[1])
    begin = np.maximum(dt * steps, onset[:, None])
    active = np.maximum(dt * (steps + 1) - begin, 0.0)
    variance = np.square(diffusion)[:, None] * active
    after = np.cumsum(drift[:, None] * active + np.sqrt(variance) * noise, axis=1)
    before = np.pad(after, ((0, 0), (1, 0)))[:, :-1]
    room, left = recipe.limit - before, recipe.limit - after
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        grazes = (room > 0.0) & (uniform < np.exp(-2.0 * room * left / variance))
        share = np.where(left <= 0.0, room / (room - left), 0.5)
    passes = (active > 0.0) & ((left <= 0.0) | grazes)
    failure = np.where(passes, begin + active * share, np.inf)
    first = np.take_along_axis(failure, passes.argmax(axis=1)[:, None], axis=1)[:, 0]
    return before[:, ::_SUBSTEPS][:, : recipe.starts], np.where(passes.any(axis=1), first, np.inf)


def run_to_failure(recipe: WearRecipe, seed: int, cases: ArrayLike) -> Runs:
    """Draw runs; case n depends on (recipe, seed, n) alone.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: case numbers, shape (n,).
    """
    numbers = np.atleast_1d(np.asarray(cases, dtype=np.int64))
    n, steps = len(numbers), int(np.ceil(recipe.starts * recipe.horizon)) * _SUBSTEPS
    own = normals(seed, Stream.MOTOR, numbers, 2)
    drift = recipe.drift_per_day * np.exp(recipe.drift_spread * own[:, 0])
    diffusion = recipe.diffusion * np.exp(recipe.diffusion_spread * own[:, 1])
    first, last = recipe.onset_days
    onset = first + (last - first) * uniforms(seed, Stream.ONSET, numbers, 1)[:, 0]
    wear, failure = np.empty((n, recipe.starts)), np.empty(n)
    for begin in range(0, n, 64):  # the noise of all runs at once would not fit
        some = slice(begin, begin + 64)
        drawn = np.array(
            [
                normals(seed, Stream.WEAR, numbers[some], steps),
                uniforms(seed, Stream.WEAR_CROSSING, numbers[some], steps),
            ]
        )
        wear[some], failure[some] = _walk(recipe, drift[some], diffusion[some], onset[some], drawn)
    return Runs(numbers, wear, failure)


def observe(recipe: WearRecipe, runs: Runs, seed: int) -> Estimates:
    """Simulate every start of every run and fit its resistance and its friction."""
    shape = runs.wear.shape
    numbers = (runs.cases[:, None] * _MOST_STARTS + np.arange(shape[1])).ravel()
    wear = runs.wear.ravel()
    coordinates = Coordinates.from_names(PAPER_MOTOR, FREE)
    values, errors = np.empty(wear.size), np.empty(wear.size)
    for begin in range(0, wear.size, 4096):
        some = slice(begin, begin + 4096)
        # Friction below the nominal one (a bearing that has run in) is the motor's own; what is above is the fault's.
        less = np.maximum(1.0 + np.minimum(wear[some], 0.0), _LEAST_FRICTION)
        scenario = Scenario(
            parameters=PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=less),
            faults=(Fault(FaultKind.BEARING, np.maximum(wear[some], 0.0)),),
            sensor=recipe.sensor,
            timing=TIMING,
        )
        starts = simulate(scenario, seed, numbers[some])
        observed = Observed.from_measurements(
            starts.measurements, starts.voltage_v[0], recipe.sensor, TIMING.dt_s
        )
        fitted = fit(observed, coordinates)
        values[some] = fitted.factors[:, 1]
        errors[some] = fitted.factors[:, 1] * fitted.std[:, 1]
    return Estimates(values.reshape(shape) - 1.0, errors.reshape(shape))


class Coverage(NamedTuple):
    """How the intervals of the remaining life did on synthetic runs, one entry a run.

    Attributes:
        low: lower end of the interval, shape (n,).
        high: upper end, shape (n,).
        life: true time from the judgement to the failure, 0 where it had failed before, shape (n,).
        trends: whether a trend to the limit was reported, shape (n,).
        reached: whether the limit was reported as reached, shape (n,).
    """

    low: FloatArray
    high: FloatArray
    life: FloatArray
    trends: NDArray[np.bool_]
    reached: NDArray[np.bool_]

    @property
    def claimed(self) -> FloatArray:
        """Probability that each interval claims: one without an upper end, or from 0 on, can fail on one side only."""
        tails: FloatArray = (self.low > 0.0).astype(np.float64) + np.isfinite(self.high)
        return 1.0 - 0.5 * (1.0 - LEVEL) * tails

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Whether the interval holds the truth."""
        return (self.low <= self.life) & (self.life <= self.high)

    @property
    def reported(self) -> NDArray[np.bool_]:
        """Whether a remaining life is reported: a trend, and the limit not reached yet."""
        return self.trends & ~self.reached


def remaining_life_coverage(recipe: WearRecipe, seed: int, cases: ArrayLike) -> Coverage:
    """Draw runs, judge each at a random start, and compare the remaining life with the truth.

    The start is uniform between `FEWEST_STARTS` and the recipe's number, whatever the estimates look like, so that
    the moment of judgement tells nothing of the run.
    """
    runs = run_to_failure(recipe, seed, cases)
    estimates = observe(recipe, runs, seed)
    share = uniforms(seed, Stream.SPLIT, runs.cases, 1)[:, 0]
    starts = (FEWEST_STARTS + np.floor(share * (recipe.starts - FEWEST_STARTS + 1))).astype(np.int64)
    days = np.arange(float(recipe.starts))
    rows = []
    for n, seen in enumerate(starts):
        wear = degradation(
            days[:seen], estimates.wear[n, :seen], estimates.standard_error[n, :seen], recipe.limit
        )
        life, left = wear.remaining_life(LEVEL), float(runs.failure_days[n] - days[seen - 1])
        trends, reached = wear.probability_trend >= TREND_PROBABILITY, life.probability_reached >= 0.5
        rows.append((life.low, life.high, max(left, 0.0), trends, reached))
    low, high, life_days, trending, over = (np.array(column) for column in zip(*rows, strict=True))
    return Coverage(low, high, life_days, trending, over)
