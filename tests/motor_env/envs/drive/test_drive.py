"""Drive: the package's physics, gymnasium's contract, costs as the options say, and what detection is worth."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from best_policies import PlannedDecisions, PlannedDrive
from bounds import drive_bounds
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from single_lanes import assert_lanes_are_single

from motor_env import discretize
from motor_env.envs import (
    DriveEnv,
    DriveOptions,
    DriveVectorEnv,
    Lqg,
    parts_of,
    returns_of,
)
from motor_env.envs.drive.drive_env import LIMP, RUN, STOP
from motor_env.envs.drive.drive_setup import LANES, drive_filter, faulty, make_setup
from motor_env.envs.drive.lqg import make_bank
from motor_env.envs.drive.options import LABELS
from motor_env.envs.setup import converged_gain

# Reaches in: the filter, noise and growth of the drive by hand, from the same streams and columns.
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.model import Input
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, normals, uniforms

VOLTAGES: dict[str, Any] = {
    "control": "voltage_and_decision",
    "steps_per_decision": 1,
    "tracking_limit_per_s": 0.0,
}
SHORT: dict[str, Any] = {"horizon_s": 0.6, "earliest_onset_s": 0.1, "mean_onset_s": 0.1}
STEADY: dict[str, Any] = {"growth_per_s": (1e-9, 1e-9), "load_std_n_m": 1e-13, "earliest_onset_s": 0.05}


def drive(options: DriveOptions | None = None, **changes: Any) -> DriveEnv:
    return DriveEnv(options, **{**VOLTAGES, **changes})


def drives(count: int, **options: Any) -> DriveVectorEnv:
    return DriveVectorEnv(count, **{**VOLTAGES, **options})


def drive_options(**options: Any) -> DriveOptions:
    return DriveOptions(**{**VOLTAGES, **options})


def random_actions(steps: int, count: int) -> NDArray[np.float64]:
    """Any voltage; a decision that now and then limps, and seldom stops."""
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.2, 1.2, (steps, count, 2))
    actions[..., 1] = rng.choice([RUN, LIMP, STOP], (steps, count), p=[0.7, 0.29, 0.01])
    return actions


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_every_lane_is_the_single_environment(mode: AutoresetMode) -> None:
    count, actions = 12, random_actions(200, 12)
    envs = drives(count, autoreset_mode=mode, **SHORT)
    assert_lanes_are_single(envs, drive(**SHORT), actions)


def test_a_score_counts_the_first_episode_alone() -> None:
    """Two motors of three are stopped at once; the vector begins further episodes of them while the third runs."""

    class StopTwo:
        def start(self, count: int) -> None:
            self.first = True

        def act(self, observations: Any) -> NDArray[np.float64]:
            decision = STOP if self.first else RUN
            self.first = False
            return np.array([[0.0, decision], [0.0, RUN], [0.0, decision]])

    envs, env = drives(3, **SHORT), drive(**SHORT)
    returns, parts = (of(envs, StopTwo(), seed=5) for of in (returns_of, parts_of))
    for index in (0, 2):
        env.reset(seed=5, options={"index": index})
        _, reward, over, _, _ = env.step([0.0, STOP])
        assert over
        assert returns[index] == pytest.approx(reward)
    assert parts[:, 1].any()
    np.testing.assert_allclose(parts.sum(axis=0), returns)


def test_a_controller_forgets_the_episode_before() -> None:
    """Filters, integral, and a winding that counts as warm from one kelvin on."""
    envs = drives(4, warm_k=1.0, **SHORT)
    used, fresh = (Lqg(envs.setup, levels=3) for _ in range(2))
    for policy, seed in ((used, 1), (fresh, 2)):
        policy.start(4)
        seen, _ = envs.reset(seed=seed)
        for _ in range(30 if policy is used else 0):
            seen = envs.step(used.act(seen))[0]
    for _ in range(10):
        actions = used.act(seen)
        np.testing.assert_array_equal(actions, fresh.act(seen))
        seen = envs.step(actions)[0]


def lane_of(env: DriveEnv) -> dict[str, float]:
    """The numbers of a single environment by name, as they stand."""
    block = env._lanes.state[0]
    return {name: float(block[name][0]) for name in block.dtype.names if block[name].shape == (LANES,)}


def state_of(env: DriveEnv) -> FloatArray:
    """Its current and speed."""
    return np.array([lane_of(env)["current"], lane_of(env)["speed"]])


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_the_motor_is_the_discretised_one_with_its_fault(kind: int) -> None:
    weights = tuple(float(k == kind) for k in range(3))
    options = drive_options(weights=weights, mean_onset_s=0.0, **STEADY)
    env, truth = drive(options), []
    _, info = env.reset(seed=3)
    assert info["label"] == LABELS[kind]
    rng, states, volts = np.random.default_rng(0), [state_of(env)], []
    for _ in range(60):
        info = env.step([rng.uniform(0.3, 0.7), RUN])[4]
        states.append(state_of(env))
        volts.append(lane_of(env)["voltage"])
        truth.append(info["severity"])
    assert (truth[4], truth[5] > 0.0) == (0.0, kind > 0)
    for before, after, voltage, severity in zip(states[:-1], states[1:], volts, truth, strict=True):
        model = discretize(faulty(options, LABELS[kind], severity), options.period_s)
        load = options.load_torque_n_m + options.fan_n_m_s2 * before[1] ** 2
        expected = model.transition @ before + model.gain @ [voltage, load]
        np.testing.assert_allclose(after, expected, rtol=1e-6)


def test_the_filter_of_a_healthy_motor_has_white_innovations() -> None:
    envs = drives(50, weights=(1.0, 0.0, 0.0), horizon_s=3.0)
    policy, (observations, _) = Lqg(envs.setup), envs.reset(seed=5)
    policy.start(50)
    rows = []
    for _ in range(290):
        observations, _, over, _, _ = envs.step(policy.act(observations))
        assert not over.any()
        rows.append(observations[:, 3:5])
    white = np.array(rows)
    assert envs.setup.observed[3:5] == ("innovation_current", "innovation_speed")
    np.testing.assert_allclose(white.mean(axis=(0, 1)), 0.0, atol=0.05)
    np.testing.assert_allclose(white.std(axis=(0, 1)), 1.0, atol=0.03)
    assert np.abs((white[1:] * white[:-1]).mean(axis=(0, 1))).max() < 0.03


def test_supply_and_profile_keep_their_limits() -> None:
    envs = drives(30, current_limit_a=1.7)
    envs.reset(seed=2)
    for action in random_actions(150, 30):
        envs.step(action * [1.0, 0.0])
        assert (np.abs(envs.truth("current")) < 1.7 + 1e-9).all()
        assert (np.abs(envs.truth("voltage")) <= 16.0).all()
    profile, options = envs._arrays[-1], envs.options
    assert profile.min() >= options.lowest_speed_rad_s
    assert profile.max() <= options.top_speed_rad_s
    steepest = (options.top_speed_rad_s - options.lowest_speed_rad_s) / options.ramp_s[0]
    assert np.abs(np.diff(profile)).max() <= steepest * options.period_s * (1.0 + 1e-9)


def test_a_failure_costs_the_rest_of_the_episode_and_more() -> None:
    env = drive(weights=(0.0, 1.0, 0.0), mean_onset_s=0.0, growth_per_s=(10.0, 10.0), wear_cost=3.0)
    policy = Lqg(env.setup)
    policy.start(1)
    observation, _ = env.reset(seed=1)
    worn, over, steps = 0.0, False, 0
    while not over:
        observation, _, over, _, info = env.step(policy.act(observation[None])[0])
        steps, worn = steps + 1, worn + info["reward_wear"]
    assert info["severity"] >= 12.0
    assert info["reward_failure"] == pytest.approx(-6.0 - (8.0 - 0.01 * steps))
    assert worn == pytest.approx(-3.0 * info["severity"] / 12.0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step([0.0, RUN])


def follow_truth(env: DriveEnv, actions: Iterable[Any]) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Lane before and after each step, what is observed, and the info."""
    for action in actions:
        before = lane_of(env)
        observation, _, over, _, info = env.step(action)
        yield (
            before,
            lane_of(env),
            dict(zip(env.observed, observation.astype(float), strict=True)),
            info,
        )
        if over:
            return


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_every_price_alone(kind: int) -> None:
    """At the default prices, from the motor's true state, as docs/drive-and-maintain.md has them."""
    weights = tuple(float(k == kind) for k in range(3))
    env = drive(weights=weights, mean_onset_s=0.0, warm_k=1.0, burn_k=1e3, growth_per_s=(1.2, 1.2))
    env.reset(seed=3)
    profile, limps, heat, worn = env._lanes.profile[0], 0.0, 0.0, 0.0
    rng = np.random.default_rng(2)
    actions = [[rng.uniform(0.3, 0.8), LIMP if 60 <= k < 100 else RUN] for k in range(150)]
    for k, (before, after, _, info) in enumerate(follow_truth(env, actions)):
        share = min(max(after["scale"] - before["scale"], -1.0), 1.0)
        assert abs(share) < 0.5 * 0.01 / 0.3 + 1e-12  # to a half within 0.3 s
        off = (after["speed"] - after["scale"] * profile[k + 1]) / 450.0
        assert info["reward_tracking"] == pytest.approx(-300.0 * off**2 * 0.01, rel=1e-9)
        heat -= 0.05 * 0.01 * max(info["temperature_k"] - 1.0, 0.0)
        worn = after["severity"] if kind == 1 else 0.0
        assert (info["reward_heat"], info["reward_wear"]) == (0.0, 0.0)  # they are paid at the end
        assert info["reward_limp"] == pytest.approx(-0.2 * 0.01 * (1.0 - after["scale"]) / 0.5, abs=1e-15)
        assert (info["reward_stop"], info["reward_failure"]) == (0.0, 0.0)
        limps = min(limps, info["reward_limp"])
    assert limps == pytest.approx(-0.002)
    _, reward, _, _, info = env.step([0.0, 0.51])
    assert info["reward_heat"] == pytest.approx(heat, rel=1e-9)
    assert info["reward_wear"] == pytest.approx(-worn / 12.0, rel=1e-9)
    assert reward == pytest.approx(heat - worn / 12.0 - (8.0 - 1.5))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_heat_and_wear_follow_their_equations(kind: int) -> None:
    weights = tuple(float(k == kind) for k in range(3))
    env = drive(weights=weights, mean_onset_s=0.0)
    _, first = env.reset(seed=3)
    assert first["onset_step"] == (50 if kind else -1)
    options, motor, believed = env.options, env.options.driven, 0.0
    growth = 0.4 * 3.0 ** uniforms(3, Stream.SEVERITY, [0], 1)[0, 0]
    actions = [[0.6 + 0.2 * (k % 3), LIMP if k % 7 == 3 else RUN] for k in range(120)]
    for k, (before, after, seen, info) in enumerate(follow_truth(env, actions)):
        ohm = 2.18 * (1.0 + info["severity"] * (kind == 2))
        loss_w = 0.5 * ohm * (before["current"] ** 2 + after["current"] ** 2)
        decay = np.exp(-0.01 / 2.0)
        warm = decay * before["temperature"] + (1.0 - decay) * 40.0 * loss_w
        assert info["temperature_k"] == pytest.approx(warm, rel=1e-9)
        loss_w = 1.09 * (before["estimated_current"] ** 2 + after["estimated_current"] ** 2)
        believed = decay * believed + (1.0 - decay) * 40.0 * loss_w
        assert seen["estimated_temperature"] == pytest.approx(believed / 120.0, rel=1e-5)
        assert info["fault_active"] == (kind > 0 and k >= 50)
        if not info["fault_active"]:
            assert info["severity"] == 0.0
            continue
        speed = before["speed"]
        power = (8e-3 + 12e-3 * (speed / 450.0) ** 2 + before["load"]) * speed / (20e-3 * 450.0)
        pace = 0.1 + 0.9 * max(power, 0.0) if kind == 1 else 1.0
        begun = before["severity"] or (2.0, 0.2)[kind - 1]
        assert info["severity"] == pytest.approx(begun * np.exp(growth * pace * 0.01), rel=1e-9)
    drag = float(motor.viscous_friction_n_m_s_per_rad)
    slope, torque = 350.0 / 0.2, 8e-3 + 12e-3 + drag * 450.0
    torque += (float(env.options.motor.inertia_kg_m2) + 4e-6) * slope
    current, volts = options.needs(450.0, slope)
    assert current == pytest.approx(torque / float(motor.torque_constant_n_m_per_a))
    assert volts == pytest.approx(2.18 * current + 450.0 * float(motor.back_emf_constant_v_s_per_rad))


