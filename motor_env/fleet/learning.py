"""What sisters teach about a healthy motor: `motor-env commission --fleet`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from motor_env.diagnosis.commission import interval_lines, intervals
from motor_env.diagnosis.learning import START_SPREAD, learn_starts
from motor_env.diagnosis.misreading import POWERS
from motor_env.diagnosis.motor_files import motor_of_windows, to_motor
from motor_env.diagnosis.running.windows import viscous
from motor_env.errors import InputError, require_several
from motor_env.fitting import places
from motor_env.fitting.starts.identified import Identified
from motor_env.fleet.first import Reading
from motor_env.fleet.fits import FleetFits, fit_fleet
from motor_env.fleet.mapping import Map
from motor_env.fleet.names import Place, places_of
from motor_env.fleet.population import Core, Motors, learn_core
from motor_env.motor import identifiable
from motor_env.motor.data_sheet import Motor, Tolerance
from motor_env.motor.faults import motor_kinds
from motor_env.motor.healthy import Fleet, Healthy, Windows
from motor_env.motor.parameters import FloatArray

FEWEST_SISTERS = 5
BELIEVED = Tolerance(
    supply=0.01,
    resistance=0.075,
    inductance=0.10,
    constants=0.03,
    inertia=0.075,
    friction=0.35,
    temperature_k=0.0,
)
"""Spread from motor to motor that is believed before any is seen: about that of a fleet of real gear motors (see
docs/fleet.md). One that is too small costs false alarms in small fleets, one that is too large costs power."""
_MANY = 500
_GAINS = ("voltage", "current", "speed")
_NONE = 1e-6
_LOST = 0.5  # probability of the core below which a motor teaches nothing of how starts are recorded


@dataclass(frozen=True)
class LearnedFleet:
    """A fleet, and the healthy core of its motors.

    Attributes:
        fits: of its records.
        every: all files with their motors, those that no motor explains too.
    """

    fits: FleetFits
    every: dict[Path, Place]

    @cached_property
    def motors(self) -> list[Place]:
        """Whose records were fitted."""
        return list(dict.fromkeys(self.every[path] for path in self.fits.seconds))

    @property
    def positions(self) -> list[str]:
        """Places in a machine, such as left and right."""
        return sorted({motor.motor for motor in self.motors})

    @cached_property
    def records(self) -> Motors:
        """What the records tell."""
        exponents, seconds = identifiable.matrix(self.fits.quantities), self.fits.seconds
        return Motors(
            np.array([one.log_values for one in seconds.values()]),
            np.array([one.log_covariance for one in seconds.values()]),
            np.array([self.motors.index(self.every[path]) for path in seconds]),
            np.array([self.positions.index(motor.motor) for motor in self.motors]),
            exponents @ identifiable.tolerance_covariance(BELIEVED) @ exponents.T + _least(exponents),
            np.eye(len(exponents)) * START_SPREAD**2,
            directions_of(exponents),
        )

    @cached_property
    def core(self) -> Core:
        """The healthy core of all motors."""
        return learn_core(self.records)

    def core_without(self, machine: str) -> Core:
        """The core of all other machines."""
        if len({motor.machine for motor in self.motors}) > _MANY:
            return self.core  # one machine of so many moves nothing
        kept = np.array([motor.machine != machine for motor in self.motors])
        others = self.records.only(kept)
        if len(np.unique(others.position)) < len(self.positions):
            raise InputError(f"no other machine than {machine} has a motor in the same place")
        return learn_core(others, begin=self.core)

    def motor(self, name: str, core: Core | None = None, position: str | None = None) -> Motor:
        """The healthy motor, as motor files hold it.

        Args:
            name: of it.
            core: of the motors; that of all unless given.
            position: place in the machine; without it, a motor of any place.
        """
        healthy = self._healthy(self.core if core is None else core, position)
        if self.fits.windows is not None:
            volts = (self.fits.windows.peaks or (None,))[0]
            return replace(motor_of_windows(healthy, name), nominal_voltage_v=volts)
        return to_motor(self._good, name, healthy=healthy)

    def _healthy(self, core: Core, position: str | None = None) -> Healthy:
        """What a core teaches of another motor."""
        centre, covariance = self._next(core, position)
        count = len(core.probability)
        return Healthy(
            count,
            core.degrees_of_freedom,
            self.fits.quantities,
            np.exp(centre),
            covariance,
            0.0,
            windows=None if self.fits.windows is None else at_centre(self.fits.windows, centre),
            starts=None if self.fits.windows is not None else learn_starts(self._good).starts,
            fleet=Fleet(count, core.within),
        )

    @cached_property
    def _good(self) -> list[Identified]:
        """Starts of motors that seem healthy."""
        seen = zip(self.fits.seconds.values(), self.core.probability[self.records.motor], strict=True)
        return [one for one, sure in seen if isinstance(one, Identified) and sure > _LOST]

    def _next(self, core: Core, position: str | None) -> tuple[FloatArray, FloatArray]:
        """Centre and covariance of another healthy motor's record."""
        if position is not None:
            at = self.positions.index(position)
            return core.centres[at], core.next_motor(at) + core.within
        centre, off = core.centres.mean(axis=0), core.centres - core.centres.mean(axis=0)
        apart = off.T @ off / max(len(off) - 1, 1)
        return centre, core.between + core.centre_covariances.mean(axis=0) + apart + core.within

    def text(self, rate: float) -> str:
        """What was learned, with the interval of the next healthy motor."""
        one = self._healthy(self.core)
        sick = int(np.sum(self.core.probability < _LOST))
        seem = "seems sick, and teaches" if sick == 1 else "seem sick, and teach"
        lines = [
            f"{len(self.motors)} motors with {len(self.fits.seconds)} records; {sick} of them {seem} nothing",
            f"interval of the next healthy motor ({1.0 - rate:.0%}, Student t, {one.degrees_of_freedom:.0f} degrees)",
            *interval_lines(intervals(one, one.log_covariance, rate)),
            *self._positions(),
            *self.fits.read,
            *(f"  not used: {path} ({reason})" for path, reason in self.fits.troubles.items()),
        ]
        return "\n".join(lines)

    def _positions(self) -> list[str]:
        if len(self.positions) < 2:
            return []
        off = np.expm1(self.core.centres - self.core.centres.mean(axis=0))
        return [
            f"  {position}: "
            + ", ".join(
                f"{name} {one:+.0%}" for name, one in zip(self.fits.quantities, row.tolist(), strict=True)
            )
            for position, row in zip(self.positions, off, strict=True)
        ]


