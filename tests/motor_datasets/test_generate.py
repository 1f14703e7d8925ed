"""Generated data sets: what is in them and what they say of themselves, the same whatever is asked beside them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
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
from motor_datasets.card import describe, draw_sheet
from motor_datasets.cli import main
from motor_datasets.loaders import export
from motor_env import Channel, FaultKind, InputError, SensorParameters, Timing, load_recipe
from motor_env.simulation.recipes import FaultClass

FIELD = replace(load_recipe("field"), timing=Timing(duration_s=0.002))


def test_a_case_does_not_depend_on_its_neighbours() -> None:
    together, alone = generate_arrays(SHORT, 7, 40), generate_arrays(SHORT, 7, [23])
    assert np.array_equal(together.X[23:24], alone.X)
    assert together.split[23] == alone.split[0]


def test_the_truth_explains_the_transient() -> None:
    """Without noise, the level of the current follows from the stored parameters and the fault."""
    quiet = SensorParameters(current_noise_a=0.0)
    data = generate_arrays(replace(load_recipe("bench"), sensor=quiet, timing=Timing(duration_s=0.2)), 1, 60)
    p = data.parameters
    worse = {
        kind: np.where(data.kind == kind, 1.0 + data.severity, 1.0) for kind in ("bearing", "winding_contact")
    }
    friction = p["viscous_friction_n_m_s_per_rad"] * worse["bearing"]
    resistance = p["resistance_ohm"] * worse["winding_contact"]
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
    assert np.array_equal(np.stack(to_pandas(test)["current_a"].to_list()), test.X[:, 1])
    transients, labels, _ = to_torch(test)[:]
    assert np.array_equal(transients.numpy(), test.X)
    assert np.array_equal(labels.numpy(), test.class_index)


def test_the_command_writes_the_same_bytes_and_never_over_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--cases", "100", "--seed", "2", "--duration-s", "0.002", "--json"]
    command = ["generate", "field", *options, "--out"]
    assert main([*command, str(tmp_path / "dry"), "--dry-run"]) == 0
    assert json.loads(capsys.readouterr().out)["cases_of_shifts"] == 50
    for name in ("a", "b"):
        assert main([*command, str(tmp_path / name)]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["cases"], told["cases_of_shifts"]) == (100, 50)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    before = files_of(tmp_path)
    assert main([*command, str(tmp_path / "a")]) == 2
    assert "not overwritten" in capsys.readouterr().err
    assert files_of(tmp_path) == before
    assert main(["describe", str(tmp_path / "a")]) == 0
    assert "  current_a [A]: measured current, " in capsys.readouterr().out


def test_the_starts_of_a_motor_share_its_parameters_and_begin_healthy() -> None:
    data = generate_arrays(FIELD, 1, 400)
    by_motor = {name: values.reshape(80, 5) for name, values in data.parameters.items()}
    for name in ("resistance_ohm", "gain"):
        assert (by_motor[name] == by_motor[name][:, :1]).all(), name
    for name in ("resistance_ohm", "coulomb_friction_n_m", "gain"):
        assert len(np.unique(by_motor[name][:, 0])) == 80
    for name in ("voltage_v", "temperature_rise_k", "offset_a"):
        assert len(np.unique(data.parameters[name])) == 400, name
    assert np.array_equal(data.motor_id, np.repeat(data.motor_id[::5], 5))
    kinds = data.kind.reshape(80, 5)
    assert (kinds[:, :3] == "healthy").all()
    assert (kinds[:, 3] == kinds[:, 4]).all()
    assert 45 <= (kinds[:, 4] != "healthy").sum() <= 78


def test_shifts_have_their_own_conditions_motors_and_files(tmp_path: Path) -> None:
    generate_dataset(FIELD, 200, 1, tmp_path / "set")
    main, hot = load(tmp_path / "set"), load(tmp_path / "set", "shift_hotter")
    assert len(hot) == 20
    assert main.parameters["temperature_rise_k"].max() < 15.0 < hot.parameters["temperature_rise_k"].min()
    unseen = load(tmp_path / "set", "shift_unseen_kind")
    assert set(unseen.kind) <= {"healthy", "winding_short", "noise"}
    assert not set(main.kind) & {"winding_short", "noise"}
    assert np.array_equal(unseen.class_name, np.array(unseen.class_names)[unseen.class_index])
    assert not set(main.motor_id) & (set(hot.motor_id) | set(unseen.motor_id))


def test_continuous_and_joint_severities() -> None:
    wide, contact = (
        FaultClass(FaultKind.BEARING, 0.05, severity_to=0.3),
        FaultClass(FaultKind.WINDING_CONTACT, 0.25),
    )
    joint = FaultClass(FaultKind.BEARING, 0.1, also=(contact,))
    exact = replace(SHORT, spread=load_recipe("paper").spread)
    data = generate_arrays(replace(exact, classes=(FaultClass(), wide, joint)), 1, 3000)
    bearings = data.severity[data.class_name == "bearing"]
    assert 0.05 <= bearings.min() < 0.06 < 0.29 < bearings.max() <= 0.3
    assert abs(bearings.mean() - 0.175) < 4.0 * 0.25 / np.sqrt(12.0 * len(bearings))
    assert joint.name == "bearing_10+winding_contact_25"
    expected = generate_arrays(replace(exact, classes=(contact,)), 2, 500).X[:, 0].max(axis=1).mean()
    peak = data.X[data.class_name == joint.name, 0].max(axis=1).mean()
    assert peak == pytest.approx(expected, abs=0.005)


def test_a_worker_of_a_loader_takes_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="the extra classifiers is not installed")
    source = to_torch_iterable(SHORT, 1, 16, batches=5)
    whole = list(source)
    cases = np.concatenate([X.numpy() for X, _, _ in whole])
    np.testing.assert_array_equal(cases, generate_arrays(SHORT, 1, 80).X)
    assert len(np.unique(cases[:, 0], axis=0)) == 80  # so a repeated case would have been seen
    for number in range(2):
        told = SimpleNamespace(id=number, num_workers=2)
        monkeypatch.setattr(torch.utils.data, "get_worker_info", lambda told=told: told)
        for ours, theirs in zip(whole[number::2], source, strict=True):
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
    name = "back_emf_constant_v_s_per_rad"
    assert np.array_equal(matlab[name], data.parameters[name])
    with pytest.raises(InputError, match="not overwritten"):
        export(data, tmp_path / "a.mat")


def test_other_tools_read_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hugging Face's datasets, offline and by the card."""
    huggingface = pytest.importorskip("datasets")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "cache"))
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    ours = load(tmp_path / "set", "test")
    theirs = huggingface.load_dataset(str(tmp_path / "set"), split="test", cache_dir=str(tmp_path / "cache"))
    assert np.array_equal(np.array(theirs["current_a"], dtype=np.float32), ours.X[:, 0])
    assert list(theirs["class_name"]) == ours.class_name.tolist()


