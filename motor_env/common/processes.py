"""Worker processes that do not outlive the process that asked for their work."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time


def end_with_parent() -> None:
    """For the start of a worker: it ends when its parent ends, however that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        sentinel: int | None = getattr(parent, "sentinel", None)

        def watch() -> None:
            # Workers of joblib have no sentinel to wait for, and their parent may be gone already; those of a fork
            # server have another process above them.
            while sentinel is None and os.getppid() == parent.pid:
                time.sleep(0.2)
            if sentinel is not None:
                parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
