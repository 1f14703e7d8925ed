"""Learn from recorded episodes alone: behaviour cloning, weighted by a critic (needs torch and the extra minari).

motor-env offline Monitor-v0 --behaviour mixed --out out/minari
python examples/offline.py motor_env/Monitor/mixed-v0 --folder out/minari

The critic learns what an observation is worth under whoever acted (the mean return from there on). An action counts by
exp(advantage / scale), as in advantage-weighted regression (Peng et al. 2019), so that what turned out well is
imitated. The environment is asked only for the score in the end. A minute of one core.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

ROUNDS, ROWS, SCALE, MOST = 20, 1024, 0.5, 3.0


def network(n_inputs: int, n_outputs: int) -> nn.Sequential:
    """Two hidden layers of 64 on inputs that are brought to one scale."""
    return nn.Sequential(
        nn.BatchNorm1d(n_inputs, momentum=None),
        *(nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_outputs)),
    )


def fit(model: nn.Module, seen: Tensor, loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    """Minimise the mean of a loss, a function of the model's outputs and the numbers of the rows."""
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    for _ in range(ROUNDS):
        for rows in torch.randperm(len(seen)).split(ROWS):
            optimizer.zero_grad()
            loss(model(seen[rows]), rows).mean().backward()  # type: ignore[no-untyped-call]  # torch's
            optimizer.step()
    model.eval()


def learn(data: Any, seed: int) -> nn.Module:
    """A network from observations to logits of the actions."""
    torch.manual_seed(seed)
    episodes = list(data.iterate_episodes())
    seen = torch.from_numpy(np.concatenate([each.observations[:-1] for each in episodes]))
    done = torch.from_numpy(np.concatenate([each.actions for each in episodes]).astype(np.int64))
    returns = np.concatenate([np.cumsum(each.rewards[::-1])[::-1] for each in episodes])
    gained = torch.from_numpy(returns / returns.std()).float()
    critic, actor = network(seen.shape[1], 1), network(seen.shape[1], int(data.action_space.n))
    fit(critic, seen, lambda worth, rows: (worth[:, 0] - gained[rows]).square())
    with torch.no_grad():
        advantage = gained - critic(seen)[:, 0]
        weights = (advantage / (SCALE * advantage.std())).clamp(max=MOST).exp()

    def imitation(logits: Tensor, rows: Tensor) -> Tensor:
        return weights[rows] * nn.functional.cross_entropy(logits, done[rows], reduction="none")

    fit(actor, seen, imitation)
    return actor


@torch.no_grad()
def returns_of(actor: nn.Module, env: gym.Env[Any, Any], episodes: int) -> np.ndarray[Any, Any]:
    """Returns of the likeliest action, in streams that no data set has."""
    assert env.spec is not None  # noqa: S101  # a data set keeps it
    envs = gym.make_vec(env.spec, num_envs=episodes)
    seen, _ = envs.reset(seed=2**63 + 1)
    total, running = np.zeros(episodes), np.ones(episodes, dtype=bool)
    while running.any():
        actions = actor(torch.from_numpy(np.array(seen))).argmax(1).numpy()
        seen, rewards, over, _, _ = envs.step(actions)
        total += rewards * running
        running &= ~over
    return total


def main() -> None:
    """Learn, score, print."""
    parser = argparse.ArgumentParser(description="Learn from a Minari data set, and score what was learned.")
    parser.add_argument("data", help="name of the data set")
    parser.add_argument("--folder", type=Path, default=Path("out/minari"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of the training")
    parser.add_argument("--episodes", type=int, default=2000, help="of the score")
    given = parser.parse_args()
    os.environ["MINARI_DATASETS_PATH"] = str(given.folder)
    import minari

    torch.set_num_threads(1)
    data = minari.load_dataset(given.data)
    behaved = np.array([each.rewards.sum() for each in data.iterate_episodes()])
    print(f"recorded: {behaved.mean():+.3f} ± {1.96 * behaved.std() / len(behaved) ** 0.5:.3f}")
    for seed in given.seeds:
        scored = returns_of(learn(data, seed), data.recover_environment(), given.episodes)
        share = float(minari.get_normalized_score(data, scored).mean())
        half = 1.96 * scored.std() / len(scored) ** 0.5
        way = f"{share:.3f} of the way from random to the best"
        print(f"seed {seed}: {scored.mean():+.3f} ± {half:.3f}, {way}")


if __name__ == "__main__":
    main()
