"""What a recipe's motors at work look like, and what departures do there.

Around the most probable motor (`work_fit`) readings are linear in the coordinates of `ClassModel`. So how probable a
record is under any normal prior of these coordinates is known in closed form (Bishop 2006, eq. 3.86), and a departure
is a prior that is wider in one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from motor_classifiers.wrappers.world import ANYWHERE, SEED, SIZES, WIDER, Levels, single_starts
from motor_datasets.generate import generate_arrays
from motor_env.inference.class_model import ClassModel
from motor_env.inference.work_features import any_fault, class_positions, most_probable, work_fit
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.disturbances import PRIORS, Field
from motor_env.simulation.recipes import FACTORS, Recipe

_SURE = 1e-6  # variance of a coordinate that is known
_UNIFORM = 1.0 / 12.0  # variance of a uniform coordinate
_UNEXPLAINED = 1.5  # mean square of what is left, above which a record is fitted as any motor's
_WHITE = 0.3  # correlation of neighbours, above which what is left is no noise
_REACH = 4.0  # of such a fit, in standard deviations
_LEAST = 0.05  # of a parameter that can be simulated, relative to the nominal one
_CALIBRATION = 4_000
_AT_ONCE = 64
_UNITS = {
    "offset": ("sensor_offset_a",),
    "gain": ("sensor_gain",),
    "warmth": ("temperature_rise_k",),
    "load": ("load_ratio", "load_end_ratio"),
}
"""Priors of the tables field and duty in which a departure sits."""


def _ranged(recipe: Recipe, sizes: Mapping[str, float]) -> Field:
    """The recipe's field, with a range for every prior in which a departure sits."""
    field = Field() if recipe.field is None else recipe.field
    ranges = {}
    for departure, names in _UNITS.items():
        for name in set(names) & set(PRIORS):
            low, high = getattr(field, name)
            ranges[name] = (low, high if low < high else low + sizes[departure])
    return replace(field, **ranges)  # type: ignore[arg-type]  # names of ranges


class WorkCoordinates(NamedTuple):
    """Records, each with the motor that is linear around its fit.

    Attributes:
        values: where the motor was made linear, shape (n, size).
        information: of the readings alone, shape (n, size, size).
        pull: slope of the log likelihood there, shape (n, size).
        energy: squares of the noise left there, shape (n,).
        correlation: of neighbours in what is left, shape (n,): 0 for white noise.
    """

    values: FloatArray
    information: FloatArray
    pull: FloatArray
    energy: FloatArray
    correlation: FloatArray


class Prior(NamedTuple):
    """Independent normal coordinates, one set a class.

    Attributes:
        log_weight: shape (n_classes,).
        mean: shape (n_classes, size).
        variance: shape (n_classes, size).
    """

    log_weight: FloatArray
    mean: FloatArray
    variance: FloatArray

    def wider(self, extra: FloatArray) -> Prior:
        """A prior with so much variance more."""
        return self._replace(variance=self.variance + extra)


