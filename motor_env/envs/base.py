"""What the single environments share: episodes, the compiled step, observations, info."""

from __future__ import annotations

from typing import Any, Generic, TypeVar, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.envs import kernel
from motor_env.envs.options import MonitorOptions
from motor_env.envs.setup import Setup, draw_episodes, make_setup
from motor_env.parameters import require

ActType = TypeVar("ActType")
Observation = NDArray[np.float32]
Info = dict[str, Any]
RENDER_MODES: tuple[str, ...] = ()


def observation_space(setup: Setup) -> spaces.Space[Observation]:
    """Box of the chosen features."""
    high = setup.view[1, setup.chosen].astype(np.float32)
    low = np.where(setup.chosen == kernel.FEATURES.index("time"), 0.0, -high).astype(np.float32)
    return cast("spaces.Space[Observation]", spaces.Box(low, high, dtype=np.float32))


class MotorEnv(gym.Env[Observation, ActType], Generic[ActType]):
    """A motor under the filter; the subclasses say what can be done with it."""

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012  # gymnasium's way

    def __init__(self, options: MonitorOptions, render_mode: str | None) -> None:
        require(
            render_mode is None or render_mode in RENDER_MODES,
            f"render_mode must be one of None {' '.join(RENDER_MODES)}, got {render_mode!r}",
        )
        self.render_mode = render_mode
        self.options = options
        self.setup: Setup = make_setup(options)
        self.observation_space = observation_space(self.setup)
        self._state = np.zeros(kernel.N_FIELDS * kernel.LANES, dtype=options.precision)
        self._seed: int | None = None
        self._index = 0
        self._episode = 0
        self._truth: Info = {}
        self._onset = kernel.NEVER
        self._offsets_v: list[float] = self.setup.offsets_v.tolist()
        self._declarations: list[int] = self.setup.declarations.astype(int).tolist()
        self._over = True
        self._samples = options.samples_per_step

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode.

        Args:
            seed: begins the stream of episodes anew; without it the next episode of the stream begins.
            options: `{"index": n}` takes the stream of sub-environment n of a vector with that seed; only with a seed.

        Raises:
            ValueError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        index = chosen.pop("index", None)
        require(not chosen, f"reset knows the option index, got {', '.join(map(repr, chosen))}")
        require(index is None or seed is not None, "the reset option index needs a seed")
        if seed is not None or self._seed is None:
            self._seed = seed if seed is not None else int(self.np_random.integers(2**63))
            self._index, self._episode = int(index or 0), 0
        else:
            self._episode += 1
        return self._begin()

    def _begin(self) -> tuple[Observation, Info]:
        assert self._seed is not None  # noqa: S101  # set by reset
        drawn = draw_episodes(self.setup, self._seed, np.array([self._index]), np.array([self._episode]))
        which, onset = int(drawn.class_index[0]), float(drawn.heads[0, kernel.HEAD_ONSET])
        self._onset = onset
        self._truth = {
            "label": self.setup.labels[which],
            "severity": self.setup.severities[which],
            "class_index": which,
            "onset_sample": int(onset) if onset < kernel.NEVER else -1,
        }
        self._table, self._key = drawn.tables[0], drawn.keys[0]
        kernel.begin_episode(self._state, 0, drawn.heads[0], self._table, self._key, self.setup.constants)
        observation = np.empty(len(self.setup.chosen), dtype=np.float32)
        kernel.observe_lane(
            self._state, 0, self.setup.chosen, self.setup.view, observation
        )
        self._over = False
        return observation, self._info()

    def _advance(self, offset_v: float, declared: int) -> tuple[Observation, float, bool, bool, Info]:
        if self._over:
            raise gym.error.ResetNeeded("call reset() before step(): the episode is over")
        setup = self.setup
        observation = np.empty(len(setup.chosen), dtype=np.float32)
        reward, self._over = kernel.step_single(
            self._state,
            self._table,
            self._key,
            setup.constants,
            setup.bank,
            setup.view,
            setup.chosen,
            observation,
            offset_v,
            declared,
            self._samples,
        )
        return observation, reward, self._over, False, self._info()

    def _info(self) -> Info:
        sample = self._state.item(kernel.SAMPLE * kernel.LANES)
        return {**self._truth, "fault_active": sample > self._onset}


class DiscreteMotorEnv(MotorEnv[Any]):
    """A motor with a list of actions: apply a voltage, or declare a kind."""

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """Apply a voltage (waiting is one), or declare a kind, which ends the episode.

        Raises:
            ValueError: there is no such action.
        """
        which = int(action)
        if not 0 <= which < len(self._offsets_v):
            raise ValueError(f"action must be in 0 .. {len(self._offsets_v) - 1}, got {action}")
        return self._advance(self._offsets_v[which], self._declarations[which])


def discrete_actions(setup: Setup) -> spaces.Discrete:
    """One action a voltage, then one a kind."""
    return spaces.Discrete(len(setup.offsets_v))
