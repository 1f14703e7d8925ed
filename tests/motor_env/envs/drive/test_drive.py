"""Drive: the package's physics, gymnasium's contract, costs as the options say, and what detection is worth."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from single_lanes import assert_lanes_are_single

from motor_env import discretize
from motor_env.envs import DriveEnv, DriveOptions, DriveVectorEnv, Lqg, returns_of
from motor_env.envs.drive.drive_env import LIMP, RUN, STOP
from motor_env.envs.drive.drive_setup import LANES, drive_filter, faulty
from motor_env.envs.drive.lqg import make_bank
from motor_env.envs.drive.options import LABELS
from motor_env.envs.setup import converged_gain

# Reaches in: the filter, noise and growth of the drive by hand, from the same streams and columns.
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.model import Input
from motor_env.simulation.random_streams import Stream, normals, uniforms

VOLTAGES: dict[str, Any] = {
    "control": "voltage_and_decision",
    "steps_per_decision": 1,
    "tracking_limit_per_s": 0.0,
}
SHORT: dict[str, Any] = {"horizon_s": 0.6, "earliest_onset_s": 0.1, "mean_onset_s": 0.1}


def drive(**changes: Any) -> DriveEnv:
    return DriveEnv(**{**VOLTAGES, **changes})


def drives(count: int, **options: Any) -> DriveVectorEnv:
    return DriveVectorEnv(count, **{**VOLTAGES, **options})


def only(kind: int) -> dict[str, Any]:
    """Episodes of that kind, from the earliest onset on."""
    return {"weights": tuple(float(k == kind) for k in range(3)), "mean_onset_s": 0.0}


def random_actions(steps: int, count: int) -> NDArray[np.float64]:
    """Any voltage; a decision that now and then limps, and seldom stops."""
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.2, 1.2, (steps, count, 2))
    actions[..., 1] = rng.choice([RUN, LIMP, STOP], (steps, count), p=[0.7, 0.29, 0.01])
    return actions


@pytest.mark.parametrize("control", ["voltage_and_decision", "decision"])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_every_lane_is_the_single_environment(mode: AutoresetMode, control: str) -> None:
    actions: Any = random_actions(200, 12)
    if control == "decision":
        actions = np.random.default_rng(2).choice(3, (200, 12), p=[0.7, 0.27, 0.03])
    envs = drives(12, autoreset_mode=mode, **SHORT | {"control": control})
    assert_lanes_are_single(envs, drive(**SHORT | {"control": control}), actions)


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


def followed(env: DriveEnv, actions: Iterable[Any]) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Lane before and after each step, what is observed, and the info, to the end of an episode."""
    for action in actions:
        before = lane_of(env)
        observation, _, over, _, info = env.step(action)
        yield before, lane_of(env), dict(zip(env.observed, observation.astype(float), strict=True)), info
        if over:
            return


def test_the_supply_keeps_its_limits() -> None:
    envs = drives(30, current_limit_a=1.7)
    envs.reset(seed=2)
    for action in random_actions(150, 30):
        envs.step(action * [1.0, 0.0])
        assert (np.abs(envs.truth("current")) < 1.7 + 1e-9).all()
        assert (np.abs(envs.truth("voltage")) <= 16.0).all()


