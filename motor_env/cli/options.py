"""Options that several commands share, and how they print a result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, Token

from motor_env.common import console
from motor_env.common.console import json_text, printable
from motor_env.common.errors import InputError

if TYPE_CHECKING:
    from motor_env.diagnosis.fleet import fits
    from motor_env.diagnosis.readers.profiles import Profile


def _seconds(_: type[float], tokens: Sequence[Token]) -> float:
    import pandas as pd

    text = tokens[0].value
    try:
        return float(text)
    except ValueError:
        try:
            return pd.Timedelta(text).total_seconds()
        except ValueError:
            raise ValueError(f"must be a time such as 20s or 10min, got {text!r}") from None


Duration = Annotated[float, Parameter(converter=_seconds)]
"""Seconds, or a time with its unit."""


def show(as_json: bool, objects: Callable[[], Any], text: Callable[[], str]) -> None:
    """Print a result: as JSON where that is asked for, else as text."""
    print(json_text(objects()) if as_json else printable(text()))


def refuse(beside: str, **given: object) -> None:
    """Refuse the options that were given beside one that they do not go with.

    Raises:
        InputError: one of them is neither None nor False.
    """
    for name, value in given.items():
        if value is not None and value is not False:
            raise InputError(f"--{name.replace('_', '-')} does not go with {beside}")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Reading:
    """How the files are read.

    Attributes:
        column: Which column holds a quantity, with its unit or scale (may be repeated): current=CH2:mA,
            "current=CH2*10-0.05" for 10 A/V and an offset of -0.05 A, voltage=none.
        sampling_rate: Samples a second, for files without a time.
        profile: File of --save-profile; options on the command line override it.
        save_profile: File (TOML) to which these choices are saved for the next time.
    """

    column: list[str] | None = None
    sampling_rate: float | None = None
    profile: Path | None = None
    save_profile: Path | None = None

    @property
    def chosen(self) -> Profile:
        """The choices, with those of the profile."""
        from motor_env.diagnosis.readers import profiles

        given = {
            field.name: getattr(self, field.name)
            for field in fields(profiles.Profile)
            if hasattr(self, field.name)
        }
        own = profiles.profile_from(given | {"column": self.column or ()})
        return own if self.profile is None else own.over(profiles.load_profile(self.profile))

    def keep(self) -> None:
        """Save them where that is asked for."""
        from motor_env.diagnosis.readers.profiles import save_profile

        if self.save_profile is not None:
            save_profile(self.chosen, self.save_profile)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Measurement(Reading):
    """How a file is read, and how the motor was measured.

    Attributes:
        voltage: Level of the supply in volt, for recordings without a voltage.
        shunt_ohm: Resistance in series with the motor (shunt, leads) in ohm; it is subtracted from R.
        sensor_lag: Time constant of the current sensor in seconds, if you know it; otherwise it is fitted.
        start: Number of the start to use, counted from 1, if a file holds several; all by default.
    """

    voltage: float | None = None
    shunt_ohm: float | None = None
    sensor_lag: float | None = None
    start: console.Whole | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of the functions behind the commands."""
        return self.chosen.options | {"start": self.start}

    def of_fleet(self, regime: str) -> fits.Reading:
        """How the records of a fleet are read: each has one piece, so that none is asked for."""
        from motor_env.diagnosis.fleet import fits

        if self.start is not None:
            raise InputError("--start does not go with a fleet: give each start in a file of its own")
        return fits.Reading(regime=regime, **self.chosen.options)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class StartMeasurement(Measurement):
    """How a file is read and the motor was measured, and what is known of its commutation ripple.

    Attributes:
        ripple_periods_per_turn: Periods of the commutation ripple in one turn; the ripple then gives speed, K, J and B.
    """

    ripple_periods_per_turn: float | None = None


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Which motors of a fleet the files hold, and where they are fitted.

    Attributes:
        group: For --fleet: a regular expression that reads machine, motor and repeat from a file's name, by named
            groups, such as `(?P<machine>[0-9]+)_(?P<motor>left|right)`.
        workers: For --fleet: number of processes.
        scheduler: For --fleet: address of a Dask scheduler, whose workers fit instead.
        kept: For --fleet: file in which each fit is stored at once, so that an interrupted call can continue.
    """

    group: str | None = None
    workers: console.Whole = 1
    scheduler: str | None = None
    kept: Path | None = None

    @contextmanager
    def fitted(self, files: list[Path], reading: fits.Reading) -> Iterator[dict[str, Any]]:
        """Arguments of the functions that fit a fleet, as long as its workers and a bar on the terminal last."""
        from motor_env.diagnosis.fleet.fits import processes

        with (
            console.working("fitting", 2 * len(files)) as update,
            processes(self.workers, self.scheduler) as each,
        ):
            yield {
                "group": self.group,
                "reading": reading,
                "each": each,
                "kept": self.kept,
                "progress": lambda _: update(advance=1),
            }


READING, MEASUREMENT, START, FLEET = Reading(), Measurement(), StartMeasurement(), FleetOptions()
