"""The variants of the filter on the paper's faults: `python benchmarks/compare_filters.py --cases 600`.

All see the same transients of the recipe `paper` (noise alone, the five classes equally likely) and decide by the
likelihood of the class, or by the estimate nearest to a class in its own covariance. Prints a Markdown table.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from motor_env.confirmation import class_filter, nominal_voltage
from motor_env.joint import JointKind, JointResult, joint_filter
from motor_env.kalman import KalmanFilter, run_filter, schedule
from motor_env.parameters import FloatArray
from motor_env.recipes import Recipe, draw, named_recipe
from motor_env.simulation import simulate

IntArray = NDArray[np.int64]


def bank(
    filters: list[KalmanFilter], measured: FloatArray, voltage: FloatArray, *, adaptive: bool
) -> IntArray:
    """Class of the most likely filter; an adaptive one takes the variance that its innovations have (Mehra 1970)."""
    scores = []
    for belief in filters:
        result = run_filter(belief, measured, voltage)
        mean_square = result.nis.mean(axis=1)
        scores.append(-0.5 * measured.shape[-1] * np.log(mean_square) if adaptive else result.log_likelihood)
    best: IntArray = np.argmax(scores, axis=0)
    return best


def held(belief: KalmanFilter) -> KalmanFilter:
    """The filter with its converged gain from the first sample on."""
    converged = schedule(belief, 200_000).covariance[-1]
    return replace(belief, initial_covariance=converged)


def noisy(belief: KalmanFilter, std: tuple[float, float]) -> KalmanFilter:
    """The filter with other process noise."""
    return replace(belief, process_covariance=np.diag(np.square(std)))


def nearest(recipe: Recipe, result: JointResult) -> IntArray:
    """Class whose log factors (R, B) are nearest to the estimate in its covariance."""
    wanted = np.log(
        [
            [
                1.0 + (c.severity if str(c.kind) == "winding_contact" else 0.0),
                1.0 + (c.severity if str(c.kind) == "bearing" else 0.0),
            ]
            for c in recipe.classes
        ]
    )
    off = result.log_factor[:, -1, None] - wanted
    weighted = np.einsum("nci,nij,ncj->nc", off, np.linalg.inv(result.covariance[:, -1]), off)
    best: IntArray = np.argmin(weighted, axis=1)
    return best


def row(name: str, found: IntArray, labels: IntArray, result: JointResult | None = None) -> str:
    """One line of the table: alarms on healthy, faults found, right class, with 95 % intervals."""

    def share(hits: NDArray[np.bool_]) -> str:
        interval = binomtest(int(hits.sum()), len(hits)).proportion_ci(method="wilson")
        return f"{100 * hits.mean():.1f} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"

    cells = [name, share(found[labels == 0] != 0), share(found[labels > 0] != 0), share(found == labels)]
    if result is None:
        cells.append("")
    else:
        spread = np.sqrt([result.log_factor[labels == c, -1].var(axis=0) for c in range(5)]).mean(axis=0)
        cells.append(f"{100 * spread[0]:.2f}, {100 * spread[1]:.1f}")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Draw, filter, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=600)
    cases = parser.parse_args().cases
    recipe = named_recipe("paper")
    drawn = draw(recipe, 5, range(cases))
    measured = simulate(drawn.scenario, 5, drawn.cases).measurements
    voltage, labels = nominal_voltage(recipe), drawn.class_index
    filters = [class_filter(recipe, c) for c in recipe.classes]
    print("| filter | healthy called faulty, % | faults found, % | right class, % | sd of R, B, % |")
    print("|---|---|---|---|---|")
    print(row("bank of linear filters", bank(filters, measured, voltage, adaptive=False), labels))
    steady = [held(f) for f in filters]
    print(row("the same, converged gain", bank(steady, measured, voltage, adaptive=False), labels))
    print(row("the same, noise adapted", bank(filters, measured, voltage, adaptive=True), labels))
    loud = [noisy(f, (1e-2, 0.316)) for f in filters]
    print(row("the same, Q = diag(1e-4, 0.1)", bank(loud, measured, voltage, adaptive=False), labels))
    for kind in JointKind:
        result = joint_filter(recipe.motor, recipe.sensor, recipe.timing.dt_s, measured, voltage, kind=kind)
        print(row(f"joint, {kind}", nearest(recipe, result), labels, result))


if __name__ == "__main__":
    main()
