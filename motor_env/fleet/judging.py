"""Each motor of a fleet judged by its sisters: `motor-env diagnose --fleet`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.console import ExitStatus, worst
from motor_env.diagnosis.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.hypotheses import Difference
from motor_env.diagnosis.scaling_errors import describe_scaling_errors, find_scaling_errors
from motor_env.errors import InputError, require_options
from motor_env.fleet.first import Reading
from motor_env.fleet.learning import LearnedFleet, learn_fleet
from motor_env.fleet.mapping import Map
from motor_env.fleet.names import Place
from motor_env.fleet.picture import picture
from motor_env.fleet.population import Core
from motor_env.fleet.sister import Sister
from motor_env.motor import identifiable
from motor_env.pages.html import render

_GAINS = 3  # of voltage, current and speed


@dataclass(frozen=True, slots=True)
class FleetDiagnosis:
    """A fleet, judged.

    Attributes:
        sisters: the motors, the oddest first.
        quantities: that were compared.
        false_alarm_rate: of each healthy motor.
    """

    sisters: tuple[Sister, ...]
    quantities: tuple[str, ...]
    false_alarm_rate: float

    @property
    def status(self) -> ExitStatus:
        """Exit status: that of the worst motor."""
        return worst(sister.verdict.status for sister in self.sisters)

    def to_json(self) -> list[dict[str, Any]]:
        """An object a motor, the oddest first."""
        return [sister.to_json() for sister in self.sisters]

    @property
    def summary(self) -> str:
        """How many are odd, and how many would be by chance."""
        odd = sum(sister.verdict.is_fault for sister in self.sisters)
        chance = self.false_alarm_rate * len(self.sisters)
        stand, share = "stands" if odd == 1 else "stand", 1.0 / self.false_alarm_rate
        return (
            f"{odd} of {len(self.sisters)} motors {stand} out."
            f" If all were healthy, about {chance:.1f} motors would stand out by chance (1 in {share:.0f})."
        )

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """A table, the oddest motor first."""
        width = max(len(sister.place.name) for sister in self.sisters)
        rows = [
            f"{sister.place.name:<{width}}  {sister.verdict:<12} {sister.shown_severity:>6}  {sister.shown}"
            for sister in self.sisters
        ]
        return "\n".join([self.summary, *rows])

    def page(self) -> str:
        """A self-contained HTML page: a picture of the fleet, and the table."""
        return render(
            "motor_env.fleet",
            "fleet.html.j2",
            title="A motor among its sisters",
            summary=self.summary,
            chart=picture(self.quantities, self.sisters),
            sisters=self.sisters,
        )


def diagnose_fleet(
    files: Sequence[Path],
    *,
    group: str | None = None,
    reading: Reading | None = None,
    false_alarm_rate: float = DEFAULT_FALSE_ALARM_RATE,
    each: Map = map,
    kept: Path | None = None,
    progress: Callable[[Path], None] = lambda path: None,
) -> FleetDiagnosis:
    """Judge each motor of a fleet by all others; those of its own machine teach nothing about it.

    Args:
        files: recordings, see `learn_fleet`.
        group: regular expression that reads machine, motor and repeat from a file's name.
        reading: how the files are read.
        false_alarm_rate: how often a healthy motor may be called faulty.
        each: what maps over files, see `motor_env.fleet.mapping.processes`.
        kept: file that keeps first fits, so that a fleet that was stopped goes on where it was.
        progress: told each file, twice.

    Raises:
        InputError: too few motors, or records that cannot be used together.
    """
    require_options(false_alarm_rate=false_alarm_rate)
    fleet = learn_fleet(files, group=group, reading=reading, each=each, kept=kept, progress=progress)
    machines = list(dict.fromkeys(place.machine for place in fleet.every.values()))
    job = partial(_of_machine, fleet, false_alarm_rate)
    found = [sister for sisters in each(job, machines) for sister in sisters]
    found.sort(key=lambda one: (not one.verdict.is_fault, 0.0 if one.p_value is None else one.p_value))
    return FleetDiagnosis(tuple(found), fleet.fits.quantities, false_alarm_rate)


def _of_machine(fleet: LearnedFleet, rate: float, machine: str) -> list[Sister]:
    """The motors of a machine, judged by those of all others."""
    core, found = fleet.core_without(machine), []
    for place in dict.fromkeys(one for one in fleet.every.values() if one.machine == machine):
        if place.motor not in fleet.positions:
            raise InputError(
                f"no motor of the place {place.motor} can be fitted: nothing judges {place.name}"
            )
        own = [path for path, one in fleet.every.items() if one == place]
        motor = fleet.motor("a healthy one", core, place.motor)
        records = {
            path: diagnose(path, motor, false_alarm_rate=rate / len(own), **fleet.fits.reading.options)
            for path in own
        }
        found.append(Sister(place, records, fleet.fits.quantities, _apart(fleet, core, place)))
    alike = together([one.apart for one in found if one.apart is not None], fleet.fits.quantities, rate)
    return [replace(one, together=alike) for one in found]


def together(apart: Sequence[Difference], names: tuple[str, ...], rate: float) -> str:
    """What the motors of a machine show together: one sensor or supply at a wrong scale; empty for nothing.

    Each motor may be too little off by itself.
    """
    if len(apart) < 2:
        return ""
    off = np.mean([one.log_ratios for one in apart], axis=0)
    spread = np.mean([one.covariance for one in apart], axis=0) / len(apart)
    limit = -float(stdtrit(apart[0].degrees_of_freedom, rate / (2.0 * _GAINS)))
    mean = replace(apart[0], log_ratios=off, covariance=spread)
    return describe_scaling_errors(
        [one for one in find_scaling_errors(mean, names, limit, rate) if one.gain is not None]
    )


def _apart(fleet: LearnedFleet, core: Core, place: Place) -> Difference | None:
    """How far a motor lies from the core; None where no fit tells."""
    if place not in fleet.motors:
        return None
    number = fleet.motors.index(place)
    kept = np.array([n == number for n in range(len(fleet.motors))])
    logs, errors = fleet.records.only(kept).means(core.within)
    at = fleet.positions.index(place.motor)
    return Difference(
        logs[0] - core.centres[at],
        core.next_motor(at) + errors[0],
        identifiable.matrix(fleet.fits.quantities),
        core.degrees_of_freedom,
    )
