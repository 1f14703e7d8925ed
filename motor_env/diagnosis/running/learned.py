"""What a watch goes on learning while all is well: how pieces scatter within windows, and windows from one to the next.

Differences are learned, no levels: a slow drift is none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.healthy_spread import PRIOR_WEIGHT
from motor_env.diagnosis.running.pieces import Pieces
from motor_env.diagnosis.running.scales import whitened
from motor_env.motor.healthy import Scale
from motor_env.motor.parameters import FloatArray, require


class Learned:
    """Sums over healthy windows since the commissioning, for each length of pieces.

    Args:
        scales: what the commissioning has taught.
    """

    def __init__(self, scales: Sequence[Scale]) -> None:
        self._taught = tuple(scales)
        self._scales = list(scales)
        self._counts = np.zeros((len(scales), len(scales[0].counts)))
        self._sums = np.zeros((*self._counts.shape, 4, 4))
        self._before: Pieces | None = None  # the window before

    def scale(self, n: int) -> Scale:
        """What is known by now of the pieces of one length."""
        return self._scales[n]

    def hear(self, window: Sequence[Pieces | None]) -> None:
        """Pieces of a healthy window by length; the last is the window."""
        for n, pieces in enumerate(window):
            if pieces is not None:
                self._add(n, pieces)
        self._before = window[-1]

    def skip(self) -> None:
        """A window from which nothing is learned."""
        self._before = None

    def _add(self, n: int, pieces: Pieces) -> None:
        scale, states = self._taught[n], pieces.states
        white, before = whitened(pieces.logs - scale.centres[states], pieces.errors), self._before
        if scale.halvings:
            white = (white - white.mean(axis=0)) / np.sqrt(max(1.0 - 1.0 / len(white), 1e-9))
        elif before is not None:
            white = (white - whitened(before.logs - scale.centres[states], before.errors)) / np.sqrt(2.0)
        else:
            return
        np.add.at(self._counts[n], states, 1.0)
        np.add.at(self._sums[n], states, white[:, :, None] * white[:, None, :])
        self._renew(n)

    def _renew(self, n: int) -> None:
        scale = self._taught[n]
        weights: FloatArray = (scale.counts + PRIOR_WEIGHT)[:, None, None]
        more = self._counts[n][:, None, None]
        covariances = (weights * scale.covariances + self._sums[n]) / (weights + more)
        self._scales[n] = replace(scale, counts=scale.counts + self._counts[n], covariances=covariances)

    @property
    def memory(self) -> dict[str, FloatArray]:
        """What a later watch needs to go on."""
        before = np.zeros((1, 20))
        if self._before is not None:
            before[:, :4], before[:, 4:] = self._before.logs, self._before.errors.reshape(1, 16)
        return {"learned": self._counts, "scatter": self._sums, "before": before}

    def remember(self, memory: dict[str, FloatArray]) -> None:
        """Go on from there.

        Raises:
            ValueError: these are the numbers of no watch.
        """
        self._counts = np.maximum(memory["learned"], 0.0).reshape(self._counts.shape)
        self._sums = memory["scatter"].reshape(self._sums.shape)
        before = memory["before"].reshape(1, 20)
        if before.any():
            errors = before[:, 4:].reshape(1, 4, 4)
            require(bool((np.linalg.eigvalsh(errors) > 0.0).all()), "errors must be positive definite")
            self._before = Pieces(before[:, :4], errors, np.zeros(1, dtype=np.intp))
        for n in range(len(self._scales)):
            self._renew(n)
