"""A DC motor that may be failing: simulation, Kalman filter, decision rules, diagnosis, gymnasium environments.

Importing the package registers its environments with gymnasium. Everything else is loaded when first used;
`__init__.pyi` lists what is public.
"""

import lazy_loader
from gymnasium.envs.registration import register

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

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
