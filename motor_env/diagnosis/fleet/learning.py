"""Learn a healthy motor from a fleet, and from its own records: `motor-env commission --fleet`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_env.common.errors import InputError, require_several
from motor_env.diagnosis.commission import interval_lines, intervals
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.fleet.fits import FleetFits, Map, Reading, fit_fleet
from motor_env.diagnosis.fleet.population import HealthyPopulation, Motors, floor_covariance, learn_population
from motor_env.diagnosis.operation.windows import viscous
from motor_env.diagnosis.verdict.healthy_motor import motor_of_windows, to_motor
from motor_env.diagnosis.verdict.healthy_spread import PRIOR_WEIGHT, START_SPREAD, learn_starts
from motor_env.diagnosis.verdict.hypotheses import Fitted
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.diagnosis.verdict.scaling_errors import POWERS
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Motor, Tolerance
from motor_env.motor.faults import motor_kinds
from motor_env.motor.healthy import Fleet, Healthy, Windows
from motor_env.motor.parameters import FloatArray

FEWEST_UNITS = 5
PRIOR_SPREAD = Tolerance(
    supply=0.01,
    resistance=0.075,
    inductance=0.10,
    constants=0.03,
    inertia=0.075,
    friction=0.35,
    temperature_k=0.0,
)
"""Prior spread from motor to motor, about that of real gear motors (docs/fleet.md). Too small costs false alarms in
small fleets, too large costs power."""
_MANY = 500
_GROUPS = ("machine", "motor", "repeat")
_GAINS = ("voltage", "current", "speed")
_NONE = 1e-6
_LEAST_PROBABILITY = 0.5  # of a healthy motor, for its starts to count


class UnitId(NamedTuple):
    """Machine and motor.

    Attributes:
        machine: its name.
        motor: place in the machine, such as left; empty for machines of one motor.
    """

    machine: str
    motor: str = ""

    @property
    def name(self) -> str:
        """Both names, as in tables."""
        return f"{self.machine} {self.motor}".strip()


def unit_ids(files: Sequence[Path], group: str | None) -> list[UnitId]:
    """Read machine and motor from each file's name.

    Args:
        files: recordings.
        group: regular expression for the stem of a name, with groups machine, motor and repeat; None if each file is a
            machine.

    Raises:
        InputError: not a regular expression, or no match.
    """
    if group is None:
        return [UnitId(path.stem) for path in files]
    try:
        pattern = re.compile(group)
    except re.error as error:
        raise InputError(f"--group must be a regular expression, got {group!r} ({error})") from None
    known = set(pattern.groupindex)
    if not known or known - set(_GROUPS):
        raise InputError(f"--group must have named groups of {', '.join(_GROUPS)}, got {sorted(known)}")
    if not known & {"machine", "motor"}:
        raise InputError("--group must have a group machine or motor: a repeat alone names no motor")
    matched = []
    for path in files:
        match = pattern.search(path.stem)
        if match is None:
            raise InputError(f"{path}: --group {group!r} does not match its name")
        parts = match.groupdict(default="")
        # Motors without machines are machines of one motor each.
        machine = parts.get("machine") or parts.get("motor", "")
        matched.append(UnitId(machine, parts.get("motor", "") if "machine" in known else ""))
    return matched


@dataclass(frozen=True)
class LearnedFleet:
    """Fleet with the healthy population of its motors.

    Attributes:
        fits: of its records.
        unit_of: motor of each file.
    """

    fits: FleetFits
    unit_of: dict[Path, UnitId]

    @cached_property
    def motors(self) -> list[UnitId]:
        """Motors whose records were fitted."""
        return list(dict.fromkeys(self.unit_of[path] for path in self.fits.by_file))

    @property
    def positions(self) -> list[str]:
        """Places in a machine."""
        return sorted({motor.motor for motor in self.motors})

    @cached_property
    def records(self) -> Motors:
        """Collect the quantities of the records."""
        exponents, by_file = identifiable.matrix(self.fits.quantities), self.fits.by_file
        return Motors(
            np.array([fit.log_values for fit in by_file.values()]),
            np.array([fit.log_covariance for fit in by_file.values()]),
            np.array([self.motors.index(self.unit_of[path]) for path in by_file]),
            np.array([self.positions.index(motor.motor) for motor in self.motors]),
            exponents @ identifiable.tolerance_covariance(PRIOR_SPREAD) @ exponents.T
            + _regulariser(exponents),
            np.eye(len(exponents)) * START_SPREAD**2,
            directions_of(exponents),
        )

    @cached_property
    def population(self) -> HealthyPopulation:
        """Learn the healthy population of all motors."""
        return learn_population(self.records)

    def population_without(self, machine: str) -> HealthyPopulation:
        """Learn the population of all other machines."""
        if len({motor.machine for motor in self.motors}) > _MANY:
            return self.population  # one machine of so many moves nothing
        kept = np.array([motor.machine != machine for motor in self.motors])
        others = self.records.subset(kept)
        if len(np.unique(others.position)) < len(self.positions):
            raise InputError(f"no other machine than {machine} has a motor in the same place")
        return learn_population(others, begin=self.population)

    def motor(
        self, name: str, population: HealthyPopulation | None = None, position: str | None = None
    ) -> Motor:
        """Return the healthy motor.

        Args:
            name: of the motor.
            population: of healthy motors; that of all unless given.
            position: place in the machine; any without.
        """
        healthy = self._healthy(self.population if population is None else population, position)
        if self.fits.windows is not None:
            volts = (self.fits.windows.peaks or (None,))[0]
            return replace(motor_of_windows(healthy, name), nominal_voltage_v=volts)
        return to_motor(self._healthy_starts, name, healthy=healthy)

    def _healthy(self, population: HealthyPopulation, position: str | None = None) -> Healthy:
        centre, covariance = self._predictive(population, position)
        count = len(population.probability)
        return Healthy(
            count,
            population.degrees_of_freedom,
            self.fits.quantities,
            np.exp(centre),
            covariance,
            0.0,
            windows=None if self.fits.windows is None else at_centre(self.fits.windows, centre),
            starts=None if self.fits.windows is not None else learn_starts(self._healthy_starts).starts,
            fleet=Fleet(count, population.within),
        )

    @cached_property
    def _healthy_starts(self) -> list[StartFit]:
        pairs = zip(self.fits.by_file.values(), self.population.probability[self.records.motor], strict=True)
        return [fit for fit, sure in pairs if isinstance(fit, StartFit) and sure > _LEAST_PROBABILITY]

    def _predictive(
        self, population: HealthyPopulation, position: str | None
    ) -> tuple[FloatArray, FloatArray]:
        if position is not None:
            at = self.positions.index(position)
            return population.centres[at], population.next_motor(at) + population.within
        centre, deviations = (
            population.centres.mean(axis=0),
            population.centres - population.centres.mean(axis=0),
        )
        between_positions = deviations.T @ deviations / max(len(deviations) - 1, 1)
        return centre, population.between + population.centre_covariances.mean(
            axis=0
        ) + between_positions + population.within

    def text(self, rate: float) -> str:
        """Describe the population, with the interval of the next healthy motor."""
        healthy, freedom = self._healthy(self.population), self.population.degrees_of_freedom
        sick = int(np.sum(self.population.probability < _LEAST_PROBABILITY))
        seem = "seems sick, and teaches" if sick == 1 else "seem sick, and teach"
        lines = [
            f"{len(self.motors)} motors with {len(self.fits.by_file)} records; {sick} of them {seem} nothing",
            f"interval of the next healthy motor ({1.0 - rate:.0%}, Student t, {freedom:.0f} degrees)",
            *interval_lines(intervals(healthy, healthy.log_covariance, rate)),
            *self._positions(),
            *self.fits.read,
            *(f"  not used: {path} ({reason})" for path, reason in self.fits.failures.items()),
        ]
        return "\n".join(lines)

    def _positions(self) -> list[str]:
        if len(self.positions) < 2:
            return []
        deviations = np.expm1(self.population.centres - self.population.centres.mean(axis=0))
        return [
            f"  {position}: "
            + ", ".join(
                f"{name} {change:+.0%}"
                for name, change in zip(self.fits.quantities, row.tolist(), strict=True)
            )
            for position, row in zip(self.positions, deviations, strict=True)
        ]


def directions_of(exponents: FloatArray) -> FloatArray:
    """List the directions of faults and sensor gains, shape (m, p).

    Args:
        exponents: of (R, L, K, J, B, V) in each quantity, shape (p, 6).
    """
    gains = [
        exponents @ [POWERS[column].get(name, 0.0) for name in identifiable.PARAMETERS] for column in _GAINS
    ]
    faults = [identifiable.visible_direction(kind, exponents) for kind in motor_kinds()]
    return np.array([direction for direction in (*gains, *faults) if np.linalg.norm(direction) > _NONE])


def _regulariser(exponents: FloatArray) -> FloatArray:
    return np.eye(len(exponents)) * 1e-4**2


def at_centre(windows: Windows, centre: FloatArray) -> Windows:
    """Set the windows' parameters to logarithms of R, K, J and the drag over the speed."""
    known = windows.physical.copy()
    drag = math.exp(centre[3]) / viscous(known, windows.speed_rad_s)
    known[[index.R, index.K, index.J]] = np.exp(centre[:3])
    known[[index.B, index.COULOMB]] *= drag
    return replace(windows, physical=known)


