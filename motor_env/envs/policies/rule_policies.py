"""Policies for many sub-environments at once: decision rules with the bank of filters.

    policy.start(n)                     reset to n sub-environments
    actions = policy.act(observations)  one action for each

A rule detects a fault. Its kind is the one with the largest `evidence_*` in the observation, see `baseline_features`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.common.arrays import instance, whole
from motor_env.detection.rules import Rule, RuleStream
from motor_env.envs.options import task_recipe
from motor_env.envs.setup import EVIDENCE_SCALE, Setup, bank_kinds
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

Actions = NDArray[np.int64]
Observations = NDArray[np.float32]


def baseline_features(recipe: Recipe | str) -> tuple[str, ...]:
    """Return the features that these policies read."""
    return (
        "measured_current",
        "innovation_current",
        "voltage",
        "time",
        *(f"evidence_{kind}" for kind in bank_kinds(task_recipe(recipe))),
    )


def declarations(setup: Setup) -> Actions:
    """Return the action that declares each kind."""
    return len(setup.offsets_v) - len(setup.kinds) + np.arange(len(setup.kinds))


def column(setup: Setup, name: str) -> int:
    """Return the column of a feature in the observation.

    Raises:
        ValueError: no such column.
    """
    names = list(setup.observed)
    require(name in names, f"this policy needs the feature {name}; observed are {', '.join(names)}")
    return names.index(name)


class Player(Protocol):
    """Actor in many sub-environments at once."""

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""

    def act(self, observations: Observations) -> NDArray[Any]:
        """Return one action for each."""


class Policy(ABC):
    """Maps observations to actions, with a state of its own."""

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        self.count = count

    @abstractmethod
    def act(self, observations: Observations) -> Actions:
        """Return one action for each sub-environment; observations have shape (count, n_features)."""


class ThresholdPolicy(Policy):
    """Declares once a statistic reaches `threshold`; before that nothing depends on it."""

    threshold: float

    @abstractmethod
    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the statistic, and the declaration at the threshold; both of shape (count,)."""

    def probe(self) -> Actions:
        """Return the actions without a declaration: wait."""
        return np.zeros(self.count, dtype=np.int64)

    def act(self, observations: Observations) -> Actions:
        """Declare where the statistic reaches the threshold, else probe."""
        statistic, declaration = self.judge(observations)
        return np.where(statistic >= self.threshold, declaration, self.probe())


class Never(ThresholdPolicy):
    """Waits in every step."""

    threshold = 1.0

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return a statistic below the threshold."""
        return np.zeros(self.count), np.zeros(self.count, dtype=np.int64)


class Random:
    """Takes random actions with equal probability.

    Args:
        space: actions of one sub-environment.
        seed: of its random numbers.
    """

    def __init__(self, space: Any, seed: int) -> None:
        self._rng, self._space = np.random.default_rng(whole("seed", seed)), space

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        self._count = count

    def act(self, observations: Observations) -> NDArray[Any]:
        """Draw one action for each sub-environment."""
        if isinstance(self._space, spaces.Box):
            return self._rng.uniform(self._space.low, self._space.high, (self._count, *self._space.shape))
        return self._rng.integers(0, self._space.n, self._count)


class _Isolating(ThresholdPolicy):
    """Names the kind with the largest evidence."""

    def __init__(self, setup: Setup) -> None:
        instance("setup", setup, Setup)
        names = list(setup.observed)
        self._columns = [m for m, name in enumerate(names) if name.startswith("evidence_")]
        require(bool(self._columns), "this policy needs an environment that observes evidence")
        verdicts = [FaultKind(names[m].removeprefix("evidence_")).verdict for m in self._columns]
        self._action = declarations(setup)[[setup.kinds.index(v) for v in verdicts]]

    def _isolate(self, observations: Observations) -> Actions:
        actions: Actions = self._action[observations[:, self._columns].argmax(axis=1)]
        return actions


class RulePolicy(_Isolating):
    """Declares when a rule on the whitened innovation reaches its threshold.

    Args:
        setup: of the environment.
        rule: any rule of `motor_env.detection.rules` for one channel.
        threshold: of its statistic.
    """

    def __init__(self, setup: Setup, rule: Rule, *, threshold: float) -> None:
        super().__init__(setup)
        self.rule, self.threshold = rule, threshold
        self._innovation = column(setup, "innovation_current")
        self._stream: RuleStream | None = None

    def start(self, count: int) -> None:
        """Reset to `count` sub-environments."""
        super().start(count)
        self._stream = None

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the rule's statistic; the first observation follows no sample and does not count."""
        declaration = self._isolate(observations)
        if self._stream is None:
            self._stream = self.rule.stream(self.count)
            return np.full(self.count, -np.inf), declaration
        return self._stream.update(observations[:, [self._innovation]].astype(np.float64)), declaration


class BankPolicy(_Isolating):
    """Declares the kind whose evidence reaches a threshold first: a matched CUSUM for each kind.

    Args:
        setup: of the environment.
        threshold: log-likelihood ratio.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        super().__init__(setup)
        self.threshold = threshold

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Return the largest log-likelihood ratio."""
        evidence = observations[:, self._columns].max(axis=1) / EVIDENCE_SCALE
        return evidence.astype(np.float64), self._isolate(observations)
