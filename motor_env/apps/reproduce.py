"""Write the paper's figures and numbers beside ours as a page and as JSON: `motor-env reproduce`.

The folder holds `index.html` and `paper.md` (the same page), `images/` and `reproduce.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from motor_env.apps.paper import (
    FAULT_LEVELS,
    SETTLING_BAND,
    VOLTAGE_V,
    comparisons,
    faulty,
    level_name,
    slips,
    start_up,
)
from motor_env.common.files import require_own_output, write_text
from motor_env.common.pages import render
from motor_env.common.plotting import COLOUR, INK, QUIET, drawing, end_label, note, save, subplots
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD, KalmanFilter
from motor_env.motor.faults import Fault, FaultKind
from motor_env.motor.model import State
from motor_env.motor.parameters import PAPER_MOTOR, RAD_S_PER_RPM, FloatArray, SensorParameters
from motor_env.simulation.simulate import Scenario, Timing, Transients, simulate, simulate_states

SEED = 1
SENSOR = SensorParameters(current_noise_a=0.02)
"""Sensor with a current noise of 20 mA; the filter's R is its square."""

PROCESS_NOISE_STD = DEFAULT_PROCESS_NOISE_STD
"""Roots of the diagonal of the filter's Q."""

TIMING = Timing(sampling_rate_hz=10_000.0, duration_s=0.1)

NOISE_FAULT = Fault(FaultKind.NOISE, severity=15.0, onset_s=0.04, growth_s=0.04)
"""Incipient noise: its variance rises from 40 ms on to 16 times the healthy one at 80 ms."""

UNKNOWN_START_STD = (0.5, 50.0)
"""Initial uncertainty of the filter in the covariance figure: 0.5 A, 50 rad/s."""

N_RUNS = 400
TIME_AXIS: dict[str, Any] = {"xlabel": "time after the step (ms)", "xlim": (0.0, 100.0)}
_MA = 1e3
_MS = 1e3


class PaperFigure(NamedTuple):
    """One figure: name of its file, caption, and the function that draws it."""

    name: str
    caption: str
    draw: Callable[[], Figure]

    @property
    def image(self) -> str:
        """Path of its picture relative to the page."""
        return f"images/{self.name}.svg"


def _start(case: int, *faults: Fault, **options: Any) -> Transients:
    return simulate(
        Scenario(PAPER_MOTOR, faults=faults, sensor=SENSOR, timing=TIMING, **options), SEED, cases=[case]
    )


def _noisy_start() -> Transients:
    return _start(0, NOISE_FAULT, process_noise_std=PROCESS_NOISE_STD)


def _belief(**options: Any) -> KalmanFilter:
    return KalmanFilter.from_parameters(
        PAPER_MOTOR, SENSOR, TIMING.dt_s, process_noise_std=PROCESS_NOISE_STD, **options
    )


