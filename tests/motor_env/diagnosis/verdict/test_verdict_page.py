"""What a technician has to find on the page without opening a fold: the verdict, its size, the next action."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from browser import opened
from judged_by_hand import SHEET, start

from motor_env import Diagnosis, Fault, FaultKind, Verdict, diagnose
from motor_env.diagnosis.verdict.report_page import RUN_ON_TEXTS, page, reference_current

Answers = tuple[str, str, str]


@cache
def judged(case: str) -> Diagnosis:
    """The five captures of the technician's test."""
    healthy = start()
    recordings = {
        "healthy": healthy,
        "bearing": start(Fault(FaultKind.BEARING, 0.5)),
        "short": start(Fault(FaultKind.WINDING_SHORT, 0.12)),
        "clipped": replace(healthy, current_a=np.minimum(healthy.current_a, 2.5)),
        "probe": replace(healthy, current_a=10.0 * healthy.current_a),
    }
    return diagnose(recordings[case], SHEET)


# Written before the pages were: what is wrong, how much of it, what to do next.
ANSWERS: dict[str, Answers] = {
    "healthy": ("Healthy", "more friction (2[0-9]|30)%", "Nothing to do"),
    "bearing": (
        "More friction: bearing, lubricant or load",
        "Friction up by (4|5)[0-9]%",
        "turn the shaft by hand",
    ),
    "short": ("Winding: shorted turns", "1[0-9]% of the turns shorted", "Measure the resistance"),
    "clipped": ("This recording cannot be judged", "clipped", "Record again"),
    "probe": ("Something changed", "R is down by 90%", "the probe.s scale"),
}


@pytest.mark.parametrize("case", list(ANSWERS))
def test_a_technician_finds_verdict_size_and_next_action(case: str) -> None:
    html = page(judged(case))
    assert html.count("<html") == 1
    assert "http" not in html.replace("http-equiv", "")  # nothing is loaded from elsewhere
    above_the_fold = re.sub(
        r"<details.*?</details>|<style.*?</style>|<svg.*?</svg>", " ", html, flags=re.DOTALL
    )
    text = " ".join(re.sub(r"<[^>]+>", " ", above_the_fold).replace("&#39;", "'").split())
    for answer in ANSWERS[case]:
        assert re.search(answer, text), (answer, text)
    verdict, _, action = (re.search(answer, text) for answer in ANSWERS[case])
    assert verdict is not None
    assert action is not None
    assert verdict.start() < action.start() < 900  # on the first screen


def test_the_page_says_whether_the_motor_may_run_on() -> None:
    assert set(RUN_ON_TEXTS) >= set(Verdict)
    for case, words in {
        "healthy": "It may run on.",
        "short": "It should not run on",
        "probe": "Not known: stop it",
    }.items():
        assert f"<b>May it run on?</b> {words}" in page(judged(case))


def test_two_currents_of_a_fault_lie_apart() -> None:
    """Half more friction moves 13 of 5,000 mA: the whole start would show one curve."""
    chart = re.search(
        r'<svg[^>]*aria-label="The end of the start.*?</svg>', page(judged("bearing")), re.DOTALL
    )
    assert chart is not None
    curves = re.findall(r'<polyline class="(\w+)" points="([^"]*)"', chart[0])
    heights = {style: np.array([float(p.split(",")[1]) for p in points.split()]) for style, points in curves}
    assert np.median(heights["healthy"] - heights["measured"]) > 40.0  # pixels of 230
    for case in ("healthy", "short"):
        assert "The end of the start" not in page(judged(case))


def test_numbers_of_experts_lie_behind_the_fold() -> None:
    html = page(judged("healthy"))
    shown, fold = html.split("<details")
    assert "NIS" not in shown
    assert "(NIS)" in fold
    assert "warning" not in shown.split("<body>")[1]


def test_the_healthy_motors_current_is_what_was_measured_when_nothing_is_wrong() -> None:
    healthy, bearing = judged("healthy").decisive, judged("bearing").decisive
    fit, expected = healthy.identified, reference_current(healthy)
    assert fit is not None
    assert expected is not None
    np.testing.assert_allclose(expected, fit.start.current_a, atol=0.2)
    assert bearing.identified is not None
    beyond = bearing.identified.start.current_a - np.asarray(reference_current(bearing))
    assert 0.005 < beyond[-500:].mean() < 0.03  # half more friction than 26 mA


def test_a_page_shows_hostile_names_as_text() -> None:
    recording = replace(start(), path=Path("<script>alert(1)</script>.csv"), columns=("<b>read</b>",))
    html = page(diagnose(recording))
    assert "<script>" not in html
    assert "<b>read" not in html
    assert "Nothing to compare with" in html


def test_the_page_in_a_browser(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(page(judged("bearing")), encoding="utf-8")
    with opened((tmp_path / "page.html").as_uri()) as browser:
        assert browser.value("document.querySelector('h1').innerText").startswith("More friction")
        shown = "document.querySelector('details pre').checkVisibility()"
        assert not browser.value(shown)
        browser.click("details summary")
        browser.wait(shown)
        assert browser.value("document.documentElement.scrollWidth <= window.innerWidth")
