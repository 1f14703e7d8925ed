"""Draw self-contained HTML pages of verdicts and of fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from motor_env.common.console import printable
from motor_env.common.pages import Axis, Chart, render, round_ticks
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import OperationFit
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.estimation.starts.start_prior import absolute_parameters
from motor_env.diagnosis.verdict.hypotheses import Change, Fitted
from motor_env.diagnosis.verdict.judgement import JudgedRecording, Judgement, Verdict, percent
from motor_env.diagnosis.verdict.report_text import as_text, describe_r2, warnings_of
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray

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
        "This recording says nothing about the motor: repair the sensor first, then record another start.",
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
    FaultKind("speed_offset"): (
        "A speed that does not begin at zero",
        "Read the speed while the motor stands: what shows then is the offset. Balance the sensor there.",
        "It comes back: compare with a stroboscope while the motor turns.",
    ),
    **dict.fromkeys(
        map(FaultKind, ("current_drift", "speed_drift")),
        (
            "A reading that drifts",
            "Let motor and sensor warm up, and watch the reading while the motor stands.",
            "It still moves: compare with a second instrument, and replace the sensor.",
        ),
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


_WIDTH = 480.0  # so narrow that its numbers can be read on a phone
_RATIOS = (1.0, 0.5, 2.0, 0.25, 4.0, 0.125, 8.0, 1.5, 0.75, 1.25, 0.8, 1.1, 0.9, 1.05, 0.95)
"""Possible grid lines, the preferred ones first."""
_MOST_POINTS = 700
_SHOWN_SHARE = 0.02  # of the recording before the start
_END = "The end of the start, averaged"
_COINCIDE = 0.03  # of the peak: closer curves cannot be told apart
_QUANTITY = {
    "R": "Winding resistance R",
    "L": "Inductance L",
    "K": "Constant K",
    "K^2/J": "Pull K²/J",
    "J": "Inertia J",
    "B": "Friction B",
    "B/J": "Friction B/J",
    "speed": "Speed (ripple)",
}


def page(diagnosis: JudgedRecording) -> str:
    """Draw the page of a diagnosis."""
    decisive, verdict = diagnosis.decisive, diagnosis.verdict
    fit, expected = decisive.identified, reference_current(decisive)
    tone = "bad" if verdict.is_fault else "good" if verdict is Verdict.HEALTHY else "unsure"
    faults = (decisive, *decisive.also)
    names = [fault.kind if fault.kind in VERDICT_TEXTS else fault.verdict for fault in faults]
    texts = [VERDICT_TEXTS.get(name, (str(name).capitalize(),)) for name in names]
    runs_on = [RUN_ON_TEXTS.get(f.kind or f.verdict) or RUN_ON_TEXTS.get(f.verdict, "") for f in faults]
    sure = "" if diagnosis.confidence is None else f"{diagnosis.confidence:.0%} sure"
    current, residual = ("", "") if fit is None else _currents(fit, expected, is_fault=verdict.is_fault)
    return render(
        "motor_env.diagnosis.verdict",
        "diagnosis.html.j2",
        title=", and: ".join(title for title, *_ in texts),
        file=printable(diagnosis.recording.path.name),
        tone=tone,
        size="; ".join(filter(None, map(_size, faults))),
        sure="over 99 % sure" if (diagnosis.confidence or 0.0) > 0.99 else sure,
        runs_on=" ".join(dict.fromkeys(runs_on)),
        first=[step for _, *steps in texts for step in steps],
        reasons=[f"{reason[0].upper()}{reason[1:]}." for reason in diagnosis.reasons],
        warnings=[
            f"{sentence[0].upper()}{sentence[1:]}." for sentence in warnings_of(diagnosis.recording, fit)
        ],
        read=[printable(note) for note in diagnosis.recording.columns],
        taken=str(diagnosis.taken),
        history=pieces_chart(diagnosis.pieces) if len(diagnosis.pieces) > 1 else "",
        bars=_bars(diagnosis.changes) if diagnosis.changes else "",
        current=current,
        has_expected=expected is not None,
        part=f"{_END}: " if _END in current else "",
        residual=residual,
        smallest=[
            (KIND_TEXTS.get(kind, kind), percent(share, ".0%"))
            for kind, share in decisive.smallest_changes.items()
        ],
        expert=printable(as_text(diagnosis, verbose=True)),
    )


def page_of_fits(
    title: str, fits: Mapping[str, StartFit | OperationFit], *, spread: str = "", note: str = ""
) -> str:
    """Draw the page of fits: measured beside fitted current and speed, and the residuals.

    Args:
        title: heading.
        fits: of starts and of logs, by the name of the recording.
        spread: chart of how the quantities of healthy pieces spread, as SVG.
        note: sentence below that chart.
    """
    return render(
        "motor_env.diagnosis.verdict",
        "fits.html.j2",
        title=printable(title),
        spread=spread,
        note=note,
        fits=[
            (
                printable(name),
                f"{' + '.join(fit.model) or 'textbook'}, {describe_r2(fit.r2_current, fit.r2_speed)}",
                "\n".join(_fit_charts(fit)),
            )
            for name, fit in fits.items()
        ],
    )


def _fit_charts(fit: StartFit | OperationFit) -> Iterator[str]:
    """Draw current and speed with residuals, of a log also the voltage, without uncounted samples."""
    if isinstance(fit, StartFit):
        time, unit = 1e3 * (fit.start.time_s - fit.onset_s), "ms"
        measured = [fit.start.current_a, fit.start.speed_rad_s]
        counted = [fit.start.counted, np.full(len(time), fill_value=True)]
    else:
        time, unit = fit.record.dt_s * np.arange(len(fit.expected), dtype=np.float64), "s"
        measured = [fit.record.readings[:, n] if fit.record.recorded[n] else None for n in range(2)]
        counted = [np.isfinite(fit.record.readings[:, n]) for n in range(2)]
        yield _chart(time, {"measured": fit.record.voltage_v}, "V", "Voltage", time_unit=unit)
    channels = (("Current", "A"), ("Speed", "rad/s"))
    for (name, symbol), values, fitted, rows in zip(channels, measured, fit.expected.T, counted, strict=True):
        if values is None:
            continue
        rows_shown = np.flatnonzero(rows)
        rows_shown = rows_shown[:: max(len(rows_shown) // _MOST_POINTS, 1)]
        curves = {"measured": values[rows_shown], "healthy": fitted[rows_shown]}
        yield _chart(time[rows_shown], curves, symbol, f"{name}, measured and fitted", time_unit=unit)
        residual = {"beyond": values[rows_shown] - fitted[rows_shown]}
        yield _chart(time[rows_shown], residual, symbol, f"{name}: residual", time_unit=unit)


def spread_chart(fits: Sequence[Fitted], parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw the interval of each quantity of the next healthy piece, and a dot for each piece, in per cent."""
    rows = zip(parameters.items(), np.exp([fit.log_values for fit in fits]).T, strict=True)
    changes, pieces = [], {}
    for (name, row), values in rows:
        low, high = np.asarray(row["interval"]) / row["value"]
        changes.append(Change(name, 1.0, low, high, "healthy"))
        pieces[name] = values / row["value"]
    return _bars(tuple(changes), pieces)


