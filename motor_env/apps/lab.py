"""Compute the lab's displays: a simulated start, the filter's residual, a rule's statistic, the verdict.

Functions take the page's plain numbers and return dictionaries for JSON; the server is `lab_server`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from motor_env.common.errors import InputError
from motor_env.detection.rules import Cusum, MOfN, Rule, first_above, in_a_row
from motor_env.diagnosis.diagnose import Diagnosis, diagnose
from motor_env.diagnosis.file_verdicts import diagnose_files
from motor_env.diagnosis.readers.recording import Recording, read_recording
from motor_env.diagnosis.verdict.report_page import moving_average, reference_current
from motor_env.diagnosis.verdict.report_text import as_json, headline
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.motor.data_sheet import Motor, load_motor
from motor_env.motor.faults import HEALTHY, Fault, FaultKind
from motor_env.motor.parameters import CATALOGUE, FloatArray, SensorParameters
from motor_env.simulation.simulate import Scenario, Timing, Transients, simulate, simulate_states

LARGEST_UPLOAD_BYTES = 20_000_000
_MOST_STARTS = 20
OWN_MOTOR, HEALTHY_STARTS = "own motor", "healthy starts"


class Uploads:
    """Readable uploaded files in a temporary folder."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="motor-env-lab-")
        self.motor: Path | None = None
        self.healthy: list[Path] = []
        self._names: dict[Path, str] = {}

    def clear(self) -> None:
        """Delete all files."""
        self._folder.cleanup()

    def keep(self, kind: str, name: str, content: bytes) -> dict[str, str | int]:
        """Keep a motor file or one healthy start; return what can be compared with.

        Raises:
            InputError: too many, or not readable.
        """
        shown = display_name(name)
        if kind not in ("motor", "healthy"):
            raise InputError(f"kind must be motor or healthy, got {kind[:40]!r}")
        if kind == "healthy" and len(self.healthy) >= _MOST_STARTS:
            raise InputError(f"at most {_MOST_STARTS} healthy starts can be compared with")
        ending = ".toml" if kind == "motor" else file_suffix(shown)
        path = Path(self._folder.name) / f"{kind}-{len(self._names)}{ending}"
        self._names[path] = shown
        path.write_bytes(content)
        with self.naming():
            try:
                load_motor(path) if kind == "motor" else read_recording(path)
            except ValueError:
                path.unlink()
                raise
        if kind == "motor":
            self.motor = path
        else:
            self.healthy.append(path)
        return {
            "name": shown,
            "reference": OWN_MOTOR if kind == "motor" else HEALTHY_STARTS,
            "healthy": len(self.healthy),
        }

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Restore the files' original names in messages."""
        try:
            yield
        except ValueError as error:
            sentence = str(error)
            for path, name in self._names.items():
                sentence = sentence.replace(str(path), name)
            raise InputError(sentence) from None

    def reference(self, wanted: str) -> tuple[str | None, list[Path]]:
        """Return the motor and healthy starts that the page has chosen.

        Raises:
            InputError: no such upload or motor.
        """
        if wanted == HEALTHY_STARTS and self.healthy:
            return None, self.healthy
        if wanted == OWN_MOTOR and self.motor is not None:
            return str(self.motor), []
        if wanted in (OWN_MOTOR, HEALTHY_STARTS):
            raise InputError(f"no {wanted} handed in yet")
        if wanted not in ("", *CATALOGUE):
            raise InputError(f"motor must be one of {', '.join(CATALOGUE)}, got {wanted[:40]!r}")
        return wanted or None, []


def display_name(name: str) -> str:
    """Clean a file's name for the page."""
    return "".join(character for character in name if character.isprintable())[:80] or "recording"


def file_suffix(shown: str) -> str:
    """Return the ending that tells the file's format."""
    suffix = Path(shown).suffix.lower()
    return suffix if suffix[1:].isalnum() and len(suffix) <= 9 else ".csv"


ROC_STARTS = 200
AVERAGED = 50  # samples: 5 ms
MOST_POINTS = 1200
TIMING = Timing(sampling_rate_hz=10_000.0, duration_s=0.3, quiet_s=0.1)

