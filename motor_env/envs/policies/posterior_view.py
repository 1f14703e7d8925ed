"""The environments as an agent with a posterior sees them: for learning, beside what is observed at first hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorWrapper
from numpy.typing import NDArray

from motor_env.envs.policies.fault_posterior import ProbeBelief
from motor_env.envs.policies.rule_policies import Actions, Observations, Policy
from motor_env.envs.vector import MotorVectorEnv, Step
from motor_env.motor.parameters import require


class PosteriorView(VectorWrapper[Any, Any, Any]):
    """Vector environment that shows the summary of `ProbeBelief`, and pays the reward that it expects.

    Both follow from what the vector observes and from the actions, so an agent can have them. The expected reward is
    the true one on average, without the noise of luck; the returns of an episode are not those of the truth.

    Args:
        envs: a vector of a task that `ProbeBelief` knows, with the autoreset mode SameStep.

    Raises:
        ValueError: the vector has another autoreset mode, or its task another posterior.
    """

    def __init__(self, envs: MotorVectorEnv) -> None:
        require(
            envs.autoreset_mode is AutoresetMode.SAME_STEP,
            f"autoreset_mode of the vector must be SameStep, got {envs.autoreset_mode.value}",
        )
        super().__init__(envs)
        self.autoreset_mode, self.belief = envs.autoreset_mode, ProbeBelief(envs.setup)
        self.belief.start(self.num_envs)
        shape = self.belief.summary().shape
        self.observation_space = spaces.Box(-4.0, 4.0, shape, dtype=np.float32)
        self.single_observation_space = spaces.Box(-4.0, 4.0, shape[1:], dtype=np.float32)

    def reset(self, **given: Any) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes everywhere."""
        _, info = self.env.reset(**given)
        self.belief.start(self.num_envs)
        return self.belief.summary(), info

    def step(self, actions: Actions) -> Step:
        """Learn from what followed."""
        declares = self.belief.setup.declarations[actions] > 0
        said = self.belief.expected_reward(actions)
        waited = self.belief.expected_reward(np.where(declares, 0, actions))
        observations, _, terminated, truncated, info = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            observations = observations.copy()
            observations[over] = np.stack(info["final_obs"][over])
        self.belief.update(observations)
        last = self.belief.summary()
        self.belief.restart(over)
        for n in np.flatnonzero(over):
            info["final_obs"][n] = last[n]
        summary = self.belief.summary() if over.any() else last
        return summary, np.where(terminated & declares, said, waited), terminated, truncated, info


class Summarised(Policy):
    """Policy of an environment, from one that was learned in a `PosteriorView` of it.

    Args:
        belief: of the environment's setup.
        choose: actions for summaries of shape (count, n_columns).
    """

    def __init__(self, belief: ProbeBelief, choose: Any) -> None:
        self.belief, self._choose = belief, choose

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self.belief.start(count)

    def act(self, observations: Observations) -> Actions:
        """What is chosen."""
        self.belief.watch(observations)
        actions: NDArray[np.int64] = self._choose(self.belief.summary()).astype(np.int64)
        return actions
