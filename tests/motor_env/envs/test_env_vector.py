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
from single_lanes import assert_lanes_are_single, follow

from motor_env import Fault, discretize, draw, load_recipe
from motor_env.envs import (
    MonitorEnv,
    MonitorVectorEnv,
    ProbeContinuousEnv,
    ProbeContinuousVectorEnv,
    ProbeEnv,
    ProbeVectorEnv,
    layout,
)
from motor_env.motor.faults import BUILT_IN_KINDS, FaultKind, apply_faults
from motor_env.simulation.recipes import FaultClass

IDS = tuple(name for name in gym.registry if name.startswith("motor_env/"))
INSTANT = gym.spec("motor_env/MonitorInstant-v0").kwargs
SHORT: dict[str, Any] = {"horizon_s": 0.02, "earliest_onset_s": 0.001, "mean_onset_s": 0.005, **INSTANT}
PAIRS: list[tuple[Any, Any, dict[str, Any]]] = [
    (MonitorEnv, MonitorVectorEnv, SHORT),
    (MonitorEnv, MonitorVectorEnv, {**SHORT, "recipe": "hard", "growth_s": 0.004, "start": "standstill"}),
    (MonitorEnv, MonitorVectorEnv, {**SHORT, "samples_per_step": 2}),
    (MonitorEnv, MonitorVectorEnv, {**SHORT, "recipe": "hard", "drive": "speed_loop"}),
    (ProbeEnv, ProbeVectorEnv, {**SHORT, "samples_per_step": 5}),
    (ProbeEnv, ProbeVectorEnv, {**SHORT, "samples_per_step": 20, "confirm_steps": 2, "drive": "speed_loop"}),
    (
        ProbeContinuousEnv,
        ProbeContinuousVectorEnv,
        {**SHORT, "samples_per_step": 5, "energy_cost_per_j": 0.5},
    ),
]
EXACT = (MonitorEnv, MonitorVectorEnv, {**SHORT, "samples_per_step": 4, "precision": "float64"})
# Nothing else steps an environment alone in double precision: seven seconds of compiling.
ALL_PAIRS = [*PAIRS, pytest.param(*EXACT, marks=pytest.mark.long)]


def random_actions(space: gym.Space[Any], steps: int, count: int, seed: int) -> NDArray[Any]:
    """Mostly harmless actions, and now and then a declaration; shape (steps, count, ...)."""
    rng = np.random.default_rng(seed)
    if isinstance(space, gym.spaces.Discrete):
        anything = rng.integers(0, space.n, (steps, count))
        return np.where(rng.random((steps, count)) < 0.02, anything, 0)
    assert space.shape is not None
    actions = rng.uniform(-1.0, 0.49, (steps, count, *space.shape))
    actions[..., 1:] += 0.6 * (rng.random((steps, count, 1)) < 0.02)
    return actions.astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(("single", "vector", "options"), ALL_PAIRS)
def test_every_lane_is_the_single_environment(
    single: Any, vector: Any, options: dict[str, Any], mode: AutoresetMode
) -> None:
    count, steps = 70, 300  # more lanes than a block has, and several episodes
    envs = vector(count, autoreset_mode=mode, **options)
    actions = random_actions(envs.single_action_space, steps, count, seed=1)
    assert_lanes_are_single(envs, single(**options), actions)


