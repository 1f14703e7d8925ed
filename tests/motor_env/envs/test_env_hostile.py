"""Hostile arguments of the environments: the right answer, or one sentence."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hostile_arguments import Row

from motor_env import Cusum
from motor_env.envs import (
    DriveEnv,
    DriveVectorEnv,
    MaintainEnv,
    MaintainVectorEnv,
    MonitorEnv,
    MonitorVectorEnv,
    Never,
    PlannedUpkeep,
    PosteriorView,
    ProbeBelief,
    ProbeContinuousEnv,
    ProbeContinuousVectorEnv,
    ProbeEnv,
    ProbeVectorEnv,
    Random,
    RulePolicy,
    StableBaselinesVecEnv,
    ThresholdReplacement,
    baseline_features,
    parts_of,
    returns_of,
    run_episodes,
    score,
)

SINGLE: tuple[Any, ...] = (MonitorEnv, ProbeEnv, ProbeContinuousEnv, DriveEnv, MaintainEnv)
VECTOR: tuple[Any, ...] = (
    MonitorVectorEnv,
    ProbeVectorEnv,
    ProbeContinuousVectorEnv,
    DriveVectorEnv,
    MaintainVectorEnv,
)


def made(make: Any, argument: str, value: Any) -> Any:
    """What an environment with an option observes first."""
    env = make(**{argument: value})
    return env.reset(seed=1)[0]


def begun(make: Any, value: Any) -> Any:
    return make().reset(seed=value)[0]


def begun_with(make: Any, option: str, value: Any) -> Any:
    env = make(3) if make in VECTOR else make()
    env.reset(seed=1)
    return env.reset(seed=1, options={option: value})[0]


def stepped(make: Any, value: Any) -> Any:
    env = make(3) if make in VECTOR else make()
    env.reset(seed=1)
    return env.step(value)[:2]


def an_action(make: Any) -> Any:
    env = make(3) if make in VECTOR else make()
    space = env.action_space
    return (
        1
        if space.shape == ()
        else np.full(space.shape, 1 if space.dtype.kind == "i" else 0.25, dtype=space.dtype)
    )


def drawn(policy: Random) -> Any:
    policy.start(4)
    return policy.act(np.zeros((4, 1), dtype=np.float32))


def without_good(call: Any, good: Any) -> Any:
    """The call, but for the good value, whose environment observes too little."""
    return lambda value: None if value is good else call(value)


VECTORS = MonitorVectorEnv(2)
HAS_ROOM = ("huge", "-huge", "large", "tiny")  # numbers that are clipped

ROWS = [
    *(Row.of(make.__name__, "seed", partial(begun, make), 5, "None") for make in (*SINGLE, *VECTOR)),
    *(Row.of(make.__name__, "index", partial(begun_with, make, "index"), 2, "None") for make in SINGLE),
    *(
        Row.of(make.__name__, "action", partial(stepped, make), an_action(make), *HAS_ROOM, "objects")
        for make in (*SINGLE, *VECTOR)
    ),
    *(
        Row.of(make.__name__, name, partial(made, make, name), 3, "None", also=(0, -1))
        for make in VECTOR
        for name in ("num_envs", "max_episode_steps")
        if make is MonitorVectorEnv or name == "num_envs"
    ),
    *(
        Row.of(make.__name__, "render_mode", partial(made, make, "render_mode"), "rgb_array", "None")
        for make in SINGLE
    ),
    Row.of(
        "MonitorVectorEnv", "autoreset_mode", partial(made, MonitorVectorEnv, "autoreset_mode"), "SameStep"
    ),
    Row.of(
        "MonitorEnv", "horizon_s", partial(made, MonitorEnv, "horizon_s"), 0.2, "0-d", "big-endian", "long"
    ),
    Row.of(
        "MonitorEnv",
        "mean_onset_s",
        partial(made, MonitorEnv, "mean_onset_s"),
        0.05,
        "0-d",
        "big-endian",
        "long",
    ),
    Row.of("MonitorEnv", "recipe", partial(made, MonitorEnv, "recipe"), "easy"),
    Row.of("MonitorEnv", "motor", partial(made, MonitorEnv, "motor"), "paper", "None"),
    Row.of("MonitorEnv", "observe", partial(made, MonitorEnv, "observe"), ("time",), "empty list"),
    Row.of("ProbeEnv", "offsets_v", partial(made, ProbeEnv, "offsets_v"), (0.0, 1.0)),
    Row.of("DriveEnv", "plateau_s", partial(made, DriveEnv, "plateau_s"), (0.2, 0.8)),
    Row.of("DriveEnv", "period_s", partial(made, DriveEnv, "period_s"), 0.01, "0-d", "big-endian", "long"),
    Row.of("MaintainEnv", "limit", partial(made, MaintainEnv, "limit"), 0.5, "0-d", "big-endian", "long"),
    Row.of("baseline_features", "recipe", baseline_features, "easy"),
    Row.of("Random", "seed", lambda v: drawn(Random(VECTORS.single_action_space, v)), 3, also=(-1,)),
    Row.of("returns_of", "envs", lambda v: returns_of(v, Never(), 1), VECTORS),
    Row.of("parts_of", "envs", lambda v: parts_of(v, Never(), 1), VECTORS),
    Row.of("run_episodes", "envs", lambda v: run_episodes(v, Never(), 1), VECTORS),
    Row.of("score", "runs", lambda v: score(VECTORS, v), run_episodes(VECTORS, Never(), 1)),
    Row.of("ProbeBelief", "setup", lambda v: str(ProbeBelief(v)), VECTORS.setup),
    Row.of(
        "RulePolicy",
        "setup",
        without_good(lambda v: RulePolicy(v, Cusum(0.5), threshold=3.0), VECTORS.setup),
        VECTORS.setup,
    ),
    Row.of("PosteriorView", "envs", PosteriorView, MonitorVectorEnv(2, autoreset_mode="SameStep")),
    Row.of(
        "StableBaselinesVecEnv", "envs", StableBaselinesVecEnv, MonitorVectorEnv(2, autoreset_mode="SameStep")
    ),
    Row.of("PlannedUpkeep", "options", lambda v: str(PlannedUpkeep(v)), MaintainVectorEnv(2).options),
    Row.of(
        "ThresholdReplacement",
        "threshold",
        lambda v: ThresholdReplacement("risk", v),
        0.5,
        "inf",
        "-inf",
        "huge",
    ),
]


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_hostile_arguments_of_environments(row: Row) -> None:
    assert row.defects() == []
