"""How much any policy can get at most: what the best policy gets that is told more.

A genie tells the agent, at the moment of the onset, that a fault of one class of the recipe has just set in, or that
this is a healthy motor's moment: healthy episodes get one too, with a class drawn at will. Knowing more never hurts
(information relaxation: Brown, Smith & Sun 2010), so the best use of it bounds every policy that sees the current at
every sample. What is left is a test of two hypotheses with a known signature, whose state is the log-odds of the fault
and where the voltage has brought the motor: dynamic programming solves it (Wald & Wolfowitz 1948, with a horizon, a
price of delay and, for a probe, a price of looking). The value is convex in the probability, so that interpolating it
there errs upwards. In a block of samples the genie lets the agent decide before it pays.

The class that is named in healthy episodes is drawn with the probabilities that make the bound lowest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, softmax

from motor_env.envs.baselines.hypotheses import N_HYPOTHESIS, known_faults, sample_model, step_of
from motor_env.envs.options import MonitorOptions
from motor_env.envs.setup import Setup, make_setup
from motor_env.motor.compiled import njit
from motor_env.motor.faults import FaultKind
from motor_env.motor.model import State
from motor_env.motor.parameters import FloatArray, require

LOG_ODDS = np.linspace(-14.0, 14.0, 281)
PLACES = 11
BLOCK_S = 1e-3
SETTLING_S = 10e-3
REMAINING = 24
_PROBABILITY = expit(LOG_ODDS)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(25)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


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


@njit(cache=True, error_model="numpy")
def expected(value: FloatArray, information: float, out: FloatArray) -> None:
    """Expected value after a look: the log-odds move by N(+-information / 2, information), + with a fault."""
    spread, step, last = math.sqrt(information), LOG_ODDS[1] - LOG_ODDS[0], len(LOG_ODDS) - 1
    for m in range(last + 1):
        total = 0.0
        for q in range(len(_NODES)):
            for sign in (-1.0, 1.0):
                odds = LOG_ODDS[m] + sign * 0.5 * information + spread * _NODES[q]
                odds = min(max(odds, LOG_ODDS[0]), LOG_ODDS[last])
                low = min(int((odds - LOG_ODDS[0]) / step), last - 1)
                at = (1.0 / (1.0 + math.exp(-odds)) - _PROBABILITY[low]) / (
                    _PROBABILITY[low + 1] - _PROBABILITY[low]
                )
                weight = _PROBABILITY[m] if sign > 0.0 else 1.0 - _PROBABILITY[m]
                total += _WEIGHTS[q] * weight * (value[low] + at * (value[low + 1] - value[low]))
        out[m] = total


def _declared(options: MonitorOptions) -> FloatArray:
    return _PROBABILITY * options.correct_reward - (1.0 - _PROBABILITY) * options.false_alarm_cost


def _silent(options: MonitorOptions) -> FloatArray:
    return (1.0 - _PROBABILITY) * options.silent_reward - _PROBABILITY * options.miss_cost


def signature(setup: Setup, which: int, n_samples: int) -> FloatArray:
    """Squares of the mean whitened innovations of a class since its onset, without a probe, shape (n_samples,)."""
    sample, state = sample_model(setup, which), np.zeros(N_HYPOTHESIS + 2)
    state[-1] = 1.0
    answer = np.empty(n_samples)
    for k in range(n_samples):
        moved = sample @ state
        state[:N_HYPOTHESIS] = moved[:N_HYPOTHESIS]
        answer[k] = moved[N_HYPOTHESIS] ** 2
    return answer


def watched(setup: Setup, which: int, remaining: int, information: FloatArray) -> FloatArray:
    """Value at the onset of a class by the log-odds, if so many blocks remain and each shows its `information`."""
    options = setup.options
    per_block = round(BLOCK_S / options.dt_s)
    declared, value, seen = _declared(options), _silent(options), np.empty(len(LOG_ODDS))
    delay = options.delay_cost_per_s * options.dt_s * per_block * _PROBABILITY
    for k in range(remaining - 1, -1, -1):
        # the block is seen before it is paid: that is more than any policy has
        expected(np.maximum(declared, value - delay), information[k], seen)
        value = seen.copy()
    return value


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


@njit(cache=True, error_model="numpy")
def _between(values: FloatArray, place: FloatArray, reach: FloatArray, out: FloatArray) -> None:
    """Value by the log-odds at a place between those of the grid."""
    n = values.shape[0]
    at0 = min(max((place[0] / reach[0] + 1.0) * 0.5 * (n - 1), 0.0), float(n - 1))
    at1 = min(max((place[1] / reach[1] + 1.0) * 0.5 * (n - 1), 0.0), float(n - 1))
    low0, low1 = min(int(at0), n - 2), min(int(at1), n - 2)
    w0, w1 = at0 - low0, at1 - low1
    for m in range(values.shape[2]):
        first = (1.0 - w1) * values[low0, low1, m] + w1 * values[low0, low1 + 1, m]
        second = (1.0 - w1) * values[low0 + 1, low1, m] + w1 * values[low0 + 1, low1 + 1, m]
        out[m] = (1.0 - w0) * first + w0 * second


@njit(cache=True, error_model="numpy")
def _probed(
    look: Looks,
    offsets: FloatArray,
    prices: FloatArray,
    declared: FloatArray,
    silent: FloatArray,
    delay: FloatArray,
    n_steps: int,
) -> FloatArray:
    """Value with each number of steps left, at the best place, shape (n_steps + 1, log-odds)."""
    n, n_odds = PLACES, len(silent)
    answer, values, following = (
        np.empty((n_steps + 1, n_odds)),
        np.empty((n, n, n_odds)),
        np.empty((n, n, n_odds)),
    )
    values[:, :], answer[0] = silent, silent
    row, seen, point = np.empty(n_odds), np.empty(n_odds), np.empty(5)
    for k in range(1, n_steps + 1):
        following[:] = values
        best = np.full(n_odds, -np.inf)
        for a in range(n):
            for b in range(n):
                point[0] = look.reach[0] * (2.0 * a / (n - 1) - 1.0)
                point[1] = look.reach[1] * (2.0 * b / (n - 1) - 1.0)
                point[4] = 1.0
                values[a, b] = declared
                for m in range(len(offsets)):
                    point[3], information = offsets[m], 0.0
                    for last in offsets:  # it matters for a sample or two: take the best
                        point[2] = last
                        information = max(information, float(point @ look.information @ point))
                    point[2] = 0.0
                    _between(following, look.move @ point, look.reach, row)
                    expected(row, information, seen)
                    values[a, b] = np.maximum(values[a, b], seen - delay - prices[m])
                best = np.maximum(best, values[a, b])
        answer[k] = best
    return answer


class Named(NamedTuple):
    """Episodes in which the genie names one class: real faults of it, and healthy ones that only seem so.

    Attributes:
        chance: probability of a real fault of every class, shape (n_classes,).
        seeming: probability of a healthy episode in which it is named, shape (n_classes,).
    """

    chance: FloatArray
    seeming: FloatArray

    def at_onset(self, values: FloatArray) -> FloatArray:
        """Values by the log-odds, shape (n_classes, times, log-odds), at the odds of each class: (n_classes, times)."""
        odds = np.log(self.chance / self.seeming)
        found = [
            [np.interp(at, LOG_ODDS, row) for row in rows] for at, rows in zip(odds, values, strict=True)
        ]
        return np.array(found)


def upper_bound(options: MonitorOptions) -> float:
    """Upper bound on the mean return of any policy on a task.

    In a probing task a winding is not named at its onset but when the voltage is next moved: without that nothing is
    to be seen of it. (A resting motor shows something, d' below 0.3 in the whole horizon for 3 %, and so does one that
    was moved more than `SETTLING_S` ago; both are neglected.)

    Raises:
        ValueError: the posterior of the task is not known, see `ProbeBelief`.
    """
    setup = make_setup(options)
    faults = known_faults(setup)
    chance = options.task.class_probabilities[faults]
    late, weights, remaining = _remaining(options)
    probes = len(options.offsets_v) > 1
    hidden = np.array([probes and FaultKind(setup.labels[which]).verdict == "winding" for which in faults])
    steps = np.ceil(remaining / (options.dt_s * options.samples_per_step)).astype(int)
    tables = [
        _probed_table(setup, which) if probes else _watched_table(setup, which, remaining) for which in faults
    ]
    shown = np.array([table[steps] if probes else table for table in tables])
    veiled = np.array([table for table, veil in zip(tables, hidden, strict=True) if veil])

    def total(logits: FloatArray) -> float:
        named = Named(chance, (1.0 - chance.sum()) * np.maximum(softmax(logits), 1e-9))
        mass = named.chance + named.seeming
        open_mass = np.where(hidden, 0.0, mass)
        answer = open_mass @ named.at_onset(shown) @ weights + open_mass.sum() * late * options.silent_reward
        if hidden.any():
            answer += must_look(options, Named(chance[hidden], named.seeming[hidden]), veiled)
        return float(answer)

    starts = [np.where(np.arange(len(chance)) == m, 3.0, 0.0) for m in range(len(chance))]
    found = (minimize(total, x0=start, method="Nelder-Mead", options={"maxfev": 300}).fun for start in starts)
    return float(min(found))


def must_look(options: MonitorOptions, named: Named, values: FloatArray) -> float:
    """Bound on what the episodes contribute in which a class is named when the voltage is first moved after its onset.

    Dynamic programming over the time and the steps since the motor last stood revealed; an onset within `SETTLING_S`
    after a move is told at once.

    Args:
        options: of the task.
        named: the episodes.
        values: at the telling by steps left and log-odds, shape (n_classes, n_steps + 1, log-odds).
    """
    step_s = options.dt_s * options.samples_per_step
    mass = named.chance + named.seeming
    total, real = mass.sum(), named.chance.sum() / mass.sum()
    told = mass @ named.at_onset(values) / total
    covered = round(SETTLING_S / step_s)
    stays = math.exp(-step_s / options.mean_onset_s)
    n, first = options.n_steps, round(options.earliest_onset_s / step_s)
    unseen = np.maximum(np.arange(-covered, n + 2), 0)
    happened = 1.0 - stays**unseen
    # steps since an onset, summed with their probabilities: sum over j < unseen of (unseen - j) stays^j (1 - stays)
    aged = np.cumsum(np.concatenate([[0.0], (1.0 - stays ** np.arange(1, n + 2))]))[unseen]
    delay = real * options.delay_cost_per_s * step_s * aged
    look = options.probe_cost_per_v2_s * step_s * np.square([v for v in options.offsets_v if v != 0.0]).min()
    silent = happened * (real * -options.miss_cost + (1.0 - real) * options.silent_reward)
    value = silent + (1.0 - happened) * options.silent_reward - delay
    blind = (
        happened * real * options.correct_reward - (1.0 - happened * real) * options.false_alarm_cost - delay
    )
    for step in range(n - 1, first - 1, -1):
        now = told[n - step]
        later = np.append(value[1:], value[-1])
        seen = np.arange(-covered, n + 2) < 0
        rest = np.where(seen, (1.0 - stays) * now + stays * later, later)
        clear = (1.0 - stays) * now + stays * value[0] - look
        looks_now = happened * now - delay + (1.0 - happened) * clear
        value = np.maximum(np.maximum(rest, looks_now), blind)
    return float(total * value[0])


def _remaining(options: MonitorOptions) -> tuple[float, FloatArray, FloatArray]:
    """Probability of no onset before the horizon; weights of some times that may remain after it, and these in s."""
    span = options.horizon_s - options.earliest_onset_s
    late = math.exp(-span / options.mean_onset_s)
    edges = np.linspace(0.0, 1.0 - late, REMAINING + 1)
    since = -options.mean_onset_s * np.log1p(-edges)
    # the most that can remain in each part: with more time the genie's agent does not do worse
    return late, np.diff(edges), span - since[:-1]


def _watched_table(setup: Setup, which: int, remaining_s: FloatArray) -> FloatArray:
    """Value at the onset of a class without a probe, for every remaining time, shape (times, log-odds)."""
    per_block = round(BLOCK_S / setup.options.dt_s)
    blocks = np.ceil(remaining_s / BLOCK_S).astype(int)
    shown = signature(setup, which, int(blocks.max()) * per_block).reshape(-1, per_block).sum(axis=1)
    return np.array([watched(setup, which, count, shown) for count in blocks])


def _probed_table(setup: Setup, which: int) -> FloatArray:
    """Value at the telling of a class with a probe, by the steps left, shape (n_steps + 1, log-odds)."""
    options = setup.options
    offsets, step_s = np.array(options.offsets_v), options.dt_s * options.samples_per_step
    table: FloatArray = _probed(
        looks(setup, which),
        offsets,
        options.probe_cost_per_v2_s * offsets**2 * step_s,
        _declared(options),
        _silent(options),
        options.delay_cost_per_s * step_s * _PROBABILITY,
        options.n_steps,
    )
    return table
