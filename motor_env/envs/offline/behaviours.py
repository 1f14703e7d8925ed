"""The policies whose episodes are recorded, from random actions to the best that is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.detection.rules import Cusum
from motor_env.envs.drive.lqg import Lqg
from motor_env.envs.maintain.replacement import PlannedUpkeep, ReplaceFrom
from motor_env.envs.policies.posterior_policies import BayesPolicy
from motor_env.envs.policies.probing import Bursts, OnDemand, OpenLoop, WorthTest
from motor_env.envs.policies.rule_policies import Observations, Player, RulePolicy, baseline_features


class Behaviour(StrEnum):
    """Who acted."""

    RANDOM = "random"
    RULE = "rule"
    BEST = "best"
    MIXED = "mixed"


class Uniform:
    """Every action is as likely as any other.

    Args:
        space: of the actions of one sub-environment.
        seed: of its random numbers.
    """

    def __init__(self, space: Any, seed: int) -> None:
        self._rng, self._space = np.random.default_rng(seed), space

    def start(self, count: int) -> None:
        """So many sub-environments begin."""
        self._count = count

    def act(self, observations: Observations) -> NDArray[Any]:
        """Any action."""
        if isinstance(self._space, spaces.Box):
            return self._rng.uniform(self._space.low, self._space.high, (self._count, *self._space.shape))
        return self._rng.integers(0, self._space.n, self._count)


@dataclass(frozen=True, slots=True)
class Task:
    """How the policies of one id are made, from its vector environment.

    Attributes:
        rule: a textbook rule, tuned.
        best: the best policy known, up to what is learned.
        options: what the environment must observe for them.
    """

    rule: Callable[[Any], Player]
    best: Callable[[Any], Player]
    options: Mapping[str, Any] = field(default_factory=dict)


def _bursts(envs: Any) -> Player:
    return OpenLoop(WorthTest(envs.setup, 0.93), Bursts(20, 10, 2).actions(envs.options.n_steps))


TASKS = {
    "Monitor-v0": Task(
        lambda envs: RulePolicy(envs.setup, Cusum(0.25, two_sided=True), threshold=30.0),
        lambda envs: BayesPolicy(envs.setup, 0.9609),
        {"observe": baseline_features("medium")},
    ),
    "Probe-v0": Task(_bursts, lambda envs: OnDemand(WorthTest(envs.setup, 0.97), 0.08)),
    "Maintain-v0": Task(lambda envs: ReplaceFrom("mean", 0.84), lambda envs: PlannedUpkeep(envs.options)),
    "MaintainUnknownRate-v0": Task(
        lambda envs: ReplaceFrom("mean", 0.84), lambda envs: PlannedUpkeep(envs.options)
    ),
    "Drive-v0": Task(lambda envs: Lqg(envs.setup), lambda envs: Lqg(envs.setup, levels=4)),
}
"""Thresholds with the best mean return on episodes of other seeds."""
