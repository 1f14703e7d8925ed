"""Base of the vector environments: many sub-environments in one compiled step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from motor_env.common.arrays import is_one_of, shown
from motor_env.envs import layout, stepping
from motor_env.envs.layout import LANES, ROWS, WordArray, empty_lanes, pack_task
from motor_env.envs.options import MonitorOptions, Options, with_changes
from motor_env.envs.setup import Setup, make_setup
from motor_env.envs.single import (
    Info,
    Observation,
    discrete_actions,
    observation_space,
    refuse_actions,
    reward_parts,
    whole_actions,
)
from motor_env.motor.parameters import FloatArray, require

BoolArray = NDArray[np.bool_]
Step = tuple[Observation, FloatArray, BoolArray, BoolArray, Info]


class LateInfo(dict[str, Any]):
    """A dictionary that is filled at its first use: labels and masks take half as long as a step.

    Attributes:
        fill: a function and its arguments, arrays that no step writes to again.
    """

    __slots__ = ("fill",)
    fill: tuple[Any, ...] | None

    def _filled(self) -> dict[str, Any]:
        if self.fill is not None:
            (function, *arguments), self.fill = self.fill, None
            dict.update(self, function(*arguments))
        return self

    def __reduce__(self) -> Any:
        return dict, (dict(self),)


def _after_filling(method: Any) -> Any:
    def call(self: LateInfo, *args: Any, **named: Any) -> Any:
        return method(self._filled(), *args, **named)

    return call


_LOOKS_AT_NOTHING = "__class_getitem__ __doc__ __getattribute__ __hash__ __init__ __new__ fromkeys"
for _name in vars(dict).keys() - set(_LOOKS_AT_NOTHING.split()):
    setattr(LateInfo, _name, _after_filling(getattr(dict, _name)))


def _full_info(
    truth: Info,
    by_class: dict[str, NDArray[Any]],
    names: Sequence[str],
    parts: Sequence[Any],
    known: BoolArray,
) -> Info:
    """Info from truth, columns by class, and parts of the reward; with gymnasium's masks."""
    info = truth | {name: values.take(truth["class_index"]) for name, values in by_class.items()}
    info |= zip(names, parts, strict=False)  # a reset has no parts
    return info | {f"_{name}": known for name in info}


