"""A DC motor that may be failing: simulation, Kalman filter, decision rules, diagnosis, gymnasium environments.

Importing the package registers its environments with gymnasium. Everything else is loaded when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

if TYPE_CHECKING:
    from motor_env.detection.rules import (
        Cusum,
        Glr,
        ModelBank,
        MOfN,
        Rule,
        ShiryaevRoberts,
        SignatureCusum,
        Sprt,
        Threshold,
        TolerantFilter,
        WindowedNis,
        in_a_row,
        nis_rule,
        recipe_thresholds,
    )
    from motor_env.filters.kalman import FilterResult, KalmanFilter, run_filter
    from motor_env.inference.isolation import Isolator
    from motor_env.motor.faults import Fault, FaultKind, apply_fault, apply_faults
    from motor_env.motor.model import State, continuous_model, discretize, steady_state
    from motor_env.motor.parameters import (
        CATALOGUE,
        PAPER_MOTOR,
        Channel,
        MotorParameters,
        SensorParameters,
        SupplyParameters,
        catalogue_motor,
    )
    from motor_env.simulation.recipes import RECIPES, Recipe, draw, named_recipe
    from motor_env.simulation.simulate import Scenario, Timing, Transients, simulate, simulate_states

__version__ = "0.1.0"

_HOME = {
    "motor.faults": ("Fault", "FaultKind", "apply_fault", "apply_faults"),
    "inference.isolation": ("Isolator",),
    "filters.kalman": ("FilterResult", "KalmanFilter", "run_filter"),
    "motor.model": ("State", "continuous_model", "discretize", "steady_state"),
    "motor.parameters": (
        "CATALOGUE",
        "PAPER_MOTOR",
        "Channel",
        "MotorParameters",
        "SensorParameters",
        "SupplyParameters",
        "catalogue_motor",
    ),
    "simulation.recipes": ("RECIPES", "Recipe", "draw", "named_recipe"),
    "detection.rules": (
        "Cusum",
        "Glr",
        "MOfN",
        "ModelBank",
        "Rule",
        "ShiryaevRoberts",
        "SignatureCusum",
        "Sprt",
        "Threshold",
        "TolerantFilter",
        "WindowedNis",
        "in_a_row",
        "nis_rule",
        "recipe_thresholds",
    ),
    "simulation.simulate": ("Scenario", "Timing", "Transients", "simulate", "simulate_states"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "CATALOGUE",
    "PAPER_MOTOR",
    "RECIPES",
    "Channel",
    "Cusum",
    "Fault",
    "FaultKind",
    "FilterResult",
    "Glr",
    "Isolator",
    "KalmanFilter",
    "MOfN",
    "ModelBank",
    "MotorParameters",
    "Recipe",
    "Rule",
    "Scenario",
    "SensorParameters",
    "ShiryaevRoberts",
    "SignatureCusum",
    "Sprt",
    "State",
    "SupplyParameters",
    "Threshold",
    "Timing",
    "TolerantFilter",
    "Transients",
    "WindowedNis",
    "apply_fault",
    "apply_faults",
    "catalogue_motor",
    "continuous_model",
    "discretize",
    "draw",
    "in_a_row",
    "named_recipe",
    "nis_rule",
    "recipe_thresholds",
    "run_filter",
    "simulate",
    "simulate_states",
    "steady_state",
]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"motor_env.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'motor_env' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


for _name, _module, _class in (
    ("Monitor-v0", "monitor", "Monitor"),
    ("Probe-v0", "probe", "Probe"),
    ("ProbeContinuous-v0", "probe", "ProbeContinuous"),
):
    register(
        id=f"motor_env/{_name}",
        entry_point=f"motor_env.envs.{_module}:{_class}Env",
        vector_entry_point=f"motor_env.envs.{_module}:{_class}VectorEnv",
    )
