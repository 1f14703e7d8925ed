"""The bracket of benchmarks/field_limit.py holds the best accuracy where that is known."""

from types import SimpleNamespace

import field_limit
import numpy as np
import pytest
from scipy.special import softmax


def test_bracket_of_noisy_posteriors_holds_the_best_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    n, rows = 3000, np.arange(3000)
    logits = 2.0 * rng.standard_normal((n, 5))
    exact = softmax(logits, axis=1)
    once, again = (softmax(logits + 0.2 * rng.standard_normal((n, 5)), axis=1) for _ in range(2))
    network = (logits + rng.standard_normal((n, 5))).argmax(axis=1)
    truth = (rng.random(n)[:, None] > exact.cumsum(axis=1)).sum(axis=1)
    monkeypatch.setattr(field_limit, "generate_arrays", lambda *_: SimpleNamespace(class_index=truth))
    monkeypatch.setattr(field_limit, "decisions", lambda _: network)
    got = field_limit.figures(once, again[:1500], (float(exact[rows, network].mean()), 0.0))
    best = exact.max(axis=1).mean()
    low, high = got["bracket"]
    assert low < best < high
    assert high - low < 0.04
    assert got["network_behind"][0] < best - exact[rows, network].mean() < got["network_behind"][1]
    assert got["right"] == pytest.approx(best, abs=0.03)
