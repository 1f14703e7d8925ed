"""Monitor: watch a motor that may be failing, and declare its fault in time. Probe: also excite it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from motor_env.envs import stepping
from motor_env.envs.options import LARGEST_REWARD, LARGEST_V, MonitorOptions
from motor_env.envs.setup import Setup
from motor_env.envs.single import Info, MotorEnv, Observation, finite_action
from motor_env.envs.vector import MotorVectorEnv
from motor_env.motor.parameters import require, require_positive
from motor_env.simulation.recipes import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOptions(MonitorOptions):
    """`MonitorOptions` with other defaults, and options of a voltage that the agent moves.

    Attributes:
        offsets_v: voltage offsets of the actions of Probe-v0; the first is that of waiting. At 1 V a random move tells
            so much that an agent need not learn to move on purpose.
        max_offset_v: largest offset, up or down, of ProbeContinuous-v0.
        probe_cost_per_v2_s: price of the squared offset for a second.
        energy_cost_per_j: price of the electrical energy that the motor takes or gives; charged where the episode ends.
        observe: names of the observed features, in this order; empty: all that the recipe's sensor gives, and the
            evidence for each kind.
    """

    recipe: Recipe | str | Path = "small"  # windings worse by 0.5 to 3 %
    horizon_s: float = 0.4
    samples_per_step: int = 40  # a decision every 4 ms
    load_torque_n_m: float | None = 0.0  # so that a motor left alone shows nothing of a winding
    earliest_onset_s: float = 0.02
    mean_onset_s: float = 0.1
    delay_cost_per_s: float = 2.0
    offsets_v: tuple[float, ...] = (0.0, -0.7, 0.7)
    max_offset_v: float = 2.0
    probe_cost_per_v2_s: float = 2.0
    energy_cost_per_j: float = 0.0
    moves_voltage: ClassVar[bool] = True

    def __post_init__(self) -> None:
        MonitorOptions.__post_init__(self)
        object.__setattr__(self, "offsets_v", tuple(float(v) for v in self.offsets_v))
        require(
            1 <= len(self.offsets_v) <= 1000 and bool((np.abs(self.offsets_v) <= LARGEST_V).all()),
            f"offsets_v must be 1 to 1000 finite voltages of at most {LARGEST_V:g} V either way, got {self.offsets_v}",
        )
        require_positive("max_offset_v", self.max_offset_v)
        require(
            self.max_offset_v <= LARGEST_V,
            f"max_offset_v must be at most {LARGEST_V:g}, got {self.max_offset_v:g}",
        )
        for name in ("probe_cost_per_v2_s", "energy_cost_per_j"):
            require_positive(name, getattr(self, name), zero_allowed=True)
            require(
                getattr(self, name) <= LARGEST_REWARD,
                f"{name} must be at most {LARGEST_REWARD:g}, got {getattr(self, name):g}",
            )


class ProbeEnv(MotorEnv):
    """A DC motor runs without load, where a winding fault does not show. Move the voltage to see it, at a price.

    ## Description
    As in `MonitorEnv`, but faults are small (0.5 to 3 %), and the agent chooses the voltage every 4 ms. A moving
    voltage makes the current flow that a changed resistance changes.

    ## Action space
    `Discrete(number of offsets + number of kinds)`: the first actions add an offset to the supply's 12 V for a step (0,
    -0.7 and +0.7 V), the others choose a kind, in the order bearing, winding, noise. By default 0 waits, 1 and 2 probe,
    3 chooses a bearing, 4 a winding.

    ## Observation space
    As in `MonitorEnv`, and for each kind of fault the evidence: a CUSUM of the log-likelihood ratio of its smallest
    fault, divided by 10, from 0 to 10. The voltage is that of the last step. The innovation is the sum over the step,
    over the root of its number of samples.

    ## Reward
    As in `MonitorEnv` with a delay cost of 2 a second; an offset of 1 V costs 2 a second, growing with its
    square, in the step that it lasts.

    ## End of an episode
    A declaration, or the horizon (100 steps of 4 ms), both as `terminated`.

    ## Info
    As in `MonitorEnv`, with `reward_probe` and `reward_energy`.
    """

    options_type = ProbeOptions


class ProbeVectorEnv(MotorVectorEnv):
    """Vector of `ProbeEnv`: sub-environment n runs the stream of episodes (seed, n)."""

    options_type = ProbeOptions


def _continuous_actions(setup: Setup) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (1 + len(setup.kinds),), dtype=np.float32)


class ProbeContinuousEnv(MotorEnv):
    """`ProbeEnv` with a voltage that can take any value.

    ## Action space
    `Box(-1, 1, (1 + number of kinds,))`: the first entry is the offset in units of the largest (2 V); if the largest of
    the others is above 0.5, its kind is chosen. Values outside are clipped.

    ProbeContinuous-v0 decides every 2 ms, and the first declaration counts.

    Everything else is as in `ProbeEnv`.
    """

    options_type = ProbeOptions
    options: ProbeOptions

    def _actions(self) -> spaces.Space[Any]:
        return _continuous_actions(self.setup)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """Apply a voltage, or declare a kind, which ends the episode.

        Raises:
            ValueError: the action has another shape, or a value that is not finite.
        """
        given = finite_action(action, self.action_space.shape)
        offset_v, declared = stepping.decode_continuous(given, self.options.max_offset_v)
        return self._advance(offset_v, declared)


class ProbeContinuousVectorEnv(MotorVectorEnv):
    """Vector of `ProbeContinuousEnv`: sub-environment n runs the stream of episodes (seed, n)."""

    options_type = ProbeOptions
    options: ProbeOptions

    def _actions(self) -> spaces.Space[Any]:
        return _continuous_actions(self.setup)

    def _step_lanes(self, actions: Any, *outputs: np.ndarray[Any, Any]) -> int:
        array = finite_action(actions, self.action_space.shape)
        n_over: int = stepping.step_continuous(
            array, self.options.max_offset_v, *self._timing, *outputs, *self._arrays
        )
        return n_over


class MonitorEnv(MotorEnv):
    """A DC motor runs, watched by a Kalman filter of the healthy motor. Declare what fails, and when.

    ## Description
    The motor begins at its operating point. At an unknown time a fault of an unknown kind sets in, or none does. Until
    then the filter's whitened innovation is standard normal white noise. The agent waits, or chooses a kind; one that
    is chosen in three steps in a row is declared.

    ## Action space
    `Discrete(1 + number of kinds)`: 0 waits, the others choose one of the recipe's kinds, in the order bearing,
    winding, noise, current_sensor, speed_sensor. With the default recipe: 1 bearing, 2 winding.

    ## Observation space
    `Box`, float32, finite, clipped at the space's bounds; `observe` chooses the numbers. Means are exponentially
    weighted and scaled to a standard deviation of 1. Current is in units of the stall current, speed of the ideal
    no-load speed, voltage of the supply's.

    ## Reward
    0 until the episode ends. See `MonitorOptions`: right kind +1, silence to the end without a fault +1, false alarm
    -1, wrong kind -0.5, miss -1; delay costs 5 a second. Charged step by step, the delay would tell the onset. A fault
    that comes and goes stays the right answer in its pauses, and these count as delay.

    ## End of an episode
    A declaration, or the horizon (100 steps of 2 ms), both as `terminated`: a miss has to be charged. `truncated`
    is always False.

    ## Info
    The truth, for scoring: `label`, `class_index` (of the recipe's classes), `severity`, `onset_sample`
    (-1: no fault), `fault_active` (False in a pause). The parts of the reward: `reward_verdict`, `reward_delay`.
    """


class MonitorVectorEnv(MotorVectorEnv):
    """Vector of `MonitorEnv`: sub-environment n runs the stream of episodes (seed, n)."""
