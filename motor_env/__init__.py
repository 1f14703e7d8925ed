"""A DC motor that may be failing: simulation, Kalman filter, decision rules, diagnosis, gymnasium environments.

Importing the package registers its environments with gymnasium. Everything else is loaded when first used;
`__init__.pyi` lists what is public.
"""

import lazy_loader
from gymnasium.envs.registration import register

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Id, class, options, and a return that the best policy known reaches: its mean less one standard error, as
# `python benchmarks/reference_scores.py` measures it. The plain name of a family is the one to begin with. The
# `Instant` ids decide more often, and the first declaration counts.
_INSTANT = {"samples_per_step": 1, "confirm_steps": 1}
_PROBE_INSTANT = {"samples_per_step": 20, "confirm_steps": 1, "offsets_v": (0.0, -1.0, 1.0)}
for _id, _class, _options, _best in (
    ("Monitor", "Monitor", {}, 0.882),
    ("MonitorHard", "Monitor", {"recipe": "hard"}, 0.442),
    ("MonitorSpeedLoop", "Monitor", {"drive": "speed_loop"}, 0.662),
    ("MonitorSensor", "Monitor", {"recipe": "sensor", "growth_s": 0.1}, 0.814),
    ("MonitorInstant", "Monitor", _INSTANT, 0.889),
    ("Probe", "Probe", {}, 0.851),
    ("ProbeContinuous", "ProbeContinuous", _PROBE_INSTANT, 0.887),
    ("ProbeInstant", "Probe", _PROBE_INSTANT, 0.887),
    ("Drive", "Drive", {}, -1.412),
    ("DriveControl", "Drive", {"control": "voltage_limp_stop", "steps_per_decision": 1}, -1.32),
    ("Maintain", "Maintain", {}, -2.299),
    ("MaintainUnknownRate", "Maintain", {"rate_spread": 0.5}, -1.926),
):
    register(
        id=f"motor_env/{_id}-v0",
        entry_point=f"motor_env.envs:{_class}Env",
        vector_entry_point=f"motor_env.envs:{_class}VectorEnv",
        reward_threshold=_best,
        kwargs=_options,
    )
