"""The maintenance task: its physics, its belief, its streams, what it refuses, its plan and its bound."""

import itertools
from typing import Any

import numpy as np
import pytest
from bounds import maintenance_bound
from gymnasium.vector import AutoresetMode
from scipy.stats import norm
from single_lanes import assert_lanes_are_single

from motor_env.envs import (
    MaintainEnv,
    MaintainOptions,
    MaintainVectorEnv,
    PlannedUpkeep,
    ThresholdReplacement,
    returns_of,
)
from motor_env.envs.maintain import kernel
from motor_env.envs.maintain.options import LEVELS, LOWEST_ESTIMATE, make_tables
from motor_env.envs.maintain.replacement import _STDS as STDS  # the grid of the plan, filled by hand

SPREAD = MaintainOptions(rate_spread=0.5)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_every_lane_is_the_single_environment(mode: AutoresetMode) -> None:
    count = 2 * kernel.MOTORS + 3  # the last block is not full
    options: dict[str, Any] = {"days": 30, "rate_spread": 0.5, "limit": 0.2}
    envs = MaintainVectorEnv(count, autoreset_mode=mode, **options)
    actions = np.random.default_rng(0).integers(0, 3, (100, count))
    assert_lanes_are_single(envs, MaintainEnv(**options), actions)


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
        seen, *_, info = env.step(action)
        marks = env._motors.marks[:, 0]
        if action == kernel.INSPECT:
            belief = belief * (np.arange(LEVELS) == marks[kernel.LEVEL])
        else:
            before = new if action == kernel.REPLACE else belief
            belief = np.einsum("rx,rxz->rz", before, chain[:, :, :LEVELS])
            belief = new if info["failed"] else belief
            belief = belief * tables.estimate[marks[kernel.ESTIMATE] - LOWEST_ESTIMATE]
        belief = belief / belief.sum()
        np.testing.assert_allclose(env._motors.belief[0, :, :, 0], belief, atol=1e-12)
        level, by_rate = belief.sum(axis=0), belief.sum(axis=1)
        mean = level @ np.arange(LEVELS)
        features = [
            marks[kernel.ESTIMATE] / 50.0,
            mean / 50.0,
            np.sqrt(level @ np.square(np.arange(LEVELS) - mean)) / 50.0,
            (belief * tables.failing).sum(),
            by_rate @ tables.rates / 0.01,
            marks[kernel.AGE] / 120.0,
            1.0 - marks[kernel.DAY] / 120.0,
        ]
        np.testing.assert_allclose(seen, features, atol=1e-6)


def test_wear_and_estimates_follow_their_laws_and_failures_come_where_they_must() -> None:
    envs = MaintainVectorEnv(20_000, days=30, failure_cost=7.0)
    envs.reset(seed=1)
    for _ in range(20):
        observations, rewards, _, _, info = envs.step(np.zeros(envs.num_envs, dtype=int))
        np.testing.assert_array_equal(rewards, np.where(info["failed"], -7.0, 0.0))
    severity = info["severity"]
    # 20 days at 1 % a day; a new bearing has no less than 0, which adds to the mean
    assert severity.mean() == pytest.approx(0.20, abs=0.02)
    assert severity.std() == pytest.approx(0.02 * 20**0.5, rel=0.12)
    assert (0.5 * observations[:, 0] - severity).std() == pytest.approx(0.031, rel=0.03)
    inside = np.abs(observations[:, 1] * 0.5 - severity) < 0.5 * 2.0 * observations[:, 2]
    assert 0.93 < inside.mean() < 0.98