@pytest.mark.parametrize("vector", [MonitorVectorEnv, ProbeVectorEnv, ProbeContinuousVectorEnv])
def test_shared_lanes_of_vectors_of_different_sizes_are_equal_to_the_bit(vector: Any) -> None:
    small, large = vector(5), vector(150)
    actions = random_actions(small.single_action_space, 250, 150, seed=2)
    first, second = small.reset(seed=3)[0], large.reset(seed=3)[0]
    np.testing.assert_array_equal(first, second[:5])
    for action in actions:
        a, b = small.step(action[:5]), large.step(action)
        for mine, theirs in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs[:5])
        for name in a[4]:
            np.testing.assert_array_equal(a[4][name], b[4][name][:5])


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("vector", [MonitorVectorEnv, ProbeVectorEnv, ProbeContinuousVectorEnv])
@pytest.mark.parametrize("recipe", ["easy", "medium", "hard", "small"])
@pytest.mark.parametrize("start", ["running", "standstill"])
def test_float32_stays_close_to_float64(vector: Any, recipe: str, start: str) -> None:
    """Over a thousand episodes, in each observation's scale, with resets at all times.

    Without the evidence of the bank: where a sum falls to zero a filter starts anew, and rounding can tip that.
    """
    envs = [
        vector(1000, precision=precision, recipe=recipe, start=start) for precision in ("float32", "float64")
    ]
    (a, _), (b, _) = (env.reset(seed=5) for env in envs)
    setup = envs[0].setup
    scale = setup.view[1, setup.chosen]
    scale[["evidence" in name for name in setup.observed]] = np.inf
    for step in range(4000 // envs[0].options.samples_per_step):
        action = random_actions(envs[0].single_action_space, 1, 1000, seed=step)[0]
        rare = np.random.default_rng(step).random(1000) < 0.05
        action = np.where(rare if action.ndim == 1 else rare[:, None], action, 0).astype(action.dtype)
        assert (np.abs(a - b) < 1e-5 * scale).all()
        (a, _, over_a, _, _), (b, _, over_b, _, _) = (env.step(action) for env in envs)
        np.testing.assert_array_equal(over_a, over_b)


def test_a_uniform_random_policy_keeps_lanes_apart_from_each_other() -> None:
    """Two of three steps end an episode: what a begin writes must not reach its neighbours."""
    envs, env = MonitorVectorEnv(130, recipe="hard"), MonitorEnv(recipe="hard")
    actions = np.random.default_rng(0).integers(0, 4, (200, 130))
    seen = [envs.reset(seed=4)[0], *(envs.step(action)[0] for action in actions)]
    for index in (0, 63, 64, 129):
        expected = follow(env, actions[:, index], 4, index, AutoresetMode.NEXT_STEP)
        for mine, theirs in zip(seen, expected, strict=True):
            np.testing.assert_array_equal(mine[index], theirs[0])


def test_final_observation_is_kept_when_the_next_episode_begins_at_once() -> None:
    envs = MonitorVectorEnv(3, autoreset_mode="SameStep", **SHORT)
    envs.reset(seed=1)
    observation, _, terminated, _, info = envs.step(np.array([0, 1, 0]))
    assert terminated.tolist() == [False, True, False]
    assert info["_final_obs"].tolist() == [False, True, False]
    assert info["final_obs"][0] is None
    assert info["final_obs"][1][-1] > 0.0
    assert observation[1, -1] == 0.0  # time
    assert info["_final_info"].tolist() == [False, True, False]


def test_the_last_info_tells_the_truth_of_the_episode_that_is_over() -> None:
    """Not that of the next one, which has begun in the same step."""
    envs, waiting = (MonitorVectorEnv(64, autoreset_mode=mode, **SHORT) for mode in ("SameStep", "NextStep"))
    for each in (envs, waiting):
        each.reset(seed=1)
    ended, last = (each.step(np.ones(64, dtype=np.int64))[4] for each in (envs, waiting))
    for name in ("class_index", "onset_sample", "fault_active"):
        np.testing.assert_array_equal(ended["final_info"][name], last[name])
    assert not np.array_equal(ended["class_index"], last["class_index"])


def test_disabled_autoreset_waits_for_the_mask() -> None:
    envs = MonitorVectorEnv(3, autoreset_mode="Disabled", **SHORT)
    before, _ = envs.reset(seed=1)
    stepped = envs.step(np.array([0, 1, 0]))[0]
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros(3, dtype=np.int64))
    mask = np.array([False, True, False])
    after, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[[0, 2]], stepped[[0, 2]])
    assert not np.array_equal(after[1], before[1])  # the next episode
    assert info["_class_index"].tolist() == mask.tolist()
    again, _ = envs.reset(seed=1, options={"reset_mask": mask})
    np.testing.assert_array_equal(again[1], before[1])
    envs.step(np.zeros(3, dtype=np.int64))


