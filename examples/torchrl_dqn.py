"""DQN by the parts of TorchRL on Probe-v0 (needs torchrl).

python examples/torchrl_dqn.py --steps 10000
"""

import argparse
from typing import Any

import gymnasium as gym
import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate

from motor_env.envs import Policy, ProbeVectorEnv, run_episodes
from motor_env.envs.policies.evaluation import interval
from motor_env.envs.policies.rule_policies import Actions, Observations

BATCH, ROWS = 128, 64


class Greedy(Policy):
    """The action that the network values most."""

    def __init__(self, values: Any) -> None:
        self._values = values

    @torch.no_grad()
    def act(self, observations: Observations) -> Actions:
        """One action for each sub-environment."""
        return self._values(torch.from_numpy(observations.copy())).argmax(1).numpy()


def main() -> None:
    """Train and score."""
    parser = argparse.ArgumentParser(description="Train a DQN of TorchRL on Probe-v0.")
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    env = GymWrapper(gym.make("motor_env:motor_env/Probe-v0"))
    values = MLP(env.observation_spec["observation"].shape[0], env.action_spec.shape[-1], num_cells=[64, 64])
    actor = QValueActor(values, spec=env.action_spec, in_keys=["observation"])
    explores = EGreedyModule(
        env.action_spec, eps_init=1.0, eps_end=0.05, annealing_num_steps=given.steps // 10
    )
    steps = Collector(
        env, TensorDictSequential(actor, explores), frames_per_batch=ROWS, total_frames=given.steps
    )
    loss, memory = (
        DQNLoss(actor, delay_value=True),
        ReplayBuffer(storage=LazyTensorStorage(50_000), batch_size=BATCH),
    )
    loss.make_value_estimator(gamma=0.99)
    target, optimizer = (
        HardUpdate(loss, value_network_update_interval=500),
        torch.optim.Adam(loss.parameters(), 3e-4),
    )
    for data in steps:
        memory.extend(data)
        explores.step(data.numel())
        for _ in range(ROWS // 4):
            optimizer.zero_grad()
            loss(memory.sample())["loss"].backward()
            optimizer.step()
            target.step()
    steps.shutdown()
    mean, half = interval(run_episodes(ProbeVectorEnv(1000), Greedy(values), 1).returns)
    print(f"DQN after {given.steps} steps: {mean:+.3f} ± {half:.3f}")


if __name__ == "__main__":
    main()
