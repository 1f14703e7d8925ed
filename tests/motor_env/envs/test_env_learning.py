"""What makes a beginning possible for agents: confirmed declarations, a view of the posterior, the examples."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from motor_env.envs import (
    BeliefPolicy,
    PosteriorView,
    ProbeBelief,
    ProbeVectorEnv,
    run_episodes,
)

OPTIONS: dict[str, Any] = {"observe": ("innovation_current", "voltage"), "horizon_s": 0.1}
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
    envs = ProbeVectorEnv(count, autoreset_mode="SameStep", confirm_steps=confirm, **OPTIONS)
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


@pytest.mark.parametrize("task", ["monitor", "probe"])
def test_the_weights_that_are_kept_are_as_good_as_was_written_down(task: str) -> None:
    ppo = pytest.importorskip("torch") and example("ppo")
    envs = ppo.make(task, 300)
    learner = ppo.Learner(task, 0)
    learner.actor.load_state_dict(ppo.load_file(EXAMPLES / "ppo" / f"{task}-0.safetensors"))
    returns = run_episodes(envs, learner.policy(envs), 1).returns
    written = ppo.json.loads((EXAMPLES / "ppo" / f"{task}.json").read_text())["agents"]["0"]["return"][0]
    assert abs(returns.mean() - written) < 4.0 * returns.std() / 300**0.5


@pytest.mark.parametrize("task", ["drive", "maintain"])
def test_decisions_that_were_learned_are_as_good_as_was_written_down(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    ppo = example("decisions_ppo")
    chosen = ppo.TASKS[task]._replace(episodes=50)
    monkeypatch.setitem(ppo.TASKS, task, chosen)
    weights = ppo.load_file(EXAMPLES / "ppo" / f"{task}.safetensors")
    own = {name.partition(".")[2]: each for name, each in weights.items() if name.startswith("0.")}
    learner = ppo.Decider(chosen, 0)
    learner.actor.load_state_dict(own)
    written = ppo.json.loads((EXAMPLES / "ppo" / f"{task}.json").read_text())["agents"]["0"]["return"][0]
    returns = chosen.returns(learner.choose, 21)
    assert abs(returns.mean() - written) < 4.0 * returns.std() / 50**0.5


@pytest.mark.long
def test_ppo_learns_in_one_file() -> None:
    pytest.importorskip("torch")
    ppo = example("ppo")
    learner = ppo.Learner("monitor", 0)
    curve = ppo.train(learner, 150_000, points=3)
    assert curve[-1]["mean_return"] > 0.5
