"""Short pieces of windows: what each says of R, K, J and the drag, and in which state the motor was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.diagnosis.running.windows import WindowJudge
from motor_env.fitting import ekf as kernel
from motor_env.fitting.record import Record
from motor_env.fitting.window import Scores, scores
from motor_env.motor.healthy import Scale
from motor_env.motor.parameters import FloatArray

N_STATES = 10
"""Standing; then creeping, turning slowly, turning fast: each backwards, to and fro, forwards."""
STEP = 3  # halvings between two lengths of pieces
_LEVELS = (0.02, 0.15, 0.5)  # of the fastest, from which on a motor creeps, turns slowly, turns fast
_ONE_WAY = 0.5  # mean over effective speed
_MOST_HALVINGS = 7
_FEWEST_SAMPLES = 4
_SHORTEST_S = 0.2  # so that pieces take a tenth of a core at most
_WIDE = 0.5  # standard deviation of a logarithm
_MOST_STEPS, _SETTLED = 15, 0.1


class Pieces(NamedTuple):
    """Pieces of one window and one length.

    Attributes:
        logs: of R, K, J and B over the healthy ones, shape (n, 4).
        errors: their covariance as the fit believes it, shape (n, 4, 4).
        states: of N_STATES, shape (n,).
    """

    logs: FloatArray
    errors: FloatArray
    states: NDArray[np.intp]


class Motion(NamedTuple):
    """Sections of a record: number of samples, sums of the speed and of its square; shape (n,) each."""

    samples: FloatArray
    speed: FloatArray
    square: FloatArray

    def states(self, fastest_rad_s: float) -> NDArray[np.intp]:
        """State of each."""
        count = np.maximum(self.samples, 1.0)
        mean, effective = self.speed / count, np.sqrt(self.square / count)
        level = np.searchsorted(_LEVELS, effective / fastest_rad_s, side="right")
        way = np.where(np.abs(mean) > _ONE_WAY * effective, np.sign(mean), 0.0)
        return np.where(level == 0, 0, 3 * level - 1 + way).astype(np.intp)


class Sections(NamedTuple):
    """What sections of a window say: their scores, where the circuit is closed, and how the motor moved."""

    said: Scores
    motion: Motion
    closed: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[Sections]) -> Sections:
        """Sections in a row."""
        gradients, information = (np.concatenate([part.said[n] for part in parts]) for n in (0, 1))
        motion = Motion(*(np.concatenate([part.motion[n] for part in parts]) for n in range(3)))
        closed = np.concatenate([part.closed for part in parts])
        return cls(Scores(gradients, information, parts[0].said.precision), motion, closed)

    def pieces(self, together: int, at: FloatArray, fastest_rad_s: float) -> Pieces:
        """Pieces of so many sections each, those left out in which the circuit opens.

        Args:
            together: number of sections of a piece.
            at: where the motor was thought to be, shape (4,).
            fastest_rad_s: of its work.
        """
        count = len(self.closed) // together

        def added(values: FloatArray) -> FloatArray:
            some = values[: count * together] * self.closed[: count * together].reshape(
                -1, *[1] * (values.ndim - 1)
            )
            out: FloatArray = some.reshape(count, together, *values.shape[1:]).sum(axis=1)
            return out

        steps, errors = Scores(added(self.said[0]), added(self.said[1]), self.said.precision).steps()
        motion = Motion(*map(added, self.motion))
        told = motion.samples > 0.0
        return Pieces((at + steps)[told], errors[told], motion.states(fastest_rad_s)[told])


def halvings_of(window_s: float, samples: int) -> tuple[int, ...]:
    """How often a window is halved for each length of pieces, the shortest first; 0, the window, is the last."""
    most = min(2.0**_MOST_HALVINGS, samples / _FEWEST_SAMPLES, window_s / _SHORTEST_S)
    shortest = int(math.log2(max(most, 1.0)))
    return (*range(shortest, STEP // 2, -STEP), 0)


def sections_of(judge: WindowJudge, record: Record, at: FloatArray, ends: Sequence[int]) -> Sections:
    """Sections of a record of a window or of its last part.

    Args:
        judge: the healthy motor.
        record: with some samples before the first section, from which the filter finds the state.
        at: where the motor is thought to be by now, shape (4,): the nearer, the better a linear step.
        ends: first sample of the first section, and where each ends.
    """
    said = scores(record, judge.physical(at), judge.windows.terms, judge.peaks, ends)
    speed = np.nan_to_num(record.readings[:, 1])
    columns = np.stack([np.ones(len(speed)), speed, speed**2, record.marks == kernel.OPEN])
    samples, sums, squares, opened = np.add.reduceat(columns[:, : ends[-1]], ends[:-1], axis=1)
    return Sections(said, Motion(samples, sums, squares), opened == 0)


def end_of(
    record: Record, span_s: float, judge: WindowJudge, at: FloatArray, scale: Scale
) -> tuple[FloatArray, FloatArray] | None:
    """What the end of a record says, however far the motor has moved; None where its circuit is open.

    Args:
        record: with some samples before that end, from which the filter finds the state.
        span_s: length of the end.
        judge: the healthy motor.
        at: where the motor was thought to be, shape (4,).
        scale: what healthy pieces of about that length have taught.

    Returns:
        Logarithms of R, K, J and B over the healthy ones, shape (4,), and how they scatter, shape (4, 4).
    """
    count, prior = len(record.voltage_v), _WIDE**2 * np.eye(len(at))
    ends = [max(count - max(round(span_s / record.dt_s), 2), 1), count]
    usual = np.average(scale.covariances, axis=0, weights=scale.counts)
    for _ in range(_MOST_STEPS):
        pieces = sections_of(judge, record, at, ends).pieces(1, at, judge.peaks[2])
        if not len(pieces.logs):
            return None
        root = np.linalg.cholesky(pieces.errors[0])
        logs, spread = pieces.logs[0], root @ usual @ root.T + scale.wander
        # On the way a fault of one quantity looks like changes of several.
        before, at = at, prior @ np.linalg.solve(prior + spread, logs)
        if (at - before) @ np.linalg.solve(spread, at - before) < _SETTLED:
            break
    return logs, spread