RULES: dict[str, tuple[str, Rule]] = {
    "cusum": ("CUSUM", Cusum(shift=0.3, two_sided=True)),
    "nis": ("NIS, 3 of 5", MOfN(3, 5)),
    "row": ("NIS, 3 in a row", in_a_row(3)),
}
"""Rules to choose from; each has its false-alarm rate for exactly the nominal motor."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The page's controls.

    Attributes:
        motor: catalogue motor that the filter assumes.
        kind: fault kind, or healthy.
        severity_percent: of the fault.
        noise_ma: standard deviation of a current sample, known to the filter.
        resistance_percent: the motor's tolerance.
        friction_percent: the same for the friction.
        false_alarm_percent: of rule and diagnosis.
        rule: name of the rule, of `RULES`.
        seed: random number of the noise.
    """

    motor: str = "paper"
    kind: str = str(FaultKind.BEARING)
    severity_percent: float = 25.0
    noise_ma: float = 45.0  # the rule finds this fault often, and not always
    resistance_percent: float = 0.0
    friction_percent: float = 0.0
    false_alarm_percent: float = 1.0
    rule: str = "cusum"
    seed: int = 1
    __pydantic_config__: ClassVar = {"extra": "forbid"}

    @property
    def sensor(self) -> SensorParameters:
        """Return the sensor."""
        return SensorParameters(current_noise_a=1e-3 * self.noise_ma)

    def __post_init__(self) -> None:
        choices = {"motor": tuple(CATALOGUE), "kind": fault_names(), "rule": tuple(RULES)}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} must lie in {low:g} .. {high:g}, got {str(value)[:40]}")


RANGES: dict[str, tuple[float, float]] = {
    "severity_percent": (0.0, 60.0),
    "noise_ma": (1.0, 200.0),
    "resistance_percent": (-10.0, 10.0),
    "friction_percent": (-10.0, 10.0),
    "false_alarm_percent": (0.1, 20.0),
    "seed": (0, 1_000_000),
}
"""Bounds of every slider."""


def fault_names() -> tuple[str, ...]:
    """List healthy and the kinds of faults; of the sensors, those of the current."""
    kinds = (kind for kind in FaultKind if not kind.is_sensor or kind.startswith("current_"))
    return (HEALTHY, *map(str, kinds))


def simulate_start(settings: Settings) -> Transients:
    """Simulate the start."""
    return simulate(_scenario(settings), settings.seed, [0])


def _scenario(settings: Settings) -> Scenario:
    motor = CATALOGUE[settings.motor].scaled(
        resistance_ohm=1.0 + 0.01 * settings.resistance_percent,
        viscous_friction_n_m_s_per_rad=1.0 + 0.01 * settings.friction_percent,
    )
    is_healthy = settings.kind == HEALTHY
    faults = () if is_healthy else (Fault(FaultKind(settings.kind), 0.01 * settings.severity_percent),)
    return Scenario(motor, faults=faults, sensor=settings.sensor, timing=TIMING)


def _filter(settings: Settings) -> KalmanFilter:
    motor = CATALOGUE[settings.motor]
    return KalmanFilter.from_parameters(motor, settings.sensor, TIMING.dt_s, process_noise_std=(1e-9, 1e-9))


def simulated(settings: Settings) -> dict[str, Any]:
    """Simulate one start: measured and expected current, residual, statistic, threshold, alarm."""
    start = simulate_start(settings)
    filtered = run_filter(_filter(settings), start.measurements[0], start.voltage_v[0])
    expected = simulate_states(CATALOGUE[settings.motor], start.voltage_v[0], TIMING.dt_s)[:, 0]
    name, rule = RULES[settings.rule]
    threshold = _threshold(settings.rule, 0.01 * settings.false_alarm_percent)
    statistic = rule.statistic(filtered.whitened)
    alarm = int(first_above(statistic, threshold))
    return {
        "time_ms": _rounded(1e3 * start.time_s),
        "measured_a": _rounded(start.measurements[0, 0]),
        "expected_a": _rounded(expected),
        "residual_a": _rounded(filtered.innovation[:, 0]),
        "averaged_a": _rounded(moving_average(start.measurements[0, 0] - expected, AVERAGED)),
        "averaged_band_a": 2e-3 * settings.noise_ma / AVERAGED**0.5,
        "statistic": _rounded(statistic),
        "threshold": threshold,
        "rule": name,
        "alarm_ms": None if alarm < 0 else 1e3 * float(start.time_s[alarm]),
        "noise_a": 1e-3 * settings.noise_ma,
    }


@lru_cache(maxsize=64)
def _threshold(rule: str, rate: float) -> float:
    wanted = RULES[rule][1].threshold_for(
        false_alarm_probability=rate, n_samples=TIMING.n_samples, n_channels=1
    )
    return float(wanted.value)


