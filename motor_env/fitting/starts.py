"""A motor's parameters from one real start, by least squares, with the terms beside the textbook that it shows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from motor_env.fitting import places
from motor_env.fitting.fit import STRONG_EVIDENCE, score_tests
from motor_env.fitting.kernel import REST, STEADY
from motor_env.fitting.problem import Problem, Solution
from motor_env.fitting.record import CURVE_PARTS, Record
from motor_env.fitting.terms import Term, terms
from motor_env.fitting.threads import on_one_thread
from motor_env.fitting.uncertainty import capped, sandwich
from motor_env.motor import identifiable as quantities
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.recordings.defects import Defect, DefectKind, UnusableError
from motor_env.recordings.noise import difference_noise, floor_noise
from motor_env.recordings.periodic_lines import line_share, over_angle, periodic_lines
from motor_env.recordings.start import Start, mean_tail

NUISANCES = ("supply_ramp", "supply_curve", "sensor_lag", "speed_lag", "dead_zone")
"""Terms that do not touch the motor: what a diagnosis may add. Coulomb friction and viscous friction, and a brush
drop and the supply, can hardly be told apart in one start, and would take the friction out of the comparison."""
EXTENSIONS = (*NUISANCES, "coulomb", "brush_drop")
"""All of them: what is tried where nothing is compared."""
FIT_SAMPLES = 40_000
INDUCTANCE_PRIOR_SD = 0.3
AMBIGUOUS = frozenset({"supply_ramp", "supply_curve", "sensor_lag"})
"""Terms that change places with L/R in a step: all are lags between the switch and the current."""
_CURVE = tuple(f"curve_{n}" for n in range(1, CURVE_PARTS))
_FIRST_SIZES = (math.exp(-2.0), 1.0)  # of the usual one: where the fit of one more term begins
_SCORED_SIZES = tuple(np.exp([-2.0, 0.0, 2.0, 4.0]).tolist())  # a long lag looks different from a short one
_UNSCORED = ("supply_curve", "dead_zone")
_PROMISING = 6.0  # of a chi-square with one degree; strong evidence takes 12 and more
_FIRST_NOISE = 0.02  # of a channel's span, until a fit tells
# Of the current's span. Without a quiet part the sensor is believed to be nulled.
_OFFSET_SD_WITHOUT_QUIET, _OFFSET_SD_WITH_QUIET = 0.0002, 0.05
_LARGEST_SKEW = 1.5  # of the voltage's samples, in intervals
_UNTOLD_LOG_SD = 1.0
_WILD_SPREADS = 10.0


@dataclass(frozen=True, slots=True)
class Identified:
    """A fitted start.

    Attributes:
        start: what was fitted.
        model: terms beside the textbook's.
        solution: the fit.
        quantity_names: what this recording can tell.
        log_values: logarithms of these quantities, shape (n,).
        log_covariance: their covariance, shape (n, n).
        expected: fitted current and speed, shape (n_samples, 2), offset and periodic ripple included.
        independent: number of independent samples that the residual's autocorrelation leaves, each channel.
        fitted_extension: value and standard error of each extension; of a supply curve the middle of the rise.
        inductance_off: how far L lies from the typical one, in standard deviations of 30 %; 0 where none is known.
    """

    start: Start
    model: tuple[str, ...]
    solution: Solution
    quantity_names: tuple[str, ...]
    log_values: FloatArray
    log_covariance: FloatArray
    expected: FloatArray
    independent: tuple[float, ...]
    fitted_extension: dict[str, tuple[float, float]]
    inductance_off: float = 0.0

    @property
    def physical(self) -> FloatArray:
        """Physical values, see `motor_env.fitting.places`."""
        return self.solution.problem.values(self.solution.theta)

    @property
    def parameters(self) -> MotorParameters:
        """Textbook parameters; absolute ones only as far as `quantities` says."""
        r, inductance, k, j, b = self.physical[[places.R, places.L, places.K, places.J, places.B]].tolist()
        return MotorParameters(r, inductance, k, k, j, b)

    @property
    def onset_s(self) -> float:
        """Fitted onset."""
        late = self.physical[places.ONSET] + self.physical[places.DELAY] * self.start.dt_s
        return float(self.start.alignment.onset_s + late)

    @property
    def offset_a(self) -> float:
        """Fitted offset of the current."""
        return float(self.start.alignment.offset_a + self.physical[places.OFFSET_I])

    def run(self, values: FloatArray) -> FloatArray:
        """Current and speed of a motor of other values in this start, as they are shown, shape (n_samples, 2)."""
        return record_of(self.start).predict(values, learn=False)[0][:, 2:4]

    @property
    def defects(self) -> tuple[Defect, ...]:
        """What is wrong with the recording, and what of the model it shows."""
        start, size = self.start, {name: value for name, (value, _) in self.fitted_extension.items()}
        defects = list(start.alignment.defects)
        for k in start.alignment.wild:
            where = f"{start.alignment.sign * start.current_a[k]:.3g} A at {start.time_s[k]:.6g} s"
            defects.append(Defect(DefectKind.WILD_SAMPLE, f"a wild sample of {where}, left out"))
        for line in start.lines:
            where = f"{line.amplitude_a:.3g} A at {line.frequency_hz:.4g} Hz"
            defects.append(Defect(DefectKind.PWM_RIPPLE, f"PWM ripple of {where} (or an alias of it)"))
        if "supply_ramp" in size:
            text = f"supply ramp: it rises in {1e3 * size['supply_ramp']:.3g} ms"
            curve = ", in a curve" if "supply_curve" in self.model else ""
            defects.append(Defect(DefectKind.SUPPLY_RAMP, text + curve))
        defects += [
            Defect(kind, f"{kind.replace('_', ' ')} of {1e3 * size[kind]:.3g} ms")
            for kind in (DefectKind.SENSOR_LAG, DefectKind.SPEED_LAG)
            if kind in size
        ]
        if "dead_zone" in size:
            text = f"dead zone: the sensor hides currents below {size['dead_zone']:.3g} A"
            defects.append(Defect(DefectKind.DEAD_ZONE, text))
        return tuple(defects)

    @property
    def residual_a(self) -> FloatArray:
        """Measured minus fitted current; 0 at wild samples."""
        return np.where(self.start.counted, self.start.current_a - self.expected[:, 0], 0.0)

    @property
    def r2_current(self) -> float:
        """Share of the current's variance that the fit explains."""
        counted = self.start.counted
        return _r2(self.start.current_a[counted], self.residual_a[counted])

    @property
    def r2_speed(self) -> float | None:
        """The same for the speed; None where it was not recorded."""
        speed = self.start.speed_rad_s
        return None if speed is None else _r2(speed, speed - self.expected[:, 1])

    @property
    def misfit(self) -> tuple[float, ...]:
        """Mean squared residual over the channel's variance, each channel."""
        return tuple(1.0 - r2 for r2 in (self.r2_current, self.r2_speed) if r2 is not None)

    @property
    def noise_a(self) -> float:
        """White noise of the current while the motor runs, beside any ripple."""
        return floor_noise(self.residual_a[self.start.alignment.onset_index :])

    @property
    def lag_one(self) -> float:
        """Autocorrelation of the current's residual at one sample; 0 would be white."""
        centred = self.residual_a - self.residual_a.mean()
        return float(np.sum(centred[1:] * centred[:-1]) / max(np.sum(centred**2), 1e-300))

    @property
    def states(self) -> FloatArray:
        """Fitted current and speed without offset and ripple, shape (n_samples, 2)."""
        out = self.expected.copy()
        out[:, 0] -= self.start.ripple_a + self.offset_a
        return out

    @property
    def is_hidden(self) -> bool:
        """Whether the sensor hides small currents: its readings are not linear in the state."""
        return self.start.alignment.rectified or "dead_zone" in self.model

    @property
    def whitened(self) -> FloatArray:
        """Residual of the running motor over the sensor's noise, shape (n, 1); NaN where the sensor shows nothing.

        The state is known where the motor stands, and nothing disturbs the model: these are the innovations of its
        Kalman filter, where the sensor hides nothing.
        """
        is_step = self.start.voltage_v is None
        begin = int(np.searchsorted(self.start.time_s, self.onset_s, side="right")) + 1 if is_step else 1
        shown = self.start.counted & (self.states[:, 0] >= 0.5 * self.physical[places.ZONE])
        noise = max(self.noise_a, 1e-9 * float(np.ptp(self.start.current_a)))
        return np.where(shown, self.residual_a / noise, np.nan)[begin:, None]

    @property
    def white_covariance(self) -> FloatArray:
        """Covariance of the logarithms from white noise alone: what differs between starts of one motor."""
        running = self.residual_a[self.start.alignment.onset_index :]
        return self.log_covariance * min(
            difference_noise(running) ** 2 / max(float(np.var(running)), 1e-300), 1.0
        )

    @property
    def exponents(self) -> FloatArray:
        """Exponents of (R, L, K, J, B, V) in each quantity, shape (n, 6)."""
        return quantities.matrix(self.quantity_names)

    @property
    def values(self) -> FloatArray:
        """The identifiable quantities, SI (over volt where the voltage is unknown)."""
        return np.exp(self.log_values)

    @property
    def standard_errors(self) -> FloatArray:
        """Their standard errors."""
        return self.values * np.sqrt(np.diag(self.log_covariance))

    @property
    def correlation(self) -> FloatArray:
        """Correlations of the logarithms, shape (n, n)."""
        sigma = np.sqrt(np.diag(self.log_covariance))
        out: FloatArray = self.log_covariance / np.outer(sigma, sigma)
        return out


