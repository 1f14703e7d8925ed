"""What the compiled step of the drive reads and writes, by name: the task, and the lanes in blocks.

A block is a record whose fields are rows of `LANES` numbers: all lanes of a block stand side by side at distances that
the compiler knows, so that it computes several lanes with one instruction, and a block fits into the first-level cache.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs.layout import BoolArray, WordArray, aligned_zeros, empty_streams
from motor_env.motor.exponentials import ROOM
from motor_env.motor.parameters import FloatArray

LANES = 64
PARTS = ("tracking", "heat", "wear", "limp", "stop", "failure")
"""What a reward is made of."""
TRUTH = ("current", "speed", "load", "temperature", "severity", "kind", "onset", "growth")
_BELIEF = ("estimated_current", "estimated_speed", "step", "integral")
_MOTOR = ("a00", "a01", "a10", "a11", "b0", "b1", "e0", "e1")
_MEASURED = ("measured_current", "measured_speed", "estimated_load", "innovation_current", "innovation_speed")
_SEEN = (*_MEASURED, "slow_current", "slow_speed", "voltage", "estimated_temperature", "scale", "time")
_WORK = ("share", "aim", "asked", "torque", "worn")
Block = Any
"""A record of `block_type`, or of `WORK`."""


class Task(NamedTuple):
    """Constants of the task, named as in `MotorParameters` and `DriveOptions`; a cost is that of a step."""

    resistance_ohm: float
    inductance_h: float
    back_emf_constant_v_s_per_rad: float
    torque_constant_n_m_per_a: float
    inertia_kg_m2: float  # with that of what it drives
    viscous_friction_n_m_s_per_rad: float
    period_s: float
    voltage_limit_v: float
    current_limit_a: float
    load_torque_n_m: float
    fan_n_m_s2: float
    load_memory: float  # share of the unknown load that is left after a step
    load_stir_n_m: float  # standard deviation of what comes on top
    lowest_speed_rad_s: float
    top_speed_rad_s: float
    shortest_plateau_s: float
    longest_plateau_s: float
    shortest_ramp_s: float
    longest_ramp_s: float
    healthy_share: float  # probability that no fault sets in
    no_winding_share: float  # that none does, or one of the bearing
    earliest_onset: float  # in steps
    log_stay: float  # logarithm of the probability that the onset is a step later
    slowest_growth_per_s: float
    log_growth_range: float
    stress_share: float
    full_power_w: float  # of the load at top speed
    bearing_onset: float  # severity
    winding_onset: float
    bearing_failure: float  # severity
    winding_failure: float
    heating_k_per_a2: float
    cooling: float  # share of a rise of temperature that happens in a step
    warm_k: float
    burn_k: float
    limp_share: float
    limp_step: float  # by how much the scale of the profile moves in a step
    current_noise_a: float
    speed_noise_rad_s: float
    horizon: float  # in steps
    tracking_cost: float  # of the squared error in units of the top speed
    heat_cost: float  # of a kelvin
    wear_cost: float  # of a unit of a bearing's severity
    failure_cost: float  # once
    stop_cost_per_s: float
    limp_cost: float  # of all of the profile's scale
    a00: float  # the discrete motor without a fault: x' = A x + b voltage + e load torque
    a01: float
    a10: float
    a11: float
    b0: float
    b1: float
    e0: float
    e1: float
    k00: float  # gain of its filter on current, speed and unknown load
    k01: float
    k10: float
    k11: float
    k20: float
    k21: float
    w00: float  # what whitens the innovation, a lower triangle
    w10: float
    w11: float
    slow_memory: float  # share of the slow means that is left after a step
    tracking_limit: float
    holds_speed: float  # 1: the drive's own controller sets the voltage
    by_current: float  # its gains
    by_speed: float
    by_integral: float
    periods: float  # of a decision


N_CONSTANTS = len(Task._fields)


class Lanes(NamedTuple):
    """Everything that changes, and where the profile is observed.

    Attributes:
        ahead: steps ahead at which the profile is observed.
        state: blocks, see `block_type`.
        work: one record of `WORK`, room for a step of a block.
        words: of what the random numbers depend on, shape (4, n_lanes).
        flags: shape (4, n_lanes).
        profile: speeds, shape (n_lanes, n_steps and what is seen beyond).
    """

    ahead: NDArray[np.int64]
    state: NDArray[np.void]
    work: NDArray[np.void]
    words: WordArray
    flags: BoolArray
    profile: FloatArray


@cache
def block_type(n_ahead: int) -> np.dtype[np.void]:
    """A block of lanes: the truth, what the filter believes, the motor as it is now, what is observed.

    `asked` is the profile as it is observed, of which `profile` is the first row. `observed` are all rows that are, and
    `everything` is all of the block.
    """
    rows = (*TRUTH, *_BELIEF, *_MOTOR, *_SEEN)
    row, n_rows, seen = 8 * LANES, len(rows) + n_ahead, len(rows) - len(_SEEN)
    wide = {"asked": (len(rows), n_ahead), "observed": (seen, n_rows - seen), "everything": (0, n_rows)}
    return np.dtype(
        {
            "names": [*rows, "profile", *wide],
            "formats": [(np.float64, (LANES,))] * (len(rows) + 1)
            + [(np.float64, (height, LANES)) for _, height in wide.values()],
            "offsets": [*range(0, row * len(rows) + 1, row), *(row * first for first, _ in wide.values())],
            "itemsize": row * n_rows,
        }
    )


@cache
def work_type(n_rows: int) -> np.dtype[np.void]:
    """Room for a step of a block of so many rows: actions, costs, noise, motors with a fault; `kept` is a copy."""
    return np.dtype(
        [
            *((name, np.float64, (LANES,)) for name in _WORK),
            ("parts", np.float64, (len(PARTS), LANES)),
            ("x", np.float64, (4, LANES)),
            ("exponential", np.float64, (4, LANES)),
            ("phi", np.float64, (4, LANES)),
            ("room", np.float64, (ROOM, LANES)),
            ("kept", np.float64, (n_rows, LANES)),
            ("made", np.uint32, (4, LANES)),
            ("noise", np.float32, (4, LANES)),
            ("faulty", np.int64, (LANES,)),
            ("stands", np.uint8, (LANES,)),
            ("over", np.uint8, (LANES,)),
        ]
    )


def empty_lanes(ahead: NDArray[np.int64], n_steps: int, count: int) -> Lanes:
    """Lanes that run no episode yet."""
    blocks = -(-count // LANES)
    block = block_type(len(ahead))
    state = aligned_zeros((blocks,), block)
    work = aligned_zeros((1,), work_type(block.itemsize // (8 * LANES)))
    words, flags = empty_streams(count)
    return Lanes(ahead, state, work, words, flags, np.zeros((count, n_steps + int(ahead.max()) + 1)))
