"""A data set in memory: transients and, beside them, the truth about each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import Channel, FloatArray
from motor_env.simulation.duty import VOLTAGE
from motor_env.simulation.recipes import Recipe

MOTOR_PARAMETERS = (
    "resistance_ohm",
    "inductance_h",
    "back_emf_constant_v_s_per_rad",
    "torque_constant_n_m_per_a",
    "inertia_kg_m2",
    "viscous_friction_n_m_s_per_rad",
    "voltage_v",
)
EFFECTS = (
    "coulomb_friction_n_m",
    "stribeck_friction_n_m",
    "brush_drop_v",
    "temperature_rise_k",
    "supply_resistance_ohm",
    "ramp_s",
    "ripple_v",
    "load_torque_n_m",
    "commutation_ripple",
    "bearing_ripple_n_m",
    "delay_s",
)
LABELS = ("case_id", "motor_id", "split", "class_name", "class_index", "kind", "severity")
SENSOR_ERRORS = ("gain", "offset_a")
LOADS = ("load_rise_n_m", "fan_n_m_s2")
COLUMN_OF_CHANNEL: dict[str, str] = {
    Channel.CURRENT: "current_a",
    Channel.SPEED: "speed_rad_s",
    VOLTAGE: "applied_voltage_v",
}


def parameter_names(recipe: Recipe) -> tuple[str, ...]:
    """Names of the sampled physical parameters, each a label of a case."""
    loads = () if recipe.duty is None else LOADS
    return MOTOR_PARAMETERS if recipe.field is None else MOTOR_PARAMETERS + EFFECTS + SENSOR_ERRORS + loads


@dataclass(frozen=True, slots=True, repr=False)
class Dataset:
    """Labelled transients.

    Attributes:
        X: measurements, float32, shape (n_cases, n_channels, n_timepoints); channels in the order of `recipe.channels`.
        class_name: label, shape (n_cases,).
        class_index: index into `class_names`, shape (n_cases,).
        kind: healthy or the fault's kind, shape (n_cases,).
        severity: relative size of the fault (of joint faults the sum), 0 for healthy, shape (n_cases,).
        parameters: each sampled physical parameter by name (`parameter_names`), shape (n_cases,), of the motor
            without its fault.
        case_id: case numbers, shape (n_cases,).
        motor_id: the motor of each case, shape (n_cases,); motors never stand in two splits.
        split: train, validation or test, shape (n_cases,).
        recipe: what the cases were drawn from.
        seed: the random seed.
    """

    X: NDArray[np.float32]
    class_name: NDArray[np.str_]
    class_index: NDArray[np.int64]
    kind: NDArray[np.str_]
    severity: FloatArray
    parameters: Mapping[str, FloatArray]
    case_id: NDArray[np.int64]
    motor_id: NDArray[np.int64]
    split: NDArray[np.str_]
    recipe: Recipe
    seed: int

    def __len__(self) -> int:
        return len(self.X)

    def __repr__(self) -> str:
        return f"<Dataset of recipe {self.recipe.name}, seed {self.seed}: X {self.X.shape}>"

    @property
    def class_names(self) -> tuple[str, ...]:
        """All labels of the recipe, in the order of `class_index`."""
        return self.recipe.class_names

    @property
    def time_s(self) -> FloatArray:
        """Time of each sample, shape (n_timepoints,); 0 is the step of the supply."""
        return self.recipe.timing.time_s

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Dataset:
        """Only these rows, by mask or by index."""
        return replace(
            self,
            X=self.X[rows],
            **{name: getattr(self, name)[rows] for name in LABELS},
            parameters={name: values[rows] for name, values in self.parameters.items()},
        )

    def of_split(self, split: str) -> Dataset:
        """Only the cases of one split."""
        return self.select(self.split == str(split))
