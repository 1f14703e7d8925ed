"""The detectors of PyOD beside the core of a fleet: power at equal false alarms, on fitted numbers and on raw currents.

.venv-bench/bin/python benchmarks/fleet_peers.py --fleets 40

Each detector learns from a fleet of which some are sick, and scores fresh motors. Its threshold is the one at which 1
in 100 of fresh healthy motors alarms: better than it could know.
"""

from collections.abc import Iterator

import numpy as np
from cyclopts import run
from fleet import CENTRE, ERROR, core_of, drawn, log
from pyod.models.copod import COPOD
from pyod.models.ecod import ECOD
from pyod.models.hbos import HBOS
from pyod.models.iforest import IForest
from pyod.models.knn import KNN
from pyod.models.lof import LOF
from pyod.models.mcd import MCD
from pyod.models.ocsvm import OCSVM
from pyod.models.pca import PCA
from scipy.special import stdtr
from tables import keep_table

from motor_env.diagnosis.hypotheses import EXPONENTS, Difference, explain
from motor_env.motor.parameters import FloatArray

SIZE, SICK = 30, 0.1
HEALTHY, SICK_JUDGED = 200, 20
FAULTS = {
    "friction x 2": np.array([0.0, 0.0, 0.0, np.log(2.0)]),
    "R +25 %": np.array([np.log(1.25), 0.0, 0.0, 0.0]),
    "K -10 %": np.array([0.0, np.log(0.9), 0.0, 0.0]),
}
DETECTORS = (COPOD, ECOD, HBOS, IForest, KNN, LOF, MCD, OCSVM, PCA)
BEST = 3


def ours(logs: FloatArray, fresh: FloatArray) -> FloatArray:
    """How odd fresh fits are to a fleet's: by the smallest p-value of the tests of a verdict, shape (n_fresh,)."""
    core = core_of(logs)
    spread, freedom = core.next_motor() + core.within + ERROR, core.degrees_of_freedom

    def oddity(off: FloatArray) -> float:
        difference = Difference(off, spread, EXPONENTS, freedom)
        whole = difference.p_value(difference.squared_distance, len(off))
        return -float(np.log(min(whole, *(stdtr(freedom, -fault.z) for fault in explain(difference)))))

    return np.array([oddity(one - core.centres[0]) for one in fresh])


def currents(rng: np.random.Generator, logs: FloatArray) -> FloatArray:
    """What a current's sensor shows of motors whose fits lie so far from the fleet's centre, shape (n, n_samples)."""
    return np.stack([log(rng, np.exp(one - CENTRE))["current_a"].to_numpy() for one in logs])


def powers(fleets: int, *, raw: bool) -> Iterator[tuple[str, list[float]]]:
    """Share of each fault that is found, by method."""
    found: dict[str, list[list[float]]] = {}
    for seed in range(fleets):
        rng = np.random.default_rng([seed, int(raw)])
        logs = drawn(rng, SIZE)
        for n in range(round(SICK * SIZE)):
            logs[n] += list(FAULTS.values())[n % len(FAULTS)]
        fresh = [drawn(rng, HEALTHY), *(drawn(rng, SICK_JUDGED) + moves for moves in FAULTS.values())]
        scores = {"this package": [ours(logs, each) for each in fresh]}
        seen, judged = (
            (currents(rng, logs), [currents(rng, each) for each in fresh]) if raw else (logs, fresh)
        )
        # Detectors by distance need one scale; that of numbers is their own median deviation.
        scale = 1.0 if raw else np.median(np.abs(logs - np.median(logs, axis=0)), axis=0)
        for make in (
            DETECTORS if not raw else [one for one in DETECTORS if one is not MCD]
        ):  # as many samples as that
            detector = make().fit(seen / scale)
            scores[make.__name__] = [detector.decision_function(each / scale) for each in judged]
        for name, (healthy, *sick) in scores.items():
            limit = np.quantile(healthy, 0.99)
            found.setdefault(name, []).append([float(np.mean(each > limit)) for each in sick])
    for name, shares in found.items():
        yield name, np.mean(shares, axis=0).tolist()


def main(*, fleets: int = 40) -> None:
    """Keep the table of docs/fleet.md.

    Args:
        fleets: number of them, for either kind of input.
    """
    rows = []
    for raw, words in ((False, "fitted numbers"), (True, "raw currents")):
        own, *others = powers(fleets, raw=raw)
        others.sort(key=lambda row: -sum(row[1]))
        for name, shares in [own, *others[:BEST]] if not raw else others[:BEST]:
            rows.append([name, words, *(f"{share:.2f}" for share in shares)])
    keep_table("fleet", "peers", ["method", "learns from", *FAULTS], rows)


if __name__ == "__main__":
    run(main)
