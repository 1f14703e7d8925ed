"""Line charts: where values stand, and that no label covers another."""

import re
from itertools import pairwise

from motor_classifiers.report.charts import Line, line_chart, share_axis

# Reaches in: the axes that a chart hands to the drawing of lines.
from motor_env.pages.svg import Axis


def test_points_are_drawn_where_the_axes_say() -> None:
    line = Line("one", "s1 dashed", [0.0, 10.0], [0.5, 1.0])
    chart = line_chart(
        [line], Axis("x", 0.0, 10.0, [0.0, 10.0]), Axis("y", 0.5, 1.0, [0.5, 1.0]), named=False
    )
    (left, low), (right, high) = (
        (float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', chart)
    )
    assert left < right
    assert low > high  # up on the page is small y
    assert 'class="series s1 dashed"' in chart
    assert "one, 10: 1" in chart


def test_labels_of_equal_ends_do_not_cover_each_other() -> None:
    lines = [Line(f"m{n}", "s1", [1.0, 2.0], [0.8, 0.9]) for n in range(5)]
    chart = line_chart(lines, Axis("x", 1.0, 2.0, [1.0, 2.0], is_log=True), share_axis([0.8, 0.9]))
    heights = sorted(float(y) for y in re.findall(r'y="([\d.]+)">m\d</text>', chart))
    assert len(heights) == 5
    assert all(below - above >= 12.9 for above, below in pairwise(heights))