def record_of(start: Start) -> Record:
    """What is fitted of a start: its current without ripple and the quiet part's offset, wild samples left out."""
    n, alignment = len(start.time_s), start.alignment
    current = start.current_a - start.ripple_a - alignment.offset_a
    current[~start.counted] = np.nan
    speed = np.zeros(n) if start.speed_rad_s is None else start.speed_rad_s
    marks = np.zeros(n)
    marks[0] = REST if start.from_rest else STEADY
    is_step = start.voltage_v is None
    return Record(
        dt_s=start.dt_s,
        voltage_v=np.full(n, start.level_v) if start.voltage_v is None else start.voltage_v,
        readings=np.stack([current, speed], axis=1),
        seen=np.array([1.0, float(start.speed_rad_s is not None)]),
        marks=marks,
        onset_s=alignment.onset_s - float(start.time_s[0]) if is_step else None,
        shunt_ohm=start.circuit.shunt_ohm,
        rectified_a=alignment.noise_a if alignment.rectified else None,
    )


def _by_eye(start: Start, constant: float | None) -> FloatArray:
    """Values by eye: R from the peak, J from the decay, B from the final current."""
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
    values = np.zeros(places.N_VALUES)
    values[[places.R, places.L]] = resistance, resistance * 0.3 * max(peak_at, 1) * start.dt_s
    values[[places.K, places.J]] = k, decay * k * k / resistance
    values[places.B] = max(final * k * k / back_emf, 1e-300)
    values[places.CURVE] = 1.0
    values[places.LAG_I] = start.circuit.sensor_lag_s
    values[places.NOISE_I] = _FIRST_NOISE * float(np.ptp(_current(start)))
    values[places.NOISE_W] = (
        1.0 if start.speed_rad_s is None else _FIRST_NOISE * float(np.ptp(start.speed_rad_s))
    )
    return values


