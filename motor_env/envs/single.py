"""Base of the single environments: episodes, the compiled step, observations, info; checks of actions."""

from __future__ import annotations

import math
import operator
from typing import Any, Generic, NoReturn, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.ma import MaskedArray
from numpy.typing import NDArray

from motor_env.common.arrays import is_one_of, numbers, shown, whole, wholes
from motor_env.envs import layout, stepping
from motor_env.envs.layout import ROWS, WordArray, empty_lanes, pack_task
from motor_env.envs.options import MonitorOptions, Options, with_changes
from motor_env.envs.rendering import Scope, Window
from motor_env.envs.setup import Setup, make_bank, make_setup
from motor_env.motor.model import State
from motor_env.motor.parameters import FloatArray, require

Observation = NDArray[np.float32]
Info = dict[str, Any]
EVERYWHERE = np.ones(1, dtype=np.bool_)
RENDER_MODES = ("rgb_array", "human")
DOUBLE, LONG = np.dtype(np.float64), np.dtype(np.int64)


def observation_space(setup: Setup) -> spaces.Space[Observation]:
    """Box of the chosen features."""
    high = setup.view[1, setup.chosen].astype(np.float32)
    low = np.where(np.array(setup.observed) == "time", 0.0, -high).astype(np.float32)
    return cast("spaces.Space[Observation]", spaces.Box(low, high, dtype=np.float32))


def discrete_actions(setup: Setup) -> spaces.Discrete:
    """One action a voltage, then one a kind."""
    return spaces.Discrete(len(setup.offsets_v))


def reward_parts(options: MonitorOptions) -> tuple[str, ...]:
    """Names of the parts of a reward in the info; their sum is the reward."""
    parts = ("reward_verdict", "reward_delay", "reward_probe", "reward_energy")
    return parts if options.moves_voltage else parts[:2]


class StreamEnv(gym.Env[Observation, Any], Generic[Options]):
    """An environment that runs the stream of episodes (seed, index).

    Args:
        options: the task; the defaults of `options_type` unless given.
        render_mode: see the metadata.
        changes: single options by name, on top.

    Attributes:
        observed: names of the numbers of an observation.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012  # gymnasium's way
    options_type: type[Options]
    observed: tuple[str, ...]
    _words: WordArray

    def __init__(
        self, options: Options | None = None, *, render_mode: str | None = None, **changes: Any
    ) -> None:
        require(
            render_mode is None or is_one_of(render_mode, RENDER_MODES),
            f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {shown(render_mode)}",
        )
        self.render_mode = render_mode
        self._seed: int | None = None
        self._window: Any = None
        self._screen: Any = None  # what draws an episode: there is one with every render mode
        self._over = True
        self.options = with_changes(options, self.options_type, changes)
        self.observation_space, self.action_space = self._set_up()

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        """Make the lane of `options`; return observation and action space."""
        raise NotImplementedError

    def _begin(self) -> tuple[Observation, Info]:
        """Begin the next episode of the stream."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode.

        Args:
            seed: begins the stream anew; without it the next episode of the stream begins.
            options: `{"index": n}`, with a seed: the stream of sub-environment n of a vector with that seed.

        Raises:
            ValueError: the seed is no whole number in 0 .. 2^64 - 1, an option is unknown or out of range.
        """
        chosen = layout.reset_options(options)
        index = chosen.pop("index", None)
        require(not chosen, f"reset knows the option index, got {', '.join(map(repr, chosen))}")
        require(index is None or seed is not None, "the reset option index needs a seed")
        index = 0 if index is None else layout.require_whole("index", index, 32)
        seed = None if seed is None else layout.require_whole("seed", seed, 64)
        super().reset(seed=seed)
        if seed is not None or self._seed is None:
            self._seed = seed if seed is not None else int(self.np_random.integers(2**63))
            seeds, indices = np.array([self._seed], np.uint64), np.array([index], np.int64)
            layout.begin_streams(self._words, EVERYWHERE, seeds, indices)
        return self._begin()

    def render(self) -> Any:
        """Draw the screen: an array of shape (height, width, 3), or None where it went to the window.

        Raises:
            DependencyNotInstalled: a window is wanted and pygame is not there.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode: give gym.make a render_mode, for example rgb_array"
            )
            return None
        frame = self._screen.draw()
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window(frame.shape[1], frame.shape[0], frames_per_s=self.metadata["render_fps"])
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None


