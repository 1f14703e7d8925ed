"""Data sets for learning offline: what they hold is what the environment gives."""

from pathlib import Path

import numpy as np
import pytest

from motor_env.cli import main
from motor_env.envs.offline.behaviours import TASKS, Behaviour
from motor_env.envs.offline.recording import episodes_of

minari = pytest.importorskip("minari", reason="data sets for learning offline need the extra minari")


@pytest.mark.parametrize("task", TASKS)
def test_a_data_set_is_read_and_its_environment_repeats_it(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["offline", task, "--behaviour", "mixed", "--episodes", "6", "--out", str(tmp_path)]
    assert main(command) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = minari.load_dataset(f"motor_env/{task.removesuffix('-v0')}/mixed-v0")
    assert data.total_episodes == 6
    env = data.recover_environment()
    assert env.spec.id == f"motor_env/{task}"
    kept = data.storage.metadata
    assert kept["ref_min_score"] < kept["ref_max_score"] == env.spec.reward_threshold
    for number, episode in enumerate(data.iterate_episodes()):
        assert episode.terminations[-1]
        assert not episode.terminations[:-1].any()
        # Two episodes of each of three behaviours, each of which has streams of its own.
        observation, _ = env.reset(seed=(number // 2) << 20, options={"index": number % 2})
        np.testing.assert_array_equal(episode.observations[0], observation)
        for action, reward, following in zip(
            episode.actions, episode.rewards, episode.observations[1:], strict=True
        ):
            observation, paid, *_ = env.step(action)
            np.testing.assert_array_equal(following, observation)
            assert paid == reward


def test_better_policies_are_paid_better() -> None:
    for task in ("Probe-v0", "Drive-v0", "Maintain-v0"):
        mean = {
            each: np.mean([one.rewards.sum() for one in episodes_of(task, each, 60, 1)]) for each in Behaviour
        }
        assert mean[Behaviour.RANDOM] < mean[Behaviour.MIXED] < mean[Behaviour.RULE], task
        assert mean[Behaviour.RULE] < mean[Behaviour.BEST] + 0.15, task


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["Drone-v0"], "task must be one of"),
        (["Probe-v0", "--episodes", "0"], "episodes must be >= 1"),
        (["Probe-v0", "--seed", "-1"], "seed in 0"),
    ],
)
def test_bad_orders_get_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["offline", *options, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_data_set_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["offline", "Maintain-v0", "--behaviour", "rule", "--episodes", "2", "--out", str(tmp_path)]
    assert main(command) == 0
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err