def test_a_profile_is_plateaus_and_ramps_between_them() -> None:
    env, wanted = drive(), np.zeros(0)
    env.reset(seed=3)
    for level, length, rise, _ in uniforms(3, Stream.PROFILE, [0], 120)[0].reshape(-1, 4):
        aim, plateau = 100.0 + 350.0 * level, int(np.ceil((0.2 + 0.6 * length) / 0.01))
        ramp = int(np.ceil((0.2 + 0.3 * rise) / 0.01)) if len(wanted) else 0
        begin = wanted[-1] if len(wanted) else aim
        rises = begin + (aim - begin) * np.arange(1, ramp + 1) / max(ramp, 1)
        wanted = np.concatenate([wanted, rises, np.full(plateau, aim)])
    profile = env._lanes.profile[0]
    np.testing.assert_allclose(profile, wanted[: len(profile)], rtol=1e-12)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (1, {"growth_per_s": (10.0, 10.0), "wear_cost": 3.0}),
        (2, {"growth_per_s": (10.0, 10.0)}),
        (0, {"thermal_time_s": 0.4, "warm_k": 20.0, "burn_k": 25.0}),
    ],
)
def test_a_failure_costs_the_rest_of_the_episode_and_more(kind: int, options: dict[str, Any]) -> None:
    env = drive(**only(kind), **options)
    env.reset(seed=1)
    steps = list(followed(env, [[0.8 - 0.4 * (k % 3), RUN] for k in range(800)]))
    (*_, (_, _, _, before), (_, _, _, info)), count = steps, len(steps)
    assert count < 800
    measure, limit = (("temperature_k", 25.0), ("severity", 12.0), ("severity", 4.0))[kind]
    assert before[measure] < limit <= info[measure]
    assert info["reward_failure"] == pytest.approx(-6.0 - (8.0 - 0.01 * count))
    assert info["reward_wear"] == pytest.approx(-3.0 * info["severity"] / 12.0 if kind == 1 else 0.0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step([0.0, RUN])


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_motor_heat_wear_and_prices_follow_their_equations(kind: int) -> None:
    """At the default numbers, from the motor's true state, as docs/drive-and-maintain.md has them."""
    env = drive(**only(kind), warm_k=1.0, burn_k=1e3)
    _, first = env.reset(seed=3)
    assert first["onset_step"] == (50 if kind else -1)
    profile, believed, heat, worn, decay = env._lanes.profile[0], 0.0, 0.0, 0.0, np.exp(-0.01 / 2.0)
    growth = 0.4 * 3.0 ** uniforms(3, Stream.SEVERITY, [0], 1)[0, 0]
    actions = [[0.5 + 0.1 * (k % 3), LIMP if 60 <= k < 100 else RUN] for k in range(150)]
    for k, (before, after, seen, info) in enumerate(followed(env, actions)):
        active = kind > 0 and k >= 50
        assert (info["fault_active"], info["severity"] > 0.0) == (active, active)
        model = discretize(faulty(env.options, LABELS[kind], info["severity"]), 0.01)
        torque = 8e-3 + 12e-3 * (before["speed"] / 450.0) ** 2 + before["load"]
        state = model.transition @ [before["current"], before["speed"]] + model.gain @ [
            after["voltage"],
            torque,
        ]
        np.testing.assert_allclose([after["current"], after["speed"]], state, rtol=1e-6)
        loss_w = (
            1.09 * (1.0 + info["severity"] * (kind == 2)) * (before["current"] ** 2 + after["current"] ** 2)
        )
        warm = decay * before["temperature"] + (1.0 - decay) * 40.0 * loss_w
        assert info["temperature_k"] == pytest.approx(warm, rel=1e-9)
        loss_w = 1.09 * (before["estimated_current"] ** 2 + after["estimated_current"] ** 2)
        believed = decay * believed + (1.0 - decay) * 40.0 * loss_w
        assert seen["estimated_temperature"] == pytest.approx(believed / 1e3, rel=1e-5)
        pace = 0.1 + 0.9 * max(torque * before["speed"] / (20e-3 * 450.0), 0.0) if kind == 1 else 1.0
        grown = (before["severity"] or (2.0, 2.0, 0.2)[kind]) * np.exp(growth * pace * 0.01)
        assert info["severity"] == pytest.approx(grown * active, rel=1e-9)
        share = float(np.clip(after["scale"] - before["scale"], -1.0, 1.0))
        assert abs(share) < 0.5 * 0.01 / 0.3 + 1e-12  # to a half within 0.3 s
        off = (after["speed"] - after["scale"] * profile[k + 1]) / 450.0
        heat -= 0.05 * 0.01 * max(info["temperature_k"] - 1.0, 0.0)
        worn = -info["severity"] / 12.0 if kind == 1 else 0.0
        limp = -0.2 * 0.01 * (1.0 - after["scale"]) / 0.5
        paid = [info[f"reward_{name}"] for name in ("tracking", "limp", "heat", "wear", "stop", "failure")]
        assert paid == pytest.approx([-300.0 * off**2 * 0.01, limp, 0.0, 0.0, 0.0, 0.0], rel=1e-9, abs=1e-15)
    _, reward, _, _, info = env.step([0.0, 0.51])  # heat and wear are paid at the end
    paid = [info["reward_heat"], info["reward_wear"], reward]
    assert paid == pytest.approx([heat, worn, heat + worn - (8.0 - 1.5)], rel=1e-9)


def test_what_a_profile_needs() -> None:
    options = DriveOptions()
    motor, drag = options.motor, float(options.motor.viscous_friction_n_m_s_per_rad)
    slope, torque = 350.0 / 0.2, 8e-3 + 12e-3 + drag * 450.0
    torque += (float(motor.inertia_kg_m2) + 4e-6) * slope
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
    for k, (_, after, seen, _) in enumerate(followed(env, actions)):
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
    std = [*DEFAULT_PROCESS_NOISE_STD, 2e-3 * np.sqrt(1.0 - keep**2)]
    np.testing.assert_allclose(np.diag(belief.process_covariance), np.square(std), rtol=1e-12)


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
    healthy, bearing = [0.51, 0.49, 0.49, 0.0, 0.0, 1.0], [0.29, 0.31, 0.0, 0.0, 0.0, 0.0]
    winding = [[0.0, 0.0, 0.51, 0.50, 0.45, 0.0], [0.0, 0.0, 0.0, 0.50, 0.55, 0.0]]
    policy.probability = np.array([healthy, bearing, [0.2, 0.2, 0.0, 0.0, 0.0, 0.0], *winding])
    policy.stop_above = (2.0, float(np.array([0.475, 0.525]) @ bank.severity[3:]) / 4.0)
    assert policy._decision().tolist() == [RUN, LIMP, RUN, RUN, STOP, RUN]
    policy.stop_above = (2.0, 0.75)
    policy._temperature = np.array([69.9, 0.0, 70.1, 0.0, 89.9, 90.1])
    assert policy._decision().tolist() == [RUN, LIMP, LIMP, RUN, LIMP, STOP]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"voltage_limit_v": 12.0}, "needs 1.25 A and 13.3 V, the limits are 3 A and 12 V"),
        ({"current_limit_a": 0.3}, "must hold load and friction at lowest_speed_rad_s, 0.371 A"),
        ({"limp_share": 1.0}, "limp_share must be below 1"),
        ({"period_s": 0.21}, "period_s must be at most a ramp"),
        ({"horizon_s": 1000.01}, "horizon_s must be 1 to 100000 periods"),
        ({"weights": (0.0, 0.0, 0.0)}, "weights must not all be 0"),
        ({"onset_severity": (13.0, 0.2)}, "onset_severity must be below failure_severity"),
        ({"control": "torque"}, "control must be one of voltage_and_decision, voltage_limp_stop, decision"),
        ({"steps_per_decision": 7}, "must hold a whole number of decisions of 7 periods, got 800"),
    ],
)
def test_bad_options_get_their_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        drive(**options)


