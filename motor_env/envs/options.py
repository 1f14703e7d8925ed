"""Options of Monitor, and what the options of all environments share."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from motor_env.common.arrays import shown
from motor_env.common.errors import UnknownOptionError
from motor_env.motor.data_sheet import Motor, load_motor, usable_parameters
from motor_env.motor.parameters import (
    CATALOGUE,
    PAPER_MOTOR,
    Channel,
    FloatArray,
    MotorParameters,
    SupplyParameters,
    require,
    require_numbers,
    require_positive,
)
from motor_env.motor.toml_files import from_dict
from motor_env.simulation.named_recipes import load_recipe, motor_recipe
from motor_env.simulation.recipes import Recipe

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def described(kind: type[Any], value: Any) -> Any:
    """Recipe or motor from the dictionary that an EnvSpec's JSON makes of it; anything else as it is."""
    if not isinstance(value, Mapping) or not value:
        return value
    return from_dict(kind, value, kind.__name__)


def task_recipe(recipe: Any) -> Recipe:
    """Recipe by name or TOML file, as `load_recipe` finds it, or from its dictionary.

    Raises:
        ValueError: no such recipe or file, or it is not a recipe.
    """
    recipe = described(Recipe, recipe)
    require(
        isinstance(recipe, Recipe | str | Path),
        f"recipe must be a name, a TOML file or a Recipe, got {shown(recipe)}",
    )
    return recipe if isinstance(recipe, Recipe) else load_recipe(recipe)


def linear_motor(motor: Any, *, needs_speed: bool) -> Motor:
    """Motor of the catalogue or of a TOML file that an environment can simulate; what it assumes is warned of.

    Raises:
        ValueError: no such motor, it is not linear, or it says too little.
    """
    require(
        isinstance(motor, str | Path), f"motor must be a name, a TOML file or parameters, got {shown(motor)}"
    )
    read = load_motor(motor)
    for name in ("coulomb_friction_n_m", "brush_drop_v"):
        require(
            getattr(read, name) == 0.0,
            f"{motor}: an environment's motor is linear, so {name} must be 0, got {getattr(read, name):g}",
        )
    usable_parameters(read, needs_speed=needs_speed)
    for note in () if read.assumed else read.notes:
        warnings.warn(f"{motor}: {note}", stacklevel=2)
    return read


def with_motor(recipe: Recipe, motor: Any) -> Recipe:
    """Recipe with another nominal motor; a motor's file also gives supply, noise and tolerances.

    Raises:
        ValueError: no such motor, its file is none or gives no voltage, or the motor is not linear.
    """
    motor = described(MotorParameters, motor)
    if isinstance(motor, MotorParameters):
        return replace(recipe, motor=motor)
    read = linear_motor(motor, needs_speed=Channel.SPEED in recipe.sensor.channels)
    if str(motor) in CATALOGUE:
        return replace(recipe, motor=read.parameters)
    require(read.nominal_voltage_v is not None, f"{motor}: motor.nominal_voltage_v is missing")
    own = motor_recipe(read, timing=recipe.timing, classes=recipe.classes)
    return replace(recipe, motor=own.motor, supply=own.supply, sensor=own.sensor, spread=own.spread)


def require_environment(recipe: Recipe) -> None:
    """Refuse, by `ValueError`, what a recipe may have for data sets, but an environment does not simulate."""
    name = recipe.name
    require(recipe.field is None, f"recipe {name} has a table field, which an environment does not simulate")
    require(
        all(not c.also for c in recipe.classes),
        f"recipe {name} has joint faults, of which an agent could declare only one",
    )
    require(
        recipe.starts_per_motor == 1,
        f"recipe {name} has several starts of a motor, but an environment draws a motor for each episode",
    )
    require(
        np.ndim(recipe.supply.voltage_v) == 0,
        f"voltage_v of recipe {name} must be one number for an environment",
    )


MAX_SAMPLES = 10_000_000
LARGEST_REWARD, LARGEST_V = 1e9, 1e6  # beyond, sums of rewards and states lose their digits or overflow
DEFAULT_LOAD_N_M = 0.0147


class Precision(StrEnum):
    """Precision of the step."""

    FLOAT32 = "float32"
    FLOAT64 = "float64"


class Start(StrEnum):
    """State of the motor when an episode begins."""

    RUNNING = "running"
    STANDSTILL = "standstill"


class Drive(StrEnum):
    """Supply of the motor."""

    OPEN_LOOP = "open_loop"
    SPEED_LOOP = "speed_loop"


