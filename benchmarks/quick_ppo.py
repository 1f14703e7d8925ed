"""PPO of Stable-Baselines3 that learns the same numbers, to rounding, in a quarter of the time.

A minibatch of 64 in networks of 64 is a matter of microseconds, for which torch takes more than a millisecond.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import PPO

Array = NDArray[np.float32]
BETAS, EPSILON = (0.9, 0.999), 1e-5  # of Adam, as Stable-Baselines3 has it


class QuickPPO(PPO):  # type: ignore[misc]  # Stable-Baselines3 says no types
    """PPO with the default networks, the default losses and discrete actions."""

    def _setup_model(self) -> None:
        super()._setup_model()
        net: Any = self.policy
        actor, critic = net.mlp_extractor.policy_net, net.mlp_extractor.value_net
        layers = ((actor[0], actor[2], net.action_net), (critic[0], critic[2], net.value_net))
        size = sum(each.numel() for each in net.parameters())
        self._flat, self._gradient, self._first, self._second = np.zeros((4, size), dtype=np.float32)
        self._time, at = 0, 0
        self._layers: list[list[tuple[Array, ...]]] = []
        for one in layers:
            self._layers.append([])
            for layer in one:
                views: list[Array] = []
                for parameter in (layer.weight, layer.bias):
                    part, shape = slice(at, at + parameter.numel()), tuple(parameter.shape)
                    at = part.stop
                    self._flat[part] = parameter.detach().numpy().ravel()
                    parameter.data = torch.from_numpy(self._flat[part].reshape(shape))
                    views += [self._flat[part].reshape(shape), self._gradient[part].reshape(shape)]
                self._layers[-1].append(tuple(views))

    def _descend(self, which: int, hidden: list[Array], slope: Array) -> None:
        """The gradient of a network, from the slope of the loss in its outputs."""
        for k in (2, 1, 0):
            weight, of_weight, _, of_bias = self._layers[which][k]
            np.matmul(slope.T, hidden[k], out=of_weight)
            slope.sum(axis=0, out=of_bias)
            if k > 0:
                slope = (slope @ weight) * (1.0 - hidden[k] * hidden[k])

    def _outputs(self, which: int, seen: Array) -> list[Array]:
        """Inputs of each layer, and the outputs."""
        hidden = [seen]
        for k, (weight, _, bias, _) in enumerate(self._layers[which]):
            hidden.append(hidden[-1] @ weight.T + bias)
            if k < 2:
                np.tanh(hidden[-1], out=hidden[-1])
        return hidden

    def train(self) -> None:
        """Learn from one rollout."""
        self._update_learning_rate(self.policy.optimizer)
        rate, clip = self.lr_schedule(self._current_progress_remaining), self.clip_range(1.0)
        b = self.rollout_buffer
        names = ("observations", "actions", "log_probs", "advantages", "returns")
        seen, actions, logs, gained, returns = (b.swap_and_flatten(getattr(b, name)) for name in names)
        chosen = actions[:, 0].astype(np.int64)
        for _ in range(self.n_epochs):
            order = np.random.permutation(len(seen))  # noqa: NPY002  # the generator of Stable-Baselines3
            for begin in range(0, len(order), self.batch_size):
                rows = order[begin : begin + self.batch_size]
                self._minibatch(
                    seen[rows], chosen[rows], logs[rows, 0], gained[rows, 0], returns[rows, 0], clip
                )
                self._adam(rate)
        self._n_updates += self.n_epochs

    def _minibatch(
        self, seen: Array, actions: NDArray[np.int64], old: Array, gained: Array, returns: Array, clip: float
    ) -> None:
        count, rows = len(seen), np.arange(len(seen))
        hidden = self._outputs(0, seen)
        logs = hidden[3] - hidden[3].max(axis=1, keepdims=True)
        logs -= np.log(np.exp(logs).sum(axis=1, keepdims=True))
        gained = (gained - gained.mean()) / (gained.std(ddof=1) + np.float32(1e-8))
        ratio = np.exp(logs[rows, actions] - old)
        worth = gained * ratio
        slope = np.where(worth <= gained * ratio.clip(1.0 - clip, 1.0 + clip), -worth / count, 0.0)
        slopes = -np.exp(logs) * slope[:, None]
        slopes[rows, actions] += slope
        self._descend(0, hidden, slopes.astype(np.float32))
        hidden = self._outputs(1, seen)
        self._descend(1, hidden, (hidden[3] - returns[:, None]) * np.float32(2.0 * self.vf_coef / count))

    def _adam(self, rate: float) -> None:
        """One step of Adam (Kingma & Ba 2015) by the gradient, clipped at its norm."""
        g, m, v, self._time = self._gradient, self._first, self._second, self._time + 1
        g *= min(1.0, self.max_grad_norm / (float(np.linalg.norm(g)) + 1e-6))
        m += (g - m) * np.float32(1.0 - BETAS[0])
        v += (g * g - v) * np.float32(1.0 - BETAS[1])
        scale = np.sqrt(v) * np.float32((1.0 - BETAS[1] ** self._time) ** -0.5) + np.float32(EPSILON)
        self._flat -= np.float32(rate / (1.0 - BETAS[0] ** self._time)) * m / scale


class QuickRecurrentPolicy(RecurrentActorCriticPolicy):
    """The policy of RecurrentPPO. Sequences that begin an episode at most in their first step run as one."""

    @staticmethod
    def _process_sequence(
        features: torch.Tensor,
        lstm_states: tuple[torch.Tensor, torch.Tensor],
        episode_starts: torch.Tensor,
        lstm: torch.nn.LSTM,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        starts = episode_starts.reshape(lstm_states[0].shape[1], -1)
        if not starts[:, 1:].any():
            goes_on = (1.0 - starts[:, 0]).view(1, -1, 1)
            lstm_states = goes_on * lstm_states[0], goes_on * lstm_states[1]
            episode_starts = torch.zeros_like(episode_starts)
        process = super(QuickRecurrentPolicy, QuickRecurrentPolicy)._process_sequence
        return process(features, lstm_states, episode_starts, lstm)