def directions_of(exponents: FloatArray) -> FloatArray:
    """In which directions faults and gains of sensors move quantities, shape (m, p).

    Args:
        exponents: of (R, L, K, J, B, V) in each quantity, shape (p, 6).
    """
    gains = [
        exponents @ [POWERS[column].get(name, 0.0) for name in identifiable.PARAMETERS] for column in _GAINS
    ]
    faults = [identifiable.visible_direction(kind, exponents) for kind in motor_kinds()]
    return np.array([one for one in (*gains, *faults) if np.linalg.norm(one) > _NONE])


def _least(exponents: FloatArray) -> FloatArray:
    """So that the covariance of quantities which share their parameters has an inverse."""
    return np.eye(len(exponents)) * 1e-4**2


def at_centre(windows: Windows, centre: FloatArray) -> Windows:
    """How windows are fitted, about a motor of these logarithms of R, K, J and the drag over the speed."""
    known = windows.physical.copy()
    drag = math.exp(centre[3]) / viscous(known, windows.speed_rad_s)
    known[[places.R, places.K, places.J]] = np.exp(centre[:3])
    known[[places.B, places.COULOMB]] *= drag
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
    """Learn a healthy motor from sisters, of which some may be sick.

    Args:
        files: recordings; each of another motor, unless names tell otherwise.
        group: regular expression that reads machine, motor and repeat from a file's name, see `places_of`.
        reading: how the files are read.
        each: what maps over files, see `motor_env.fleet.mapping.processes`.
        kept: file that keeps first fits, so that a fleet that was stopped goes on where it was.
        progress: told each file, twice.

    Raises:
        InputError: too few motors, or records that cannot be used together.
    """
    require_several("files", files, (str, Path))
    files = [Path(path) for path in files]
    if len({path.resolve() for path in files}) < len(files):
        raise InputError("a record of the fleet is given twice: it would count as two motors")
    every = dict(zip(files, places_of(files, group), strict=True))
    fits = fit_fleet(files, reading or Reading(), each=each, kept=kept, progress=progress)
    learned = LearnedFleet(fits, every)
    count = len(learned.motors)
    if count < FEWEST_SISTERS:
        raise InputError(f"a fleet needs at least {FEWEST_SISTERS} motors that can be fitted, got {count}")
    return learned