def settle_numbers(options: DataclassInstance) -> None:
    """Check the numbers of frozen options, and make NumPy's Python's; else `ValueError`."""
    require_numbers(options)
    for field in fields(options):
        value = getattr(options, field.name)
        if isinstance(value, np.floating):
            object.__setattr__(options, field.name, float(value))


def settle_choice(options: Any, name: str, choices: type[StrEnum]) -> None:
    """Replace an option of frozen options by the member of its enumeration; else `ValueError`."""
    value = getattr(options, name)
    known = isinstance(value, str) and value in set(choices)
    require(known, f"{name} must be one of {', '.join(choices)}, got {shown(value)}")
    object.__setattr__(options, name, choices(value))


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorOptions:
    """Options of a monitor; the defaults are those of Monitor-v0. Times in seconds, rewards in the reward's own unit.

    Attributes:
        recipe: nominal motor, tolerances, faults and their weights, sensor, sampling rate: a `Recipe`, its TOML file,
            its dictionary in an EnvSpec's JSON, or a name of `simulation.named_recipes`, as easy, medium or hard.
        motor: in place of the recipe's nominal motor: a motor's TOML file, which also gives supply, noise and
            tolerances; a name of the catalogue, or `MotorParameters`; None: the recipe's motor.
        horizon_s: length of an episode.
        samples_per_step: sensor samples between two decisions.
        start: `running` at the operating point, or from `standstill`.
        load_torque_n_m: load on the shaft, known to the filter; without load a winding fault of a running motor is all
            but invisible. None: 11 % of the stall torque, 0.0147 N m for the default motor.
        drive: `open_loop` is a voltage; `speed_loop` a PI controller that holds the initial speed, with a tachometer of
            its own. Neither filter nor agent knows what it adds to the voltage.
        loop_time_s: time constant of the speed loop, for stability at least twice a sample and L / R.
        earliest_onset_s: before this time there is no fault.
        mean_onset_s: mean of the (geometric) waiting time from `earliest_onset_s` to the onset; 0: always at once.
        growth_s: time over which the fault grows to its severity; 0: abrupt.
        growth_levels: equal steps in which it grows.
        correct_reward: for declaring the right kind after the onset.
        silent_reward: for reaching the horizon in silence when there was no fault.
        false_alarm_cost: for a declaration when no fault had acted yet.
        wrong_kind_cost: for declaring another kind than the fault's.
        miss_cost: for reaching the horizon in silence when there was a fault.
        delay_cost_per_s: for every second that passes between onset and declaration; charged where the episode ends.
        confirm_steps: a kind is declared once it has been chosen in so many steps in a row, or in the last step; the
            choices before count as waiting.
        precision: `float32` or `float64` inside the step; observations are float32. float32 is quicker in a vector, and
            off by about 1e-5 of an observation's scale; choose float64 below 10 microseconds of sampling.
        observe: names of the observed features, in this order; empty: all that the recipe's sensor gives.

    Raises:
        ValueError: a value is out of its range; the sentence says which and what would be right.
    """

    recipe: Recipe | str | Path = "medium"
    motor: MotorParameters | str | Path | None = None
    horizon_s: float = 0.2
    samples_per_step: int = (
        20  # a discount of 0.99 a step leaves something of the end after 100 steps, not 2,000
    )
    start: Start = Start.RUNNING
    load_torque_n_m: float | None = None
    drive: Drive = Drive.OPEN_LOOP
    loop_time_s: float = 0.001
    earliest_onset_s: float = 0.01
    mean_onset_s: float = 0.05
    growth_s: float = 0.0
    growth_levels: int = 16
    correct_reward: float = 1.0
    silent_reward: float = 1.0
    false_alarm_cost: float = 1.0
    wrong_kind_cost: float = 0.5
    miss_cost: float = 1.0
    delay_cost_per_s: float = 5.0
    confirm_steps: int = (
        3  # random actions seldom choose a kind so often, so that episodes last to their fault
    )
    precision: Precision = Precision.FLOAT32
    observe: tuple[str, ...] = ()
    moves_voltage: ClassVar[bool] = False
    """Whether actions can change the voltage; if so, the default observation has the evidence of the bank."""

    @property
    def offsets_v(self) -> tuple[float, ...]:
        """Voltage offsets of the actions: a monitor has none but 0."""
        return (0.0,)

    @property
    def probe_cost_per_v2_s(self) -> float:
        """Price of an offset: none."""
        return 0.0

    @property
    def energy_cost_per_j(self) -> float:
        """Price of electrical energy: none."""
        return 0.0

    def __post_init__(self) -> None:
        settle_numbers(self)
        recipe = task_recipe(self.recipe)
        if self.motor is not None:
            recipe = with_motor(recipe, self.motor)
            object.__setattr__(self, "motor", recipe.motor)
        require_environment(recipe)
        object.__setattr__(self, "recipe", recipe)
        settle_choice(self, "start", Start)
        settle_choice(self, "drive", Drive)
        settle_choice(self, "precision", Precision)
        if self.drive is Drive.SPEED_LOOP:
            require(self.start is Start.RUNNING, f"start must be running in a speed loop, got {self.start}")
            shortest = 2.0 * (self.dt_s + float(np.asarray(recipe.motor.electrical_time_constant_s)))
            require(
                shortest <= self.loop_time_s <= 1e3,
                f"loop_time_s must be from {shortest:.3g} (twice a sample and L / R) to 1000, got {self.loop_time_s:g}",
            )
        require_positive("horizon_s", self.horizon_s)
        for name in ("earliest_onset_s", "mean_onset_s", "growth_s"):
            require_positive(name, getattr(self, name), zero_allowed=True)
        for name in ("samples_per_step", "growth_levels", "confirm_steps"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 1000,
                f"{name} must be a whole number from 1 to 1000, got {shown(value)}",
            )
        for field in fields(self):
            if field.name.endswith(("_reward", "_cost", "_cost_per_s", "load_torque_n_m")):
                value = getattr(self, field.name)
                require(
                    value is None or abs(value) <= LARGEST_REWARD,
                    f"{field.name} must be finite, at most {LARGEST_REWARD:g} either way, got {value}",
                )
        require(
            self.n_samples % self.samples_per_step == 0 and self.n_samples >= self.samples_per_step,
            f"horizon_s must hold a whole number of steps of {self.samples_per_step} samples at "
            f"{recipe.timing.sampling_rate_hz:g} Hz, got {self.horizon_s:g} s = {self.n_samples} samples",
        )
        require(
            self.n_samples <= MAX_SAMPLES,
            f"horizon_s must be at most {MAX_SAMPLES} samples long, got {self.n_samples}",
        )
        names: Any = self.observe
        are_names = isinstance(names, tuple | list) and all(isinstance(name, str) for name in names)
        require(are_names, f"observe must be names of features, got {shown(names)}")
        object.__setattr__(self, "observe", tuple(names))

    @property
    def task(self) -> Recipe:
        """The recipe itself."""
        assert isinstance(self.recipe, Recipe)  # noqa: S101  # made so in __post_init__
        return self.recipe

    @property
    def load_n_m(self) -> float:
        """Load on the shaft; by default the same share of the stall torque for every motor."""
        if self.load_torque_n_m is not None:
            return self.load_torque_n_m
        return DEFAULT_LOAD_N_M * (
            _stall_torque(self.task.motor, float(self.task.supply.voltage_v))
            / _stall_torque(PAPER_MOTOR, SupplyParameters().voltage_v)
        )

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return self.task.timing.dt_s

    @property
    def n_samples(self) -> int:
        """Samples of an episode that reaches its horizon."""
        return round(min(self.horizon_s * self.task.timing.sampling_rate_hz, 2.0 * MAX_SAMPLES))

    @property
    def n_levels(self) -> int:
        """Levels of a growing fault; 1 if it is abrupt."""
        return self.growth_levels if round(self.growth_s / self.dt_s) > 0 else 1

    @property
    def n_steps(self) -> int:
        """Steps of an episode that reaches its horizon."""
        return self.n_samples // self.samples_per_step


def _stall_torque(motor: MotorParameters, voltage_v: float | FloatArray) -> float:
    """Torque at standstill."""
    return float(np.mean(motor.torque_constant_n_m_per_a * voltage_v / motor.resistance_ohm))


Options = TypeVar("Options", bound="DataclassInstance")


def with_changes(options: Any, kind: type[Options], changes: dict[str, Any]) -> Options:
    """Options with some of them changed.

    Args:
        options: of `kind`, or their dictionary in an EnvSpec's JSON; None: the defaults.
        kind: their class.
        changes: by name.

    Raises:
        UnknownOptionError: an option does not exist.
        ValueError: a value is of another type or out of its range.
    """
    if isinstance(options, Mapping) and options:
        return with_changes(None, kind, {**options, **changes})
    options = kind() if options is None else options
    require(isinstance(options, kind), f"options must be {kind.__name__}, got {options!r:.60}")
    known = [field.name for field in fields(options)]
    for name in changes:
        if name not in known:  # TorchRL reads the first words, and does without the option
            there = f"no option {shown(name)}; there are {', '.join(known)}"
            raise UnknownOptionError(f"unexpected keyword argument {shown(name)}: {there}")
    changed: Options = replace(options, **changes)
    return changed
