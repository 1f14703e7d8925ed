"""Options of the drive: motor, load, profile, faults, heat, and what everything costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

import numpy as np

from motor_env.common.arrays import shown
from motor_env.envs.options import described, linear_motor, settle_choice, settle_numbers
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.model import load_torque
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    MotorParameters,
    require,
    require_positive,
)

LABELS = (HEALTHY, str(FaultKind.BEARING), str(FaultKind.WINDING_CONTACT))
"""Classes of an episode, in the order of `weights`."""
LARGEST_COST = 1e6
MAX_STEPS = 100_000


class Control(StrEnum):
    """Form of an action."""

    VOLTAGE_AND_DECISION = "voltage_and_decision"
    VOLTAGE_LIMP_STOP = "voltage_limp_stop"
    DECISION = "decision"


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions:
    """Options of a drive in SI units; the defaults are those of Drive-v0. Costs in the reward's own unit.

    Attributes:
        motor: nominal motor: `MotorParameters`, a name of the catalogue, or a motor's TOML file, of which only the
            parameters count.
        current_noise_a: standard deviation of the measured current, read once a step.
        speed_noise_rad_s: the same of the speed.
        period_s: sampling period, in which voltage and load are held.
        horizon_s: length of an episode.
        voltage_limit_v: largest voltage of the supply, either way.
        current_limit_a: largest current at the end of a step; the supply folds the voltage back.
        load_inertia_kg_m2: inertia of the driven machine, on top of the motor's.
        load_torque_n_m: constant part of the load, as of a hoist.
        fan_torque_n_m: quadratic part of the load at the top speed, as of a fan.
        load_std_n_m: standard deviation of the unknown part of the load (Ornstein-Uhlenbeck).
        load_time_s: its time constant.
        lowest_speed_rad_s: lowest speed of the profile.
        top_speed_rad_s: highest speed of the profile.
        plateau_s: shortest and longest plateau of the profile.
        ramp_s: shortest and longest ramp between two plateaus.
        ahead_s: times ahead at which the profile is observed, beside its value now and at the end of the next step.
        weights: of a healthy motor, a bad bearing, a bad winding contact; only ratios count.
        earliest_onset_s: before this time there is no fault.
        mean_onset_s: mean of the (geometric) waiting time from there to the onset.
        onset_severity: severity of bearing and winding at the onset: relative rise of friction and resistance.
        failure_severity: severity of bearing and winding at which the motor fails.
        growth_per_s: slowest and fastest rate of a fault's exponential growth; drawn with a uniform logarithm.
        stress_share: share of a bearing's growth that is proportional to load torque times speed; the rest, and a
            winding's growth, is constant.
        thermal_resistance_k_per_w: of the winding against its surroundings, for all of its copper heat.
        thermal_time_s: time constant of the winding's temperature.
        warm_k: rise of temperature beyond which heat costs.
        burn_k: rise of temperature at which the motor fails.
        limp_share: share of the profile that is asked of a limping motor.
        limp_time_s: time in which the profile shrinks to that share, and grows back.
        tracking_cost_per_s: price of the squared error of the speed, in units of the top speed, for a second.
        heat_cost_per_k_s: price of a kelvin beyond `warm_k` for a second.
        wear_cost: price of a bearing's growth from 0 to failure.
        failure_cost: price of a failure, on top of the rest of the episode at `stop_cost_per_s`.
        stop_cost_per_s: price of a second that a stopped motor does not run.
        limp_cost_per_s: price of a second with the whole reduction of the profile.
        tracking_limit_per_s: largest cost of a second of tracking error: a cost x becomes x / (1 + x / limit); 0: no
            limit.
        control: `decision`: run, limp or stop, while the drive's speed controller (LQG with integral action on the
            healthy motor) sets the voltage; `voltage_limp_stop`: three numbers, one each; `voltage_and_decision`: two
            numbers, the voltage, and a decision that runs, limps or stops.
        steps_per_decision: periods for which an action holds.

    Raises:
        ValueError: a value is out of its range, or no motor can follow the profile; the sentence says which.
    """

    motor: MotorParameters = PAPER_MOTOR
    current_noise_a: float = 0.02
    speed_noise_rad_s: float = 1.0
    period_s: float = 0.01
    horizon_s: float = 8.0
    voltage_limit_v: float = 16.0
    current_limit_a: float = 3.0
    load_inertia_kg_m2: float = 4e-6
    load_torque_n_m: float = 8e-3
    fan_torque_n_m: float = 12e-3
    load_std_n_m: float = 0.5e-3
    load_time_s: float = 1.0
    lowest_speed_rad_s: float = 100.0
    top_speed_rad_s: float = 450.0
    plateau_s: tuple[float, float] = (0.2, 0.8)
    ramp_s: tuple[float, float] = (0.2, 0.5)
    ahead_s: tuple[float, ...] = (0.05, 0.1, 0.2)
    weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
    earliest_onset_s: float = 0.5
    mean_onset_s: float = 1.5
    onset_severity: tuple[float, float] = (2.0, 0.2)
    failure_severity: tuple[float, float] = (12.0, 4.0)
    growth_per_s: tuple[float, float] = (0.4, 1.2)
    stress_share: float = 0.9
    thermal_resistance_k_per_w: float = 40.0
    thermal_time_s: float = 2.0
    warm_k: float = 70.0
    burn_k: float = 120.0
    limp_share: float = 0.5
    limp_time_s: float = 0.3
    tracking_cost_per_s: float = 300.0
    heat_cost_per_k_s: float = 0.05
    wear_cost: float = 1.0
    failure_cost: float = 6.0
    stop_cost_per_s: float = 1.0
    limp_cost_per_s: float = 0.2
    tracking_limit_per_s: float = 3.0
    control: Control = Control.DECISION
    steps_per_decision: int = 10

    def __post_init__(self) -> None:
        settle_numbers(self)
        motor: Any = described(MotorParameters, self.motor)
        if not isinstance(motor, MotorParameters):
            motor = linear_motor(motor, needs_speed=True).parameters
        object.__setattr__(self, "motor", motor)
        for field in fields(self):
            values = getattr(self, field.name)
            if field.name in ("motor", "control", "steps_per_decision"):
                continue
            if isinstance(values, list):
                values = tuple(values)
                object.__setattr__(self, field.name, values)
            may_be_zero = "cost" in field.name or field.name in _MAY_BE_ZERO
            for value in values if isinstance(values, tuple) else (values,):
                require_positive(field.name, value, zero_allowed=may_be_zero)
                require(
                    "cost" not in field.name or value <= LARGEST_COST,
                    f"{field.name} must be at most {LARGEST_COST:g}, got {value:g}",
                )
        for name, length in _LENGTHS.items():
            values = getattr(self, name)
            require(len(values) == length, f"{name} must be {length} numbers, got {values!r}")
        for name in ("plateau_s", "ramp_s", "growth_per_s"):
            low, high = getattr(self, name)
            require(low <= high, f"{name} must be the smaller, then the larger number, got {low:g}, {high:g}")
        for low_name, high_name in _IN_ORDER:
            low, high = np.asarray(getattr(self, low_name)), np.asarray(getattr(self, high_name))
            require(bool((low < high).all()), f"{low_name} must be below {high_name} = {high}, got {low}")
        for name in ("stress_share", "limp_share"):
            require(getattr(self, name) <= 1.0, f"{name} must be at most 1, got {getattr(self, name):g}")
        require(self.limp_share < 1.0, "limp_share must be below 1: a limping motor runs slower")
        require(sum(self.weights) > 0.0, f"weights must not all be 0, got {self.weights}")
        require(self.motor.batch_shape == (), "motor must be one motor, got a batch")
        require(self.period_s <= self.ramp_s[0], f"period_s must be at most a ramp, got {self.period_s:g}")
        require(
            1 <= self.n_steps <= MAX_STEPS,
            f"horizon_s must be 1 to {MAX_STEPS} periods, got {self.n_steps}",
        )
        settle_choice(self, "control", Control)
        repeats: object = self.steps_per_decision
        require(
            isinstance(repeats, int) and not isinstance(repeats, bool) and repeats >= 1,
            f"steps_per_decision must be a whole number >= 1, got {shown(repeats)}",
        )
        require(
            self.n_steps % self.steps_per_decision == 0,
            f"horizon_s must hold a whole number of decisions of {repeats} periods, got {self.n_steps} periods",
        )
        self._require_followable()

    def _require_followable(self) -> None:
        """Refuse a supply that cannot hold the load, and a profile that the motor cannot follow with it."""
        idle, _ = self.needs(self.lowest_speed_rad_s, 0.0)
        require(
            idle <= self.current_limit_a,
            f"current_limit_a must hold load and friction at lowest_speed_rad_s, {idle:.3g} A, "
            f"got {self.current_limit_a:g}",
        )
        slope = (self.top_speed_rad_s - self.lowest_speed_rad_s) / self.ramp_s[0]
        current, voltage = self.needs(self.top_speed_rad_s, slope)
        require(
            current <= self.current_limit_a and voltage <= self.voltage_limit_v,
            f"the profile must be one that the motor can follow: its steepest ramp to {self.top_speed_rad_s:g} rad/s "
            f"needs {current:.3g} A and {voltage:.3g} V, the limits are {self.current_limit_a:g} A and "
            f"{self.voltage_limit_v:g} V",
        )

    def needs(self, speed_rad_s: float, slope_rad_s2: float) -> tuple[float, float]:
        """Current and voltage that a healthy motor needs at a speed that rises with a slope."""
        motor = self.motor
        torque = float(load_torque(self.load_torque_n_m, self.fan_n_m_s2, speed_rad_s))
        torque += float(motor.viscous_friction_n_m_s_per_rad) * speed_rad_s
        torque += (float(motor.inertia_kg_m2) + self.load_inertia_kg_m2) * slope_rad_s2
        current = torque / float(motor.torque_constant_n_m_per_a)
        back_emf = float(motor.back_emf_constant_v_s_per_rad) * speed_rad_s
        return current, float(motor.resistance_ohm) * current + back_emf

    @property
    def driven(self) -> MotorParameters:
        """The nominal motor together with the inertia that it drives."""
        return self.motor.scaled(inertia_kg_m2=1.0 + self.load_inertia_kg_m2 / self.motor.inertia_kg_m2)

    @property
    def fan_n_m_s2(self) -> float:
        """Load torque per square of the speed."""
        return self.fan_torque_n_m / self.top_speed_rad_s**2

    @property
    def n_steps(self) -> int:
        """Steps of an episode that reaches its horizon."""
        return round(min(self.horizon_s / self.period_s, 2.0 * MAX_STEPS))

    @property
    def ahead_steps(self) -> tuple[int, ...]:
        """Steps ahead at which the profile is observed, each once: now, at the end of the next step, later."""
        later = (max(1, round(time / self.period_s)) for time in self.ahead_s)
        return tuple(dict.fromkeys((0, 1, *later)))

    @property
    def load_memory(self) -> float:
        """Share of the unknown load that is left after a step."""
        return math.exp(-self.period_s / self.load_time_s)


_MAY_BE_ZERO = (
    "load_inertia_kg_m2",
    "load_torque_n_m",
    "fan_torque_n_m",
    "weights",
    "earliest_onset_s",
    "mean_onset_s",
    "stress_share",
    "tracking_limit_per_s",
)
_LENGTHS = {"weights": 3, **dict.fromkeys(("plateau_s", "ramp_s", "growth_per_s"), 2)}
_LENGTHS |= dict.fromkeys(("onset_severity", "failure_severity"), 2)
_IN_ORDER = (
    ("lowest_speed_rad_s", "top_speed_rad_s"),
    ("onset_severity", "failure_severity"),
    ("warm_k", "burn_k"),
)
