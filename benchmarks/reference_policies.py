"""What plays in the table of reference scores: for each id a textbook policy and the best known, and a bound.

Designs and thresholds were tuned by sweeps, and by drive_scores.py beside this file, on seeds that the table does not
use.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from best_policies import LookAhead, PlannedDecisions, PlannedDrive, ShownFaults
from bounds import drive_bound, maintenance_bound, upper_bound
from numpy.typing import NDArray

from motor_env.detection.rules import Cusum, Glr
from motor_env.envs import (
    BankPolicy,
    BayesPolicy,
    EventTriggeredProbing,
    ExpectedRewardTest,
    Lqg,
    MonitorOptions,
    PlannedUpkeep,
    RulePolicy,
    ThresholdReplacement,
    baseline_features,
)
from motor_env.envs.policies.residual_posterior import ResidualPosterior
from motor_env.envs.policies.rule_policies import Player

Make = Callable[[Any], Player]
"""A policy from its vector environment."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The policies of one id.

    Attributes:
        textbook: name and policy.
        best: the same of the best policy known.
        bound: what no policy exceeds in the mean, from the options; None: nobody knows such a figure.
        options: what the environment observes for them.
        episodes: of each seed of a score; policies that think long get fewer.
    """

    textbook: tuple[str, Make]
    best: tuple[str, Make]
    bound: Callable[[Any], float] | None = None
    options: dict[str, Any] = field(default_factory=dict)
    episodes: int = 250


class Continuous:
    """A policy of a probe with a list of actions, where the voltage is continuous.

    Args:
        envs: with continuous actions.
        make: the policy.
    """

    def __init__(self, envs: Any, make: Make) -> None:
        setup, most = envs.setup, envs.options.max_offset_v
        self._policy = make(envs)
        kinds = np.arange(1, len(setup.kinds) + 1) == setup.declarations[:, None]
        self._actions = np.column_stack([setup.offsets_v / most, kinds])

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        self._policy.start(count)

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """The same choice in numbers."""
        actions: NDArray[Any] = self._actions[self._policy.act(observations)]
        return actions


class Steadfast:
    """A policy that keeps to the kind that it has named: it has to be named several times in a row.

    Args:
        policy: of a monitor.
    """

    def __init__(self, policy: Player) -> None:
        self._policy = policy

    def start(self, count: int) -> None:
        """Forget everything; so many sub-environments begin."""
        self._policy.start(count)
        self._said = np.zeros(count, dtype=np.int64)

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """The kind that was named first, 0 before."""
        self._said = np.where(self._said > 0, self._said, self._policy.act(observations))
        return self._said


def _rule(rule: Any, threshold: float) -> Make:
    return lambda envs: RulePolicy(envs.setup, rule, threshold=threshold)


def _steadfast_rule(rule: Any, threshold: float) -> Make:
    return lambda envs: Steadfast(RulePolicy(envs.setup, rule, threshold=threshold))


def _at_every_sample(options: MonitorOptions) -> float:
    """The bound of an agent that may declare after every sample: it can do all that others can."""
    return upper_bound(replace(options, samples_per_step=1, confirm_steps=1))


def _look(bonus: float, threshold: float) -> Make:
    return lambda envs: LookAhead(ExpectedRewardTest(envs.setup, threshold), bonus)


def _ask(above: float, threshold: float) -> Make:
    return lambda envs: EventTriggeredProbing(ExpectedRewardTest(envs.setup, threshold), above)


_UPKEEP = Reference(
    ("threshold on the remaining life", lambda envs: ThresholdReplacement("risk", 0.01)),
    ("plan", lambda envs: PlannedUpkeep(envs.options)),
    maintenance_bound,
    episodes=15_000,
)
_SMALL_PROBE = Reference(("on demand", _ask(0.08, 0.9867)), ("look ahead", _look(0.0006, 0.961)), upper_bound)

REFERENCES = {
    "Monitor-v0": Reference(
        ("CUSUM", _rule(Cusum(0.3, two_sided=True), 16.0)),
        ("Bayes posterior", lambda envs: ExpectedRewardTest(envs.setup, 0.8)),
        _at_every_sample,
        {"observe": baseline_features("medium")},
    ),
    "MonitorHard-v0": Reference(
        ("CUSUM", _steadfast_rule(Cusum(1.5, two_sided=True), 8.0)),
        ("bank of filters", lambda envs: BankPolicy(envs.setup, 7.5)),
        _at_every_sample,
        {"observe": baseline_features("hard")},
    ),
    "MonitorSpeedLoop-v0": Reference(
        ("CUSUM", _steadfast_rule(Cusum(1.2, two_sided=True), 5.0)),
        ("GLR of a step", _steadfast_rule(Glr(1, 60, two_sided=True), 18.0)),
        None,
        {"observe": baseline_features("medium")},
    ),
    "MonitorSensor-v0": Reference(
        ("bank of hypotheses", lambda envs: ResidualPosterior(envs.setup, 0.9)),
        ("bank of hypotheses", lambda envs: ResidualPosterior(envs.setup, 0.9)),
        _at_every_sample,
        {"observe": ("innovation_current", "innovation_speed")},
    ),
    "MonitorInstant-v0": Reference(
        ("CUSUM", _rule(Cusum(0.12, two_sided=True), 63.07)),
        ("Bayes posterior", lambda envs: BayesPolicy(envs.setup, 0.9609)),
        upper_bound,
        {"observe": baseline_features("medium")},
    ),
    "Probe-v0": Reference(("on demand", _ask(0.08, 0.93)), ("look ahead", _look(0.0006, 0.95)), upper_bound),
    "ProbeContinuous-v0": Reference(
        ("on demand", lambda envs: Continuous(envs, _SMALL_PROBE.textbook[1])),
        ("look ahead", lambda envs: Continuous(envs, _SMALL_PROBE.best[1])),
    ),
    "ProbeInstant-v0": _SMALL_PROBE,
    "Drive-v0": Reference(
        ("two thresholds on what is seen", lambda envs: ShownFaults(envs.setup)),
        ("plan", lambda envs: PlannedDecisions(envs.setup)),
        drive_bound,
        episodes=200,
    ),
    "DriveControl-v0": Reference(
        ("LQG by a bank of filters", lambda envs: Lqg(envs.setup, levels=8)),
        ("plan", lambda envs: PlannedDrive(envs.setup)),
        drive_bound,
        episodes=500,
    ),
    "Maintain-v0": _UPKEEP,
    "MaintainUnknownRate-v0": _UPKEEP,
}
"""By id."""
