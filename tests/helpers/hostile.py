"""Hostile files, and the one check of what becomes of them: they are refused in one sentence, or read the same.

Damage is what disks and networks do to bytes. Forgery is what a stranger does who knows the format: a whole file that
says something else. Both follow from the generator that is handed in.
"""

from __future__ import annotations

import copy
import io
import json
import os
import pickle
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from motor_env import InputError

# Reaches in: a forged value stands in its file as the library itself would write it.
from motor_env.motor.toml_files import toml_text

T = TypeVar("T")
Random = np.random.Generator
LONGEST_SENTENCE = 1500
MOST_KB = 2_000_000  # of memory, whatever is read


def _set(data: bytearray, at: int, size: int, content: bytes | bytearray) -> None:
    data[at : at + size] = content


DAMAGES: dict[str, Callable[[bytearray, int, int, Random], None]] = {
    "flipped": lambda data, at, _, rng: _set(data, at, 1, bytes([data[at] ^ 1 << int(rng.integers(8))])),
    "overwritten": lambda data, at, size, rng: _set(data, at, size, rng.bytes(min(size, len(data) - at))),
    "zeroed": lambda data, at, size, _: _set(data, at, size, bytes(min(size, len(data) - at))),
    "cut out": lambda data, at, size, _: _set(data, at, size, b""),
    "doubled": lambda data, at, size, _: _set(data, at, 0, data[at : at + size]),
    "put in": lambda data, at, size, rng: _set(data, at, 0, rng.bytes(size)),
    "moved": lambda data, at, size, rng: _set(data, int(rng.integers(len(data))), size, data[at : at + size]),
    "cut off": lambda data, at, _, __: _set(data, at, len(data), b""),
}


def damaged(
    content: bytes,
    rng: Random,
    *,
    most: int = 1,
    kinds: Sequence[str] = tuple(DAMAGES),
    focus: range | None = None,
) -> bytes:
    """The content after one to `most` damages; half of them begin in the focus, if there is one."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, most + 1))):
        if not data:
            break
        places = focus if focus is not None and rng.random() < 0.5 else range(len(data))
        at = min(int(rng.integers(places.start, places.stop)), len(data) - 1)
        DAMAGES[kinds[int(rng.integers(len(kinds)))]](data, at, int(rng.integers(1, 64)), rng)
    return bytes(data)


def flips(content: bytes, rng: Random, count: int, *, within: range | None = None) -> Iterator[bytes]:
    """The content with one flipped bit, at random places."""
    places = within or range(len(content))
    for at in rng.integers(places.start, places.stop, size=count):
        data = bytearray(content)
        DAMAGES["flipped"](data, int(at), 1, rng)
        yield bytes(data)


def cuts(content: bytes, count: int) -> Iterator[bytes]:
    """The content cut off at places even along it, the first of them its begin."""
    return (content[:end] for end in np.linspace(0, len(content) - 1, count).astype(int))


DEEP = "a deep list"
ABSURD: tuple[Any, ...] = (
    0, 1, -1, -5, 7, 2**31, 2**64, -(2**63), 10**21, 10**400, True, False, None,
    0.0, -0.0, 0.5, 1.5, -1.0, 1e-310, 1e-30, 1e12, 1e20, 1e39, 1e300, -1e300, 1e308, float("nan"), float("inf"),
    "", "1", "bench", "healthy", "../x", "/dev/zero", "a\nb", "\x00", "\ud800", "x" * 5000,
    [], [[]], [1.0], [2.0, 1.0], [[1.0], [1.0, 2.0]], [1e300, 1e300], [0.0, 1e308], ["bench"], {}, {"a": 1}, [{}], DEEP,
)  # fmt: skip
"""What no field of a file expects, or few."""


def deep(depth: int = 100_000) -> str:
    """Lists within lists, as JSON and as TOML."""
    return "[" * depth + "]" * depth


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Each table or list of a tree, and each key in it."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield node, key
        if isinstance(value, dict | list):
            yield from places(value)


def forged(tree: Any, rng: Random, *, absurd: Sequence[Any] = ABSURD, most: int = 1) -> Any:
    """A tree of tables and lists with one to `most` values replaced, left out or added.

    Half of what is replaced keeps its kind, and some numbers only their scale: not all is refused. A text that is JSON
    itself stays JSON.
    """
    out = copy.deepcopy(tree)
    for _ in range(int(rng.integers(1, most + 1))):
        found = list(places(out))
        node, key = found[int(rng.integers(len(found)))]
        kind = _kind(node[key])
        like = [value for value in absurd if _kind(value) is kind] if rng.random() < 0.5 else absurd
        value = copy.deepcopy(like[int(rng.integers(len(like)))])
        if kind is float and rng.random() < 0.4 and abs(node[key]) < 1e300:
            value = type(node[key])(node[key] * 10.0 ** rng.uniform(-2.0, 2.0))
        if kind is str and node[key][:1] in ("{", "["):
            value = json_of(value)
        match int(rng.integers(20)):
            case 0 | 1:
                del node[key]
            case 2 if isinstance(node, dict):
                node["strange"] = value
            case _:
                node[key] = value
    return out


def _kind(value: Any) -> type:
    return float if isinstance(value, int | float) and not isinstance(value, bool) else type(value)


def json_of(tree: Any) -> str:
    """As JSON."""
    return json.dumps(tree).replace(json.dumps(DEEP), deep())


def toml_of(content: dict[str, Any]) -> str:
    """As TOML, with inline tables."""
    return "".join(f"{key} = {_toml(value)}\n" for key, value in content.items()).replace(f'"{DEEP}"', deep())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return toml_text({"x": value}, {}).removeprefix("x = ").rstrip("\n")


def members_of(content: bytes) -> dict[str, bytes]:
    """Files in a zip archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def zip_bombs(members: dict[str, bytes], size: int) -> Iterator[tuple[str, bytes]]:
    """Archives with one more member of so many zeros, and the same with a smaller size stated, which is read first."""
    for name, method in (("deflated", zipfile.ZIP_DEFLATED), ("bzip2", zipfile.ZIP_BZIP2)):
        bomb = archive_of(members | {"zeros": bytes(size)}, method)
        yield name, bomb
        yield f"{name} lying", bomb.replace(size.to_bytes(4, "little"), (9).to_bytes(4, "little"))


