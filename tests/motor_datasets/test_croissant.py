"""What a data set says of itself: Croissant, card, columns with units, counts that add up, one line in the shell."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import torch

from motor_datasets import generate_arrays, generate_dataset, to_torch, to_torch_iterable
from motor_datasets.arrays import columns
from motor_datasets.cli import main
from motor_env import load_recipe

REQUIRED = ("@context", "@type", "conformsTo", "name", "description", "license", "distribution", "recordSet")
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


def test_croissant_has_what_version_1_asks_for(folder: Path) -> None:
    """The fields that its specification requires; mlcroissant 1.1.1 validated such a file and read its records."""
    content: dict[str, Any] = json.loads((folder / "croissant.json").read_bytes())
    for name in REQUIRED:
        assert content[name], name
    assert content["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    entries = {entry["path"]: entry for entry in json.loads((folder / "dataset.json").read_bytes())["files"]}
    files = {file["@id"]: file for file in content["distribution"]}
    assert set(files) == set(entries)
    for path, file in files.items():
        assert (file["@type"], file["encodingFormat"]) == ("cr:FileObject", "application/x-parquet")
        assert file["sha256"] == entries[path]["sha256"]
        assert (folder / file["contentUrl"]).is_file()
    identifiers = [record["@id"] for record in content["recordSet"]]
    for record in content["recordSet"]:
        assert [field["source"]["extract"]["column"] for field in record["field"]] == [
            c.name for c in columns(FIELD)
        ]
        assert {field["source"]["fileObject"]["@id"] for field in record["field"]} <= set(files)
        identifiers += [field["@id"] for field in record["field"]]
    assert len(set(identifiers)) == len(identifiers)


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
