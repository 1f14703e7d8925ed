"""Baselines with one interface: they see what an agent sees, for many sub-environments at once.

    policy.start(n)                     forget everything; n sub-environments begin
    actions = policy.act(observations)  one action for each

A rule says that something is wrong; which kind, the bank of filters says: the one with the largest `evidence_*`
in the observation. So an environment for these baselines observes `BASELINE_FEATURES`, see `baseline_features`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from motor_env.detection.rules import Rule, RuleStream
from motor_env.envs.options import task_recipe
from motor_env.envs.setup import EVIDENCE_SCALE, Setup, bank_kinds
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

Actions = NDArray[np.int64]
Observations = NDArray[np.float32]


def baseline_features(recipe: Recipe | str) -> tuple[str, ...]:
    """Features that the baselines read: measurement, innovation, evidence for each kind of the recipe, time."""
    return (
        "measured_current",
        "innovation_current",
        "voltage",
        "time",
        *(f"evidence_{kind}" for kind in bank_kinds(task_recipe(recipe))),
    )


def declarations(setup: Setup) -> Actions:
    """The action that declares each kind."""
    return len(setup.offsets_v) - len(setup.kinds) + np.arange(len(setup.kinds))


def column(setup: Setup, name: str) -> int:
    """Column of a feature in the observation.

    Raises:
        ValueError: the environment does not observe it.
    """
    names = list(setup.observed)
    require(name in names, f"this policy needs the feature {name}; observed are {', '.join(names)}")
    return names.index(name)


class Player(Protocol):
    """What acts in many sub-environments at once."""

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""

    def act(self, observations: Observations) -> NDArray[Any]:
        """One action for each."""


class Policy(ABC):
    """Turns observations into actions, with a memory of its own."""

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        self.count = count

    @abstractmethod
    def act(self, observations: Observations) -> Actions:
        """One action for each sub-environment, from observations of shape (count, n_features)."""


class ThresholdPolicy(Policy):
    """Declares once a statistic reaches a threshold. Until then neither statistic nor voltage depends on it.

    Attributes:
        threshold: of the statistic.
    """

    threshold: float

    @abstractmethod
    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Statistic, and the declaration to make where it is large; both of shape (count,)."""

    def probe(self) -> Actions:
        """Actions where nothing is declared after `judge`: wait."""
        return np.zeros(self.count, dtype=np.int64)

    def act(self, observations: Observations) -> Actions:
        """Declare where the statistic reaches the threshold."""
        statistic, declaration = self.judge(observations)
        return np.where(statistic >= self.threshold, declaration, self.probe())


class Never(ThresholdPolicy):
    """Waits in every step."""

    threshold = 1.0

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """Nothing is ever seen."""
        return np.zeros(self.count), np.zeros(self.count, dtype=np.int64)


class Random(ThresholdPolicy):
    """Every action is as likely as any other, in each step anew.

    Args:
        setup: of the environment.
        rng: source of randomness.
    """

    def __init__(self, setup: Setup, rng: np.random.Generator) -> None:
        self._declarations, self._n_offsets = declarations(setup), len(setup.offsets_v) - len(setup.kinds)
        self._rng, self.threshold = rng, self._n_offsets / len(setup.offsets_v)

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """A number from 0 to 1, and any kind."""
        return self._rng.random(self.count), self._rng.choice(self._declarations, self.count)

    def probe(self) -> Actions:
        """Any offset."""
        return self._rng.integers(0, self._n_offsets, self.count)


class _Isolating(ThresholdPolicy):
    """Names the kind with the largest evidence."""

    def __init__(self, setup: Setup) -> None:
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
        """Forget everything; so many sub-environments begin."""
        super().start(count)
        self._stream = None

    def judge(self, observations: Observations) -> tuple[FloatArray, Actions]:
        """The rule's statistic. The first observation follows no sample, so the rule does not see it."""
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
        """The largest log-likelihood ratio."""
        evidence = observations[:, self._columns].max(axis=1) / EVIDENCE_SCALE
        return evidence.astype(np.float64), self._isolate(observations)
