"""What strangers give as a file is a regular file of a stated size, whoever reads it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hostile import odd_places, refused

from motor_env import load_motor, load_recipe
from motor_env.files import read_file


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