class StreamVectorEnv(VectorEnv[Observation, Any, NDArray[Any]], Generic[Options]):
    """Sub-environments that each run a stream of episodes of their own.

    The trajectory of sub-environment n depends on (options, seed, n) and its actions alone. A single environment reset
    with that seed and `{"index": n}` runs the same. With a list of seeds, sub-environment n runs the stream
    (seeds[n], 0).

    The info is that of a single environment, with masks; under the autoreset mode SameStep it has no `label`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # gymnasium's way
    options_type: type[Options]
    _words: WordArray
    _flags: BoolArray
    by_class: dict[str, NDArray[Any]] = {}  # noqa: RUF012  # never written to
    """Columns of the info by class."""
    part_names: tuple[str, ...]

    def __init__(
        self,
        num_envs: int = 1,
        options: Options | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **changes: Any,
    ) -> None:
        """Make the sub-environments.

        Args:
            num_envs: number of sub-environments.
            options: the task; the defaults of `options_type` unless given.
            autoreset_mode: `NextStep`, `SameStep` or `Disabled`.
            render_mode: None; a vector draws no pictures.
            max_episode_steps: steps until an episode is truncated; None: never.
            changes: single options by name, on top.
        """
        num_envs = layout.require_whole("num_envs", num_envs, 32)
        require(num_envs >= 1, f"num_envs must be >= 1, got {num_envs}")
        require(render_mode is None, f"render_mode of a vector must be None, got {render_mode!r}")
        self.num_envs = num_envs
        modes = [mode.value for mode in AutoresetMode]
        known = isinstance(autoreset_mode, AutoresetMode) or is_one_of(autoreset_mode, modes)
        require(known, f"autoreset_mode must be one of {', '.join(modes)}, got {shown(autoreset_mode)}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if max_episode_steps is not None:
            max_episode_steps = layout.require_whole("max_episode_steps", max_episode_steps, 32)
            require(max_episode_steps >= 1, f"max_episode_steps must be >= 1, got {max_episode_steps}")
        self._longest, self._elapsed = max_episode_steps or 0, np.zeros(num_envs, dtype=np.int64)
        self._next_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._seeded = False
        self.options = with_changes(options, self.options_type, changes)
        self.single_observation_space, self.single_action_space = self._set_up()
        (self._n_observed,) = self.single_observation_space.shape or (0,)
        self._without_text = {name: each for name, each in self.by_class.items() if each.dtype != object}
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        """Make the lanes of `options`; return observation and action space of a lane."""
        raise NotImplementedError

    def _begin(self, mask: BoolArray) -> None:
        """Begin the next episode of the sub-environments in the mask."""
        raise NotImplementedError

    def _write(self, observation: NDArray[np.float32]) -> None:
        """Write the current observation, one row a feature."""
        raise NotImplementedError

    def _observe(self) -> Observation:
        observation = self._empty()
        self._write(observation)
        return observation.T[: self.num_envs]

    def _empty(self) -> NDArray[np.float32]:
        """A new array for the observation, with the lanes that fill the last block."""
        return np.empty((self._n_observed, self._flags.shape[1]), dtype=np.float32)

    def _truth(self, active: BoolArray) -> Info:
        """The current truth, for scoring; what decides must not read it."""
        raise NotImplementedError

    def _step(self, actions: Any) -> tuple[Observation, FloatArray, FloatArray, int]:
        """Step every sub-environment: observation, reward, its parts, and how many episodes ended."""
        raise NotImplementedError

    def _info(self, flags: BoolArray, parts: Any = ()) -> Info:
        """Info of a step, or of a reset without parts."""
        truth, known = self._truth(flags[layout.FAULT_ACTIVE]), flags[layout.KNOWN]
        if self.autoreset_mode is AutoresetMode.SAME_STEP:  # TorchRL reads these, and can read no text
            return _full_info(truth, self._without_text, self.part_names, parts, known)
        info = LateInfo()
        info.fill = (_full_info, truth, self.by_class, self.part_names, parts, known)
        return info

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin episodes.

        Args:
            seed: begins the streams anew; without it the next episode of each stream begins. A list has one seed, or
                None, for each sub-environment.
            options: `{"reset_mask": mask}` resets the sub-environments of the mask only.

        Raises:
            ValueError: the mask or the list of seeds is none, or a seed no whole number in 0 .. 2^64 - 1.
        """
        chosen = layout.reset_options(options)
        mask = self._checked_mask(chosen.pop("reset_mask", None))
        require(not chosen, f"reset knows the option reset_mask, got {', '.join(map(repr, chosen))}")
        are_several = isinstance(seed, list | tuple) or getattr(seed, "ndim", 0) > 0
        if seed is not None and not are_several:
            seed = layout.require_whole("seed", seed, 64)
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._take_seeds(seed, mask)
        self._elapsed[mask] = 0
        self._begin(mask)
        flags = self._flags[:, : self.num_envs].copy()
        flags[layout.KNOWN] = mask
        return self._observe(), self._info(flags)

    def _checked_mask(self, mask: Any) -> BoolArray:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        is_list = isinstance(mask, list | tuple) and all(isinstance(flag, bool | np.bool_) for flag in mask)
        array: Any = np.array(mask) if is_list else mask
        is_array = type(array) is np.ndarray
        require(
            is_array and array.shape == (self.num_envs,) and array.dtype == np.bool_ and bool(array.any()),
            f"reset_mask must be a boolean array of shape ({self.num_envs},) with a True in it, "
            f"got {f'{array.dtype} {array.shape}' if is_array else type(mask).__name__}",
        )
        require(
            self._seeded or bool(array.all()),
            "reset_mask must not be given before the first reset of all sub-environments",
        )
        checked: BoolArray = array
        return checked

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
        """Step every sub-environment.

        Raises:
            ValueError: an action does not exist.
            ResetNeeded: before the first reset, or, with autoreset disabled, where an episode is over.
        """
        if not self._seeded:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._flags[layout.TERMINATED].any():
            raise gym.error.ResetNeeded("autoreset is disabled: reset the sub-environments that are over")
        begun = self._flags[layout.TERMINATED, : self.num_envs].copy() if self._longest else None
        observation, reward, parts, n_over = self._step(actions)
        flags = self._flags[:, : self.num_envs].copy()
        over = flags[layout.TERMINATED]
        if begun is not None:
            over = over | self._truncated(begun, flags)
            n_over = int(over.sum())
        info = self._info(flags, parts)
        if n_over > 0 and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = self._final(observation, info, over)
            self._elapsed[over] = 0
            self._begin(over)
            observation = self._observe()
            info = self._info(self._flags[:, : self.num_envs].copy(), parts) | final
        return observation, reward, flags[layout.TERMINATED], flags[layout.TRUNCATED], info

    def _truncated(self, begun: BoolArray, flags: BoolArray) -> BoolArray:
        """Count the steps, and flag what is truncated; `begun`: an episode has begun in this step."""
        self._elapsed += 1
        self._elapsed[begun] = 0
        truncated: BoolArray = self._elapsed >= self._longest
        flags[layout.TRUNCATED] = truncated
        self._flags[layout.TERMINATED, : self.num_envs] |= (
            truncated  # so that a compiled step begins the next one
        )
        return truncated

    def _final(self, last: Observation, last_info: Info, over: BoolArray) -> Info:
        """The last observations and infos of the episodes that are over, in gymnasium's form."""
        observations, known = np.full(self.num_envs, None, dtype=object), over.copy()
        ended = np.flatnonzero(over)
        for n, row in zip(ended.tolist(), last[ended], strict=True):
            observations[n] = row
        info = last_info | {name: known for name in last_info if name.startswith("_")}
        return {"final_obs": observations, "_final_obs": known, "final_info": info, "_final_info": known}


