"""Gymnasium environments in which a motor may be failing, textbook policies for them, and scores.

`import motor_env` registers the ids. Everything is loaded when first used; `__init__.pyi` lists what is public.

Begin with `reference`: a step on one page of NumPy. `monitor_and_probe` has the environments; `single` and `vector` run
their episodes, `stepping` is the compiled step, `kernel` the equations of a sample, `episode_sampling` what is random,
`layout` the arrays, `setup` their numbers. `drive` and `maintain` are families of their own; `policies` decide, and
`offline_data` records them. No policy reads the truth in an info.

Example:
    A textbook policy plays 100 episodes of the easy task.

    >>> from motor_env.envs import BankPolicy, MonitorVectorEnv, baseline_features, run_episodes, score
    >>> envs = MonitorVectorEnv(100, recipe="easy", observe=baseline_features("easy"))
    >>> result = score(envs, run_episodes(envs, BankPolicy(envs.setup, threshold=10.0), seed=1))
    >>> print(f"mean return {result.mean_return:.2f}")
    mean return 0.98
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
