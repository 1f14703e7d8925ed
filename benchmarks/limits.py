"""What can be known at best from the starts of a recipe: the tables of docs/best-possible.md.

`python benchmarks/limits.py [CASES]`: 20,000 cases, some seven minutes. Each figure is an average over the recipe's own
cases of what the exact posterior expects: no rule does better on average. The truth is drawn here, and only scored;
what decides gets the recipe, the samples and the nominal voltage.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from cyclopts import run
from numpy.typing import ArrayLike
from tables import keep_table

from motor_env.inference.fit import Prior, inverse_information
from motor_env.inference.posterior import SeverityPrior, class_probabilities, severity_posterior
from motor_env.inference.sensitivities import Coordinates, jacobian
from motor_env.inference.whitening import MatchedTest
from motor_env.motor.faults import Fault, FaultKind
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    Channel,
    FloatArray,
    MotorParameters,
    SensorParameters,
    require,
)
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipes import FaultClass, Recipe, Spread
from motor_env.simulation.sampling import draw
from motor_env.simulation.simulate import Timing, simulate

_CHUNK = 2000


def cramer_rao_bound(
    motor: MotorParameters,
    sensor: SensorParameters,
    timing: Timing,
    free: tuple[str, ...] = ("resistance", "friction"),
    prior_std: ArrayLike = np.inf,
) -> FloatArray:
    """Smallest covariance of unbiased estimates of relative values from a start at 12 V (Rao 1945; Cramer 1946).

    Args:
        motor: the motor.
        sensor: what is read.
        timing: time axis.
        free: quantities that are not known, of `QUANTITIES`; all others are.
        prior_std: relative standard deviation known beforehand of each, infinite for none; with one it is the Bayesian
            bound of van Trees (1968), linearised at the motor.

    Returns:
        Shape (n_free, n_free): sqrt of its diagonal is 0.01 for 1 %.

    Raises:
        ValueError: the samples leave a direction open.
    """
    _, slopes = jacobian(Coordinates.from_names(motor, free), timing.step(12.0), sensor, timing.dt_s)
    white = (slopes / sensor.noise_std[:, None, None]).reshape(-1, len(free))
    precision = Prior.from_std(np.broadcast_to(prior_std, len(free))).precision
    return inverse_information(white.T @ white + precision, free)


class Limit(NamedTuple):
    """The Bayes-optimal accuracy on given cases.

    Attributes:
        expected_accuracy: mean of the largest probabilities.
        standard_error: its standard error.
    """

    expected_accuracy: float
    standard_error: float


def bayes_limit(probabilities: FloatArray) -> Limit:
    """Best accuracy that any rule can have (Chow 1957), from posterior probabilities of drawn cases.

    The mean of the largest probability has half the standard error of counting hits, and needs no labels.

    Args:
        probabilities: shape (n_cases, n_classes), at least two cases.
    """
    largest = probabilities.max(axis=1)
    return Limit(float(largest.mean()), float(largest.std(ddof=1) / np.sqrt(len(largest))))


class SeverityLimit(NamedTuple):
    """The smallest error of a severity, for severities drawn uniformly from a range.

    Attributes:
        expected_rmse: root mean posterior variance.
        rmse: of the posterior mean on the drawn cases.
        coverage: share of the 90 % intervals that hold the severity.
    """

    expected_rmse: float
    rmse: float
    coverage: float


def chunks(n_cases: int) -> Iterator[np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Case numbers, as many at once as memory holds."""
    require(n_cases >= 2, f"n_cases must be >= 2, got {n_cases}")
    for begin in range(0, n_cases, _CHUNK):
        yield np.arange(begin, min(begin + _CHUNK, n_cases))