def test_the_filter_sees_what_its_model_says() -> None:
    """Estimates and whitened innovations against `run_filter`'s equations with the fan as it turns; units by hand."""
    env = drive(weights=(1.0, 0.0, 0.0), load_std_n_m=2e-3)
    env.reset(seed=3)
    options, belief = env.options, drive_filter(env.options, env.options.driven)
    gain, covariance = converged_gain(belief)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    model, keep = discretize(options.driven, 0.01), np.exp(-0.01)
    rest = lane_of(env)
    state = np.array([rest["current"], rest["speed"], 0.0])
    slow, memory = np.zeros(2), np.exp(-0.01 / 0.3)
    actions = [[0.6 + 0.2 * (k % 3), RUN] for k in range(60)]
    for k, (_, after, seen, _) in enumerate(follow_truth(env, actions)):
        torque = 8e-3 + 12e-3 * (state[1] / 450.0) ** 2 + state[2]
        state = np.append(
            model.transition @ state[:2] + model.gain @ [after["voltage"], torque], keep * state[2]
        )
        off = np.array([after["measured_current"], after["measured_speed"]]) - state[:2]
        state = state + gain @ off
        white = whitening @ off
        slow = memory * slow + np.sqrt(1.0 - memory**2) * white
        names = ("innovation_current", "innovation_speed", "slow_current", "slow_speed")
        assert [seen[name] for name in names] == pytest.approx([*white, *slow], abs=2e-5)
        assert seen["estimated_load"] == pytest.approx(state[2] / 20e-3, abs=1e-6)
        noise = normals(3, Stream.MEASUREMENT, [0], 4 * (k + 1))[0, -4:]
        assert seen["measured_current"] * 3.0 - after["current"] == pytest.approx(0.02 * noise[0], abs=1e-6)
        assert seen["measured_speed"] * 450.0 - after["speed"] == pytest.approx(noise[1], abs=1e-4)
        assert seen["voltage"] * 16.0 == pytest.approx(after["voltage"], abs=1e-5)
        assert seen["time"] == pytest.approx((k + 1) / 800.0, abs=1e-7)
        ahead = [seen[f"profile_{m}"] * 450.0 for m in (0, 1, 5, 10, 20)]
        assert ahead == pytest.approx(env._lanes.profile[0][[k + 1 + m for m in (0, 1, 5, 10, 20)]], abs=1e-4)
    middle, by_load = 0.5 * (100.0 + 450.0), model.gain[:, Input.LOAD_TORQUE]
    wanted = np.zeros((3, 3))
    wanted[:2, :2], wanted[:2, 2], wanted[2, 2] = model.transition, by_load, keep
    wanted[:2, 1] += by_load * 2.0 * 12e-3 / 450.0**2 * middle
    np.testing.assert_allclose(belief.model.transition, wanted, rtol=1e-12)
    stir = 2e-3 * np.sqrt(1.0 - keep**2)
    np.testing.assert_allclose(
        np.diag(belief.process_covariance), np.square([*DEFAULT_PROCESS_NOISE_STD, stir]), rtol=1e-12
    )


