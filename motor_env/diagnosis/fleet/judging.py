"""Judge each motor of a fleet by all others, and show the fleet: `motor-env diagnose --fleet`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motor_env.common.console import ExitStatus, worst
from motor_env.common.errors import InputError, require_options
from motor_env.common.pages import Axis, Chart, render
from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.fleet.fits import Map, Reading
from motor_env.diagnosis.fleet.learning import LearnedFleet, UnitId, learn_fleet
from motor_env.diagnosis.fleet.population import HealthyPopulation
from motor_env.diagnosis.verdict.decision import DEFAULT_FALSE_ALARM_RATE
from motor_env.diagnosis.verdict.hypotheses import Difference
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.diagnosis.verdict.scaling_errors import describe_scaling_errors, find_scaling_errors
from motor_env.motor import identifiable

_GAINS = 3  # of voltage, current and speed
_CLEAR = 2.0  # standard deviations
_MOST_ODD = 3
_ALONE = re.compile(",? and nothing else moved")


@dataclass(frozen=True, slots=True)
class FleetUnit:
    """A motor of the fleet, judged by the others.

    Attributes:
        unit_id: machine and motor.
        records: diagnosis of each of its files.
        quantities: of the fleet's records.
        difference: from the healthy population of the other motors; None without a fit.
        common_cause: wrong scale of all motors of its machine; empty for none.
    """

    unit_id: UnitId
    records: dict[Path, Diagnosis]
    quantities: tuple[str, ...]
    difference: Difference | None = None
    common_cause: str = ""

    @property
    def ratios(self) -> dict[str, float]:
        """Quantities over those of a healthy motor; empty without a fit."""
        if self.difference is None:
            return {}
        return dict(zip(self.quantities, np.exp(self.difference.log_ratios).tolist(), strict=True))

    @property
    def deviations(self) -> dict[str, float]:
        """Deviations of its quantities, in standard deviations of the population."""
        if self.difference is None:
            return {}
        sd = np.sqrt(np.diag(self.difference.covariance))
        return dict(zip(self.quantities, (self.difference.log_ratios / sd).tolist(), strict=True))

    @property
    def p_value(self) -> float | None:
        """Share of healthy motors at least as far away (Hotelling)."""
        if self.difference is None:
            return None
        deviations = self.difference.log_ratios
        return self.difference.p_value(
            float(deviations @ np.linalg.solve(self.difference.covariance, deviations)), len(deviations)
        )

    @property
    def decisive(self) -> Diagnosis:
        """Decisive record: the surest with a fault, else the first healthy one."""
        faults = [record for record in self.records.values() if record.verdict.is_fault]
        calm = [record for record in self.records.values() if record.verdict is Verdict.HEALTHY]
        rest = next(iter([*calm, *self.records.values()]))
        return max(faults, key=lambda record: record.confidence or 0.0, default=rest)

    @property
    def verdict(self) -> Verdict:
        """Verdict on the motor."""
        return self.decisive.verdict

    @property
    def odd(self) -> str:
        """Quantities farthest from the population."""
        ratios = self.ratios
        return ", ".join(f"{name} {ratios[name] - 1.0:+.0%}" for name in self._far)

    @property
    def _far(self) -> list[str]:
        deviations = self.deviations
        far = sorted(deviations, key=lambda name: -abs(deviations[name]))[:_MOST_ODD]
        return [name for name in far if abs(deviations[name]) > _CLEAR]

    def to_json(self) -> dict[str, Any]:
        """Build one object for programs."""
        record = self.decisive
        return {
            "motor": self.unit_id.name,
            "machine": self.unit_id.machine,
            "files": [str(path) for path in self.records],
            "verdict": str(record.verdict),
            "kind": None if record.kind is None else str(record.kind),
            "severity": record.severity,
            "severity_interval": record.severity_interval,
            "confidence": record.confidence,
            "p_value": self.p_value,
            "ratios": self.ratios,
            "standard_deviations": self.deviations,
            "reasons": list(record.reasons),
            "together": self.common_cause or None,
        }

    @property
    def shown_severity(self) -> str:
        """Severity of its fault as text; empty without one."""
        severity = self.decisive.severity
        return f"{severity:+.0%}" if severity and self.verdict.is_fault else ""

    @property
    def why(self) -> str:
        """Give the first reason of a fault, and the common cause of its machine."""
        own = "" if self.verdict is Verdict.HEALTHY else self._reason
        both = (
            f"all motors of {self.unit_id.machine} together: {self.common_cause}" if self.common_cause else ""
        )
        return "; ".join(filter(None, (own, both)))

    @property
    def _reason(self) -> str:
        reason, kind, far = self.decisive.reasons[0], self.decisive.decisive.fault_kind, self._far
        if kind is None or not far:
            return reason
        moved = identifiable.visible_direction(kind, identifiable.matrix(tuple(far)))
        return reason if moved.all() else f"mostly, {_ALONE.sub('', reason)}"

    @property
    def shown(self) -> str:
        """Describe the motor in a line; with a failed sensor, without quantities."""
        return self.why if self.verdict is Verdict.SENSOR else self.odd or self.why


@dataclass(frozen=True, slots=True)
class FleetDiagnosis:
    """Verdicts on the motors of a fleet.

    Attributes:
        units: the motors, the oddest first.
        quantities: compared ones.
        false_alarm_rate: of each healthy motor.
    """

    units: tuple[FleetUnit, ...]
    quantities: tuple[str, ...]
    false_alarm_rate: float

    @property
    def status(self) -> ExitStatus:
        """Return the exit status of the worst motor."""
        return worst(unit.verdict.status for unit in self.units)

    def to_json(self) -> list[dict[str, Any]]:
        """Build an object a motor, the oddest first."""
        return [unit.to_json() for unit in self.units]

    @property
    def summary(self) -> str:
        """Count the faulty motors, and those expected by chance."""
        odd = sum(unit.verdict.is_fault for unit in self.units)
        chance = self.false_alarm_rate * len(self.units)
        stand, share = "stands" if odd == 1 else "stand", 1.0 / self.false_alarm_rate
        return (
            f"{odd} of {len(self.units)} motors {stand} out."
            f" If all were healthy, about {chance:.1f} motors would stand out by chance (1 in {share:.0f})."
        )

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Print a table, the oddest motor first."""
        width = max(len(unit.unit_id.name) for unit in self.units)
        rows = [
            f"{unit.unit_id.name:<{width}}  {unit.verdict:<12} {unit.shown_severity:>6}  {unit.shown}"
            for unit in self.units
        ]
        return "\n".join([self.summary, *rows])

    def page(self) -> str:
        """Render a self-contained HTML page: a picture of the fleet, and the table."""
        return render(
            "motor_env.diagnosis.fleet",
            "fleet.html.j2",
            title="A motor among its sisters",
            summary=self.summary,
            chart=picture(self.quantities, self.units),
            units=self.units,
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
    """Judge each motor of a fleet by those of all other machines.

    Args:
        files: see `learn_fleet`.
        group: see `unit_ids`.
        reading: options for reading.
        false_alarm_rate: per healthy motor.
        each: maps over files, see `motor_env.diagnosis.fleet.fits.processes`.
        kept: file of first fits, to continue a stopped run.
        progress: called with each file, twice.

    Raises:
        InputError: too few motors, or records that cannot be used together.
    """
    require_options(false_alarm_rate=false_alarm_rate)
    fleet = learn_fleet(files, group=group, reading=reading, each=each, kept=kept, progress=progress)
    machines = list(dict.fromkeys(unit_id.machine for unit_id in fleet.unit_of.values()))
    job = partial(_diagnose_machine, fleet, false_alarm_rate)
    judged = [unit for units in each(job, machines) for unit in units]
    judged.sort(key=lambda unit: (not unit.verdict.is_fault, 0.0 if unit.p_value is None else unit.p_value))
    return FleetDiagnosis(tuple(judged), fleet.fits.quantities, false_alarm_rate)


def _diagnose_machine(fleet: LearnedFleet, rate: float, machine: str) -> list[FleetUnit]:
    population, units = fleet.population_without(machine), []
    for unit_id in dict.fromkeys(each for each in fleet.unit_of.values() if each.machine == machine):
        if unit_id.motor not in fleet.positions:
            raise InputError(f"no motor of the place {unit_id.motor} can be fitted to judge {unit_id.name}")
        own = [path for path, each in fleet.unit_of.items() if each == unit_id]
        motor = fleet.motor("a healthy one", population, unit_id.motor)
        records = {
            path: diagnose(path, motor, false_alarm_rate=rate / len(own), **fleet.fits.reading.options)
            for path in own
        }
        units.append(
            FleetUnit(unit_id, records, fleet.fits.quantities, _difference_from(fleet, population, unit_id))
        )
    alike = common_cause(
        [unit.difference for unit in units if unit.difference is not None], fleet.fits.quantities, rate
    )
    return [replace(unit, common_cause=alike) for unit in units]


def common_cause(differences: Sequence[Difference], names: tuple[str, ...], rate: float) -> str:
    """Find one wrong scale of a sensor or supply that a machine's motors share; empty for none."""
    if len(differences) < 2:
        return ""
    deviations = np.mean([each.log_ratios for each in differences], axis=0)
    spread = np.mean([each.covariance for each in differences], axis=0) / len(differences)
    limit = -float(stdtrit(differences[0].degrees_of_freedom, rate / (2.0 * _GAINS)))
    mean = replace(differences[0], log_ratios=deviations, covariance=spread)
    return describe_scaling_errors(
        [scale for scale in find_scaling_errors(mean, names, limit, rate) if scale.gain is not None]
    )


def _difference_from(
    fleet: LearnedFleet, population: HealthyPopulation, unit_id: UnitId
) -> Difference | None:
    if unit_id not in fleet.motors:
        return None
    number = fleet.motors.index(unit_id)
    kept = np.array([n == number for n in range(len(fleet.motors))])
    logs, errors = fleet.records.subset(kept).means(population.within)
    at = fleet.positions.index(unit_id.motor)
    return Difference(
        logs[0] - population.centres[at],
        population.next_motor(at) + errors[0],
        identifiable.matrix(fleet.fits.quantities),
        population.degrees_of_freedom,
    )


_FARTHEST = 6.0  # standard deviations that the picture shows
_USUAL = 2.0
_JITTER = (0.0, 0.12, -0.12, 0.06, -0.06, 0.18, -0.18)  # of a column: dots that would hide each other
_ROW = 13.0  # pixels between two names


def picture(names: Sequence[str], units: Sequence[FleetUnit]) -> str:
    """Draw the fleet: a column for each quantity, a dot for each motor, names of faulty ones.

    Heights are standard deviations of another healthy motor.

    Args:
        names: of the quantities.
        units: the motors, the oddest first.
    """
    columns = Axis("", -0.5, len(names) - 0.5)
    rows = Axis("", -_FARTHEST, _FARTHEST, (-6, -4, -2, 0, 2, 4, 6), number="{:g}".format)
    chart = Chart(
        columns,
        rows,
        size=(480.0, 380.0),  # so narrow that its names can be read on a phone
        margins=(36.0, 72.0, 14.0, 34.0),
        label=f"{len(units)} motors, each quantity in standard deviations from the healthy core",
    )
    top, height = chart.y(_USUAL), chart.y(-_USUAL) - chart.y(_USUAL)
    chart.shape("rect", "usual", x=chart.left, y=top, width=chart.right - chart.left, height=height)
    chart.y_numbers()
    named: dict[int, list[tuple[float, float, str]]] = {}
    for unit_id, unit in enumerate(reversed(units)):  # the oddest last, on top
        # The readings of a failed sensor are no evidence on the motor.
        is_odd = unit.verdict.is_fault and unit.verdict is not Verdict.SENSOR
        for column, name in enumerate(names):
            if name not in unit.deviations:
                continue
            deviations = unit.deviations[name]
            at = (chart.x(column + _JITTER[unit_id % len(_JITTER)]), chart.y(deviations))
            title = f"{unit.unit_id.name}: {name} {unit.ratios[name] - 1.0:+.0%}"
            chart.dot("odd" if is_odd else "sister", at, 5.0 if is_odd else 3.5, title)
            if is_odd and abs(deviations) > _USUAL:
                named.setdefault(column, []).append((at[1] + 4.0, at[0] + 9.0, unit.unit_id.name))
    for labels in named.values():
        below = -math.inf
        for line, x, label in sorted(labels):
            below = max(line, below + _ROW)
            chart.text((x, below), label, "name")
    for column, name in enumerate(names):
        chart.text((chart.x(column), chart.bottom + 22.0), name, "tick", "middle")
    return chart.svg()