def _size(judgement: Judgement) -> str:
    """Describe the size of a fault with its interval; empty without a size."""
    size, interval, kind = judgement.severity, judgement.severity_interval, judgement.fault_kind
    if not size or not judgement.verdict.is_fault or kind is None:
        return ""
    between = "" if interval is None else f", between {' and '.join(percent(end, '.0%') for end in interval)}"
    return SIZE_TEXTS.get(kind, "Size {}").format(percent(size, ".0%")) + between


def reference_current(judgement: Judgement) -> FloatArray | None:
    """Simulate the current of the reference's motor in this start, shape (n,); None without a reference.

    Without a speed, K is that of the fit: the current depends on K^2/J and B/J only.
    """
    fit, reference = judgement.identified, judgement.reference
    if fit is None or reference is None:
        return None
    believed = float(np.max(fit.parameters.back_emf_constant_v_s_per_rad))
    value = absolute_parameters(
        dict(zip(fit.quantity_names, fit.values.tolist(), strict=True)) | reference.values, believed
    )
    physical = fit.physical
    for name in "RLKJB":
        physical[getattr(index, name)] = value[name]
    return fit.run(physical)[:, 0] + fit.start.alignment.offset_a


def _bars(changes: tuple[Change, ...], pieces: Mapping[str, FloatArray] | None = None) -> str:
    """Draw the change of each quantity, or of several pieces, with its interval on a logarithmic axis."""
    height = 34.0 * len(changes)
    chart = Chart(
        _ratio_axis(changes),
        Axis("", 0.0, 1.0),
        size=(_WIDTH, height + 30.0),
        margins=(150.0, 64.0, 0.0, 30.0),
        label="Deviation of each quantity from the healthy motor, with its 95 % interval",
    )
    chart.x_numbers(grid=True)
    chart.upright("zero", 1.0)
    for row, change in enumerate(changes):
        y, style = 34.0 * row + 17.0, "moved" if change.significant else "still"
        name = change.name.replace(" V)", ")").removesuffix("/V").replace("(J)", "J")
        with chart.group(style, f"{change.name}: {percent(change.ratio - 1.0)}"):
            chart.text((0.0, y + 5.0), _QUANTITY.get(name, change.name), "name")
            chart.line("interval", (chart.x(change.low), y), (chart.x(change.high), y))
            if pieces is not None:
                for ratio in pieces[change.name]:
                    chart.dot("dot", (chart.x(ratio), y), 4.0)
                continue
            chart.dot("dot", (chart.x(change.ratio), y), 6.0)
            chart.text((_WIDTH, y + 5.0), percent(round(change.ratio - 1.0, 2) + 0.0, "+.0%"), "value", "end")
    return chart.svg()


