"""Reference scores: thresholds and table follow from the kept results, and what is there is not measured again."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import reference_scores
from reference_policies import REFERENCES, Continuous

import motor_env  # noqa: F401  # registers the environments

IDS = [name.removeprefix("motor_env/") for name in gym.registry if name.startswith("motor_env/")]


def test_every_id_has_policies_of_its_own() -> None:
    assert sorted(REFERENCES) == sorted(IDS), "benchmarks/reference_policies.py names the policies of each id"


@pytest.mark.parametrize("name", IDS)
def test_thresholds_are_the_best_policys_mean_less_its_error(name: str) -> None:
    found = reference_scores.kept(name)
    assert "best" in found, f"`python benchmarks/reference_scores.py --only {name}` measures it"
    best, threshold = found["best"], gym.spec(f"motor_env/{name}").reward_threshold
    assert threshold == reference_scores.threshold(best)
    assert (
        best["return"] - best["standard_error"] - 0.001 < threshold <= best["return"] - best["standard_error"]
    )
    assert found["trivial"]["return"] < found["textbook"]["return"] < best["return"] + 0.02
    if "bound" in found:
        assert best["return"] < found["bound"]["return"] + 2.0 * best["standard_error"]


def test_what_is_there_is_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(reference_scores, "RESULTS", tmp_path)
    monkeypatch.setattr(reference_scores, "SEEDS", (1, 2))
    few = replace(REFERENCES["Drive-v0"], episodes=3)
    monkeypatch.setitem(REFERENCES, "Drive-v0", few)
    reference_scores.main(only="Drive-", methods=("textbook",))
    kept = tmp_path / "Drive-v0" / "textbook.json"
    assert list(tmp_path.rglob("*.json")) == [kept]
    assert "Drive-v0 textbook:" in capsys.readouterr().out
    before = kept.stat().st_mtime_ns
    reference_scores.main(only="Drive-", methods=("textbook",))
    assert kept.stat().st_mtime_ns == before
    found = reference_scores.kept("Drive-v0")["textbook"]
    assert found["episodes"] == 6
    assert -8.0 <= found["return"] < 0.0


def test_the_middle_half_of_the_runs() -> None:
    """Of eight runs the middle four count; the interval holds them, and shrinks to a point without spread."""
    runs = np.array([-90.0, -80.0, 1.0, 2.0, 3.0, 4.0, 80.0, 95.0])
    middle, low, high = reference_scores.interquartile(runs, np.random.default_rng(0))
    assert middle == 2.5
    assert low < -1.0 < 5.0 < high
    assert reference_scores.interquartile(np.full(5, 2.0), np.random.default_rng(0)) == (2.0, 2.0, 2.0)


def test_a_policy_of_listed_voltages_plays_with_any_voltage() -> None:
    envs: Any = gym.make_vec("motor_env/ProbeContinuous-v0", num_envs=5).unwrapped

    class Listed:
        def start(self, count: int) -> None:
            self.count = count

        def act(self, observations: Any) -> Any:
            return np.arange(self.count)

    policy = Continuous(envs, lambda _: Listed())
    policy.start(5)
    wanted = [[0.0, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert policy.act(np.zeros((5, 1), dtype=np.float32)).tolist() == wanted
