"""Prior of a start to fit: rough values, typical values and its terms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.record import CURVE_PARTS
from motor_env.diagnosis.estimation.starts.start_fit import record_of
from motor_env.diagnosis.estimation.terms import Term, terms
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import Start, mean_tail
from motor_env.motor.parameters import FloatArray

FIT_SAMPLES = 40_000
INDUCTANCE_PRIOR_SD = 0.3
_LAGS = frozenset({"supply_ramp", "supply_curve", "sensor_lag"})
CURVE = tuple(f"curve_{n}" for n in range(1, CURVE_PARTS))
_FIRST_SIZES = (math.exp(-2.0), 1.0)  # of the usual one: where the fit of one more term begins
_FIRST_NOISE = 0.02  # of a channel's span, until a fit tells
# Of the current's span. Without a quiet part the sensor is believed to be nulled.
_OFFSET_SD_WITHOUT_QUIET, _OFFSET_SD_WITH_QUIET = 0.0002, 0.05
_LARGEST_SKEW = 1.5  # of the voltage's samples, in intervals


def _rough_values(start: Start, constant: float | None) -> FloatArray:
    """Estimate roughly: R from the peak, J from the decay, B from the final current."""
    after = np.where(start.counted, start.current_a, np.nan)[start.alignment.onset_index :]
    after = np.where(np.isnan(after), np.nanmedian(after), after) - start.alignment.offset_a
    peak_at = int(np.argmax(after))
    peak = float(after[peak_at])
    final = float(np.clip(mean_tail(after), 0.002 * peak, 0.8 * peak))
    below = np.flatnonzero(after[peak_at:] < final + 0.37 * (peak - final))
    decay = max(float(below[0]) if len(below) else 0.3 * len(after), 1.0) * start.dt_s
    resistance = 0.9 * start.level_v / peak
    back_emf = max(start.level_v - resistance * final, 0.1 * start.level_v)
    if start.speed_rad_s is not None:
        k = back_emf / max(abs(mean_tail(start.speed_rad_s)), 1e-9)
    else:
        k = constant if constant is not None else 0.01 * start.level_v
    values = np.zeros(index.N_VALUES)
    values[[index.R, index.L]] = resistance, resistance * 0.3 * max(peak_at, 1) * start.dt_s
    values[[index.K, index.J]] = k, decay * k * k / resistance
    values[index.B] = max(final * k * k / back_emf, 1e-300)
    values[index.CURVE] = 1.0
    values[index.LAG_I] = start.circuit.sensor_lag_s
    values[index.NOISE_I] = _FIRST_NOISE * float(np.ptp(_current(start)))
    values[index.NOISE_W] = (
        1.0 if start.speed_rad_s is None else _FIRST_NOISE * float(np.ptp(start.speed_rad_s))
    )
    return values


def _current(start: Start) -> FloatArray:
    """Return the counted samples, without ripple."""
    out: FloatArray = (start.current_a - start.ripple_a)[start.counted]
    return out


def absolute_parameters(quantities: Mapping[str, float], constant: float) -> dict[str, float]:
    """Return R, L, K, J and B as far as quantities tell them: the current alone needs an assumed K."""
    values = {"K": constant} | {
        name.replace("(J V)", "J").replace("/V", ""): value for name, value in quantities.items()
    }
    if "K^2/J" in values and "B/J" in values:
        values["J"] = constant**2 / values["K^2/J"]
        values["B"] = values["B/J"] * values["J"]
    return values


@dataclass(frozen=True, slots=True)
class StartPrior:
    """Start to fit, with what is known beforehand.

    Attributes:
        start: what is fitted.
        known: rough values.
        typical: logarithms of typical parameters over rough ones; empty where not known.
        available_terms: all terms.
    """

    start: Start
    known: FloatArray
    typical: dict[str, float]
    available_terms: dict[str, Term]

    @property
    def core(self) -> tuple[str, ...]:
        """Free parameters of the textbook model."""
        return tuple(name for name in "RLKJB" if name != "K" or self.start.speed_rad_s is not None)

    @property
    def start_terms(self) -> tuple[str, ...]:
        """Terms of every start beside the parameters: the onset or delay, and the sensor's offset."""
        late = "onset" if self.start.voltage_v is None else "delay"
        return (late,) if self.start.alignment.rectified else (late, "offset_current")

    def has_inductance_prior(self, model: Sequence[str]) -> bool:
        """Return whether L is held near the typical one."""
        return "L" in self.typical and hides_inductance(model)

    def problem(self, model: Sequence[str]) -> Problem:
        """Return the problem with the terms of a model."""
        every = self.available_terms
        if self.has_inductance_prior(model):
            mean = self.typical["L"]
            every = every | {"L": replace(every["L"], prior_sd=INDUCTANCE_PRIOR_SD, prior_mean=mean)}
        names = (*self.core, *expanded_terms(model), *self.start_terms)
        return Problem(
            record_of(self.start.shortened(FIT_SAMPLES)), self.known, tuple(every[n] for n in names)
        )

    def initial_guesses(self, problem: Problem) -> list[FloatArray]:
        """Return initial guesses: the typical motor, and for each of three inductances the best of a small grid."""
        begin = np.array([0.0 if term.is_log else _FIRST_SIZES[1] * term.usual for term in problem.free])
        begin[len(begin) - len(self.start_terms) :] = 0.0
        fits = []
        if len(self.typical) == len(self.core):
            fits.append(np.append([self.typical[name] for name in self.core], begin[len(self.core) :]))
        for inductance in (0.1, 1.0, 4.0):
            grid = np.tile(begin, (6, 1))
            for row, (inertia, ohm) in zip(grid, product((0.5, 1.0, 2.0), (0.7, 1.0)), strict=True):
                logs = {"R": ohm, "L": inductance, "K": 1.0, "J": inertia, "B": 1.0}
                row[: len(self.core)] = [math.log(logs[name]) for name in self.core]
            fits.append(grid[np.argmin(np.sum(problem.residuals_each(grid) ** 2, axis=1))])
        return fits

    def extended_guesses(self, problem: Problem, simpler: Solution) -> list[FloatArray]:
        """Extend a simpler fit by a weak and a strong beginning of one more term."""
        known = dict(zip(simpler.names, simpler.theta.tolist(), strict=True))
        added = [term for term in problem.free if term.name not in known]
        guesses = []
        for size in _FIRST_SIZES if len(added) == 1 else (1.0,):
            begun = known | {term.name: 0.0 if term.is_log else size * term.usual for term in added}
            guesses.append(np.array([begun[name] for name in problem.names]))
        if self.has_inductance_prior(expanded_terms(problem.names)):
            core = [self.typical.get(name, known[name]) for name in self.core]
            guesses[0] = np.append(core, guesses[-1][len(core) :])
        return guesses

    def is_typical(self, theta: FloatArray) -> bool:
        """Return whether the parameters are typical to a factor of e."""
        return len(self.typical) == len(self.core) and all(
            abs(value - self.typical[name]) < 1.0 for value, name in zip(theta, self.core, strict=False)
        )

    def inductance_deviation(self, theta: FloatArray) -> float:
        """Return L's distance from the typical one, in standard deviations of its prior; 0 where none is known."""
        return (float(theta[1]) - self.typical["L"]) / INDUCTANCE_PRIOR_SD if "L" in self.typical else 0.0