def test_a_seed_under_a_mask_leaves_the_other_streams_alone() -> None:
    envs, plain = MonitorVectorEnv(3, **SHORT), MonitorVectorEnv(3, **SHORT)
    mask = np.array([False, True, False])
    for each in (envs, plain):
        each.reset(seed=1)
    envs.reset(seed=2, options={"reset_mask": mask})
    following, wanted = (each.reset(options={"reset_mask": ~mask})[0] for each in (envs, plain))
    np.testing.assert_array_equal(following[~mask], wanted[~mask])


def test_a_list_of_seeds_gives_the_single_environments_of_those_seeds() -> None:
    seeds = [5, 5, 9]
    observations, _ = MonitorVectorEnv(3).reset(seed=seeds)
    for row, seed in zip(observations, seeds, strict=True):
        np.testing.assert_array_equal(row, MonitorEnv().reset(seed=seed)[0])


def test_what_a_step_returns_is_never_written_to_again() -> None:
    envs = ProbeVectorEnv(4)
    first = envs.reset(seed=0)
    kept, kept_info = np.copy(first[0]), {k: np.copy(v) for k, v in first[1].items()}
    second = envs.step(np.array([1, 2, 3, 4]))
    third = envs.step(np.array([1, 2, 3, 0]))
    np.testing.assert_array_equal(first[0], kept)
    for name, value in first[1].items():
        np.testing.assert_array_equal(value, kept_info[name])
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
def test_make_and_make_vec(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(name).unwrapped, skip_render_check=find_spec("pygame") is None)
        envs = gym.make_vec(name, num_envs=3)
        assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        observations, _ = envs.reset(seed=0)
        assert envs.observation_space.contains(np.ascontiguousarray(observations))
        for _ in range(5):
            observations, rewards, terminated, truncated, _ = envs.step(envs.action_space.sample())
            assert envs.observation_space.contains(np.ascontiguousarray(observations))
            assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)


@pytest.mark.parametrize(
    ("actions", "sentence"),
    [
        (np.array([0, 9, 0]), "actions must be in 0 .. 2, got 0 .. 9"),
        (np.array([0, -1, 0]), "actions must be in 0 .. 2, got -1 .. 0"),
        (np.array([0.0, 0.0, 0.0]), "actions must be integers of shape"),
        (np.array([0, 0]), "actions must be integers of shape"),
    ],
)
def test_actions_that_do_not_exist_are_refused(actions: NDArray[Any], sentence: str) -> None:
    envs = MonitorVectorEnv(3)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=sentence):
        envs.step(actions)


@pytest.mark.parametrize(("recipe", "growth_s"), [("small", 0.0), ("hard", 0.004), ("ranges", 0.004)])
@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.long)])
def test_episodes_are_the_draws_of_the_simulation(recipe: str, growth_s: float, precision: str) -> None:
    """The compiled drawing, `draw` of the recipe and `discretize` give the same numbers, to the last bit."""
    ranges = (FaultClass(), *(FaultClass(kind, 0.05, severity_to=0.3) for kind in BUILT_IN_KINDS))
    task = replace(load_recipe("hard"), classes=ranges) if recipe == "ranges" else load_recipe(recipe)
    envs = MonitorVectorEnv(
        200, recipe=task, growth_s=growth_s, precision=precision, mean_onset_s=0.0, **INSTANT
    )
    _, info = envs.reset(seed=9)
    drawn = draw(task, 9, np.arange(200) << 32)
    np.testing.assert_array_equal(info["class_index"], drawn.class_index)
    lanes = envs._arrays[-1][:200]
    np.testing.assert_array_equal(lanes[:, 0], drawn.severity)
    np.testing.assert_array_equal(lanes[:, 1:], drawn.factors)
    envs.step(
        np.zeros(200, dtype=np.int64)
    )  # growth or not, the earliest onset is far: still the healthy motor
    for share, steps in ((0.0, 0), (1.0, round((0.01 + growth_s) / 1e-4) + 1)):
        for _ in range(steps):
            envs.step(np.zeros(200, dtype=np.int64))
        faults = tuple(Fault(f.kind, f.severity * share) for f in drawn.scenario.faults)
        model = discretize(apply_faults(drawn.scenario.parameters, faults), envs.options.dt_s)
        state = envs._arrays[2].view(layout.block_type(precision))
        belief = envs.setup.belief.model
        moved = (model.transition - belief.transition).reshape(-1, 4).astype(precision)
        own = [state[name].ravel()[:200] for name in ("m00", "m01", "m10", "m11", "b0", "b1")]
        np.testing.assert_array_equal(own[:4], moved.T)
        gain = model.gain[..., 0] * drawn.factors[:, :1] - belief.gain[:, 0]
        np.testing.assert_array_equal(own[4:], gain.T.astype(precision))


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


