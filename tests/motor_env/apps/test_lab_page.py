"""The lab's page in a real headless browser."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import opened
from running_lab import running_lab, write_start

OVERLAPS = """[...document.querySelectorAll('#results svg')].flatMap((svg) => {
  const boxes = [...svg.querySelectorAll("text[text-anchor='middle']")].map((text) => text.getBoundingClientRect());
  return boxes.slice(1).filter((box, k) => box.left < boxes[k].right);
}).length"""  # numbers along the time axes that run into each other


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_lab() as address:
        yield address


def test_page_in_a_browser(server: str, tmp_path: Path) -> None:
    with opened(server, "document.body && document.body.dataset.shown !== undefined") as browser:
        curve = "document.querySelector('#current path.measured').getAttribute('d')"
        assert browser.value("document.querySelectorAll('#results svg path').length") == 5
        browser.wait("document.body.dataset.compared !== undefined")
        assert browser.value("document.getElementById('verdict').textContent").startswith("bearing")
        assert browser.value("document.getElementById('alarm').textContent").startswith("alarm after")
        assert browser.value("document.querySelectorAll('#roc path.roc, #roc circle').length") == 2

        browser.call(
            "Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True
        )
        browser.wait("document.getElementById('current').clientWidth < 390")
        browser.wait("document.body.dataset.judged === document.body.dataset.shown")
        assert browser.value(OVERLAPS) == 0
        browser.call("Emulation.clearDeviceMetricsOverride")
        browser.value(
            "document.getElementById('kind').value = 'healthy';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('verdict').textContent.startsWith('healthy')")
        assert browser.value("document.getElementById('alarm').textContent") == "no alarm"

        browser.value(
            "document.getElementById('kind').value = 'winding_contact';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('alarm').textContent.startsWith('alarm after')")
        before, severity = (
            browser.value(curve),
            browser.value("document.getElementById('severity_percent').value"),
        )
        shown = browser.value("document.body.dataset.shown")
        browser.click("#severity_percent", 0.9)
        browser.wait(f"Number(document.body.dataset.shown) > {shown}")
        assert float(browser.value("document.getElementById('severity_percent').value")) > float(severity)
        assert browser.value(curve) != before
        browser.wait("document.body.dataset.judged === document.body.dataset.shown")
        assert browser.value("document.getElementById('verdict').textContent").startswith("winding")

        browser.value(
            "document.getElementById('kind').add(new Option('no such', 'no_such'));"
            "document.getElementById('kind').value = 'no_such';"
            "document.getElementById('kind').dispatchEvent(new Event('change'))"
        )
        browser.wait("document.getElementById('alarm').textContent.includes('kind must be one of')")
        assert browser.value("document.querySelectorAll('#current path, #roc path').length") == 0
        assert not browser.value("document.getElementById('verdict').textContent")

        browser.drop("#drop", write_start(tmp_path / "capture.csv", "bearing"))
        browser.wait("document.body.dataset.taken === 'capture.csv'")
        assert browser.value("document.getElementById('recording-verdict').textContent").startswith("bearing")
        assert browser.value("document.querySelectorAll('#recording svg path').length") == 3

        broken = tmp_path / "<b>broken<b>.csv"
        broken.write_bytes(b"\xff\xfe\x00nonsense")
        browser.drop("#drop", broken)
        browser.wait(f"document.body.dataset.taken === {json.dumps(broken.name)}")
        assert broken.name in browser.value("document.getElementById('recording-verdict').textContent")
        assert browser.value("document.querySelectorAll('#recording b').length") == 0