def test_three_numbers_give_the_same_commands_as_two() -> None:
    plain, other = drives(16, **SHORT), drives(16, **SHORT, control="voltage_limp_stop")
    wanted, found = (returns_of(envs, Lqg(envs.setup, levels=3), seed=3) for envs in (plain, other))
    np.testing.assert_array_equal(found, wanted)


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


def test_a_decision_lasts() -> None:
    options: dict[str, Any] = {"control": "decision", "weights": (1.0, 0.0, 0.0)}
    fine, coarse = drives(4, **options), drives(4, **options, steps_per_decision=5)
    for envs in (fine, coarse):
        envs.reset(seed=5)
    for step in range(100):
        limps = np.full(4, step % 3 == 0, dtype=np.int64)
        inner = [fine.step(limps) for _ in range(5)]
        seen, reward, _, _, info = coarse.step(limps)
        np.testing.assert_array_equal(seen, inner[-1][0])
        np.testing.assert_allclose(reward, sum(each[1] for each in inner), rtol=1e-12)
        limped = sum(each[4]["reward_limp"] for each in inner)
        np.testing.assert_allclose(info["reward_limp"], limped, rtol=1e-12)


def test_an_error_of_the_speed_costs_so_much_at_most() -> None:
    free, capped = (drives(5, tracking_limit_per_s=limit) for limit in (0.0, 3.0))
    for envs in (free, capped):
        envs.reset(seed=5)
    for action in random_actions(60, 5) * [1.0, 0.0]:
        errors = [-envs.step(action)[4]["reward_tracking"] for envs in (free, capped)]
        np.testing.assert_allclose(errors[1], errors[0] / (1.0 + errors[0] / 0.03), rtol=1e-12)
    assert errors[0].max() > 0.03 > errors[1].max()


def test_a_picture_changes_nothing_in_a_drive() -> None:
    options: dict[str, Any] = {"control": "decision", "steps_per_decision": 10}
    shown, plain = (drive(**options, render_mode=mode) for mode in ("rgb_array", None))
    shown.reset(seed=4)
    plain.reset(seed=4)
    first = np.asarray(shown.render())
    for _ in range(8):
        np.testing.assert_array_equal(shown.step(0)[0], plain.step(0)[0])
    assert not np.array_equal(np.asarray(shown.render())[40:], first[40:])  # the head says the time