def _current(start: Start) -> FloatArray:
    """The samples that count, without ripple."""
    out: FloatArray = (start.current_a - start.ripple_a)[start.counted]
    return out


def absolute(told: Mapping[str, float], constant: float) -> dict[str, float]:
    """R, L, K, J and B as far as quantities tell them; K is believed where the current alone was measured.

    The current depends on K^2/J and B/J only, whatever K is believed.
    """
    values = {"K": constant} | {
        name.replace("(J V)", "J").replace("/V", ""): value for name, value in told.items()
    }
    if "K^2/J" in values and "B/J" in values:
        values["J"] = constant**2 / values["K^2/J"]
        values["B"] = values["B/J"] * values["J"]
    return values


@dataclass(frozen=True, slots=True)
class _Belief:
    """A start to fit, with what is believed of it beforehand.

    Attributes:
        start: what is fitted.
        known: values by eye.
        typical: logarithms of the typical parameters over those by eye; empty where they are not known.
        every: all terms.
    """

    start: Start
    known: FloatArray
    typical: dict[str, float]
    every: dict[str, Term]

    @property
    def core(self) -> tuple[str, ...]:
        """The textbook's free parameters."""
        return tuple(name for name in "RLKJB" if name != "K" or self.start.speed_rad_s is not None)

    @property
    def ends(self) -> tuple[str, ...]:
        """What every start has beside them."""
        late = "onset" if self.start.voltage_v is None else "delay"
        return (late,) if self.start.alignment.rectified else (late, "offset_current")

    def has_inductance_prior(self, model: Sequence[str]) -> bool:
        """Whether L is held near the typical one."""
        return "L" in self.typical and self.start.voltage_v is None and bool(AMBIGUOUS & set(model))

    def problem(self, model: Sequence[str]) -> Problem:
        """What is solved, with the terms of a model."""
        every = self.every
        if self.has_inductance_prior(model):
            mean = self.typical["L"]
            every = every | {"L": replace(every["L"], prior_sd=INDUCTANCE_PRIOR_SD, prior_mean=mean)}
        names = (*self.core, *parts_of(model), *self.ends)
        return Problem(
            record_of(self.start.shortened(FIT_SAMPLES)), self.known, tuple(every[n] for n in names)
        )

    def guesses(self, problem: Problem) -> list[FloatArray]:
        """The typical motor where it is known, and for each of three inductances the best of a small grid."""
        begin = np.array([0.0 if term.is_log else _FIRST_SIZES[1] * term.usual for term in problem.free])
        begin[len(begin) - len(self.ends) :] = 0.0
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

    def richer(self, problem: Problem, simpler: Solution) -> list[FloatArray]:
        """A simpler fit with a weak and a strong beginning of one more term."""
        known = dict(zip(simpler.names, simpler.theta.tolist(), strict=True))
        added = [term for term in problem.free if term.name not in known]
        found = []
        for size in _FIRST_SIZES if len(added) == 1 else (1.0,):
            begun = known | {term.name: 0.0 if term.is_log else size * term.usual for term in added}
            found.append(np.array([begun[name] for name in problem.names]))
        if self.has_inductance_prior(parts_of(problem.names)):
            core = [self.typical.get(name, known[name]) for name in self.core]
            found[0] = np.append(core, found[-1][len(core) :])
        return found

    def is_typical(self, theta: FloatArray) -> bool:
        """Whether the textbook parameters are those of the typical motor to a factor of e: no other optimum then."""
        return len(self.typical) == len(self.core) and all(
            abs(one - self.typical[name]) < 1.0 for one, name in zip(theta, self.core, strict=False)
        )

    def inductance_off(self, theta: FloatArray) -> float:
        """How far L lies from the typical one, in standard deviations of its prior; 0 where none is known."""
        return (float(theta[1]) - self.typical["L"]) / INDUCTANCE_PRIOR_SD if "L" in self.typical else 0.0


