"""Draws the screens that the documentation shows: `make pictures`. tests/test_pictures.py says when one is stale."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

from motor_env import diagnose
from motor_env.diagnosis.fleet.judging import FleetUnit, picture
from motor_env.diagnosis.verdict.judgement import Verdict
from motor_env.diagnosis.verdict.report_page import _bars, _currents, reference_current

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
EXAMPLES = DOCS.parent / "examples"
STYLE = """svg { font: 14px system-ui, "Segoe UI", Arial, sans-serif; } text { fill: #1c2733; } .tick { fill: #5d6b7a; }
.grid, .zero { stroke: #d5d3cc; } .interval { stroke-width: 5; stroke-linecap: round; stroke-opacity: .45; }
.still .interval { stroke: #0b6fa4; } .still .dot { fill: #0b6fa4; } .moved .interval { stroke: #b3261e; }
.moved .dot { fill: #b3261e; } .moved .value { font-weight: 700; } polyline { fill: none; stroke-width: 1.6; }
.measured { stroke: #0b6fa4; } .healthy { stroke: #12805c; stroke-width: 2.2; stroke-dasharray: 7 4; }"""
"""Colours of the page, by day."""
FLEET = """svg { font: 13px system-ui, "Segoe UI", Arial, sans-serif; } text { fill: #1c2733; } .tick { fill: #5d6b7a; }
.grid { stroke: #d5d3cc; } .usual { fill: #12805c; fill-opacity: .1; } .sister { fill: #0b6fa4; fill-opacity: .45; }
.odd { fill: #b3261e; } .name { fill: #b3261e; font-size: 12px; font-weight: 600; }"""


def verdict() -> str:
    """Two charts of the example's page, one below the other, as one picture."""
    found = diagnose(EXAMPLES / "startup_capture.csv", EXAMPLES / "motor.toml")
    decisive = found.decisive
    current, _ = _currents(decisive.identified, reference_current(decisive), is_fault=True)
    parts, top = [], 30.0
    for title, chart in (
        ("How far each quantity lies from the healthy motor", _bars(found.changes)),
        ("Current after the start; dashed: a healthy motor", current),
    ):
        width, height = map(float, re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', chart)[0])
        parts.append(f'<text x="0" y="{top - 10:g}" font-weight="600">{title}</text>')
        parts.append(
            chart.replace("<svg ", f'<svg x="0" y="{top:g}" width="{width:g}" height="{height:g}" ', 1)
        )
        top += height + 40.0
    size = f'viewBox="-12 0 {width + 24:g} {top - 20:g}"'
    ground = '<rect x="-12" width="100%" height="100%" fill="white"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{STYLE}</style>{ground}'
    return "\n".join([head, *parts, "</svg>"]) + "\n"


def fleet() -> str:
    """The picture of the fleet of docs/fleet.md, from what `motor-env diagnose --fleet ... --json` said of it."""
    units = [
        SimpleNamespace(
            unit_id=SimpleNamespace(name=one["motor"]),
            verdict=Verdict(one["verdict"]),
            ratios=one["ratios"],
            deviations=one["standard_deviations"],
        )
        for one in json.loads((IMAGES / "fleet.json").read_bytes())
    ]
    chart = picture(("R", "K", "J", "B"), cast("list[FleetUnit]", units))
    ground = f'<style>{FLEET}</style><rect width="100%" height="100%" fill="white"/>'
    return (
        chart.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).replace(">", f">{ground}", 1)
        + "\n"
    )


if __name__ == "__main__":
    (IMAGES / "fleet.svg").write_text(fleet(), encoding="utf-8")
    (IMAGES / "verdict.svg").write_text(verdict(), encoding="utf-8")
    for script in ("docs/images/make_hero.py", "docs/make_pages.py", "benchmarks/film.py"):
        subprocess.run([sys.executable, script], cwd=DOCS.parent, check=True)  # noqa: S603  # our own
