"""Generated data sets: what is in them, and that they come out the same whatever is asked beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_datasets import generate_arrays, generate_dataset, load, split_of, to_pandas, to_torch
from motor_datasets.cli import main
from motor_env.parameters import Channel, SensorParameters
from motor_env.recipes import RECIPES
from motor_env.simulation import Timing

SHORT = replace(RECIPES["bench"], timing=Timing(duration_s=0.01))


def test_a_case_does_not_depend_on_its_neighbours() -> None:
    together = generate_arrays(SHORT, 7, 40)
    alone = generate_arrays(SHORT, 7, [23])
    assert np.array_equal(together.X[23:24], alone.X)
    assert together.split[23] == alone.split[0]


def test_splits_are_dealt_exactly_and_by_motor_alone() -> None:
    splits = split_of(3, np.arange(2000))
    assert [(splits == name).sum() for name in ("train", "validation", "test")] == [1400, 300, 300]
    assert np.array_equal(split_of(3, np.arange(977, 1003)), splits[977:1003])
    assert not np.array_equal(split_of(4, np.arange(2000)), splits)


def test_the_truth_explains_the_transient() -> None:
    """Without noise, the level of the current follows from the stored parameters and the fault."""
    recipe = replace(
        RECIPES["bench"], sensor=SensorParameters(current_noise_a=0.0), timing=Timing(duration_s=0.2)
    )
    data = generate_arrays(recipe, 1, 60)
    p = data.parameters
    friction = p["viscous_friction_n_m_s_per_rad"] * np.where(
        data.kind == "bearing", 1.0 + data.severity, 1.0
    )
    resistance = p["resistance_ohm"] * np.where(data.kind == "winding_contact", 1.0 + data.severity, 1.0)
    stiffness = p["torque_constant_n_m_per_a"] * p["back_emf_constant_v_s_per_rad"]
    level = p["voltage_v"] * friction / (stiffness + resistance * friction)
    np.testing.assert_allclose(data.X[:, 0, -1], level, rtol=1e-6)


def test_what_is_loaded_is_what_was_generated(tmp_path: Path) -> None:
    recipe = replace(SHORT, sensor=SensorParameters(channels=(Channel.SPEED, Channel.CURRENT)))
    generate_dataset(recipe, 50, 5, tmp_path / "set")
    loaded, made = load(tmp_path / "set"), generate_arrays(recipe, 5, 50)
    assert loaded.recipe == recipe
    assert np.array_equal(loaded.X, made.X)
    for name in ("class_name", "class_index", "kind", "severity", "case_id", "motor_id", "split"):
        assert np.array_equal(getattr(loaded, name), getattr(made, name)), name
    for name, values in made.parameters.items():
        assert np.array_equal(loaded.parameters[name], values), name
    test = load(tmp_path / "set", "test")
    assert np.array_equal(test.case_id, made.of_split("test").case_id)
    frame = to_pandas(test)
    assert np.array_equal(np.stack(frame["current_a"].to_list()), test.X[:, 1])
    transients, labels, _ = to_torch(test)[:]
    assert np.array_equal(transients.numpy(), test.X)
    assert np.array_equal(labels.numpy(), test.class_index)


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_command_writes_the_same_bytes_and_never_over_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["generate", "bench", "--cases", "30", "--seed", "2", "--duration-s", "0.01"]
    for name in ("a", "b"):
        assert main([*command, "--out", str(tmp_path / name)]) == 0
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    before = files_of(tmp_path)
    assert main([*command, "--out", str(tmp_path / "a")]) == 2
    assert "not overwritten" in capsys.readouterr().err
    assert files_of(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["nope", "--cases", "3"], "recipe must be one of"),
        (["bench", "--cases", "0"], "cases must be in 1 .."),
        (["bench", "--cases", "3", "--channels", "current,torque"], "torque"),
        (["bench", "--cases", "3", "--sampling-rate-hz", "-1"], "sampling_rate_hz must be"),
        (["bench", "--cases", "3", "--current-noise-a", "nan"], "current_noise_a must be"),
        (["bench", "--cases", "3", "--motor", "none.toml"], "none.toml"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert main(["generate", *options, "--seed", "1", "--out", str(tmp_path / "set")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
