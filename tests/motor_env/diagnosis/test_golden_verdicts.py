"""Verdict, kind, severity and exit status of some eighty captures, by one table; no sentence contradicts a verdict."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from captures import CAPTURES, REFERENCES, SHEET, started, thing, without

from motor_env import Diagnosis, FaultKind, commission, diagnose, identify
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, Judgement, Verdict
from motor_env.diagnosis.verdict.scaling_errors import BEYOND_WEAR, EXPLAINED, SWAPPED

# Reaches in: the sentences that a judgement may give.

FRICTION, CONTACT, SHORTED = "bearing", "winding_contact", "winding_short"
NOT_TURNING, COUPLED = "does not show that a motor turns", "AC-coupled"

Row = tuple[str, str | None, float | None, int, str]
HEALTHY: Row = ("healthy", None, 0.0, 0, "no quantity has moved")
GOLDEN: dict[str, Row] = {
    # name: verdict, kind where it is sure, true severity, exit status, what is said or noticed
    "none: bearing 30 %": ("bearing", FRICTION, 0.3, 1, "look at the bearings"),
    "offset: contact 30 %": ("winding", CONTACT, 0.3, 1, "look at brushes"),
    "noise: bearing 30 %": ("bearing", None, 0.3, 1, "the current's noise is 1."),
    "rectification: contact 30 %": ("winding", CONTACT, 0.3, 1, "rectification"),
    "quantisation: bearing 30 %": ("bearing", FRICTION, 0.3, 1, "quantisation"),
    "pwm: contact 30 %": ("winding", CONTACT, 0.3, 1, "PWM ripple"),
    "supply ramp: bearing 30 %": ("bearing", FRICTION, 0.3, 1, "supply ramp: it rises in 4."),
    "sensor lag: contact 30 %": ("winding", CONTACT, 0.3, 1, "sensor lag"),
    "series shunt: bearing 30 %": ("bearing", FRICTION, 0.3, 1, ""),
    "jitter: contact 30 %": ("winding", CONTACT, 0.3, 1, "uneven"),
    "onset between samples: bearing 30 %": ("bearing", FRICTION, 0.3, 1, ""),
    "negative times: contact 30 %": ("winding", CONTACT, 0.3, 1, ""),
    "reversed: bearing 30 %": ("bearing", FRICTION, 0.3, 1, ""),
    "a wild sample: contact 30 %": ("winding", CONTACT, 0.3, 1, "an outlier of"),
    "no quiet part: bearing 30 %": ("bearing", FRICTION, 0.3, 1, ""),
    "mains hum: contact 30 %": ("winding", CONTACT, 0.3, 1, "hum of the mains"),
    "saturation: contact 30 %": ("unusable", None, None, 3, "clipped, saturation"),
    "no start: contact 30 %": ("unusable", None, None, 3, "the current is constant"),
    "coupled by a capacitor: contact 30 %": ("unusable", None, None, 3, COUPLED),
    "none: healthy": HEALTHY,
    "pwm: healthy": HEALTHY,
    "sensor lag: healthy": HEALTHY,
    "quantisation: healthy": HEALTHY,
    "jitter: healthy": HEALTHY,
    "shorted turns 15 %": ("winding", SHORTED, 0.15, 1, "look for shorted turns"),
    "noise tripled": ("noise", None, 2.0, 1, "times the reference's"),
    "a weak magnet": ("other", None, None, 1, "a coupled machine looks the same"),
    "with a speed: healthy": HEALTHY,
    "with a speed: bearing 35 %": ("bearing", FRICTION, 0.35, 1, ""),
    "with a speed: contact 35 %": ("winding", CONTACT, 0.35, 1, ""),
    "with a speed: shorted turns 15 %": ("winding", SHORTED, 0.15, 1, ""),
    "with a speed: noise tripled": ("noise", None, 2.0, 1, ""),
    "short: healthy": HEALTHY,
    "short: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
    "slow: healthy": HEALTHY,
    "slow: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
    "slow and short: healthy": ("healthy", None, 0.0, 0, "the friction is undecided"),
    "slow and short: contact 25 %": ("winding", None, 0.25, 1, ""),
    "weak magnet, learned": ("other", None, None, 1, "K^2/(J V) is down by 19%"),
    "20 K colder": ("healthy", None, 0.0, 0, "K colder"),
    "25 K warmer": ("healthy", None, 0.0, 0, "K warmer"),
    "15 K warmer: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
    "constant load: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
    "constant load, 35 K warmer": ("healthy", None, 0.0, 0, "K warmer"),
    "fan: healthy": HEALTHY,
    "fan: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
    "two starts, then contact 30 %": ("winding", CONTACT, 0.3, 1, ""),
    "two starts without a voltage": ("winding", CONTACT, 0.3, 1, ""),
    "all channels: healthy": HEALTHY,
    "current 35 % high": ("sensor", "current_gain", 0.35, 1, "times too large"),
    "speed 20 % low": ("sensor", "speed_gain", 0.25, 1, "1.25 times too small"),
    "voltage 15 % high": ("sensor", "voltage_gain", 0.15, 1, "1.15 times too large"),
    "current in mA, learned": ("other", None, None, 1, "the current is in mA, and was read in A"),
    "clock half as fast": ("other", None, None, 1, "the time is 2 times too large"),
    "current stuck": ("sensor", "current_stuck", None, 1, "for its last 750 samples"),
    "current dead": ("sensor", "current_dead", None, 1, "sensor shows nothing"),
    "log: current reversed": ("sensor", "current_polarity", None, 1, "with the wrong sign"),
    "log: speed dead": ("sensor", "speed_dead", None, 1, "sensor shows nothing"),
    "log: current offset by 1.5 A": ("sensor", "current_offset", None, 1, "at every voltage and speed"),
    "log: columns swapped": ("sensor", "swapped", None, 1, SWAPPED),
    "log: speed in degrees": ("other", None, None, 1, "the speed is in degrees a second, and was read in rad/s"),
    "speed in rpm": ("other", None, None, 1, f"{EXPLAINED} if the speed is in rpm, and was read in rad/s"),
    "twice the current": ("other", None, None, 1, "the current is 2 times too large (look at the scale of its"),
    "half the voltage": ("other", None, None, 1, "the voltage is 2 times too small (look at the scale of its"),
    "current in mA": ("other", None, None, 1, "in mA, and was read in A, or if the voltage is in kV, and"),
    "half the rate": ("other", None, None, 1, "the time is 2 times too large (look at the sampling rate)"),
    "columns swapped": ("sensor", "swapped", None, 1, SWAPPED),
    "resistor": ("other", None, None, 1, NOT_TURNING),
    "blocked rotor": ("other", None, None, 1, NOT_TURNING),
    "solenoid": ("other", None, None, 1, NOT_TURNING),
    "lamp": ("other", None, None, 1, BEYOND_WEAR),
    "capacitor": ("other", None, None, 1, BEYOND_WEAR),
    "stepper": ("unusable", None, None, 3, "no start is visible"),
    "brushless": ("unusable", None, None, 3, "no motor model explains the current"),
    "supply at its limit": ("other", None, None, 1, NOT_TURNING),
    "blocked rotor, learned": ("other", None, None, 1, NOT_TURNING),
    "work: healthy": HEALTHY,
    "work: bearing 100 %": ("bearing", FRICTION, 1.0, 1, ""),
    "work: contact 25 %": ("winding", CONTACT, 0.25, 1, ""),
}  # fmt: skip


@cache
def judged(name: str) -> Diagnosis:
    reference, make = CAPTURES[name]
    shunt_ohm = 0.22 if name.startswith("series shunt") else 0.0
    return diagnose(make(), REFERENCES[reference](), circuit=Circuit(shunt_ohm=shunt_ohm))


def test_every_capture_is_in_the_table() -> None:
    assert set(GOLDEN) == set(CAPTURES)


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_verdicts(name: str) -> None:
    verdict, kind, severity, status, words = GOLDEN[name]
    found = judged(name)
    assert (found.verdict, found.kind, found.verdict.status) == (verdict, kind, status)
    if severity is None:
        assert found.severity is None
    else:  # the motors that are compared with a sheet lie within its tolerances themselves
        assert found.severity == pytest.approx(severity, abs=0.08, rel=0.2)
    fit = found.decisive.identified
    noticed = [] if fit is None else list(map(str, fit.defects))
    assert words in "; ".join([*found.reasons, *noticed, *found.recording.columns])


MOVES = {"bearing": "B", "winding_contact": "R", "winding_short": "RLK", "magnet": "K"}
"""First letters of the quantities that a fault moves: K^2/J and B/J count as K and B."""


def contradicted(found: Judgement) -> list[str]:
    """Sentences that nothing else moved, where an interval of what the fault does not move excludes healthy."""
    out = []
    for kind, own in MOVES.items():
        beside = [change for change in found.changes if change.excludes_healthy and change.name[0] not in own]
        what = FaultKind(kind).finding.partition(":")[0] + NOTHING_ELSE
        out += [reason for reason in found.reasons if reason.startswith(what) and (beside or found.also)]
    return out


@pytest.mark.parametrize("name", GOLDEN)
def test_no_sentence_says_that_nothing_else_moved_where_an_interval_says_that_it_did(name: str) -> None:
    assert [sentence for piece in judged(name).pieces for sentence in contradicted(piece)] == []


def test_such_a_sentence_would_be_found() -> None:
    found = judged("none: bearing 30 %").decisive
    assert contradicted(found) == []
    (sentence,) = (reason for reason in found.reasons if NOTHING_ELSE in reason)
    changes = tuple(replace(change, low=1.01, high=1.1) for change in found.changes)
    assert contradicted(replace(found, changes=changes)) == [sentence]


EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


def test_a_blocked_rotor_that_a_fit_alone_would_call_healthy_is_none() -> None:
    missing = ("speed_rad_s", "voltage_v")
    starts = [without(started(np.random.default_rng(n)), *missing) for n in range(3)]
    motor, rng = commission(starts, voltage_v=12.0).motor, np.random.default_rng(53)
    blocked = without(thing("blocked rotor", started(rng), rng), *missing)
    found = diagnose(blocked, motor, voltage_v=12.0)
    assert (found.verdict, found.severity) == ("other", None)
    assert all(NOT_TURNING in told for told in (found.reasons[0], found.text(), found.page()))
    warnings = identify(blocked).to_json()[0]["warnings"]
    assert any(NOT_TURNING in sentence for sentence in warnings)


def test_the_file_of_another_motor_is_asked_for(tmp_path: Path) -> None:
    """R, L and K^2/J are all off: no single fault, and within what wear could do."""
    other, text = tmp_path / "other.toml", (EXAMPLES / "motor.toml").read_text(encoding="utf-8")
    text = text.replace("resistance_ohm = 2.18", "resistance_ohm = 3.1")
    other.write_text(text.replace("inductance_mh = 0.238", "inductance_mh = 0.45"), encoding="utf-8")
    capture = EXAMPLES / "startup_capture.csv"
    found = diagnose(capture, other)
    assert found.verdict is Verdict.OTHER
    assert any("is this the right motor?" in reason for reason in found.reasons)
    assert not any("right motor" in reason for reason in diagnose(capture, SHEET).reasons)
