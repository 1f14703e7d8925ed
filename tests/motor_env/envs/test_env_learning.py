"""What makes a beginning possible for agents: confirmed declarations, a view of the posterior, the examples."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import reference_scores
from gymnasium.spaces import Box

from motor_env.envs import (
    BeliefPolicy,
    MonitorVectorEnv,
    PosteriorView,
    ProbeBelief,
    ProbeVectorEnv,
    returns_of,
    run_episodes,
)

OPTIONS: dict[str, Any] = {
    "observe": ("innovation_current", "voltage"),
    "horizon_s": 0.1,
    **gym.spec("motor_env/ProbeInstant-v0").kwargs,
}
EXAMPLES = Path(__file__).parents[3] / "examples"


def example(name: str) -> Any:
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("confirm", [1, 2])
def test_a_posterior_view_pays_the_true_reward_on_average(confirm: int) -> None:
    count = 2000
    envs = ProbeVectorEnv(count, autoreset_mode="SameStep", **{**OPTIONS, "confirm_steps": confirm})
    view, rng = PosteriorView(envs), np.random.default_rng(0)
    seen, _ = view.reset(seed=5)
    assert view.single_observation_space.contains(seen[0])
    for space in (view.observation_space, view.single_observation_space):
        assert isinstance(space, Box)
        assert (set(space.low.ravel().tolist()), set(space.high.ravel().tolist())) == ({-4.0}, {4.0})
    told, true = np.zeros((2, count))
    step, paid = envs.step, np.zeros(count)

    def watched(actions: Any) -> Any:
        answer = step(actions)
        paid[:] = answer[1]
        return answer

    envs.step = watched  # type: ignore[method-assign]
    alive = np.ones(count, dtype=bool)
    for _ in range(envs.options.n_steps):
        sure = view.belief.kinds.max(axis=1) > 0.3
        actions = np.where(sure, 3 + view.belief.kinds.argmax(axis=1), rng.integers(0, 3, count))
        _, reward, over, _, _ = view.step(actions)
        told, true = told + alive * reward, true + alive * paid
        alive &= ~over
    assert not alive.any()
    difference = told - true
    assert difference.std() > 0.1
    assert abs(difference.mean()) < 4.0 * difference.std() / count**0.5


def test_a_view_needs_episodes_that_follow_at_once() -> None:
    with pytest.raises(ValueError, match="autoreset_mode of the vector must be SameStep, got NextStep"):
        PosteriorView(ProbeVectorEnv(2, **OPTIONS))


def test_a_view_forgets_at_a_reset() -> None:
    view = PosteriorView(ProbeVectorEnv(8, autoreset_mode="SameStep", **OPTIONS))
    first, _ = view.reset(seed=3)
    for _ in range(10):
        seen = view.step(np.ones(8, dtype=np.int64))[0]
    assert not np.array_equal(seen, first)
    np.testing.assert_array_equal(view.reset(seed=3)[0], first)


def test_a_policy_of_summaries_sees_what_the_view_shows() -> None:
    envs = ProbeVectorEnv(8, **OPTIONS)
    seen: list[Any] = []

    def wait(summary: Any) -> Any:
        seen.append(summary)
        return np.zeros(len(summary))

    policy = BeliefPolicy(ProbeBelief(envs.setup), wait)
    for _ in range(2):  # whatever it played before
        seen.clear()
        run_episodes(envs, policy, seed=3)
    view = PosteriorView(ProbeVectorEnv(8, autoreset_mode="SameStep", **OPTIONS))
    np.testing.assert_array_equal(seen[0], view.reset(seed=3)[0])
    for shown in seen[1:]:
        np.testing.assert_array_equal(shown, view.step(np.zeros(8, dtype=np.int64))[0])


@pytest.mark.parametrize("name", [path.stem for path in (EXAMPLES / "agents").glob("*.npz")])
def test_the_agent_that_is_kept_is_better_than_one_action_always(name: str, tmp_path: Path) -> None:
    ppo = example("ppo")
    agent = ppo.Agent(dict(np.load(EXAMPLES / "agents" / f"{name}.npz")))
    told = ppo.play(name, agent, tmp_path / "screen.png")
    assert (tmp_path / "screen.png").stat().st_size > 1000
    found = float(re.findall(r"mean return (\S+)", told)[0])
    assert found > reference_scores.kept(name)["trivial"]["return"] + 0.5


@pytest.mark.long
def test_ppo_with_its_defaults_learns() -> None:
    pytest.importorskip("stable_baselines3")
    ppo = example("ppo")
    agent = ppo.Agent(ppo.train("Monitor-v0", 50_000, 0))
    assert returns_of(MonitorVectorEnv(300), agent, 1).mean() > 0.5
