"""The variants of the filter on the paper's faults: `python benchmarks/compare_filters.py --cases 2000`.

Prints two Markdown tables. In the first, each variant says which class a transient of the recipe `paper` is (noise
alone, the five classes equally likely): by the likelihood of a bank of filters, or by the estimate of (R, B) nearest to
a class in its own covariance. All variants see the same transients. The second shows how process noise absorbs a
bearing fault of 10 %: how far the whitened innovations move, and what a two-sided CUSUM on them finds at the threshold
that 1 % of healthy transients pass.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from cyclopts import run
from numpy.typing import NDArray
from scipy.stats import binomtest
from tables import keep_table

from motor_classifiers.estimators.confirmation import class_filter
from motor_env.detection.rules.cusum import Cusum
from motor_env.filters.adaptive import MEMORY, AdaptiveResult, JointKind, adaptive_filter, joint_filter
from motor_env.filters.batch import FilterResult, run_filter
from motor_env.filters.consistency import check_consistency
from motor_env.filters.kalman import KalmanFilter, schedule
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.sampling import draw
from motor_env.simulation.simulate import simulate, simulate_states

IntArray = NDArray[np.int64]
LARGE_Q = (1e-2, 0.316)
RECIPE = named_recipe("paper")
KINDS = np.array([0, 1, 1, 2, 2])
"""Kinds of the recipe's classes: healthy, bearing, winding; checked in `main`."""

WATCH = Cusum(shift=0.13, two_sided=True)
"""The shift of a bearing fault of 10 % at 20 mA, to either side."""


Filter = Callable[[KalmanFilter, FloatArray, FloatArray], FilterResult | AdaptiveResult]


def converged(belief: KalmanFilter, measured: FloatArray, voltage: FloatArray) -> FilterResult:
    """The filter with its converged gain from the first sample on."""
    covariance = schedule(belief, 200_000).covariance[-1]
    return run_filter(replace(belief, initial_covariance=covariance), measured, voltage)


def noisy(
    belief: KalmanFilter, measured: FloatArray, voltage: FloatArray, std: tuple[float, float] = LARGE_Q
) -> FilterResult:
    """The filter with other process noise."""
    return run_filter(replace(belief, process_covariance=np.diag(np.square(std))), measured, voltage)


def bank(
    variant: Filter, measured: FloatArray, voltage: FloatArray, *, own_variance: bool = False
) -> IntArray:
    """Class of the most likely filter (Magill 1965); with the noise's variance of its own innovations (Mehra 1970)."""
    results = [variant(class_filter(RECIPE, c), measured, voltage) for c in RECIPE.classes]
    scores = [-np.log(each.nis.mean(axis=1)) if own_variance else each.log_likelihood for each in results]
    return np.asarray(np.argmax(scores, axis=0))


def wanted_factors(recipe: Recipe) -> FloatArray:
    """Factors on (R, B) of each class, shape (n_classes, 2)."""
    severity = np.array([c.severity if c.kind is not None else 0.0 for c in recipe.classes])
    factors: FloatArray = 1.0 + severity[:, None] * np.stack([KINDS == 2, KINDS == 1], axis=1)
    return factors


def nearest(kind: JointKind, memory: float | None, measured: FloatArray, voltage: FloatArray) -> IntArray:
    """Class nearest to the joint estimate of R and B, in its covariance."""
    given = (RECIPE.motor, RECIPE.sensor, RECIPE.timing.dt_s, measured, voltage)
    result = joint_filter(*given, kind=kind, memory=memory)
    off = result.theta[:, -1, None] - np.log(wanted_factors(RECIPE))
    weighted = np.einsum("nci,nij,ncj->nc", off, np.linalg.inv(result.covariance[:, -1]), off)
    return np.asarray(np.argmin(weighted, axis=1))


def watch(variant: Filter, measured: FloatArray, voltage: FloatArray) -> FloatArray:
    """Largest CUSUM of each transient on the whitened innovations of a healthy belief."""
    result = variant(class_filter(RECIPE, RECIPE.classes[0]), measured, voltage)
    statistic: FloatArray = WATCH.statistic(result.whitened).max(axis=1)
    return statistic