class MotorVectorEnv(StreamVectorEnv[MonitorOptions]):
    """Base of the vectors of Monitor and Probe. A step returns new arrays; the observation is Fortran-ordered."""

    options_type = MonitorOptions

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        self.setup: Setup = make_setup(self.options)
        blocks = -(-self.num_envs // LANES)
        lanes = empty_lanes(blocks, blocks * LANES, self.options.precision)
        self._words, self._marks, self._flags = lanes.words, lanes.marks, lanes.flags
        self._drawn, classes = lanes.drawn, self.options.task.classes
        self.by_class = {"label": np.array(self.setup.labels, dtype=object)}
        self._is_drawn = any(c.severity_to is not None for c in classes)
        if not self._is_drawn:
            self.by_class["severity"] = np.array([c.severity for c in classes], dtype=np.float64)
        self._arrays = (*pack_task(self.setup.numbers, self.options.precision), *lanes)
        self.part_names = reward_parts(self.options)
        self._n_offsets = len(self.setup.offsets_v) - len(self.setup.kinds)
        self._timing = (self.options.samples_per_step, self._next_step)
        return observation_space(self.setup), self._actions()

    def _actions(self) -> spaces.Space[Any]:
        return discrete_actions(self.setup)

    def _begin(self, mask: BoolArray) -> None:
        if mask.all():
            self._marks[layout.ROW] = ROWS
        stepping.begin_lanes(mask, *self._arrays)

    def _write(self, observation: NDArray[np.float32]) -> None:
        stepping.observe(observation, *self._arrays)

    def _truth(self, active: BoolArray) -> Info:
        marks = self._marks[: layout.RUNNING_ONSET + 1, : self.num_envs].copy()
        truth = {"class_index": marks[0], "onset_sample": marks[1], "fault_active": active}
        if self._is_drawn:
            truth["severity"] = self._drawn[: self.num_envs, 0].copy()
        return truth

    def _step(self, actions: Any) -> tuple[Observation, FloatArray, FloatArray, int]:
        observation = self._empty()
        reward = np.empty(observation.shape[1])
        parts = np.empty((len(self.part_names), len(reward)))
        n_over = self._step_lanes(actions, observation, reward, parts)
        n = self.num_envs
        return observation.T[:n], reward[:n], parts[:, :n], n_over

    def _step_lanes(self, actions: Any, *outputs: NDArray[Any]) -> int:
        array = whole_actions(actions, self.num_envs, len(self.setup.offsets_v))
        n_over: int = stepping.step_discrete(
            array, self.setup.offsets_v, self._n_offsets, *self._timing, *outputs, *self._arrays
        )
        if n_over < 0:
            refuse_actions(array, len(self.setup.offsets_v))
        return n_over