def test_a_long_period_shows_each_step_ahead_once() -> None:
    """0.05 s ahead is the end of the next step already."""
    setup = make_setup(drive_options(period_s=0.05))
    assert setup.ahead.tolist() == [0, 1, 2, 4]
    assert setup.observed[-4:] == ("profile_0", "profile_1", "profile_2", "profile_4")


def test_a_bank_and_its_decisions_by_hand() -> None:
    """Two severities of each kind, a quarter and three quarters of the way from onset to failure, on a logarithm."""
    setup = drive().setup
    bank = make_bank(setup.options, 2)
    assert bank.kind.tolist() == [0, 1, 1, 2, 2]
    sixth, twentieth = (12.0 / 2.0) ** 0.25, (4.0 / 0.2) ** 0.25
    severity = [0.0, 2.0 * sixth, 2.0 * sixth**3, 0.2 * twentieth, 0.2 * twentieth**3]
    assert bank.severity == pytest.approx(severity)
    assert bank.ohm == pytest.approx(2.18 * (1.0 + bank.severity * (bank.kind == 2)))
    friction = float(setup.options.driven.viscous_friction_n_m_s_per_rad)
    assert bank.drag == pytest.approx(friction * (1.0 + bank.severity * (bank.kind == 1)))
    born = 0.01 / 1.51 / 3.0
    on = [0.01 * np.sqrt(0.4 * 1.2) * 2.0 / np.log(ratio) for ratio in (6.0, 20.0)]
    moves = np.diag([1.0 - 2.0 * born, 1.0 - on[0], 1.0, 1.0 - on[1], 1.0])
    moves[0, [1, 3]], moves[1, 2], moves[3, 4] = born, on[0], on[1]
    np.testing.assert_allclose(bank.moves, moves, rtol=1e-12)
    model = drive_filter(setup.options, setup.options.driven).model
    a, b = np.eye(3), np.append(model.gain[:, Input.VOLTAGE], 0.0)
    a[:2, :2], a[2, 1] = model.transition[:2, :2], 0.01
    cost = np.zeros((3, 3))
    for _ in range(3000):  # value iteration: squared rad/s at 1, squared rad at 3000, squared volt at 1
        back = (b @ cost @ a) / (1.0 + b @ cost @ b)
        cost = np.diag([0.0, 1.0, 3000.0]) + a.T @ cost @ (a - np.outer(b, back))
    np.testing.assert_allclose(bank.feedback[0], back, rtol=1e-8)
    policy = Lqg(setup, levels=2)
    policy.start(6)
    policy.probability = np.array(
        [
            [0.51, 0.49, 0.49, 0.0, 0.0, 1.0],
            [0.29, 0.31, 0.0, 0.0, 0.0, 0.0],
            [0.20, 0.20, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.51, 0.50, 0.45, 0.0],
            [0.0, 0.0, 0.0, 0.50, 0.55, 0.0],
        ]
    )
    worn = np.array([0.5, 0.5]) @ bank.severity[3:] / 4.0, np.array([0.45, 0.55]) @ bank.severity[3:] / 4.0
    policy.stop_above = (2.0, float(np.mean(worn)))
    assert policy._decision().tolist() == [RUN, LIMP, RUN, RUN, STOP, RUN]
    policy.stop_above = (2.0, 0.75)
    policy._temperature = np.array([69.9, 0.0, 70.1, 0.0, 89.9, 90.1])
    assert policy._decision().tolist() == [RUN, LIMP, LIMP, RUN, LIMP, STOP]
    assert (Lqg(setup).limp_above, Lqg(setup).stop_above, Lqg(setup).decides) == (0.5, (2.0, 0.75), False)


