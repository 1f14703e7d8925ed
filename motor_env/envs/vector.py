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
from motor_env.envs.base import Info, Observation, discrete_actions, observation_space
from motor_env.envs.episodes import draw_episodes, record_length, right_declarations
from motor_env.envs.noise import INDEX, LANES, ROWS, SEED_HIGH, SEED_LOW
from motor_env.envs.options import MonitorOptions, with_changes
from motor_env.envs.setup import Setup, make_setup
from motor_env.envs.vector_kernel import (
    BLOCK,
    CLASS_INDEX,
    DEPTH,
    FAULT_ACTIVE,
    KNOWN,
    NUMBER,
    READY,
    RING,
    RUNNING_ONSET,
    SLOT,
    TERMINATED,
    TRUNCATED,
)
from motor_env.motor.parameters import FloatArray, require

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Step = tuple[Observation, FloatArray, BoolArray, BoolArray, Info]


class MotorVectorEnv(VectorEnv[Observation, Any, NDArray[Any]]):
    """The compiled step over many lanes. The subclasses lay their actions into the lanes.

    The trajectory of sub-environment n depends on (options, seed, n) and the actions alone: not on the number of
    sub-environments, nor on what the others do. A single environment reset with that seed and `{"index": n}` runs
    the same. With a list of seeds, sub-environment n runs the stream (seeds[n], 0).

    Arrays that a step returns are new at each call; the observation is Fortran-ordered.

    Args:
        num_envs: number of sub-environments.
        options: the task; the defaults of `options_type` unless given.
        autoreset_mode: what follows the end of an episode: `NextStep`, `SameStep` or `Disabled`.
        render_mode: None, or rgb_array.
        changes: single options by name, on top.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # gymnasium's way

    options_type: type[MonitorOptions] = MonitorOptions

    def __init__(
        self,
        num_envs: int = 1,
        options: MonitorOptions | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        require(num_envs >= 1, f"num_envs must be >= 1, got {num_envs}")
        require(render_mode is None, f"render_mode of a vector must be None, got {render_mode!r}")
        self.num_envs = num_envs
        self.options = with_changes(options or self.options_type(), changes)
        self.setup: Setup = make_setup(self.options)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = self._actions()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.single_observation_space = observation_space(self.setup)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._allocate()

    def _actions(self) -> spaces.Space[Any]:
        return discrete_actions(self.setup)

    @property
    def labels(self) -> tuple[str, ...]:
        """Label kind of every class: what the info's `class_index` points at."""
        return self.setup.labels

    @property
    def right_declaration(self) -> NDArray[np.int64]:
        """Number of the kind that is right for every class, 0 for healthy, as `setup.declarations` counts them."""
        return right_declarations(self.setup)

    def _allocate(self) -> None:
        blocks = -(-self.num_envs // LANES)
        precision = self.options.precision
        self._state = np.zeros(blocks * BLOCK, dtype=precision)
        by_field = self._state.reshape(blocks, kernel.N_FIELDS, LANES)
        by_field[:, [kernel.ONSET, kernel.NEXT_CHANGE]] = kernel.NEVER  # lanes that fill the last block
        self._noise = np.zeros((blocks, ROWS, LANES), dtype=np.float32)
        self._row = ROWS
        self._names = np.zeros((blocks, 4, LANES), dtype=np.uint32)
        self._episodes = np.zeros((blocks, DEPTH, LANES, record_length(self.options)), dtype=precision)
        self._counts = np.zeros((blocks, RING + DEPTH, LANES), dtype=np.int32)
        self._declared = np.zeros((blocks, LANES), dtype=np.uint8)
        self._flags = np.zeros((4, blocks * LANES), dtype=np.bool_)
        self._flags[KNOWN] = True
        self._truth = np.zeros((2, blocks * LANES), dtype=np.int32)
        self._seeds: NDArray[np.uint64] | None = None
        self._n_offsets = len(self.setup.offsets_v) - len(self.setup.kinds)
        self._counts[:, NUMBER] = -1
        self._fixed = (
            self._state,
            self._noise,
            self._names,
            self.setup.constants,
            self.setup.bank,
            self.setup.observed,
            self._episodes,
            self._counts,
            self._declared,
            self._flags,
            self._truth,
            self.options.samples_per_step,
            self.autoreset_mode is AutoresetMode.NEXT_STEP,
        )

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
        if (self._by_lane(self._counts, READY)[mask] == 0).any():
            self._draw()
        if mask.all():
            self._row = ROWS
        self._begin(mask)
        return self._tell(mask)

    def _tell(self, known: BoolArray | None = None) -> tuple[Observation, Info]:
        """Observation and info as the lanes stand."""
        observation, _ = self._empty()
        vector_kernel.observe(self._state, self.setup.observed, observation)
        flags = self._flags[:, : self.num_envs].copy()
        if known is not None:
            flags[KNOWN] = known
        return observation.T[: self.num_envs], self._info(flags)

    def _empty(self) -> tuple[NDArray[np.float32], FloatArray]:
        """Fresh arrays for observation and reward of all lanes, those that fill the last block too."""
        lanes = self._declared.size
        return np.empty((len(self.setup.chosen), lanes), dtype=np.float32), np.empty(lanes)

    def _info(self, flags: BoolArray) -> Info:
        """The truth, for those who score; what decides must not read it."""
        known, truth = flags[KNOWN], self._truth[:, : self.num_envs].copy()
        return {
            "class_index": truth[CLASS_INDEX],
            "_class_index": known,
            "onset_sample": truth[RUNNING_ONSET],
            "_onset_sample": known,
            "fault_active": flags[FAULT_ACTIVE],
            "_fault_active": known,
        }

    def _begin(self, mask: BoolArray) -> None:
        vector_kernel.begin_lanes(
            mask,
            self._state,
            self._noise,
            self._row,
            self._names,
            self.setup.constants,
            self._episodes,
            self._counts,
            self._flags,
            self._truth,
        )

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
                block, lane = divmod(n, LANES)
                self._seeds[n], self._names[block, INDEX, lane] = given, indices[n]
                self._counts[block, NUMBER, lane], self._counts[block, READY, lane] = -1, 0
        block, lane = np.divmod(everywhere, LANES)
        self._names[block, SEED_LOW, lane] = self._seeds & 0xFFFFFFFF
        self._names[block, SEED_HIGH, lane] = self._seeds >> 32

    def _draw(self) -> None:
        """Fill the rings of episodes: many at once, which costs little a lane."""
        assert self._seeds is not None  # noqa: S101  # set by reset
        ready, number = self._by_lane(self._counts, READY), self._by_lane(self._counts, NUMBER)
        slot, index = self._by_lane(self._counts, SLOT), self._by_lane(self._names, INDEX)
        missing = DEPTH - 1 - ready
        lanes = np.repeat(np.arange(self.num_envs), missing)
        first = np.repeat(np.cumsum(missing) - missing, missing)
        ahead = ready[lanes] + 1 + np.arange(len(lanes)) - first
        seeds = self._seeds[lanes]
        for seed in np.unique(seeds):
            chosen = seeds == seed
            some, offset = lanes[chosen], ahead[chosen]
            drawn = draw_episodes(self.setup, int(seed), index[some], number[some] + offset)
            place, (block, lane) = (slot[some] + offset) % DEPTH, np.divmod(some, LANES)
            self._episodes[block, place, lane] = drawn.records
            self._counts[block, RING + place, lane] = drawn.class_index
        block, lane = np.divmod(np.arange(self.num_envs), LANES)
        self._counts[block, READY, lane] = DEPTH - 1

    def _by_lane(self, array: NDArray[Any], row: int) -> IntArray:
        """A row of counts or names, one entry for each sub-environment."""
        return array[:, row].reshape(-1)[: self.num_envs].astype(np.int64)

    def _step_lanes(
        self, actions: Any, fixed: tuple[Any, ...], given: tuple[Any, ...]
    ) -> tuple[int, int, int]:
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
        if mode is AutoresetMode.DISABLED and self._flags[TERMINATED].any():
            raise gym.error.ResetNeeded("autoreset is disabled: reset the sub-environments that are over")
        lanes, reward = self._empty()
        self._row, n_over, n_unready = self._step_lanes(actions, self._fixed, (self._row, lanes, reward))
        if n_unready > 0:
            self._draw()
        flags = self._flags[:, : self.num_envs].copy()
        observation, info, terminated = lanes.T[: self.num_envs], self._info(flags), flags[TERMINATED]
        if n_over > 0 and mode is AutoresetMode.SAME_STEP:
            observation, info = self._reset_same_step(observation, info, terminated)
        return observation, reward[: self.num_envs], terminated, flags[TRUNCATED], info

    def _reset_same_step(
        self, last: Observation, last_info: Info, over: BoolArray
    ) -> tuple[Observation, Info]:
        """Begin the next episodes at once; the last observations and infos go into the info, in gymnasium's form."""
        self._begin(over)
        final = np.full(self.num_envs, None, dtype=object)
        for n in np.flatnonzero(over):
            final[n] = last[n].copy()
        masks = {name: over.copy() for name in last_info if name.startswith("_")}
        observation, info = self._tell()
        info.update(final_obs=final, _final_obs=over.copy(), final_info={**last_info, **masks})
        info["_final_info"] = over.copy()
        return observation, info


class DiscreteVectorEnv(MotorVectorEnv):
    """Sub-environments with a list of actions."""

    def _step_lanes(
        self, actions: Any, fixed: tuple[Any, ...], given: tuple[Any, ...]
    ) -> tuple[int, int, int]:
        array = np.asarray(actions)
        if array.shape != (self.num_envs,) or array.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers of shape ({self.num_envs},), got {array.dtype} {array.shape}"
            )
        array = np.ascontiguousarray(array, dtype=np.int64)
        result: tuple[int, int, int] = vector_kernel.step_discrete(
            array, self.setup.offsets_v, self._n_offsets, *fixed, *given
        )
        if result[0] < 0:
            highest = len(self.setup.offsets_v) - 1
            raise ValueError(f"actions must be in 0 .. {highest}, got {array.min()} .. {array.max()}")
        return result
