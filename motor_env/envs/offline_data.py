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
from gymnasium import spaces
from numpy.typing import NDArray

from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import filling
from motor_env.detection.rules import Cusum
from motor_env.envs.drive.lqg import Lqg
from motor_env.envs.maintain.replacement import PlannedUpkeep, ThresholdReplacement
from motor_env.envs.policies.posterior_policies import (
    BayesPolicy,
    Bursts,
    EventTriggeredProbing,
    ExpectedRewardTest,
    OpenLoop,
)
from motor_env.envs.policies.rule_policies import Observations, Player, RulePolicy, baseline_features
from motor_env.motor.parameters import FloatArray


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
    return OpenLoop(ExpectedRewardTest(envs.setup, 0.93), Bursts(20, 10, 2).actions(envs.options.n_steps))


TASKS = {
    "Monitor-v0": Task(
        lambda envs: RulePolicy(envs.setup, Cusum(0.25, two_sided=True), threshold=30.0),
        lambda envs: BayesPolicy(envs.setup, 0.9609),
        {"observe": baseline_features("medium")},
    ),
    "Probe-v0": Task(_bursts, lambda envs: EventTriggeredProbing(ExpectedRewardTest(envs.setup, 0.97), 0.08)),
    "Maintain-v0": Task(
        lambda envs: ThresholdReplacement("mean", 0.84), lambda envs: PlannedUpkeep(envs.options)
    ),
    "MaintainUnknownRate-v0": Task(
        lambda envs: ThresholdReplacement("mean", 0.84), lambda envs: PlannedUpkeep(envs.options)
    ),
    "Drive-v0": Task(lambda envs: Lqg(envs.setup), lambda envs: Lqg(envs.setup, levels=4)),
}
"""Thresholds with the best mean return on episodes of other seeds."""


_AT_ONCE = 100
_PURE = (Behaviour.RANDOM, Behaviour.RULE, Behaviour.BEST)


class Episode(NamedTuple):
    """One episode of n steps.

    Attributes:
        observations: shape (n + 1, n_features).
        actions: shape (n,).
        rewards: shape (n,).
        seed: of its stream.
        stream: its index: a single environment reset with both repeats the episode.
    """

    observations: NDArray[np.float32]
    actions: NDArray[Any]
    rewards: FloatArray
    seed: int
    stream: int


def play(envs: Any, policy: Player, seed: int) -> list[Episode]:
    """Play one episode of a policy in each sub-environment."""
    observation, _ = envs.reset(seed=seed)
    policy.start(envs.num_envs)
    seen, done, paid = [np.array(observation)], [], []
    length = np.zeros(envs.num_envs, dtype=np.int64)
    running = np.ones(envs.num_envs, dtype=np.bool_)
    while running.any():
        actions = policy.act(observation).astype(envs.single_action_space.dtype)
        observation, rewards, terminated, _, _ = envs.step(actions)
        seen.append(np.array(observation))
        done.append(actions)
        paid.append(rewards)
        length += running
        running &= ~terminated
    observations, actions, rewards = np.array(seen), np.array(done), np.array(paid)
    return [
        Episode(observations[: n + 1, k], actions[:n, k], rewards[:n, k], seed, k)
        for k, n in enumerate(length.tolist())
    ]


def episodes_of(task: str, behaviour: Behaviour, count: int, seed: int) -> list[Episode]:
    """So many episodes; those of `mixed` come from the three others in turn."""
    if behaviour is Behaviour.MIXED:
        shares = [count // 3 + (k < count % 3) for k in range(3)]
        parts = [
            episodes_of(task, each, share, seed + k)
            for k, (each, share) in enumerate(zip(_PURE, shares, strict=True))
            if share
        ]
        return [episode for part in parts for episode in part]
    known, found = TASKS[task], []
    for begin in range(0, count, _AT_ONCE):
        envs: Any = gym.make_vec(
            f"motor_env/{task}", num_envs=min(_AT_ONCE, count - begin), **known.options
        ).unwrapped
        stream = (seed << 20) + begin
        if behaviour is Behaviour.RANDOM:
            policy: Player = Uniform(envs.single_action_space, stream)
        else:
            policy = (known.rule if behaviour is Behaviour.RULE else known.best)(envs)
        found += play(envs, policy, stream)
    return found


def record(task: str, behaviour: Behaviour, folder: Path, *, episodes: int = 300, seed: int = 0) -> str:
    """Write a data set below a folder (Minari's MINARI_DATASETS_PATH); its name.

    Its scores are normalised by random actions (0) and by the best policy known (1).

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
    found = episodes_of(task, behaviour, episodes, seed)
    random = found if behaviour is Behaviour.RANDOM else episodes_of(task, Behaviour.RANDOM, 100, seed)
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
        for number, episode in enumerate(found)
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
    """Minari writes below this folder, and does not ask for an author and a link to the code."""
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
