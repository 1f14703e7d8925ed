"""What the residual is worth: agents of raw measurements play the same episodes, and PPO is Stable-Baselines3's."""

from typing import Any

import numpy as np
import pytest
import reference_scores
import residual_worth
import torch
from quick_ppo import QuickPPO, QuickRecurrentPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import PPO

from motor_env.envs.policies.evaluation import returns_of

N = 40


class Late:
    """Takes an action from some step on; to an environment it is a policy, to Stable-Baselines3 a model."""

    def __init__(self, action: int, begin: int) -> None:
        self.action, self.begin = action, begin

    def start(self, count: int) -> None:
        self.step = 0

    def act(self, observations: Any) -> Any:
        self.step += 1
        return np.full(len(observations), self.action if self.step > self.begin else 0)

    def predict(self, observations: Any, state: Any, begins: Any, deterministic: bool) -> Any:
        if begins.all():
            self.start(N)
        return self.act(observations), None


@pytest.mark.parametrize(("action", "begin"), [(0, 0), (1, 40), (2, 25), (2, 97)])
@pytest.mark.parametrize("name", residual_worth.IDS)
def test_held_out_episodes_of_raw_measurements_are_those_of_the_id(
    name: str, action: int, begin: int
) -> None:
    envs = residual_worth.environments(name, "stacked", N, held_out=True)
    found = residual_worth.judged(Late(action, begin), envs)
    own = reference_scores.vector(name, N)
    expected = returns_of(own, Late(action, begin), reference_scores.AGENT_SEED)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert expected.std() > 0.1


def test_a_raw_measurement_is_the_mean_of_a_step_and_an_episode_begins_with_a_step() -> None:
    """Of two monitors the second declares: what the first sees does not depend on that."""
    raw: Any = residual_worth.environments("Monitor-v0", "raw", 2).unwrapped.envs
    options = {"observe": residual_worth.RAW, "samples_per_step": 1}
    each = reference_scores.vector("Monitor-v0", 2, **options)
    seen, waits = [raw.reset(seed=3)[0]], np.zeros(2, dtype=np.int64)
    each.reset(seed=3)
    for over in (False, False, True, False):
        seen.append((step := raw.step([0, 1]))[0])
        assert step[2].tolist() == [False, over]
    means = [np.mean([each.step(waits)[0] for _ in range(raw.samples)], axis=0) for _ in range(4)]
    np.testing.assert_allclose([each[0] for each in seen[1:]], [mean[0] for mean in means], rtol=1e-5)
    np.testing.assert_allclose([each[1] for each in seen[1:3]], [mean[1] for mean in means[:2]], rtol=1e-5)
    assert seen[3][1, 2] == 0.0
    np.testing.assert_allclose(seen[4][1, 2], means[0][1, 2], rtol=1e-5)


def test_agents_of_raw_currents_learn_no_more_than_the_clock_on_a_probe() -> None:
    """As the page says: they are no better than a winding that is declared at a fixed time, 216 ms."""
    envs = reference_scores.vector("Probe-v0", reference_scores.AGENT_EPISODES)
    by_clock = returns_of(envs, Late(4, 54), reference_scores.AGENT_SEED).mean()
    assert f"{by_clock:+.2f}" == "-0.29"
    for variant in ("raw", "stacked", "recurrent"):
        kept = [one["return"] for one in residual_worth.kept("Probe-v0", variant)]
        assert max(kept) < by_clock + 0.05


def test_the_quick_update_is_that_of_stable_baselines() -> None:
    found = []
    for algorithm in (PPO, QuickPPO):
        envs = residual_worth.environments("Probe-v0", "raw", 8)
        envs.unwrapped.seed(0)
        model = algorithm("MlpPolicy", envs, n_steps=128, seed=0, device="cpu")
        before = torch.cat([each.detach().ravel() for each in model.policy.parameters()])
        model.learn(3 * 8 * 128)
        found.append(torch.cat([each.detach().ravel() for each in model.policy.parameters()]))
        assert (found[-1] - before).abs().max() > 0.01
    torch.testing.assert_close(found[0], found[1], rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("begins", [(0, 0), (1, 0), (1, 1)])
def test_quick_sequences_are_those_of_sb3_contrib(begins: tuple[int, int]) -> None:
    """An episode begins in the first step of a sequence, in its third, or in both."""
    torch.manual_seed(0)
    lstm, features, states = (
        torch.nn.LSTM(3, 5),
        torch.randn(8, 3),
        (torch.randn(1, 2, 5), torch.randn(1, 2, 5)),
    )
    starts = torch.zeros(2, 4)
    starts[0, 0], starts[1, 2] = begins
    given = (features, states, starts.ravel(), lstm)
    quick = QuickRecurrentPolicy._process_sequence(*given)
    plain = RecurrentActorCriticPolicy._process_sequence(*given)
    torch.testing.assert_close(quick, plain)
    assert quick[0].shape == (8, 5)
