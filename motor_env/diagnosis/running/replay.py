"""Whether calibrated tails hold: healthy windows once more, each judged by what the others teach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gammainc

from motor_env.diagnosis.running.detector import Detector
from motor_env.diagnosis.running.pieces import Pieces
from motor_env.diagnosis.running.scales import calibrated, directions, normal_scores, reaches
from motor_env.motor.healthy import Scale

THRESHOLDS = 4.0 ** np.arange(1, 13)
"""Pieces from one false alarm to the next at which healthy windows are replayed."""
_UNLIKELY = 0.01


def tails_hold(replayed: Sequence[int], pieces: int) -> bool:
    """Whether healthy windows, each judged by what the others teach, alarm no oftener than they should (Poisson)."""
    return bool(replayed) and all(
        gammainc(alarms, pieces / asked) >= _UNLIKELY  # of so many or more, by Poisson
        for alarms, asked in zip(replayed, THRESHOLDS.tolist(), strict=False)
    )


def replay(scales: Sequence[Sequence[Scale]], windows: Sequence[Sequence[Pieces]]) -> list[int]:
    """Alarms at each of THRESHOLDS while windows pass, each judged by its own scales.

    Args:
        scales: for each window, by length.
        windows: pieces of each window, by length, the shortest first.
    """
    along, total, due = directions(), 2 ** scales[0][0].halvings, []
    for mine, window in zip(scales, windows, strict=True):
        for n, (scale, pieces) in enumerate(zip(mine, window, strict=True)):
            due.append((n, scale, pieces.states, calibrated(scale, pieces, along.along)))
    counts = []
    for threshold in THRESHOLDS:
        steps = []
        for number, (n, scale, states, found) in enumerate(due):
            together, begin = total >> scale.halvings, number // len(scales[0]) * total
            scores = normal_scores(scale, states, found, threshold / total)
            for k, pair in enumerate(zip(scores, reaches(scale, found, along.along), strict=True)):
                steps.append((begin + (k + 1) * together, n, *pair, together))
        detector, count = Detector(len(scales[0]), along.weights), 0
        for _, n, row, reach, together in sorted(steps, key=lambda one: one[:2]):
            detector.add(n, row, together, reach)
            if detector.passes(threshold):
                count += 1
                detector.forget()
        counts.append(count)
    return counts
