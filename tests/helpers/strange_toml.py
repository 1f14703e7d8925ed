"""Motor files and recipes of strangers: good ones, and what makes them strange."""

from __future__ import annotations

import tomllib

import hostile
import numpy as np
from hostile import forged, toml_of

PARAMETERS = """
[motor]
resistance_ohm = 2.18
inductance_h = 2.38e-4
back_emf_constant_v_s_per_rad = 0.0235
torque_constant_n_m_per_a = 0.0235
inertia_kg_m2 = 1.07e-6
viscous_friction_n_m_s_per_rad = 1.2e-6
"""

RECIPE = """
base = "bench"
name = "mine"
starts_per_motor = 3
healthy_starts = 1
[supply]
voltage_v = 12.0
[timing]
sampling_rate_hz = 2000
duration_s = 0.05
quiet_s = 0.02
[sensor]
channels = ["current", "speed"]
current_noise_a = 0.02
[field]
temperature_rise_k = [0.0, 30.0]
coulomb_ratio = [0.1, 0.2]
stribeck_ratio = [0.0, 0.1]
brush_drop_v = [0.0, 0.1]
supply_resistance_ohm = [0.02, 0.06]
commutation_ripple = [0.0, 0.02]
sensor_gain = [0.995, 1.005]
sensor_offset_a = [-0.0025, 0.0025]
load_ratio = [0.0, 0.05]
ramp_s = [0.0, 0.0005]
ripple_v = [0.0, 0.05]
trigger_jitter = [0.0, 0.99]
bearing_ripple_ratio = [0.0, 0.5]
ripple_hz = 100.0
sensor_lag_s = 1e-4
sensor_range_a = 8.0
adc_bits = 12
missing_fraction = 0.01
[[classes]]
[[classes]]
kind = "bearing"
severity = 0.05
severity_to = 0.3
weight = 2.0
[[classes]]
kind = "noise"
severity = 0.5
[[shifts]]
name = "hot"
field = { temperature_rise_k = [40.0, 60.0] }
"""
RECIPES = (RECIPE + PARAMETERS, RECIPE.replace("\nname", '\nmotor = "paper"\nname', 1))
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
