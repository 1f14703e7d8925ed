"""Vector environments for learning libraries that do not take gymnasium's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from motor_env.common.arrays import instance, shown
from motor_env.common.errors import require_extra
from motor_env.motor.parameters import require

require_extra("stable_baselines3", "rl")
from stable_baselines3.common.monitor import Monitor  # noqa: E402  # the sentence comes first
from stable_baselines3.common.vec_env.base_vec_env import VecEnv  # noqa: E402


class StableBaselinesVecEnv(VecEnv):
    """A vector environment as a VecEnv of Stable-Baselines3 (extra `rl`).

    The info of each sub-environment is empty within an episode; at its end it has `terminal_observation`,
    `TimeLimit.truncated`, the truth, and `episode` with return and length, as Stable-Baselines3's Monitor gives it.

    Args:
        envs: a vector with the autoreset mode SameStep, or a view of one.

    Raises:
        ValueError: the vector has another autoreset mode.
    """

    def __init__(self, envs: Any) -> None:
        instance("envs", envs, VectorEnv)
        require(
            envs.autoreset_mode is AutoresetMode.SAME_STEP,
            f"autoreset_mode of the vector must be SameStep, got {envs.autoreset_mode.value}",
        )
        self.envs = envs
        self.render_mode = None
        self._actions: Any = None
        self._pending_seed: int | None = None
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, dtype=np.int64)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed of the next reset; sub-environment n then runs the stream (seed, n)."""
        self._pending_seed = seed
        return [seed] * self.num_envs

    def reset(self) -> NDArray[np.float32]:
        """Begin episodes everywhere."""
        observations, _ = self.envs.reset(seed=self._pending_seed)
        self._pending_seed = None
        self._returns[:], self._lengths[:] = 0.0, 0
        return np.ascontiguousarray(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step every sub-environment."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        over = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        labels = getattr(self.envs.unwrapped, "by_class", {}).get("label")
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for n in np.flatnonzero(over):
            last = info["final_info"]
            infos[n] = {
                "terminal_observation": info["final_obs"][n],
                "TimeLimit.truncated": bool(truncated[n] and not terminated[n]),
                "episode": {"r": float(self._returns[n]), "l": int(self._lengths[n])},
                **({} if labels is None else {"label": labels[last["class_index"][n]]}),
                **{name: value[n] for name, value in last.items() if not name.startswith("_")},
            }
        self._returns[over], self._lengths[over] = 0.0, 0
        return np.ascontiguousarray(observations), rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Close the vector."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of the vector, once for each index."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: the sub-environments are one object."""
        raise NotImplementedError("the sub-environments of a compiled vector cannot be set apart")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: the sub-environments are one object."""
        raise NotImplementedError("the sub-environments of a compiled vector have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """True for Monitor, whose `episode` the infos have, else False."""
        return [issubclass(Monitor, wrapper_class)] * len(list(self._get_indices(indices)))

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Refuse options of a reset."""
        given: Sequence[Any] = options if isinstance(options, list | tuple) else [options]
        if not all(each is None or (isinstance(each, dict) and not each) for each in given):
            raise NotImplementedError(f"a compiled vector has no options of a reset, got {shown(options)}")
