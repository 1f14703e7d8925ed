"""Scores of pieces, calibrated on healthy pieces of the same length and state.

A piece's distance along a direction is compared with what healthy pieces of its length and state scatter within their
windows (Student's t, whose tail is fitted by moments). How far a healthy motor may stay off, for hours, is no scatter:
it is allowed for as a shift. So no drift is ever learned as noise, and noise averages away over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from motor_env.diagnosis.learning import PRIOR_WEIGHT
from motor_env.diagnosis.running.pieces import N_STATES, Pieces
from motor_env.diagnosis.running.windows import EXPONENTS, NAMES, WARMTH
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind
from motor_env.motor.healthy import Scale
from motor_env.motor.parameters import FloatArray

AXES = np.concatenate([np.eye(len(NAMES)), -np.eye(len(NAMES))])
_P = len(NAMES)
_STAYS = 0.005  # probability of a healthy motor that stays farther off than is allowed for
_LEAST_EXCESS = 1e-3  # of the kurtosis
_NAMED_WEIGHT = 4.0
_NORMAL_TAILS = 30.0  # degrees of freedom


class Directions(NamedTuple):
    """Along which faults move the logarithms of R, K, J and B.

    Attributes:
        along: unit vectors: those of faults with a name, and up and down each quantity; shape (n, 4).
        weights: by how much each is believed before anything is seen, shape (n,).
        kinds: the fault of each; None for those without a name.
    """

    along: FloatArray
    weights: FloatArray
    kinds: tuple[FaultKind | None, ...]


def directions() -> Directions:
    """All of them."""
    named = quantities.nameable_kinds(EXPONENTS)
    rows = [*(quantities.visible_direction(kind, EXPONENTS) for kind in named), *AXES]
    unit = [row / np.linalg.norm(row) for row in rows]
    chosen = [n for n, row in enumerate(unit) if not any(np.allclose(row, one) for one in unit[:n])]
    kinds = tuple(named[n] if n < len(named) else None for n in chosen)
    weights = np.array([1.0 if kind is None else _NAMED_WEIGHT for kind in kinds])
    return Directions(np.array(unit)[chosen], weights, kinds)


def learn_scale(
    halvings: int, windows: Sequence[Pieces], prior_sd: float, *, temperature_k: float, steady: bool
) -> Scale:
    """What healthy pieces of one length teach; of whole windows each has one piece.

    Args:
        halvings: how often a window is halved for them.
        windows: pieces of each window.
        prior_sd: of each logarithm: how far a healthy motor may stay off for no known reason.
        temperature_k: how much warmer or colder it may be, one standard deviation.
        steady: nothing but a fault moves the motor.
    """
    logs, errors, states = (np.concatenate([each[n] for each in windows]) for n in range(3))
    place = np.repeat(np.arange(len(windows)), [len(each.logs) for each in windows])
    precision = np.linalg.inv(errors)
    centres, counts = np.zeros((N_STATES, _P)), np.bincount(states, minlength=N_STATES).astype(np.float64)
    for state in np.flatnonzero(counts).tolist():
        some = precision[states == state]
        sums = np.einsum("nij,nj->i", some, logs[states == state])
        centres[state] = np.linalg.solve(some.sum(axis=0) + some.mean(axis=0), sums)
    off = logs - centres[states]
    white = whitened(off, errors)
    means = np.array([white[place == n].mean(axis=0) for n in range(len(windows))])
    rest = white - (means[place] if halvings else white.mean(axis=0))
    covariances, freedom = _scatter(rest, states, len(rest) - (len(windows) if halvings else 1))
    prior = prior_sd**2 * np.eye(_P) + temperature_k**2 * np.outer(WARMTH, WARMTH)
    roots = np.linalg.cholesky(errors)
    inverse = np.linalg.inv(roots @ covariances[states] @ np.swapaxes(roots, 1, 2))
    levels, believed = [], []
    for n in range(len(windows)):
        error = np.linalg.inv(inverse[place == n].sum(axis=0))
        levels.append(error @ np.einsum("nij,nj->i", inverse[place == n], off[place == n]))
        believed.append(error)
    scatter = np.cov(np.array(levels).T)
    wander = prior + scatter / len(windows)
    if halvings:
        wander += _more(scatter, np.mean(believed, axis=0), len(windows), steady=steady)
    return Scale(halvings, counts, centres, covariances, freedom, wander, len(windows))


def untaught_scale(log_covariance: FloatArray, freedom: float, windows: int) -> Scale:
    """Whole windows of a motor whose windows were not compared: all that is believed of them may stay."""
    shape = (N_STATES, _P)
    eye = np.tile(np.eye(_P), (N_STATES, 1, 1))
    counts = np.full(N_STATES, max(freedom, 2.0))
    return Scale(0, counts, np.zeros(shape), eye, freedom, log_covariance, max(windows, 2))


def whitened(off: FloatArray, errors: FloatArray) -> FloatArray:
    """Differences over the roots of their covariances, shape (n, p)."""
    white: FloatArray = np.linalg.solve(np.linalg.cholesky(errors), off[..., None])[..., 0]
    return white


def _scatter(rest: FloatArray, states: NDArray[np.intp], freedom: int) -> tuple[FloatArray, float]:
    """Covariance by state, few pieces being like all others, and degrees of freedom of the tails by moments.

    Of Student's t with f degrees the kurtosis is 3 + 6 / (f - 4). It is taken one standard error larger than it is.
    """
    pooled = rest.T @ rest
    whole = max(float(np.trace(pooled)) / _P / max(freedom, 1), 1e-12)
    pooled = (pooled + PRIOR_WEIGHT * whole * np.eye(_P)) / (max(freedom, 1) + PRIOR_WEIGHT)
    used, covariances = freedom / max(len(rest), 1), []
    for state in range(N_STATES):
        some = rest[states == state]
        covariances.append((some.T @ some + PRIOR_WEIGHT * pooled) / (used * len(some) + PRIOR_WEIGHT))
    out = np.array(covariances)
    unit = whitened(rest, out[states])
    kurtosis = float(np.mean(unit**4) / np.mean(unit**2) ** 2) + math.sqrt(24.0 / unit.size)
    return out, 4.0 + 6.0 / max(kurtosis - 3.0, _LEAST_EXCESS)


def _more(scatter: FloatArray, believed: FloatArray, windows: int, *, steady: bool) -> FloatArray:
    """By how much windows differ more than their pieces say; of a steady motor only where chance does not explain it.

    The largest eigenvalue of so many windows' covariance is about (1 + sqrt(p / n))^2 by chance (Marchenko & Pastur).
    """
    root = np.linalg.cholesky(believed)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ scatter @ inverse.T)
    chance = (1.0 + math.sqrt(_P / windows)) ** 2 if steady else 1.0
    more = root @ axes * np.sqrt(np.where(sizes > chance, sizes - 1.0, 0.0))
    out: FloatArray = more @ more.T
    return out


def spread_of(scale: Scale, errors: FloatArray, states: NDArray[np.intp]) -> FloatArray:
    """Calibrated covariance of pieces about their centre, shape (n, 4, 4)."""
    roots = np.linalg.cholesky(errors)
    spread: FloatArray = roots @ scale.covariances[states] @ np.swapaxes(roots, 1, 2)
    return spread


def normal_scores(scale: Scale, pieces: Pieces, along: FloatArray, temperature_k: float) -> FloatArray:
    """Normal scores of pieces along directions, shape (n, n_directions): standard normal or less while all is well.

    Where healthy pieces have heavier tails than normal ones, no piece says more than the rarest of them: one in as many
    as were seen. With few pieces to learn from, a distance with a sample's inverse covariance is that of a t with fewer degrees and a
    larger scale (Hotelling).
    """
    spread = spread_of(scale, pieces.errors, pieces.states)
    off = pieces.logs - scale.centres[pieces.states]
    distances, allowed = places_along(off, spread, scale.wander, along, temperature_k)
    taught = scale.counts[pieces.states] + PRIOR_WEIGHT - 1.0
    freedom = np.maximum(np.minimum(taught - _P + 1.0, scale.freedom), 1.0)[:, None]
    size = np.sqrt(taught / np.maximum(taught - _P + 1.0, 1.0))[:, None]
    shift = -float(stdtrit(scale.healthy_windows - 1, _STAYS)) * allowed
    tails = stdtr(freedom, -(distances - shift) / size)
    if scale.halvings and scale.freedom < _NORMAL_TAILS:
        tails = np.maximum(tails, 1.0 / (scale.counts.sum() + 1.0))
    scores: FloatArray = -ndtri(tails)
    return np.where(np.isnan(scores), 0.0, scores)


def places_along(
    off: FloatArray, spread: FloatArray, wander: FloatArray, along: FloatArray, temperature_k: float
) -> tuple[FloatArray, FloatArray]:
    """How far pieces are off along directions, in standard deviations, and that of what may stay; shape (n, n_dir).

    A warmer motor is told from a fault by how R, K and friction move together: what looks like warmth counts little.
    """
    warm = temperature_k * WARMTH
    slopes = np.linalg.solve(
        spread + np.outer(warm, warm), np.broadcast_to(along.T, (len(off), *along.T.shape))
    )
    lengths = np.sqrt(np.einsum("dp,npd->nd", along, slopes))
    slopes = slopes / lengths[:, None, :]
    distances = np.einsum("npd,np->nd", slopes, off)
    allowed = np.sqrt(np.einsum("npd,pq,nqd->nd", slopes, wander, slopes))
    return distances, allowed


def places_on_axes(scale: Scale, pieces: Pieces, temperature_k: float) -> FloatArray:
    """Where a window is along the axes, by its own error alone: what is counted needs no healthy window's spread."""
    places, _ = places_along(pieces.logs, pieces.errors, scale.wander, AXES, temperature_k)
    first: FloatArray = places[0]
    return first
