"""Charts to the pixel on tiny examples, and what the page makes of made results."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import opened
from made_results import RECIPE, answer, decisions, made_results

# Reaches in: the page is drawn from results made by hand, in the types that the other rooms give it.
from motor_classifiers.report import page
from motor_classifiers.report.page import Line, interval_chart, line_chart, readable, reliability_chart, short
from motor_classifiers.scoring.metrics import Reliability, Score
from motor_classifiers.scoring.score import Results
from motor_classifiers.scoring.task import class_task
from motor_env.common.pages import Axis

BARS = [("a", "torch", Score(0.80, 0.75, 0.85)), ("b", "own", Score(0.90, 0.88, 0.93))]


def shapes(chart: str, tag: str, style: str = "") -> list[Any]:
    """Numbers of each element of a tag and class, to a tenth of a pixel."""
    found = re.findall(rf"<{tag}((?: [a-z0-9-]+=\"[^\"]*\")*)>", chart)
    place = re.compile(r' (?:x|y|x1|y1|x2|y2|cx|cy|r)="([\d.-]+)"')
    mine = [attributes for attributes in found if not style or f'class="{style}"' in attributes]
    return [pytest.approx([float(v) for v in place.findall(attributes)], abs=0.11) for attributes in mine]


def test_intervals_stand_where_their_scores_say() -> None:
    chart = interval_chart(BARS, 0.95, "limit: 95.0 %")

    def x(share: float) -> float:
        return 170 + (760 - 54 - 170) * (share - 0.74) / (0.96 - 0.74)

    assert 'viewBox="0 0 760 120"' in chart
    assert shapes(chart, "line", "limit") == [[x(0.95), 28.0, x(0.95), 90.0]]
    assert shapes(chart, "line", "range") == [[x(0.75), 48.0, x(0.85), 48.0], [x(0.88), 76.0, x(0.93), 76.0]]
    assert shapes(chart, "circle") == [[x(0.8), 48.0, 5.5], [x(0.9), 76.0, 5.5]]
    assert shapes(chart, "text", "value") == [[x(0.85) + 8, 52.0], [x(0.93) + 8, 80.0]]
    assert ">80.0</text>" in chart
    assert re.findall(r">(\d+ %)<", chart) == ["75 %", "80 %", "85 %", "90 %", "95 %"]
    low = interval_chart(BARS, 0.76, "limit", width=440, left=166)
    assert re.findall(r">(\d+ %)<", low) == ["80 %", "90 %"]
    sides = [re.findall(r'class="limit-label" text-anchor="(\w+)"', each) for each in (chart, low)]
    assert sides == [["end"], ["middle"]]
    top = interval_chart([("a", "own", Score(0.999, 0.99, 1.0))], 0.995, "limit")
    assert shapes(top, "circle") == [[170 + 536 * (0.999 - 0.98) / 0.02, 48.0, 5.5]]  # the axis ends at 1


def test_reliability_has_bars_of_one_error_and_dots_by_their_cases() -> None:
    sure, right = np.array([0.6, np.nan, 0.9]), np.array([0.5, np.nan, 0.8])
    chart = reliability_chart(Reliability(sure, right, np.array([25.0, 0.0, 100.0])), 0.5)

    def at(x: float, y: float) -> list[float]:
        return [34 + 148 * (x - 0.5) / 0.5, 164 - 156 * (y - 0.5) / 0.5]

    assert shapes(chart, "circle") == [[*at(0.6, 0.5), 3.0], [*at(0.9, 0.8), 4.2]]
    expected = [[*at(0.6, 0.6), *at(0.6, 0.5)], [*at(0.9, 0.84), *at(0.9, 0.76)]]  # 0.4 lies below the axis
    assert shapes(chart, "line", "range") == expected
    assert "25 starts" in chart


def test_lines_end_at_their_labels() -> None:
    lines = [Line(name, "s0", [0.0, 5.0, 10.0], [0.5, 0.5, 1.0]) for name in ("one", "two")]
    axes = Axis("x", 0.0, 10.0, [0.0, 10.0]), Axis("accuracy", 0.5, 1.0, [0.5, 1.0])
    chart = line_chart(lines, *axes)
    assert 'points="58.0,360.0 223.0,360.0 388.0,24.0"' in chart
    assert shapes(chart, "circle")[:3] == [[58.0, 360.0, 3.0], [223.0, 360.0, 3.0], [388.0, 24.0, 3.0]]
    assert shapes(chart, "line", "lead") == [[388.0, 24.0, 400.0, 28.0], [388.0, 24.0, 400.0, 41.0]]
    labels = re.findall(r'x="([\d.]+)" y="([\d.]+)">(one|two)<', chart)
    assert labels == [("403.0", "32.0", "one"), ("403.0", "45.0", "two")]
    assert page.share_axis([0.6, 0.995]).high == 1.0
    assert page._spread_out([54.0, 50.0, 52.0, 1.0], 10.0, 4.0, 60.0) == [60.0, 40.0, 50.0, 4.0]
    plain = line_chart(lines, axes[0], axes[1]._replace(title=""), named=False, marked=False)
    assert 'points="52.0,360.0 275.0,360.0 498.0,12.0"' in plain
    assert "<circle" not in plain


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (readable, "winding_contact_25", "winding contact 25 %"),
        (readable, "bearing_2.5", "bearing 2.5 %"),
        (readable, "winding_short", "winding short"),
        (short, "healthy", "ok"),
        (short, "winding_contact_25", "WC 25"),
        (short, "noise", "noi"),
        (page._share, Score(0.12345, 0, 0), "12.3"),
        (page._share, Score(np.nan, 0, 0), "–"),
        (page._points, -1.234, "−1.23"),
        (page._points, -0.004, "0.00"),
        (page._quantity, 19.94, "19.9"),
        (page._quantity, 20.0, "20"),
        (page._quantity, None, "–"),
    ],
)
def test_names_and_numbers_for_people(write: Any, value: Any, text: str) -> None:
    assert write(value) == text


@pytest.fixture(scope="module")
def made() -> tuple[Any, Results]:
    """Three methods, one of which only decides; the limit errs on the first ten starts."""
    return made_results(
        answer(decisions(slice(0, 10)), 0.8125), threshold=answer(decisions(slice(5, 21))),
        residual_qda=answer(decisions(slice(2, 14)), 1.0), network=answer(decisions(slice(0, 13)), 0.5625),
    )  # fmt: skip


def noted(monkeypatch: pytest.MonkeyPatch, name: str) -> list[Any]:
    """What a function of the page is called with from now on."""
    calls: list[Any] = []

    def note(*arguments: Any, **options: Any) -> str:
        calls.append((*arguments, options))
        return name

    monkeypatch.setattr(page, name, note)
    return calls


def test_the_page_is_given_what_was_scored(
    made: tuple[Any, Results], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("interval_chart", "reliability_chart", "render")
    intervals, curves, rendered = (noted(monkeypatch, name) for name in names)
    plan, plain = made
    peer = replace(plain.methods[2], name="peer", answer=plain.methods[2].answer._replace(origin="elsewhere"))
    for methods in (plain.methods, (*plain.methods, peer)):
        assert page.render_report(plan, [replace(plain, methods=methods)], "a machine") == "render"
    words, with_peer = (call[-1] for call in rendered)
    assert (with_peer["best_peer"].name, with_peer["origins"]) == ("peer", ["elsewhere"])
    ranked = ["residual-qda", "network", "threshold"]
    assert [one.name for one in words["methods"]] == ranked
    assert (words["best"].name, words["best_peer"], words["sweep"]) == ("residual-qda", None, None)
    assert (words["limit_name"], words["n_comparisons"], words["significance"]) == ("Bayes limit", 3, 0.01)
    assert words["limit_expected"] == pytest.approx(0.8125)
    (_, _), (name, between) = words["against"]
    assert (name, between.only_first, between.only_second) == ("threshold", 3, 7)  # rows 2 .. 4, and 14 .. 20
    bars, limit, label, _ = intervals[0]
    assert [name for name, *_ in bars] == ranked
    assert (limit, label) == (pytest.approx(50 / 60), "Bayes limit on these motors: 83.3 %")
    assert [call[-1]["title"] for call in intervals[1:4]] == ["Winding", "Bearing", "Severity"]
    counts = plain.limit.scores.confusion
    shares = 100.0 * counts / counts.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(words["confusions"][0]["shares"], shares)
    # Confidences are 0.8125, 0.5625 and 0.75; what only decides has no curve.
    assert [one["name"] for one in words["reliability"]] == ["limit", "network", "threshold"]
    assert [call[1] for call in curves[:3]] == pytest.approx([0.5] * 3)


def test_a_sweep_is_drawn_by_size_and_by_noise(
    made: tuple[Any, Results], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = noted(monkeypatch, "line_chart")
    plan, result = made

    def at(noise_a: float, n_train: int) -> Results:
        recipe = replace(RECIPE, sensor=replace(RECIPE.sensor, current_noise_a=noise_a))
        return replace(result, task=class_task(recipe, n_train, 60))

    told = page.sweep_section(plan, [at(0.02, 200), at(0.1, 200), at(0.02, 100), at(0.005, 200)])
    assert told["learning"] == told["noise"] == [{"title": "bench, 1 kHz", "chart": "line_chart"}]
    by_size, by_noise = drawn
    assert by_size[1].ticks == [100.0, 200.0]
    assert by_noise[1].ticks == pytest.approx([5.0, 20.0, 100.0])
    lines = {line.label: (line.style, line.y) for line in by_size[0]}
    assert list(lines) == ["threshold", "residual-qda", "network", "Bayes limit"]
    assert lines["threshold"] == ("s0", pytest.approx([44 / 60] * 2))
    assert lines["Bayes limit"] == ("limit", pytest.approx([50 / 60] * 2))
    assert (by_size[2].low, by_size[2].high) == pytest.approx((44 / 60 - 0.01, 50 / 60 + 0.01))
    alone = page.sweep_section(plan, [at(0.02, 200)])
    assert (alone["learning"], alone["noise"], len(alone["settings"])) == ([], [], 1)


def test_the_page_in_a_browser(made: tuple[Any, Results], tmp_path: Path) -> None:
    plan, result = made
    page.write_results(plan, [result], tmp_path)
    names = "[...document.querySelectorAll('table.sortable tbody')[0].rows].map((row) => row.cells[0].textContent)"
    with opened((tmp_path / "report.html").as_uri()) as browser:
        assert browser.value("document.querySelectorAll('svg').length") >= 3
        before = sorted(browser.value(names), key=str.lower)
        for expected in (before, before[::-1]):
            browser.click("table.sortable th button")
            assert browser.value(names) == expected
