"""What a watch goes on learning while all is well: how pieces scatter within windows, and windows from one to the next.

Differences are learned, no levels: a slow drift is none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.learning import PRIOR_WEIGHT
from motor_env.diagnosis.running.pieces import Pieces
from motor_env.diagnosis.running.scales import whitened
from motor_env.motor.healthy import Scale
from motor_env.motor.parameters import FloatArray


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
        self._last: list[Pieces | None] = []
        self._before: Pieces | None = None

    def scale(self, n: int) -> Scale:
        """What is known by now of the pieces of one length."""
        return self._scales[n]

    def hear(self, window: Sequence[Pieces | None], *, is_calm: bool) -> bool:
        """Pieces of a window by length; whether those of the window before it were learned.

        Args:
            window: nothing where it breaks off.
            is_calm: whether all is well in it.
        """
        learns = is_calm and bool(self._last)
        if learns:
            for n, pieces in enumerate(self._last):
                if pieces is not None:
                    self._add(n, pieces)
            self._before = self._last[-1]
        if not is_calm:
            self._before = None
        self._last = list(window) if is_calm else []
        return learns

    def _add(self, n: int, pieces: Pieces) -> None:
        scale, states = self._taught[n], pieces.states
        white = whitened(pieces.logs - scale.centres[states], pieces.errors)
        if scale.halvings:
            rest = (
                (white - white.mean(axis=0)) / np.sqrt(1.0 - 1.0 / len(white))
                if len(white) > 1
                else white[:0]
            )
        else:
            known = self._before
            rest = white[:0]
            if known is not None:
                rest = (white - whitened(known.logs - scale.centres[states], known.errors)) / np.sqrt(2.0)
        states = states[: len(rest)]
        np.add.at(self._counts[n], states, 1.0)
        np.add.at(self._sums[n], states, rest[:, :, None] * rest[:, None, :])
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
        return {"learned": self._counts, "scatter": self._sums}

    def remember(self, memory: dict[str, FloatArray]) -> None:
        """Go on from there."""
        self._counts = np.maximum(memory["learned"], 0.0).reshape(self._counts.shape)
        self._sums = memory["scatter"].reshape(self._sums.shape)
        for n in range(len(self._scales)):
            self._renew(n)
