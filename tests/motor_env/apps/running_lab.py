"""A running lab, and starts to hand in, for the tests of its server and of its page."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    start = lab.start_of(lab.Settings(kind=kind, noise_ma=5.0, seed=seed))
    rows = zip(start.time_s, start.measurements[0, 0], start.voltage_v[0], strict=True)
    text = "\n".join(["time_s,current_a,voltage_v", *(f"{t:.6f},{i:.6f},{v:g}" for t, i, v in rows)])
    path.write_text(text + "\n")
    return path
