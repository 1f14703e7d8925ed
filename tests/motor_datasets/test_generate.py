"""Generated data sets: what is in them, and that they come out the same whatever is asked beside them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import loadmat
from small_sets import SHORT, assert_same, files_of

from motor_datasets import (
    generate_arrays,
    generate_dataset,
    load,
    to_pandas,
    to_torch,
    to_torch_iterable,
)
from motor_datasets.cli import main
from motor_datasets.loaders import export
from motor_env import Channel, FaultKind, InputError, SensorParameters, Timing, load_recipe
from motor_env.simulation.recipes import FaultClass


def test_a_case_does_not_depend_on_its_neighbours() -> None:
    together = generate_arrays(SHORT, 7, 40)
    alone = generate_arrays(SHORT, 7, [23])
    assert np.array_equal(together.X[23:24], alone.X)
    assert together.split[23] == alone.split[0]


def test_the_truth_explains_the_transient() -> None:
    """Without noise, the level of the current follows from the stored parameters and the fault."""
    recipe = replace(
        load_recipe("bench"), sensor=SensorParameters(current_noise_a=0.0), timing=Timing(duration_s=0.2)
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
    assert_same(loaded, made)
    test = load(tmp_path / "set", "test")
    assert np.array_equal(test.case_id, made.case_id[made.split == "test"])
    frame = to_pandas(test)
    assert np.array_equal(np.stack(frame["current_a"].to_list()), test.X[:, 1])
    transients, labels, _ = to_torch(test)[:]
    assert np.array_equal(transients.numpy(), test.X)
    assert np.array_equal(labels.numpy(), test.class_index)


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
        (["bench", "--cases", "0"], "cases must be >= 1"),
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


def test_the_starts_of_a_motor_share_its_parameters_and_begin_healthy() -> None:
    recipe = replace(load_recipe("field"), timing=Timing(duration_s=0.002))
    data = generate_arrays(recipe, 1, 400)
    by_motor = data.motor_id.reshape(80, 5)
    assert (by_motor == by_motor[:, :1]).all()
    for name in ("resistance_ohm", "coulomb_friction_n_m", "gain"):
        values = data.parameters[name].reshape(80, 5)
        if name != "coulomb_friction_n_m":  # a bearing fault raises it
            assert (values == values[:, :1]).all(), name
        assert len(np.unique(values[:, 0])) == 80
    for name in ("voltage_v", "temperature_rise_k", "offset_a"):
        assert len(np.unique(data.parameters[name])) == 400, name
    kinds = data.kind.reshape(80, 5)
    assert (kinds[:, :3] == "healthy").all()
    assert (kinds[:, 3] == kinds[:, 4]).all()
    assert 45 <= (kinds[:, 4] != "healthy").sum() <= 78


def test_shifts_have_their_own_conditions_motors_and_files(tmp_path: Path) -> None:
    recipe = replace(load_recipe("field"), timing=Timing(duration_s=0.002))
    generate_dataset(recipe, 200, 1, tmp_path / "set")
    main, hot = load(tmp_path / "set"), load(tmp_path / "set", "shift_hotter")
    assert len(hot) == 20
    assert main.parameters["temperature_rise_k"].max() < 15.0 < hot.parameters["temperature_rise_k"].min()
    unseen = load(tmp_path / "set", "shift_unseen_kind")
    assert set(unseen.kind) <= {"healthy", "winding_short", "noise"}
    assert not set(main.kind) & {"winding_short", "noise"}
    assert np.array_equal(unseen.class_name, np.array(unseen.class_names)[unseen.class_index])
    assert not set(main.motor_id) & (set(hot.motor_id) | set(unseen.motor_id))


def test_continuous_and_joint_severities() -> None:
    wide = FaultClass(FaultKind.BEARING, 0.05, severity_to=0.3)
    joint = FaultClass(FaultKind.BEARING, 0.1, also=(FaultClass(FaultKind.WINDING_CONTACT, 0.25),))
    recipe = replace(SHORT, classes=(FaultClass(), wide, joint), spread=load_recipe("paper").spread)
    data = generate_arrays(recipe, 1, 3000)
    bearings = data.severity[data.class_name == "bearing"]
    assert 0.05 <= bearings.min() < 0.06 < 0.29 < bearings.max() <= 0.3
    assert abs(bearings.mean() - 0.175) < 4.0 * 0.25 / np.sqrt(12.0 * len(bearings))
    assert joint.name == "bearing_10+winding_contact_25"
    peak = data.X[:, 0].max(axis=1)
    contact = replace(SHORT, classes=(FaultClass(FaultKind.WINDING_CONTACT, 0.25),), spread=recipe.spread)
    expected = generate_arrays(contact, 2, 500).X[:, 0].max(axis=1).mean()
    assert peak[data.class_name == joint.name].mean() == pytest.approx(expected, abs=0.005)


def test_severities_of_a_range_are_those_of_each_case_in_torch() -> None:
    pytest.importorskip("torch", reason="the extra classifiers is not installed")
    recipe = replace(SHORT, classes=(FaultClass(FaultKind.BEARING, 0.1, severity_to=0.3),))
    data = generate_arrays(recipe, 1, 20)
    assert np.ptp(data.severity) > 0.1
    (_, _, streamed), *_ = to_torch_iterable(recipe, 1, 20, batches=1)
    for severity in (to_torch(data).tensors[2], streamed):
        np.testing.assert_array_equal(severity.numpy(), data.severity.astype(np.float32))


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.long)])  # each imports torch
def test_the_workers_of_a_loader_give_each_case_once(workers: int) -> None:
    torch = pytest.importorskip("torch", reason="the extra classifiers is not installed")
    source = to_torch_iterable(SHORT, 1, 16, batches=5)
    # Spawned, not forked: a fork beside threads is a warning from Python 3.12 on.
    loader = torch.utils.data.DataLoader(
        source, batch_size=None, num_workers=workers, multiprocessing_context="spawn"
    )
    shared = [tuple(part.numpy().copy() for part in batch) for batch in loader]
    alone = [tuple(part.numpy() for part in batch) for batch in source]
    expected = generate_arrays(SHORT, 1, 80)
    assert np.array_equal(np.concatenate([X for X, _, _ in alone]), expected.X)
    for here, there in zip(alone, shared, strict=True):
        for ours, theirs in zip(here, there, strict=True):
            assert np.array_equal(ours, theirs)
    assert len(np.unique(expected.X[:, 0], axis=0)) == 80  # so a repeated case would have been seen


def test_a_worker_of_a_loader_takes_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="the extra classifiers is not installed")
    whole = list(to_torch_iterable(SHORT, 1, 16, batches=5))
    for number in range(2):
        told = SimpleNamespace(id=number, num_workers=2)
        monkeypatch.setattr(torch.utils.data, "get_worker_info", lambda told=told: told)
        share = list(to_torch_iterable(SHORT, 1, 16, batches=5))
        for ours, theirs in zip(whole[number::2], share, strict=True):
            assert all(map(torch.equal, ours, theirs))


def test_exports_hold_the_same_numbers(tmp_path: Path) -> None:
    data = generate_arrays(SHORT, 1, 20)
    export(data, tmp_path / "a.npz")
    export(data, tmp_path / "a.mat")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert np.array_equal(archive["X"], data.X)
        assert np.array_equal(archive["class_name"], data.class_name)
    matlab = loadmat(tmp_path / "a.mat", squeeze_me=True, chars_as_strings=True)
    assert np.array_equal(matlab["X"], data.X[:, 0])
    assert matlab["class_name"].tolist() == data.class_name.tolist()
    assert np.array_equal(
        matlab["back_emf_constant_v_s_per_rad"], data.parameters["back_emf_constant_v_s_per_rad"]
    )
    with pytest.raises(InputError, match="not overwritten"):
        export(data, tmp_path / "a.mat")