@pytest.mark.parametrize("factor", [1.0 - 1e-9, 1.0 + 1e-9])
def test_limits_of_the_options_are_exact(factor: float) -> None:
    current, volts = drive_options().needs(450.0, 350.0 / 0.2)
    refused: list[dict[str, Any]] = [
        {"voltage_limit_v": volts / factor},
        {"current_limit_a": current / factor},
        {"period_s": 0.2 * factor, "horizon_s": 2.0},
        {"stress_share": factor},
        {"horizon_s": 1000.005 * factor},
        {"horizon_s": 0.005 / factor},
        {"limp_share": 1.0 - 2e-9 + (factor - 1.0) * 2.0},
    ]
    for options in refused:
        if factor < 1.0:
            drive_options(**options)
        else:
            with pytest.raises(ValueError, match=r"must be|needs"):
                drive_options(**options)
    with pytest.raises(ValueError, match="periods, got 200000"):
        drive_options(horizon_s=1e9)


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
        (
            {"control": "torque"},
            "control must be one of voltage_and_decision, voltage_limp_stop, decision, got",
        ),
        ({"steps_per_decision": 0}, "steps_per_decision must be a whole number >= 1, got 0"),
        ({"steps_per_decision": 7}, "horizon_s must hold a whole number of decisions of 7 periods, got 800"),
    ],
)
def test_bad_options_get_their_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        drive(**options)