class Poison:
    """What touches a mark as soon as it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return (Path.touch, (self.mark,))


def poison(mark: Path) -> bytes:
    """A pickle whose code touches a mark; no test may find the mark."""
    return pickle.dumps(Poison(mark))


def odd_places(path: Path) -> Iterator[Path]:
    """A path at which there is no regular file: a pipe, a folder, a link to what never ends, and that itself."""
    for make in (os.mkfifo, Path.mkdir, lambda at: at.symlink_to("/dev/zero")):
        path.unlink(missing_ok=True)
        make(path)
        yield path
        (path.rmdir if path.is_dir() else path.unlink)()
    yield Path("/dev/zero")


def _checked(sentence: str, path: Path, *, named: bool | str) -> str:
    """One line, not endless, no traceback; it names the file."""
    assert sentence
    assert "\n" not in sentence, sentence
    assert len(sentence) < LONGEST_SENTENCE
    assert "Traceback" not in sentence
    assert not named or (path.name if named is True else named) in sentence, sentence
    return sentence


def _beside(path: Path) -> dict[str, int]:
    """Files of the temporary folder that a path is in, and when they were written."""
    folder = path.absolute().parent
    if not folder.is_relative_to(tempfile.gettempdir()):
        return {}
    return {str(file): file.lstat().st_mtime_ns for file in folder.rglob("*") if not file.is_dir()}


def refused(call: Callable[[], object], path: Path, *, named: bool | str = True) -> str:
    """The one sentence with which a file is refused by `InputError` or status 2; beside it nothing was written.

    The sentence names the file, or what `named` says instead.
    """
    before, out, err = _beside(path), io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = call()
        except InputError as error:
            sentence = str(error)
        else:
            assert status == 2, (status, out.getvalue(), err.getvalue())
            assert out.getvalue().strip() in ("", "[]")
            sentence = err.getvalue().removesuffix("\n")
    assert _beside(path) == before
    return _checked(sentence, path, named=named)


def refused_or_same(
    call: Callable[[], T],
    path: Path,
    same: Callable[[T], object] = lambda _: None,
    *,
    named: bool | str = True,
    error: type[ValueError] = InputError,
) -> str:
    """The sentence of the refusal; empty where the file was read and `same`, which asserts, was content."""
    try:
        found = call()
    except error as refusal:
        return _checked(str(refusal), path, named=named)
    same(found)
    return ""


_CHILD = """
import json, resource, signal, sys, warnings
from pathlib import Path
from motor_env.common.errors import InputError
warnings.simplefilter("ignore")
{read}
seconds, memory = {seconds}, {memory}
resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
for number, line in enumerate(sys.stdin):
    path = Path(json.loads(line))
    # The first file waits for what is imported late or compiled, and a busy machine for its processor.
    signal.setitimer(signal.ITIMER_PROF, seconds if number else 0)
    signal.alarm(6 * seconds)
    try:
        outcome = str(read(path))
    except InputError as error:
        sentence = str(error)
        outcome = "refused" if str(path) in sentence and chr(10) not in sentence else sentence
    except BaseException as error:
        outcome = f"{{type(error).__name__}}: {{error}}"
    signal.alarm(0)
    signal.setitimer(signal.ITIMER_PROF, 0)
    status = Path("/proc/self/status").read_text()  # ru_maxrss of a child begins with its parent's
    peak = int(status.split("VmHWM:")[1].split()[0])
    print(json.dumps([outcome, peak]), flush=True)
"""


class Child:
    """A process of its own that reads files with `read(path)`, since damage may crash compiled code or hang it.

    A file may take so many seconds of a processor, and the process so many bytes of data once it can read.
    """

    def __init__(self, read: str, seconds: int = 60, memory: int = -1) -> None:
        self.code = _CHILD.format(read=read, seconds=seconds, memory=memory)
        self._start()

    def _start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", self.code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def outcome(self, path: Path) -> str:
        """`refused` where it is one sentence that names the file, what `read` said, or what went wrong."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(str(path)), file=self.process.stdin, flush=True)
        told = self.process.stdout.readline()
        if not told:
            with self.process:
                ended = self.process.wait()
            self._start()
            return f"it ended its process with {ended}"
        outcome, peak_kb = json.loads(told)
        assert peak_kb < MOST_KB, path.name
        return str(outcome)

    def outcomes(self, files: Iterable[tuple[str, bytes]], folder: Path) -> dict[str, str]:
        """The same for contents by name, each written into the folder before it is read."""
        found = {}
        for name, content in files:
            (folder / name).write_bytes(content)
            found[name] = self.outcome(folder / name)
            (folder / name).unlink()
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()
