"""`motor_env/Monitor-v0`: watch a motor that may be failing, and say so in time."""

from __future__ import annotations

from motor_env.envs.single import MotorEnv
from motor_env.envs.vector import MotorVectorEnv


class MonitorEnv(MotorEnv):
    """A DC motor runs, watched by a Kalman filter of the healthy motor. Say what fails, and when.

    ## Description
    The motor begins at its operating point. At an unknown time a fault of an unknown kind sets in, or none does. The
    filter's whitened innovation is standard normal white noise until then. The agent waits, or declares a kind.

    ## Action space
    `Discrete(1 + number of kinds)`: 0 waits, the others declare one of the kinds that the recipe knows, in the order
    bearing, winding, noise. With the default recipe: 1 bearing, 2 winding.

    ## Observation space
    `Box`, float32, finite, clipped at the space's bounds; `observe` chooses the numbers. Means are exponentially
    weighted and scaled to a standard deviation of 1. Current is in units of the stall current, speed of the ideal
    no-load speed, voltage of the supply's.

    ## Reward
    See `MonitorOptions`: delay costs 5 a second; right kind +1, silence to the end without a fault +1, false alarm -1,
    wrong kind -0.5, miss -1.

    ## End of an episode
    A declaration, or the horizon (2000 samples of 0.1 ms), both as `terminated`. `truncated` is always False: the
    environment owns its horizon, because a miss has to be charged.

    ## Info
    The truth, for those who score: `label`, `class_index` (of the recipe's classes), `severity`, `onset_sample`
    (-1: no fault), `fault_active`. And what the reward is made of: `reward_verdict`, `reward_delay`.

    Args:
        options: the task; `MonitorOptions()` unless given.
        render_mode: see the metadata.
        changes: single options by name, on top.
    """


class MonitorVectorEnv(MotorVectorEnv):
    """Vector of `MonitorEnv`: sub-environment n runs the stream of episodes (seed, n)."""