def _fine_start(fault: Fault | None, duration_s: float, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return time in ms and states of a start without noise, from the step on."""
    n_samples = round(duration_s / dt_s)
    states: FloatArray = simulate_states(faulty(fault), np.full(n_samples, VOLTAGE_V), dt_s)
    time_ms = _MS * dt_s * np.arange(n_samples + 1, dtype=np.float64)
    return time_ms, np.concatenate([np.zeros((1, 2)), states])


def _shade_noise_fault(axes: Axes) -> None:
    begin, full = _MS * NOISE_FAULT.onset_s, _MS * (NOISE_FAULT.onset_s + NOISE_FAULT.growth_s)
    axes.axvspan(begin, _MS * TIMING.duration_s, color=COLOUR["noise"], alpha=0.08, linewidth=0)
    axes.axvline(full, color=COLOUR["noise"], alpha=0.5, linewidth=1, linestyle=":")


def healthy_start() -> Figure:
    """Draw figure 4: current, velocity and speed of the healthy motor."""
    time_ms, states = _fine_start(None, 0.04, 2e-5)
    current, speed = states[:, State.CURRENT], states[:, State.SPEED]
    figures = start_up(PAPER_MOTOR)
    figure, (top, middle, bottom) = subplots(3, height_in=8.0)
    top.plot(time_ms, current, color=COLOUR["healthy"])
    peak_ms = _MS * figures.peak_time_s
    top.plot([peak_ms], [figures.peak_a], "o", color=INK, markersize=6, markeredgecolor="white", zorder=5)
    peak = f"{figures.peak_a:.3f} A at {peak_ms:.2f} ms"
    note(top, (peak_ms, figures.peak_a), peak, (10.0, -3.0), color=INK)
    final = (38.0, figures.final_current_a)
    note(top, final, f"final {_MA * figures.final_current_a:.2f} mA", (0, 9), ha="right")
    top.set(title="Current", ylabel="current (A)", ylim=(0.0, 5.6))
    middle.plot(time_ms, speed, color=COLOUR["healthy"])
    middle.set(title="Angular velocity", ylabel="velocity (rad/s)", ylim=(0.0, 560.0))
    bottom.plot(time_ms, speed / RAD_S_PER_RPM, color=COLOUR["healthy"])
    bottom.set(title="Speed", ylabel="speed (rpm)", xlabel="time after the step (ms)", ylim=(0.0, 5400.0))
    for axes, scale, unit in ((middle, RAD_S_PER_RPM, "rad/s"), (bottom, 1.0, "rpm")):
        value = figures.final_speed_rpm * scale
        note(axes, (38.0, value), f"{value:.1f} {unit}", (0, -16), ha="right")
    return figure


def true_states() -> Figure:
    """Draw figure 8, the first: the true states, with Gaussian noise in the current output."""
    transients = _noisy_start()
    time_ms = _MS * transients.time_s
    figure, (top, bottom) = subplots(2, height_in=7.0, height_ratios=(3, 2))
    _shade_noise_fault(top)
    measured, true = transients.measurements[0, 0], transients.states[0, :, State.CURRENT]
    top.plot(time_ms, measured, color=COLOUR["measured"], linewidth=1.0, label="measured")
    top.plot(time_ms, true, color=COLOUR["healthy"], label="true")
    top.set(title="Current, with Gaussian noise in its output", ylabel="current (A)", ylim=(-0.3, 5.5))
    top.legend(loc="center right")
    inset = top.inset_axes((0.27, 0.26, 0.49, 0.58))
    _shade_noise_fault(inset)
    inset.plot(time_ms, _MA * measured, color=COLOUR["measured"], linewidth=0.9)
    inset.plot(time_ms, _MA * true, color=COLOUR["healthy"], linewidth=1.6)
    inset.set(xlim=(20.0, 100.0), ylim=(-230.0, 290.0), ylabel="mA")
    inset.set_title("incipient noise from 40 ms on, enlarged", fontsize=11, fontweight="normal")
    inset.tick_params(labelsize=9)
    bottom.plot(time_ms, transients.states[0, :, State.SPEED], color=COLOUR["healthy"])
    bottom.set(title="Speed", ylabel="speed (rad/s)", ylim=(0.0, 560.0), **TIME_AXIS)
    return figure


def healthy_minus_faulty() -> Figure:
    """Draw figure 8, the second: the healthy minus the faulty output."""
    faults = (NOISE_FAULT, Fault(FaultKind.WINDING_CONTACT, 0.25), Fault(FaultKind.BEARING, 0.25))
    names = (
        "Incipient noise, growing from 40 ms to 16 times the variance at 80 ms",
        "Winding contact 25 %",
        "Bearing 25 %: a level of 6.4 mA under 20 mA of noise",
    )
    figure, rows = subplots(3, height_in=8.0)
    reference = _start(0)
    time_ms = _MS * reference.time_s
    for case, (axes, fault, name) in enumerate(zip(rows, faults, names, strict=True), start=1):
        other = _start(case, fault)
        measured = _MA * (reference.measurements - other.measurements)[0, 0]
        true = _MA * (reference.states - other.states)[0, :, State.CURRENT]
        faint: dict[str, Any] = {"color": COLOUR[str(fault.kind)], "linewidth": 0.9, "alpha": 0.55}
        axes.plot(time_ms, measured, **faint, label="of the outputs")
        axes.plot(time_ms, true, color=INK, linewidth=1.8, label="without the noise")
        axes.set(title=name, ylabel="healthy - faulty (mA)")
    _shade_noise_fault(rows[0])
    rows[0].legend(loc="upper left", ncols=2)
    rows[0].set_ylim(-300.0, 400.0)
    rows[2].set(ylim=(-120.0, 120.0), **TIME_AXIS)
    return figure


def estimated_states() -> Figure:
    """Draw figure 9: the estimated current, speed and velocity, from the noisy current of figure 8."""
    transients = _noisy_start()
    result = run_filter(_belief(), transients.measurements, transients.voltage_v)
    time_ms = _MS * transients.time_s
    measured, current = _MA * transients.measurements[0, 0], _MA * transients.states[0, :, State.CURRENT]
    figure, (top, middle, bottom) = subplots(3, height_in=8.4)
    _shade_noise_fault(top)
    top.plot(time_ms, measured, color=COLOUR["measured"], linewidth=0.9, label="measured")
    top.plot(time_ms, _MA * result.state[0, :, State.CURRENT], color=COLOUR["estimate"], label="estimated")
    top.plot(time_ms, current, color=INK, linestyle=":", label="true")
    top.set(title="Current (start cut off at 400 mA)", ylabel="current (mA)", ylim=(-230.0, 400.0))
    top.legend(loc="upper right", ncols=3)
    estimate, true = result.state[0, :, State.SPEED], transients.states[0, :, State.SPEED]
    middle.plot(time_ms, estimate, color=COLOUR["estimate"], label="estimated")
    middle.plot(time_ms, true, color=INK, linestyle=":", label="true")
    middle.set(title="Angular velocity, never measured", ylabel="velocity (rad/s)", ylim=(0.0, 560.0))
    middle.legend(loc="lower right", ncols=2)
    band = 2.0 * np.sqrt(result.covariance[:, State.SPEED, State.SPEED]) / RAD_S_PER_RPM
    bottom.fill_between(
        time_ms, -band, band, color=COLOUR["estimate"], alpha=0.15, linewidth=0, label="±2 sd of P"
    )
    bottom.plot(time_ms, (estimate - true) / RAD_S_PER_RPM, color=COLOUR["estimate"], linewidth=1.4)
    limits = -2.0 * band.max(), 2.0 * band.max()
    bottom.set(title="Speed: error of the estimate", ylabel="error (rpm)", ylim=limits, **TIME_AXIS)
    bottom.legend(loc="lower right")
    return figure


def error_covariance() -> Figure:
    """Draw the filter's error covariance, and its actual error."""
    start_std = np.asarray(UNKNOWN_START_STD)
    errors, covariance = _errors_of_many_runs(_belief(initial_std=UNKNOWN_START_STD), start_std)
    time_ms = _MS * TIMING.time_s
    figure, (top, bottom) = subplots(2, height_in=6.4)
    rows = (
        (top, State.CURRENT, _MA, "Current", "sd (mA)"),
        (bottom, State.SPEED, 1.0, "Speed", "sd (rad/s)"),
    )
    for axes, state, scale, title, label in rows:
        std = scale * np.sqrt(covariance[:, state, state])
        axes.plot(time_ms, std, color=COLOUR["estimate"], label="square root of P")
        rms = scale * np.sqrt(np.mean(np.square(errors[:, :, state]), axis=0))
        dots: dict[str, Any] = {
            "color": INK,
            "markersize": 4.5,
            "label": f"measured error, rms of {N_RUNS} runs",
        }
        axes.plot(time_ms[::25], rms[::25], "o", **dots)
        axes.set(title=title, ylabel=label, yscale="log")
    top.axhline(_MA * SENSOR.current_noise_a, color=QUIET, linestyle="--", linewidth=1.2)
    note(top, (98.0, 20.0), "noise of one sample, 20 mA", (0, 6), ha="right", fontsize=None)
    top.legend(loc="center right")
    bottom.set(**TIME_AXIS)
    return figure


def _errors_of_many_runs(belief: KalmanFilter, start_std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Simulate estimation errors, with start and process noise as the filter assumes them."""
    rng = np.random.default_rng(SEED)
    shape = (N_RUNS, TIMING.n_samples)
    states = simulate_states(
        PAPER_MOTOR,
        np.full(TIMING.n_samples, VOLTAGE_V),
        TIMING.dt_s,
        initial_state=start_std * rng.standard_normal((N_RUNS, 2)),
        process_noise=np.asarray(PROCESS_NOISE_STD) * rng.standard_normal((*shape, 2)),
    )
    measured = states[:, :, State.CURRENT] + SENSOR.current_noise_a * rng.standard_normal(shape)
    result = run_filter(belief, measured[:, None, :], np.full(TIMING.n_samples, VOLTAGE_V))
    return result.state - states, result.covariance


def faulty_start(fault: Fault) -> Figure:
    """Draw figures 10 to 13: the current of a faulty motor beside the healthy one, its start and its end."""
    figure, (top, bottom) = subplots(2, height_in=7.0, height_ratios=(3, 2), sharex=False)
    pairs = ((None, COLOUR["healthy"], "-"), (fault, COLOUR[str(fault.kind)], "--"))
    for index, (motor, curve_colour, dashes) in enumerate(pairs):
        time_ms, states = _fine_start(motor, 0.06, 2e-5)
        current, figures = states[:, State.CURRENT], start_up(faulty(motor))
        top.plot(time_ms, current, dashes, color=curve_colour, label=level_name(motor))
        bottom.plot(time_ms, _MA * current, dashes, color=curve_colour)
        top.annotate(
            f"{level_name(motor)}: peak {figures.peak_a:.3f} A at {_MS * figures.peak_time_s:.2f} ms, "
            f"settled at {_MS * figures.settling_time_s:.2f} ms",
            (0.16, 0.88 - 0.11 * index),
            xycoords="axes fraction",
            color=curve_colour,
            fontsize=12,
            fontweight="bold",
        )
        # The two final levels differ by 3 mA or 0.01 mA: their names stand above and below the curves.
        final_ma = _MA * figures.final_current_a
        offset_pt = -8.0 if index == 0 else 8.0
        end_label(bottom, 60.0, final_ma, f"{final_ma:.2f} mA", curve_colour, offset_pt=offset_pt)
    top.set(
        title=f"Start-up current, {level_name(fault)}",
        ylabel="current (A)",
        xlim=(0.0, 20.0),
        ylim=(0.0, 5.6),
    )
    bottom.set(title="The same, its end enlarged", ylabel="current (mA)", ylim=(20.0, 60.0))
    bottom.set(**{**TIME_AXIS, "xlim": (16.0, 60.0)})
    return figure


def _level_figures() -> list[PaperFigure]:
    what = {
        FaultKind.WINDING_CONTACT: "armature winding fault. The resistance of the table raised: "
        "the peak falls and the start lasts longer; "
        "the final current stays",
        FaultKind.BEARING: "bearing fault. The friction of the table raised: the start stays; the final current rises",
    }
    return [
        PaperFigure(
            f"figure_{number}",
            f"Figure {number}: current output for {100 * float(fault.severity):g} % of {what[fault.kind]}.",
            partial(faulty_start, fault),
        )
        for number, fault in enumerate(filter(None, FAULT_LEVELS), start=10)
    ]


def paper_figures() -> list[PaperFigure]:
    """List all figures, in the order of the paper."""
    return [
        PaperFigure(
            "figure_04",
            "Figure 4: current, velocity and speed of the healthy motor; 12 V from rest, no noise.",
            healthy_start,
        ),
        PaperFigure(
            "figure_08_true_states",
            "Figure 8 (the first of two): true states, current and speed, with Gaussian noise in the current output.",
            true_states,
        ),
        PaperFigure(
            "figure_08_difference",
            "Figure 8 (the second): difference between the healthy and the faulty output. Above for the paper's noise; "
            "below for two faults of its part 4. Each motor has its own sensor noise.",
            healthy_minus_faulty,
        ),
        PaperFigure(
            "figure_09",
            "Figure 9: estimated states, from the noisy current alone. The filter is not told "
            "that its sensor gets worse.",
            estimated_states,
        ),
        PaperFigure(
            "error_covariance",
            "Error covariance, which the paper's text promises and no figure shows: the filter starts without knowing "
            f"the state (sd {UNKNOWN_START_STD[0]:g} A, {UNKNOWN_START_STD[1]:g} rad/s).",
            error_covariance,
        ),
        *_level_figures(),
    ]


MADE_BY = "motor-env reproduce"
NOT_PRINTED = "not printed"
_RECORD = "reproduce.json"


class Block(NamedTuple):
    """Part of the page: heading, paragraph, table (its first row is the header), or image and caption."""

    kind: str
    text: str = ""
    rows: tuple[tuple[str, ...], ...] = ()
    image: str = ""


def _choices() -> str:
    current, speed = PROCESS_NOISE_STD
    noise, fault = SENSOR.current_noise_a, NOISE_FAULT
    span = f"{TIMING.sampling_rate_hz / 1e3:g} kHz for {1e3 * TIMING.duration_s:g} ms"
    return (
        "The paper prints no Q, no R and no variance of its noise. Taken here: a sensor noise of "
        f"{1e3 * noise:g} mA, so R = {noise**2:.1e} A²; Q = diag({current**2:.0e} A², {speed**2:.0e} rad²/s²) "
        f"per sampling interval; {span}; an incipient noise fault that starts {1e3 * fault.onset_s:g} ms after the "
        f"step and raises the variance by {100 * float(fault.severity):g} % over {1e3 * fault.growth_s:g} ms; seed "
        f"{SEED}; {N_RUNS} runs for the error covariance. Q is small on purpose: process noise absorbs a fault."
    )


def page() -> list[Block]:
    """Build the page with newly computed numbers."""
    return [
        Block("heading", "The paper, reproduced"),
        Block(
            "paragraph",
            "Source: Simulation of Incipient Fault Detection, Confirmation and Diagnosis Using Kalman Filter. "
            f"Made by `{MADE_BY} --out out/paper`; every number of ours on this page was computed by that command.",
        ),
        Block("paragraph", _choices()),
        Block("heading 2", "Where the paper is wrong"),
        Block(
            "table", rows=(("the paper says", "what holds"), *((slip.says, slip.holds) for slip in slips()))
        ),
        Block("heading 2", "Its numbers beside ours"),
        Block(
            "paragraph",
            f"Settling time: the last moment at which the current is more than {100 * SETTLING_BAND:g} % of its peak "
            "away from its final value. A paper's number agrees when ours rounds to every digit printed.",
        ),
        Block("table", rows=_number_rows()),
        Block("heading 2", "Figures"),
        *(Block("image", figure.caption, image=figure.image) for figure in paper_figures()),
    ]


def _number_rows() -> tuple[tuple[str, ...], ...]:
    verdict = {None: "", True: "yes", False: "no"}
    rows = (
        (n.quantity, n.unit, n.paper or NOT_PRINTED, n.ours_text, verdict[n.agrees], n.parameters)
        for n in comparisons()
    )
    return (("quantity", "unit", "paper", "ours", "agrees", "computed from"), *rows)


def markdown(blocks: Sequence[Block]) -> str:
    """Write the page as Markdown."""
    parts = []
    for block in blocks:
        match block.kind:
            case "heading":
                parts.append(f"# {block.text}")
            case "heading 2":
                parts.append(f"## {block.text}")
            case "table":
                lines = [f"| {' | '.join(row)} |" for row in block.rows]
                lines.insert(1, "|---" * len(block.rows[0]) + "|")
                parts.append("\n".join(lines))
            case "image":
                title = block.text.partition(":")[0]
                parts.append(f"![{title}]({block.image})\n\n*{block.text}*")
            case _:
                parts.append(block.text)
    return "\n\n".join(parts) + "\n"


def record() -> dict[str, Any]:
    """Collect the figures' numbers for machines; `paper` is null where the paper prints no number."""
    return {
        "made_by": MADE_BY,
        "numbers": [
            {**number._asdict(), "ours_shown": number.ours_text, "agrees": number.agrees}
            for number in comparisons()
        ],
        "slips": [slip._asdict() for slip in slips()],
        "choices": {
            "measurement_variance_a2": SENSOR.current_noise_a**2,
            "process_variance": [std**2 for std in PROCESS_NOISE_STD],
            "sampling_rate_hz": TIMING.sampling_rate_hz,
            "noise_fault_severity": NOISE_FAULT.severity,
            "noise_fault_onset_s": NOISE_FAULT.onset_s,
            "noise_fault_growth_s": NOISE_FAULT.growth_s,
            "seed": SEED,
        },
        "figures": [{"image": figure.image, "caption": figure.caption} for figure in paper_figures()],
    }


def reproduce(out: Path, *, progress: Callable[[PaperFigure], None] = lambda _: None) -> dict[str, Any]:
    """Write the page, its figures and its record into a folder.

    Args:
        out: the folder; new, empty, or an earlier output.
        progress: called before each figure.

    Returns:
        Content of `reproduce.json`.

    Raises:
        InputError: the folder cannot be written, or holds other files.
    """
    require_own_output(out, _RECORD, f'"made_by": "{MADE_BY}"', command="reproduce")
    result = record()
    # The record comes first: a folder left by an interrupted run is still known as ours.
    write_text(out / _RECORD, json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    (out / "images").mkdir(exist_ok=True)
    with drawing():
        for figure in paper_figures():
            progress(figure)
            save(figure.draw(), out / figure.image)
    blocks = page()
    write_text(out / "paper.md", markdown(blocks))
    html = render("motor_env.apps", "paper.html.j2", title=blocks[0].text, blocks=blocks)
    write_text(out / "index.html", html)
    return result
