"""Networks of others on the starts of a task, in .venv-bench: NPE of sbi, and a convolutional network in torch.

`python network_peers.py CASES.npz ANSWERS.npz npe|convolution CPU_SECONDS` trains one of them, tuning included, for so
many seconds of CPU time, and judges the test starts. Neither is told anything of motors but the training starts.

Every network is trained the same way: AdamW, a learning rate that rises for a tenth of the time and then falls along a
cosine, and a tenth of the starts held back. Of the candidates, each trained for 7 % of the time, the one with the
smallest cross-entropy on the starts held back has the rest. The best on them of all states is kept.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.neural_nets.embedding_nets import CNNEmbedding, FCEmbedding  # type: ignore[import-not-found]  # in .venv-bench
from sbi.neural_nets.net_builders.mixed_nets import build_mnpe  # type: ignore[import-not-found]  # as above
from torch import nn

SEED, BATCH, HELD_BACK, MOST_HELD_BACK = 0, 256, 0.1, 5_000
SHARE_OF_A_CANDIDATE, WARM_UP, FLOOR = 0.07, 0.1, 1e-3
Tensors = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Starts, class of each, and what else is to be estimated of it."""


class Network(nn.Module):
    """What a candidate must do: a loss to learn by, and the logarithm of the probability of each class."""

    rate = 1e-3

    def loss(self, x: torch.Tensor, label: torch.Tensor, theta: torch.Tensor) -> torch.Tensor:
        """Mean loss of a batch."""
        return nn.functional.cross_entropy(self(x), label)


class Npe(Network):
    """Mixed neural posterior estimation of sbi: the class by a categorical net, resistance and friction by a flow."""

    def __init__(self, embedding: nn.Module, data: Tensors, n_classes: int) -> None:
        super().__init__()
        x, label, theta = (each[:20_000] for each in data)
        self.n_classes = n_classes
        self.estimator = build_mnpe(
            torch.cat([theta, label[:, None].float()], dim=1),
            x,
            flow_model="maf",
            num_categories_per_variable=torch.tensor([n_classes]),
            embedding_net=embedding,
        )

    def loss(self, x: torch.Tensor, label: torch.Tensor, theta: torch.Tensor) -> torch.Tensor:
        """Mean negative log density of the class and of what else is to be estimated."""
        loss: torch.Tensor = self.estimator.loss(torch.cat([theta, label[:, None].float()], dim=1), x).mean()
        return loss

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Logarithm of the probability of each class, shape (n_cases, n_classes)."""
        each = torch.arange(self.n_classes).float()[:, None, None].expand(-1, len(x), 1)
        condition = x[None].expand(self.n_classes, *x.shape)
        logs: torch.Tensor = self.estimator.discrete_net.log_prob(each, condition).T
        return logs


def _layer(n_in: int, n_out: int, kernel: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(
        nn.Conv1d(n_in, n_out, kernel, stride=stride, padding=kernel // 2, bias=False), nn.BatchNorm1d(n_out)
    )


class _Block(nn.Module):
    """Two convolutions and a shortcut (He et al. 2016; for time series Wang, Yan & Oates 2017)."""

    def __init__(self, n_in: int, n_out: int, kernel: int) -> None:
        super().__init__()
        self.first, self.second = _layer(n_in, n_out, kernel, 2), _layer(n_out, n_out, kernel)
        self.shortcut = _layer(n_in, n_out, 1, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.second(torch.relu(self.first(x))) + self.shortcut(x))


class Convolution(Network):
    """A residual network on the start, each sample standardised; at its end the mean over time, or all of it."""

    rate = 3e-3
    center: torch.Tensor
    scale: torch.Tensor

    def __init__(
        self, data: Tensors, n_classes: int, *, width: int, stem: int, whole: bool, noise: float
    ) -> None:
        super().__init__()
        x = data[0]
        self.noise = noise
        self.register_buffer("center", x.mean(dim=0))
        self.register_buffer("scale", x.std(dim=0).clamp_min(1e-9))
        body = nn.Sequential(
            _layer(x.shape[1], width, 2 * stem + 1, stem),
            nn.ReLU(),
            _Block(width, width, 5),
            _Block(width, 2 * width, 5),
            _Block(2 * width, 2 * width, 5),
            *([] if whole else [nn.AdaptiveAvgPool1d(1)]),
            nn.Flatten(),
        )
        n_last = body(torch.zeros(2, *x.shape[1:])).shape[1]
        head = [nn.Linear(n_last, 64), nn.ReLU(), nn.Linear(64, n_classes)]
        self.network = nn.Sequential(body, *(head if whole else [nn.Linear(n_last, n_classes)]))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Logits, shape (n_cases, n_classes)."""
        standard = (x - self.center) / self.scale
        if self.training and self.noise:
            standard = standard + self.noise * torch.randn_like(standard)
        logits: torch.Tensor = self.network(standard)
        return logits


Maker = Callable[[Tensors, int], Network]


