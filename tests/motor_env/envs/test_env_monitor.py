"""Monitor-v0: the contract of gymnasium, and the same physics and filter as everywhere else."""

import warnings
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import motor_env  # noqa: F401  # registers the environments
from motor_env.envs import kernel
from motor_env.envs.base import Info
from motor_env.envs.kernel import LANES
from motor_env.envs.monitor import MonitorEnv
from motor_env.envs.noise import case_of
from motor_env.envs.setup import converged_gain
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter, schedule
from motor_env.motor.faults import Fault, FaultKind, apply_fault
from motor_env.motor.model import State, discretize, steady_state
from motor_env.motor.parameters import PAPER_MOTOR, FloatArray
from motor_env.simulation.drawing import draw
from motor_env.simulation.random_streams import Stream, normals
from motor_env.simulation.simulate import simulate_states

WAIT = 0


def test_check_env_warns_of_nothing() -> None:
    env = gym.make("motor_env/Monitor-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=find_spec("pygame") is None)


def rollout(env: MonitorEnv, seed: int, index: int = 0) -> tuple[FloatArray, list[Info], FloatArray]:
    """All observations, infos and the true states of a silent episode."""
    observation, info = env.reset(seed=seed, options={"index": index})
    observations, infos, states = [observation], [info], []
    over = False
    while not over:
        observation, _, over, truncated, info = env.step(WAIT)
        assert truncated is False
        observations.append(observation)
        infos.append(info)
        deviation = env._state[[kernel.CURRENT * LANES, kernel.SPEED * LANES]]
        states.append(deviation + env.setup.rest)
    return np.array(observations), infos, np.array(states)


def faulty_episode(env: MonitorEnv, label: str) -> int:
    """A seed whose episode has that fault."""
    for seed in range(1000):
        _, info = env.reset(seed=seed)
        if info["label"] == label and info["onset_sample"] < 1500:
            return seed
    raise AssertionError(label)


@pytest.mark.parametrize("kind", [FaultKind.BEARING, FaultKind.WINDING_CONTACT])
def test_true_states_are_those_of_the_simulation(kind: FaultKind) -> None:
    env = MonitorEnv(precision="float64")
    seed = faulty_episode(env, kind)
    _, infos, states = rollout(env, seed)
    dt_s, load = env.options.dt_s, env.options.load_n_m
    fault = Fault(kind, infos[0]["severity"], onset_s=infos[0]["onset_sample"] * dt_s)
    expected = simulate_states(
        PAPER_MOTOR,
        np.full(len(states), 12.0),
        dt_s,
        faults=(fault,),
        load_torque_n_m=load,
        initial_state=steady_state(PAPER_MOTOR, 12.0, load),
    )
    np.testing.assert_allclose(states, expected, rtol=1e-10)


def test_a_speed_loop_is_a_pi_controller_that_the_filter_is_not_told_of() -> None:
    options: dict[str, Any] = {"precision": "float64", "observe": ("innovation_current",)}
    env = MonitorEnv(drive="speed_loop", loop_time_s=0.002, **options)
    seed = faulty_episode(env, FaultKind.WINDING_CONTACT)
    _, infos, states = rollout(env, seed)
    motor, rest, dt_s = PAPER_MOTOR, env.setup.rest, env.options.dt_s
    worse = apply_fault(motor, Fault(FaultKind.WINDING_CONTACT, infos[0]["severity"]))
    gain = 12.0 / steady_state(motor, 12.0, 0.0)[State.SPEED] / 0.002
    state, added, expected = rest, 0.0, []
    for k in range(len(states)):
        model = discretize(motor if k < infos[0]["onset_sample"] else worse, dt_s)
        before = state[State.SPEED]
        state = model.transition @ state + model.gain @ [12.0 + added, env.options.load_n_m]
        added -= gain * motor.mechanical_time_constant_s * (state[State.SPEED] - before)
        added -= gain * dt_s * (state[State.SPEED] - rest[State.SPEED])
        expected.append(state)
    np.testing.assert_allclose(states, expected, rtol=1e-9)
    dropped = rollout(MonitorEnv(**options), seed)[2][-1, State.SPEED] - rest[State.SPEED]
    assert abs(states[-1, State.SPEED] - rest[State.SPEED]) < 1e-3 * abs(dropped)


def test_a_declaration_can_be_asked_to_be_confirmed() -> None:
    env = MonitorEnv(confirm_steps=3, horizon_s=0.02, earliest_onset_s=0.0, mean_onset_s=0.0)

    def ended(*actions: int) -> bool:
        env.reset(seed=1)
        return [env.step(action)[2] for action in actions][-1]

    assert not ended(1, 1)
    assert ended(1, 1, 1)
    assert not ended(1, 1, 2, 1, 1)
    assert not ended(2, 2, 0, 2, 2)
    faulty_episode(env, FaultKind.BEARING)
    rewards = [env.step(0)[1] for _ in range(199)] + [env.step(1)[1]]
    assert rewards[-1] > 0.0  # in the last step the first word counts


def test_innovations_are_those_of_the_filter() -> None:
    env = MonitorEnv(observe=("measured_current", "innovation_current"))
    observations, _, _ = rollout(env, faulty_episode(env, FaultKind.BEARING))
    measured = observations[1:, 0].astype(np.float64) * 12.0 / 2.18
    belief = env.setup.belief
    gain, covariance = converged_gain(belief)
    predicted_covariance = schedule(belief, 20_000).covariance[-1]
    settled = KalmanFilter(
        belief.model,
        belief.observation,
        belief.process_covariance,
        belief.measurement_covariance,
        belief.initial_state,
        predicted_covariance,
    )
    result = run_filter(settled, measured[None], np.full(len(measured), 12.0), 0.0147)
    np.testing.assert_allclose(result.gain[-1], gain, rtol=1e-6)
    np.testing.assert_allclose(result.innovation_covariance[-1], covariance, rtol=1e-9)
    np.testing.assert_allclose(observations[1:, 1], result.whitened[:, 0], atol=1e-4)


def test_a_fault_shows_only_after_its_onset() -> None:
    env = MonitorEnv(observe=("innovation_current",))
    seed = faulty_episode(env, FaultKind.WINDING_CONTACT)
    observations, infos, _ = rollout(env, seed)
    onset = infos[0]["onset_sample"]
    innovations = observations[1:, 0]
    assert abs(innovations[:onset].mean()) < 4.0 / np.sqrt(onset)
    assert innovations[onset : onset + 10].mean() < -2.0


def outcome(env: MonitorEnv, seed: int, wait: int, action: int) -> float:
    """Reward of the last step: wait so many steps, then act."""
    env.reset(seed=seed)
    for _ in range(wait):
        env.step(WAIT)
    _, reward, terminated, _, _ = env.step(action)
    assert terminated
    assert type(reward) is float
    return reward


def test_rewards_say_what_the_options_say() -> None:
    env = MonitorEnv(correct_reward=2.0, false_alarm_cost=3.0, wrong_kind_cost=4.0, miss_cost=5.0)
    seed = faulty_episode(env, FaultKind.BEARING)
    onset = env.reset(seed=seed)[1]["onset_sample"]
    assert outcome(env, seed, onset, 1) == -3.0  # nothing of the fault has been observed yet
    assert outcome(env, seed, onset + 1, 1) == 2.0
    assert outcome(env, seed, onset + 1, 2) == -4.0
    assert outcome(env, seed, 1999, WAIT) == pytest.approx(-5.0 - 5.0 * 1e-4, rel=1e-6)
    healthy = next(s for s in range(100) if env.reset(seed=s)[1]["label"] == "healthy")
    assert outcome(env, healthy, 1999, WAIT) == 1.0


def test_delay_is_charged_from_the_onset() -> None:
    env = MonitorEnv(delay_cost_per_s=7.0, miss_cost=0.0)
    seed = faulty_episode(env, FaultKind.BEARING)
    onset = env.reset(seed=seed)[1]["onset_sample"]
    rewards = [env.step(WAIT)[1] for _ in range(env.options.n_steps)]
    assert rewards[:onset] == [0.0] * onset
    np.testing.assert_allclose(rewards[onset:], -7.0e-4, rtol=1e-6)


def test_noise_is_that_of_the_streams_and_a_start_that_of_the_simulation() -> None:
    """The environment, a data set and a recording that is simulated draw the same numbers for the same case."""
    env = MonitorEnv(
        start="standstill",
        load_torque_n_m=0.0,
        horizon_s=0.05,
        precision="float64",
        recipe="bench",
        observe=("measured_current",),
        mean_onset_s=1e9,
    )
    observed, _, states = rollout(env, seed=3, index=5)
    stall = 12.0 / PAPER_MOTOR.resistance_ohm
    noise = observed[1:, 0] * stall - states[:, 0]
    case = case_of(np.array([5]), np.array([0]))
    expected = normals(3, Stream.MEASUREMENT, case, 501)[0, 1:] * env.options.task.sensor.current_noise_a
    np.testing.assert_allclose(noise, expected, atol=2e-6)
    drawn = draw(env.options.task, 3, case)
    simulated = simulate_states(
        drawn.scenario.parameters, np.full((1, 500), drawn.scenario.supply.voltage_v), env.options.dt_s
    )
    np.testing.assert_allclose(states, simulated[0], rtol=1e-9, atol=1e-9)