def class_limits(
    recipe: Recipe, seed: int, n_cases: int, samples_seen: Sequence[int] | None = None
) -> list[tuple[Limit, float]]:
    """Bayes-optimal accuracy from the first samples, and the share that the most probable class names rightly.

    Args:
        recipe: what the cases are drawn from.
        seed: the random seed.
        n_cases: cases 0 .. n_cases - 1 of that seed.
        samples_seen: numbers of samples, each giving one limit; all samples by default.
    """
    seen = samples_seen or [recipe.timing.n_samples]
    probabilities: list[list[FloatArray]] = [[] for _ in seen]
    labels = []
    for cases in chunks(n_cases):
        drawn = draw(recipe, seed, cases)
        measured = simulate(drawn.scenario, seed, cases).measurements
        labels.append(drawn.class_index)
        for column, count in zip(probabilities, seen, strict=True):
            column.append(class_probabilities(recipe, measured[..., :count]))
    truth = np.concatenate(labels)
    posteriors = [np.concatenate(column) for column in probabilities]
    return [(bayes_limit(each), float((each.argmax(axis=1) == truth).mean())) for each in posteriors]


def severity_limit(recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int) -> SeverityLimit:
    """Smallest error of the severity of one kind of fault.

    Args:
        recipe: nominal motor, tolerances, sensor and timing; its classes are not looked at.
        prior: kind and range.
        seed: the random seed.
        n_cases: cases 0 .. n_cases - 1 of that seed.
    """
    sound = replace(recipe, classes=(FaultClass(),))
    errors, variances, covered = [], [], []
    for cases in chunks(n_cases):
        severity = prior.at(2.0 * uniforms(seed, Stream.ONSET, cases, 1)[:, 0] - 1.0)
        scenario = replace(draw(sound, seed, cases).scenario, faults=(Fault(prior.kind, severity),))
        posterior = severity_posterior(recipe, prior, simulate(scenario, seed, cases).measurements)
        low, high = posterior.interval(0.90).T
        errors.append(posterior.mean - severity)
        variances.append(np.square(posterior.std))
        covered.append((low <= severity) & (severity <= high))
    return SeverityLimit(
        expected_rmse=float(np.sqrt(np.concatenate(variances).mean())),
        rmse=float(np.sqrt(np.square(np.concatenate(errors)).mean())),
        coverage=float(np.concatenate(covered).mean()),
    )


SEED = 11
RATES_HZ = (10_000.0, 1_000.0)
NOISES_A = (0.005, 0.02, 0.1)
BENCH = named_recipe("bench")


def bench(rate_hz: float, noise_a: float) -> Recipe:
    """The recipe `bench` at another rate and noise."""
    sensor = SensorParameters(current_noise_a=noise_a)
    return named_recipe("bench", sensor=sensor, timing=Timing(rate_hz, 0.1))


def accuracy(n_cases: int) -> Iterable[Iterable[str]]:
    """Bayes-optimal accuracy by rate and noise."""
    for rate_hz in RATES_HZ:
        for noise_a in NOISES_A:
            ((limit, error), hits), *_ = class_limits(bench(rate_hz, noise_a), SEED, n_cases)
            yield f"{rate_hz:g} Hz", f"{1e3 * noise_a:g} mA", f"{limit:.4f} ± {error:.4f}", f"{hits:.4f}"


