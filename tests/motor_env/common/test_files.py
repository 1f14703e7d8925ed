"""What strangers give as a file is a regular file of a stated size, whoever reads it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hostile import deep, odd_places, refused

from motor_env import InputError, load_motor, load_recipe
from motor_env.common.files import filling, read_file, read_json, require_own_output


@pytest.mark.timeout(20)
@pytest.mark.parametrize("read", [partial(read_file, largest_bytes=100), load_motor, load_recipe])
def test_only_regular_files_are_opened(
    read: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "open", None)
    for path in odd_places(tmp_path / "a.toml"):
        if path.suffix == ".toml":
            assert "is no regular file" in refused(partial(read, path), path)


def test_a_file_is_as_large_as_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a"
    assert refused(partial(read_file, path, 3, "no such thing"), path) == f"{path}: no such thing"
    path.write_bytes(b"abc")
    assert read_file(path, 3) == b"abc"
    assert refused(partial(read_file, path, 2), path) == f"{path}: is larger than 2e-06 MB"
    path.write_bytes(b"")
    assert read_file(path, 0) == b""
    assert "cannot be read (" in refused(partial(read_file, Path("a\0b"), 3), path, named=False)
    assert read_file(Path("/proc/self/status"), 3) == b""  # made up while it is read


def test_what_is_made_in_a_folder_appears_there_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "out"

    def made(*names: str) -> None:
        with filling(folder) as unfinished:
            for name in names:
                path = unfinished / name
                path.parent.mkdir(exist_ok=True)
                path.write_text(name)
                assert not (folder / name).exists() or (folder / name).read_text() == "old"

    made("a", "inner/b")
    (folder / "a").write_text("old")
    (folder / "own").write_text("old")
    made("a", "inner/c", "more/d")
    there = {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}
    assert there == {name: name for name in ("a", "inner/b", "inner/c", "more/d")} | {"own": "old"}
    new = tmp_path / "new"
    with pytest.raises(ZeroDivisionError), filling(new) as unfinished:
        (unfinished / "a").write_text(str(1 / 0))
    assert not new.exists()
    (folder / "a").unlink()
    (folder / "a" / "x").mkdir(parents=True)
    with pytest.raises(InputError, match="out: cannot be written"):
        made("a")
    assert [path for path in folder.iterdir() if path.name.startswith(".")] == []


def test_json_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text, reason in ((deep(), "nested too deep"), ("", "Expecting value"), ("9" * 5000, "digits")):
        path.write_text(text)
        assert reason in refused(partial(read_json, path, 10**6), path)
    path.write_text('{"a": [1]}', encoding="utf-16")
    assert read_json(path, 10**6) == {"a": [1]}


def test_a_folder_of_others_is_refused(tmp_path: Path) -> None:
    ours = partial(require_own_output, command="make-it")
    ours(tmp_path / "new", "a.json", "mark")
    ours(tmp_path, "a.json", "mark")
    path = tmp_path / "a.json"
    path.write_text("another's")
    sentence = refused(lambda: ours(tmp_path, "a.json", "mark"), tmp_path)
    assert sentence.endswith("make-it did not make it; give a new or empty folder")
    refused(lambda: ours(path, "a.json", "mark"), path)
    path.write_text("with a mark")
    ours(tmp_path, "a.json", "mark")