def test_bad_actions_get_their_sentence() -> None:
    env = drive()
    env.reset(seed=0)
    for action in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match=r"action must be finite and have shape \(2,\)"):
            env.step(action)


@pytest.mark.parametrize("control", ["voltage_limp_stop", "decision"])
def test_other_actions_give_the_same_commands(control: str) -> None:
    """Of a vector and of a single environment; the drive's own controller is the LQG of the healthy motor."""
    short: dict[str, Any] = {"tracking_limit_per_s": 3.0, "horizon_s": 3.0, "growth_per_s": (1.0, 3.0)}
    changes = short | {"control": control}
    plain, other = drives(16, **short), drives(16, **changes)
    first, second = (returns_of(envs, Lqg(envs.setup, levels=3), seed=3) for envs in (plain, other))
    off = np.abs(first - second)
    assert (off == 0.0).all() if control == "voltage_limp_stop" else (np.median(off) < 0.02 and off.any())
    single = drive(**changes)
    seen, _ = single.reset(seed=3, options={"index": 7})
    policy, total, over = Lqg(single.setup, levels=3), 0.0, False
    policy.start(1)
    while not over:
        seen, reward, over, _, _ = single.step(policy.act(seen[None])[0])
        total += reward
    assert total == pytest.approx(second[7], abs=1e-9)
    for action in (3, [0.0, 0.0]):
        single.reset()
        with pytest.raises(ValueError, match="action must be"):
            single.step(action)