def share(hits: NDArray[np.bool_]) -> str:
    """Percentage with its 95 % interval (Wilson 1927)."""
    interval = binomtest(int(hits.sum()), len(hits)).proportion_ci(method="wilson")
    return f"{100 * hits.mean():.1f} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def class_row(name: str, index: IntArray, labels: IntArray) -> list[str]:
    """One line of the first table."""
    faulty = labels > 0
    kinds = KINDS[index[faulty & (index > 0)]] == KINDS[labels[faulty & (index > 0)]]
    hits = (index[~faulty] != 0, index[faulty] != 0, kinds, index == labels)
    return [name, *(share(each) for each in hits)]


def noise_row(
    std: tuple[float, float], healthy: FloatArray, faulty: FloatArray, voltage: FloatArray
) -> list[str]:
    """One line of the second table."""
    motor = apply_faults(RECIPE.motor, RECIPE.classes[1].faults)
    variant = partial(noisy, std=std)
    belief = class_filter(RECIPE, RECIPE.classes[0])
    other = replace(belief, process_covariance=np.diag(np.square(std)))
    states = simulate_states(motor, voltage, RECIPE.timing.dt_s)
    signature = run_filter(
        other, other.observation @ states.T, voltage
    ).whitened  # without noise (Turin 1960)
    separation = float(np.linalg.norm(signature))
    squares = check_consistency(variant(belief, healthy, voltage).whitened).mean_square
    alarms = watch(variant, faulty, voltage) > np.quantile(watch(variant, healthy, voltage), 0.99)
    return [f"{std[0]:g} A, {std[1]:g} rad/s", f"{squares:.2f}", f"{separation:.2f}", share(alarms)]


def main(*, cases: int = 2000) -> None:
    """Compare the variants of the filter on the paper's faults, over so many transients."""
    names = [str(c.kind) for c in RECIPE.classes]
    assert names == ["None", "bearing", "bearing", "winding_contact", "winding_contact"], names
    drawn = draw(RECIPE, 5, range(cases))
    measured = simulate(drawn.scenario, 5, drawn.cases).measurements
    voltage, labels = RECIPE.nominal_voltage_v, drawn.class_index
    healthy_case = draw(RECIPE, 6, range(5 * cases))
    healthy = simulate(healthy_case.scenario, 6, healthy_case.cases).measurements[
        healthy_case.class_index == 0
    ]

    joints = {
        "joint, extended": (JointKind.EXTENDED, None),
        "joint, unscented": (JointKind.UNSCENTED, None),
        "joint, extended, noise adapted": (JointKind.EXTENDED, MEMORY),
    }
    variants: dict[str, Filter] = {
        "linear": run_filter,
        "linear, converged gain": converged,
        "linear, Q = diag(1e-4, 0.1)": noisy,
        "linear, noise adapted": adaptive_filter,
    }
    banks: dict[str, Callable[[FloatArray, FloatArray], IntArray]] = {
        **{name: partial(bank, variant) for name, variant in variants.items()},
        "linear, one variance a transient": partial(bank, run_filter, own_variance=True),
        **{name: partial(nearest, *which) for name, which in joints.items()},
    }
    keep_table(
        "detection",
        "filters: classes",
        ("filter", "healthy called faulty", "faults found", "right kind", "right class"),
        (class_row(name, decide(measured, voltage), labels) for name, decide in banks.items()),
    )
    stds = ((0.0, 0.0), (1e-5, 1e-3), (1e-3, 3e-2), (3e-3, 1e-1), LARGE_Q)
    keep_table(
        "detection",
        "process noise",
        ("process noise", "mean NIS, healthy", "d' of B +10 %", "CUSUM finds"),
        (noise_row(std, healthy, measured[labels == 1], voltage) for std in stds),
    )


if __name__ == "__main__":
    run(main)