class MotorEnv(StreamEnv[MonitorOptions]):
    """Base of Monitor and Probe: discrete actions that apply a voltage, or declare a kind."""

    options_type = MonitorOptions

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        options = self.options
        self.setup: Setup = make_setup(options)
        self.observed = self.setup.observed
        numbers = self.setup.numbers
        if self.render_mode is not None:  # the picture shows the evidence of all kinds
            bank = make_bank(options, self.setup.belief.model, self.setup.rest)
            constants = numbers.constants.copy()
            constants[layout.FULL] = 1.0
            numbers = numbers._replace(bank=bank, constants=constants)
        lanes = empty_lanes(1, 1, options.precision)
        self._state, self._words, self._marks, _, self._drawn = lanes
        self._arrays = (*pack_task(numbers, options.precision), *lanes)
        self._parts = np.empty((4, 1))
        self._truth: Info = {}
        self._offsets_v: list[float] = self.setup.offsets_v.tolist()
        self._declarations: list[int] = self.setup.declarations.tolist()
        self._screen = Scope(self.setup) if self.render_mode is not None else None
        self._moves_voltage = options.moves_voltage
        self._samples, self._n_observed = options.samples_per_step, len(self.setup.chosen)
        return observation_space(self.setup), self._actions()

    def _actions(self) -> spaces.Space[Any]:
        return discrete_actions(self.setup)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """Apply a voltage (waiting is one), or declare a kind, which ends the episode.

        Raises:
            ValueError: there is no such action.
        """
        which = whole_action(action, len(self._offsets_v))
        return self._advance(self._offsets_v[which], self._declarations[which])

    def _begin(self) -> tuple[Observation, Info]:
        self._marks[layout.ROW] = ROWS
        stepping.begin_lanes(EVERYWHERE, *self._arrays)
        which, onset = self._marks.item(layout.CLASS_INDEX), self._marks.item(layout.RUNNING_ONSET)
        self._truth = {
            "label": self.setup.labels[which],
            "severity": self._drawn.item(0),
            "class_index": which,
            "onset_sample": onset,
        }
        observation = np.empty(len(self.setup.chosen), dtype=np.float32)
        stepping.observe(observation.reshape(-1, 1), *self._arrays)
        self._over = False
        if self._screen is not None:
            self._screen.clear()
            self._show()
        return observation, {**self._truth, "fault_active": False}

    def _advance(self, offset_v: float, declared: int) -> tuple[Observation, float, bool, bool, Info]:
        if self._over:
            raise gym.error.ResetNeeded("call reset() before step(): the episode is over")
        observation = np.empty(self._n_observed, dtype=np.float32)
        reward, self._over, fault_active, parts = stepping.step_single(
            offset_v, declared, self._samples, observation, self._parts, *self._arrays
        )
        if self._screen is not None:
            if self._over:
                self._screen.verdict, self._screen.good = self._verdict(self._marks.item(layout.DECLARED))
            self._show()
        info = {
            **self._truth,
            "fault_active": fault_active,
            "reward_verdict": parts[0],
            "reward_delay": parts[1],
        }
        if self._moves_voltage:
            info["reward_probe"], info["reward_energy"] = parts[2], parts[3]
        return observation, reward, self._over, False, info

    def _now(self, field: str) -> Any:
        """A field of the lane, see `layout.block_type`."""
        block = self._state.view(layout.block_type(self.options.precision))[0]
        return block[field][..., 0].tolist()

    def _verdict(self, declared: int) -> tuple[str, bool]:
        """Verdict of the episode in words, and whether it is right."""
        onset = self._now("onset")
        if declared == 0:
            missed = onset < self.options.n_samples
            return ("fault missed" if missed else "rightly silent"), not missed
        kind = self.setup.kinds[declared - 1]
        if self._now("time") - self._samples <= onset:
            return f"{kind}: false alarm", False
        right = declared == self._now("kind")
        return f"{kind}: {'right' if right else 'wrong kind'}", right

    def _show(self) -> None:
        """Add the sample to the scope; in a window, draw it."""
        scope, rest = self._screen, self.setup.rest
        scope.add(
            self._now("measured_current") + rest[State.CURRENT],
            self._now("estimated_current") + rest[State.CURRENT],
            self._now("estimated_speed") + rest[State.SPEED],
            self._now("voltage") + float(self.options.task.supply.voltage_v),
            self._now("innovation_current") / self._samples**0.5,
            *self._now("evidence"),
        )
        if self._truth["onset_sample"] >= 0:
            scope.onset_step = self._truth["onset_sample"] // self._samples
        if self.render_mode == "human" and scope.step % scope.per_column == 0:
            self.render()


