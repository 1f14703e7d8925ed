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

    ## Action Space
    `Discrete(number of offsets + number of kinds)`. An offset is added to the supply's 12 V for a step. By default:

    | Num | Action |
    |---|---|
    | 0 | wait |
    | 1 | move the voltage by -0.7 V |
    | 2 | move the voltage by +0.7 V |
    | 3 | choose bearing |
    | 4 | choose winding |

    ## Observation Space
    Those of `MonitorEnv`, and the evidence for each kind of fault that changes the motor:

    | Num | Observation | Meaning | Min | Max |
    |---|---|---|---|---|
    | 0 | `measured_current` | what the sensor reads, in units of the stall current | -3 | 3 |
    | 1 | `estimated_current` | what the filter holds it for | -3 | 3 |
    | 2 | `estimated_speed` | the same of the speed, in units of the ideal no-load speed | -3 | 3 |
    | 3 | `innovation_current` | read minus expected, whitened: sum over the step / root of its samples | -10 | 10 |
    | 4 | `fast_current` | its exponentially weighted mean over 1 ms, scaled to a standard deviation of 1 | -10 | 10 |
    | 5 | `slow_current` | the same over 10 ms | -10 | 10 |
    | 6 | `excess` | how far its power exceeds that of noise, over 10 ms, scaled in the same way | -10 | 10 |
    | 7 | `voltage` | of the last step, in units of the supply's | -3 | 3 |
    | 8 | `time` | share of the horizon that has passed | 0 | 1 |
    | 9 | `evidence_bearing` | CUSUM of the log-likelihood ratio of the kind's smallest fault, over 10 | -10 | 10 |
    | 10 | `evidence_winding_contact` | the same | -10 | 10 |

    ## Rewards
    As in `MonitorEnv`, with a delay cost of 2 a second. In each step an offset of u volt costs 2 u^2 a second. Energy
    (`energy_cost_per_j`, 0 by default) is charged where the episode ends.

    ## Starting State
    As in `MonitorEnv`.

    ## Episode End
    A declaration, or the horizon (100 steps of 4 ms), both as `terminated`.

    ## Information
    As in `MonitorEnv`, with `reward_probe` and `reward_energy`.

    ## Arguments
    Any option of `ProbeOptions` by name, and `render_mode`: `rgb_array` or `human` (a window, needs pygame). A reset
    with a seed and `options={"index": n}` begins the stream of sub-environment n of a vector.

    ```python
    env = gym.make("motor_env/Probe-v0", offsets_v=(0.0, -1.0, 1.0), render_mode="rgb_array")
    ```

    ## Vectorized environment
    `gym.make_vec("motor_env/Probe-v0", num_envs=1024)` is compiled: all sub-environments step in one call.

    ## Version History
    * v0: first version.
    """

    options_type = ProbeOptions


class ProbeVectorEnv(MotorVectorEnv):
    """Vector of `ProbeEnv`: sub-environment n runs the stream of episodes (seed, n)."""

    options_type = ProbeOptions


def _continuous_actions(setup: Setup) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (1 + len(setup.kinds),), dtype=np.float32)


class ProbeContinuousEnv(MotorEnv):
    """`ProbeEnv` with a voltage that can take any value.

    ## Description
    As in `ProbeEnv`. ProbeContinuous-v0 decides every 2 ms, and the first declaration counts.

    ## Action Space
    `Box(-1, 1, (1 + number of kinds,))`; values outside are clipped. By default:

    | Num | Action | Min | Max |
    |---|---|---|---|
    | 0 | offset of the voltage, in units of 2 V | -1 | 1 |
    | 1 | above 0.5, and above the other kinds: choose bearing | -1 | 1 |
    | 2 | above 0.5, and above the other kinds: choose winding | -1 | 1 |

    ## Observation Space
    Those of `ProbeEnv`:

    | Num | Observation | Meaning | Min | Max |
    |---|---|---|---|---|
    | 0 | `measured_current` | what the sensor reads, in units of the stall current | -3 | 3 |
    | 1 | `estimated_current` | what the filter holds it for | -3 | 3 |
    | 2 | `estimated_speed` | the same of the speed, in units of the ideal no-load speed | -3 | 3 |
    | 3 | `innovation_current` | read minus expected, whitened: sum over the step / root of its samples | -10 | 10 |
    | 4 | `fast_current` | its exponentially weighted mean over 1 ms, scaled to a standard deviation of 1 | -10 | 10 |
    | 5 | `slow_current` | the same over 10 ms | -10 | 10 |
    | 6 | `excess` | how far its power exceeds that of noise, over 10 ms, scaled in the same way | -10 | 10 |
    | 7 | `voltage` | of the last step, in units of the supply's | -3 | 3 |
    | 8 | `time` | share of the horizon that has passed | 0 | 1 |
    | 9 | `evidence_bearing` | CUSUM of the log-likelihood ratio of the kind's smallest fault, over 10 | -10 | 10 |
    | 10 | `evidence_winding_contact` | the same | -10 | 10 |

    ## Rewards
    As in `ProbeEnv`.

    ## Starting State
    As in `MonitorEnv`.

    ## Episode End
    A declaration, or the horizon (200 steps of 2 ms), both as `terminated`.

    ## Information
    As in `ProbeEnv`.

    ## Arguments
    Any option of `ProbeOptions` by name, and `render_mode`: `rgb_array` or `human` (a window, needs pygame). A reset
    with a seed and `options={"index": n}` begins the stream of sub-environment n of a vector.

    ```python
    env = gym.make("motor_env/ProbeContinuous-v0", max_offset_v=1.0, render_mode="rgb_array")
    ```

    ## Vectorized environment
    `gym.make_vec("motor_env/ProbeContinuous-v0", num_envs=1024)` is compiled: all sub-environments step in one call.

    ## Version History
    * v0: first version.
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

    ## Action Space
    `Discrete(1 + number of kinds)`; kinds are those of the recipe, in the order bearing, winding, noise, and the
    sensors, `current_sensor` and `speed_sensor`. By default:

    | Num | Action |
    |---|---|
    | 0 | wait |
    | 1 | choose bearing |
    | 2 | choose winding |

    ## Observation Space
    `Box`, float32, finite, clipped at its bounds; `observe` chooses the numbers. By default:

    | Num | Observation | Meaning | Min | Max |
    |---|---|---|---|---|
    | 0 | `measured_current` | what the sensor reads, in units of the stall current | -3 | 3 |
    | 1 | `estimated_current` | what the filter holds it for | -3 | 3 |
    | 2 | `estimated_speed` | the same of the speed, in units of the ideal no-load speed | -3 | 3 |
    | 3 | `innovation_current` | read minus expected, whitened: sum over the step / root of its samples | -10 | 10 |
    | 4 | `fast_current` | its exponentially weighted mean over 1 ms, scaled to a standard deviation of 1 | -10 | 10 |
    | 5 | `slow_current` | the same over 10 ms | -10 | 10 |
    | 6 | `excess` | how far its power exceeds that of noise, over 10 ms, scaled in the same way | -10 | 10 |
    | 7 | `voltage` | of the last step, in units of the supply's | -3 | 3 |
    | 8 | `time` | share of the horizon that has passed | 0 | 1 |

    ## Rewards
    0 until the episode ends. Charged step by step, the delay would tell the onset. By default (`MonitorOptions`):

    | Event | Reward |
    |---|---|
    | the right kind is declared after the onset | +1 |
    | silence until the horizon, and there was no fault | +1 |
    | a kind is declared before anything has happened | -1 |
    | another kind than the fault's is declared after the onset | -0.5 |
    | silence until the horizon, and there was a fault | -1 |
    | each second between onset and declaration, or horizon | -5 |

    A fault that comes and goes stays the right answer in its pauses, and these count as delay.

    ## Starting State
    The operating point of a motor that is drawn from the recipe, healthy; with `start="standstill"` it stands. Class,
    severity, motor and onset follow from the seed alone.

    ## Episode End
    A declaration, or the horizon (100 steps of 2 ms), both as `terminated`: a miss has to be charged. `truncated` is
    always False.

    ## Information
    The truth, for scoring: `label`, `class_index` (of the recipe's classes), `severity`, `onset_sample` (-1: no fault),
    `fault_active` (False in a pause). The parts of the reward: `reward_verdict`, `reward_delay`.

    ## Arguments
    Any option of `MonitorOptions` by name, and `render_mode`: `rgb_array` or `human` (a window, needs pygame). A reset
    with a seed and `options={"index": n}` begins the stream of sub-environment n of a vector.

    ```python
    env = gym.make("motor_env/Monitor-v0", recipe="easy", render_mode="rgb_array")
    ```

    ## Vectorized environment
    `gym.make_vec("motor_env/Monitor-v0", num_envs=1024)` is compiled: all sub-environments step in one call.

    ## Version History
    * v0: first version.
    """


class MonitorVectorEnv(MotorVectorEnv):
    """Vector of `MonitorEnv`: sub-environment n runs the stream of episodes (seed, n)."""
