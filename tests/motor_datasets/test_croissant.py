"""What a data set says of itself: Croissant, card, columns with units, counts that add up, one line in the shell."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from motor_datasets import generate_arrays, generate_dataset, load, to_torch, to_torch_iterable
from motor_datasets.arrays import columns
from motor_datasets.cli import main
from motor_env import load_recipe

FIELD = load_recipe("field", timing=replace(load_recipe("field").timing, sampling_rate_hz=1_000.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("croissant") / "data"
    generate_dataset(FIELD, 100, 1, out)
    return out


def test_columns_are_those_of_the_files(folder: Path) -> None:
    for path in (folder / "data").iterdir():
        schema = pq.read_schema(path)
        assert schema.names == [column.name for column in columns(FIELD)]
        for column in columns(FIELD):
            unit = column.name.rpartition("_")[2] if "_per_" not in column.name else ""
            assert column.unit == {"v": "V", "s": "s", "k": "K", "ohm": "ohm", "a": "A"}.get(
                unit, column.unit
            )


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib and pandas, in mlcroissant
def test_mlcroissant_validates_it_and_reads_its_records(folder: Path) -> None:
    import mlcroissant

    described = mlcroissant.Dataset(jsonld=folder / "croissant.json")
    assert not described.metadata.ctx.issues.errors
    (advice,) = described.metadata.ctx.issues.warnings
    assert "datePublished" in advice  # left out: the same seed gives the same bytes
    records, starts = list(described.records("train-000000")), load(folder, "train")
    assert [each["train-000000/class_name"].decode() for each in records] == starts.class_name.tolist()
    np.testing.assert_array_equal([each["train-000000/current_a"] for each in records], starts.X[:, 0])


def test_croissant_has_every_file_and_its_digest(folder: Path) -> None:
    content: dict[str, Any] = json.loads((folder / "croissant.json").read_bytes())
    entries = {
        entry["path"]: entry["sha256"]
        for entry in json.loads((folder / "dataset.json").read_bytes())["files"]
    }
    assert {file["@id"]: file["sha256"] for file in content["distribution"]} == entries
    assert len(content["recordSet"]) == len(entries)
    for record in content["recordSet"]:
        assert [field["source"]["extract"]["column"] for field in record["field"]] == [
            c.name for c in columns(FIELD)
        ]


def test_cases_add_up_where_there_are_shifts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["generate", "field", "--cases", "100", "--seed", "1", "--sampling-rate-hz", "1000"]
    assert main([*command, "--out", str(tmp_path / "dry"), "--dry-run"]) == 0
    assert "would write 100 cases and 50 of shifts of" in capsys.readouterr().out
    assert main([*command, "--out", str(tmp_path / "data"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["cases"], summary["cases_of_shifts"]) == (100, 50)
    assert main(["describe", str(tmp_path / "data")]) == 0
    assert "  current_a [A]: measured current, " in capsys.readouterr().out


def test_severity_is_single_precision_in_torch() -> None:
    starts = generate_arrays(FIELD, 1, range(4))
    assert to_torch(starts).tensors[2].dtype is torch.float32
    batch = next(iter(to_torch_iterable(FIELD, 1, batch_size=4)))
    assert batch[2].dtype is torch.float32


def test_a_data_set_is_one_line_in_the_shell() -> None:
    assert repr(generate_arrays(FIELD, 1, range(4))) == "<Dataset of recipe field, seed 1: X (4, 1, 120)>"
