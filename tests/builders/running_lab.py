"""A running lab, and starts to hand in, for the tests of its server and of its page."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from recording_csv import write_csv

# Reaches in: the lab is served from a thread of the tests.
from motor_env.apps import lab
from motor_env.apps.lab_server import address, make_server


@contextmanager
def running_lab() -> Iterator[str]:
    """Yields its address."""
    with make_server() as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield address(running)
        running.shutdown()
        thread.join()


def write_start(path: Path, kind: str, seed: int = 1) -> Path:
    """A CSV file of a simulated start."""
    start = lab.simulate_start(lab.Settings(kind=kind, noise_ma=5.0, seed=seed))
    current, voltage = start.measurements[0, 0], start.voltage_v[0]
    columns = {"time_s": start.time_s, "current_a": current, "voltage_v": voltage}
    return write_csv(path, columns, form=".6f")
