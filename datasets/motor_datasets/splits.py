"""Which motor is for training, validation or test: whole motors, and the same one whatever else is generated."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.arrays import whole, wholes
from motor_env.simulation.random_streams import Stream, uniforms


class Split(StrEnum):
    """Training, validation or test."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


MOTORS_OF_BLOCK = {Split.TRAIN: 14, Split.VALIDATION: 3, Split.TEST: 3}
"""How many of twenty consecutive motors go where: 70, 15 and 15 %."""

BLOCK = sum(MOTORS_OF_BLOCK.values())

_BY_RANK = np.repeat([str(split) for split in MOTORS_OF_BLOCK], list(MOTORS_OF_BLOCK.values()))


def split_of(seed: int, motor_id: ArrayLike) -> NDArray[np.str_]:
    """Split of each motor, the shape of `motor_id`: depends on (seed, motor) alone.

    Every block of twenty consecutive motors is shuffled by its own stream and dealt out 14 : 3 : 3, so the shares
    are exact in every whole block.
    """
    whole("seed", seed, most=2**64 - 1)
    motors = wholes("motor_id", motor_id)
    blocks, which = np.unique(motors // BLOCK, return_inverse=True)
    order = np.argsort(uniforms(seed, Stream.SPLIT, blocks, BLOCK), axis=1, kind="stable")
    rank = np.argsort(order, axis=1, kind="stable")
    splits: NDArray[np.str_] = _BY_RANK[rank[which.reshape(motors.shape), motors % BLOCK]]
    return splits
