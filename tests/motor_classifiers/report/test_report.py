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
from motor_classifiers.report.page import interval_chart
from motor_classifiers.scoring.metrics import Score
from motor_classifiers.scoring.score import Results
from motor_classifiers.scoring.task import class_task

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
    assert re.findall(r">(\d+ %)<", chart) == ["75 %", "80 %", "85 %", "90 %", "95 %"]
    top = interval_chart([("a", "own", Score(0.999, 0.99, 1.0))], 0.995, "limit")
    assert shapes(top, "circle") == [[170 + 536 * (0.999 - 0.98) / 0.02, 48.0, 5.5]]  # the axis ends at 1


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
    assert page.render_report(plan, [plain], "a machine") == "render"
    words = rendered[0][-1]
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
    assert by_noise[1].ticks == pytest.approx([5.0, 20.0, 100.0])
    lines = {line.label: (line.style, line.y) for line in by_size[0]}
    assert list(lines) == ["threshold", "residual-qda", "network", "Bayes limit"]
    assert lines["threshold"] == ("s0", pytest.approx([44 / 60] * 2))
    assert lines["Bayes limit"] == ("limit", pytest.approx([50 / 60] * 2))
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