def learn_fleet(
    files: Sequence[Path],
    *,
    group: str | None = None,
    reading: Reading | None = None,
    each: Map = map,
    kept: Path | None = None,
    progress: Callable[[Path], None] = lambda path: None,
) -> LearnedFleet:
    """Learn a healthy motor from motors of one make; some may be faulty.

    Args:
        files: recordings; without `group` each of another motor.
        group: regular expression for names, see `unit_ids`.
        reading: options for reading.
        each: maps over files, see `motor_env.diagnosis.fleet.fits.processes`.
        kept: file of first fits, to continue a stopped run.
        progress: called with each file, twice.

    Raises:
        InputError: too few motors, or records that cannot be used together.
    """
    require_several("files", files, (str, Path))
    files = [Path(path) for path in files]
    if len({path.resolve() for path in files}) < len(files):
        raise InputError("a record of the fleet is given twice: it would count as two motors")
    every = dict(zip(files, unit_ids(files, group), strict=True))
    fits = fit_fleet(files, reading or Reading(), each=each, kept=kept, progress=progress)
    learned = LearnedFleet(fits, every)
    count = len(learned.motors)
    if count < FEWEST_UNITS:
        raise InputError(f"a fleet needs at least {FEWEST_UNITS} motors that can be fitted, got {count}")
    return learned


