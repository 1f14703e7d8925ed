"""The residuals of one start as a function of its unknowns: what a least-squares routine is given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product

import numpy as np
from scipy.special import ndtr

from motor_env.identification.start_model import Extension, driven, step_start
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.recordings.start import Start, mean_tail

CORE = ("R", "L", "K", "J", "B")
CURVE_PARTS = 5
"""Parts of a supply curve of free shape."""
AMBIGUOUS = frozenset({"supply_ramp", "supply_curve", "sensor_lag"})
"""Extensions that change places with L/R in a step: all are lags between the switch and the current."""
INDUCTANCE_PRIOR_SD = 0.3
_CURVE_PRIOR_SD = 1.5
_LARGEST_SKEW = 1.5  # of the voltage's samples, in intervals
_BEGINNINGS = (-2.0, 0.0, 2.0, 4.0)  # for a lag: of a quarter of a sample to a hundred samples
_LARGEST_LOG = 12.0
# Of the current's span. Without a quiet part the sensor is believed to be nulled.
_OFFSET_SD_WITHOUT_QUIET = 0.0002
_OFFSET_SD_WITH_QUIET = 0.05
_LARGEST_DEAD_ZONE = 0.35  # of the current's span: what hides more is no sensor


class Problem:
    """Residuals of one start.

    The unknowns are logarithms of factors on rough values: of the free textbook parameters, then of the extensions;
    then the onset and the current's offset as they are.

    Args:
        start: what is fitted.
        model: extensions of the textbook.
        constant: K to assume where the current alone is measured.
        typical: quantities of such a motor by name, where known: one more guess to begin from, and where the model
            makes L ambiguous a prior of 30 % on it.
    """

    def __init__(
        self,
        start: Start,
        model: tuple[str, ...],
        *,
        constant: float | None = None,
        typical: Mapping[str, float] | None = None,
    ) -> None:
        self.start, self.model = start, model
        self.has_speed = start.speed_rad_s is not None
        self.free = tuple(name for name in CORE if name != "K" or self.has_speed)
        self.n_core = len(self.free)
        self.extras = tuple(
            part
            for name in model
            for part in (
                (name,) if name != "supply_curve" else tuple(f"curve_{n}" for n in range(1, CURVE_PARTS))
            )
        )
        self.counted = start.counted
        current = start.current_a - start.ripple_a
        self.measured = current if start.speed_rad_s is None else np.concatenate([current, start.speed_rad_s])
        if self.has_speed:
            self.counted = np.concatenate([self.counted, np.ones(len(start.time_s), dtype=np.bool_)])
        self.span = float(np.ptp(current[start.counted]))
        self.scale = np.full(len(self.measured), 0.02 * self.span)
        if start.speed_rad_s is not None:
            self.scale[len(start.time_s) :] = 0.02 * float(np.ptp(start.speed_rad_s))
        self.base = self._rough(constant)
        self.typical = self._typical(typical or {})
        lag = 2.0 * start.dt_s
        until_peak = int(np.argmax(np.where(start.counted, current, -np.inf))) - start.alignment.onset_index
        self.base_extra = {
            "supply_ramp": max(0.5 * until_peak * start.dt_s, lag),
            "coulomb": 0.3 * self.base["B"] * start.level_v / self.base["K"],
            "brush_drop": 0.05 * start.level_v,
            "sensor_lag": lag,
            "speed_lag": lag,
            "dead_zone": 0.15 * self.span,
        } | {f"curve_{n}": 1.0 for n in range(1, CURVE_PARTS)}
        self.offset_sd = self.span * (
            _OFFSET_SD_WITH_QUIET if start.alignment.n_quiet else _OFFSET_SD_WITHOUT_QUIET
        )

    def _rough(self, constant: float | None) -> dict[str, float]:
        """Parameters by eye: R from the peak, J from the decay, B from the final current."""
        start = self.start
        after = np.where(start.counted, start.current_a, np.nan)[start.alignment.onset_index :]
        after = np.where(np.isnan(after), np.nanmedian(after), after) - start.alignment.offset_a
        peak_at = int(np.argmax(after))
        peak = float(after[peak_at])
        final = float(np.clip(mean_tail(after), 0.002 * peak, 0.8 * peak))
        below = np.flatnonzero(after[peak_at:] < final + 0.37 * (peak - final))
        decay = max(float(below[0]) if len(below) else 0.3 * len(after), 1.0) * start.dt_s
        resistance = 0.9 * start.level_v / peak
        if start.speed_rad_s is not None:
            speed = max(abs(mean_tail(start.speed_rad_s)), 1e-9)
            k = max(start.level_v - resistance * final, 0.1 * start.level_v) / speed
        else:
            k = constant if constant is not None else 0.01 * start.level_v
        inertia = decay * k * k / resistance
        friction = max(final * k * k / max(start.level_v - resistance * final, 0.1 * start.level_v), 1e-300)
        rise = max(peak_at, 1) * start.dt_s
        return {"R": resistance, "L": resistance * 0.3 * rise, "K": k, "J": inertia, "B": friction}

    def _typical(self, quantities: Mapping[str, float]) -> dict[str, float]:
        """Logarithms of the typical parameters over the rough ones; empty where they are not known."""
        values = absolute(quantities, self.base["K"])
        return {
            name: math.log(values[name] / self.base[name]) for name in self.free if values.get(name, 0) > 0.0
        }

    @property
    def has_inductance_prior(self) -> bool:
        """Whether L is held near the typical one."""
        return "L" in self.typical and self.start.voltage_v is None and bool(AMBIGUOUS & set(self.model))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of the unknowns."""
        start, n = self.start, self.n_core + len(self.extras)
        room = max(5.0 * start.dt_s, 0.02 * (start.time_s[-1] - start.alignment.onset_s))
        first = start.time_s[0] - 2.0 * start.dt_s
        onset, offset = start.alignment.onset_s, start.alignment.offset_a
        low = [-_LARGEST_LOG] * n + [max(onset - room, first), offset - 0.5 * self.span]
        high = [_LARGEST_LOG] * n + [onset + room, offset + 0.5 * self.span]
        if "dead_zone" in self.extras:
            largest = math.log(_LARGEST_DEAD_ZONE * self.span / self.base_extra["dead_zone"])
            high[self.n_core + self.extras.index("dead_zone")] = largest
        if start.voltage_v is not None:  # known but for the place between two samples, and a sample's skew
            low[n], high[n] = onset - _LARGEST_SKEW * start.dt_s, onset + _LARGEST_SKEW * start.dt_s
        return np.array(low), np.array(high)

    def guesses(self) -> list[FloatArray]:
        """The typical motor where it is known, and for each of three inductances the best of a small grid."""
        end = [*[0.0] * len(self.extras), self.start.alignment.onset_s, self.start.alignment.offset_a]
        fits = []
        if len(self.typical) == self.n_core:
            fits.append(np.array([*(self.typical[name] for name in self.free), *end]))
        for inductance in (0.1, 1.0, 4.0):
            grid = []
            for inertia, ohm in product((0.5, 1.0, 2.0), (0.7, 1.0)):
                logs = {"R": ohm, "L": inductance, "K": 1.0, "J": inertia, "B": 1.0}
                grid.append(np.array([*(math.log(logs[name]) for name in self.free), *end]))
            fits.append(min(grid, key=lambda unknowns: float(np.sum(self.residuals(unknowns) ** 2))))
        return fits

    def richer(self, simpler: FloatArray) -> list[FloatArray]:
        """A simpler fit with a weak and a strong beginning of one more extension."""
        n = len(simpler) - 2
        added = self.n_core + len(self.extras) - n
        begins = (-2.0, 0.0) if added == 1 else (0.0,)
        out = [np.insert(simpler, n, [value] * added) for value in begins]
        if self.has_inductance_prior:
            core = np.array([self.typical.get(name, simpler[k]) for k, name in enumerate(self.free)])
            out = [np.concatenate([core, out[-1][self.n_core :]]), out[-1]]
        return out

    def split(self, unknowns: FloatArray) -> tuple[MotorParameters, Extension, float, float]:
        """Parameters of the motor, extension, onset and offset of a vector of unknowns."""
        value = dict(self.base)
        for name, log in zip(self.free, unknowns, strict=False):
            value[name] = self.base[name] * math.exp(log)
        extra = {
            name: self.base_extra[name] * math.exp(log)
            for name, log in zip(self.extras, unknowns[self.n_core :], strict=False)
        }
        parameters = MotorParameters(value["R"], value["L"], value["K"], value["K"], value["J"], value["B"])
        shares: tuple[float, ...] = ()
        if "supply_curve" in self.model:
            parts = np.array([1.0, *(extra[f"curve_{n}"] for n in range(1, CURVE_PARTS))])
            shares = tuple((parts / parts.sum()).tolist())
        extension = Extension(
            extra.get("coulomb", 0.0),
            extra.get("brush_drop", 0.0),
            extra.get("supply_ramp", 0.0),
            shares,
            extra.get("sensor_lag", self.start.circuit.sensor_lag_s),
            extra.get("speed_lag", 0.0),
            extra.get("dead_zone", 0.0),
        )
        return parameters, extension, float(unknowns[-2]), float(unknowns[-1])

    def expected(self, unknowns: FloatArray, start: Start) -> FloatArray:
        """Current and speed that the unknowns predict, offset included, ripple left out."""
        parameters, extension, onset, offset = self.split(unknowns)
        ohm = parameters.resistance_ohm
        circuit = parameters.scaled(resistance_ohm=1.0 + start.circuit.shunt_ohm / ohm)
        states = started(start, circuit, extension, onset)
        if start.alignment.rectified:
            states[:, 0] = _rectified_mean(states[:, 0], start.alignment.noise_a)
        else:
            states[:, 0] += offset
        return states

    def residuals(self, unknowns: FloatArray) -> FloatArray:
        """Weighted residuals of both channels, then those of the priors: curve, inductance, offset."""
        states = self.expected(unknowns, self.start)
        predicted = states.T.ravel() if self.has_speed else states[:, 0]
        out = np.where(self.counted, (self.measured - predicted) / self.scale, 0.0)
        priors = []
        if "supply_curve" in self.model:
            first = self.n_core + self.extras.index("curve_1")
            priors += [*(unknowns[first : first + CURVE_PARTS - 1] / _CURVE_PRIOR_SD)]
        if self.has_inductance_prior:
            priors.append(self.inductance_off(unknowns))
        priors.append((unknowns[-1] - self.start.alignment.offset_a) / self.offset_sd)
        both: FloatArray = np.concatenate([out, priors])
        return np.nan_to_num(both, nan=1e6, posinf=1e6, neginf=-1e6)

    def inductance_off(self, unknowns: FloatArray) -> float:
        """How far L lies from the typical one, in standard deviations of its prior; 0 where none is known."""
        if "L" not in self.typical:
            return 0.0
        return float(unknowns[self.free.index("L")] - self.typical["L"]) / INDUCTANCE_PRIOR_SD

    def is_typical(self, unknowns: FloatArray) -> bool:
        """Whether the textbook parameters are those of the typical motor to a factor of e: no other optimum then."""
        return len(self.typical) == self.n_core and all(
            abs(unknowns[k] - self.typical[name]) < 1.0 for k, name in enumerate(self.free)
        )

    def score(self, simpler: FloatArray) -> float:
        """Score test of the extensions that the simpler fit lacks (Rao 1948): chi-square, one degree, without them.

        How much of the residual a beginning of the extension explains that the other unknowns do not; the most of
        several, for a long lag looks different from a short one.
        """
        n, added = len(simpler) - 2, self.n_core + len(self.extras) - len(simpler) + 2
        absent = np.insert(simpler, n, [-_LARGEST_LOG] * added)
        self.reweight(absent)
        residual = self.residuals(absent)[: len(self.measured)]
        columns = []
        for k in [*range(n), n + added, n + added + 1]:
            moved = absent.copy()
            moved[k] += 1e-4 if k < n else 1e-4 * (self.start.dt_s if k == n + added else self.span)
            columns.append(self.residuals(moved)[: len(self.measured)] - residual)
        basis = np.stack(columns, axis=1)
        basis = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-150)
        begun = [np.insert(simpler, n, [size] * added) for size in _BEGINNINGS]
        moves = np.stack([self.residuals(b)[: len(self.measured)] - residual for b in begun], axis=1)
        moves = moves - basis @ np.linalg.lstsq(basis, moves, rcond=None)[0]
        lengths = np.linalg.norm(moves, axis=0) * float(np.std(residual[self.counted]))
        return float(np.max((residual @ moves / np.maximum(lengths, 1e-150)) ** 2))

    def reweight(self, unknowns: FloatArray) -> None:
        """Weigh each channel by what the fit leaves of it."""
        n = len(self.start.time_s)
        left = self.residuals(unknowns)[: len(self.measured)] * self.scale
        for begin in range(0, len(left), n):
            self.scale[begin : begin + n] = max(float(np.std(left[begin : begin + n])), 1e-9 * self.span)