def test_the_plan_beats_every_threshold_and_stays_below_the_bound() -> None:
    for options in (MaintainOptions(), SPREAD):
        envs = MaintainVectorEnv(500, options)
        planned = returns_of(envs, PlannedUpkeep(options), seed=1)
        for feature, threshold in (("age", 0.2), ("mean", 0.84), ("risk", 0.01)):
            gained = planned - returns_of(envs, ThresholdReplacement(feature, threshold), seed=1)
            assert gained.mean() > 1.96 * gained.std() / len(gained) ** 0.5, feature
        assert planned.mean() - 2.6 * planned.std() / len(planned) ** 0.5 < maintenance_bound(options)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"failure_cost": 1.0}, "failure_cost must be above replacement_cost"),
        ({"diffusion": 0.0049}, "diffusion must be at least"),
        ({"drift_per_day": 0.481 / np.exp(1.2), "rate_spread": 0.4}, "must leave a bearing more than a day"),
    ],
)
def test_bad_options_get_one_sentence(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MaintainEnv(**changes)


def test_tables_are_those_of_the_laws() -> None:
    """Wear: a normal step a day in fiftieths of the limit; estimates: normal about the level, cut at both ends."""
    tables = make_tables(SPREAD)
    assert tables.weights @ tables.rates == pytest.approx(0.01)  # lognormal, its mean the drift
    assert tables.weights @ np.log(tables.rates / 0.01) == pytest.approx(-0.125)
    assert tables.weights @ np.square(np.log(tables.rates / 0.01) + 0.125) == pytest.approx(0.25)
    assert (len(tables.rates), tables.lowest, make_tables(MaintainOptions()).wear.shape) == (5, -12, (1, 26))
    growth = tables.lowest + np.arange(tables.wear.shape[1])
    for rate, wear, failing in zip(tables.rates, tables.wear, tables.failing, strict=True):
        law = norm(rate / 0.01, 2.0)  # two levels a day
        np.testing.assert_allclose(wear, law.cdf(growth + 0.5) - law.cdf(growth - 0.5), atol=1e-8)
        np.testing.assert_allclose(failing, law.sf(49.5 - np.arange(50)), atol=1e-8)
    law, level = norm(0.0, 20.0), np.arange(50)
    estimate = make_tables(MaintainOptions(estimate_std=0.2)).estimate
    assert estimate.shape == (101, 50)
    np.testing.assert_allclose(estimate[1:-1, 7], np.diff(law.cdf(np.arange(-24, 76) - 7.5)), atol=1e-12)
    np.testing.assert_allclose(estimate[0], law.cdf(-24.5 - level), atol=1e-12)
    np.testing.assert_allclose(estimate[-1], law.sf(74.5 - level), atol=1e-12)


def test_a_plan_is_looked_up_between_its_points() -> None:
    policy, stds = PlannedUpkeep(MaintainOptions(days=3, rate_spread=0.5)), np.array(STDS)
    pace = make_tables(MaintainOptions(rate_spread=0.5)).rates / 0.01
    grid = np.zeros((4, 3, 5, LEVELS, 12))

    def chosen(run: Any, replace: float, left: int = 2, **features: float) -> int:
        grid[:] = -1e9
        grid[left, kernel.RUN], grid[left, kernel.REPLACE] = run, replace
        policy._values = grid.reshape(4, 3, 5, -1)
        seen = {"rate": 1.0, "mean": 0.3, "std": 0.05, "days_left": left / 3.0} | features
        row = np.array([[seen.get(name, 0.0) for name in kernel.FEATURES]], dtype=np.float32)
        return int(policy.act(row)[0])

    by_rate = pace[:, None, None]
    for name, worth, values in (
        ("rate", by_rate, (0.4, 0.9, 1.1, 2.2)),
        ("mean", np.arange(LEVELS)[:, None] / 50.0, (0.013, 0.5, 0.971)),
        ("std", stds / 50.0, (0.013, 0.061, 0.131)),
    ):
        for value, left in itertools.product(values, (1, 3)):
            assert chosen(worth, value - 1e-4, left, **{name: value}) == kernel.RUN
            assert chosen(worth, value + 1e-4, left, **{name: value}) == kernel.REPLACE
    assert chosen(by_rate, pace[-1] - 1e-4, rate=9.0) == kernel.RUN  # beyond the ends the ends hold
    assert chosen(by_rate, pace[0] + 1e-4, rate=0.0) == kernel.REPLACE