def test_its_own_controller_is_the_fixed_lqg() -> None:
    plain, own = drives(8), drives(8, control="decision")
    seen, _ = plain.reset(seed=3)
    own.reset(seed=3)
    policy = Lqg(plain.setup)
    policy.start(8)
    for _ in range(300):
        seen = plain.step(policy.act(seen))[0]
        other = own.step(np.zeros(8, dtype=np.int64))[0]
    np.testing.assert_allclose(other, seen, atol=2e-4)
    with pytest.raises(ValueError, match=r"actions must be in 0 .. 2, got 0 .. 3"):
        own.step(np.arange(8) % 4)


def test_a_decision_lasts_and_an_error_costs_so_much_at_most() -> None:
    healthy: dict[str, Any] = {"control": "decision", "weights": (1.0, 0.0, 0.0)}
    fine, coarse = drives(4, **healthy), drives(4, **healthy, steps_per_decision=5)
    fine.reset(seed=5)
    coarse.reset(seed=5)
    for step in range(100):
        limps = np.full(4, step % 3 == 0, dtype=np.int64)
        inner = [fine.step(limps) for _ in range(5)]
        seen, reward, over, _, info = coarse.step(limps)
        np.testing.assert_array_equal(seen, inner[-1][0])
        np.testing.assert_allclose(reward, sum(each[1] for each in inner), rtol=1e-12)
        np.testing.assert_allclose(
            info["reward_limp"], sum(each[4]["reward_limp"] for each in inner), rtol=1e-12
        )
        assert not over.any()
    free, capped = drives(50), drives(50, tracking_limit_per_s=3.0)
    for envs in (free, capped):
        envs.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = np.stack([rng.uniform(-1.0, 1.0, 50), np.full(50, RUN)], axis=1)
        errors = [-envs.step(actions)[4]["reward_tracking"] for envs in (free, capped)]
        np.testing.assert_allclose(errors[1], errors[0] / (1.0 + errors[0] / 0.03), rtol=1e-12)
    assert errors[0].max() > 0.5 > 0.03 > errors[1].max()