def absolute(quantities: Mapping[str, float], constant: float) -> dict[str, float]:
    """R, L, K, J and B as far as quantities tell them; K is believed where the current alone was measured.

    The current depends on K^2/J and B/J only, whatever K is believed.
    """
    values = {"K": constant} | {
        name.replace("(J V)", "J").replace("/V", ""): value for name, value in quantities.items()
    }
    if "K^2/J" in values and "B/J" in values:
        values["J"] = constant**2 / values["K^2/J"]
        values["B"] = values["B/J"] * values["J"]
    return values


def started(start: Start, motor: MotorParameters, extension: Extension, onset_s: float) -> FloatArray:
    """Current and speed of a motor in a start, by its step or its measured voltage, shape (n_samples, 2)."""
    if start.voltage_v is None:
        return step_start(motor, extension, start.time_s, onset_s, start.level_v)
    late = start.lateness(onset_s)
    return driven(motor, extension, start.voltage_v, start.dt_s, from_rest=start.from_rest, late=late)


def _rectified_mean(current: FloatArray, noise_a: float) -> FloatArray:
    """Mean of max(i + noise, 0): what a sensor shows that cannot go below 0."""
    if noise_a <= 0.0:
        return np.maximum(current, 0.0)
    z = np.clip(current / noise_a, -40.0, 40.0)
    mean: FloatArray = current * ndtr(z) + noise_a * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return mean
