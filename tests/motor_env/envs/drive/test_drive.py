"""Drive-v0: the package's physics, gymnasium's contract, costs as the options say, and what detection is worth."""

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from motor_env.envs.drive import evaluation, kernel
from motor_env.envs.drive.env import REWARDS, DriveEnv, DriveVectorEnv
from motor_env.envs.drive.evaluation import clairvoyant_returns, drive_episodes
from motor_env.envs.drive.options import LABELS, DriveOptions
from motor_env.envs.drive.policies import LIMP, PI, RUN, STOP, Lqg
from motor_env.envs.drive.setup import faulty
from motor_env.motor.model import discretize

SHORT: dict[str, Any] = {"horizon_s": 0.6, "earliest_onset_s": 0.1, "mean_onset_s": 0.1}
STEADY: dict[str, Any] = {"growth_per_s": (1e-9, 1e-9), "load_std_n_m": 1e-13, "earliest_onset_s": 0.05}


def random_actions(steps: int, count: int) -> NDArray[np.float64]:
    """Any voltage; a decision that now and then limps, and seldom stops."""
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.2, 1.2, (steps, count, 2))
    actions[..., 1] = rng.choice([RUN, LIMP, STOP], (steps, count), p=[0.7, 0.29, 0.01])
    return actions


def follow(env: DriveEnv, actions: NDArray[np.float64], index: int, mode: AutoresetMode) -> list[Any]:
    """What a vector should give for one sub-environment, made with a single environment."""
    observation, info = env.reset(seed=7, options={"index": index})
    trace, over = [(observation, 0.0, False, info["severity"])], False
    for action in actions:
        if over and mode is AutoresetMode.NEXT_STEP:
            (observation, info), reward, over = env.reset(), 0.0, False
        else:
            observation, reward, over, _, info = env.step(action)
            if over and mode is AutoresetMode.SAME_STEP:
                observation, info = env.reset()
        trace.append((observation, reward, over, info["severity"]))
    return trace


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_every_lane_is_the_single_environment(mode: AutoresetMode) -> None:
    count, actions = 12, random_actions(200, 12)
    envs = DriveVectorEnv(count, autoreset_mode=mode, **SHORT)
    observations, info = envs.reset(seed=7)
    seen = [(observations, np.zeros(count), np.zeros(count, bool), info["severity"])]
    for action in actions:
        observations, rewards, over, _, info = envs.step(action)
        seen.append((observations, rewards, over, info["severity"]))
    assert sum(int(over.sum()) for _, _, over, _ in seen) > 2 * count
    for index in range(count):
        expected = follow(DriveEnv(**SHORT), actions[:, index], index, mode)
        for (o, r, t, k), (eo, er, et, ek) in zip(seen, expected, strict=True):
            np.testing.assert_array_equal(o[index], eo)
            assert (r[index], t[index], k[index]) == (er, et, ek)


def test_disabled_autoreset_waits_for_the_mask() -> None:
    envs = DriveVectorEnv(3, autoreset_mode="Disabled", **SHORT)
    first, _ = envs.reset(seed=1)
    stepped = envs.step(np.array([[0.5, RUN], [0.5, STOP], [0.5, RUN]]))
    assert stepped[2].tolist() == [False, True, False]
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros((3, 2)))
    mask = np.array([False, True, False])
    after, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[[0, 2]], stepped[0][[0, 2]])
    assert not np.array_equal(after[1], first[1])
    assert info["_severity"].tolist() == mask.tolist()


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_the_motor_is_the_discretised_one_with_its_fault(kind: int) -> None:
    weights = tuple(float(k == kind) for k in range(3))
    options = DriveOptions(weights=weights, mean_onset_s=0.0, **STEADY)  # type: ignore[arg-type]
    env, truth = DriveEnv(options), []
    _, info = env.reset(seed=3)
    assert info["label"] == LABELS[kind]
    rng, states, volts = np.random.default_rng(0), [env._state[0, :2].copy()], []
    for _ in range(60):
        info = env.step([rng.uniform(0.3, 0.7), RUN])[4]
        states.append(env._state[0, :2].copy())
        volts.append(env._state[0, kernel.VOLTAGE])
        truth.append(info["severity"])
    assert (truth[4], truth[5] > 0.0) == (0.0, kind > 0)
    for before, after, voltage, severity in zip(states[:-1], states[1:], volts, truth, strict=True):
        model = discretize(faulty(options, LABELS[kind], severity), options.period_s)
        load = options.load_torque_n_m + options.fan_n_m_s2 * before[1] ** 2
        expected = model.transition @ before + model.gain @ [voltage, load]
        np.testing.assert_allclose(after, expected, rtol=1e-6)


def test_the_filter_of_a_healthy_motor_has_white_innovations() -> None:
    envs = DriveVectorEnv(50, weights=(1.0, 0.0, 0.0), horizon_s=3.0)
    pi, (observations, _) = PI(envs.setup), envs.reset(seed=5)
    pi.start(50)
    rows = []
    for _ in range(290):
        observations, _, over, _, _ = envs.step(pi.act(observations))
        assert not over.any()
        rows.append(observations[:, 3:5])
    white = np.array(rows)
    assert envs.setup.observed[3:5] == ("innovation_current", "innovation_speed")
    np.testing.assert_allclose(white.mean(axis=(0, 1)), 0.0, atol=0.05)
    np.testing.assert_allclose(white.std(axis=(0, 1)), 1.0, atol=0.03)
    assert np.abs((white[1:] * white[:-1]).mean(axis=(0, 1))).max() < 0.03


