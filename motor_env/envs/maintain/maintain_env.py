"""The maintenance task: one motor, or many in one compiled step."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.envs.layout import BoolArray, aligned_zeros, empty_streams
from motor_env.envs.maintain import kernel
from motor_env.envs.maintain.belief import AT_ONCE
from motor_env.envs.maintain.kernel import FEATURES, PARTS
from motor_env.envs.maintain.options import LEVELS, MaintainOptions, Tables, make_tables
from motor_env.envs.maintain.picture import Logbook
from motor_env.envs.single import EVERYWHERE, Info, Observation, StreamEnv, whole_action, whole_actions
from motor_env.envs.vector import StreamVectorEnv
from motor_env.motor.parameters import FloatArray

IMPOSSIBLE = 1e-100
"""A probability that counts as 0: a processor takes a hundred times as long for the tiniest numbers."""
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
    """So many motors that run no episode yet."""
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
    drift, and each start's current tells it with an error. At the limit the bearing fails in service. A new bearing
    has severity 0, and with `rate_spread` a rate of wear of its own.

    ## Action space
    `Discrete(3)`: 0 runs the motor for a day, 1 inspects the bearing (the motor stands still for the day, and its
    severity is known after it), 2 replaces the bearing and runs.

    ## Observation space
    `Box`, float32, shape (7,). `estimate`: severity by the last start or inspection; `mean` and `std`: mean and
    standard deviation of the severity, given all that was seen; `risk`: probability that the bearing fails today;
    `rate`: mean rate of wear, given all that was seen; `age`: days since the bearing was new; `days_left`. Severities
    are divided by the limit, times by the episode's length, the rate by `drift_per_day`.

    ## Reward
    Minus the day's cost, in planned replacements: see `MaintainOptions`. A failure costs 5, a planned replacement 1, an
    inspection 0.1.

    ## End of an episode
    After `days` days, as `terminated`. `truncated` is always False: what is left of a bearing then has no value.

    ## Info
    The truth, for those who score: `severity`, `drift_per_day`, `failed`. And what the reward is made of:
    `reward_failure`, `reward_replacement`, `reward_inspection`.

    Args:
        options: the task; `MaintainOptions()` unless given.
        render_mode: see the metadata.
        changes: single options by name, on top.
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
            raise ValueError(f"actions must be in 0 .. {_ACTIONS - 1}, got {array.min()} .. {array.max()}")
        return observation.T, parts.sum(axis=0), parts, n_over