def update_unit(
    files: Sequence[str | Path], fleet_motor: Motor, name: str, *, reading: Reading | None = None
) -> Motor:
    """Learn the healthy motor from its records and its fleet.

    Args:
        files: healthy records of this motor.
        fleet_motor: learned from a fleet, or by this function.
        name: of the motor.
        reading: options for reading.

    Raises:
        InputError: the motor does not come from a fleet, or a record cannot be used.
    """
    healthy = fleet_motor.healthy
    if healthy is None or healthy.fleet is None:
        raise InputError("--motor must be a motor file that `motor-env commission --fleet` has written")
    fits = [fit for path in files for fit in _fits(Path(path), fleet_motor, reading or Reading())]
    learned = combine_with_records(
        healthy,
        np.array([fit.log_values for fit in fits]),
        np.array([fit.log_covariance for fit in fits]),
    )
    return replace(fleet_motor, name=name, healthy=learned)


def unit_quantities(motor: Motor) -> dict[str, dict[str, Any]]:
    """List value, interval (95 %) and unit of each quantity of a motor of `update_unit`."""
    healthy = motor.healthy
    assert healthy is not None  # noqa: S101  # it was learned
    assert healthy.fleet is not None  # noqa: S101  # it was learned from a fleet
    return intervals(healthy, np.maximum(healthy.log_covariance - healthy.fleet.log_within, 0.0), 0.05)


def combine_with_records(healthy: Healthy, logs: FloatArray, errors: FloatArray) -> Healthy:
    """Combine a fleet's motor with records.

    Args:
        healthy: statistics of the fleet.
        logs: logarithms of the quantities of each record, shape (n, p).
        errors: their covariance by the fit, shape (n, p, p).
    """
    assert healthy.fleet is not None  # noqa: S101  # the callers have seen to it
    within = _within_covariance(logs, errors, healthy.fleet)
    between = floor_covariance(
        healthy.log_covariance - healthy.fleet.log_within, 1e-6 * healthy.log_covariance
    )
    prior, information = np.linalg.inv(between), np.linalg.inv(within + errors)
    posterior = np.linalg.inv(prior + information.sum(axis=0))
    centre = posterior @ (prior @ np.log(healthy.values) + np.einsum("npq,nq->p", information, logs))
    return replace(
        healthy,
        pieces=len(logs),
        degrees_of_freedom=healthy.degrees_of_freedom + len(logs),
        values=np.exp(centre),
        log_covariance=posterior + within,
        windows=None if healthy.windows is None else at_centre(healthy.windows, centre),
        fleet=replace(healthy.fleet, log_within=within),
    )


def _fits(path: Path, fleet_motor: Motor, reading: Reading) -> list[Fitted]:
    """Fit a record's pieces.

    Raises:
        InputError: no pieces, or other quantities than the fleet.
    """
    diagnosis = diagnose(path, fleet_motor, **reading.options)
    fits = [
        piece.fit
        for piece in diagnosis.pieces
        if piece.fit is not None and piece.verdict is not Verdict.UNUSABLE
    ]
    if not fits:
        raise InputError(f"{path}: a healthy record cannot be used: {diagnosis.reasons[0]}")
    names = fleet_motor.healthy.quantities if fleet_motor.healthy is not None else ()
    if any(fit.quantity_names != names for fit in fits):
        raise InputError(
            f"{path}: its columns are not those of the other motors, which give {', '.join(names)}"
        )
    return fits


def _within_covariance(logs: FloatArray, errors: FloatArray, fleet: Fleet) -> FloatArray:
    deviations = logs - logs.mean(axis=0)
    scatter = deviations.T @ deviations - max(len(logs) - 1, 0) * errors.mean(axis=0)
    spread = (scatter + PRIOR_WEIGHT * fleet.log_within) / (len(logs) - 1 + PRIOR_WEIGHT)
    return floor_covariance(spread, fleet.log_within / PRIOR_WEIGHT)
