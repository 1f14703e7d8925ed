"""Which extensions of the textbook motor a start gives evidence for."""

from __future__ import annotations

import math
from collections.abc import Mapping

from motor_env.identification.identify import FIT_SAMPLES, Identified, identify
from motor_env.identification.residuals import Problem
from motor_env.recordings.start import Start

NUISANCES = ("supply_ramp", "supply_curve", "sensor_lag", "speed_lag", "dead_zone")
"""Extensions that do not touch the motor: what a diagnosis may add. Coulomb friction and viscous friction, and a brush
drop and the supply, can hardly be told apart in one start, and would take the friction out of the comparison."""
EXTENSIONS = (*NUISANCES, "coulomb", "brush_drop")
"""All of them: what is tried where nothing is compared."""
STRONG_EVIDENCE = 6.0
_PROMISING = 6.0  # of a chi-square with one degree; strong evidence takes 12 and more


def evidence(simple: Identified, rich: Identified) -> float:
    """How much the richer model is preferred: the drop of the Bayesian information criterion (Schwarz 1978).

    The samples are counted as independent ones, as many as the richer model's residual leaves; above 6 is strong
    (Raftery 1995). Where a typical L is known, its prior counts: a lag of the sensor is more likely than an L that is
    three times as large.
    """
    gain = sum(
        n * math.log(max(before, 1e-300) / max(after, 1e-300))
        for n, before, after in zip(rich.independent, simple.misfit, rich.misfit, strict=True)
    )
    gain += simple.inductance_off**2 - rich.inductance_off**2
    return gain - (len(rich.unknowns) - len(simple.unknowns)) * math.log(max(sum(rich.independent), 2.0))


def identify_best(
    start: Start,
    candidates: tuple[str, ...] = EXTENSIONS,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
) -> Identified:
    """Fit the textbook, and add the extension for which the evidence is strongest, as long as it is strong.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    best = identify(start, constant=constant, typical=typical)
    start = best.start
    knows_inductance = any(name in (typical or {}) for name in ("L", "L/V"))

    def is_worth_trying(model: tuple[str, ...]) -> bool:
        """Whether its last extension may earn strong evidence: a score test, far cheaper than its fit."""
        if model[-1] in {"supply_curve", "dead_zone"} or best.inductance_off**2 > _PROMISING:
            return True
        problem = Problem(start.shortened(FIT_SAMPLES), model, constant=constant, typical=typical)
        return problem.score(best.unknowns) > _PROMISING

    while True:
        applicable = (
            (*best.model, name)
            for name in candidates
            if name not in best.model and _applies(name, start, best.model, knows_inductance=knows_inductance)
        )
        trials = [
            identify(start, model, constant=constant, typical=typical, simpler=best)
            for model in filter(is_worth_trying, applicable)
        ]
        richer = max(trials, key=lambda trial: evidence(best, trial), default=None)
        if richer is None or evidence(best, richer) < STRONG_EVIDENCE:
            return best
        best = richer


def _applies(name: str, start: Start, model: tuple[str, ...], *, knows_inductance: bool) -> bool:
    """Whether a recording can tell one more extension.

    A measured voltage has no ramp to find. A step cannot tell a brush drop from a lower supply. The lag of the
    current's sensor is told from L/R only by a motor file that knows L: both are lags of one cascade. An
    amplifier that hides small currents hides negative ones too.
    """
    step = start.voltage_v is None
    applies = {
        "supply_ramp": step,
        "supply_curve": "supply_ramp" in model,
        "brush_drop": not step,
        "sensor_lag": (not step or knows_inductance) and start.circuit.sensor_lag_s == 0.0,
        "speed_lag": start.speed_rad_s is not None,
        "dead_zone": step and start.from_rest and float(start.current_a.min()) >= 0.0,
    }
    return applies.get(name, True)
