"""Data sets for learning offline: what they hold is what the environment gives."""

import errno
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from motor_env.cli import main
from motor_env.envs.offline_data import TASKS, Behaviour, episodes_of

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


def test_a_folder_may_be_relative_and_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Minari itself cannot write below a relative path."""
    monkeypatch.chdir(tmp_path)
    assert (
        main(["offline", "Maintain-v0", "--behaviour", "random", "--episodes", "2", "--out", "out/new"]) == 0
    )
    assert (tmp_path / "out" / "new" / "motor_env" / "Maintain" / "random-v0").is_dir()


def test_better_policies_are_paid_better() -> None:
    for task in ("Probe-v0", "DriveControl-v0", "Maintain-v0"):
        random, rule, best = (
            np.mean([one.rewards.sum() for one in episodes_of(task, each, 60, 1)])
            for each in (Behaviour.RANDOM, Behaviour.RULE, Behaviour.BEST)
        )
        assert random < rule < best + 0.15, task


def test_thresholds_are_those_that_were_tuned() -> None:
    """What the recorded episodes were played with: another threshold would be another data set of the same name."""
    found = {}
    for name, task in TASKS.items():
        options: Any = task.options
        envs = gym.make_vec(f"motor_env/{name}", num_envs=1, **options).unwrapped
        makers = (
            [task.rule] if name.startswith("Maintain") else [task.rule, task.best]
        )  # a plan takes a second
        found[name] = [getattr(make(envs), "threshold", None) for make in makers]
        if name == "Monitor-v0":
            rule: Any = task.rule(envs)
            assert (rule.rule.shift, rule.rule.two_sided) == (0.3, True)
        if name == "Probe-v0":
            best: Any = task.best(envs)
            assert best.above == 0.08
    assert found == {
        "Monitor-v0": [16.0, 0.8],
        "Probe-v0": [0.93, 0.93],
        "DriveControl-v0": [None, None],
        "Maintain-v0": [0.84],
        "MaintainUnknownRate-v0": [0.84],
    }


def test_mixed_episodes_are_of_each_behaviour_in_turn() -> None:
    """Shares of 7: 3, 2 and 2; each behaviour has streams of its own, 2^20 apart."""
    episodes = episodes_of("Maintain-v0", Behaviour.MIXED, 7, 5)
    assert [(one.seed, one.stream) for one in episodes] == [
        *((5 << 20, k) for k in range(3)),
        *((6 << 20, k) for k in range(2)),
        *((7 << 20, k) for k in range(2)),
    ]
    assert [one.seed for one in episodes_of("Maintain-v0", Behaviour.RULE, 101, 5)[99:]] == [
        5 << 20,
        (5 << 20) + 100,
    ]
    assert {len(one.rewards) for one in episodes} == {120}
    random = np.concatenate([one.actions for one in episodes[:3]])
    assert np.bincount(random).min() > 90  # of 120 each


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["Drone-v0"], "task must be one of"),
        (["Probe-v0", "--episodes", "0"], "episodes must be >= 1"),
        (["Probe-v0", "--seed", "-1"], "seed in 0"),
        (["Probe-v0", "--seed", "4294967296"], "seed in 0"),
    ],
)
def test_bad_orders_get_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["offline", *options, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_data_set_is_whole_or_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, keep = tmp_path / "sets", tmp_path / "sets" / "mine.txt"
    command = ["offline", "Maintain-v0", "--behaviour", "rule", "--episodes", "2", "--out", str(folder)]

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for there in (False, True):
        if there:
            folder.mkdir()
            keep.write_text("mine")
        with monkeypatch.context() as patch:
            patch.setattr("minari.dataset._storages.arrow_storage.ArrowStorage.update_episodes", full)
            assert main(command) == 2
        assert "no space left on device" in capsys.readouterr().err
        assert list(tmp_path.rglob("*")) == ([folder, keep] if there else [])
    assert main(command) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    assert minari.load_dataset("motor_env/Maintain/rule-v0").total_episodes == 2
    assert {file.name for file in folder.iterdir()} == {"mine.txt", "motor_env"}


def test_a_data_set_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["offline", "Maintain-v0", "--behaviour", "rule", "--episodes", "2", "--out", str(tmp_path)]
    command += ["--seed", "4294967295"]
    assert main(command) == 0
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err
