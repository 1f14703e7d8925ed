"""Many environments in one compiled step: what the vector twins share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from motor_env.envs import layout, stepping
from motor_env.envs.base import Info, Observation, discrete_actions, observation_space, reward_parts
from motor_env.envs.kernel import LANES, ROWS
from motor_env.envs.layout import WordArray, empty_lanes, pack_task
from motor_env.envs.options import MonitorOptions, Options, with_changes
from motor_env.envs.setup import Setup, make_setup
from motor_env.motor.parameters import FloatArray, require

BoolArray = NDArray[np.bool_]
Step = tuple[Observation, FloatArray, BoolArray, BoolArray, Info]


class StreamVectorEnv(VectorEnv[Observation, Any, NDArray[Any]], Generic[Options]):
    """Sub-environments that each run a stream of episodes of their own.

    The trajectory of sub-environment n depends on (options, seed, n) and the actions alone: not on the number of
    sub-environments, nor on what the others do. A single environment reset with that seed and `{"index": n}` runs
    the same. With a list of seeds, sub-environment n runs the stream (seeds[n], 0).
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # gymnasium's way
    options_type: type[Options]
    _words: WordArray
    _flags: BoolArray

    def __init__(
        self,
        num_envs: int = 1,
        options: Options | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        """Make the sub-environments.

        Args:
            num_envs: number of sub-environments.
            options: the task; the defaults of `options_type` unless given.
            autoreset_mode: what follows the end of an episode: `NextStep`, `SameStep` or `Disabled`.
            render_mode: None; a vector draws no pictures.
            changes: single options by name, on top.
        """
        num_envs = layout.require_whole("num_envs", num_envs, 32)
        require(num_envs >= 1, f"num_envs must be >= 1, got {num_envs}")
        require(render_mode is None, f"render_mode of a vector must be None, got {render_mode!r}")
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._seeded = False
        self.options = with_changes(options, self.options_type, changes)
        self.single_observation_space, self.single_action_space = self._set_up()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        """Make the lanes of `options`; the spaces of one of them."""
        raise NotImplementedError

    def _begin(self, mask: BoolArray) -> None:
        """Begin the next episode of the sub-environments in the mask."""
        raise NotImplementedError

    def _observed(self, known: BoolArray | None = None) -> tuple[Observation, Info]:
        """Observation and info as the lanes stand."""
        raise NotImplementedError

    def _step(self, actions: Any) -> tuple[Step, int]:
        """A step of every sub-environment, and how many episodes it ended."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin episodes.

        Args:
            seed: begins the streams of episodes anew; without it the next episode of each stream begins. A list has
                one seed, or None, for each sub-environment.
            options: `{"reset_mask": mask}` resets the sub-environments of the mask only.

        Raises:
            ValueError: the mask or the list of seeds is none, or a seed no whole number in 0 .. 2^64 - 1.
        """
        chosen = layout.reset_options(options)
        mask = self._checked_mask(chosen.pop("reset_mask", None))
        require(not chosen, f"reset knows the option reset_mask, got {', '.join(map(repr, chosen))}")
        if seed is not None and not isinstance(seed, list | tuple | np.ndarray):
            seed = layout.require_whole("seed", seed, 64)
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._take_seeds(seed, mask)
        self._begin(mask)
        return self._observed(mask)

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
            self._seeded or bool(array.all()),
            "reset_mask must not be given before the first reset of all sub-environments",
        )
        return array

    def _take_seeds(self, seed: int | Sequence[int | None] | None, mask: BoolArray) -> None:
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**63))
        self._seeded = True
        if seed is None:
            return
        if isinstance(seed, int):
            seeds, given = np.full(self.num_envs, seed, dtype=np.uint64), mask
            index = np.arange(self.num_envs)
        else:
            require(len(seed) == self.num_envs, f"seed must list {self.num_envs} seeds, got {len(seed)}")
            numbers = [0 if number is None else layout.require_whole("seed", number, 64) for number in seed]
            seeds = np.array(numbers, dtype=np.uint64)
            given = mask & np.array([number is not None for number in seed])
            index = np.zeros(self.num_envs, dtype=np.int64)
        layout.begin_streams(self._words[:, : self.num_envs], given, seeds, index)

    def step(self, actions: Any) -> Step:
        """A step of every sub-environment.

        Raises:
            ValueError: an action does not exist.
            ResetNeeded: before the first reset, or, with autoreset disabled, where an episode is over.
        """
        if not self._seeded:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._flags[layout.TERMINATED].any():
            raise gym.error.ResetNeeded("autoreset is disabled: reset the sub-environments that are over")
        (observation, reward, terminated, truncated, info), n_over = self._step(actions)
        if n_over > 0 and self.autoreset_mode is AutoresetMode.SAME_STEP:
            observation, info = self._reset_same_step(observation, info, terminated)
        return observation, reward, terminated, truncated, info

    def _reset_same_step(
        self, last: Observation, last_info: Info, over: BoolArray
    ) -> tuple[Observation, Info]:
        """Begin the next episodes at once; the last observations and infos go into the info, in gymnasium's form."""
        self._begin(over)
        final = np.full(self.num_envs, None, dtype=object)
        ended = np.flatnonzero(over)
        for n, row in zip(ended.tolist(), last[ended], strict=True):
            final[n] = row
        masks = {name: over.copy() for name in last_info if name.startswith("_")}
        observation, info = self._observed()
        info.update({name: value for name, value in last_info.items() if "reward" in name})
        info.update(final_obs=final, _final_obs=over.copy(), final_info={**last_info, **masks})
        info["_final_info"] = over.copy()
        return observation, info


