"""Answers of other packages' classifiers: exported, read back, and refused where they speak of other starts."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import peers as aeon
import pytest
from hostile import Poison, refused

# Reaches in: the table that a run prints names where kept answers come from.
from motor_classifiers.cli.sweep import table_lines
from motor_classifiers.scoring.benchmark import PEERS, Plan, read_peers, run_plan
from motor_classifiers.scoring.judging import Cost
from motor_classifiers.scoring.results import result_rows
from motor_classifiers.scoring.task import class_task
from motor_env import InputError, Timing, load_recipe

TASK = class_task(load_recipe("bench", timing=Timing(1_000.0, 0.1)), 100, 60)


def _answers(folder: Path, off: float = 0.0) -> Path:
    """What benchmarks/aeon_peers.py writes, from a peer that calls every second start of `TASK` healthy and no other.

    The mean levels of its test starts are off by so much.
    """
    aeon.export_starts(TASK.train(), TASK.starts(), folder / "cases.npz")
    with np.load(folder / "cases.npz") as held:
        arrays = {name: held[name] for name in held.files}
    n_classes = int(arrays["n_classes"])
    found = np.full((len(arrays["test_X"]), n_classes), 0.5 / (n_classes - 1))
    found[::2, 0] = 0.5
    found[1::2] = 2.0 * np.eye(n_classes)[1]
    told = {
        "train_s": 1.5,
        "microseconds_per_transient": 200.0,
        "train_memory_mb": None,
        "inference_memory_mb": 3.0,
    }
    facts = {
        "date": "2026-11-21",
        "machine": "one",
        "aeon": "1.6.0",
        "command": "test",
        "methods": {"quant": told},
    }
    identity = ("train_mean", "test_mean", "train_class_index", "test_class_index")
    written = {name: arrays[name] for name in identity}
    written["test_mean"] = written["test_mean"].astype(np.float64) + off
    facts_text = np.array(json.dumps(facts))
    np.savez(folder / "peers.npz", facts=facts_text, quant=found.astype(np.float16), **written)
    return folder / "peers.npz"


@pytest.fixture
def peers(tmp_path: Path) -> Path:
    """A file of answers to the starts of `TASK`."""
    return _answers(tmp_path)


def test_exported_starts_are_those_of_the_benchmark(tmp_path: Path) -> None:
    aeon.export_starts(TASK.train(), TASK.starts(), tmp_path / "cases.npz")
    with np.load(tmp_path / "cases.npz") as held:
        np.testing.assert_array_equal(held["train_X"], TASK.train().X)
        np.testing.assert_array_equal(held["test_class_index"], TASK.starts().class_index)


def test_answers_are_scaled_to_probabilities(peers: Path) -> None:
    got = read_peers(peers, TASK)["quant"]
    assert got.probabilities[:2].tolist() == [[0.5, 0.125, 0.125, 0.125, 0.125], [0.0, 1.0, 0.0, 0.0, 0.0]]
    assert (got.train, got.inference.memory_mb) == (Cost(1.5, None), 3.0)
    assert got.inference.seconds == pytest.approx(0.012)
    assert got.origin == "2026-11-21, one, aeon 1.6.0, test"


@pytest.mark.parametrize(("off", "found"), [(0.99e-6, True), (1.01e-6, False)])
def test_levels_may_differ_in_their_last_bits(off: float, found: bool, tmp_path: Path) -> None:
    assert bool(read_peers(_answers(tmp_path, off), TASK)) is found


def test_peers_stand_in_the_table_and_are_no_leak(peers: Path) -> None:
    (result,) = run_plan(Plan((TASK,), (), peers))
    (quant,) = result.methods
    assert quant.name == "quant"
    expected = np.where(np.arange(60) % 2 == 0, 0, 1)
    np.testing.assert_array_equal(quant.answer.decided, expected)
    assert table_lines(result)[-1] == "quant: kept answers, 2026-11-21, one, aeon 1.6.0, test"
    row = result_rows([result])[1]
    assert row["family"] == "peer"
    assert row["train_memory_mb"] is None
    assert row["accuracy"] == pytest.approx((expected == TASK.starts().class_index).mean())


def test_a_run_on_other_starts_alone_refuses_the_answers(peers: Path) -> None:
    other = class_task(TASK.recipe, 100, 60, seed=1)
    with pytest.raises(InputError, match="holds answers to other starts than those of this benchmark"):
        run_plan(Plan((other,), (), peers))


def test_answers_to_other_starts_are_left_out(peers: Path) -> None:
    recipe = TASK.recipe
    assert set(read_peers(peers, TASK)) == {"quant"}
    assert read_peers(peers, class_task(recipe, 100, 50))  # the first of its starts
    for other in (
        class_task(recipe, 101, 60),
        class_task(recipe, 100, 61),
        class_task(recipe, 100, 60, seed=1),
        class_task(load_recipe("bench", timing=Timing(2_000.0, 0.1)), 100, 60),
    ):
        assert read_peers(peers, other) == {}


def test_poisoned_and_damaged_files_are_refused(peers: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "poisoned.npz", facts=np.array([Poison(tmp_path / "mark")], dtype=object))
    whole = peers.read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("poisoned", "cut", "text", "none"):
        path = tmp_path / f"{name}.npz"
        refused(partial(read_peers, path, TASK), path)


def test_kept_answers_are_those_of_the_default_setting() -> None:
    found = read_peers(aeon.KEPT, class_task(load_recipe("bench")))
    assert set(found) == set(PEERS)
    truth = class_task(load_recipe("bench")).starts().class_index
    accuracy = {name: (answer.decided == truth).mean() for name, answer in found.items()}
    # Measured before: QUANT 0.932, MiniRocket 0.817, MultiRocket-Hydra 0.828 on other starts of the recipe.
    assert accuracy["quant"] == pytest.approx(0.935, abs=0.02)
    assert accuracy["minirocket"] == pytest.approx(0.82, abs=0.03)
    assert accuracy["multirocket-hydra"] == pytest.approx(0.83, abs=0.03)
    assert [name for name, answer in found.items() if answer.is_graded] == ["quant"]
