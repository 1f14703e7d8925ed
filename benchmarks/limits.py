"""Make the tables of docs/limits.md: `python benchmarks/limits.py [CASES]`, 20,000 cases and some seven minutes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from accuracy_limits import chunks, class_limits, cramer_rao_bound, severity_limit
from cyclopts import run
from tables import keep_table

from motor_env.inference.posterior import SeverityPrior
from motor_env.inference.whitening import MatchedTest
from motor_env.motor.faults import Fault, FaultKind
from motor_env.motor.parameters import PAPER_MOTOR, Channel, SensorParameters
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe, Spread
from motor_env.simulation.sampling import draw
from motor_env.simulation.simulate import Timing, simulate

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
            for two_sided in (False, True):
                size = np.abs(statistic) if two_sided else statistic
                alarms = (size > test.threshold_for(0.01, two_sided=two_sided)).mean()
                yield (
                    name,
                    f"{fault.kind} +{100.0 * float(fault.severity):g} %",
                    "two" if two_sided else "one",
                    f"{100.0 * alarms:.2f} %",
                    f"{100.0 * test.power(0.01, two_sided=two_sided):.1f} %",
                )


def bounds() -> Iterable[Iterable[str]]:
    """Cramer-Rao bounds, other parameters known."""
    for noise_a in (0.0034, 0.02, 0.04):
        covariance = cramer_rao_bound(PAPER_MOTOR, SensorParameters(current_noise_a=noise_a), Timing())
        yield f"{1e3 * noise_a:g} mA", *(f"{100.0 * np.sqrt(v):.3f} %" for v in np.diag(covariance))


def main(n_cases: int = 20_000) -> None:
    """Make all tables."""
    keep_table("limits", "bounds", ("noise", "R", "B"), bounds())
    keep_table("limits", "accuracy", ("rate", "noise", "limit", "hits"), accuracy(n_cases))
    keep_table("limits", "variants", ("setting", "limit"), variants(n_cases))
    keep_table("limits", "early", ("seen", "limit"), early(n_cases))
    keep_table(
        "limits",
        "severity",
        ("kind", "rate", "noise", "expected", "measured", "coverage"),
        severity(max(n_cases // 10, 100)),
    )
    keep_table("limits", "tests", ("recipe", "fault", "sides", "false alarms", "power"), power(n_cases))


if __name__ == "__main__":
    run(main)
