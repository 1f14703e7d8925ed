"""The maintenance task: its physics, its belief, its streams, what it refuses, its plan and its bound."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from bounds import maintenance_bound
from gymnasium.vector import AutoresetMode
from limits import cramer_rao_bound
from scipy.stats import norm
from single_lanes import assert_lanes_are_single

from motor_env import load_recipe
from motor_env.envs import (
    MaintainEnv,
    MaintainOptions,
    MaintainVectorEnv,
    PlannedUpkeep,
    ThresholdReplacement,
    rendering,
    returns_of,
)
from motor_env.envs.maintain import kernel, maintain_env
from motor_env.envs.maintain.maintain_env import Logbook
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
    recipe = load_recipe("bench")
    names, spread = ("friction", "supply", "resistance", "constants", "inertia"), recipe.spread
    prior = [np.inf, *(getattr(spread, name) for name in names[1:])]
    bound = cramer_rao_bound(recipe.motor, recipe.sensor, recipe.timing, names, prior)
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
        envs = MaintainVectorEnv(500, options)
        planned = returns_of(envs, PlannedUpkeep(options), seed=1)
        for feature, threshold in (("age", 0.2), ("mean", 0.84), ("risk", 0.01), ("age", np.inf)):
            gained = planned - returns_of(envs, ThresholdReplacement(feature, threshold), seed=1)
            assert gained.mean() > 1.96 * gained.std() / len(gained) ** 0.5, feature
        bound = maintenance_bound(options)
        assert planned.mean() - 2.6 * planned.std() / len(planned) ** 0.5 < bound


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


@pytest.mark.parametrize(
    "changes", [{"diffusion": 0.005}, {"drift_per_day": 0.48 / np.exp(1.2), "rate_spread": 0.4}]
)
def test_limits_of_the_options_are_exact(changes: dict[str, float]) -> None:
    name, limit = next(iter(changes.items()))
    side = -1e-9 if name == "diffusion" else 1e-9
    MaintainOptions(**changes | {name: limit * (1.0 - side)})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=name):
        MaintainOptions(**changes | {name: limit * (1.0 + side)})  # type: ignore[arg-type]


def test_a_plan_is_looked_up_between_its_points() -> None:
    """Worths that are linear in rate, mean and deviation are told exactly; the action changes where they say."""
    policy, stds = PlannedUpkeep(MaintainOptions(days=3, rate_spread=0.5)), np.array(STDS)
    pace = make_tables(MaintainOptions(rate_spread=0.5)).rates / 0.01
    assert stds.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0]
    grid = np.zeros((4, 3, 5, LEVELS, 12))

    def chosen(run: Any, replace: float, left: int = 2, **features: float) -> int:
        grid[:] = -1e9
        grid[left, kernel.RUN], grid[left, kernel.REPLACE] = run, replace
        policy._values = grid.reshape(4, 3, 5, -1)
        seen = {"rate": 1.0, "mean": 0.3, "std": 0.05, "days_left": left / 3.0} | features
        row = np.array([[seen.get(name, 0.0) for name in kernel.FEATURES]], dtype=np.float32)
        return int(policy.act(row)[0])

    cases = (
        ("rate", pace[:, None, None], (0.4, 0.9, 1.1, 2.2)),
        ("mean", np.arange(LEVELS)[:, None] / 50.0, (0.013, 0.5, 0.971)),
        ("std", stds / 50.0, (0.013, 0.061, 0.131)),
    )
    for name, worth, values in cases:
        for value in values:
            for left in (1, 3):
                assert chosen(worth, value - 1e-4, left, **{name: value}) == kernel.RUN
                assert chosen(worth, value + 1e-4, left, **{name: value}) == kernel.REPLACE
    assert (
        chosen(pace[:, None, None], pace[-1] - 1e-4, rate=9.0) == kernel.RUN
    )  # beyond the ends the ends hold
    assert chosen(pace[:, None, None], pace[0] + 1e-4, rate=0.0) == kernel.REPLACE


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


def test_the_logbook_stands_where_its_values_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten days of constant severities: rows of their lines, columns of the deeds, cost."""
    book = Logbook(MaintainOptions(days=10))
    figures: list[Any] = []
    monkeypatch.setattr(maintain_env, "write_figures", lambda _, text, *__, **___: figures.append(text))
    row = dict(zip(kernel.FEATURES, (0.6, 0.9, 0.05, 0.04, 1.0, 0.0, 1.0), strict=True))
    deeds = (kernel.RUN, kernel.RUN, kernel.INSPECT, kernel.REPLACE, kernel.REPLACE)
    for day, deed in enumerate(deeds):
        book.add(np.array(list(row.values()), dtype=np.float32), deed, severity=0.1, failed=day == 4)
    frame = book.draw()
    assert frame.shape == (400, 640, 3)
    severity, risk, colours = frame[46:250, 92:620], frame[284:370, 92:620], rendering.COLOURS
    until = 528 * 5 // 11  # five of eleven columns of days are filled
    for name, value in (("bearing", 0.2), ("current", 0.6), ("estimate", 0.9)):
        at = round((1.25 - value) / 1.5 * 203)
        line = (severity == colours[name]).all(axis=2)
        assert line[at, 30:until].mean() > 0.9
        assert not line[at, until + 1 :].any()
        assert not line[[at - 1, at + 1]].any()
    shown = (severity[:, 1] == rendering.GRID).all(axis=1)  # within two standard deviations of the mean
    band = np.linspace(1.25, -0.25, 204)
    assert shown[np.abs(band - 0.9) < 0.099].sum() >= np.sum(np.abs(band - 0.9) < 0.099) - 2  # two lines
    assert not shown[(np.abs(band - 0.9) > 0.101) & (np.arange(204) % 51 > 0)].any()
    dashes = (severity[round(0.25 / 1.5 * 203)] == colours["threshold"]).all(axis=1)
    assert dashes[until + 1 :].tolist() == (np.arange(until + 1, 528) % 9 < 4).tolist()
    failing = (risk[:, 10] == colours["residual"]).all(axis=1)
    assert np.flatnonzero(failing).tolist() == [50, 51, 52]
    for day, name in ((2, "speed"), (3, "residual"), (4, "threshold")):
        x = 92 + day * 528 // 11
        marked = (frame[:, x - 1 : x + 3] == colours[name]).all(axis=2)[46:250:2]
        assert marked.all(axis=0).tolist() == [False, True, True, False]
    assert {"day    4", "cost    6.1", "0.1"} <= set(figures)


def test_the_logbook_shows_what_was_done() -> None:
    env = gym.make("motor_env/Maintain-v0", render_mode="rgb_array")
    env.reset(seed=1)
    first = np.asarray(env.render())
    for day in range(40):
        env.step(kernel.REPLACE if day == 30 else kernel.RUN)
    last = np.asarray(env.render())
    assert first.shape == last.shape == (400, 640, 3)
    assert (first != last).any(axis=2).mean() > 0.01
