"""Episodes of known policies, written as a Minari data set."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import filling
from motor_env.detection.rules import Cusum
from motor_env.envs.drive.lqg import Lqg
from motor_env.envs.maintain.replacement import PlannedUpkeep, ThresholdReplacement
from motor_env.envs.policies.posterior_policies import (
    Bursts,
    EventTriggeredProbing,
    ExpectedRewardTest,
    OpenLoop,
)
from motor_env.envs.policies.rule_policies import Player, Random, RulePolicy, baseline_features
from motor_env.motor.parameters import FloatArray


class Behaviour(StrEnum):
    """Policy of a data set."""

    RANDOM = "random"
    RULE = "rule"
    BEST = "best"
    MIXED = "mixed"


@dataclass(frozen=True, slots=True)
class Task:
    """Makers of the policies of one id, from its vector environment."""

    rule: Callable[[Any], Player]  # a textbook rule, tuned
    best: Callable[[Any], Player]  # the best policy known that is not learned
    options: Mapping[str, Any] = field(default_factory=dict)  # of the environment, for what they observe


def _bursts(envs: Any) -> Player:
    return OpenLoop(ExpectedRewardTest(envs.setup, 0.93), Bursts(10, 5, 2).actions(envs.options.n_steps))


def _upkeep(envs: Any) -> Player:
    return ThresholdReplacement("mean", 0.84)


TASKS = {
    "Monitor-v0": Task(
        lambda envs: RulePolicy(envs.setup, Cusum(0.3, two_sided=True), threshold=16.0),
        lambda envs: ExpectedRewardTest(envs.setup, 0.8),
        {"observe": baseline_features("medium")},
    ),
    "Probe-v0": Task(_bursts, lambda envs: EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.93), 0.08)),
    "DriveControl-v0": Task(lambda envs: Lqg(envs.setup), lambda envs: Lqg(envs.setup, levels=4)),
    "Maintain-v0": Task(_upkeep, lambda envs: PlannedUpkeep(envs.options)),
    "MaintainUnknownRate-v0": Task(_upkeep, lambda envs: PlannedUpkeep(envs.options)),
}
"""Thresholds with the best mean return on episodes of other seeds."""


_AT_ONCE = 100
_PURE = (Behaviour.RANDOM, Behaviour.RULE, Behaviour.BEST)


class Episode(NamedTuple):
    """One episode of n steps."""

    observations: NDArray[np.float32]  # shape (n + 1, n_features)
    actions: NDArray[Any]  # shape (n,)
    rewards: FloatArray  # shape (n,)
    seed: int  # of its stream
    stream: int  # its index: a single environment reset with both repeats the episode


def play(envs: Any, policy: Player, seed: int) -> list[Episode]:
    """Play one episode of a policy in each sub-environment."""
    observation, _ = envs.reset(seed=seed)
    policy.start(envs.num_envs)
    all_observations, all_actions, all_rewards = [np.array(observation)], [], []
    length = np.zeros(envs.num_envs, dtype=np.int64)
    running = np.ones(envs.num_envs, dtype=np.bool_)
    while running.any():
        actions = policy.act(observation).astype(envs.single_action_space.dtype)
        observation, rewards, terminated, _, _ = envs.step(actions)
        all_observations.append(np.array(observation))
        all_actions.append(actions)
        all_rewards.append(rewards)
        length += running
        running &= ~terminated
    observations, actions, rewards = map(np.array, (all_observations, all_actions, all_rewards))
    return [
        Episode(observations[: n + 1, k], actions[:n, k], rewards[:n, k], seed, k)
        for k, n in enumerate(length.tolist())
    ]


def episodes_of(task: str, behaviour: Behaviour, count: int, seed: int) -> list[Episode]:
    """Play `count` episodes; those of `mixed` come from the three others."""
    if behaviour is Behaviour.MIXED:
        shares = [count // 3 + (k < count % 3) for k in range(3)]
        parts = [
            episodes_of(task, each, share, seed + k)
            for k, (each, share) in enumerate(zip(_PURE, shares, strict=True))
            if share
        ]
        return [episode for part in parts for episode in part]
    policies, played = TASKS[task], []
    for begin in range(0, count, _AT_ONCE):
        envs: Any = gym.make_vec(
            f"motor_env/{task}", num_envs=min(_AT_ONCE, count - begin), **policies.options
        ).unwrapped
        stream = (seed << 20) + begin
        if behaviour is Behaviour.RANDOM:
            policy: Player = Random(envs.single_action_space, stream)
        else:
            policy = (policies.rule if behaviour is Behaviour.RULE else policies.best)(envs)
        played += play(envs, policy, stream)
    return played


def record(task: str, behaviour: Behaviour, folder: Path, *, episodes: int = 300, seed: int = 0) -> str:
    """Write a data set below a folder (Minari's MINARI_DATASETS_PATH); return its name.

    Scores are normalised by random actions (0) and the best policy known (1).

    Raises:
        InputError: an unknown task, no episode, Minari is not installed, or the data set is there already.
    """
    if task not in TASKS:
        raise InputError(f"task must be one of {', '.join(TASKS)}, got {task!r}")
    if episodes < 1 or not 0 <= seed < 2**32:
        raise InputError(f"episodes must be >= 1 and seed in 0 .. 2^32 - 1, got {episodes} and {seed}")
    require_extra("minari", "minari")
    import minari
    from minari.data_collector import EpisodeBuffer

    name = f"motor_env/{task.removesuffix('-v0')}/{behaviour}-v0"
    if (folder / name).exists():
        raise InputError(f"{folder / name}: is there already; choose another folder, or remove it")
    recorded = episodes_of(task, behaviour, episodes, seed)
    random = recorded if behaviour is Behaviour.RANDOM else episodes_of(task, Behaviour.RANDOM, 100, seed)
    buffers = [
        EpisodeBuffer(
            id=number,
            seed=episode.seed,
            options={"index": episode.stream},
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards.tolist(),
            terminations=[False] * (len(episode.rewards) - 1) + [True],
            truncations=[False] * len(episode.rewards),
        )
        for number, episode in enumerate(recorded)
    ]
    env = gym.make(f"motor_env/{task}", **TASKS[task].options)
    assert env.spec is not None  # noqa: S101  # it was made by its id
    with filling(folder) as unfinished, _minari_below(unfinished):
        minari.create_dataset_from_buffers(
            name,
            buffers,
            env=env,
            algorithm_name=str(behaviour),
            ref_min_score=float(np.mean([episode.rewards.sum() for episode in random])),
            ref_max_score=env.spec.reward_threshold,
            description=f"{episodes} episodes of the policy '{behaviour}' in {env.spec.id}, seed {seed}.",
            requirements=["motor-env"],
            data_format="arrow",
        )
    return name


@contextmanager
def _minari_below(folder: Path) -> Iterator[None]:
    """Let Minari write below this folder, without its warnings."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder.absolute())  # no other way; it fails on relative paths
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before