def test_supply_and_profile_keep_their_limits() -> None:
    envs = DriveVectorEnv(30, current_limit_a=1.7)
    envs.reset(seed=2)
    for action in random_actions(150, 30):
        envs.step(action * [1.0, 0.0])
        assert (np.abs(envs.truth[kernel.CURRENT]) < 1.7 + 1e-9).all()
        assert (np.abs(envs.truth[kernel.VOLTAGE]) <= 16.0).all()
    profile, options = envs._arrays[-1], envs.options
    assert profile.min() >= options.lowest_speed_rad_s
    assert profile.max() <= options.top_speed_rad_s
    steepest = (options.top_speed_rad_s - options.lowest_speed_rad_s) / options.ramp_s[0]
    assert np.abs(np.diff(profile)).max() <= steepest * options.period_s * (1.0 + 1e-9)


def test_rewards_say_what_the_options_say() -> None:
    env = DriveEnv(weights=(0.0, 1.0, 0.0), mean_onset_s=0.0, growth_per_s=(10.0, 10.0), wear_cost=3.0)
    policy = Lqg(env.setup)
    policy.start(1)
    observation, _ = env.reset(seed=1)
    worn, over, steps = 0.0, False, 0
    while not over:
        before = env._state[0, kernel.SEVERITY]
        observation, reward, over, _, info = env.step(policy.act(observation[None])[0])
        steps += 1
        assert reward == pytest.approx(sum(info[name] for name in REWARDS), abs=1e-12)
        worn += info["reward_wear"]
        assert info["reward_wear"] == pytest.approx(-3.0 * (info["severity"] - before) / 12.0)
    assert info["severity"] >= 12.0
    assert info["reward_failure"] == pytest.approx(-6.0 - (8.0 - 0.01 * steps))
    assert worn == pytest.approx(-3.0 * info["severity"] / 12.0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step([0.0, RUN])
    env.reset(seed=1)
    limped = [env.step([0.5, LIMP])[4]["reward_limp"] for _ in range(40)]
    assert limped[0] == pytest.approx(-0.2 * 0.01 / 30.0)
    assert limped[-1] == pytest.approx(-0.2 * 0.01)
    _, reward, over, _, info = env.step([0.5, STOP])
    assert over
    assert reward == info["reward_stop"] == pytest.approx(-7.6)


def test_a_faulty_winding_burns() -> None:
    env = DriveEnv(weights=(0.0, 0.0, 1.0), mean_onset_s=0.0, burn_k=71.0, thermal_time_s=0.2)
    policy, (observation, _) = PI(env.setup), env.reset(seed=4)
    policy.start(1)
    over, heat = False, 0.0
    while not over:
        observation, _, over, _, info = env.step(policy.act(observation[None])[0])
        heat += info["reward_heat"]
    assert info["temperature_k"] >= 71.0
    assert info["severity"] < 4.0
    assert info["reward_failure"] < -6.0
    assert heat < 0.0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"voltage_limit_v": 12.0}, "needs 1.25 A and 13.3 V, the limits are 3 A and 12 V"),
        ({"ramp_s": (0.02, 0.5)}, "the profile must be one that the motor can follow"),
        (
            {"current_limit_a": 0.3},
            "current_limit_a must hold load and friction at lowest_speed_rad_s, 0.371 A",
        ),
        ({"failure_cost": -1.0}, "failure_cost must be finite and >= 0, got -1"),
        ({"stop_cost_per_s": 1e9}, "stop_cost_per_s must be at most 1e+06, got 1e+09"),
        ({"weights": (0.0, 0.0, 0.0)}, "weights must not all be 0"),
        ({"weights": (1.0, 1.0)}, "weights must be 3 numbers"),
        ({"warm_k": 130.0}, "warm_k must be below burn_k = 120.0, got 130.0"),
        ({"onset_severity": (13.0, 0.2)}, "onset_severity must be below failure_severity"),
        ({"limp_share": 1.0}, "limp_share must be below 1"),
        ({"ramp_s": (0.5, 0.2)}, "ramp_s must be the smaller, then the larger number, got 0.5, 0.2"),
        ({"horizon_s": 1e9}, "horizon_s must be 1 to 100000 periods"),
        ({"speed": 1.0}, "no option 'speed'"),
    ],
)
def test_bad_options_get_their_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        DriveEnv(**options)


def test_bad_actions_get_their_sentence() -> None:
    env = DriveEnv()
    env.reset(seed=0)
    for action in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match=r"action must be finite and have shape \(2,\)"):
            env.step(action)


def test_detection_is_worth_something(monkeypatch: pytest.MonkeyPatch) -> None:
    envs = DriveVectorEnv(40)
    fixed, bank = (drive_episodes(envs, Lqg(envs.setup, levels=levels), seed=9) for levels in (0, 8))
    ahead = bank.returns - fixed.returns
    assert ahead.mean() > 1.0 + 1.96 * ahead.std() / np.sqrt(40)
    np.testing.assert_array_equal(fixed.class_index, bank.class_index)
    monkeypatch.setattr(evaluation, "LIMP_FROM", (0.35, 0.7))
    monkeypatch.setattr(evaluation, "STOP_FROM", (0.97,))
    assert clairvoyant_returns(envs, seed=9).mean() > bank.returns.mean()


def test_a_picture_changes_nothing() -> None:
    shown, plain = DriveEnv(render_mode="rgb_array"), DriveEnv()
    shown.reset(seed=1)
    plain.reset(seed=1)
    for _ in range(50):
        np.testing.assert_array_equal(shown.step([0.6, LIMP])[0], plain.step([0.6, LIMP])[0])
    frame = shown.render()
    assert frame.shape == (448, 640, 3)
    assert frame.std() > 10.0