class MotorVectorEnv(StreamVectorEnv[MonitorOptions]):
    """The compiled step over many lanes. The subclasses lay their actions into the lanes.

    Arrays that a step returns are new at each call; the observation is Fortran-ordered.
    """

    options_type = MonitorOptions

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        self.setup: Setup = make_setup(self.options)
        self._allocate()
        return observation_space(self.setup), self._actions()

    def _actions(self) -> spaces.Space[Any]:
        return discrete_actions(self.setup)

    @property
    def labels(self) -> tuple[str, ...]:
        """Label kind of every class: what the info's `class_index` points at."""
        return self.setup.labels

    @property
    def right_declaration(self) -> NDArray[np.int64]:
        """Number of the kind that is right for every class, 0 for healthy, as `setup.declarations` counts them."""
        return self.setup.right_declarations

    def _allocate(self) -> None:
        blocks = -(-self.num_envs // LANES)
        lanes = empty_lanes(blocks, blocks * LANES, self.options.precision)
        _, self._words, self._marks, self._flags, _ = lanes
        self._arrays = (*pack_task(self.setup.numbers), *lanes)
        self._part_names = reward_parts(self.options)
        self._n_offsets = len(self.setup.offsets_v) - len(self.setup.kinds)
        self._timing = (self.options.samples_per_step, self.autoreset_mode is AutoresetMode.NEXT_STEP)

    def _begin(self, mask: BoolArray) -> None:
        if mask.all():
            self._marks[layout.ROW] = ROWS
        stepping.begin_lanes(mask, *self._arrays)

    def _observed(self, known: BoolArray | None = None) -> tuple[Observation, Info]:
        observation, _ = self._empty()
        stepping.observe(observation, *self._arrays)
        flags = self._flags[:, : self.num_envs].copy()
        if known is not None:
            flags[layout.KNOWN] = known
        return observation.T[: self.num_envs], self._info(flags)

    def _empty(self) -> tuple[NDArray[np.float32], FloatArray]:
        """Fresh arrays for observation and reward of all lanes, those that fill the last block too."""
        lanes = self._flags.shape[1]
        return np.empty((len(self.setup.chosen), lanes), dtype=np.float32), np.empty(lanes)

    def _info(self, flags: BoolArray) -> Info:
        """The truth, for those who score; what decides must not read it."""
        known, truth = flags[layout.KNOWN], self._marks[: layout.RUNNING_ONSET + 1, : self.num_envs].copy()
        return {
            "class_index": truth[0],
            "_class_index": known,
            "onset_sample": truth[1],
            "_onset_sample": known,
            "fault_active": flags[layout.FAULT_ACTIVE],
            "_fault_active": known,
        }

    def _step_lanes(self, actions: Any, *outputs: NDArray[Any]) -> int:
        raise NotImplementedError

    def _step(self, actions: Any) -> tuple[Step, int]:
        lanes, reward = self._empty()
        parts = np.empty((len(self._part_names), len(reward)))
        n_over = self._step_lanes(actions, lanes, reward, parts)
        flags = self._flags[:, : self.num_envs].copy()
        observation, info = lanes.T[: self.num_envs], self._info(flags)
        for name, part in zip(self._part_names, parts, strict=True):
            info[name], info[f"_{name}"] = part[: self.num_envs], flags[layout.KNOWN]
        return (
            observation,
            reward[: self.num_envs],
            flags[layout.TERMINATED],
            flags[layout.TRUNCATED],
            info,
        ), n_over


def whole_actions(actions: Any, num_envs: int) -> NDArray[np.int64]:
    """Actions of a discrete space as an array.

    Raises:
        ValueError: no integers, or of another shape.
    """
    array = np.asarray(actions)
    if array.shape != (num_envs,) or array.dtype.kind not in "iu":
        raise ValueError(f"actions must be integers of shape ({num_envs},), got {array.dtype} {array.shape}")
    return np.ascontiguousarray(array, dtype=np.int64)


class DiscreteVectorEnv(MotorVectorEnv):
    """Sub-environments with a list of actions."""

    def _step_lanes(self, actions: Any, *outputs: NDArray[Any]) -> int:
        array = whole_actions(actions, self.num_envs)
        n_over: int = stepping.step_discrete(
            array, self.setup.offsets_v, self._n_offsets, *self._timing, *outputs, *self._arrays
        )
        if n_over < 0:
            highest = len(self.setup.offsets_v) - 1
            raise ValueError(f"actions must be in 0 .. {highest}, got {array.min()} .. {array.max()}")
        return n_over
