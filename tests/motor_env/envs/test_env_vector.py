"""The vector twins: each sub-environment is the single environment, whatever stands beside it."""

import copy
import pickle
import warnings
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from single_lanes import assert_lanes_are_single

from motor_env import draw, load_recipe
from motor_env.envs import (
    MonitorEnv,
    MonitorVectorEnv,
    ProbeContinuousEnv,
    ProbeContinuousVectorEnv,
    ProbeEnv,
    ProbeVectorEnv,
)
from motor_env.motor.faults import BUILT_IN_KINDS
from motor_env.simulation.recipes import FaultClass

IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))
INSTANT = gym.spec("motor_env/MonitorInstant-v0").kwargs
SHORT: dict[str, Any] = {"horizon_s": 0.02, "earliest_onset_s": 0.001, "mean_onset_s": 0.005, **INSTANT}
PAIRS: list[Any] = [
    (MonitorEnv, MonitorVectorEnv, SHORT),
    (MonitorEnv, MonitorVectorEnv, {**SHORT, "recipe": "hard", "growth_s": 0.004, "start": "standstill"}),
    (MonitorEnv, MonitorVectorEnv, {**SHORT, "recipe": "hard", "drive": "speed_loop", "samples_per_step": 2}),
    (ProbeEnv, ProbeVectorEnv, {**SHORT, "samples_per_step": 20, "confirm_steps": 2, "drive": "speed_loop"}),
    (ProbeContinuousEnv, ProbeContinuousVectorEnv, {**SHORT, "energy_cost_per_j": 0.5}),
    # Nothing else steps an environment alone in double precision: seven seconds of compiling.
    pytest.param(MonitorEnv, MonitorVectorEnv, {**SHORT, "precision": "float64"}, marks=pytest.mark.long),
]


def random_actions(space: gym.Space[Any], steps: int, count: int, seed: int) -> NDArray[Any]:
    """Harmless actions, and now and then, in every other lane often, a declaration; shape (steps, count, ...)."""
    rng = np.random.default_rng(seed)
    bold = rng.random((steps, count)) < np.where(np.arange(count) % 2, 0.02, 0.5)
    if isinstance(space, gym.spaces.Discrete):
        return np.where(bold, rng.integers(0, space.n, (steps, count)), 0)
    assert space.shape is not None
    actions = rng.uniform(-1.0, 0.49, (steps, count, *space.shape))
    actions[..., 1:] += 0.6 * bold[..., None]
    return actions.astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(("single", "vector", "options"), PAIRS)
def test_every_lane_is_the_single_environment(
    single: Any, vector: Any, options: dict[str, Any], mode: AutoresetMode
) -> None:
    envs = vector(70, autoreset_mode=mode, **options)  # more lanes than a block has
    actions = random_actions(envs.single_action_space, 300, 70, seed=1)  # several episodes
    assert_lanes_are_single(envs, single(**options), actions)


def test_the_last_observation_and_info_are_those_of_the_episode_that_is_over() -> None:
    envs, waiting = (MonitorVectorEnv(64, autoreset_mode=mode, **SHORT) for mode in ("SameStep", "NextStep"))
    for each in (envs, waiting):
        each.reset(seed=1)
    actions = np.arange(64) % 2
    observation, _, over, _, ended = envs.step(actions)
    last_observation, *_, last = waiting.step(actions)
    np.testing.assert_array_equal(over, actions == 1)
    for name in ("_final_obs", "_final_info"):
        np.testing.assert_array_equal(ended[name], over)
    assert ended["final_obs"][0] is None
    np.testing.assert_array_equal(np.stack(ended["final_obs"][over]), last_observation[over])
    assert (observation[over, -1] == 0.0).all()  # time
    for name in ("class_index", "onset_sample", "fault_active"):
        np.testing.assert_array_equal(ended["final_info"][name][over], last[name][over])
    assert not np.array_equal(ended["class_index"][over], last["class_index"][over])


@pytest.mark.parametrize("limit", [None, 1])
def test_disabled_autoreset_waits_for_the_mask(limit: int | None) -> None:
    envs = MonitorVectorEnv(3, autoreset_mode="Disabled", max_episode_steps=limit, **SHORT)
    before, _ = envs.reset(seed=1)
    stepped, _, over, cut, _ = envs.step(np.array([0, 1, 0]))
    assert over.tolist() == [False, True, False]
    assert cut.any() == (limit is not None)
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros(3, dtype=np.int64))
    mask = over | cut
    after, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], stepped[~mask])
    assert not np.array_equal(after[1], before[1])  # the next episode
    assert info["_class_index"].tolist() == mask.tolist()
    again, _ = envs.reset(seed=[1, 2, 3], options={"reset_mask": mask})
    np.testing.assert_array_equal(again[1], MonitorEnv(**SHORT).reset(seed=2)[0])
    envs.step(np.zeros(3, dtype=np.int64))


def test_what_a_step_returns_is_never_written_to_again() -> None:
    envs = ProbeVectorEnv(4)
    first = envs.reset(seed=0)
    kept = copy.deepcopy(first)
    second = envs.step(np.array([1, 2, 3, 4]))
    third = envs.step(np.array([1, 2, 3, 0]))
    np.testing.assert_equal(first, kept)
    for mine, next_one in zip(second[:4], third[:4], strict=True):
        assert not np.shares_memory(mine, next_one)


REWARDED: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {"tracking_cost_per_s": 0.0} if "Drive" in name else {}) for name in IDS},
    "energy": ("motor_env/Probe-v0", {"energy_cost_per_j": 0.5}),
}