def variants(n_cases: int) -> Iterable[Iterable[str]]:
    """The best accuracy when more or less is known of the motor, or the speed is measured."""
    own = Spread(supply=0.01, resistance=0.003, constants=0.002, inertia=0.002, friction=0.002)
    both = SensorParameters(channels=(Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=1.0)
    wide = (
        Spread(0.01, 0.04, 0.01, 0.02, 0.02),
        Spread(0.01, 0.01, 0.01, 0.02, 0.05),
        Spread(0.01, 0.01, 0.01, 0.02, 0.10),
    )
    changes: tuple[tuple[str, dict[str, Any]], ...] = (
        ("`bench`", {}),
        ("the motor's own parameters known: R 0.3 %, K, J, B 0.2 %", {"spread": own}),
        ("the same at 1 kHz", {"spread": own, "timing": Timing(1_000.0, 0.1)}),
        ("R 4 %", {"spread": wide[0]}),
        ("B 5 %", {"spread": wide[1]}),
        ("B 10 %", {"spread": wide[2]}),
        ("speed beside the current, 1 rad/s", {"sensor": both}),
    )
    for name, change in changes:
        ((limit, error), _), *_ = class_limits(named_recipe("bench", **change), SEED, n_cases)
        yield name, f"{limit:.4f} ± {error:.4f}"


def early(n_cases: int) -> Iterable[Iterable[str]]:
    """The best accuracy by the samples seen."""
    seen_ms = (1, 2, 5, 10, 20, 40, 60, 80, 100)
    limits = class_limits(BENCH, SEED, n_cases, [10 * ms for ms in seen_ms])
    for ms, ((limit, error), _) in zip(seen_ms, limits, strict=True):
        yield f"{ms} ms", f"{limit:.4f} ± {error:.4f}"


def with_error(share: float, n_cases: int) -> str:
    """A share of so many cases and its standard error."""
    return f"{share:.3f} ± {np.sqrt(share * (1.0 - share) / n_cases):.3f}"


def severity(n_cases: int) -> Iterable[Iterable[str]]:
    """Errors of the severities."""
    for kind in (FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT):
        for rate_hz in RATES_HZ:
            for noise_a in NOISES_A:
                got = severity_limit(bench(rate_hz, noise_a), SeverityPrior(kind), SEED, n_cases)
                points = (f"{100.0 * value:.2f}" for value in (got.expected_rmse, got.rmse))
                yield (
                    str(kind),
                    f"{rate_hz:g} Hz",
                    f"{1e3 * noise_a:g} mA",
                    *points,
                    with_error(got.coverage, n_cases),
                )


def power(n_cases: int) -> Iterable[Iterable[str]]:
    """False alarms over healthy motors, and powers."""
    faults = (
        Fault(FaultKind.BEARING, 0.10),
        Fault(FaultKind.WINDING_CONTACT, 0.005),
        Fault(FaultKind.WINDING_CONTACT, 0.02),
        Fault(FaultKind.WINDING_CONTACT, 0.05),
    )
    for name in ("paper", "bench"):
        recipe = named_recipe(name)
        sound = replace(recipe, classes=recipe.classes[:1])
        tests = [MatchedTest.from_recipe(recipe, fault) for fault in faults]
        parts = []
        for cases in chunks(n_cases):
            measured = simulate(draw(sound, SEED, cases).scenario, SEED, cases).measurements
            parts.append([test.statistic(measured) for test in tests])
        for fault, test, statistic in zip(faults, tests, np.concatenate(parts, axis=1), strict=True):
            alarms = (statistic > test.threshold_for(0.01)).mean()
            yield (
                name,
                f"{fault.kind} +{100.0 * float(fault.severity):g} %",
                f"{100.0 * alarms:.2f} %",
                f"{100.0 * test.power(0.01):.1f} %",
            )


def bounds() -> Iterable[Iterable[str]]:
    """Cramer-Rao bounds, other parameters known."""
    for noise_a in (0.0034, 0.02, 0.04):
        covariance = cramer_rao_bound(PAPER_MOTOR, SensorParameters(current_noise_a=noise_a), Timing())
        yield f"{1e3 * noise_a:g} mA", *(f"{100.0 * np.sqrt(v):.3f} %" for v in np.diag(covariance))


def main(n_cases: int = 20_000) -> None:
    """Make all tables."""
    keep_table("best-possible", "bounds", ("noise", "R", "B"), bounds())
    keep_table("best-possible", "accuracy", ("rate", "noise", "limit", "hits"), accuracy(n_cases))
    keep_table("best-possible", "variants", ("setting", "limit"), variants(n_cases))
    keep_table("best-possible", "early", ("seen", "limit"), early(n_cases))
    keep_table(
        "best-possible",
        "severity",
        ("kind", "rate", "noise", "expected", "measured", "coverage"),
        severity(max(n_cases // 10, 100)),
    )
    keep_table("best-possible", "tests", ("recipe", "fault", "false alarms", "power"), power(n_cases))


if __name__ == "__main__":
    run(main)