def parts_of(model: Sequence[str]) -> tuple[str, ...]:
    """Terms of a model by name: a supply curve has several."""
    return tuple(part for name in model for part in (_CURVE if name == "supply_curve" else (name,)))


def _believed(start: Start, constant: float | None, typical: Mapping[str, float] | None) -> _Belief:
    known = _by_eye(start, constant)
    values = absolute(typical or {}, known[places.K])
    logs = {
        name: math.log(values[name] / known[getattr(places, name)])
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
    drag = 0.3 * known[places.B] * start.level_v / known[places.K]
    every["coulomb"] = replace(every["coulomb"], usual=drag / every["coulomb"].unit)
    return _Belief(start, known, logs, every)


@on_one_thread
def identify(
    start: Start,
    model: tuple[str, ...] = (),
    *,
    constant: float | None = None,
    typical: Mapping[str, float] | None = None,
    simpler: Identified | None = None,
) -> Identified:
    """Fit the model to a start.

    Where the residual shows lines of constant frequency, or single wild samples, they are taken off, and the fit is
    repeated.

    Args:
        start: what to fit.
        model: terms beside the textbook's, of EXTENSIONS.
        constant: K to assume where the current alone is measured, for only K^2/J and B/J can then be told.
        typical: quantities of such a motor by name, where known: one more guess to begin from, and where the model
            makes L ambiguous a prior of 30 % on it.
        simpler: a fit of the same start that lacks the last term of the model, to begin from.

    Raises:
        UnusableError: the fit does not converge to a motor.
    """
    belief = _believed(start, constant, typical)
    problem, best = belief.problem(model), None
    for guess in belief.guesses(problem) if simpler is None else belief.richer(problem, simpler.solution):
        found = Solution(problem, *problem.solve(guess, most=60))
        if best is None or found.misfit < best.misfit:
            best = found
        if simpler is None and belief.is_typical(best.theta):
            break
    if best is None or not math.isfinite(best.misfit):
        raise UnusableError("no motor model can be fitted")
    weighed = best.weighed()
    fit = _result(belief, model, Solution(weighed, *weighed.solve(best.theta, most=100)))
    cleaner = _cleaner(fit)
    if cleaner is None:
        return fit
    return identify(cleaner, model, constant=constant, typical=typical, simpler=simpler)


def _cleaner(fit: Identified) -> Start | None:
    """The start without what the residual shows to be no part of it, lines and wild samples; None if all is well."""
    start, residual = fit.start, fit.residual_a
    wild = sorted({*start.alignment.wild, *_wild_against(residual, start.current_a)})
    if len(wild) > max(len(residual) // 1000, 1):
        wild = list(start.alignment.wild)
    begin = start.alignment.onset_index
    lines = start.lines or periodic_lines(residual[begin:], start.time_s[begin:])
    if lines and not start.lines and _turns_with_the_motor(fit, begin):
        lines = ()
    if lines == start.lines and len(wild) == len(start.alignment.wild):
        return None
    return replace(start, lines=lines, alignment=replace(start.alignment, wild=tuple(wild)))


def _turns_with_the_motor(fit: Identified, begin: int) -> bool:
    """Whether the strongest line is sharper over the angle than over time: the commutator's, not a converter's."""
    residual, time_s = fit.residual_a[begin:], fit.start.time_s[begin:]
    turning = over_angle(residual, time_s, fit.states[begin:, 1])
    return turning is not None and line_share(turning[1], turning[0]) > line_share(residual, time_s)


def _wild_against(residual: FloatArray, current: FloatArray) -> list[int]:
    """Samples far off a fit that goes well through both neighbours, and off both neighbours to the same side."""
    off = np.abs(residual[1:-1])
    spread = 1.4826 * float(np.median(np.abs(residual)))
    beside = np.maximum(np.abs(residual[:-2]), np.abs(residual[2:]))
    left, right = current[1:-1] - current[:-2], current[1:-1] - current[2:]
    jumps = (left * right > 0.0) & (np.minimum(np.abs(left), np.abs(right)) > 0.5 * off)
    wild = (off > _WILD_SPREADS * spread) & (beside < 0.3 * off) & jumps
    return [int(k) + 1 for k in np.flatnonzero(wild)]


def _result(belief: _Belief, model: tuple[str, ...], best: Solution) -> Identified:
    """Put the fit into words and numbers."""
    start, problem, theta = belief.start, best.problem, best.theta
    n_core, values = len(belief.core), problem.values(theta)
    jacobian = problem.jacobian(theta, problem.residuals(theta))
    level = start.alignment.unseen_level_a / values[places.NOISE_I]
    covariance, independent = sandwich(
        problem, theta, jacobian, range(len(theta)), begin=start.alignment.onset_index, level=level
    )
    if belief.has_inductance_prior(model):
        # What looks like L may be the ramp or the lag, and the other way round: L tells nothing then.
        covariance[1, 1] += _UNTOLD_LOG_SD**2
    names = quantities.names(has_voltage=start.voltage_known, has_speed=start.speed_rad_s is not None)
    exponents = quantities.matrix(names)
    core = exponents[:, [quantities.PARAMETERS.index(name) for name in belief.core]]
    extras = {}
    for name in model:
        if name == "supply_curve":
            extras[name] = _middle_of_rise(problem, values, covariance)
            continue
        k = problem.names.index(name)
        unit = problem.free[k].unit
        extras[name] = (unit * float(theta[k]), unit * math.sqrt(max(covariance[k, k], 0.0)))
    expected = record_of(start).predict(values, learn=False)[0][:, 2:4]
    expected[:, 0] += start.alignment.offset_a + start.ripple_a
    parameters = MotorParameters(
        *values[[places.R, places.L, places.K, places.K, places.J, places.B]].tolist()
    )
    return Identified(
        start=start,
        model=model,
        solution=best,
        quantity_names=names,
        log_values=exponents @ quantities.logarithms(parameters, start.level_v),
        log_covariance=capped(core @ covariance[:n_core, :n_core] @ core.T),
        expected=expected,
        independent=independent,
        fitted_extension=extras,
        inductance_off=belief.inductance_off(theta),
    )


def _middle_of_rise(problem: Problem, values: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Where the middle of the supply's rise lies, as a share of its time, with its standard error; 0.5 is even."""
    shares = np.append(1.0, values[places.CURVE])
    shares /= shares.sum()
    at = (np.arange(len(shares)) + 0.5) / len(shares)
    middle = float(shares @ at)
    slopes = (shares * (at - middle))[1:]
    first = problem.names.index(_CURVE[0])
    some = slice(first, first + len(slopes))
    return middle, math.sqrt(max(float(slopes @ covariance[some, some] @ slopes), 0.0))


def _r2(measured: FloatArray, left: FloatArray) -> float:
    return 1.0 - float(np.sum(left**2) / max(np.sum((measured - measured.mean()) ** 2), 1e-300))


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
        UnusableError: the fit does not converge to a motor.
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
        every = _believed(start, constant, typical).every
        scored = [name for name in applicable if name not in _UNSCORED]
        if best.inductance_off**2 <= _PROMISING:  # a score test, far cheaper than a fit
            tests = score_tests(best.solution, every, scored, _SCORED_SIZES)
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
