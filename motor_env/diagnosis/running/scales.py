"""Scores of pieces, calibrated on healthy pieces of the same length and state.

A piece's distance along a direction is compared with what healthy pieces of its length and state scatter within their
windows (Student's t, whose tail is fitted by moments). How far a healthy motor may stay off, for hours, is no scatter:
it is allowed for as a shift. So no drift is ever learned as noise, and noise averages away over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from motor_env.diagnosis.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.hypotheses import EXPONENTS, NAMES
from motor_env.diagnosis.running.pieces import N_STATES, Pieces
from motor_env.diagnosis.running.windows import WARMTH
from motor_env.diagnosis.verdict import Judgement, Verdict
from motor_env.fitting.uncertainty import beyond
from motor_env.motor import identifiable as quantities
from motor_env.motor.faults import FaultKind
from motor_env.motor.healthy import Scale
from motor_env.motor.parameters import FloatArray

AXES = np.concatenate([np.eye(len(NAMES)), -np.eye(len(NAMES))])
_P = len(NAMES)
_STAYS = (
    0.005,
    0.1,
)  # probability of a healthy motor that stays farther off than is allowed for: least, most
_LEAST_EXCESS = 1e-3  # of the kurtosis
_NAMED_WEIGHT = 4.0
_REACHES = (0.1, 3.0)
_NORMAL_TAILS = 30.0  # degrees of freedom
_MOSTLY = 0.9  # of the evidence
_NOTHING = 1e-6


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

    def named(self, judged: Judgement, place: int, share: float) -> Judgement:
        """A judgement that names no fault, named by the direction with this share of the evidence.

        Not where it has little of it, or something else has moved as well.
        """
        kind = self.kinds[place]
        if judged.verdict is not Verdict.OTHER or kind is None or share <= _MOSTLY:
            return judged
        moves = {name for name, part in zip(NAMES, self.along[place], strict=True) if abs(part) > _NOTHING}
        if not moves >= {one.name for one in judged.changes if one.significant}:
            return judged
        return replace(judged, verdict=Verdict(kind.verdict), fault_kind=kind, kind_probability=share)


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
    halvings: int, windows: Sequence[Pieces], prior_sd: FloatArray, *, temperature_k: float
) -> Scale:
    """What healthy pieces of one length teach; of whole windows each has one piece.

    Args:
        halvings: how often a window is halved for them.
        windows: pieces of each window.
        prior_sd: of each logarithm: how far a healthy motor may stay off for no known reason, shape (4,); 0 where
            nothing but a fault moves it.
        temperature_k: how much warmer or colder it may be, one standard deviation.
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
    levels = np.zeros((len(windows), _P))
    for _ in range(2 if halvings else 1):
        white = whitened(off - levels[place], errors)
        white -= 0.0 if halvings else white.mean(axis=0)
        freedom = len(white) - (len(windows) if halvings else 1)
        covariances, tails = _scatter(white, states, freedom)
        inverse = np.linalg.inv(spread_of(covariances[states], errors))
        believed = np.linalg.inv([inverse[place == n].sum(axis=0) for n in range(len(windows))])
        pulls = np.einsum("nij,nj->ni", inverse, off)
        levels = np.array([one @ pulls[place == n].sum(axis=0) for n, one in enumerate(believed)])
    scatter = np.cov(levels.T)
    wander = (
        np.diag(np.square(prior_sd)) + temperature_k**2 * np.outer(WARMTH, WARMTH) + scatter / len(windows)
    )
    if halvings and prior_sd.any():
        wander += beyond(believed.mean(axis=0), scatter)
    information: FloatArray = np.asarray(inverse.mean(axis=0), dtype=np.float64)
    return Scale(halvings, counts, centres, covariances, tails, information, wander, len(windows))


def untaught_scale(log_covariance: FloatArray, freedom: float, windows: int) -> Scale:
    """Whole windows of a motor whose windows were not compared: all that is believed of them may stay."""
    shape = (N_STATES, _P)
    eye = np.tile(np.eye(_P), (N_STATES, 1, 1))
    counts = np.full(N_STATES, max(freedom, 2.0))
    information: FloatArray = np.asarray(np.linalg.inv(log_covariance), dtype=np.float64)
    return Scale(0, counts, np.zeros(shape), eye, freedom, information, log_covariance, max(windows, 2))


