"""Delays for docs/results/detection.md, and the picture of docs/rules.md: `python benchmarks/rules.py`, ten minutes.

Thresholds are solved for ARL0 10,000; delays count from an onset at the start of the rule, and in mid-run from one
after 1,000 healthy samples without an alarm. Each row is printed as soon as it is known.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from cyclopts import run
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from tables import keep_table

from motor_env import Cusum, Glr, ModelBank, MOfN, Rule, ShiryaevRoberts, Sprt
from motor_env.common.plotting import drawing, save
from motor_env.detection.rules import Threshold, WindowedNis, in_a_row, nis_rule, run_lengths

ARL0 = 1e4
HEALTHY = 1_000
SHIFTS = (1.0, 0.13)
DRAWN, DRAWN_AT = 0.5, (1e2, 3e2, 1e3, 3e3, 1e4)
KEPT_CURVES = Path(__file__).parent / "results" / "rules_delay.json"
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "rules_delay.svg"
LEAST = "CUSUM, true shift (least worst case)"  # Moustakides 1986
BANK = "bank 1/8, 1/4, 1/2, 1"
BLIND: dict[str, Rule] = {
    "GLR": Glr(),
    BANK: ModelBank((0.125, 0.25, 0.5, 1.0)),
    "NIS over 20": WindowedNis(20),
    "3 of 5": MOfN(3, 5),
    "NIS": nis_rule(),
}
"""Rules that do not know the fault's size."""

Curves = dict[str, list[float]]
"""Delay at each ARL0 of `DRAWN_AT`, by rule."""


@cache
def threshold_of(rule: Rule, calibration: int) -> Threshold:
    """For the wanted average run length; solved once."""
    return rule.threshold_for(arl0=ARL0, runs=calibration)


def informed(shift: float) -> dict[str, Rule]:
    """Rules that are told the fault's size, or about its size."""
    return {
        "CUSUM, true shift": Cusum(shift),
        "CUSUM, half the shift": Cusum(0.5 * shift),
        "CUSUM, twice the shift": Cusum(2.0 * shift),
        "Shiryaev-Roberts": ShiryaevRoberts(shift),
        "SPRT, repeated": Sprt(shift, restart=True),
    }


def simulated(rule: Rule, threshold: float, runs: int, mean: ArrayLike) -> tuple[float, float]:
    """Mean delay and its standard error."""
    lengths = run_lengths(rule, threshold, runs, seed=3, mean=mean)
    return float(lengths.mean()), float(lengths.std() / np.sqrt(runs))


def delays(runs: int, calibration: int) -> Iterable[Iterable[str]]:
    """Delays of every rule, over the exact one of the matched CUSUM, and after a thousand healthy samples."""
    for shift in SHIFTS:
        least = Cusum(shift).average_run_length(threshold_of(Cusum(shift), calibration).value, shift)
        for name, rule in {**informed(shift), **BLIND}.items():
            value, error, _ = threshold_of(rule, calibration)
            if error:
                mean, of_mean = simulated(rule, value, runs, shift)
                delay = f"{mean:.1f} ± {of_mean:.1f}"
            else:
                mean = rule.average_run_length(value, shift)
                delay = f"{mean:.1f}"
            later = run_lengths(rule, value, runs, seed=4, mean=[0.0] * HEALTHY + [shift])[:, 0]
            after = later[later > HEALTHY] - HEALTHY
            mid_run = f"{after.mean():.1f} ± {after.std() / np.sqrt(len(after)):.1f}"
            yield f"{shift:g}", name, delay, f"{mean / least:.2f}", mid_run


def curves() -> Curves:
    """Delay at each ARL0 of every rule, from an onset at its start, for a shift of half a sigma."""
    shift = DRAWN
    rules: dict[str, Rule] = {
        LEAST: Cusum(shift),
        "Shiryaev-Roberts, true shift": ShiryaevRoberts(shift),
        "SPRT repeated, true shift": Sprt(shift, restart=True),
        "CUSUM, twice the shift": Cusum(2.0 * shift),
        BANK: BLIND[BANK],
        "GLR, size unknown": BLIND["GLR"],
        "NIS over 20": BLIND["NIS over 20"],
        "3 of 5": BLIND["3 of 5"],
        "3 in a row": in_a_row(3),
        "NIS": BLIND["NIS"],
    }
    return {
        name: [
            round(rule.average_run_length(rule.threshold_for(arl0=wanted).value, shift), 2)
            for wanted in DRAWN_AT
        ]
        for name, rule in rules.items()
    }


def draw(delays_of: Curves, path: Path) -> None:
    """Draw delay against ARL0."""
    with drawing():
        figure = Figure(figsize=(9.0, 4.5), layout="constrained")
        axis = figure.subplots()
        for name, delay in delays_of.items():
            width = 3.0 if name == LEAST else 1.5
            axis.plot(DRAWN_AT, delay, marker="o", markersize=3.0, linewidth=width, label=name)
        asymptote = 2.0 * np.log(DRAWN_AT) / DRAWN**2  # Lorden 1971
        axis.plot(DRAWN_AT, asymptote, color="0.5", linestyle=":", label="asymptote ln(ARL0) / KL, no bound")
        axis.set(xscale="log", yscale="log", xlabel="samples between false alarms, ARL0")
        axis.set_ylabel(f"delay in samples, shift of {DRAWN:g} sigma")
        figure.legend(loc="outside right upper", frameon=False, fontsize="small")
        save(figure, path)


def main(
    *,
    runs: int = 2_000,
    calibration: int = 10_000,
    only: Literal["delays", "picture"] | None = None,
) -> None:
    """Delays and picture.

    Args:
        runs: simulated delays of a row.
        calibration: healthy runs behind a simulated threshold.
        only: one of the two.
    """
    if only in (None, "delays"):
        header = ("shift", "rule", "delay", "of least", "delay in mid-run")
        keep_table("detection", "delays", header, delays(runs, calibration))
    if only in (None, "picture"):
        KEPT_CURVES.write_text(json.dumps(curves(), indent=1) + "\n", encoding="utf-8")
        draw(json.loads(KEPT_CURVES.read_bytes()), PICTURE)


if __name__ == "__main__":
    run(main)