def test_a_severity_that_is_drawn_is_told_too() -> None:
    ranges = replace(load_recipe("hard"), classes=(FaultClass(FaultKind.BEARING, 0.05, severity_to=0.3),))
    told = MonitorVectorEnv(5, recipe=ranges).reset(seed=1)[1]["severity"]
    alone = [MonitorEnv(recipe=ranges).reset(seed=1, options={"index": n})[1]["severity"] for n in range(5)]
    assert told.tolist() == alone
    assert len(set(alone)) == 5


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
    """In lanes of their own streams: the next episode begins in the next step, and its steps count anew."""
    envs, env = gym.make_vec(name, num_envs=2, max_episode_steps=3), gym.make(name, max_episode_steps=3)
    waits = np.zeros_like(envs.action_space.sample())
    seen, wanted = [envs.reset(seed=6)[0][0]], [env.reset(seed=6)[0]]
    cut: list[tuple[bool, bool]] = []
    cut_alone: list[tuple[bool, bool]] = []
    for _ in range(10):
        observation, _, terminated, truncated, _ = envs.step(waits)
        seen.append(observation[0])
        cut.append((bool(terminated[0]), bool(truncated[0])))
        if cut_alone and any(cut_alone[-1]):
            wanted.append(env.reset()[0])
            cut_alone.append((False, False))
            continue
        observation, _, over, stopped, _ = env.step(waits[0])
        wanted.append(observation)
        cut_alone.append((over, stopped))
    np.testing.assert_array_equal(seen, wanted)
    assert cut == cut_alone
    assert [step for step, (_, stopped) in enumerate(cut) if stopped] == [2, 6]


def test_a_step_limit_under_the_other_autoreset_modes() -> None:
    for count in (0, 1.5, True, "5", 2**40):
        with pytest.raises(ValueError, match="max_episode_steps must be"):
            MonitorVectorEnv(2, max_episode_steps=count)  # type: ignore[arg-type]  # what is refused
    waits = np.zeros(3, dtype=np.int64)
    envs = MonitorVectorEnv(3, autoreset_mode="SameStep", max_episode_steps=2, confirm_steps=1)
    first = envs.reset(seed=1)[0]
    envs.step(waits)
    observation, _, terminated, truncated, info = envs.step(np.array([0, 1, 0]))
    assert terminated.tolist() == [False, True, False]
    assert truncated.tolist() == [
        True,
        True,
        True,
    ]  # as gymnasium's TimeLimit says of an episode that ends by itself
    assert info["_final_obs"].all()
    assert (observation[:, -1] == 0.0).all()  # time
    assert not np.array_equal(observation, first)
    assert not envs.step(waits)[3].any()
    envs = MonitorVectorEnv(3, autoreset_mode="Disabled", max_episode_steps=2)
    envs.reset(seed=1)
    envs.step(waits)
    assert envs.step(waits)[3].all()
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(waits)
    envs.reset(options={"reset_mask": np.ones(3, dtype=bool)})
    assert not envs.step(waits)[3].any()
