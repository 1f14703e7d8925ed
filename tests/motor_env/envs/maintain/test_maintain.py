"""The maintenance task: its physics, its belief, its streams, what it refuses, its plan and its bound."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from motor_env.envs import (
    MaintainEnv,
    MaintainOptions,
    MaintainVectorEnv,
    PlannedUpkeep,
    ReplaceFrom,
    maintenance_bound,
    returns_of,
)
from motor_env.envs.maintain import kernel
from motor_env.envs.maintain.options import LEVELS, LOWEST_ESTIMATE, make_tables
from motor_env.envs.maintain.policies import clairvoyant_value
from motor_env.inference.identifiability import Experiment, cramer_rao_bound
from motor_env.simulation.named_recipes import named_recipe

SPREAD = MaintainOptions(rate_spread=0.5)


@pytest.mark.parametrize("name", ["Maintain-v0", "MaintainUnknownRate-v0"])
def test_gymnasium_has_nothing_to_say(name: str) -> None:
    check_env(gym.make(f"motor_env/{name}").unwrapped)
    envs = gym.make_vec(f"motor_env/{name}", num_envs=3)
    observations, _ = envs.reset(seed=2)
    assert envs.observation_space.contains(np.ascontiguousarray(observations))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_vector_is_so_many_single_motors_to_the_bit(mode: str) -> None:
    options, rng = MaintainOptions(days=30, rate_spread=0.5, limit=0.2), np.random.default_rng(0)
    envs = MaintainVectorEnv(4, options, autoreset_mode=mode)
    singles = [MaintainEnv(options) for _ in range(4)]
    observations, _ = envs.reset(seed=5)
    ours = [env.reset(seed=5, options={"index": n})[0] for n, env in enumerate(singles)]
    np.testing.assert_array_equal(observations, ours)
    over, ended = np.zeros(4, dtype=bool), 0
    for _ in range(65):
        if over.any() and mode == "Disabled":
            np.testing.assert_array_equal(
                envs.reset(options={"reset_mask": over})[0], [env.reset()[0] for env in singles]
            )
        actions = rng.integers(0, 3, 4)
        observations, rewards, now, _, info = envs.step(actions)
        for n, env in enumerate(singles):
            if over[n] and mode == "NextStep":
                seen, reward, done, told = env.reset()[0], 0.0, False, None
            else:
                seen, reward, done, _, told = env.step(actions[n])
            if done and mode == "SameStep":
                np.testing.assert_array_equal(info["final_obs"][n], seen)
                seen, told = env.reset()[0], None
            np.testing.assert_array_equal(observations[n], seen)
            assert (rewards[n], now[n]) == (reward, done)
            if told is not None:
                assert {name: info[name][n] for name in told} == told
        over, ended = now, ended + int(now.sum())
    assert ended == 8


def test_the_belief_is_bayes_rule() -> None:
    """Against a plain forward pass over all levels and rates, days of running, inspecting and replacing."""
    env, tables = MaintainEnv(SPREAD), make_tables(SPREAD)
    env.reset(seed=4)
    chain = np.zeros((len(tables.rates), LEVELS, LEVELS + 1))
    for growth in range(tables.wear.shape[1]):
        for level in range(LEVELS):
            after = min(max(level + tables.lowest + growth, 0), LEVELS)
            chain[:, level, after] += tables.wear[:, growth]
    np.testing.assert_allclose(chain[:, :, LEVELS], tables.failing, atol=1e-14)
    new = np.outer(tables.weights, np.arange(LEVELS) == 0)
    belief = new
    for action in [0] * 25 + [1] + [0] * 5 + [2] + [0] * 5:
        *_, info = env.step(action)
        marks = env.motors.marks[:, 0]
        if action == kernel.INSPECT:
            belief = belief * (np.arange(LEVELS) == marks[kernel.LEVEL])
        else:
            before = new if action == kernel.REPLACE else belief
            belief = np.einsum("rx,rxz->rz", before, chain[:, :, :LEVELS])
            belief = new if info["failed"] else belief
            belief = belief * tables.estimate[marks[kernel.ESTIMATE] - LOWEST_ESTIMATE]
        belief = belief / belief.sum()
        np.testing.assert_allclose(env.motors.belief[0], belief, atol=1e-12)


def test_wear_follows_its_law_and_failures_come_where_they_must() -> None:
    options = MaintainOptions(days=30, failure_cost=7.0)
    envs = MaintainVectorEnv(20_000, options)
    envs.reset(seed=1)
    run = np.zeros(envs.num_envs, dtype=int)
    for _ in range(20):
        _, rewards, _, _, info = envs.step(run)
        np.testing.assert_array_equal(rewards, np.where(info["failed"], -7.0, 0.0))
    growth = info["severity"]
    # 20 days at 1 % a day; a new bearing has no less than 0, which adds to the mean
    assert growth.mean() == pytest.approx(0.20, abs=0.02)
    assert growth.std() == pytest.approx(0.02 * 20**0.5, rel=0.12)


def test_an_estimate_errs_as_a_start_of_the_bench_does() -> None:
    recipe = named_recipe("bench")
    start = Experiment.start(recipe.timing, recipe.sensor, float(recipe.supply.voltage_v))
    names, spread = ("friction", "supply", "resistance", "constants", "inertia"), recipe.spread
    prior = [np.inf, *(getattr(spread, name) for name in names[1:])]
    bound = cramer_rao_bound(recipe.motor, start, names, prior)
    assert MaintainOptions().estimate_std == pytest.approx(bound[0, 0] ** 0.5, abs=5e-4)
    envs = MaintainVectorEnv(20_000)
    envs.reset(seed=3)
    for _ in range(30):
        observations, _, _, _, info = envs.step(np.zeros(envs.num_envs, dtype=int))
    error = 0.5 * observations[:, 0] - info["severity"]
    assert error.std() == pytest.approx(0.031, rel=0.03)
    inside = np.abs(observations[:, 1] * 0.5 - info["severity"]) < 0.5 * 2.0 * observations[:, 2]
    assert 0.93 < inside.mean() < 0.98


def test_the_plan_beats_every_threshold_and_stays_below_the_bound() -> None:
    for options in (MaintainOptions(), SPREAD):
        envs = MaintainVectorEnv(800, options)
        planned = returns_of(envs, PlannedUpkeep(options), seed=1)
        for feature, threshold in (("age", 0.2), ("mean", 0.84), ("risk", 0.01), ("age", np.inf)):
            gained = planned - returns_of(envs, ReplaceFrom(feature, threshold), seed=1)
            assert gained.mean() > 1.96 * gained.std() / len(gained) ** 0.5, feature
        bound = maintenance_bound(options)
        assert planned.mean() - 2.6 * planned.std() / len(planned) ** 0.5 < bound < clairvoyant_value(options)


def test_a_bound_of_two_days_by_hand() -> None:
    """A bearing that cannot fail within the episode costs nothing; one that surely fails tomorrow is replaced."""
    assert maintenance_bound(MaintainOptions(days=2)) == pytest.approx(0.0, abs=1e-9)
    fast = MaintainOptions(days=1, limit=0.5, drift_per_day=0.47, diffusion=0.005)
    tables = make_tables(fast)
    assert maintenance_bound(fast) == pytest.approx(-5.0 * tables.failing[0, 0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"failure_cost": 1.0}, "failure_cost must be above replacement_cost"),
        ({"inspection_cost": -0.1}, "inspection_cost must be in 0"),
        ({"drift_per_day": 0.5}, "drift_per_day must leave a bearing more than a day"),
        ({"diffusion": 0.001}, "diffusion must be at least"),
        ({"days": 0}, "days must be a whole number >= 1"),
        ({"limit": float("nan")}, "limit must be in 0"),
        ({"wear": 1}, "no option 'wear'"),
    ],
)
def test_bad_options_get_one_sentence(changes: dict[str, Any], words: str) -> None:
    for cls in (MaintainEnv, MaintainVectorEnv):
        with pytest.raises(ValueError, match=words):
            cls(**changes)


def test_bad_actions_and_steps_are_refused() -> None:
    env, envs = MaintainEnv(days=1), MaintainVectorEnv(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    for action in (3, -1, 0.5):
        with pytest.raises(ValueError, match=r"whole number in 0 \.\. 2"):
            env.step(action)
    assert env.step(0)[2]
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"in 0 \.\. 2"):
        envs.step(np.array([0, 3]))


def test_the_logbook_shows_what_was_done() -> None:
    env = gym.make("motor_env/Maintain-v0", render_mode="rgb_array")
    env.reset(seed=1)
    first = np.asarray(env.render())
    for day in range(40):
        env.step(kernel.REPLACE if day == 30 else kernel.RUN)
    last = np.asarray(env.render())
    assert first.shape == last.shape == (400, 640, 3)
    assert (first != last).any(axis=2).mean() > 0.01