@dataclass(frozen=True, slots=True)
class WorkWorld:
    """What a recipe's motors at work look like, and what they look like where something is off.

    Attributes:
        recipe: what motors are drawn from.
        model: its motors with any fault, and with the coordinates of all departures.
        known: which coordinates the recipe's own motors have, shape (size,).
        box: smallest and largest coordinates of any motor that is simulated, shape (2, size).
        own: the recipe's motors.
        anything: any motor in any surroundings.
        departures: the recipe's motors with one departure, by its name.
    """

    recipe: Recipe
    model: ClassModel
    known: NDArray[np.bool_]
    box: FloatArray
    own: Prior
    anything: Prior
    departures: Mapping[str, Prior]

    @classmethod
    def from_recipe(cls, recipe: Recipe) -> WorkWorld:
        """The priors of a recipe with a table `duty`.

        Raises:
            ValueError: a recipe of failed sensors.
        """
        recipe.require_motor_faults()
        single = single_starts(recipe)
        stall_a = float(np.max(single.supply.voltage_v)) / float(single.motor.resistance_ohm)
        sizes = SIZES | {"offset": SIZES["offset"] * stall_a}
        wide = replace(single, field=_ranged(single, sizes))
        fault = any_fault(single)
        model = ClassModel(wide, fault)
        names = model.names
        known = np.isin(names, ClassModel(single, fault).names)
        factors, kinds = slice(len(FACTORS)), slice(-len(fault.parts), None)
        # Coordinates of departures alone begin at the usual value, of which the recipe's motors are sure.
        usual = np.where(known, 0.5, 0.0), np.where(known, _UNIFORM, _SURE)
        usual[0][factors], usual[1][factors] = 0.0, 1.0
        positions, spans = class_positions(single)
        mean, variance = (np.tile(each, (len(positions), 1)) for each in usual)
        mean[:, kinds], variance[:, kinds] = positions, np.maximum(_UNIFORM * np.square(spans), _SURE)
        with np.errstate(divide="ignore"):  # a class that is never drawn
            own = Prior(np.log(single.class_probabilities), mean, variance)
        widths = {name: np.zeros(len(names)) for name in (*_UNITS, "severity", "another motor")}
        for departure, name in ((d, n) for d, priors in _UNITS.items() for n in priors if n in names):
            begin, end = wide.priors[name]
            widths[departure][names.index(name)] = sizes[departure] / (end - begin)
        tops = np.array([part.largest_severity for part in fault.parts])[::-1]
        widths["severity"][kinds] = sizes["severity"] / tops
        spread = single.spread.std
        widths["another motor"][factors] = np.divide(
            sizes["another motor"], spread, out=np.zeros_like(spread), where=spread > 0.0
        )
        extras = {name: np.square(width) for name, width in widths.items() if width.any()}
        middle = single.class_probabilities @ mean
        every = single.class_probabilities @ (variance + np.square(mean - middle))
        departed = np.array([*extras.values()]).sum(axis=0)
        anything = Prior(np.zeros(1), middle[None], (WIDER * every + ANYWHERE * departed)[None])
        reach = _REACH * np.sqrt(WIDER * every + departed)
        low, high = middle - reach, middle + reach
        # Frictions and drops cannot be negative, parameters not zero, and severities have the box of their fit.
        signed = np.isin(names, (*FACTORS, *_UNITS["warmth"], *_UNITS["load"]))
        low = np.where(known & ~signed, 0.0, low)
        low[factors] = np.maximum(low[factors], (_LEAST - 1.0) / np.maximum(spread, _SURE))
        low[kinds], high[kinds] = 0.0, 1.0
        departures = {name: own.wider(extra) for name, extra in extras.items()}
        return cls(single, model, known, np.array([low, high]), own, anything, departures)

    @property
    def freedom(self) -> int:
        """Values of a record less the coordinates that are fitted."""
        return len(self.model.noise) - int(self.known.sum())

    def coordinates(self, flat: FloatArray) -> WorkCoordinates:
        """Fit records, `flat` of shape (n, n_values), and make the motor linear there."""
        cases = flat.reshape(len(flat), len(self.recipe.channels), -1)
        parts = [self._located(cases[begin : begin + _AT_ONCE]) for begin in range(0, len(cases), _AT_ONCE)]
        return WorkCoordinates(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _located(self, cases: FloatArray) -> WorkCoordinates:
        n, size = len(cases), len(self.known)
        values = np.zeros((n, size))
        values[:, self.known] = work_fit(self.recipe, cases).simulated
        here = self._linear(cases, values, enough=np.inf)
        foreign = here.energy > _UNEXPLAINED * self.freedom
        if foreign.any():
            for part, better in zip(here, self._linear(cases[foreign], values[foreign]), strict=True):
                part[foreign] = better
        return here

    def _linear(self, cases: FloatArray, values: FloatArray, **ends: float) -> WorkCoordinates:
        """Motors made linear, after steps to the most probable one of all motors."""
        (mean,), (variance,) = self.anything.mean, self.anything.variance
        fit = most_probable(
            self.model,
            cases[:, :-1].reshape(len(cases), -1),
            cases[:, -1],
            begin=values,
            centre=mean,
            precision=1.0 / variance,
            box=self.box,
            **ends,
        )
        energy = np.square(fit.left).sum(axis=1)
        correlation = (fit.left[:, 1:] * fit.left[:, :-1]).sum(axis=1) / energy
        return WorkCoordinates(fit.at, fit.information, fit.pull, energy, correlation)

    def distance(self, at: WorkCoordinates, levels: Levels) -> FloatArray:
        """Log likelihood ratio of anything to the recipe, shape (n,); `levels` are those that the recipe allows."""
        return self._evidence(self.anything, at, (levels[0], np.inf)) - self._evidence(self.own, at, levels)

    def off(self, at: WorkCoordinates, levels: Levels) -> NDArray[Any]:
        """What is off in records that are not of the recipe: a key of `outside.ADVICE`, shape (n,)."""
        logs = [self._evidence(self.own, at, (levels[0], np.inf))]
        logs += [self._evidence(prior, at, levels) for prior in self.departures.values()]
        names = np.array(["noise", *self.departures], dtype=object)
        found: NDArray[Any] = names[np.argmax(logs, axis=0)]
        left = at.energy > _UNEXPLAINED * levels[1] * self.freedom
        return np.where(left, np.where(at.correlation > _WHITE, "another motor", "noise"), found)

    def _evidence(self, prior: Prior, at: WorkCoordinates, levels: Levels) -> FloatArray:
        """Log density of the records, up to one constant of each, shape (n,).

        Within the levels the variance of the noise is read off what each class leaves over.
        """
        logs = []
        for weight, mean, variance in zip(*prior, strict=True):
            away = (mean - at.values) / variance
            precision = np.diag(1.0 / variance)
            step = np.linalg.solve(at.information + precision, (at.pull + away)[..., None])[..., 0]
            moved = np.einsum("nij,nj->ni", at.information, step) - 2.0 * at.pull
            level = np.clip((at.energy + (step * moved).sum(axis=1)) / self.freedom, *levels)
            information = at.information / level[:, None, None] + precision
            pull = at.pull / level[:, None] + away
            gained = (pull * np.linalg.solve(information, pull[..., None])[..., 0]).sum(axis=1)
            spent = np.square(away) @ variance + np.log(variance).sum() + np.linalg.slogdet(information)[1]
            noise = at.energy / level + len(self.model.noise) * np.log(level)
            logs.append(weight + 0.5 * (gained - spent - noise))
        density: FloatArray = logsumexp(logs, axis=0)
        return density

    def fresh(self, level: float) -> WorkCoordinates:
        """Motors of the recipe at so many times the noise's variance."""
        louder = self.recipe.sensor.with_noise(np.sqrt(level))
        drawn = generate_arrays(replace(self.recipe, sensor=louder), SEED, _CALIBRATION)
        return self.coordinates(drawn.X.reshape(_CALIBRATION, -1).astype(np.float64))
