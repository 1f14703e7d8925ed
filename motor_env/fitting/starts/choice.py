"""The terms beside the textbook for which a start gives evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from motor_env.fitting.fit import STRONG_EVIDENCE
from motor_env.fitting.score import score_tests
from motor_env.fitting.starts.belief import believed
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.starts.identify import identify
from motor_env.motor.threads import on_one_thread
from motor_env.recordings.start import Start

NUISANCES = ("supply_ramp", "supply_curve", "sensor_lag", "speed_lag", "dead_zone")
"""Terms that do not touch the motor: what a diagnosis may add. Coulomb friction and viscous friction, and a brush
drop and the supply, can hardly be told apart in one start, and would take the friction out of the comparison."""
EXTENSIONS = (*NUISANCES, "coulomb", "brush_drop")
"""All of them: what is tried where nothing is compared."""
SCORED_SIZES = tuple(np.exp([-2.0, 0.0, 2.0, 4.0]).tolist())  # a long lag looks different from a short one
_UNSCORED = ("supply_curve", "dead_zone")
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
    added = len(rich.solution.theta) - len(simple.solution.theta)
    return gain - added * math.log(max(sum(rich.independent), 2.0))


@on_one_thread
def identify_best(
    start: Start,
    candidates: tuple[str, ...] = EXTENSIONS,
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
) -> Identified:
    """Fit the textbook, and add the term for which the evidence is strongest, as long as it is strong.

    Raises:
        UnusableError: the current flows against the voltage.
    """
    best = identify(start, constant=constant, typical=typical)
    start = best.start
    knows_inductance = any(name in (typical or {}) for name in ("L", "L/V"))
    while True:
        applicable = [
            name
            for name in candidates
            if name not in best.model and _applies(name, start, best.model, knows_inductance=knows_inductance)
        ]
        every = believed(start, constant, typical).every
        scored = [name for name in applicable if name not in _UNSCORED]
        if best.inductance_off**2 <= _PROMISING:  # a score test, far cheaper than a fit
            tests = score_tests(best.solution, every, scored, SCORED_SIZES)
            scored = [name for name, test in tests.items() if test.chi_square > _PROMISING]
        trials = [
            identify(start, (*best.model, name), constant=constant, typical=typical, simpler=best)
            for name in applicable
            if name in scored or name in _UNSCORED
        ]
        richer = max(trials, key=lambda trial: evidence(best, trial), default=None)
        if richer is None or evidence(best, richer) < STRONG_EVIDENCE:
            return best
        best = richer


def _applies(name: str, start: Start, model: tuple[str, ...], *, knows_inductance: bool) -> bool:
    """Whether a recording can tell one more term.

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
