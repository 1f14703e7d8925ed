"""Texts of each verdict and kind: heading, size, what to do first, and whether the motor may run on."""

from __future__ import annotations

from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.motor.faults import FaultKind

KIND_TEXTS = {
    "bearing": "more friction",
    "winding_contact": "more winding resistance",
    "winding_short": "shorted turns",
    "magnet": "weaker magnets",
}
SIZE_TEXTS = {
    FaultKind.BEARING: "Friction up by {}",
    FaultKind.WINDING_CONTACT: "Winding resistance up by {}",
    FaultKind.WINDING_SHORT: "{} of the turns shorted",
    **dict.fromkeys(map(FaultKind, ("current_gain", "speed_gain", "voltage_gain")), "Off by {}"),
}
VERDICT_TEXTS: dict[Verdict | FaultKind, tuple[str, ...]] = {
    Verdict.HEALTHY: (
        "Healthy",
        "Nothing to do. Keep this recording: more healthy starts make smaller faults visible.",
    ),
    Verdict.BEARING: (
        "More friction: bearing, lubricant or load",
        "Switch off, lock out, and turn the shaft by hand: rough, stiff or noisy?",
        "Uncouple the load and record another start. Still high: bearings or lubricant. Normal: the driven machine.",
    ),
    Verdict.WINDING: (
        "Winding or brushes",
        "Tighten and clean the terminals; measure the resistance with four leads at several rotor positions.",
        "High at all positions: connections or brushes. High or low at some: commutator or winding.",
    ),
    FaultKind.WINDING_SHORT: (
        "Winding: shorted turns",
        "Take the motor out of service soon: shorted turns heat up and spread.",
        (
            "Measure the resistance with four leads at several rotor positions: low at some confirms it. Replace or"
            " rewind."
        ),
    ),
    Verdict.MAGNET: (
        "Weak magnets",
        "Let the motor cool to the temperature of its healthy starts and record again: warm magnets are weaker.",
        "Still low: compare the no-load speed with the data sheet; it rises as magnets weaken.",
    ),
    Verdict.SENSOR: (
        "A sensor, not the motor",
        "Of the motor this recording says nothing: mend the sensor first, then record another start.",
        "Read the quantity with another instrument beside it. Do they differ? Then look at cable, range and scale.",
    ),
    FaultKind("current_dead"): (
        "The current's sensor shows nothing",
        "Clamp another probe around a lead. Nothing there either: the circuit is open, or a fuse is.",
        "A current there: check supply, cable and connector of the sensor, and the recorder's channel. Record again.",
    ),
    FaultKind("speed_dead"): (
        "The speed's sensor shows nothing",
        "Turn the shaft by hand and watch the reading: supply, cable and connector of the encoder or tachometer.",
        "Look whether its wheel or coupling slips on the shaft. Then record again.",
    ),
    **dict.fromkeys(
        map(FaultKind, ("current_polarity", "speed_polarity", "voltage_polarity")),
        (
            "A reading with the wrong sign",
            "Check which way round probe, encoder and the motor's leads are connected: who worked on them last?",
            "Turn the one round that differs, and record again; its size may be right.",
        ),
    ),
    **dict.fromkeys(
        map(FaultKind, ("current_clipped", "speed_clipped")),
        (
            "A reading at the end of its range",
            "Choose a range of which the peak fills half, and record again: from before switching on.",
            "Still flat: the supply limits the current, or the counter its rate; look at their settings.",
        ),
    ),
    **dict.fromkeys(
        map(FaultKind, ("current_stuck", "speed_stuck")),
        (
            "A reading that stands still",
            "Move the cable and watch the reading; look whether the recorder repeats the last sample.",
            "Switch sensor and recorder off and on, and record again.",
        ),
    ),
    **dict.fromkeys(
        map(FaultKind, ("current_gain", "speed_gain", "voltage_gain")),
        (
            "A scale that changed",
            "Compare with a second instrument: a clamp meter, a stroboscope, a voltmeter at the terminals under load.",
            "Check range switch, shunt or divider, pulses a turn and gear; a battery: charge it. Then record again.",
        ),
    ),
    FaultKind("current_offset"): (
        "A current that does not begin at zero",
        "Read the current with the motor's lead off: what shows then is the offset. Balance the sensor there.",
        "It comes back: look for a magnet or a high current beside the sensor.",
    ),
    FaultKind("swapped"): (
        "Columns that are swapped",
        "Check the order of the columns and which cable is in which channel: unplug one and see which reading stops.",
        "Name the columns with --column, or swap the cables, and diagnose again.",
    ),
    Verdict.NOISE: (
        "Noisy current",
        "Check brushes and commutator for sparks and wear, then the probe, its cable and its ground.",
        "Record again with the probe on another supply line to tell the motor's noise from the sensor's.",
    ),
    Verdict.OTHER: (
        "Something changed that is no single known fault",
        "Check the recording first: the probe's scale, the units and the supply voltage under Read as, below.",
        "Is it this motor, with the usual load? Record two more starts; if they agree, take it out for inspection.",
    ),
    Verdict.NO_REFERENCE: (
        "Nothing to compare with",
        "Record three healthy starts and run: motor-env commission A.csv B.csv C.csv -o motor.toml",
        "Or write the data sheet into a motor file, and run diagnose again with --motor motor.toml.",
    ),
    Verdict.UNUSABLE: (
        "This recording cannot be judged",
        "Record again: from before switching on until the current is steady, without clipping.",
        "Choose the range so that the peak fills half of it, and leave some milliseconds without current before it.",
    ),
}
"""The heading of a verdict, or of a kind of its own, and what to do first."""

RUN_ON_TEXTS: dict[Verdict | FaultKind, str] = {
    Verdict.HEALTHY: "It may run on.",
    Verdict.BEARING: "It may run on to the next stop while it stays cool and quiet: friction heats it, and may jam it.",
    Verdict.WINDING: "It may run on to the next stop at a light load: a bad contact heats up, and may open.",
    FaultKind.WINDING_SHORT: "It should not run on: shorted turns heat up and spread.",
    Verdict.MAGNET: "It may run on with less torque: under the same load it draws more current and gets hotter.",
    Verdict.SENSOR: "The motor is not judged. Let it run on only where nothing relies on this reading.",
    Verdict.NOISE: "It may run on while the brushes do not spark.",
    Verdict.OTHER: "Not known: stop it at the next occasion and look.",
    Verdict.NO_REFERENCE: "Not known from this recording.",
    Verdict.UNUSABLE: "Not known from this recording.",
}
"""Whether the motor may run on, by verdict or kind."""
