"""Profile of an instrument: how its files are read, kept for the next time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from motor_env.common.errors import InputError
from motor_env.common.files import write_text
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.start import Circuit
from motor_env.motor.toml_files import NotNegative, OneLine, Positive, from_dict, read_toml, toml_text


@dataclass(frozen=True)
class Profile:
    """Reading options of an instrument's files.

    Attributes:
        column: choices of columns, as `ColumnChoice.parse` reads them.
        sampling_rate: in Hz, where no column holds the time.
        voltage: level of the supply in volt, where none was recorded.
        shunt_ohm: resistance in series with the motor.
        sensor_lag: time constant of the current sensor in seconds.
    """

    column: tuple[OneLine, ...] = ()
    sampling_rate: Positive | None = None
    voltage: Positive | None = None
    shunt_ohm: NotNegative | None = None
    sensor_lag: NotNegative | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of the functions that read and fit.

        Raises:
            InputError: a choice that cannot be understood.
        """
        sampled = [] if self.sampling_rate is None else [ColumnChoice.sampled(self.sampling_rate)]
        return {
            "voltage_v": self.voltage,
            "columns": [*map(ColumnChoice.parse, self.column), *sampled],
            "circuit": Circuit(self.shunt_ohm or 0.0, self.sensor_lag or 0.0),
        }

    def over(self, kept: Profile) -> Profile:
        """Complete this profile from a kept one; a column counts as one quantity."""
        named = {text.partition("=")[0] for text in self.column}
        columns = [text for text in kept.column if text.partition("=")[0] not in named]
        own = {name: value for name, value in asdict(self).items() if value is not None}
        return replace(kept, **own | {"column": (*columns, *self.column)})


def profile_from(given: Mapping[str, Any]) -> Profile:
    """Make a profile out of a command's options.

    Raises:
        InputError: a number out of its range.
    """
    try:
        return from_dict(Profile, given, "the profile")
    except ValueError as error:
        raise InputError(str(error).replace("_", "-")) from None


def load_profile(path: Path) -> Profile:
    """Read a profile from its TOML file.

    Raises:
        InputError: no such file, not TOML, an unknown key, a value out of range, or a column that is no choice.
    """
    content = read_toml(path, "no such profile")
    try:
        profile = from_dict(Profile, content, "the profile")
        for text in profile.column:
            ColumnChoice.parse(text)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return profile


def save_profile(profile: Profile, path: Path) -> None:
    """Write a profile as TOML, also over another profile.

    Raises:
        InputError: the file cannot be written, or is there and is no profile.
    """
    if path.exists():
        load_profile(path)
    write_text(path, toml_text(asdict(profile), {}))
