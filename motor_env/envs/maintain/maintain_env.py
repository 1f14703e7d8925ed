"""The maintenance task: one motor, or many in one compiled step; a logbook as its screen."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.envs import rendering
from motor_env.envs.layout import BoolArray, aligned_zeros, empty_streams
from motor_env.envs.maintain import kernel
from motor_env.envs.maintain.kernel import AT_ONCE, FEATURES, INSPECT, PARTS, REPLACE, RUN
from motor_env.envs.maintain.options import LEVELS, MaintainOptions, Tables, make_tables
from motor_env.envs.rendering import GRID, LEFT, RIGHT, TOP, WIDTH, Frame, write, write_figures
from motor_env.envs.single import (
    EVERYWHERE,
    Info,
    Observation,
    StreamEnv,
    refuse_actions,
    whole_action,
    whole_actions,
)
from motor_env.envs.vector import StreamVectorEnv
from motor_env.motor.parameters import FloatArray

_HEIGHT, _MIDDLE, _GAP = 400, 250, 34
_SEVERITIES = (-0.25, 1.25)
_LINES = (
    ("truth", "bearing"),
    ("estimate", "current"),
    ("mean", "estimate"),
    ("limit", "threshold"),
)
_DEEDS = {
    RUN: ("| failed", "threshold"),
    INSPECT: ("| inspected", "speed"),
    REPLACE: ("| replaced", "residual"),
}


class Logbook:
    """Keeps an episode and draws it, with the truth, which the agent does not observe."""

    def __init__(self, options: MaintainOptions) -> None:
        self.options = options
        self.clear()

    def clear(self) -> None:
        """Begin an episode."""
        self._rows: list[tuple[float, ...]] = []
        self._deeds: list[tuple[int, int]] = []
        self._cost = 0.0

    def add(
        self, observation: NDArray[np.float32], action: int, *, severity: float, failed: bool, **_: float
    ) -> None:
        """Add a day: observation, action, truth."""
        feature = dict(zip(FEATURES, observation.tolist(), strict=True))
        if failed:
            action = RUN
            self._cost += self.options.failure_cost
        elif action != RUN:
            self._cost += self.options.inspection_cost if action == INSPECT else self.options.replacement_cost
        if failed or action != RUN:
            self._deeds.append((len(self._rows), action))
        names = ("estimate", "mean", "std", "risk")
        self._rows.append((severity / self.options.limit, *(feature[name] for name in names)))

    def draw(self) -> Frame:
        """Draw the screen, shape (400, 640, 3)."""
        frame = rendering.blank_screen(_HEIGHT)
        severity = frame[TOP:_MIDDLE, LEFT : WIDTH - RIGHT]
        risk = frame[_MIDDLE + _GAP : _HEIGHT - 30, LEFT : WIDTH - RIGHT]
        columns = np.arange(severity.shape[1])
        for panel in (severity, risk):
            panel[:: panel.shape[0] // 4] = GRID
            panel[:, :: panel.shape[1] // 10] = GRID
        days = np.full((self.options.days + 1, 5), np.nan)
        days[: len(self._rows)] = self._rows
        truth, estimate, mean, std, failing = days[columns * len(days) // len(columns)].T
        band = np.linspace(*_SEVERITIES, severity.shape[0])[::-1, None]
        severity[np.abs(band - mean) < 2.0 * std] = GRID
        rendering.draw_trace(severity, np.where(columns % 9 < 4, 1.0, np.nan), _SEVERITIES, "threshold")
        for values, colour in ((truth, "bearing"), (estimate, "current"), (mean, "estimate")):
            rendering.draw_trace(severity, values, _SEVERITIES, colour)
        rendering.draw_trace(risk, failing, (0.0, 0.1), "residual", thick=2)
        self._write(frame)
        return frame

    def _write(self, frame: Frame) -> None:
        options = self.options
        write(frame, "bearing", (6, 8), "ink", size_px=16)
        write_figures(frame, f"day {max(len(self._rows) - 1, 0):4d}", (190, 8), "ink", size_px=16)
        write_figures(frame, f"cost {self._cost:6.1f}", (330, 8), "speed", size_px=16)
        write(frame, "severity", (6, TOP - 2), "ink", size_px=12)
        for place, (name, colour) in enumerate(_LINES):
            write(frame, name, (6, TOP + 30 + 16 * place), colour, size_px=11)
        write(frame, "risk today", (6, _MIDDLE + _GAP - 2), "ink", size_px=12)
        write_figures(frame, "0.1", (6, _MIDDLE + _GAP + 15), "dim", size_px=11)
        write(frame, f"0 to {options.days} days", (WIDTH - RIGHT - 90, _HEIGHT - 24), "dim", size_px=12)
        for place, (name, colour) in enumerate(_DEEDS.values()):
            write(frame, name, (LEFT + 90 * place, _MIDDLE + 6), colour, size_px=11)
        for day, action in self._deeds:
            x = LEFT + day * (WIDTH - LEFT - RIGHT) // (options.days + 1)
            frame[TOP:_MIDDLE:2, x : x + 2] = rendering.COLOURS[_DEEDS[action][1]]


IMPOSSIBLE = 1e-100
"""A probability that counts as 0: a processor takes a hundred times as long for denormal numbers."""
_ACTIONS = kernel.REPLACE + 1


def _chances(options: MaintainOptions, tables: Tables) -> kernel.Chances:
    """The tables as the compiled step reads them."""
    missing = -tables.wear.shape[1] % AT_ONCE
    sums = tables.wear.cumsum(axis=1)[:, :-1]
    behind = -sums.shape[1] % kernel.COMPARED
    estimate = np.where(tables.estimate < IMPOSSIBLE, 0.0, tables.estimate)
    return kernel.Chances(
        tables.weights,
        tables.weights.cumsum()[:-1],
        tables.rates / options.drift_per_day,
        np.ascontiguousarray(np.pad(tables.wear, ((0, 0), (0, missing)))[:, ::-1]),
        np.pad(sums, ((0, 0), (0, behind)), constant_values=2.0),
        tables.failing,
        np.concatenate([estimate.T, np.eye(LEVELS), np.ones((LEVELS, 1))], axis=1),
        np.array(
            [
                *(tables.lowest, options.days, options.estimate_std / (options.limit / LEVELS)),
                *(options.failure_cost, options.inspection_cost, options.replacement_cost),
            ]
        ),
    )


def _motors(chances: kernel.Chances, count: int) -> kernel.Motors:
    """Motors before their first episode."""
    width = min(count, kernel.MOTORS)
    words, flags = empty_streams(count)
    return kernel.Motors(
        words,
        np.zeros((kernel.FAILED + 1, count), dtype=np.int32),
        flags,
        aligned_zeros((-(-count // width), len(chances.weights), LEVELS, width)),
        kernel.room_for(chances.growths.shape[1], width),
        aligned_zeros((4, width), np.uint32),
        aligned_zeros((width,), np.float32),
        aligned_zeros((width,), np.uint32),
    )


def _observation_space(chances: kernel.Chances) -> spaces.Space[Observation]:
    """Box of the features."""
    fastest = np.nextafter(np.float32(chances.shares.max()), np.float32(np.inf))
    high = np.array([1.5, 1.0, 1.0, 1.0, fastest, 1.0, 1.0], dtype=np.float32)
    low = np.zeros(len(FEATURES), dtype=np.float32)
    low[FEATURES.index("estimate")] = -0.5
    return cast("spaces.Space[Observation]", spaces.Box(low, high, dtype=np.float32))


class MaintainEnv(StreamEnv[MaintainOptions]):
    """A bearing wears from start to start. Run the motor, inspect its bearing, or replace it in time.

    ## Description
    The motor starts once a day. The severity of its bearing fault (extra friction) grows by a Wiener process with
    drift; each start gives a noisy estimate of it. At the limit the bearing fails in service. A new bearing has
    severity 0, and with `rate_spread` a rate of wear of its own.

    ## Action Space
    `Discrete(3)`:

    | Num | Action |
    |---|---|
    | 0 | run the motor for a day |
    | 1 | inspect: the motor stands still for the day, and its severity is known after it |
    | 2 | replace the bearing, and run |

    ## Observation Space
    `Box`, float32. Severities are divided by the limit, times by the episode's length:

    | Num | Observation | Meaning | Min | Max |
    |---|---|---|---|---|
    | 0 | `estimate` | severity by the last start or inspection | -0.5 | 1.5 |
    | 1 | `mean` | of the severity's posterior | 0 | 1 |
    | 2 | `std` | its standard deviation | 0 | 1 |
    | 3 | `risk` | probability that the bearing fails today | 0 | 1 |
    | 4 | `rate` | posterior mean of the rate of wear, over `drift_per_day` | 0 | 1 |
    | 5 | `age` | time since the bearing was new | 0 | 1 |
    | 6 | `days_left` | time to the end of the episode | 0 | 1 |

    ## Rewards
    Minus the day's cost, in planned replacements. A failure is seen at once, so nothing is held back. By default
    (`MaintainOptions`):

    | Event | Reward |
    |---|---|
    | a failure | -5 |
    | a planned replacement | -1 |
    | an inspection | -0.1 |

    ## Starting State
    A new bearing; its rate of wear follows from the seed alone.

    ## Episode End
    After `days` days, as `terminated`. `truncated` is always False: what is left of a bearing then has no value.

    ## Information
    The truth, for scoring: `severity`, `drift_per_day`, `failed`. The parts of the reward: `reward_failure`,
    `reward_replacement`, `reward_inspection`.

    ## Arguments
    Any option of `MaintainOptions` by name, and `render_mode`: `rgb_array` or `human` (a window, needs pygame). A reset
    with a seed and `options={"index": n}` begins the stream of sub-environment n of a vector.

    ```python
    env = gym.make("motor_env/Maintain-v0", days=60, render_mode="rgb_array")
    ```

    ## Vectorized environment
    `gym.make_vec("motor_env/Maintain-v0", num_envs=1024)` is compiled: all sub-environments step in one call.

    ## Version History
    * v0: first version.
    """

    observed = FEATURES
    metadata: dict[str, Any] = {**StreamEnv.metadata, "render_fps": 10}  # noqa: RUF012  # gymnasium's way

    options_type = MaintainOptions

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        tables = make_tables(self.options)
        chances = _chances(self.options, tables)
        self._rates, self._motors = tables.rates, _motors(chances, 1)
        self._words, self._arrays = self._motors.words, (*chances, *self._motors)
        self._action = np.zeros(1, dtype=np.int64)
        self._screen = None if self.render_mode is None else Logbook(self.options)
        return _observation_space(chances), spaces.Discrete(_ACTIONS)

    def _begin(self) -> tuple[Observation, Info]:
        kernel.begin(EVERYWHERE, *self._arrays)
        self._over = False
        observation = np.empty((len(FEATURES), 1), dtype=np.float32)
        kernel.observe(observation, *self._arrays)
        if self._screen is not None:
            self._screen.clear()
            self._show(observation[:, 0], kernel.RUN)
        return observation[:, 0], self._truth()

    def _truth(self) -> Info:
        marks = self._motors.marks
        return {
            "severity": marks.item(kernel.LEVEL, 0) * (self.options.limit / LEVELS),
            "drift_per_day": self._rates.item(marks.item(kernel.RATE, 0)),
            "failed": marks.item(kernel.FAILED, 0) > 0,
        }

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """One day.

        Raises:
            ValueError: there is no such action.
        """
        if self._over:
            raise gym.error.ResetNeeded("call reset() before step(): the episode is over")
        self._action[0] = whole_action(action, _ACTIONS)
        observation, parts = np.empty((len(FEATURES), 1), dtype=np.float32), np.empty((len(PARTS), 1))
        self._over = kernel.step(self._action, False, parts, observation, *self._arrays) > 0
        if self._screen is not None:
            self._show(observation[:, 0], int(self._action[0]))
        info, costs = self._truth(), parts.ravel().tolist()
        info.update(zip(PARTS, costs, strict=True))
        return observation[:, 0], sum(costs), self._over, False, info

    def _show(self, observation: Observation, action: int) -> None:
        self._screen.add(observation, action, **self._truth())
        if self.render_mode == "human":
            self.render()


class MaintainVectorEnv(StreamVectorEnv[MaintainOptions]):
    """Vector of `MaintainEnv`: sub-environment n runs the stream of episodes (seed, n)."""

    options_type = MaintainOptions
    part_names = PARTS

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        tables = make_tables(self.options)
        chances = _chances(self.options, tables)
        self._rates, motors = tables.rates, _motors(chances, self.num_envs)
        self._words, self._flags, self._marks = motors.words, motors.flags, motors.marks
        self._arrays = (*chances, *motors)
        return _observation_space(chances), spaces.Discrete(_ACTIONS)

    def _begin(self, mask: BoolArray) -> None:
        kernel.begin(mask, *self._arrays)

    def _write(self, observation: NDArray[np.float32]) -> None:
        kernel.observe(observation, *self._arrays)

    def _truth(self, active: BoolArray) -> Info:
        return {
            "severity": self._marks[kernel.LEVEL] * (self.options.limit / LEVELS),
            "drift_per_day": self._rates.take(self._marks[kernel.RATE]),
            "failed": self._marks[kernel.FAILED] > 0,
        }

    def _step(self, actions: Any) -> tuple[Observation, FloatArray, FloatArray, int]:
        array = whole_actions(actions, self.num_envs, _ACTIONS)
        observation, parts = self._empty(), np.empty((len(PARTS), self.num_envs))
        n_over = kernel.step(array, self._next_step, parts, observation, *self._arrays)
        if n_over < 0:
            refuse_actions(array, _ACTIONS)
        return observation.T, parts.sum(axis=0), parts, n_over
