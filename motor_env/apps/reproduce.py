"""Write the paper's figures and numbers beside ours as a page and as JSON: the command `motor-env reproduce`.

A folder that it writes holds `index.html` and `paper.md` (the same page), `images/` and `reproduce.json`. Both pages
are made from one list of blocks.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from motor_env.apps.paper import SETTLING_BAND, comparisons, slips
from motor_env.apps.paper_figures import (
    N_RUNS,
    NOISE_FAULT,
    PROCESS_NOISE_STD,
    SEED,
    SENSOR,
    TIMING,
    PaperFigure,
    paper_figures,
)
from motor_env.common.files import require_ours, write_text
from motor_env.common.pages.html import render
from motor_env.common.plotting import drawing, save

MADE_BY = "motor-env reproduce"
NOT_PRINTED = "not printed"
_RECORD = "reproduce.json"


class Block(NamedTuple):
    """A part of the page: heading, paragraph, table (its first row is the header), or image and caption."""

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
    """Build the whole page, its numbers computed now."""
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
        out: the folder; new, empty, or one that this command wrote before.
        progress: called before each figure.

    Returns:
        What stands in `reproduce.json`.

    Raises:
        InputError: a folder that cannot be written, or files of others in it.
    """
    require_ours(out, _RECORD, f'"made_by": "{MADE_BY}"', command="reproduce")
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