def candidates(method: str, shape: tuple[int, int]) -> dict[str, Maker]:
    """Untrained networks by what they are, for starts of so many channels and samples."""
    n_channels, n_samples = shape
    if method == "npe":
        layers: dict[str, dict[str, Any]] = {
            "CNNEmbedding as it is": {"output_dim": 20},
            "CNNEmbedding, 4 layers": {
                "num_conv_layers": 4, "out_channels_per_layer": [16, 32, 32, 64], "kernel_size": 7,
                "pool_kernel_size": 3, "num_linear_units": 128, "output_dim": 32,
            },
        }  # fmt: skip
        made: dict[str, Maker] = {
            name: lambda data, n, options=options: Npe(  # type: ignore[misc]  # a default binds the loop's value
                CNNEmbedding((n_samples,), in_channels=n_channels, **options), data, n
            )
            for name, options in layers.items()
        }

        def dense(data: Tensors, n: int) -> Network:
            net = FCEmbedding(n_channels * n_samples, output_dim=32, num_layers=3, num_hiddens=128)
            return Npe(nn.Sequential(nn.Flatten(), net), data, n)

        return made | {"FCEmbedding": dense}
    options = {
        "mean over time": {"width": 32, "stem": 10, "whole": False, "noise": 0.0},
        "all times": {"width": 16, "stem": 10, "whole": True, "noise": 0.0},
        "all times, wide": {"width": 48, "stem": 5, "whole": True, "noise": 0.0},
        "all times, noise added": {"width": 16, "stem": 10, "whole": True, "noise": 0.5},
    }
    return {
        name: lambda data, n, own=own: Convolution(data, n, **own)  # type: ignore[misc]  # as above
        for name, own in options.items()
    }


def answers(network: Network, x: torch.Tensor) -> torch.Tensor:
    """Logarithms of the probabilities, shape (n_cases, n_classes)."""
    network.eval()
    with torch.inference_mode():
        return torch.cat([network(part).log_softmax(dim=1) for part in torch.split(x, 512)])


def learned(network: Network, data: Tensors, held: Tensors, seconds: float) -> tuple[Network, float, int]:
    """The network after so many seconds of CPU time: its best state, its cross-entropy, the starts it was shown."""
    began = time.process_time()
    optimiser = torch.optim.AdamW(network.parameters(), lr=network.rate, weight_decay=1e-2)
    best, state, shown, looked = np.inf, network.state_dict(), 0, began
    share = 0.0
    while share < 1.0:
        network.train()
        for rows in torch.split(torch.randperm(len(data[0])), BATCH):
            share = (time.process_time() - began) / seconds
            if share >= 1.0:
                break
            if len(rows) < 2:
                continue  # no variance to normalise by
            falling = 0.5 * (1.0 + np.cos(np.pi * (share - WARM_UP) / (1.0 - WARM_UP)))
            optimiser.param_groups[0]["lr"] = network.rate * max(
                FLOOR, share / WARM_UP if share < WARM_UP else falling
            )
            optimiser.zero_grad()
            network.loss(*(each[rows] for each in data)).backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            shown += len(rows)
        now = time.process_time()
        if now - looked > 0.02 * seconds or share >= 1.0:  # looking costs time too
            looked = now
            loss = float(nn.functional.nll_loss(answers(network, held[0]), held[1]))
            if loss < best:
                best, state = loss, copy.deepcopy(network.state_dict())
    network.load_state_dict(state)
    return network, best, shown


def main(source: Path, target: Path, method: str, seconds: float) -> None:
    """Tune, train, judge, and write the answers whole or not at all."""
    torch.set_num_threads(1)
    torch.manual_seed(SEED)  # the seed of this script, a process of its own
    with np.load(source) as arrays:
        cases = dict(arrays)
    x, label = torch.from_numpy(cases["train_X"]), torch.from_numpy(cases["train_class_index"]).long()
    theta = torch.from_numpy(cases["theta"]).float()
    n_held = min(MOST_HELD_BACK, round(HELD_BACK * len(x)))
    data, held = (x[n_held:], label[n_held:], theta[n_held:]), (x[:n_held], label[:n_held], theta[:n_held])
    n_classes = int(cases["n_classes"])
    began, tried, best = time.process_time(), {}, np.inf
    makers = candidates(method, (x.shape[1], x.shape[2]))
    for name, make in makers.items():
        one, loss, shown = learned(make(data, n_classes), data, held, SHARE_OF_A_CANDIDATE * seconds)
        tried[name] = round(loss, 4)
        print(
            f"{method}: {name}: {loss:.4f} on the starts held back, {shown} shown",
            file=sys.stderr,
            flush=True,
        )
        if loss < best:
            best, chosen, network = loss, name, one
    rest = seconds - (time.process_time() - began)
    longer, loss, shown = learned(makers[chosen](data, n_classes), data, held, rest)
    if loss < best:
        best, network = loss, longer
    took = time.process_time() - began
    said = answers(network, torch.from_numpy(cases["test_X"])).exp().numpy()
    hits = float((said.argmax(axis=1) == cases["test_class_index"]).mean())
    facts = {
        "candidates": tried, "chosen": chosen, "held_back": round(best, 4), "starts_shown": shown,
        "cpu_s": round(took), "n_train": len(x),
    }  # fmt: skip
    print(f"{method}: accuracy {hits:.4f}, {facts}", file=sys.stderr, flush=True)
    np.savez(target, facts=np.array(json.dumps(facts)), probabilities=said.astype(np.float32))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], float(sys.argv[4]))
