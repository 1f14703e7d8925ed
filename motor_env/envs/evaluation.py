"""Scores of a policy on a task: one episode in each sub-environment, with intervals."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from motor_env.envs.policies import Policy
from motor_env.envs.vector import MotorVectorEnv
from motor_env.parameters import FloatArray


@dataclass(frozen=True, slots=True)
class Score:
    """How a policy did over a number of episodes.

    Attributes:
        episodes: their number.
        mean_return: mean return of an episode.
        return_half_width: half the width of its 95 % interval.
        false_alarm_share: share of all episodes that end in a declaration before any fault had acted.
        detected_share: share of the episodes with a fault, not ended before, that end in a declaration after it.
        isolated_share: share of those declarations that name the right kind.
        median_delay_s: median time from onset to declaration among the detected.
        late_share: share of the episodes with a fault whose onset leaves less than 1 % of the horizon: no rule's fault.
    """

    episodes: int
    mean_return: float
    return_half_width: float
    false_alarm_share: float
    detected_share: float
    isolated_share: float
    median_delay_s: float
    late_share: float

    def as_row(self) -> dict[str, float]:
        """The fields by name."""
        return asdict(self)


def run_episodes(envs: MotorVectorEnv, policy: Policy, seed: int) -> dict[str, FloatArray]:
    """One episode of each sub-environment: return, steps, declared kind (0: none), right kind, onset in samples."""
    count = envs.num_envs
    observations, info = envs.reset(seed=seed)
    onset = info["onset_sample"].astype(float)
    right = envs.right_declaration[info["class_index"]]
    policy.start(count)
    returns, steps, declared = np.zeros(count), np.zeros(count), np.zeros(count)
    alive = np.ones(count, dtype=bool)
    for step in range(envs.options.n_steps):
        actions = policy.act(observations)
        observations, rewards, terminated, _, _ = envs.step(actions)
        returns += rewards * alive
        ended = alive & terminated
        steps[ended] = step
        declared[ended] = envs.setup.declarations[actions[ended]]
        alive &= ~terminated
        if not alive.any():
            break
    return {"return": returns, "steps": steps, "declared": declared, "right": right, "onset": onset}


def score(envs: MotorVectorEnv, policy: Policy, seed: int) -> Score:
    """Score of the policy on the streams of that seed."""
    runs = run_episodes(envs, policy, seed)
    options = envs.options
    onset, declared, right = runs["onset"], runs["declared"], runs["right"]
    at = runs["steps"] * options.samples_per_step
    happens = (onset >= 0) & (onset < options.n_samples)
    said = declared > 0
    false = said & ~((onset >= 0) & (at > onset))
    detected = said & ~false
    could = happens & ~false
    delay = (at - onset)[detected] * options.dt_s
    return Score(
        episodes=len(onset),
        mean_return=float(runs["return"].mean()),
        return_half_width=float(1.96 * runs["return"].std(ddof=1) / np.sqrt(len(onset))),
        false_alarm_share=float(false.mean()),
        detected_share=float(detected.sum() / max(1, could.sum())),
        isolated_share=float((declared == right)[detected].mean()) if detected.any() else float("nan"),
        median_delay_s=float(np.median(delay)) if detected.any() else float("nan"),
        late_share=float((happens & (onset > 0.99 * options.n_samples)).sum() / max(1, happens.sum())),
    )