def test_no_controller_is_above_the_bound() -> None:
    """In no episode, as it is told all that is to come; the best plan comes near."""
    envs = drives(60)
    bound = drive_bounds(envs.options, 60, seed=4)
    best = returns_of(envs, PlannedDrive(envs.setup), 4)
    assert (best < bound + 1e-3).all()
    assert bound.mean() - 0.35 < best.mean() < bound.mean() < -0.5


@pytest.mark.long
def test_the_plan_is_ahead_of_the_bank() -> None:
    envs = drives(150)
    bank, plan = (
        returns_of(envs, policy, seed=9) for policy in (Lqg(envs.setup, levels=8), PlannedDrive(envs.setup))
    )
    ahead = plan - bank
    assert ahead.mean() > 1.5 * ahead.std() / np.sqrt(150)
    deciding = DriveVectorEnv(150)
    decided = returns_of(deciding, PlannedDecisions(deciding.setup), seed=9)
    assert decided.mean() > bank.mean()


def test_detection_is_worth_something() -> None:
    envs = drives(40)
    fixed, bank = (returns_of(envs, Lqg(envs.setup, levels=levels), seed=9) for levels in (0, 8))
    ahead = bank - fixed
    assert ahead.mean() > 1.0 + 1.96 * ahead.std() / np.sqrt(40)


def test_a_picture_changes_nothing() -> None:
    shown, plain = drive(render_mode="rgb_array"), drive()
    shown.reset(seed=1)
    plain.reset(seed=1)
    for _ in range(50):
        np.testing.assert_array_equal(shown.step([0.6, LIMP])[0], plain.step([0.6, LIMP])[0])
    frame = shown.render()
    assert frame.shape == (448, 640, 3)
    assert frame.std() > 10.0


@pytest.mark.parametrize("control", ["voltage_and_decision", "decision"])
def test_what_linear_algebra_gives_has_twelve_digits(control: str) -> None:
    """Its last digits differ from processor to processor, and an id's steps are the same to the bit."""
    task = make_setup(drive_options(control=control)).task
    names = [name for name in task._fields if re.fullmatch(r"[kw]\d\d|by_\w+", name)]
    assert len(names) == 12
    for name in names:
        assert getattr(task, name) == float(f"{getattr(task, name):.12g}")


def test_a_decision_is_drawn_as_long_as_it_lasts() -> None:
    """After 80 of 800 periods the curves reach a tenth of the screen further than after 8."""
    ends = []
    for repeats in (1, 10):
        env = drive(control="decision", steps_per_decision=repeats, render_mode="rgb_array")
        env.reset(seed=4)
        frames = []
        for _ in range(8):
            env.step(0)
            frames.append(np.asarray(env.render()))
        below = frames[-1][40:420] != frames[0][40:420]  # without the head, which says the time
        ends.append(int(np.flatnonzero(below.any(axis=(0, 2))).max()))
    assert 40 < ends[1] - ends[0] < 65
