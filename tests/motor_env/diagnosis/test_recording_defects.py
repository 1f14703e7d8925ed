"""Captures with every defect of real ones, through the diagnosis; what a start tells beyond its current."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_captures import DEFECTS, Defect, captures
from started_motor import driven

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Diagnosis,
    Fault,
    FaultKind,
    InputError,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    Verdict,
    commission,
    diagnose,
    identify,
    load_motor,
    simulate,
)
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.diagnosis.readers.start import Circuit, chosen_starts

# Reaches in: the estimate of a start's noise by itself, and the starts of a recording without their fits.
from motor_env.motor.parameters import FloatArray

MOTOR = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml")
FAULTS = {
    Verdict.HEALTHY: (),
    Verdict.BEARING: (Fault(FaultKind.BEARING, 0.30),),
    Verdict.WINDING: (Fault(FaultKind.WINDING_CONTACT, 0.30),),
}


def judge(defect: Defect, truth: Verdict, circuit: Circuit | None = None) -> Diagnosis:
    (recording,) = captures(defect, FAULTS[truth], MOTOR.parameters, 5, 1)
    return diagnose(recording, MOTOR, circuit=circuit)


JUDGED = [name for name, defect in DEFECTS.items() if defect.judged]
TURNS = [(name, (Verdict.BEARING, Verdict.WINDING)[n % 2]) for n, name in enumerate(JUDGED)]
OTHERS = [(name, (Verdict.WINDING, Verdict.BEARING)[n % 2]) for n, name in enumerate(JUDGED)]


@pytest.mark.parametrize(
    ("name", "truth"), [*TURNS, *(pytest.param(*other, marks=pytest.mark.long) for other in OTHERS)]
)
def test_a_fault_is_seen_through_each_defect(name: str, truth: Verdict) -> None:
    defect = DEFECTS[name]
    found = judge(defect, truth, Circuit(shunt_ohm=defect.shunt_ohm))
    assert found.verdict is truth
    fit = found.decisive.identified
    assert fit is not None
    assert defect.words in " ".join([*found.recording.columns, *map(str, fit.defects)])


@pytest.mark.parametrize(
    "name",
    ["pwm", "sensor lag", "quantisation", "jitter", pytest.param("supply ramp", marks=pytest.mark.long)],
)
def test_a_defect_is_no_fault(name: str) -> None:
    assert judge(DEFECTS[name], Verdict.HEALTHY).verdict is Verdict.HEALTHY


@pytest.mark.parametrize("name", [name for name, defect in DEFECTS.items() if not defect.judged])
def test_what_cannot_be_judged_is_unusable(name: str) -> None:
    found = judge(DEFECTS[name], Verdict.WINDING)
    assert found.verdict is Verdict.UNUSABLE
    assert DEFECTS[name].words in found.reasons[0]


@pytest.mark.parametrize(
    ("hertz", "size_a", "begin_s"), [(50.0, 0.2, 0.0), (59.9, 0.02, 0.0), (100.2, 0.1, 0.1)]
)
def test_hum_hides_no_friction(hertz: float, size_a: float, begin_s: float) -> None:
    """Of a probe throughout, or of the supply from the onset on: as found, and the friction as without it."""
    (start,) = captures(DEFECTS["none"], FAULTS[Verdict.BEARING], MOTOR.parameters, 5, 1)
    time_s = start.time_s
    wave = size_a * np.sin(2.0 * np.pi * hertz * time_s + 1.0) * (time_s >= time_s[0] + begin_s)
    plain, hummed = (
        diagnose(replace(start, current_a=start.current_a + hum), MOTOR) for hum in (0.0 * wave, wave)
    )
    assert (plain.verdict, hummed.verdict) == (Verdict.BEARING, Verdict.BEARING)
    assert hummed.severity == pytest.approx(plain.severity, abs=0.06)
    fits = [found.decisive.identified for found in (plain, hummed)]
    silent, humming = (fit.start for fit in fits if fit is not None)
    assert silent.hum_hz == ()
    assert humming.hum_hz == pytest.approx([hertz], abs=0.2)
    assert math.hypot(*humming.sizes) == pytest.approx(size_a, abs=0.003)
    assert humming.is_hum_of_supply is (begin_s > 0.0)


@pytest.mark.parametrize("hertz", [50.0, 60.1])
@pytest.mark.parametrize("level_a", [0.0, 0.5])
def test_hum_alone_is_no_start(hertz: float, level_a: float) -> None:
    time_s = 1e-4 * np.arange(6000.0)
    current = (
        level_a
        + 0.3 * np.sin(2.0 * np.pi * hertz * time_s + 0.4)
        + 0.1 * np.sin(6.0 * np.pi * hertz * time_s)
    )
    current += 0.05 * np.random.default_rng(7).standard_normal(len(time_s))
    found = identify(Recording(Path("hum"), time_s, current))
    assert not found.is_complete
    assert found.starts[0][1].start.hum_hz


def assert_friction_is_undecided(found: Diagnosis) -> None:
    """A healthy resistance, and nothing of the friction: each is told."""
    assert found.verdict is Verdict.HEALTHY
    assert found.reasons[1].startswith("the friction is undecided: the recording is too coarse")
    said = {change.name: change.verdict for change in found.changes}
    assert (said["R"], said["B/J"]) == ("healthy", "undecided")


def test_a_converter_too_coarse_for_the_friction_says_so() -> None:
    coarse = replace(DEFECTS["quantisation"], chain=replace(DEFECTS["quantisation"].chain, adc_bits=5))  # type: ignore[type-var]  # it has a chain
    assert_friction_is_undecided(judge(coarse, Verdict.HEALTHY))


def test_a_known_lag_and_a_known_shunt_are_taken_off() -> None:
    defect = Defect(lag_s=0.0003, shunt_ohm=0.5)
    (recording,) = captures(defect, (), MOTOR.parameters, 6, 1)
    (fit,) = identify(recording, circuit=Circuit(0.5, 0.0003)).usable
    (plain,) = captures(Defect(), (), MOTOR.parameters, 6, 1)
    (expected,) = identify(plain).usable
    np.testing.assert_allclose(fit.values[[0, 2, 3]], expected.values[[0, 2, 3]], rtol=0.03)
    assert fit.values[1] == pytest.approx(expected.values[1], rel=0.1)


def rippled(constant: float = 1.0, periods: float = 14.0) -> tuple[Recording, float]:
    """A start whose current is modulated by the angle that the simulated motor turns, and its last speed."""
    motor = PAPER_MOTOR.scaled(back_emf_constant_v_s_per_rad=constant, torque_constant_n_m_per_a=constant)
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.002, 1e-9)
    scenario = Scenario(motor, sensor=sensor, timing=Timing(10_000.0, 0.2, 0.02))
    current, speed = simulate(scenario, 3, [0]).measurements[0]
    time = scenario.timing.time_s
    angle = np.cumsum(speed) * scenario.timing.dt_s
    current = current * (1.0 + 0.1 * np.cos(periods * angle)) * (time > 0.0)
    voltage = np.where(time > 1e-9, 12.0, 0.0)
    return Recording(Path("x"), time, current, voltage), float(speed[-100:].mean())


@pytest.mark.parametrize("constant", [1.0, 1.2])
def test_the_ripple_tells_the_speed_and_the_constants(constant: float) -> None:
    recording, speed = rippled(constant)
    found = identify(recording, periods_per_turn=14.0).to_json()[0]["commutation"]
    assert found["speed_rad_s"] == pytest.approx(speed, rel=0.002)
    told = diagnose(recording, periods_per_turn=14.0)
    assert told.to_json()["commutation"] == found
    assert f"{found['speed_rad_s']:.5g} rad/s (" in told.text(verbose=True)
    nominal = float(PAPER_MOTOR.back_emf_constant_v_s_per_rad)
    assert found["K"]["value"] == pytest.approx(constant * nominal, rel=0.01)
    assert found["J"]["value"] == pytest.approx(float(PAPER_MOTOR.inertia_kg_m2), rel=0.05)


def test_without_a_ripple_there_is_no_speed() -> None:
    (recording,) = captures(Defect(), (), MOTOR.parameters, 5, 1)
    assert identify(recording).to_json()[0]["commutation"] is None


def test_the_ripple_compares_speeds_between_recordings() -> None:
    motor = commission([rippled()[0]] * 2, fewest=2).motor  # two alike
    assert motor.healthy is not None
    assert motor.healthy.starts is not None
    assert motor.healthy.starts.ripple_hz is not None
    found = diagnose(rippled(1.2)[0], motor)
    moved = {change.name: change.ratio for change in found.changes if change.significant}
    assert moved["K"] == pytest.approx(1.2, rel=0.02)
    assert moved["speed"] == pytest.approx(1.0 / 1.2, rel=0.02)


def several(*, voltage: bool) -> Recording:
    """Two starts in one recording, the second with a contact fault."""
    parts = [
        captures(Defect(), faults, MOTOR.parameters, 5, 1)[0]
        for faults in (FAULTS[Verdict.HEALTHY], FAULTS[Verdict.WINDING])
    ]
    current = np.concatenate([part.current_a for part in parts])
    volts = np.concatenate([part.voltage_v for part in parts if part.voltage_v is not None])
    time: FloatArray = np.arange(len(current), dtype=np.float64) * parts[0].dt_s
    return Recording(Path("two.csv"), time, current, volts if voltage else None)


def test_the_starts_of_a_recording_share_its_rate() -> None:
    both = diagnose(several(voltage=True), MOTOR, false_alarm_rate=0.02)
    assert (both.taken.regime, both.of) == ("start", 2)
    assert [piece.verdict for piece in both.pieces] == [Verdict.HEALTHY, Verdict.WINDING]
    assert (both.verdict, both.decisive) == (Verdict.WINDING, both.pieces[1])
    parts = chosen_starts(several(voltage=True), None)
    assert [piece.begin_s for piece in both.pieces] == [float(part.time_s[0]) for part in parts]
    second = diagnose(several(voltage=True), MOTOR, false_alarm_rate=0.02, start=2)
    assert (second.taken, second.of) == (("start", "as asked"), 1)
    half = diagnose(parts[1], MOTOR, false_alarm_rate=0.01)
    assert both.decisive.smallest_changes == half.decisive.smallest_changes
    assert both.decisive.smallest_changes["bearing"] > second.decisive.smallest_changes["bearing"]


@pytest.mark.parametrize("voltage", [True, False])
def test_each_start_of_a_file_is_judged(voltage: bool) -> None:
    parts = chosen_starts(several(voltage=voltage), None)
    assert [str(part.path) for part in parts] == ["two.csv#1", "two.csv#2"]
    assert [diagnose(part, MOTOR).verdict for part in parts] == [Verdict.HEALTHY, Verdict.WINDING]
    ((second, _),) = identify(several(voltage=voltage), start=2).starts
    assert second.path.name == "two.csv#2"
    with pytest.raises(InputError, match=r"--start must lie in 1 \.\. 2, got 3"):
        identify(several(voltage=voltage), start=3)


def test_a_recording_that_the_model_does_not_explain_is_said_to_be_inconsistent() -> None:
    (good,) = captures(Defect(), (), MOTOR.parameters, 5, 1)
    assert diagnose(good, MOTOR).decisive.warning == ""
    wavy = replace(good, current_a=good.current_a + 0.1 * np.sin(60.0 * good.time_s))
    assert "correlated in time" in diagnose(wavy, MOTOR).decisive.warning


def test_a_sensor_that_hides_small_currents_is_told_by_the_evidence() -> None:
    (plain,) = captures(Defect(noise_a=0.005), (), MOTOR.parameters, 8, 1)
    seen = np.where(plain.current_a > 0.3, plain.current_a, 0.0)
    hiding = replace(plain, current_a=seen)
    (fit,) = identify(hiding).usable
    assert fit.model == ("dead_zone",)
    assert fit.fitted_extension["dead_zone"][0] == pytest.approx(0.3, abs=0.03)
    assert any(defect.startswith("dead zone: ") for defect in fit.defects)
    (true,) = identify(plain).usable
    assert true.model == ()
    assert fit.log_values[0] == pytest.approx(true.log_values[0], abs=0.01)
    assert_friction_is_undecided(diagnose(hiding, MOTOR))


def test_no_start_knows_the_friction_better_than_its_noise_allows() -> None:
    """The friction is a level of 26 mA above the quiet part's: white noise bounds both means."""
    starts = captures(Defect(), (), MOTOR.parameters, 7, 6)
    errors = [math.sqrt(fit.log_covariance[3, 3]) for fit in identify(starts).usable]
    assert len(errors) == 6
    bound = 0.02 * math.sqrt(1.0 / 1000 + 1.0 / 1900) / 0.026
    assert all(0.85 * bound < error < 1.5 * bound for error in errors)


