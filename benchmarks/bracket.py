"""Between which two figures the best return on a monitor lies whose motor is known (needs torch).

python benchmarks/bracket.py --recipe small        # a minute or two of one core

Above: an agent that knows the future of its own posterior, but pays for it. The price is a martingale, which costs an
agent without such knowledge nothing on average, so that the mean of the best moment bounds every policy (Rogers 2002;
Haugh & Kogan 2004; Desai, Farias & Moallemi 2012). The martingale is the sum of the surprises of the posterior, each
times a factor that a small network chooses beforehand; it is fitted to other episodes than those that give the bound.

Below: one threshold on what a declaration is worth. Its return has the same martingale taken off, which changes nothing
on average and takes most of the luck out.
"""

import argparse
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from motor_env.envs import BayesPolicy, MonitorVectorEnv
from motor_env.envs.baselines.belief import worth
from motor_env.envs.baselines.evaluation import interval
from motor_env.envs.baselines.hypotheses import kind_matrix, known_faults
from motor_env.motor.parameters import FloatArray

BLOCK = 5
LAGS = (0, 20, 50)
THRESHOLDS = 1.0 - np.geomspace(0.01, 0.4, 15)


class Paths(NamedTuple):
    """Posteriors of many episodes in which nothing is declared.

    Attributes:
        stop: what an episode returns in expectation if it ends after so many samples, shape (count, n_samples + 1).
        surprise: of the probability of each class with each sample, shape (count, n_samples, n_classes).
        seen: what the network sees before each block of samples, shape (count, n_blocks, n_features).
        worth: of a declaration after so many samples, without the price of delay, shape as `stop`; before the last step
            infinite where it is more than that of silence, else minus infinity.
    """

    stop: FloatArray
    surprise: FloatArray
    seen: FloatArray
    worth: FloatArray


def collect(recipe: str, count: int, seed: int) -> Paths:
    """Run that many episodes beside the exact posterior."""
    envs = MonitorVectorEnv(count, recipe=recipe, observe=("measured_current",))
    options, policy, faults = envs.options, BayesPolicy(envs.setup, 0.0), known_faults(envs.setup)
    n, prior, kind_of = (
        options.n_samples,
        options.task.class_probabilities[faults],
        kind_matrix(envs.setup, faults),
    )
    classes, quiet = np.empty((n + 1, count, len(faults))), np.empty((n + 1, count))
    observations, _ = envs.reset(seed=seed)
    policy.start(count)
    for k in range(n + 1):
        policy.judge(observations)
        classes[k], quiet[k] = policy.classes, policy.quiet
        if k < n:
            observations = envs.step(np.zeros(count, dtype=np.int64))[0]
    since = np.maximum(np.arange(n) - round(options.earliest_onset_s / options.dt_s), -1)
    hazard = 1.0 / (1.0 + options.mean_onset_s / options.dt_s)
    unborn = (1.0 - hazard) ** np.maximum(since, 0)
    begins = np.where(since >= 0, hazard, 0.0) * unborn / (1.0 - prior.sum() * (1.0 - unborn))
    expected = classes[:-1] + (begins[:, None] * quiet[:-1])[..., None] * prior
    declared, silent = worth(options, quiet.ravel(), classes.reshape(-1, len(faults)) @ kind_of)
    last, silence = declared.reshape(quiet.shape), silent.reshape(quiet.shape)
    delay = options.delay_cost_per_s * options.dt_s * np.cumsum(classes[1:].sum(axis=2), axis=0)
    stop = last - np.concatenate([np.zeros((1, count)), delay])
    stop[n] = silence[n] - delay[-1]
    at = np.arange(0, n, BLOCK)
    columns = [classes[np.maximum(at - lag, 0)] for lag in LAGS] + [quiet[at, :, None] ** 8]
    left = np.broadcast_to((1.0 - at / n)[:, None, None], (len(at), count, 1))
    seen = np.concatenate([*columns, left, last[at, :, None]], axis=2)
    last[n - 1] = np.where(last[n - 1] > silence[n - 1], np.inf, -np.inf)
    return Paths(stop.T, (classes[1:] - expected).swapaxes(0, 1), seen.swapaxes(0, 1), last.T)


def fit(paths: Paths, rounds: int) -> nn.Module:
    """The network whose martingale leaves a knowing agent least, and least by luck."""
    seen = torch.tensor(paths.seen, dtype=torch.float32)
    shocks = torch.tensor(paths.surprise, dtype=torch.float32)
    shocks = shocks.reshape(len(shocks), -1, BLOCK, shocks.shape[2]).sum(2)
    stop = torch.tensor(paths.stop[:, ::BLOCK], dtype=torch.float32)
    sizes = (seen.shape[2], 32, 32, shocks.shape[2])
    network = nn.Sequential(
        nn.Linear(*sizes[:2]), nn.Tanh(), nn.Linear(*sizes[1:3]), nn.Tanh(), nn.Linear(*sizes[2:])
    )
    optimizer = torch.optim.AdamW(network.parameters(), 3e-3)
    for k in range(rounds):
        rows = torch.randperm(len(seen))[:150]
        price = (network(seen[rows]) * shocks[rows]).sum(2).cumsum(1)
        best: Tensor = (stop[rows] - nn.functional.pad(price, (1, 0))).max(1).values
        optimizer.param_groups[0]["lr"] = 3e-3 * (1.0 - k / rounds)
        optimizer.zero_grad()
        (best.mean() + 0.3 * best.std()).backward()  # type: ignore[no-untyped-call]  # torch's
        optimizer.step()
    return network


def price_of(network: nn.Module, paths: Paths) -> FloatArray:
    """The martingale of each episode after every number of samples, shape (count, n_samples + 1)."""
    with torch.no_grad():
        factor = network(torch.tensor(paths.seen, dtype=torch.float32)).numpy().repeat(BLOCK, axis=1)
    steps = (factor * paths.surprise).sum(axis=2).cumsum(axis=1)
    return np.concatenate([np.zeros((len(steps), 1)), steps], axis=1)


def one_threshold(paths: Paths, price: FloatArray, threshold: float) -> FloatArray:
    """Return of each episode, the martingale taken off, if it is declared once that is worth the threshold."""
    n = paths.stop.shape[1] - 1
    over = paths.worth[:, :n] >= threshold
    at = np.where(over.any(axis=1), over.argmax(axis=1), n)
    rows = np.arange(len(at))
    found: FloatArray = paths.stop[rows, at] - price[rows, at]
    return found


def main() -> None:
    """Print the bracket."""
    parser = argparse.ArgumentParser(description="Bracket the best return on a monitor.")
    parser.add_argument("--recipe", default="small")
    parser.add_argument("--episodes", type=int, default=1000, help="to fit to, and as many to score")
    parser.add_argument("--rounds", type=int, default=300, help="of fitting")
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)  # the seed of this script, a process of its own
    fitted = collect(given.recipe, given.episodes, seed=100)
    network = fit(fitted, given.rounds)
    price = price_of(network, fitted)
    threshold = max(THRESHOLDS, key=lambda t: one_threshold(fitted, price, t).mean())
    scored = collect(given.recipe, given.episodes, seed=1)
    price = price_of(network, scored)
    (high, high_half), (low, low_half) = (
        interval((scored.stop - price).max(axis=1)),
        interval(one_threshold(scored, price, threshold)),
    )
    print(f"one threshold, {threshold:.4f}: {low:+.4f} ± {low_half:.4f}")
    print(f"upper bound: {high:+.4f} ± {high_half:.4f}")
    print(f"width with both sampling errors: {high + high_half - low + low_half:.4f}")


if __name__ == "__main__":
    main()
