"""What no policy exceeds: a column of the reference scores, which reference_scores.py measures.

Monitors and probes: a genie tells the agent, at the moment of the onset, that a fault of one class of the recipe has
just set in, or that this is a healthy motor's moment: healthy episodes get one too, with a class drawn at will. Knowing
more never hurts (information relaxation: Brown, Smith & Sun 2010), so the best use of it bounds every policy that sees
the current at every sample. What is left is a test of two hypotheses with a known signature, whose state is the
log-odds of the fault: a look moves them by N(+-information / 2, information), + with a fault. Dynamic programming
solves it (Wald & Wolfowitz 1948, with a horizon and a price of delay). In a block of samples the genie lets the agent
decide before it pays. On a probing task it tells less: the class alone, and that at the beginning of the episode
(`Pair`). The class that is named in healthy episodes is drawn with the probabilities that make the bound lowest. Of
tolerances and noise faults the genie tells everything; the nominal motor stands for all that are drawn.

Drives: the return of one that knows all and sets the speed of each period at will. A winding grows whatever is done, so
it has to be stopped before it fails. A bearing grows by power: beside tracking and limping each period then pays a
price for growth, the multiplier of Lagrange that makes the sum largest, and none of the dynamics binds it. Both are
told the fault, the load and the profile, and pay no heat. Neither can do better on these episodes; the figure has their
sampling error, and that of a table between whose points is interpolated (some 0.001).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import minimize
from scipy.special import expit, softmax

from motor_env.envs import DriveOptions, DriveVectorEnv, MaintainOptions
from motor_env.envs.drive.kernel import BEARING, WINDING
from motor_env.envs.drive.options import Control
from motor_env.envs.maintain.options import LEVELS, make_tables
from motor_env.envs.maintain.replacement import transitions
from motor_env.envs.options import MonitorOptions
from motor_env.envs.policies.fault_posterior import (
    N_HYPOTHESIS,
    known_faults,
    known_motor,
    onset_law,
    sample_model,
    step_of,
)
from motor_env.envs.policies.residual_posterior import innovation_signatures
from motor_env.envs.setup import Setup, make_setup
from motor_env.motor.compiled import njit
from motor_env.motor.model import State, load_torque
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Spread

LOG_ODDS = np.linspace(-14.0, 14.0, 141)
PROBABILITY = expit(LOG_ODDS)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(25)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@njit(cache=True, error_model="numpy")
def look_matrix(information: float) -> FloatArray:
    """Matrix that makes of values by the log-odds after a look those expected before it.

    Between the places of the grid values are linear in the probability: too large where they are convex in it.
    """
    spread, step, last = math.sqrt(information), LOG_ODDS[1] - LOG_ODDS[0], len(LOG_ODDS) - 1
    matrix = np.zeros((last + 1, last + 1))
    for m in range(last + 1):
        for q in range(len(_NODES)):
            for sign in (-1.0, 1.0):
                odds = LOG_ODDS[m] + sign * 0.5 * information + spread * _NODES[q]
                odds = min(max(odds, LOG_ODDS[0]), LOG_ODDS[last])
                low = min(int((odds - LOG_ODDS[0]) / step), last - 1)
                at = (1.0 / (1.0 + math.exp(-odds)) - PROBABILITY[low]) / (
                    PROBABILITY[low + 1] - PROBABILITY[low]
                )
                weight = _WEIGHTS[q] * (PROBABILITY[m] if sign > 0.0 else 1.0 - PROBABILITY[m])
                matrix[m, low] += weight * (1.0 - at)
                matrix[m, low + 1] += weight * at
    return matrix


class Looks(NamedTuple):
    """What a step of a probed motor shows of one class, and where it brings the motor.

    The place is the speed's distance from its rest, as a voltage, and how far the fault has moved the speed. The
    current follows within a step.

    Attributes:
        information: quadratic form on (place, last offset, offset, 1): summed squares of the mean innovations, (5, 5).
        move: new place from (place, last offset, offset, 1), shape (2, 5).
        reach: largest size of the two, shape (2,).
    """

    information: FloatArray
    move: FloatArray
    reach: FloatArray


def looks(setup: Setup, which: int) -> Looks:
    """Information and movement of a class, read off its linear model along a random probe.

    Raises:
        ValueError: the current does not settle within a step, so that the place says too little.
    """
    n, offsets = setup.options.samples_per_step, np.unique(setup.offsets_v)
    samples = [sample_model(setup, which)] * n
    rows, _ = step_of(samples)
    healthy, _ = step_of([sample_model(setup, None)] * n)
    volts = float(np.asarray(setup.options.task.motor.back_emf_constant_v_s_per_rad))
    rng = np.random.default_rng(0)
    state, path, last = np.zeros(N_HYPOTHESIS), np.zeros(N_HYPOTHESIS), 0.0
    inputs, means, places = [], [], []
    for offset in rng.choice(offsets, 400):
        place = (path[State.SPEED] * volts, (state[State.SPEED] - path[State.SPEED]) * volts)
        inputs.append((*place, last, offset, 1.0))
        at, shown = np.array([*state, offset, 1.0]), np.empty(n)
        for k, sample in enumerate(samples):
            moved = sample @ at
            at[:N_HYPOTHESIS], shown[k] = moved[:N_HYPOTHESIS], moved[N_HYPOTHESIS]
        means.append(shown)
        state, path, last = rows @ [*state, offset, 1.0], healthy @ [*path, offset, 1.0], offset
        places.append((path[State.SPEED] * volts, (state[State.SPEED] - path[State.SPEED]) * volts))
    x, y, z = np.array(inputs), np.array(means), np.array(places)
    row, move = np.linalg.lstsq(x, y, rcond=None)[0], np.linalg.lstsq(x, z, rcond=None)[0]
    error = float(np.linalg.norm(y - x @ row) / np.linalg.norm(y))
    require(
        error < 0.02, f"a step must be long enough for the current to settle, got an error of {error:.1%}"
    )
    return Looks(row @ row.T, move.T, np.abs(z).max(axis=0))


PLACES = 9
START = PLACES**2 // 2  # the place of a motor that was left alone


def declared_worth(options: MonitorOptions) -> FloatArray:
    """Worth of declaring the one fault that there can be, by its log-odds."""
    return PROBABILITY * options.correct_reward - (1.0 - PROBABILITY) * options.false_alarm_cost


def silent_worth(options: MonitorOptions) -> FloatArray:
    """Worth of being silent at the horizon, by the log-odds of the fault."""
    return (1.0 - PROBABILITY) * options.silent_reward - PROBABILITY * options.miss_cost


class Pair:
    """A class of fault, or none, on a probing task.

    Args:
        setup: of the task.
        which: number of the class.

    Attributes:
        looks: what a step shows of the class.
    """

    def __init__(self, setup: Setup, which: int) -> None:
        self.looks = looks(setup, which)
        self._options = options = setup.options
        self._chance = float(options.task.class_probabilities[which])
        self._stay, self._earliest = onset_law(options)
        axes = [np.linspace(-reach, reach, PLACES) for reach in self.looks.reach]
        healthy, moved = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        one, look, move = np.ones_like(healthy), [], []
        for offset, last in product(options.offsets_v, options.offsets_v):
            # of a fault that has been there, and of one that sets in: the place is where it was
            shown = [[healthy, place, last * one, offset * one, one] for place in (moved, 0.0 * one)]
            information = np.einsum("qip,ij,qjp->qp", shown, self.looks.information, shown).max(axis=0)
            look.append([look_matrix(value).astype(np.float32) for value in information])
            move.append(self._weights(self.looks.move @ shown[0]))
        n = len(options.offsets_v)
        self._look = np.array(look).reshape(n, n * len(one), len(LOG_ODDS), -1)
        self._move = np.array(move, dtype=np.float32).reshape(n, n * len(one), -1)

    def coordinates(self, place: FloatArray) -> FloatArray:
        """Where on the grid a place lies, from 0 to PLACES - 1; both of shape (2, n)."""
        at = (place / self.looks.reach[:, None] + 1.0) * 0.5 * (PLACES - 1)
        return np.clip(at, 0.0, PLACES - 1.0)

    def _weights(self, place: FloatArray) -> FloatArray:
        """What each place of the grid counts at other places, shape (n, PLACES^2)."""
        at = self.coordinates(place)[:, :, None]
        first, second = np.maximum(1.0 - np.abs(at - np.arange(PLACES)), 0.0)
        weights: FloatArray = (first[:, :, None] * second[:, None]).reshape(len(first), -1)
        return weights

    def worths(self, seeming: FloatArray) -> Iterator[FloatArray]:
        """Worth of each offset after each last offset, the last step first.

        Args:
            seeming: probabilities of a healthy episode in which this class is named, shape (n_seeming,).

        Yields:
            Shape (n_offsets, n_offsets, PLACES^2, log-odds of the fault, n_seeming).
        """
        options, p, n = self._options, PROBABILITY[:, None], len(self._look)
        per_step = options.samples_per_step
        step_s, offsets = options.dt_s * per_step, np.array(options.offsets_v)
        price = options.probe_cost_per_v2_s * step_s * offsets[:, None, None, None] ** 2
        shape = (n, PLACES**2, len(p), len(seeming))
        value = np.broadcast_to(silent_worth(options)[:, None], shape)
        declared, column = declared_worth(options)[:, None], np.arange(len(seeming))
        for step in reversed(range(options.n_steps)):
            since = np.maximum(np.array([step, step + 1]) * per_step - self._earliest, 0)
            unborn, later = self._chance * self._stay**since
            sets_in = (1.0 - p) * (unborn - later) / (unborn + seeming)
            following = self._move @ value.reshape(n, PLACES**2, -1).astype(np.float32)
            seen = self._look @ following.reshape(n, -1, *shape[2:])
            low = np.clip(np.searchsorted(PROBABILITY, p + sets_in) - 1, 0, len(LOG_ODDS) - 2)
            at = (p + sets_in - PROBABILITY[low]) / (PROBABILITY[low + 1] - PROBABILITY[low])
            seen = (1.0 - at) * seen[:, :, low, column] + at * seen[:, :, low + 1, column]
            delay = (
                options.delay_cost_per_s * step_s * (p + 0.5 * sets_in)
            )  # one that comes does so in mid-step
            worth = (seen - delay - price).reshape(n, *shape)
            yield worth
            value = np.maximum(worth.max(axis=0), declared)

    def totals(self, seeming: FloatArray) -> FloatArray:
        """What the episodes in which the class is named contribute to the mean return at most, shape (n_seeming,)."""
        for worth in self.worths(seeming):
            first: FloatArray = worth[:, 0, START, 0].max(axis=0)
        return (self._chance + seeming) * first


BLOCK_S = 1e-3
REMAINING = 24
SEEMING = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)


def upper_bound(options: MonitorOptions) -> float:
    """Upper bound on the mean return of any policy on a task.

    Raises:
        ValueError: the posterior of the task is not known, see `ProbeBelief`, even if its tolerances were.
    """
    recipe = options.task
    heard = [c.kind is None or not c.kind.changes_noise for c in recipe.classes]
    share = float(recipe.class_probabilities[heard].sum())
    told = replace(recipe, spread=Spread(), classes=tuple(np.array(recipe.classes, dtype=object)[heard]))
    setup = make_setup(replace(options, recipe=told, motor=None))
    bound = _probing(setup) if len(options.offsets_v) > 1 else _watching(setup)
    return share * bound + (1.0 - share) * options.correct_reward


def _lowest(total: Callable[[FloatArray], float], n_classes: int) -> float:
    """The lowest total over all shares of the classes that are named in healthy episodes."""

    def of_logits(logits: FloatArray) -> float:
        return total(np.maximum(softmax(logits), 1e-9))

    starts = 3.0 * np.eye(n_classes)
    return min(
        float(minimize(of_logits, x0=start, method="Nelder-Mead", options={"maxfev": 300}).fun)
        for start in starts
    )


def _probing(setup: Setup) -> float:
    """Bound on a task whose voltage can be moved."""
    faults = known_faults(setup)
    healthy = 1.0 - setup.options.task.class_probabilities[faults].sum()
    totals = [Pair(setup, which).totals(healthy * np.array(SEEMING)) for which in faults]

    def total(shares: FloatArray) -> float:
        # convex, so that lines between the shares that were tried are above it
        return sum(float(np.interp(share, SEEMING, row)) for share, row in zip(shares, totals, strict=True))

    return _lowest(total, len(faults))


def _watching(setup: Setup) -> float:
    """Bound on a monitor."""
    options, faults = setup.options, known_motor(setup)
    chance = options.task.class_probabilities[faults]
    late, weights, remaining = _remaining(options)
    blocks = np.ceil(remaining / BLOCK_S).astype(int)
    values = np.array([_values_at_onset(setup, which, blocks) for which in faults])

    def total(shares: FloatArray) -> float:
        seeming = (1.0 - chance.sum()) * shares
        odds, mass = np.log(chance / seeming), chance + seeming
        told = [[np.interp(at, LOG_ODDS, row) for row in rows] for at, rows in zip(odds, values, strict=True)]
        return float(mass @ np.array(told) @ weights + mass.sum() * late * options.silent_reward)

    return _lowest(total, len(faults))


def _remaining(options: MonitorOptions) -> tuple[float, FloatArray, FloatArray]:
    """Probability of no onset before the horizon; weights of some times that may remain after it, and these in s."""
    span = options.horizon_s - options.earliest_onset_s
    late = math.exp(-span / options.mean_onset_s)
    edges = np.linspace(0.0, 1.0 - late, REMAINING + 1)
    since = -options.mean_onset_s * np.log1p(-edges)
    # the most that can remain in each part: with more time the genie's agent does not do worse
    return late, np.diff(edges), span - since[:-1]


def _values_at_onset(setup: Setup, which: int, blocks: FloatArray) -> FloatArray:
    """Value at the onset of a class by the log-odds, for every number of blocks that remain: (times, log-odds)."""
    options = setup.options
    per_block = round(BLOCK_S / options.dt_s)
    means = innovation_signatures(setup, [which], int(blocks.max()) * per_block)[0]
    information = np.square(means).reshape(len(means) // per_block, -1).sum(axis=1)
    declared, silent = declared_worth(options), silent_worth(options)
    delay = options.delay_cost_per_s * options.dt_s * per_block * PROBABILITY
    value = np.tile(silent[:, None], len(blocks))
    for k in reversed(range(int(blocks.max()))):
        # the block is seen before it is paid: that is more than any policy has
        seen = look_matrix(information[k]) @ np.maximum(declared[:, None], value - delay[:, None])
        value = np.where(k < blocks, seen, value)
    return value.T


PRICES = np.concatenate([[0.0], np.geomspace(0.02, 60.0, 40)])  # of a unit of the logarithm of the severity
NEVER = 1e9


def cheapest(options: DriveOptions, growth_prices: FloatArray) -> RegularGridInterpolator:
    """Least cost of a period by price of growth per second, unknown load and speed asked for."""
    o, dt = options, options.period_s
    asked = np.linspace(o.lowest_speed_rad_s, o.top_speed_rad_s, 36)
    loads = o.load_std_n_m * np.linspace(-5.0, 5.0, 21)
    ratio = np.linspace(
        0.0, 1.1, 441
    )  # of the speed to what is asked; the scales of a limping motor are among them
    speeds = asked[:, None] * ratio
    full = (o.load_torque_n_m + o.fan_torque_n_m) * o.top_speed_rad_s
    torque = load_torque(o.load_torque_n_m, o.fan_n_m_s2, speeds) + loads[:, None, None]
    pace = 1.0 + o.stress_share * (np.maximum(torque * speeds, 0.0) / full - 1.0)  # (loads, asked, speeds)
    least = np.full(speeds.shape, np.inf)
    for scale in np.linspace(o.limp_share, 1.0, 21):
        error = o.tracking_cost_per_s * ((ratio - scale) * asked[:, None] / o.top_speed_rad_s) ** 2
        if o.tracking_limit_per_s > 0.0:
            error = error / (1.0 + error / o.tracking_limit_per_s)
        least = np.minimum(least, error + o.limp_cost_per_s * (1.0 - scale) / (1.0 - o.limp_share))
    costs = [(least + price * pace).min(axis=2) * dt for price in growth_prices]
    return RegularGridInterpolator((growth_prices, loads, asked), np.array(costs))


def bearing_costs(
    options: DriveOptions, growth: FloatArray, loads: FloatArray, asked: FloatArray
) -> FloatArray:
    """Least cost of each episode with a bad bearing; loads and speeds of each period, zero cost before the onset."""
    o, (count, steps) = options, loads.shape
    known = ~np.isnan(loads)
    table = cheapest(
        o, np.concatenate([[0.0], np.geomspace(0.005, 1.3 * PRICES[-1] * o.growth_per_s[1], 60)])
    )
    worst = np.log(o.failure_severity[0] / o.onset_severity[0])
    grown = np.linspace(0.0, worst, 400)
    worn = o.wear_cost * np.exp(grown - worst)
    left_s = o.period_s * (steps - np.arange(steps + 1))
    edge = 5.0 * o.load_std_n_m
    best = np.full((count, steps + 1), -np.inf)
    for price in PRICES:
        at = np.stack(
            np.broadcast_arrays(price * growth[:, None], np.clip(loads, -edge, edge), asked), axis=-1
        )
        spent = np.zeros((count, steps))
        spent[known] = table(at[known])
        so_far = np.concatenate([np.zeros((count, 1)), spent.cumsum(axis=1)], axis=1)
        best = np.maximum(best, so_far + (worn - price * grown).min())
    best = np.where(np.cumsum(known, axis=1)[:, -1:] > 0, best, 0.0)
    costs: FloatArray = (np.maximum(best, 0.0) + o.stop_cost_per_s * left_s).min(axis=1)
    return costs


def drive_bounds(options: DriveOptions, count: int, seed: int) -> FloatArray:
    """Return of each episode that no controller exceeds in the mean, shape (count,)."""
    o = options
    envs = DriveVectorEnv(
        count,
        replace(
            o,
            failure_severity=(NEVER, NEVER),
            burn_k=NEVER,
            control=Control.VOLTAGE_AND_DECISION,
            steps_per_decision=1,
        ),
    )
    envs.reset(seed=seed)
    kind, onset, growth = (envs.truth(name) for name in ("kind", "onset", "growth"))
    loads, asked = np.empty((2, count, o.n_steps))
    for k in range(o.n_steps):
        loads[:, k], asked[:, k] = envs.truth("load"), envs.truth("profile")
        envs.step(np.tile([0.0, -1.0], (count, 1)))
    costs = np.zeros(count)
    winding, bearing = kind == WINDING, kind == BEARING
    lasts = np.ceil(np.log(o.failure_severity[1] / o.onset_severity[1]) / (growth[winding] * o.period_s))
    fails = onset[winding] + lasts - 1.0  # in this step
    costs[winding] = o.stop_cost_per_s * o.period_s * np.maximum(o.n_steps - fails, 0.0)
    before = np.arange(o.n_steps) < onset[bearing, None]
    costs[bearing] = bearing_costs(
        o, growth[bearing], np.where(before, np.nan, loads[bearing]), asked[bearing]
    )
    return -costs


def drive_bound(options: DriveOptions) -> float:
    """Its mean over episodes that the reference scores play, too."""
    return float(np.mean([drive_bounds(options, 200, seed).mean() for seed in range(1, 11)]))


def maintenance_bound(options: MaintainOptions) -> float:
    """A return that no policy exceeds in the mean: the fast informed bound (Hauskrecht 2000).

    It is the return of an agent that is told yesterday's level and the rate, but not what today brought.
    """
    tables = make_tables(options)
    chain, weights = transitions(tables), tables.weights
    worth = np.zeros((3, len(weights), LEVELS))

    def told(rate: int) -> FloatArray:
        """For each level before: of each estimate and next action the expected worth, (LEVELS, n_estimates, 3)."""
        after = tables.estimate[:, :, None] * worth[:, rate].T  # (n_estimates, LEVELS, 3)
        expected: FloatArray = np.einsum("xz,eza->xea", chain[rate], after, optimize=True)
        return expected

    for _ in range(options.days):
        new = float((weights @ worth[:, :, 0].T).max())
        ahead = np.array([told(rate) for rate in range(len(weights))])
        fails = tables.failing * (new - options.failure_cost)
        run = ahead.max(axis=3).sum(axis=2) + fails
        replaced = np.tensordot(weights, ahead[:, 0], axes=1).max(axis=1).sum() + float(weights @ fails[:, 0])
        inspect = worth.max(axis=0) - options.inspection_cost
        worth = np.stack([run, inspect, np.full_like(run, replaced - options.replacement_cost)])
    return float((weights @ worth[:, :, 0].T).max())