@pytest.mark.parametrize("with_reference", [False, True])
def test_friction_that_is_not_viscous_is_tried_where_nothing_is_compared(with_reference: bool) -> None:
    """A square wave of the supply tells Coulomb friction from viscous; a comparison keeps to the sheet's model."""
    time_s = np.linspace(0.0, 0.3998, 2000)
    voltage: FloatArray = np.where(time_s % 0.1 < 0.05, 1.5, -1.5) * (time_s > 0.01)
    states = driven(PAPER_MOTOR, voltage, 2e-4, from_rest=True, COULOMB=2e-3)
    noise = np.random.default_rng(3).normal(0.0, 0.002, len(time_s))
    recording = Recording(Path("square"), time_s, states[:, 0] + noise, voltage)
    found = diagnose(recording, MOTOR if with_reference else None, regime="start").decisive
    assert found.identified is not None
    assert ("coulomb" in found.identified.model) is not with_reference
    if not with_reference:  # and the filter, which is linear, takes it as a load that it knows
        assert found.consistency is not None
        assert found.consistency.mean_square == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("noise", [0.3, 0.5, 0.7, 0.9, 1.2, 2.0])
def test_noise_of_a_coarse_converter_is_the_same_from_start_to_start(noise: float) -> None:
    """In steps of the converter; its own error adds 1 / sqrt(12)."""
    rng = np.random.default_rng(3)
    decay = 50.0 * np.exp(-np.linspace(0.0, 5.0, 2000))
    levels = rng.uniform(0.0, 1.0, 40)
    found = [
        difference_noise(np.round(decay + v + noise * rng.standard_normal(2000)) - decay) for v in levels
    ]
    np.testing.assert_allclose(found, math.hypot(noise, 12.0**-0.5), rtol=0.2)
