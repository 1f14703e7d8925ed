"""Data sets for learning offline: what they hold is what the environment gives."""

import errno
from pathlib import Path

import numpy as np
import pytest

from motor_env.cli import main
from motor_env.envs.offline_data import Behaviour, episodes_of

minari = pytest.importorskip("minari", reason="data sets for learning offline need the extra minari")


@pytest.mark.parametrize("task", ["Monitor-v0", "Probe-v0", "DriveControl-v0", "Maintain-v0"])
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


def test_mixed_episodes_are_of_each_behaviour_in_turn() -> None:
    """Shares of 7: 3, 2 and 2; each behaviour has streams of its own, 2^20 apart, of a hundred episodes each."""
    episodes = episodes_of("Maintain-v0", Behaviour.MIXED, 7, 5)
    assert [one.seed >> 20 for one in episodes] == [5, 5, 5, 6, 6, 7, 7]
    assert [one.stream for one in episodes] == [0, 1, 2, 0, 1, 0, 1]
    assert [one.seed for one in episodes_of("Maintain-v0", Behaviour.RULE, 101, 5)[99:]] == [
        5 << 20,
        (5 << 20) + 100,
    ]
    random = np.concatenate([one.actions for one in episodes[:3]])
    assert np.bincount(random).min() > 90  # of 120 each


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["Drone-v0"], "task must be one of"),
        (["Probe-v0", "--seed", "4294967296"], "seed in 0"),
    ],
)
def test_bad_orders_get_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["offline", *options, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_data_set_is_whole_or_not_there_and_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a folder that is relative and new, below which Minari itself cannot write."""
    monkeypatch.chdir(tmp_path)
    command = ["offline", "Maintain-v0", "--behaviour", "rule", "--episodes", "2", "--out", "new/sets"]
    command += ["--seed", "4294967295"]

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("minari.dataset._storages.arrow_storage.ArrowStorage.update_episodes", full)
        assert main(command) == 2
    assert "no space left on device" in capsys.readouterr().err
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert main(command) == 0
    assert (tmp_path / "new" / "sets" / "motor_env" / "Maintain" / "rule-v0").is_dir()
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err
