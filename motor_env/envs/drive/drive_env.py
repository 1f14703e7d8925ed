"""Drive: follow a speed with a motor that may be failing; limp or stop in time."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.envs import rendering
from motor_env.envs.drive import kernel
from motor_env.envs.drive.drive_setup import PARTS, DriveSetup, empty_lanes, make_setup
from motor_env.envs.drive.kernel import BEARING
from motor_env.envs.drive.options import LABELS, Control, DriveOptions
from motor_env.envs.layout import FAULT_ACTIVE, BoolArray
from motor_env.envs.rendering import GRID, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Frame, write, write_figures
from motor_env.envs.single import (
    EVERYWHERE,
    Info,
    Observation,
    StreamEnv,
    finite_action,
    refuse_actions,
    whole_action,
    whole_actions,
)
from motor_env.envs.vector import StreamVectorEnv
from motor_env.motor.parameters import FloatArray

RUN, LIMP, STOP = -1.0, 0.25, 1.0
"""Second entry of a command; the first is the voltage in units of its limit."""
DECISIONS = np.array([RUN, LIMP, STOP])


def _width(control: Control) -> int:
    return 2 if control is Control.VOLTAGE_AND_DECISION else 3


def action_space(control: Control) -> spaces.Space[Any]:
    """Actions of one sub-environment."""
    if control is Control.DECISION:
        return spaces.Discrete(len(DECISIONS))
    return spaces.Box(-1.0, 1.0, (_width(control),), dtype=np.float32)


def command(control: Control, action: Any) -> FloatArray:
    """Command of the one lane of a single environment, shape (1, 2).

    Raises:
        ValueError: there is no such action.
    """
    if control is Control.DECISION:
        return _decided(np.array([whole_action(action, len(DECISIONS))]))
    if control is Control.VOLTAGE_AND_DECISION:
        return finite_action(action, (2,))[None]
    return _from_numbers(finite_action(action, (3,))[None])


def commands(control: Control, actions: Any, count: int) -> FloatArray:
    """Commands of many lanes, shape (count, 2).

    Raises:
        ValueError: there are no such actions.
    """
    if control is Control.DECISION:
        decisions = whole_actions(actions, count, len(DECISIONS))
        if ((decisions < 0) | (decisions >= len(DECISIONS))).any():
            refuse_actions(decisions, len(DECISIONS))
        return _decided(decisions)
    return _from_numbers(finite_action(actions, (count, _width(control))))


def as_actions(control: Control, command_rows: FloatArray) -> NDArray[Any]:
    """Actions that give these commands, whose decisions are RUN, LIMP or STOP."""
    volts, decision = command_rows.T
    if control is Control.DECISION:
        return np.array(np.searchsorted(DECISIONS, decision))
    if control is Control.VOLTAGE_LIMP_STOP:
        return np.stack([volts, np.sign(decision), np.where(decision == STOP, 1.0, -1.0)], axis=1)
    return command_rows


def _decided(which: NDArray[np.int64]) -> FloatArray:
    return np.stack([np.zeros(len(which)), DECISIONS[which]], axis=1)


def _from_numbers(command_rows: FloatArray) -> FloatArray:
    """Voltage and decision; of three numbers the third stops, the second limps."""
    if command_rows.shape[1] == 2:
        return command_rows
    decision = np.where(command_rows[:, 2] > 0.5, STOP, np.where(command_rows[:, 1] > 0.0, LIMP, RUN))
    return np.stack([command_rows[:, 0], decision], axis=1)


_TRUTH = ("kind", "onset", "severity", "temperature")
REWARDS = tuple(f"reward_{part}" for part in PARTS)


def _spaces(setup: DriveSetup) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
    low, high = setup.view[1:].astype(np.float32)
    observations = cast("spaces.Space[Observation]", spaces.Box(low, high, dtype=np.float32))
    return observations, action_space(setup.options.control)


class DriveEnv(StreamEnv[DriveOptions]):
    """A DC motor that may be failing drives a machine along a speed profile. Follow it; limp or stop in time.

    ## Description
    The profile has plateaus and ramps. The load is a constant, a part with the square of the speed, and an unknown part
    that moves slowly. At an unknown time a bearing or a winding contact begins to fail, or neither does. Its severity
    grows exponentially at an unknown rate; that of a bearing grows faster under load and speed. A bad winding heats up.
    A motor whose severity or temperature is too large fails.

    ## Action Space
    `Discrete(3)`. The drive's own speed controller sets the voltage, and a decision holds for 0.1 s.

    | Num | Action |
    |---|---|
    | 0 | run |
    | 1 | limp: within 0.3 s the profile shrinks to half |
    | 2 | stop for good |

    With `control="voltage_limp_stop"` (DriveControl-v0) `Box(-1, 1, (3,))`: the voltage in units of the supply's limit;
    above 0 limps; above 0.5 stops. With `control="voltage_and_decision"` `Box(-1, 1, (2,))`: the voltage, and a
    decision: at most 0 runs, up to 0.5 limps, above 0.5 stops. Values outside are clipped.

    ## Observation Space
    `Box`, float32, finite, clipped at its bounds:

    | Num | Observation | Meaning | Min | Max |
    |---|---|---|---|---|
    | 0 | `measured_current` | what the sensor reads, in units of the current's limit | -1.5 | 1.5 |
    | 1 | `measured_speed` | what the sensor reads, in units of the top speed | -1.5 | 1.5 |
    | 2 | `estimated_load` | beyond the known load, as the healthy motor's filter has it; 1 is ten sd | -1.5 | 1.5 |
    | 3 | `innovation_current` | read minus expected, whitened | -10 | 10 |
    | 4 | `innovation_speed` | the same of the speed | -10 | 10 |
    | 5 | `slow_current` | weighted mean of the innovation over 0.3 s, scaled to a standard deviation of 1 | -10 | 10 |
    | 6 | `slow_speed` | the same of the speed | -10 | 10 |
    | 7 | `voltage` | of the last step, in units of its limit | -1 | 1 |
    | 8 | `estimated_temperature` | rise of a healthy winding's temperature, as a share of the failing one | 0 | 1.5 |
    | 9 | `scale` | share of the profile that is asked for now | 0 | 1 |
    | 10 | `time` | share of the horizon that has passed | 0 | 1 |
    | 11 | `profile_0` | scaled profile now, in units of the top speed | 0 | 1 |
    | 12 | `profile_1` | the same at the end of the next period | 0 | 1 |
    | 13 | `profile_5` | in 0.05 s | 0 | 1 |
    | 14 | `profile_10` | in 0.1 s | 0 | 1 |
    | 15 | `profile_20` | in 0.2 s | 0 | 1 |

    ## Rewards
    By default (`DriveOptions`); heat and wear are charged where the episode ends: step by step they would tell of the
    fault.

    | Event | Reward |
    |---|---|
    | a second of the squared error of the speed, in units of the top speed; a second costs at most 3 | -300 |
    | a second of a kelvin beyond 70 K | -0.05 |
    | a bearing wears from new to failure | -1 |
    | a second of limping | -0.2 |
    | each second left when the motor stops or fails | -1 |
    | a failure, besides | -6 |

    ## Starting State
    A healthy motor turns at the first speed of a profile that is drawn. Class, onset, growth and profile follow from
    the seed alone.

    ## Episode End
    Stopping, a failure, or the horizon (80 decisions of 0.1 s), all as `terminated`. `truncated` is always False.

    ## Information
    The truth, for scoring: `label`, `class_index`, `onset_step` (-1: no fault), `fault_active`, `severity`,
    `temperature_k`. The parts of the reward: `reward_tracking`, `reward_heat`, `reward_wear`, `reward_limp`,
    `reward_stop`, `reward_failure`.

    ## Arguments
    Any option of `DriveOptions` by name, and `render_mode`: `rgb_array` or `human` (a window, needs pygame). A reset
    with a seed and `options={"index": n}` begins the stream of sub-environment n of a vector.

    ```python
    env = gym.make("motor_env/Drive-v0", weights=(1.0, 2.0, 0.0), render_mode="rgb_array")
    ```

    ## Vectorized environment
    `gym.make_vec("motor_env/Drive-v0", num_envs=1024)` is compiled: all sub-environments step in one call.

    ## Version History
    * v0: first version.
    """

    options_type = DriveOptions

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        self.setup = make_setup(self.options)
        self.observed = self.setup.observed
        self._lanes = empty_lanes(self.setup.ahead, self.options.n_steps, 1)
        self._words, self._flags = self._lanes.words, self._lanes.flags
        self._arrays = (np.array(self.setup.task), *self._lanes)
        self._parts, self._reward = np.zeros((len(PARTS), 1)), np.zeros(1)
        self._make_views()
        self._screen = DriveScreen(self.setup) if self.render_mode is not None else None
        return _spaces(self.setup)

    def _make_views(self) -> None:
        # Once and not in each step, where they would take a tenth of the time.
        self._truth = {name: self._lanes.state[name].reshape(-1) for name in _TRUTH}
        self._part_values = self._parts.reshape(-1)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make_views()  # a copy of a view is no view

    def _begin(self) -> tuple[Observation, Info]:
        kernel.begin(EVERYWHERE, *self._arrays)
        observation = np.empty((len(self.setup.observed), 1), dtype=np.float32)
        kernel.observe(self._lanes.state, self.setup.view, observation)
        self._over = False
        if self._screen is not None:
            self._screen.begin(self._lanes.profile[0])
        return observation[:, 0], self._info()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """Apply a voltage for a step, or stop the motor, which ends the episode.

        Raises:
            ValueError: the action has another shape, or a value that is not finite.
            ResetNeeded: the episode is over.
        """
        if self._over:
            raise gym.error.ResetNeeded("call reset() before step(): the episode is over")
        command_rows = command(self.options.control, action)
        observation = np.empty((len(self.setup.observed), 1), dtype=np.float32)
        self._over = bool(
            kernel.step(
                command_rows, False, self.setup.view, observation, self._reward, self._parts, *self._arrays
            )
        )
        info = self._info()
        info.update(zip(REWARDS, self._part_values.tolist(), strict=True))
        if self._screen is not None:
            self._screen.add(self._lanes.state[0])
            if self.render_mode == "human":
                self.render()
        return observation[:, 0], self._reward.item(), self._over, False, info

    def _info(self) -> Info:
        kind = int(self._truth["kind"].item(0))
        return {
            "label": LABELS[kind],
            "class_index": kind,
            "onset_step": int(self._truth["onset"].item(0)),
            "fault_active": self._flags.item(FAULT_ACTIVE, 0),
            "severity": self._truth["severity"].item(0),
            "temperature_k": self._truth["temperature"].item(0),
        }


class DriveVectorEnv(StreamVectorEnv[DriveOptions]):
    """Vector of `DriveEnv`: sub-environment n runs the stream of episodes (seed, n)."""

    options_type = DriveOptions
    part_names = REWARDS
    by_class = {"label": np.array(LABELS, dtype=object)}  # noqa: RUF012  # never written to

    def _set_up(self) -> tuple[spaces.Space[Observation], spaces.Space[Any]]:
        self.setup = make_setup(self.options)
        self._lanes = empty_lanes(self.setup.ahead, self.options.n_steps, self.num_envs)
        self._words, self._flags = self._lanes.words, self._lanes.flags
        self._arrays = (np.array(self.setup.task), *self._lanes)
        return _spaces(self.setup)

    def truth(self, name: str) -> FloatArray:
        """A row of the lanes as it stands, for scoring, shape (num_envs,).

        Args:
            name: `current`, `speed`, `load`, `temperature`, `severity`, `kind`, `onset`, `growth`, or an observed
                number, in SI units.
        """
        row: FloatArray = self._lanes.state[name].reshape(-1)[: self.num_envs].copy()
        return row

    def _begin(self, mask: BoolArray) -> None:
        kernel.begin(mask, *self._arrays)

    def _write(self, observation: NDArray[np.float32]) -> None:
        kernel.observe(self._lanes.state, self.setup.view, observation)

    def _truth(self, active: BoolArray) -> Info:
        return {
            "class_index": self.truth("kind").astype(np.int64),
            "onset_step": self.truth("onset").astype(np.int64),
            "fault_active": active,
            "severity": self.truth("severity"),
            "temperature_k": self.truth("temperature"),
        }

    def _step(self, actions: Any) -> tuple[Observation, FloatArray, FloatArray, int]:
        command_rows = commands(self.options.control, actions, self.num_envs)
        observation, reward = self._empty(), np.empty(self.num_envs)
        parts = np.empty((len(PARTS), self.num_envs))
        n_over = kernel.step(
            command_rows, self._next_step, self.setup.view, observation, reward, parts, *self._arrays
        )
        return observation.T, reward, parts, n_over


_GAP = 18
_SHOWN = ("speed", "current", "voltage", "temperature", "severity", "scale")


class DriveScreen:
    """Keeps an episode and draws it, with the truth, which the agent does not observe."""

    def __init__(self, setup: DriveSetup) -> None:
        self.setup = setup

    def begin(self, profile: FloatArray) -> None:
        """Begin an episode with that profile."""
        self._profile = profile[1 : self.setup.options.n_steps + 1].copy()
        self._rows: list[list[float]] = []
        self._kind = self._onset = 0

    def add(self, lanes: np.void) -> None:
        """Add the first lane of a block after a step."""
        row = [lanes[name].item(0) for name in _SHOWN]
        # What a decision shows is its last period.
        self._rows += [row] * self.setup.options.steps_per_decision
        self._kind, self._onset = int(lanes["kind"].item(0)), int(lanes["onset"].item(0))

    def draw(self) -> Frame:
        """Draw the screen, shape (HEIGHT, WIDTH, 3)."""
        options, frame = self.setup.options, rendering.blank_screen()
        speed, current, voltage, heat, severity, scale = np.array(self._rows).reshape(-1, len(_SHOWN)).T
        asked = self._profile.copy()
        asked[: len(scale)] *= scale
        failure = options.failure_severity[max(self._kind - 1, 0)]
        panels = (
            ("speed", "rad/s", options.top_speed_rad_s, ((asked, "estimate"), (speed, "speed"))),
            ("voltage", "V", options.voltage_limit_v, ((voltage, "residual"),)),
            ("current", "A", options.current_limit_a, ((current, "current"),)),
            (
                "winding",
                "K",
                options.burn_k,
                ((np.full(len(asked), options.warm_k), "threshold"), (heat, "winding")),
            ),
            ("severity", "", failure, ((severity, "bearing" if self._kind == BEARING else "winding"),)),
        )
        height = (HEIGHT - TOP - 30) // len(panels) - _GAP
        for place, (name, unit, most, traces) in enumerate(panels):
            top = TOP + place * (height + _GAP)
            panel = frame[top : top + height, LEFT : WIDTH - RIGHT]
            panel[:: height // 2] = GRID
            write(frame, name, (6, top), "ink", size_px=12)
            write_figures(frame, f"{most:.3g} {unit}", (6, top + 16), "dim", size_px=11)
            for values, colour in traces:
                rendering.draw_trace(panel, self._columns(values, panel.shape[1]), (0.0, 1.1 * most), colour)
        self._head(frame, LABELS[self._kind])
        return frame

    def _columns(self, values: FloatArray, width: int) -> FloatArray:
        """One value a column of the screen."""
        at = np.arange(width) * self.setup.options.n_steps // width
        return values[at[at < len(values)]]

    def _head(self, frame: Frame, label: str) -> None:
        options, steps = self.setup.options, len(self._rows)
        write(frame, "drive", (6, 8), "ink", size_px=16)
        write_figures(frame, f"{steps * options.period_s:6.2f} s", (80, 8), "ink", size_px=16)
        last = dict(
            zip(_SHOWN, self._rows[-1] if self._rows else (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), strict=True)
        )
        if last["scale"] < 1.0:
            write(frame, "limps", (200, 8), "residual", size_px=16)
        if last["severity"] > 0.0:
            write(frame, label.replace("_", " "), (300, 8), "threshold", size_px=16)
            x = LEFT + self._onset * (WIDTH - LEFT - RIGHT) // options.n_steps
            rendering.mark_moment(frame, x)
        write(frame, f"0 to {options.horizon_s:g} s", (WIDTH - RIGHT - 80, HEIGHT - 24), "dim", size_px=12)
