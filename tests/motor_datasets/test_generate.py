"""Generated data sets: what is in them and what they say of themselves, the same whatever is asked beside them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from scipy.io import loadmat
from small_sets import SHORT, assert_same, files_of

from motor_datasets import (
    folder as folder_module,
    generate_arrays,
    generate_dataset,
    load,
    to_pandas,
    to_torch,
    to_torch_iterable,
)
from motor_datasets.arrays import columns
from motor_datasets.card import data_card, describe, draw_sheet
from motor_datasets.cli import main
from motor_datasets.generate import bytes_of_case
from motor_datasets.loaders import export
from motor_datasets.manifest import Entry, Manifest
from motor_env import Channel, FaultKind, InputError, Recipe, SensorParameters, Timing, load_recipe
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


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("nope --cases 3", "recipe must be one of"),
        ("bench --cases 0", "cases must be >= 1"),
        ("bench --cases 3 --channels current,torque", "torque"),
        ("bench --cases 3 --sampling-rate-hz -1", "sampling_rate_hz must be"),
        ("bench --cases 3 --current-noise-a nan", "current_noise_a must be"),
        ("bench --cases 3 --motor none.toml", "none.toml"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: str, said: str
) -> None:
    assert main(["generate", *options.split(), "--seed", "1", "--out", str(tmp_path / "set")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


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


REQUIRED = ("@context", "@type", "conformsTo", "name", "description", "license", "distribution", "recordSet")
BENCH = load_recipe("bench")
SLOW_FIELD = load_recipe("field", timing=replace(load_recipe("field").timing, sampling_rate_hz=1_000.0))


def entry(name: str, rows: int, size: int = 1000) -> Entry:
    return Entry(f"data/{name}.parquet", name.partition("-")[0], rows, size, "0" * 64)


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


def test_croissant_has_all_files_and_columns(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    generate_dataset(SLOW_FIELD, 100, 1, folder)
    names = [column.name for column in columns(SLOW_FIELD)]
    for path in (folder / "data").iterdir():
        assert pq.read_schema(path).names == names
    content: dict[str, Any] = json.loads((folder / "croissant.json").read_bytes())
    entries = json.loads((folder / "dataset.json").read_bytes())["files"]
    digests = {entry["path"]: entry["sha256"] for entry in entries}
    assert {file["@id"]: file["sha256"] for file in content["distribution"]} == digests
    kinds = {"text": "sc:Text", "whole": "sc:Integer", "number": "sc:Float", "samples": "sc:Float"}
    for record in content["recordSet"]:
        assert [field["dataType"] for field in record["field"]] == [
            kinds[c.kind] for c in columns(SLOW_FIELD)
        ]
        assert [field["source"]["extract"]["column"] for field in record["field"]] == names


def test_the_card_counts() -> None:
    files = entry("train-000000", 700, 1_250_000), entry("train-000001", 50, 1_250_000)
    manifest = Manifest(load_recipe("operation"), 9, 999, (*files, entry("test-000000", 249, 10_000)))
    card = data_card(manifest)
    for words in (
        "| train | 750 |\n| test | 249 |\n",
        "999 cases in\n3 files, 2.5 MB.",
        "seed 9. One row a case",
        "Simulated records of motors at work",
        "| `voltage_v` | number | V | level of the supply |",
        "configs:\n- config_name: default\n  data_files:\n  - split: train\n    path: data/train-*.parquet\n",
    ):
        assert words in card


def test_a_dry_run_tells_cases_by_the_time_of_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(folder_module, "seconds_per_case", lambda recipe, seed: 0.25)
    out, recipe = str(tmp_path / "set"), load_recipe("field")
    command = ["generate", "field", "--cases", "400", "--seed", "1", "--out", out, "--dry-run"]
    assert main([*command, "--workers", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "out": out, "recipe": "field", "seed": 1, "cases": 400, "cases_of_shifts": 200,
        "classes": list(recipe.class_names), "channels": ["current"], "samples": 1200, "files": 8,
        "bytes_uncompressed": 600 * bytes_of_case(recipe), "seconds": 600 * 0.25 / 4,
    }  # fmt: skip
    assert main(command) == 0
    assert capsys.readouterr().out == (
        f"would write 400 cases and 200 of shifts of 1200 samples in 8 files to {out}:"
        f" {600 * bytes_of_case(recipe) / 1e6:.1f} MB before compression, some 150.0 s\n"
    )


RANGED = replace(BENCH.classes[1], severity=0.05, severity_to=0.3)
DESCRIBED: list[tuple[Recipe, list[str]]] = [
    (
        load_recipe("bench-full"),
        [
            "  resistance_ohm = 2.18",
            "supply: step to 12 V",
            "  friction: 2 %",
            "  noise_100: 11.1 %, noise 100 %",
            "samples: 1000 at 10000 Hz, 0 s before the step and 0.1 s after it",
            "channels: current; current noise 0.02 A",
            "  current_a [A]: measured current, 1000 samples at 10000 Hz",
        ],
    ),
    (replace(BENCH, classes=(BENCH.classes[0], RANGED)), [f"  {RANGED.name}: 50 %, bearing 5 % to 30 %"]),
    (
        SLOW_FIELD,
        ["  ramp_s: 0 to 0.0005, each start", "  coulomb_ratio: 0.3 to 0.4, each motor", "  adc_bits = 12"],
    ),
    (load_recipe("operation"), ["  hold_s: 0.02 to 0.1, log-uniform, each start"]),
]


@pytest.mark.parametrize(("recipe", "lines"), DESCRIBED)
def test_a_recipe_is_described_in_its_units(recipe: Recipe, lines: list[str]) -> None:
    """Numbers as docs/recipes.md gives them: shares in per cent, the rest in SI."""
    assert [line for line in lines if line not in describe(recipe).splitlines()] == []


def test_a_sheet_shows_the_starts_of_each_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    recipe = replace(BENCH, classes=BENCH.classes[:2])
    draw_sheet(recipe, 3, tmp_path / "sheet.png")
    data = generate_arrays(recipe, 3, 160)
    for axis, name in zip(drawn[0].axes, recipe.class_names, strict=False):
        shown = [np.asarray(line.get_ydata()) for line in axis.get_lines()]
        np.testing.assert_allclose(shown, data.X[data.class_name == name][:4, 0])