def _ratio_axis(changes: Sequence[Change]) -> Axis:
    """Make a logarithmic axis in per cent, a tenth wider than the widest interval."""
    widest = max(max(change.high, 1.0 / change.low) for change in changes)
    edge = float(np.clip(1.1 * widest, 1.1, 8.0))
    ticks: list[float] = []
    for tick in _RATIOS:
        difference = min((abs(np.log(tick / drawn)) for drawn in ticks), default=1.0)
        if 1.0 / edge <= tick <= edge and difference > 0.36 * np.log(edge):
            ticks.append(tick)
    return Axis("", 1.0 / edge, edge, ticks, lambda ratio: f"{100.0 * (ratio - 1.0):+.0f} %", is_log=True)


def _currents(fit: StartFit, expected: FloatArray | None, *, is_fault: bool) -> tuple[str, str]:
    """Draw the measured current beside the healthy motor's, and their difference; empty without the latter.

    The difference is averaged over a fiftieth of the recording, with the sensor's noise as a band. If curves of a fault
    would coincide, only the averaged end is drawn.
    """
    time_ms = 1e3 * (fit.start.time_s - fit.onset_s)
    begin = int(np.searchsorted(time_ms, -_SHOWN_SHARE * time_ms[-1]))
    shown = slice(begin, None, max((len(time_ms) - begin) // _MOST_POINTS, 1))
    measured = fit.start.current_a - fit.start.ripple_a
    span = max(len(measured) // 50, 1)
    curves = {"measured": fit.start.current_a[shown]}
    if expected is not None:
        curves["healthy"] = expected[shown]
    whole_ms, current = time_ms[shown], ""
    if expected is not None and is_fault:
        difference = np.abs(moving_average(measured - expected, span))[begin:]
        if np.max(difference) < _COINCIDE * np.ptp(curves["healthy"]):
            current = _end_chart(
                time_ms,
                moving_average(measured, span),
                moving_average(expected, span),
                float(np.max(difference)),
            )
    label = "Measured current and that of the healthy motor"
    current = current or _chart(whole_ms, curves, "A", label)
    if expected is None:
        return current, ""
    time_ms, smooth = whole_ms, moving_average(measured - expected, span)[shown]
    noise = 2.0 * fit.noise_a / float(np.sqrt(span))
    largest = max(float(np.quantile(np.abs(smooth[time_ms > 0.0]), 0.98)), 2.0 * noise)
    unit, factor = ("A", 1.0) if largest > 1.0 else ("mA", 1e3)
    edge = 1.2 * factor * largest
    residual = _chart(
        time_ms,
        {"beyond": factor * smooth},
        unit,
        "Measured less healthy current, with the band of the sensor's noise",
        limits=(-edge, edge),
        band=factor * noise,
    )
    return current, residual


def moving_average(values: FloatArray, span: int) -> FloatArray:
    """Average over so many samples, moving; shape (n,)."""
    padded = np.pad(values, (span // 2, span - 1 - span // 2), "reflect")
    return np.convolve(padded, np.ones(span) / span, "valid")


def _end_chart(time_ms: FloatArray, measured: FloatArray, healthy: FloatArray, apart_a: float) -> str:
    """Draw both settled currents; empty if they do not settle."""
    moving = np.flatnonzero(np.abs(healthy - healthy[-1]) > 2.0 * apart_a)
    begin = int(moving[-1]) + 1 if moving.size else 0
    if begin > 0.9 * len(healthy):
        return ""
    shown = slice(begin, None, max((len(time_ms) - begin) // _MOST_POINTS, 1))
    unit, factor = ("A", 1.0) if apart_a > 1.0 else ("mA", 1e3)
    curves = {"measured": factor * measured[shown], "healthy": factor * healthy[shown]}
    label = f"{_END}: measured current and that of the healthy motor"
    return _chart(time_ms[shown], curves, unit, label)


def _chart(
    time_ms: FloatArray,
    curves: Mapping[str, FloatArray],
    unit: str,
    label: str,
    *,
    limits: tuple[float, float] | None = None,
    band: float = 0.0,
    time_unit: str = "ms",
) -> str:
    """Draw curves over the time, within their limits, and a band about 0."""
    begin, end = float(time_ms[0]), float(time_ms[-1])
    low, high = limits or (min(map(np.min, curves.values())), max(map(np.max, curves.values())))
    room = 0.05 * max(high - low, 1e-9)
    low, high = low - room, high + room
    chart = Chart(
        Axis("", begin, end, round_ticks(begin, end), lambda value: f"{value:g} {time_unit}"),
        Axis("", low, high, round_ticks(low, high), lambda value: f"{value:g} {unit}"),
        size=(_WIDTH, 230.0),
        margins=(66.0 + 8.0 * max(len(unit) - 2, 0), 32.0, 8.0, 28.0),
        label=label,
    )
    if band:
        corners = chart.points([begin, end, end, begin], [band, band, -band, -band])
        chart.shape("polygon", "band", points=corners)
    chart.y_numbers()
    chart.x_numbers()
    for style, values in curves.items():
        chart.curve(style, time_ms, values)
    return chart.svg()


def pieces_chart(pieces: Sequence[Judgement]) -> str:
    """Draw the change of each quantity from the healthy motor, piece by piece over the recording's time."""
    judged = [(piece, {change.name: change for change in piece.changes}) for piece in pieces if piece.changes]
    names = [name for name in judged[0][1] if name in judged[-1][1]] if judged else []
    return "\n".join(
        _history(name, [(piece, changes[name]) for piece, changes in judged if name in changes])
        for name in names
    )


def _history(name: str, changes: Sequence[tuple[Judgement, Change]]) -> str:
    """Draw one quantity: a dot and its interval for each piece."""
    begin, end = changes[0][0].begin_s, max(piece.begin_s + piece.duration_s for piece, _ in changes)
    what = _QUANTITY.get(name, name)
    chart = Chart(
        Axis("", begin, end, round_ticks(begin, end), lambda value: f"{value:g} s"),
        _ratio_axis([change for _, change in changes]),
        size=(_WIDTH, 130.0),
        margins=(66.0, 32.0, 24.0, 28.0),
        label=f"{what} over time, with 95 % intervals",
    )
    chart.y_numbers()
    chart.x_numbers()
    chart.text((66.0, 14.0), what, "name")
    for piece, change in changes:
        middle = chart.x(piece.begin_s + 0.5 * piece.duration_s)
        with chart.group("moved" if change.significant else "still", percent(change.ratio - 1.0)):
            chart.line("interval", (middle, chart.y(change.low)), (middle, chart.y(change.high)))
            chart.dot("dot", (middle, chart.y(change.ratio)), 4.0)
    return chart.svg()