def hides_inductance(model: Sequence[str]) -> bool:
    """Return whether a term is a lag between voltage and current, as L/R is: each may pass for the other."""
    return not _LAGS.isdisjoint(model)


def expanded_terms(model: Sequence[str]) -> tuple[str, ...]:
    """Return the terms of a model by name: a supply curve has several.

    Brushes have no knee here: beside a motor that stands, it would explain the noise of a measured voltage.
    """
    return tuple(part for name in model for part in (CURVE if name == "supply_curve" else (name,)))


def start_prior(start: Start, constant: float | None, typical: Mapping[str, float] | None) -> StartPrior:
    """Return what is known of a start before it is fitted, see `identify`.

    Raises:
        UnusableError: the current flows against the voltage.
    """
    known = _rough_values(start, constant)
    if known[index.R] <= 0.0:
        raise UnusableError("no motor explains the current: it flows against the voltage")
    values = absolute_parameters(typical or {}, known[index.K])
    logs = {
        name: math.log(values[name] / known[getattr(index, name)])
        for name in "RLKJB"
        if values.get(name, 0.0) > 0.0 and (name != "K" or start.speed_rad_s is not None)
    }
    every = terms(record_of(start.shortened(FIT_SAMPLES)), known)
    alignment, dt_s, span = start.alignment, start.dt_s, float(np.ptp(_current(start)))
    room = max(5.0 * dt_s, 0.02 * (float(start.time_s[-1]) - alignment.onset_s))
    earliest = max(-room, float(start.time_s[0]) - 2.0 * dt_s - alignment.onset_s)
    offset_sd = _OFFSET_SD_WITH_QUIET if alignment.n_quiet else _OFFSET_SD_WITHOUT_QUIET
    peak_at = int(np.argmax(np.where(start.counted, start.current_a - start.ripple_a, -np.inf)))
    every["onset"] = replace(every["onset"], low=earliest / dt_s, high=room / dt_s)
    every["delay"] = replace(every["delay"], low=-_LARGEST_SKEW, high=_LARGEST_SKEW)
    every["offset_current"] = replace(
        every["offset_current"], unit=span, low=-0.5, high=0.5, prior_sd=offset_sd
    )
    every["dead_zone"] = replace(every["dead_zone"], unit=span)
    rise = max(0.5 * (peak_at - alignment.onset_index), 2.0)
    every["supply_ramp"] = replace(every["supply_ramp"], usual=rise)
    drag = 0.3 * known[index.B] * start.level_v / known[index.K]
    every["coulomb"] = replace(every["coulomb"], usual=drag / every["coulomb"].unit)
    return StartPrior(start, known, logs, every)
