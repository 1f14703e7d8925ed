"""Evidence against healthy pieces, added up over time: an e-detector (Shin, Ramdas & Rinaldo 2023).

Each piece gives normal scores: standard normal, or less, while the motor is healthy. exp(lean u - lean^2 / 2) then
has a mean of 1 at most: it is an e-value. Its Shiryaev-Roberts sum M <- (M + 1) e grows by at most 1 a piece on
average, so that a mixture of such sums passes a threshold A no earlier than after A pieces on average, whatever
direction depends on what. Pieces of several lengths count for as many of the shortest ones as they are long.
"""

from __future__ import annotations

import numpy as np

from motor_env.motor.parameters import FloatArray

LEANS = np.array([0.6, 1.2, 2.4])
"""Sizes of a fault that are looked for, in standard deviations of a piece."""
_LARGEST = 10.0
_OVERSHOOT, _ENOUGH = 0.5, 1e100


class Detector:
    """Shiryaev-Roberts sums of each length of pieces, direction and lean; all of them 0 at first.

    Args:
        lengths: number of them.
        weights: of each direction in the mixture, shape (n_directions,).

    Attributes:
        sums: shape (n_lengths, n_directions, n_leans).
        ages: of each sum, its terms times how long ago they began; shape of `sums`.
        weights: as given, over their sum.
    """

    def __init__(self, lengths: int, weights: FloatArray) -> None:
        shape = (lengths, len(weights), len(LEANS))
        self.sums: FloatArray = np.zeros(shape)
        self.ages: FloatArray = np.zeros(shape)
        self.weights: FloatArray = weights / weights.sum()

    def add(self, length: int, scores: FloatArray, pieces: int, reach: FloatArray | float = 1.0) -> None:
        """A piece that is as long as so many of the shortest ones.

        Args:
            length: which of the lengths it has.
            scores: normal scores in each direction, shape (n_directions,).
            pieces: number of the shortest ones.
            reach: how much more it tells than usual ones; the sizes that are looked for go with it.
        """
        u, leans = np.minimum(scores, _LARGEST)[:, None], LEANS * np.reshape(reach, (-1, 1))
        e_values = np.exp(leans * u - 0.5 * leans**2)
        begun = self.sums[length] + pieces
        # Evidence that waits for a window's end goes on growing: there is more than enough of it.
        e_values /= np.maximum(begun * e_values / _ENOUGH, 1.0)
        self.ages[length] = (self.ages[length] + pieces * begun) * e_values
        self.sums[length] = begun * e_values

    @property
    def evidence(self) -> float:
        """The mixture: its mean is at most the number of pieces so far."""
        return float(self.weights @ self.sums.mean(axis=(0, 2)))

    def passes(self, pieces: float) -> bool:
        """Whether there is an alarm, at one false alarm in so many pieces.

        At an alarm the sums are beyond the threshold. Half of it is enough for normal scores (by simulation 2.1 to 2.6
        times as many pieces pass as the threshold says); for any others false alarms are twice as many at most.
        """
        return self.evidence >= _OVERSHOOT * pieces

    @property
    def strongest(self) -> tuple[int, int, float]:
        """Length, direction and age of the largest sum: what the evidence is about, and since how many pieces."""
        weighted = self.sums * self.weights[:, None]
        length, direction, lean = np.unravel_index(int(np.argmax(weighted)), self.sums.shape)
        largest = float(self.sums[length, direction, lean])
        return int(length), int(direction), float(self.ages[length, direction, lean]) / max(largest, 1e-300)

    @property
    def shares(self) -> FloatArray:
        """How much of the evidence each direction holds, shape (n_directions,)."""
        weighted = self.weights * self.sums.sum(axis=(0, 2))
        share: FloatArray = weighted / max(float(weighted.sum()), 1e-300)
        return share

    def forget(self) -> None:
        """Begin anew, as after an alarm."""
        self.sums[:], self.ages[:] = 0.0, 0.0

    @property
    def memory(self) -> dict[str, FloatArray]:
        """What a later watch needs to go on."""
        return {"sums": self.sums, "ages": self.ages}

    def remember(self, memory: dict[str, FloatArray]) -> None:
        """Go on from there."""
        self.sums, self.ages = (memory[name].reshape(self.sums.shape) for name in ("sums", "ages"))
