"""A DC motor that may be failing: simulation, Kalman filter, decision rules, diagnosis, gymnasium environments.

Importing the package registers its environments with gymnasium. Everything else is loaded when first used;
`__init__.pyi` lists what is public.
"""

import lazy_loader
from gymnasium.envs.registration import register

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Id, module and class, options, return of the best policy known (docs/environments.md, docs/decisions.md); on a
# monitor it decides after each sample.
for _id, _class, _options, _best in (
    ("Monitor", "monitor:Monitor", {}, 0.889),
    ("MonitorEasy", "monitor:Monitor", {"recipe": "easy"}, 0.989),
    ("MonitorHard", "monitor:Monitor", {"recipe": "hard"}, 0.744),
    ("MonitorSmall", "monitor:Monitor", {"recipe": "small"}, 0.514),
    ("MonitorSpeedLoop", "monitor:Monitor", {"drive": "speed_loop"}, 0.714),
    ("Probe", "probe:Probe", {}, 0.892),
    ("ProbeMedium", "probe:Probe", {"recipe": "medium"}, 0.933),
    ("ProbeContinuous", "probe:ProbeContinuous", {}, 0.892),
    ("Drive", "drive.env:Drive", {}, -1.563),
    ("DriveHeavy", "drive.env:Drive", {"load_torque_n_m": 12e-3}, -1.734),
    ("DriveBearing", "drive.env:Drive", {"weights": (1.0, 2.0, 0.0)}, -1.521),
    ("Maintain", "maintain.environment:Maintain", {}, -2.292),
    ("MaintainUnknownRate", "maintain.environment:Maintain", {"rate_spread": 0.5}, -1.933),
):
    register(
        id=f"motor_env/{_id}-v0",
        entry_point=f"motor_env.envs.{_class}Env",
        vector_entry_point=f"motor_env.envs.{_class}VectorEnv",
        reward_threshold=_best,
        kwargs=_options,
    )
