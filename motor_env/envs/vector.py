"""Many environments in one compiled step: what the vector twins share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from motor_env.envs import kernel, vector_kernel
from motor_env.envs.base import Info, Observation, observation_space
from motor_env.envs.options import MonitorOptions
from motor_env.envs.setup import Setup, draw_episodes, make_setup, n_levels, right_declarations
from motor_env.envs.vector_kernel import BLOCK, DEPTH, BoolArray, IntArray, Now, Outcome, Store
from motor_env.parameters import FloatArray, require

Step = tuple[Observation, FloatArray, BoolArray, BoolArray, Info]


class MotorVectorEnv(VectorEnv[Observation, Any, NDArray[Any]]):
    """The compiled step over many lanes. The subclasses lay their actions into the lanes.

    The trajectory of sub-environment n depends on (options, seed, n) and the actions alone: not on the number of
    sub-environments, nor on what the others do. A single environment reset with that seed and `{"index": n}` runs
    the same. With a list of seeds, sub-environment n runs the stream (seeds[n], 0).

    Arrays that a step returns are new at each call; the observation is Fortran-ordered.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # gymnasium's way

    def __init__(
        self,
        num_envs: int,
        options: MonitorOptions,
        single_action_space: spaces.Space[Any],
        autoreset_mode: AutoresetMode | str,
        render_mode: str | None,
    ) -> None:
        require(num_envs >= 1, f"num_envs must be >= 1, got {num_envs}")
        require(render_mode is None, f"render_mode of a vector must be None, got {render_mode!r}")
        self.num_envs = num_envs
        self.options = options
        self.setup: Setup = make_setup(options)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = single_action_space
        self.action_space = batch_space(single_action_space, num_envs)
        self.single_observation_space = observation_space(self.setup)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._allocate()

    @property
    def labels(self) -> tuple[str, ...]:
        """Label kind of every class: what the info's `class_index` points at."""
        return self.setup.labels

    @property
    def right_declaration(self) -> NDArray[np.int64]:
        """Number of the kind that is right for every class, 0 for healthy, as `setup.declarations` counts them."""
        return right_declarations(self.setup)

    def _allocate(self) -> None:
        lanes = -(-self.num_envs // kernel.LANES) * kernel.LANES
        levels = n_levels(self.options) + 1
        precision = self.options.precision
        self._state = np.zeros(lanes // kernel.LANES * BLOCK, dtype=precision)
        by_field = self._state.reshape(-1, kernel.N_FIELDS, kernel.LANES)
        by_field[:, [kernel.ONSET, kernel.NEXT_CHANGE]] = kernel.NEVER  # lanes that fill the last block
        self._low, self._high = np.zeros((2, lanes), dtype=np.uint64)
        self._store = Store(
            heads=np.zeros((DEPTH, lanes, kernel.HEAD_LENGTH)),
            tables=np.zeros((DEPTH, lanes, levels, kernel.ROW_LENGTH), dtype=precision),
            keys=np.zeros((DEPTH, lanes, 2), dtype=np.uint64),
            class_index=np.zeros((DEPTH, lanes), dtype=np.int64),
        )
        self._now = Now(
            slot=np.zeros(lanes, dtype=np.int64),
            ready=np.zeros(lanes, dtype=np.int64),
            over=np.zeros(lanes, dtype=np.bool_),
            class_index=np.zeros(lanes, dtype=np.int64),
            onset=np.zeros(lanes, dtype=np.int64),
            episode=np.zeros(lanes, dtype=np.int64),
        )
        self._seeds: NDArray[np.uint64] | None = None
        self._indices: IntArray = np.arange(lanes, dtype=np.int64)

    def _out(self, values: NDArray[Any]) -> NDArray[Any]:
        return values[: self.num_envs].copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin episodes.

        Args:
            seed: begins the streams of episodes anew; without it the next episode of each stream begins. A list has
                one seed, or None, for each sub-environment.
            options: `{"reset_mask": mask}` resets the sub-environments of the mask only.

        Raises:
            ValueError: the mask or the list of seeds is none.
        """
        chosen = dict(options or {})
        mask = self._checked_mask(chosen.pop("reset_mask", None))
        require(not chosen, f"reset knows the option reset_mask, got {', '.join(map(repr, chosen))}")
        super().reset(seed=seed if isinstance(seed, int | np.integer) else None)
        self._take_seeds(seed, mask)
        if (self._now.ready[: self.num_envs][mask] == 0).any():
            self._draw()
        vector_kernel.begin_lanes(
            self._state, mask, self._low, self._high, self.setup.constants, self._store, self._now
        )
        return self._observe(), self._info(self._active(), mask)

    def _checked_mask(self, mask: Any) -> BoolArray:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        array = np.asarray(mask)
        require(
            array.shape == (self.num_envs,) and array.dtype == np.bool_ and bool(array.any()),
            f"reset_mask must be a boolean array of shape ({self.num_envs},) with a True in it, "
            f"got {array.dtype} {array.shape}",
        )
        require(
            self._seeds is not None or bool(array.all()),
            "reset_mask must not be given before the first reset of all sub-environments",
        )
        return array

    def _take_seeds(self, seed: int | Sequence[int | None] | None, mask: BoolArray) -> None:
        everywhere = np.arange(self.num_envs)
        if seed is None and self._seeds is None:
            seed = int(self.np_random.integers(2**63))
        if self._seeds is None:
            self._seeds = np.zeros(self.num_envs, dtype=np.uint64)
        if seed is None:
            return
        if isinstance(seed, int | np.integer):
            seeds: list[int | None] = [int(seed)] * self.num_envs
            indices = everywhere
        else:
            seeds, indices = list(seed), np.zeros(self.num_envs, dtype=np.int64)
            require(len(seeds) == self.num_envs, f"seed must list {self.num_envs} seeds, got {len(seeds)}")
        for n in everywhere[mask]:
            given = seeds[n]
            if given is not None:
                self._seeds[n], self._indices[n] = given, indices[n]
                self._now.episode[n], self._now.ready[n] = -1, 0

    def _draw(self) -> None:
        """Fill the rings of episodes: many at once, which costs little a lane."""
        assert self._seeds is not None  # noqa: S101  # set by reset
        now = self._now
        missing = DEPTH - 1 - now.ready[: self.num_envs]
        lanes = np.repeat(np.arange(self.num_envs), missing)
        first = np.repeat(np.cumsum(missing) - missing, missing)
        ahead = now.ready[lanes] + 1 + np.arange(len(lanes)) - first
        seeds = self._seeds[lanes]
        for seed in np.unique(seeds):
            chosen = seeds == seed
            some, offset = lanes[chosen], ahead[chosen]
            drawn = draw_episodes(self.setup, int(seed), self._indices[some], now.episode[some] + offset)
            place = (now.slot[some] + offset) % DEPTH
            self._store.heads[place, some] = drawn.heads
            self._store.tables[place, some] = drawn.tables
            self._store.keys[place, some] = drawn.keys
            self._store.class_index[place, some] = drawn.class_index
        now.ready[: self.num_envs] = DEPTH - 1

    def _lay_actions(self, actions: Any) -> None:
        raise NotImplementedError

    def step(self, actions: Any) -> Step:
        """A step of every sub-environment.

        Raises:
            ValueError: an action does not exist.
            ResetNeeded: before the first reset, or, with autoreset disabled, where an episode is over.
        """
        if self._seeds is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        mode = self.autoreset_mode
        if mode is AutoresetMode.DISABLED and self._now.over.any():
            raise gym.error.ResetNeeded("autoreset is disabled: reset the sub-environments that are over")
        self._lay_actions(actions)
        count = self.num_envs
        out = Outcome(
            observation=np.empty((len(self.setup.chosen), count), dtype=np.float32),
            reward=np.empty(count),
            terminated=np.empty(count, dtype=np.bool_),
            active=np.empty(count, dtype=np.bool_),
        )
        n_over, n_unready = vector_kernel.step_vector(
            self._state,
            self._low,
            self._high,
            self.setup.constants,
            self.setup.bank,
            self.setup.view,
            self.setup.chosen,
            self._store,
            self._now,
            out,
            self.options.samples_per_step,
            mode is AutoresetMode.NEXT_STEP,
        )
        if n_unready > 0:
            self._draw()
        observation, info = out.observation.T, self._info(out.active)
        if mode is AutoresetMode.SAME_STEP and n_over > 0:
            observation, info = self._reset_same_step(observation, info, out.terminated)
        return observation, out.reward, out.terminated, np.zeros(count, dtype=np.bool_), info

    def _reset_same_step(
        self, last: Observation, last_info: Info, over: BoolArray
    ) -> tuple[Observation, Info]:
        """Begin the next episodes at once; the last observations and infos go into the info, in gymnasium's form."""
        vector_kernel.begin_lanes(
            self._state, over, self._low, self._high, self.setup.constants, self._store, self._now
        )
        final = np.full(self.num_envs, None, dtype=object)
        for n in np.flatnonzero(over):
            final[n] = last[n].copy()
        masks = {name: over.copy() for name in last_info if name.startswith("_")}
        info = self._info(self._active())
        info.update(final_obs=final, _final_obs=over.copy(), final_info={**last_info, **masks})
        info["_final_info"] = over.copy()
        return self._observe(), info

    def _observe(self) -> Observation:
        rows = np.empty((len(self.setup.chosen), self.num_envs), dtype=np.float32)
        vector_kernel.observe(self._state, self.setup.chosen, self.setup.view, rows)
        return rows.T

    def _active(self) -> BoolArray:
        by_field = self._state.reshape(-1, kernel.N_FIELDS, kernel.LANES)
        active = by_field[:, kernel.SAMPLE] > by_field[:, kernel.ONSET]
        return active.ravel()[: self.num_envs]

    def _info(self, active: BoolArray, mask: BoolArray | None = None) -> Info:
        """The truth, for those who score; what decides must not read it."""
        known = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask.copy()
        return {
            "class_index": self._out(self._now.class_index),
            "_class_index": known,
            "onset_sample": self._out(self._now.onset),
            "_onset_sample": known,
            "fault_active": active,
            "_fault_active": known,
        }


class DiscreteVectorEnv(MotorVectorEnv):
    """Sub-environments with a list of actions."""

    def _lay_actions(self, actions: Any) -> None:
        given = np.asarray(actions)
        if given.shape != (self.num_envs,) or given.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers of shape ({self.num_envs},), got {given.dtype} {given.shape}"
            )
        known = vector_kernel.decode_discrete(
            self._state,
            np.ascontiguousarray(given, dtype=np.int64),
            self.setup.offsets_v,
            self.setup.declarations,
        )
        if not known:
            highest = len(self.setup.offsets_v) - 1
            raise ValueError(f"actions must be in 0 .. {highest}, got {given.min()} .. {given.max()}")
