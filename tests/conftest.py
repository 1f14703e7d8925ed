"""What every test runs under: one thread a process, no window, no network, the same examples each time.

Whole runs on several processes begin with compiling, each process its share: otherwise all would compile the same.
"""

import gc
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

# Before NumPy and torch are imported: workers of pytest-xdist share the cores.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from motor_env.common import console  # noqa: E402

console.PATIENCE_S = 1e6  # what is printed does not depend on how busy the machine is

# HYPOTHESIS_PROFILE=explore looks for new examples; the default repeats the same ones everywhere.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

MANY_TESTS = 500
"""Fewer need little of what could be compiled before them."""

KEPT = "motor_env/compiled"
"""Place in pytest's cache of what is compiled."""


COMPILING: list[float] = []
"""Seconds, of this process and of the workers that have told it theirs."""


def listen() -> None:
    """From now on add up what compiling takes; a function compiled on the way to another counts once."""
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]  # numba carries no types
        def __init__(self) -> None:
            self.begins: list[float] = []

        def on_start(self, event: event.Event) -> None:
            self.begins.append(time.perf_counter())

        def on_end(self, event: event.Event) -> None:
            begin = self.begins.pop()
            if not self.begins:
                COMPILING.append(time.perf_counter() - begin)

    event.register("numba:compile", Listener())


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is imported and collected stays to the end: no search for garbage goes through it."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The tests of documentation and packaging begin: they take longest, and nobody should wait for them at the end."""
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent)


def compile_share(config: pytest.Config) -> None:
    """Compile what no other process of this run has begun: the parts of `motor-env warm-up`."""
    # Reaches in: what is compiled beforehand is what `motor-env warm-up` compiles, part by part.
    from motor_env.apps.warming import PARTS, warm_up

    begun = config._tmp_path_factory.getbasetemp().parent / "compiling"  # type: ignore[attr-defined]  # of all processes
    begun.mkdir(exist_ok=True)
    for part in PARTS:
        with suppress(FileExistsError):
            (begun / part).mkdir()
            warm_up([part])


def version() -> dict[str, Any]:
    """What the compiled code was made of, and where it is; no files where numba keeps it elsewhere."""
    package = Path(__file__).parents[1] / "motor_env"
    sources = b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))
    return {
        "sources": hashlib.sha256(sources).hexdigest(),
        "files": sorted(str(path) for path in package.rglob("*.nbi")),
    }


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist waits until each process has told it its tests
def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile before the first test, where that has not been done in an earlier run."""
    listen()
    if not hasattr(session.config, "workerinput") or len(session.items) < MANY_TESTS:
        return
    kept, now = session.config.cache.get(KEPT, {}), version()
    if kept.get("sources") != now["sources"] or not set(kept["files"]) <= set(now["files"]):
        compile_share(session.config)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A worker tells what it has spent, and writes down that all is compiled, unless something ended it before."""
    if (output := getattr(session.config, "workeroutput", None)) is not None:
        output["compiling_s"] = sum(COMPILING)
        is_whole = exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED)
        if is_whole and len(session.items) >= MANY_TESTS and (now := version())["files"]:
            session.config.cache.set(KEPT, now)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """A worker of pytest-xdist has ended."""
    COMPILING.append(getattr(node, "workeroutput", {}).get("compiling_s", 0.0))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How long the processes have compiled, those aside that tests started."""
    terminalreporter.write_line(f"compiling took {sum(COMPILING):.1f} s, the processes of the tests together")