@pytest.mark.parametrize("name", REWARDED)
def test_a_policy_that_reads_its_last_reward_does_no_better_than_one_that_does_not(name: str) -> None:
    """The oracle alarms (declares, stops, replaces) once a reward is not 0, which costs nothing but a fault."""
    identity, options = REWARDED[name]
    envs: Any = gym.make_vec(identity, num_envs=200, **options).unwrapped
    space, found = envs.single_action_space, []
    many = isinstance(space, gym.spaces.Box)
    calm = np.zeros((200, *space.shape), dtype=space.dtype)
    alarm = np.broadcast_to(np.eye(space.shape[0])[-1] if many else space.n - 1, calm.shape)
    for reads in (False, True):
        envs.reset(seed=3)
        returns, alarmed, alive = np.zeros(200), np.zeros(200, dtype=np.bool_), np.ones(200, dtype=np.bool_)
        while alive.any():
            chosen = alarmed[:, None] if many else alarmed
            _, rewards, over, _, _ = envs.step(np.where(chosen, alarm, calm).astype(space.dtype))
            returns += rewards * alive
            alive &= ~over
            alarmed |= reads & (rewards != 0.0)
        found.append(returns)
    silent, oracle = found
    if "Maintain" in name:  # a failure costs, but the agent has seen it
        assert oracle.mean() < silent.mean()
    else:
        np.testing.assert_array_equal(oracle, silent)


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_is_content_and_a_vector_gives_what_its_spaces_say(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(name).unwrapped, skip_render_check=find_spec("pygame") is None)
    envs = gym.make_vec(name, num_envs=3)
    seen = [envs.reset(seed=0)[0]]
    for _ in range(5):
        observations, rewards, terminated, truncated, _ = envs.step(envs.action_space.sample())
        seen.append(observations)
        assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
    assert all(envs.observation_space.contains(np.ascontiguousarray(each)) for each in seen)


def test_episodes_are_the_draws_of_the_simulation() -> None:
    ranges = (FaultClass(), *(FaultClass(kind, 0.05, severity_to=0.3) for kind in BUILT_IN_KINDS))
    task = replace(load_recipe("hard"), classes=ranges)
    envs, env = MonitorVectorEnv(200, recipe=task), MonitorEnv(recipe=task)
    info, drawn = envs.reset(seed=9)[1], draw(task, 9, np.arange(200) << 32)
    np.testing.assert_array_equal(info["class_index"], drawn.class_index)
    np.testing.assert_array_equal(info["severity"], drawn.severity)
    np.testing.assert_array_equal(envs._arrays[-1][:200, 1:], drawn.factors)
    alone = [env.reset(seed=9, options={"index": n})[1]["severity"] for n in range(5)]
    assert alone == drawn.severity[:5].tolist()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("name", IDS)
def test_vector_infos_carry_what_single_infos_carry(name: str, mode: str) -> None:
    envs, env = gym.make_vec(name, num_envs=3, autoreset_mode=mode), gym.make(name).unwrapped
    singles = [env.reset(seed=4, options={"index": n})[1] for n in range(3)]
    waits = np.zeros_like(envs.action_space.sample())
    told = envs.reset(seed=4)[1]
    later = envs.step(waits)[4]
    for info, wanted in ((told, singles), (later, None)):
        assert set(info) == {*info, *(f"_{key}" for key in info if key[0] != "_")}
        for key, values in info.items():
            assert isinstance(values, np.ndarray)
            assert values.shape == (3,)
            assert key[0] != "_" or values.all()
            if wanted is not None and key[0] != "_":
                assert values.tolist() == [single[key] for single in wanted]
    text = {"label"} if mode == "SameStep" else set()  # which TorchRL cannot read
    assert {key for key in told if key[0] != "_"} == set(singles[0]) - text
    assert {key for key in later if key[0] != "_"} == set(env.step(waits[0])[4]) - text


def test_an_info_tells_of_its_own_step_whenever_and_however_it_is_read() -> None:
    envs, twins = (MonitorVectorEnv(4, **SHORT) for _ in range(2))
    for each in (envs, twins):
        each.reset(seed=1)
    late, early = [], []
    for action in ([0, 1, 2, 0], [1, 0, 0, 0], [1, 1, 1, 1]):
        late.append(envs.step(np.array(action))[4])
        early.append(copy.deepcopy(twins.step(np.array(action))[4]))
    reads: list[Any] = [dict, lambda info: {**info}, lambda info: pickle.loads(pickle.dumps(info))]  # noqa: S301
    for info, wanted, read in zip(late, early, reads, strict=True):
        found = read(info)
        assert type(found) is dict
        np.testing.assert_equal(found, wanted)


@pytest.mark.parametrize("name", IDS)
def test_a_step_limit_truncates_a_vector_as_it_truncates_a_single_environment(name: str) -> None:
    envs, env = gym.make_vec(name, num_envs=2, max_episode_steps=3), gym.make(name, max_episode_steps=3)
    waits = np.zeros_like(envs.action_space.sample())
    seen, wanted = [envs.reset(seed=6)[0][0]], [env.reset(seed=6)[0]]
    for step in range(10):
        observation, _, _, truncated, _ = envs.step(waits)
        seen.append(observation[0])
        alone, *_ = [env.reset()[0]] if step in (3, 7) else env.step(waits[0])
        wanted.append(alone)
        assert truncated[0] == (step in (2, 6))
    np.testing.assert_array_equal(seen, wanted)
