"""Baselines with one interface: they see what an agent sees, for many sub-environments at once.

    policy.start(n)                     forget everything; n sub-environments begin
    actions = policy.act(observations)  one action for each

A rule says that something is wrong; which kind, the bank of filters says: the one with the largest `evidence_*`
in the observation. So an environment for these baselines observes `BASELINE_FEATURES`, see `baseline_features`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import kernel
from motor_env.envs.setup import VERDICT_OF, Setup
from motor_env.faults import FaultKind
from motor_env.parameters import require
from motor_env.recipes import Recipe
from motor_env.rules import Rule, RuleStream

Actions = NDArray[np.int64]
Observations = NDArray[np.float32]


def baseline_features(recipe: Recipe) -> tuple[str, ...]:
    """Features that the baselines read: measurement, innovation, evidence for each kind of the recipe, time."""
    kinds = dict.fromkeys(c.kind for c in recipe.classes if c.kind not in (None, FaultKind.NOISE))
    return (
        "measured_current",
        "innovation_current",
        "voltage",
        "time",
        *(f"evidence_{kind}" for kind in FaultKind if kind in kinds),
    )


def column(setup: Setup, name: str) -> int:
    """Column of a feature in the observation.

    Raises:
        ValueError: the environment does not observe it.
    """
    names = [kernel.FEATURES[m] for m in setup.chosen]
    require(name in names, f"this policy needs the feature {name}; observed are {', '.join(names)}")
    return names.index(name)


class Policy(ABC):
    """What decides: sees observations, remembers what it likes."""

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        self.count = count

    @abstractmethod
    def act(self, observations: Observations) -> Actions:
        """One action for each sub-environment, from observations of shape (count, n_features)."""


@dataclass
class Never(Policy):
    """Waits."""

    def act(self, observations: Observations) -> Actions:
        """Wait everywhere."""
        return np.zeros(len(observations), dtype=np.int64)


@dataclass
class Random(Policy):
    """Takes any action but waiting with a small probability.

    Attributes:
        n_actions: number of actions.
        rng: source of randomness.
        probability: of not waiting.
    """

    n_actions: int
    rng: np.random.Generator
    probability: float = 1e-3

    def act(self, observations: Observations) -> Actions:
        """Wait nearly everywhere."""
        anything = self.rng.integers(1, self.n_actions, len(observations))
        acts = self.rng.random(len(observations)) < self.probability
        return np.where(acts, anything, 0)


class _Isolating(Policy):
    """Names the kind with the largest evidence."""

    def __init__(self, setup: Setup) -> None:
        self._first_declaration = len(setup.offsets_v) - len(setup.kinds)
        names = [kernel.FEATURES[m] for m in setup.chosen]
        self._columns = [m for m, name in enumerate(names) if name.startswith("evidence_")]
        require(bool(self._columns), "this policy needs an environment that observes evidence")
        verdicts = [VERDICT_OF[FaultKind(names[m].removeprefix("evidence_"))] for m in self._columns]
        self._action = np.array([self._first_declaration + setup.kinds.index(v) for v in verdicts])

    def _isolate(self, observations: Observations) -> Actions:
        actions: Actions = self._action[observations[:, self._columns].argmax(axis=1)]
        return actions


class RulePolicy(_Isolating):
    """Declares when a rule on the whitened innovation passes its threshold.

    Args:
        setup: of the environment.
        rule: any rule of `motor_env.rules` for one channel.
        threshold: of its statistic.
    """

    def __init__(self, setup: Setup, rule: Rule, threshold: float) -> None:
        super().__init__(setup)
        self.rule, self.threshold = rule, threshold
        self._innovation = column(setup, "innovation_current")
        self._stream: RuleStream | None = None

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._stream = None

    def act(self, observations: Observations) -> Actions:
        """Wait until the rule alarms. The first observation follows no sample, so the rule does not see it."""
        if self._stream is None:
            self._stream = self.rule.stream(self.count, 1)
            return np.zeros(self.count, dtype=np.int64)
        statistic = self._stream.update(observations[:, [self._innovation]].astype(np.float64))
        return np.where(statistic >= self.threshold, self._isolate(observations), 0)


class BankPolicy(_Isolating):
    """Declares the kind whose evidence passes a threshold first: a matched CUSUM for each kind.

    Args:
        setup: of the environment.
        threshold: log-likelihood ratio.
    """

    def __init__(self, setup: Setup, threshold: float) -> None:
        super().__init__(setup)
        self.threshold = threshold
        self._scale = float(setup.view[0, kernel.FEATURES.index("evidence_bearing")])

    def act(self, observations: Observations) -> Actions:
        """Wait until a filter of the bank is believed."""
        evidence = observations[:, self._columns].max(axis=1) / self._scale
        return np.where(evidence >= self.threshold, self._isolate(observations), 0)
