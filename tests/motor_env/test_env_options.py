"""Options: every environment that can be made can be stepped to its end, or refuses with one sentence."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics
from hypothesis import given, settings
from hypothesis import strategies as st

from motor_env.envs.monitor import MonitorEnv, MonitorVectorEnv
from motor_env.envs.options import MonitorOptions
from motor_env.envs.probe import ProbeContinuousEnv, ProbeEnv, ProbeVectorEnv

NUMBERS = st.floats(-1.0, 2.0) | st.sampled_from([0.0, 1e-3, 0.01, 0.02, float("nan"), float("inf"), 1e9])
MONITOR = {
    "recipe": st.sampled_from(["easy", "medium", "hard", "paper", "bench", "small", "no such recipe"]),
    "horizon_s": st.sampled_from([0.0, 1e-4, 0.01, 0.0203, -1.0, float("nan")]) | st.floats(0.0, 0.03),
    "samples_per_step": st.integers(-1, 25),
    "start": st.sampled_from(["running", "standstill", "flying"]),
    "load_torque_n_m": NUMBERS,
    "earliest_onset_s": NUMBERS,
    "mean_onset_s": NUMBERS,
    "growth_s": st.sampled_from([0.0, 0.001, 0.01, 3.0, -1.0]),
    "growth_levels": st.integers(-1, 40),
    "belief_noise_std": st.tuples(NUMBERS, NUMBERS),
    "delay_cost_per_s": NUMBERS,
    "miss_cost": NUMBERS,
    "precision": st.sampled_from(["float32", "float32", "float16"]),
    "observe": st.sampled_from(
        [(), ("time",), ("evidence_bearing", "excess"), ("label",), ("measured_speed",)]
    ),
}
PROBE = {
    **MONITOR,
    "offsets_v": st.lists(NUMBERS, max_size=4).map(tuple),
    "max_offset_v": NUMBERS,
    "probe_cost_per_v2_s": NUMBERS,
}


def some_of(options: dict[str, st.SearchStrategy[Any]]) -> st.SearchStrategy[dict[str, Any]]:
    """Any of the options, few at a time, so that some of the sets are good."""
    names = st.lists(st.sampled_from(sorted(options)), max_size=3, unique=True)
    return names.flatmap(lambda chosen: st.fixed_dictionaries({name: options[name] for name in chosen}))


def runs_or_refuses(make: Any, options: dict[str, Any]) -> None:
    """The property."""
    try:
        env = make(**options)
    except ValueError as refusal:
        sentence = str(refusal)
        assert "\n" not in sentence
        assert 10 < len(sentence) < 400
        return
    observation, _ = env.reset(seed=3)
    wait = env.action_space.low * 0.0 if isinstance(env.action_space, gym.spaces.Box) else 0
    for step in range(min(env.options.n_steps, 400)):
        assert env.observation_space.contains(observation), observation
        observation, reward, over, _, _ = env.step(wait)
        assert np.isfinite(reward)
        assert over == (step == env.options.n_steps - 1)
    assert env.observation_space.contains(observation)


@settings(max_examples=120)
@given(some_of(MONITOR))
def test_monitor_runs_or_refuses(options: dict[str, Any]) -> None:
    runs_or_refuses(MonitorEnv, options)


@settings(max_examples=120)
@given(some_of(PROBE), st.sampled_from([ProbeEnv, ProbeContinuousEnv]))
def test_probe_runs_or_refuses(options: dict[str, Any], make: Any) -> None:
    runs_or_refuses(make, options)


def test_an_unknown_option_is_named_and_the_known_ones_listed() -> None:
    with pytest.raises(ValueError, match="no option 'horizn_s'; there are recipe, horizon_s"):
        MonitorEnv(horizn_s=1.0)


@pytest.mark.parametrize("make", [MonitorEnv, ProbeEnv, ProbeContinuousEnv, MonitorVectorEnv, ProbeVectorEnv])
def test_environments_and_options_survive_pickling(make: Any) -> None:
    env = make()
    env.reset(seed=4)
    copy = pickle.loads(pickle.dumps(env))  # noqa: S301  # our own bytes
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = np.clip(env.action_space.sample(), 0, 0) if rng.random() < 0.5 else env.action_space.sample()
        mine, theirs = env.step(action), copy.step(action)
        np.testing.assert_array_equal(mine[0], theirs[0])
        np.testing.assert_array_equal(mine[1], theirs[1])
        if np.ndim(mine[2]) == 0 and mine[2]:
            break
    assert pickle.loads(pickle.dumps(MonitorOptions())) == MonitorOptions()  # noqa: S301


def test_wrappers_and_frames() -> None:
    env = RecordEpisodeStatistics(gym.make("motor_env/Probe-v0", render_mode="rgb_array", horizon_s=0.02))
    env.reset(seed=0)
    over = False
    while not over:
        _, _, over, _, info = env.step(1)
    assert info["episode"]["l"] == 10
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    assert frame.shape == (560, 800, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 20  # traces, text, grid: not one colour


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_thousand_million_random_steps() -> None:
    import resource

    envs = MonitorVectorEnv(8192, recipe="hard", growth_s=0.01)
    rng = np.random.default_rng(0)
    envs.reset(seed=0)
    lows, highs = envs.single_observation_space.low, envs.single_observation_space.high  # type: ignore[attr-defined]
    memory = []
    for step in range(10**9 // 8192 + 1):
        if step % 500 == 0:
            declared = rng.integers(1, envs.single_action_space.n, (500, 8192))  # type: ignore[attr-defined]
            actions = np.where(rng.random((500, 8192)) < 0.999, 0, declared)
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        observations, rewards, _, _, _ = envs.step(actions[step % 500])
        assert (observations >= lows).all() and (observations <= highs).all()  # noqa: PT018  # also without NaN
        assert np.isfinite(rewards).all()
    assert memory[-1] < 1.02 * memory[len(memory) // 4]
