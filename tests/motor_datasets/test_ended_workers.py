"""A generation that is ended leaves no worker and, where it is asked to end, no half written file."""

import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest
from small_sets import SMALL_SHARDS


def with_mark(mark: str) -> list[int]:
    """Processes that have this in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    mark = uuid.uuid4().hex
    command = [sys.executable, "-c", SMALL_SHARDS, "generate", "bench", "--cases", "200000", "--seed", "3"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "set"), "--workers", "2"],
        env={**os.environ, "MARK_OF_THIS_TEST": mark},
        stderr=subprocess.PIPE,
    )
    until = time.monotonic() + 90.0
    while len(list((tmp_path / "set/data").glob("[!.]*.parquet"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    assert len(with_mark(mark)) >= 3
    process.send_signal(number)
    _, said = process.communicate(timeout=60)  # would wait for all that hold the pipe
    until = time.monotonic() + 30.0
    while with_mark(mark) and time.monotonic() < until:
        time.sleep(0.05)
    assert with_mark(mark) == []
    if number == signal.SIGTERM:
        assert process.returncode == 128 + signal.SIGTERM
        assert b"Traceback" not in said
        assert list((tmp_path / "set").rglob(".*.partial")) == []