def whitened(off: FloatArray, errors: FloatArray) -> FloatArray:
    """Differences over the roots of their covariances, shape (n, p)."""
    return np.linalg.solve(np.linalg.cholesky(errors), off[..., None])[..., 0]


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


def spread_of(covariances: FloatArray, errors: FloatArray) -> FloatArray:
    """Covariance of pieces about their centre, by that of what is whitened by their errors, shape (n, 4, 4)."""
    roots = np.linalg.cholesky(errors)
    return roots @ covariances @ np.swapaxes(roots, 1, 2)


class Places(NamedTuple):
    """How far pieces are off along directions, in standard deviations of their scatter, shape (n, n_directions) each.

    Attributes:
        distances: of each piece.
        allowed: standard deviation of what a healthy motor may stay off.
        reach: of a unit of the fault.
    """

    distances: FloatArray
    allowed: FloatArray
    reach: FloatArray


def places_along(off: FloatArray, spread: FloatArray, wander: FloatArray, along: FloatArray) -> Places:
    """The combination of R, K, J and B that tells a fault best from scatter and from what may stay, as warmth does."""
    slopes = np.linalg.solve(spread + wander, np.broadcast_to(along.T, (len(off), *along.T.shape)))
    slopes /= np.sqrt(np.einsum("npd,npq,nqd->nd", slopes, spread, slopes))[:, None, :]
    allowed = np.sqrt(np.einsum("npd,pq,nqd->nd", slopes, wander, slopes))
    return Places(np.einsum("npd,np->nd", slopes, off), allowed, np.einsum("npd,dp->nd", slopes, along))


def calibrated(scale: Scale, pieces: Pieces, along: FloatArray) -> Places:
    """Where pieces are, by what healthy ones of their length and state scatter."""
    spread = spread_of(scale.covariances[pieces.states], pieces.errors)
    return places_along(pieces.logs - scale.centres[pieces.states], spread, scale.wander, along)


def places_on_axes(scale: Scale, pieces: Pieces) -> Places:
    """Where a window is along the axes by its own error: what is counted needs no healthy window's scatter."""
    return places_along(pieces.logs, pieces.errors, scale.wander, AXES)


def normal_scores(scale: Scale, states: NDArray[np.intp], found: Places, windows: float) -> FloatArray:
    """Normal scores of pieces along directions, shape (n, n_directions): standard normal or less while all is well.

    Where healthy pieces have heavier tails than normal ones, no piece says more than the rarest of them: one in as many
    as were seen. With few pieces to learn from, a distance with a sample's inverse covariance is that of a t with fewer
    degrees and a larger scale (Hotelling).

    Args:
        scale: of pieces of this length.
        states: of the pieces, shape (n,).
        found: where they are.
        windows: from one false alarm to the next: the more, the farther a healthy motor may stay off.
    """
    taught = scale.counts[states] + PRIOR_WEIGHT - 1.0
    freedom = np.maximum(np.minimum(taught - _P + 1.0, scale.freedom), 1.0)[:, None]
    size = np.sqrt(taught / np.maximum(taught - _P + 1.0, 1.0))[:, None]
    tails = stdtr(freedom, -(found.distances - farthest(scale, windows) * found.allowed) / size)
    if scale.halvings and scale.freedom < _NORMAL_TAILS:
        tails = np.maximum(tails, 1.0 / (scale.counts.sum() + 1.0))
    scores: FloatArray = -ndtri(tails)
    return np.where(np.isnan(scores), 0.0, scores)


def reaches(scale: Scale, found: Places, along: FloatArray) -> FloatArray:
    """How much more a piece tells of each fault than usual ones of its length do, shape (n, n_directions)."""
    usual = np.sqrt(np.einsum("dp,pq,dq->d", along, scale.information, along))
    times: FloatArray = np.clip(found.reach / usual, *_REACHES)
    return times


def farthest(scale: Scale, windows: float) -> float:
    """Standard deviations up to which a healthy motor may stay off, at one false alarm in so many windows."""
    return -float(stdtrit(scale.healthy_windows - 1, min(max(1.0 / windows, _STAYS[0]), _STAYS[1])))
