"""What plays in the table of reference scores: for each id a textbook policy and the best known, and a bound.

Designs and thresholds were tuned by sweeps, and by drive_scores.py beside this file, on seeds that the table does not
use.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from best_policies import LookAhead, PlannedDecisions, PlannedDrive, ShownFaults, TolerancePolicy
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


def _rule(rule: Any, threshold: float) -> Make:
    return lambda envs: RulePolicy(envs.setup, rule, threshold=threshold)


def _monitor(recipe: str, rule: tuple[str, Make], best: tuple[str, Make], **more: Any) -> Reference:
    return Reference(rule, best, upper_bound, {"observe": baseline_features(recipe)}, **more)


def _bayes(threshold: float) -> tuple[str, Make]:
    return "Bayes posterior", lambda envs: BayesPolicy(envs.setup, threshold)


def _look(bonus: float, threshold: float) -> Make:
    return lambda envs: LookAhead(ExpectedRewardTest(envs.setup, threshold), bonus)


def _ask(above: float, threshold: float) -> Make:
    return lambda envs: EventTriggeredProbing(ExpectedRewardTest(envs.setup, threshold), above)


_DRIVE = Reference(
    ("LQG by a bank of filters", lambda envs: Lqg(envs.setup, levels=8)),
    ("plan", lambda envs: PlannedDrive(envs.setup)),
    drive_bound,
    episodes=500,
)
_UPKEEP = Reference(
    ("threshold on the remaining life", lambda envs: ThresholdReplacement("risk", 0.01)),
    ("plan", lambda envs: PlannedUpkeep(envs.options)),
    maintenance_bound,
    episodes=15_000,
)
_SMALL_PROBE = Reference(("on demand", _ask(0.08, 0.9867)), ("look ahead", _look(0.0006, 0.961)), upper_bound)

REFERENCES = {
    "Monitor-v0": _monitor("medium", ("CUSUM", _rule(Cusum(0.12, two_sided=True), 63.07)), _bayes(0.9609)),
    "MonitorConfirm-v0": Reference(
        ("CUSUM", _rule(Cusum(0.3, two_sided=True), 16.0)),
        ("Bayes posterior", lambda envs: ExpectedRewardTest(envs.setup, 0.8)),
        lambda _: upper_bound(MonitorOptions()),  # all that it lets an agent do, Monitor-v0 does, too
        {"observe": baseline_features("medium")},
    ),
    "MonitorEasy-v0": _monitor(
        "easy",
        ("CUSUM", _rule(Cusum(0.48, two_sided=True), 24.57)),
        ("bank of filters", lambda envs: BankPolicy(envs.setup, 11.8)),
    ),
    "MonitorHard-v0": _monitor(
        "hard",
        ("GLR of a step", _rule(Glr(5, 400, two_sided=True), 38.5)),
        ("Bayes posterior, tolerances integrated out", lambda envs: TolerancePolicy(envs.setup, 0.9974)),
        episodes=60,
    ),
    "MonitorSmall-v0": _monitor(
        "small", ("GLR of a step", _rule(Glr(40, 1600, two_sided=True), 24.71)), _bayes(0.9772)
    ),
    "MonitorSpeedLoop-v0": Reference(
        ("CUSUM", _rule(Cusum(0.24, two_sided=True), 30.0)),
        ("bank of filters", lambda envs: BankPolicy(envs.setup, 8.775)),
        None,
        {"observe": baseline_features("medium")},
    ),
    "MonitorSensor-v0": Reference(
        ("bank of hypotheses", lambda envs: ResidualPosterior(envs.setup, 0.9)),
        ("bank of hypotheses", lambda envs: ResidualPosterior(envs.setup, 0.9)),
        upper_bound,
        {"observe": ("innovation_current", "innovation_speed")},
    ),
    "Probe-v0": _SMALL_PROBE,
    "ProbeConfirm-v0": Reference(
        ("on demand", _ask(0.08, 0.93)), ("look ahead", _look(0.0006, 0.95)), upper_bound
    ),
    "ProbeMedium-v0": Reference(
        ("on demand", _ask(0.03, 0.9609)), ("look ahead", _look(0.0015, 0.9329)), upper_bound
    ),
    "ProbeContinuous-v0": Reference(
        ("on demand", lambda envs: Continuous(envs, _SMALL_PROBE.textbook[1])),
        ("look ahead", lambda envs: Continuous(envs, _SMALL_PROBE.best[1])),
    ),
    "Drive-v0": _DRIVE,
    "DriveBounded-v0": _DRIVE,
    "DriveDecide-v0": Reference(
        ("two thresholds on what is seen", lambda envs: ShownFaults(envs.setup)),
        ("plan", lambda envs: PlannedDecisions(envs.setup)),
        drive_bound,
        episodes=200,
    ),
    "DriveHeavy-v0": _DRIVE,
    "DriveBearing-v0": _DRIVE,
    "Maintain-v0": _UPKEEP,
    "MaintainUnknownRate-v0": _UPKEEP,
}
"""By id."""
