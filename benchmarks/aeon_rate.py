"""How fast a peer of aeon judges: answers one measurement for each line on its standard input.

`python aeon_rate.py CASES.npz METHOD` in aeon's environment, for bench_classifiers.py.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from aeon_peers import make_peer


def main() -> None:
    """Train, say `ready`, then one rate (starts a second) for each line."""
    source, name = sys.argv[1:]
    with np.load(source) as held:
        train, labels, test = (held[part] for part in ("train_X", "train_class_index", "test_X"))
    model = make_peer(name).fit(train, labels)
    model.predict_proba(test)  # compiles
    print("ready", flush=True)
    for _ in sys.stdin:
        begin = time.perf_counter()
        model.predict_proba(test)
        print(len(test) / (time.perf_counter() - begin), flush=True)


if __name__ == "__main__":
    main()
