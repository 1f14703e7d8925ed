"""What is no brushed motor, and what was read wrongly: it is right, refused, or said; never a worn motor."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odd_recordings import THINGS, WRONG_SCALES, at_work, scaled, started, swapped, thing

from motor_env import Recording, commission, diagnose, identify
from motor_env.diagnosis.diagnose import Diagnosis
from motor_env.diagnosis.verdict.judgement import Verdict

# Reaches in: the sentences that a judgement may give.
from motor_env.diagnosis.verdict.scaling_errors import BEYOND_WEAR, EXPLAINED, SWAPPED
from motor_env.motor.data_sheet import Motor

SHEET = Path(__file__).resolve().parents[3] / "examples" / "motor.toml"
NOT_TURNING = "does not show that a motor turns"
FORMS = {
    "start": (),
    "start without speed": ("speed_rad_s",),
    "current alone": ("speed_rad_s", "voltage_v"),
    "log": (),
}
"""What is recorded, and the columns that are missing."""
EVERY = [
    (form, name)
    for form, missing in FORMS.items()
    for name in (*WRONG_SCALES, "swapped", *THINGS)
    if not {*WRONG_SCALES.get(name, ())} & {*missing} and (name != "swapped" or not missing[1:])
]


def made(form: str, name: str) -> Recording:
    """One of the recordings."""
    rng = np.random.default_rng([list(FORMS).index(form), len(name)])
    whole = at_work(rng) if form == "log" else started(rng)
    if name in THINGS:
        whole = thing(name, whole, rng)
    whole = scaled(whole, **WRONG_SCALES.get(name, {}))
    missing: dict[str, Any] = dict.fromkeys(FORMS[form])
    whole = replace(whole, **missing)
    return swapped(whole) if name == "swapped" else whole


def is_said(found: Diagnosis, name: str) -> bool:
    """Whether a diagnosis is refused, or says what the recording is."""
    told = "; ".join(found.reasons)
    if name == "swapped":
        return SWAPPED in told
    if found.verdict is Verdict.UNUSABLE:
        return True
    columns = [column.split("_")[0] for column in WRONG_SCALES.get(name, {})]
    is_named = EXPLAINED in told and all(f"the {column} is" in told for column in columns)
    is_odd = found.verdict in (Verdict.OTHER, Verdict.SENSOR)
    return is_odd and (is_named or NOT_TURNING in told or BEYOND_WEAR in told)


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("start without speed", "resistor"),
        ("start without speed", "solenoid"),
        ("current alone", "blocked rotor"),
    ],
)
def test_what_does_not_turn_has_no_bearing(form: str, name: str) -> None:
    recording = made(form, name)
    found = diagnose(recording, SHEET)
    assert found.verdict == "other"
    assert found.severity is None
    assert NOT_TURNING in found.reasons[0]
    warnings = identify(recording).to_json()[0]["warnings"]
    assert any(NOT_TURNING in sentence for sentence in warnings)


@pytest.mark.parametrize(
    ("missing", "seed"), [((), 50), (("speed_rad_s",), 51), (("speed_rad_s", "voltage_v"), 53)]
)
def test_a_blocked_rotor_is_no_healthy_motor(missing: tuple[str, ...], seed: int) -> None:
    """Nor an unusable recording, though no fit explains a speed of zero. By its fit alone one of these is healthy."""

    def shown(whole: Recording) -> Recording:
        columns: dict[str, Any] = dict.fromkeys(missing)
        return replace(whole, **columns)

    volts = 12.0 if "voltage_v" in missing else None
    motor = commission([shown(started(np.random.default_rng(n))) for n in range(3)], voltage_v=volts).motor
    rng = np.random.default_rng(seed)
    found = diagnose(shown(thing("blocked rotor", started(rng), rng)), motor, voltage_v=volts)
    assert found.verdict == "other"
    assert NOT_TURNING in found.reasons[0]
    assert NOT_TURNING in found.text()
    assert NOT_TURNING in found.page()
    assert found.to_json()["pieces"][0]["verdict"] == "other"


@pytest.mark.parametrize(
    ("form", "name", "first"),
    [
        ("start", "speed in rpm", "the speed is in rpm, and was read in rad/s"),
        (
            "start",
            "twice the current",
            "the current is 2 times too large (look at the scale of its probe or shunt)",
        ),
        (
            "start",
            "half the voltage",
            "the voltage is 2 times too small (look at the scale of its probe or divider)",
        ),
        (
            "current alone",
            "half the sampling rate",
            "the time is 2 times too large (look at the sampling rate)",
        ),
        (
            "start without speed",
            "current in mA",
            "the current is in mA, and was read in A, or if the voltage is in kV, and was read in V",
        ),
        ("log", "speed in deg/s", "the speed is in degrees a second, and was read in rad/s"),
    ],
)
def test_a_wrong_scale_is_named_first(form: str, name: str, first: str) -> None:
    found = diagnose(made(form, name), SHEET)
    assert found.verdict == "other"
    assert found.reasons[0] == f"{EXPLAINED} if {first}"
    assert BEYOND_WEAR not in found.reasons
    assert all(one.fault_kind is None for one in found.pieces if one.verdict == "other")


@pytest.mark.parametrize("form", ["start without speed", "log"])
def test_swapped_columns_are_named(form: str) -> None:
    recording = made(form, "swapped")
    assert diagnose(recording, SHEET).reasons[0] == SWAPPED


@pytest.mark.parametrize("name", ["lamp", "capacitor"])
def test_what_is_no_wear_is_said(name: str) -> None:
    found = diagnose(made("start without speed", name), SHEET)
    assert found.verdict is Verdict.UNUSABLE or BEYOND_WEAR in found.reasons


@pytest.fixture(scope="module")
def commissioned() -> dict[bool, Motor]:
    """Learned from healthy logs (True), and from healthy starts."""

    def learned(is_log: bool) -> Motor:
        rngs = map(np.random.default_rng, range(100, 104 if is_log else 108))
        pieces = ((at_work if is_log else started)(rng) for rng in rngs)
        return commission([replace(one, path=Path(f"healthy {n}")) for n, one in enumerate(pieces)]).motor

    return {is_log: learned(is_log) for is_log in (False, True)}


@pytest.mark.long
@pytest.mark.parametrize(("form", "name"), EVERY)
def test_all_of_it_is_refused_or_said(form: str, name: str, commissioned: dict[bool, Motor]) -> None:
    recording = made(form, name)
    assert is_said(diagnose(recording, SHEET), name)
    if form != "current alone":  # healthy starts with a voltage
        assert is_said(diagnose(recording, commissioned[form == "log"]), name)


def test_the_file_of_another_motor_is_asked_for(tmp_path: Path) -> None:
    """R, L and K^2/J are all off: no single fault, and within what wear could do."""
    other = tmp_path / "other.toml"
    text = SHEET.read_text(encoding="utf-8").replace("resistance_ohm = 2.18", "resistance_ohm = 3.1")
    other.write_text(text.replace("inductance_mh = 0.238", "inductance_mh = 0.45"), encoding="utf-8")
    capture = SHEET.with_name("startup_capture.csv")
    found = diagnose(capture, other)
    assert found.verdict is Verdict.OTHER
    assert any("is this the right motor?" in reason for reason in found.reasons)
    assert not any("right motor" in reason for reason in diagnose(capture, SHEET).reasons)
