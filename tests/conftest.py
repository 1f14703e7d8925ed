"""What every test runs under: one thread a process, no window, no network, the same examples each time.

Whole runs on several processes begin with compiling, each process its share: otherwise all would compile the same.
"""

import os
import time
from pathlib import Path
from typing import Any

# Before NumPy and torch are imported: workers of pytest-xdist share the cores.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# HYPOTHESIS_PROFILE=explore looks for new examples; the default repeats the same ones everywhere.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

MANY_TESTS = 500
"""Fewer need little of what could be compiled before them."""


COMPILING: list[float] = []
"""Seconds, of this process and of the workers that have told it theirs."""


def listen() -> None:
    """From now on add up what compiling takes; a function compiled on the way to another counts once."""
    from numba.core import event

    class Listener(event.Listener):
        def __init__(self) -> None:
            self.begins: list[float] = []

        def on_start(self, event: event.Event) -> None:
            self.begins.append(time.perf_counter())

        def on_end(self, event: event.Event) -> None:
            begin = self.begins.pop()
            if not self.begins:
                COMPILING.append(time.perf_counter() - begin)

    event.register("numba:compile", Listener())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The tests of documentation and packaging begin: they take longest, and nobody should wait for them at the end."""
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist waits until each process has told it its tests
def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile this process's share."""
    listen()
    worker = getattr(session.config, "workerinput", None)
    if worker is None or len(session.items) < MANY_TESTS:
        return
    from motor_env.apps.warming import PARTS, warm_up

    warm_up(PARTS[int(worker["workerid"][2:]) :: worker["workercount"]])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker tells what it has spent."""
    if (output := getattr(session.config, "workeroutput", None)) is not None:
        output["compiling_s"] = sum(COMPILING)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """A worker of pytest-xdist has ended."""
    COMPILING.append(getattr(node, "workeroutput", {}).get("compiling_s", 0.0))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How long the processes have compiled, those aside that tests started."""
    terminalreporter.write_line(f"compiling took {sum(COMPILING):.1f} s, the processes of the tests together")
