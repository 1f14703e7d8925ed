"""How much any policy can get at most: what the best policy gets that is told more.

A genie tells the agent of a monitor, at the moment of the onset, that a fault of one class of the recipe has just set
in, or that this is a healthy motor's moment: healthy episodes get one too, with a class drawn at will. Knowing more
never hurts (information relaxation: Brown, Smith & Sun 2010), so the best use of it bounds every policy that sees the
current at every sample. What is left is a test of two hypotheses with a known signature, whose state is the log-odds of
the fault: dynamic programming solves it (Wald & Wolfowitz 1948, with a horizon and a price of delay). In a block of
samples the genie lets the agent decide before it pays. On a probing task it tells less: the class alone, and that at
the beginning of the episode (`pairs`).

The class that is named in healthy episodes is drawn with the probabilities that make the bound lowest. Of tolerances
and noise faults the genie tells everything; the nominal motor stands for all that are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from looks import LOG_ODDS, PROBABILITY, look_matrix
from pairs import Pair, declared_worth, silent_worth
from scipy.optimize import minimize
from scipy.special import softmax

from motor_env.envs.options import MonitorOptions
from motor_env.envs.policies.fault_posterior import N_HYPOTHESIS, known_faults, sample_model
from motor_env.envs.setup import Setup, make_setup
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Spread

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
    options, faults = setup.options, known_faults(setup)
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


def _values_at_onset(setup: Setup, which: int, blocks: FloatArray) -> FloatArray:
    """Value at the onset of a class by the log-odds, for every number of blocks that remain: (times, log-odds)."""
    options = setup.options
    per_block = round(BLOCK_S / options.dt_s)
    information = signature(setup, which, int(blocks.max()) * per_block).reshape(-1, per_block).sum(axis=1)
    declared, silent = declared_worth(options), silent_worth(options)
    delay = options.delay_cost_per_s * options.dt_s * per_block * PROBABILITY
    value = np.tile(silent[:, None], len(blocks))
    for k in reversed(range(int(blocks.max()))):
        # the block is seen before it is paid: that is more than any policy has
        seen = look_matrix(information[k]) @ np.maximum(declared[:, None], value - delay[:, None])
        value = np.where(k < blocks, seen, value)
    return value.T