def whole_action(action: Any, count: int) -> int:
    """An action of a discrete space as a number.

    Raises:
        ValueError: there is no such action.
    """
    if type(action) is int and 0 <= action < count:
        return action
    try:
        number = -1 if type(action) in _NO_INDICES else operator.index(action)
    except TypeError:  # 1.9 and "1" are not 1
        number = -1
    if not 0 <= number < count:
        return whole("action", action, most=count - 1)  # has the sentence
    return number


_NO_INDICES = (bool, MaskedArray)  # though Python takes them for such


def whole_actions(actions: Any, num_envs: int, count: int) -> NDArray[np.int64]:
    """Actions of a discrete space, one for each sub-environment, as an array; the compiled step checks NumPy's range.

    Raises:
        ValueError: no integers, or of another shape.
    """
    wanted = f"actions must be integers of shape ({num_envs},)"
    if type(actions) is not np.ndarray or actions.dtype.kind not in "iu":
        try:
            actions = wholes("actions", actions, most=count - 1)
        except ValueError as error:
            raise ValueError(f"{wanted}: {error}") from None
    if actions.shape != (num_envs,):
        raise ValueError(f"{wanted}, got shape {actions.shape}")
    checked: NDArray[np.int64] = actions
    if actions.dtype != LONG or not actions.flags.carray:  # else the step would be compiled anew for it
        checked = actions.astype(LONG, order="C")
    return checked


def refuse_actions(actions: NDArray[np.int64], count: int) -> NoReturn:
    """Raise the `ValueError` about actions outside 0 .. count - 1."""
    raise ValueError(f"actions must be in 0 .. {count - 1}, got {actions.min()} .. {actions.max()}")


def finite_action(action: Any, shape: tuple[int, ...] | None) -> FloatArray:
    """An action of a continuous space, or one for each sub-environment, as an array.

    Raises:
        ValueError: it has another shape, or a number that is not finite.
    """
    if type(action) is not np.ndarray or action.shape != shape or action.dtype.kind not in "iuf":
        action = _as_numbers(action, shape)
    checked: FloatArray = action.astype(DOUBLE, order="C")
    # numpy takes a microsecond for what a single environment's few numbers need
    if not (all(map(math.isfinite, checked.tolist())) if checked.ndim == 1 else np.isfinite(checked).all()):
        entry = checked[~np.isfinite(checked)][0]
        raise ValueError(f"action must be finite and have shape {shape}, got {entry:g} in it")
    return checked


def _as_numbers(action: Any, shape: tuple[int, ...] | None) -> FloatArray:
    """The action as an array of that shape, or the sentence about it."""
    wanted = f"action must be finite and have shape {shape}"
    try:
        array = numbers("action", action)
    except ValueError as error:
        raise ValueError(f"{wanted}: {error}") from None
    if array.shape != shape:
        raise ValueError(f"{wanted}, got shape {array.shape}")
    return array
