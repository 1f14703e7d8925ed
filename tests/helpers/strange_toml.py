"""Motor files and recipes of strangers: good ones, and what makes them strange."""

from __future__ import annotations

import tomllib
from typing import Any

import hostile
import numpy as np
from hostile import forged, toml_of

from motor_env import load_recipe

# Reaches in: recipes as files hold them.
from motor_env.simulation.named_recipes import recipe_to_dict

PARAMETERS = """
[motor]
resistance_ohm = 2.18
inductance_h = 2.38e-4
back_emf_constant_v_s_per_rad = 0.0235
torque_constant_n_m_per_a = 0.0235
inertia_kg_m2 = 1.07e-6
viscous_friction_n_m_s_per_rad = 1.2e-6
"""


def _given(value: Any) -> Any:
    """A tree as TOML has it: lists, and nothing that is None."""
    if isinstance(value, dict):
        return {key: _given(each) for key, each in value.items() if each is not None}
    return [_given(each) for each in value] if isinstance(value, list | tuple) else value


RECIPES = [toml_of(_given(recipe_to_dict(load_recipe(name)))) for name in ("field", "bench-full")]
MOTOR = """
name = "RE 25"
notes = ["a note"]
[motor]
resistance_ohm = 2.18
inductance_mh = 0.238
torque_constant_mnm_per_a = 23.5
speed_constant_rpm_per_v = 406.0
rotor_inertia_g_cm2 = 10.7
no_load_current_ma = 26.3
no_load_speed_rpm = 4860.0
nominal_voltage_v = 12.0
[tolerance]
resistance = 0.02
[sensor]
current_noise_a = 0.01
[healthy]
pieces = 5
degrees_of_freedom = 8.0
quantities = ["R", "L"]
values = [2.2, 2.4e-4]
log_covariance = [[4e-4, 0.0], [0.0, 2.5e-3]]
"""
STARTS = """
[healthy.starts]
log_noise = -4.0
log_noise_sd = 0.1
sampling_rate_hz = 6000.0
duration_s = 0.08
"""
WINDOWS = """
[healthy.windows]
window_s = 2.0
terms = ["R"]
physical = [2.2]
hold = "held"
dt_s = 1e-3
speed_rad_s = 300.0
"""
MOTORS = (MOTOR + STARTS, MOTOR + WINDOWS)

ABSURD = [
    *[value for value in hostile.ABSURD if value is not None and value != "\ud800"],  # TOML has neither
    [{"kind": "bearing", "severity": 1e300}],
    [{"kind": "winding_short", "severity": 5.0}],
]


def strange(text: str, rng: np.random.Generator) -> str:
    """The file with one or two values strange, a key more or less, or a character changed."""
    written = toml_of(forged(tomllib.loads(text), rng, absurd=ABSURD, most=2))
    if rng.random() < 0.05:
        place = int(rng.integers(len(written)))
        written = written[:place] + '\\"[{='[int(rng.integers(5))] + written[place + 1 :]
    return written