def roc(settings: Settings) -> dict[str, Any]:
    """Compute the shares of healthy and of faulty starts with an alarm, by threshold."""
    healthy = replace(settings, kind=HEALTHY, resistance_percent=0.0, friction_percent=0.0)
    largest = [np.sort(_largest_statistics(one)) for one in (healthy, settings)]
    thresholds = np.quantile(largest[0], np.linspace(0.0, 1.0, 101))
    shares = [1.0 - np.searchsorted(values, thresholds) / ROC_STARTS for values in largest]
    limit = _threshold(settings.rule, 0.01 * settings.false_alarm_percent)
    return {
        "false_alarms": _rounded(np.append(shares[0], 0.0)[::-1]),
        "found": _rounded(np.append(shares[1], float(np.mean(largest[1] > largest[0][-1])))[::-1]),
        "at": [0.01 * settings.false_alarm_percent, float(np.mean(largest[1] > limit))],
        "starts": ROC_STARTS,
    }


def _largest_statistics(settings: Settings) -> FloatArray:
    starts = simulate(_scenario(settings), settings.seed, range(ROC_STARTS))
    whitened = run_filter(_filter(settings), starts.measurements, starts.voltage_v).whitened
    out: FloatArray = RULES[settings.rule][1].statistic(whitened).max(axis=-1)
    return out


def _rounded(values: FloatArray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def verdict(settings: Settings) -> dict[str, Any]:
    """Diagnose the simulated start as `motor-env diagnose` does a recording."""
    start = simulate_start(settings)
    seen = Recording(Path("simulated"), start.time_s, start.measurements[0, 0], start.voltage_v[0])
    motor: Motor = replace(load_motor(settings.motor), current_noise_a=1e-3 * settings.noise_ma)
    return _as_document(diagnose(seen, motor, false_alarm_rate=0.01 * settings.false_alarm_percent))


def recording_verdict(
    name: str,
    content: bytes,
    motor: str,
    voltage_v: float | None,
    uploads: Uploads,
) -> dict[str, Any]:
    """Diagnose an uploaded recording.

    Args:
        name: the file's name, whose ending tells the format.
        content: its bytes.
        motor: catalogue motor to compare with, `own motor`, `healthy starts`, or empty for none.
        voltage_v: level of the supply, for recordings without a voltage.
        uploads: own motor and healthy starts.

    Raises:
        InputError: unknown motor, or not readable.
    """
    known, healthy = uploads.reference(motor)
    shown = display_name(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"recording{file_suffix(shown)}"
        path.write_bytes(content)
        with uploads.naming():
            (outcome,) = diagnose_files([path], motor=known, healthy=healthy, voltage_v=voltage_v)
        if outcome.diagnosis is None:
            raise InputError((outcome.error or "cannot be read").replace(str(path), shown))
        document = _as_document(outcome.diagnosis)
    document["file"] = shown
    return document


def _as_document(diagnosis: Diagnosis) -> dict[str, Any]:
    document = as_json(diagnosis)
    document["headline"] = headline(diagnosis.decisive)
    document["curves"] = None
    fit = diagnosis.decisive.identified
    if fit is not None:
        begin = max(int(np.searchsorted(fit.start.time_s, fit.onset_s)) - 20, 0)
        step = max((len(fit.start.time_s) - begin) // MOST_POINTS, 1)
        some, expected = slice(begin, None, step), reference_current(diagnosis.decisive)
        beyond = None if expected is None else moving_average(fit.start.current_a - expected, AVERAGED)
        document["curves"] = {
            "time_ms": _rounded(1e3 * (fit.start.time_s[some] - fit.onset_s)),
            "measured_a": _rounded(fit.start.current_a[some]),
            "fitted_a": _rounded(fit.expected[some, 0]),
            "residual_a": _rounded(fit.residual_a[some]),
            "healthy_a": None if expected is None else _rounded(expected[some]),
            "beyond_a": None if beyond is None else _rounded(beyond[some]),
        }
    return document


def options() -> dict[str, Any]:
    """List what the page offers."""
    return {
        "motors": list(CATALOGUE),
        "kinds": list(fault_names()),
        "rules": [{"name": key, "label": label} for key, (label, _) in RULES.items()],
        "ranges": RANGES,
        "defaults": {field.name: field.default for field in fields(Settings)},
        "largest_upload_bytes": LARGEST_UPLOAD_BYTES,
    }
