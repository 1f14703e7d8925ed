"""A data set in memory, and the meaning of its columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import whole
from motor_env.motor.parameters import Channel, FloatArray
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.sensor_faults import VOLTAGE


def at_least_one(name: str, value: Any) -> int:
    """Return a whole number of 1 or more; else raise `ValueError`."""
    if isinstance(value, int) and value < 1:
        raise ValueError(f"{name} must be >= 1, got {value}")
    return whole(name, value, least=1)


class Column(NamedTuple):
    """Column of a data set.

    Attributes:
        name: in the Parquet files.
        kind: text, whole, number or samples (float32, a list of one length).
        unit: of a number; may be empty.
        meaning: in words.
    """

    name: str
    kind: str
    unit: str
    meaning: str


LABEL_COLUMNS = (
    Column("case_id", "whole", "", "number of the case"),
    Column("motor_id", "whole", "", "number of its motor; all starts of a motor are in one split"),
    Column("split", "text", "", "train, validation, test or shift_NAME"),
    Column("class_name", "text", "", "label"),
    Column("class_index", "whole", "", "the label's place in the recipe"),
    Column("kind", "text", "", "healthy, or kind of the (first) fault"),
    Column("severity", "number", "1", "relative size of the fault, 0.25 for 25 %"),
)
"""Names of the columns with the truth about a case."""
MOTOR_PARAMETERS = {
    "resistance_ohm": ("ohm", "winding resistance without the fault"),
    "inductance_h": ("H", "winding inductance"),
    "back_emf_constant_v_s_per_rad": ("V s/rad", "back-EMF constant"),
    "torque_constant_n_m_per_a": ("N m/A", "torque constant"),
    "inertia_kg_m2": ("kg m²", "inertia of rotor and load"),
    "viscous_friction_n_m_s_per_rad": ("N m s/rad", "viscous friction without the fault"),
    "voltage_v": ("V", "level of the supply"),
}
EFFECTS = {
    "coulomb_friction_n_m": ("N m", "dry friction"),
    "stribeck_friction_n_m": ("N m", "breakaway torque above it"),
    "brush_drop_v": ("V", "voltage drop of both brushes"),
    "temperature_rise_k": ("K", "of winding and magnets above the data sheet's temperature"),
    "supply_resistance_ohm": ("ohm", "of supply and leads"),
    "ramp_s": ("s", "rise time of the supply"),
    "ripple_v": ("V", "amplitude of the supply's ripple"),
    "load_torque_n_m": ("N m", "load"),
    "commutation_ripple": ("1", "relative ripple of the torque constant"),
    "bearing_ripple_n_m": ("N m", "torque ripple of a damaged bearing"),
    "delay_s": ("s", "delay of the supply's step after time 0"),
}
SENSOR_ERRORS = {
    "gain": ("1", "factor of the current sensor"),
    "offset_a": ("A", "offset of the current sensor"),
}
LOADS = {
    "load_rise_n_m": ("N m", "what the load gains from begin to end"),
    "fan_n_m_s2": ("N m s²", "load over the square of the speed"),
}
_CHANNELS = {
    Channel.CURRENT: ("current_a", "A", "measured current"),
    Channel.SPEED: ("speed_rad_s", "rad/s", "measured speed"),
    VOLTAGE: ("applied_voltage_v", "V", "applied voltage, held over each sampling interval"),
}
LABELS = tuple(column.name for column in LABEL_COLUMNS)
COLUMN_OF_CHANNEL: dict[str, str] = {channel: name for channel, (name, _, _) in _CHANNELS.items()}


def parameter_columns(recipe: Recipe) -> tuple[Column, ...]:
    """Return the sampled physical parameters, each a label of a case."""
    tables = [MOTOR_PARAMETERS]
    if recipe.field is not None:
        tables += [EFFECTS, SENSOR_ERRORS]
        tables += [] if recipe.duty is None else [LOADS]
    return tuple(Column(name, "number", *about) for table in tables for name, about in table.items())


def parameter_names(recipe: Recipe) -> tuple[str, ...]:
    """Return their names."""
    return tuple(column.name for column in parameter_columns(recipe))


def columns(recipe: Recipe) -> tuple[Column, ...]:
    """Return the columns of a recipe's data set."""
    timing = recipe.timing
    every = f", {timing.n_samples} samples at {timing.sampling_rate_hz:g} Hz"
    channels = [_CHANNELS[channel] for channel in recipe.channels]
    samples = (Column(name, "samples", unit, meaning + every) for name, unit, meaning in channels)
    return (*LABEL_COLUMNS, *parameter_columns(recipe), *samples)


@dataclass(frozen=True, slots=True, repr=False)
class Dataset:
    """Labelled starts, or motors at work, with their recipe.

    Attributes:
        X: measurements, float32, shape (n_cases, n_channels, n_timepoints); channels in the order of `recipe.channels`.
        class_name: label, shape (n_cases,).
        class_index: its index in `class_names`, shape (n_cases,).
        kind: healthy or the fault's kind, shape (n_cases,).
        severity: relative size of the fault (of joint faults the sum), 0 for healthy, shape (n_cases,).
        parameters: of the motor without its fault, by name (`parameter_names`), shape (n_cases,).
        case_id: case numbers, shape (n_cases,).
        motor_id: the motor of each case, shape (n_cases,); a motor is in one split only.
        split: train, validation or test, shape (n_cases,).
        recipe: distribution of the cases.
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
        """Select rows, by mask or by index."""
        return replace(
            self,
            X=self.X[rows],
            **{name: getattr(self, name)[rows] for name in LABELS},
            parameters={name: values[rows] for name, values in self.parameters.items()},
        )