BENCH = load_recipe("bench")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib and pandas, in mlcroissant
def test_mlcroissant_validates_a_set_and_reads_its_records(tmp_path: Path) -> None:
    import mlcroissant

    generate_dataset(BENCH, 20, 1, tmp_path / "data")
    described = mlcroissant.Dataset(jsonld=tmp_path / "data" / "croissant.json")
    assert not described.metadata.ctx.issues.errors
    (advice,) = described.metadata.ctx.issues.warnings
    assert "datePublished" in advice  # left out: the same seed gives the same bytes
    records, starts = list(described.records("train-000000")), load(tmp_path / "data", "train")
    assert [each["train-000000/class_name"].decode() for each in records] == starts.class_name.tolist()
    np.testing.assert_array_equal([each["train-000000/current_a"] for each in records], starts.X[:, 0])


def test_a_recipe_is_described_in_its_units() -> None:
    """Numbers as docs/recipes.md gives them: shares in per cent, the rest in SI."""
    ranged = replace(BENCH.classes[1], severity=0.05, severity_to=0.3)
    few = replace(load_recipe("field"), classes=(BENCH.classes[0], ranged))
    told = describe(few).splitlines()
    for line in (
        "  resistance_ohm = 2.18",
        "supply: step to 12 V",
        f"  {ranged.name}: 50 %, bearing 5 % to 30 %",
        "  ramp_s: 0 to 0.0005, each start",
        "  coulomb_ratio: 0.3 to 0.4, each motor",
        "  adc_bits = 12",
    ):
        assert line in told
    assert "  hold_s: 0.02 to 0.1, log-uniform, each start" in describe(load_recipe("operation"))


def test_a_sheet_shows_the_starts_of_each_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    recipe = replace(BENCH, classes=BENCH.classes[:2])
    draw_sheet(recipe, 3, tmp_path / "sheet.png")
    data = generate_arrays(recipe, 3, 160)
    for axis, name in zip(drawn[0].axes, recipe.class_names, strict=False):
        shown = [np.asarray(line.get_ydata()) for line in axis.get_lines()]
        np.testing.assert_allclose(shown, data.X[data.class_name == name][:4, 0])
