"""The picture of a fleet: every motor a dot in each quantity's column, the odd ones with their names."""

from __future__ import annotations

import math
from collections.abc import Sequence

from motor_env.diagnosis.verdict import Verdict
from motor_env.fleet.sister import Sister
from motor_env.pages.svg import Axis, Chart

_FARTHEST = 6.0  # standard deviations that the picture shows
_USUAL = 2.0
_JITTER = (0.0, 0.12, -0.12, 0.06, -0.06, 0.18, -0.18)  # of a column: dots that would hide each other
_ROW = 13.0  # pixels between two names


def picture(names: Sequence[str], sisters: Sequence[Sister]) -> str:
    """The markup: deviations from the healthy core, in standard deviations of another healthy motor.

    Args:
        names: of the quantities.
        sisters: the motors, the oddest first.
    """
    columns = Axis("", -0.5, len(names) - 0.5)
    rows = Axis("", -_FARTHEST, _FARTHEST, (-6, -4, -2, 0, 2, 4, 6), number="{:g}".format)
    chart = Chart(
        columns,
        rows,
        size=(480.0, 380.0),  # so narrow that its names can be read on a phone
        margins=(36.0, 72.0, 14.0, 34.0),
        label=f"{len(sisters)} motors, each quantity in standard deviations from the healthy core",
    )
    top, height = chart.y(_USUAL), chart.y(-_USUAL) - chart.y(_USUAL)
    chart.shape("rect", "usual", x=chart.left, y=top, width=chart.right - chart.left, height=height)
    chart.y_numbers()
    named: dict[int, list[tuple[float, float, str]]] = {}
    for place, sister in enumerate(reversed(sisters)):  # the oddest last, on top
        # What a failed sensor has read tells nothing of the motor.
        is_odd = sister.verdict.is_fault and sister.verdict is not Verdict.SENSOR
        for column, name in enumerate(names):
            if name not in sister.off:
                continue
            off = sister.off[name]
            at = (chart.x(column + _JITTER[place % len(_JITTER)]), chart.y(off))
            title = f"{sister.place.name}: {name} {sister.ratios[name] - 1.0:+.0%}"
            chart.dot("odd" if is_odd else "sister", at, 5.0 if is_odd else 3.5, title)
            if is_odd and abs(off) > _USUAL:
                named.setdefault(column, []).append((at[1] + 4.0, at[0] + 9.0, sister.place.name))
    for labels in named.values():
        below = -math.inf
        for line, x, label in sorted(labels):
            below = max(line, below + _ROW)
            chart.text((x, below), label, "name")
    for column, name in enumerate(names):
        chart.text((chart.x(column), chart.bottom + 22.0), name, "tick", "middle")
    return chart.svg()
