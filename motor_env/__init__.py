"""A DC motor that may be failing: simulation, Kalman filter, decision rules, diagnosis, gymnasium environments.

Importing the package registers its environments with gymnasium. Everything else is loaded when first used;
`__init__.pyi` lists what is public.
"""

import lazy_loader
from gymnasium.envs.registration import register

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Id, class, options, and a return that the best policy known reaches: its mean less one standard error, as
# `python benchmarks/reference_scores.py` measures it. In the order in which an agent should try them: first those that
# one learns to begin with, then the harder ones of each family.
# The `Confirm` ids decide every 2 and 4 ms. A discount of 0.99 a step would make the end of 2,000 steps worth nothing.
_CONFIRM = {"samples_per_step": 20, "confirm_steps": 3}
_ASK = {"samples_per_step": 40, "confirm_steps": 3, "offsets_v": (0.0, -0.7, 0.7)}
_DECIDE = {"tracking_limit_per_s": 3.0, "control": "decision", "steps_per_decision": 10}
for _id, _class, _options, _best in (
    ("Maintain", "Maintain", {}, -2.299),
    ("MonitorConfirm", "Monitor", _CONFIRM, 0.882),
    ("DriveDecide", "Drive", _DECIDE, -1.412),
    ("ProbeConfirm", "Probe", _ASK, 0.851),
    ("MonitorEasy", "Monitor", {"recipe": "easy"}, 0.988),
    ("Monitor", "Monitor", {}, 0.889),
    ("MonitorHard", "Monitor", {"recipe": "hard"}, 0.716),
    ("MonitorSmall", "Monitor", {"recipe": "small"}, 0.501),
    ("MonitorSpeedLoop", "Monitor", {"drive": "speed_loop"}, 0.721),
    ("MonitorSensor", "Monitor", {**_CONFIRM, "recipe": "sensor", "growth_s": 0.1}, 0.8),
    ("ProbeMedium", "Probe", {"recipe": "medium"}, 0.92),
    ("Probe", "Probe", {}, 0.887),
    ("ProbeContinuous", "ProbeContinuous", {}, 0.887),
    ("MaintainUnknownRate", "Maintain", {"rate_spread": 0.5}, -1.926),
    ("DriveBounded", "Drive", {"tracking_limit_per_s": 3.0, "control": "voltage_limp_stop"}, -1.32),
    ("Drive", "Drive", {}, -1.322),
    ("DriveBearing", "Drive", {"weights": (1.0, 2.0, 0.0)}, -1.245),
    ("DriveHeavy", "Drive", {"load_torque_n_m": 12e-3}, -1.559),
):
    register(
        id=f"motor_env/{_id}-v0",
        entry_point=f"motor_env.envs:{_class}Env",
        vector_entry_point=f"motor_env.envs:{_class}VectorEnv",
        reward_threshold=_best,
        kwargs=_options,
    )
