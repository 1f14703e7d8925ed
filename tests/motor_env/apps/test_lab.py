"""The lab: what it computes, and what its server refuses."""

from __future__ import annotations

import http.client
import json
import re
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import opened
from running_lab import running_lab, write_start

from motor_env import (
    Cusum,
    Fault,
    FaultKind,
    InputError,
    KalmanFilter,
    MOfN,
    Scenario,
    SensorParameters,
    Timing,
    in_a_row,
    run_filter,
    simulate,
    simulate_states,
)
from motor_env.apps import lab
from motor_env.apps.lab import LARGEST_UPLOAD_BYTES
from motor_env.apps.lab_server import make_server  # its reading is tested without a connection
from motor_env.cli import main

# Reaches in: settings come from a page through the reader of documents, which no public name shows.
from motor_env.motor.faults import BUILT_IN_KINDS, SENSOR_KINDS
from motor_env.motor.parameters import CATALOGUE
from motor_env.motor.toml_files import from_dict

MOTOR = Path("examples/motor.toml")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_lab() as address:
        yield address


def host_of(server: str) -> str:
    return server.removeprefix("http://").rstrip("/")


def request(
    server: str, method: str, path: str, body: bytes = b"", headers: Sequence[tuple[str, str]] = ()
) -> tuple[int, dict[str, Any]]:
    """Status and answer; a page is its text, with its policy."""
    connection = http.client.HTTPConnection(host_of(server), timeout=60)
    connection.putrequest(method, path)
    if all(name != "Content-Length" for name, _ in headers):
        headers = [("Content-Length", str(len(body))), *headers]
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders(body)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    policy = response.headers["Content-Security-Policy"]
    is_json = "json" in response.getheader("Content-Type", "")
    return response.status, json.loads(content) if is_json else {"text": content.decode(), "policy": policy}


def diagnosed(server: str, recording: bytes, motor: str, name: str = "a.csv") -> tuple[int, dict[str, Any]]:
    return request(server, "POST", f"/api/diagnose?name={name}&motor={motor}", recording)


def test_own_motor_and_healthy_starts_are_references(server: str, tmp_path: Path) -> None:
    recording = write_start(tmp_path / "a.csv", "healthy").read_bytes()
    assert diagnosed(server, recording, "own+motor")[1]["error"] == "no own motor handed in yet"
    own = MOTOR.read_bytes().replace(b"2.18", b"4.36")
    for body, status in ((b"[motor]\nresistance_ohm = -1\n", 400), (own, 200), (b"nonsense", 400)):
        found, told = request(server, "POST", "/api/keep?kind=motor&name=m.toml", body)
        assert found == status
        assert told["reference"] == "own motor" if status == 200 else told["error"].startswith("m.toml")
    status, told = diagnosed(server, recording, "own+motor")  # the bad one has not taken its place
    assert (status, told["verdict"]) == (200, "other")  # half the resistance of that motor file
    for seed in range(3):
        start = write_start(tmp_path / "h.csv", "healthy", seed).read_bytes()
        assert request(server, "POST", "/api/keep?kind=healthy&name=h.csv", start)[0] == 200
    status, told = diagnosed(server, recording, "healthy+starts")
    assert (status, told["verdict"]) == (200, "healthy")
    assert len(told["curves"]["healthy_a"]) == len(told["curves"]["time_ms"])


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        ([], "must be an object"),
        ({"kind": "speed_dead"}, "kind must be one of"),  # a sensor that is not there
        ({"severity_percent": float("nan")}, "severity_percent must lie in 0 .. 60, got nan"),
        ({"noise_ma": 10**400}, "noise_ma must"),
        ({"seed": 1.9}, "seed must be a valid integer, got 1.9"),
        ({"path": "x"}, "unknown key 'path' in the settings"),
    ],
)
def test_settings_are_checked(document: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        from_dict(lab.Settings, document, "the settings")


@pytest.mark.parametrize("name", lab.options()["ranges"])
def test_sliders_end_where_they_say(name: str) -> None:
    offered = lab.options()
    low, high = offered["ranges"][name]
    for value in (low, high):
        lab.Settings(**{name: value})
    for value in (np.nextafter(low, -1e9), np.nextafter(high, 1e9)):
        with pytest.raises(ValueError, match=re.escape(f"{name} must lie in {low:g} .. {high:g}")):
            lab.Settings(**{name: float(value)})  # type: ignore[arg-type]
    assert low <= offered["defaults"][name] <= high


def test_every_fault_that_is_offered_has_words_on_the_page_and_can_be_simulated() -> None:
    script = (resources.files("motor_env.apps") / "lab_assets" / "lab.js").read_text(encoding="utf-8")
    own = [str(kind) for kind in (*BUILT_IN_KINDS, *SENSOR_KINDS)]  # other tests register kinds
    offered = [kind for kind in lab.options()["kinds"] if kind in own]
    assert {"bearing", "current_dead"} <= set(offered)
    for kind in offered:
        lab.simulated(lab.Settings(kind=kind, severity_percent=60.0))
    assert all(f'{kind}: "' in script for kind in lab.fault_names() if kind in own)


def test_curves_are_those_of_the_start() -> None:
    """Every curve from the simulation, the filter and the rule themselves."""
    settings = lab.Settings(
        kind="bearing", severity_percent=30.0, noise_ma=30.0, resistance_percent=4.0, friction_percent=-3.0,
        false_alarm_percent=2.0, rule="nis", seed=5,
    )  # fmt: skip
    paper = CATALOGUE["paper"]
    own = paper.scaled(resistance_ohm=1.04, viscous_friction_n_m_s_per_rad=0.97)
    timing = Timing(sampling_rate_hz=10_000.0, duration_s=0.3, quiet_s=0.1)
    sensor = SensorParameters(current_noise_a=0.03)
    start = simulate(Scenario(own, (Fault(FaultKind.BEARING, 0.3),), sensor=sensor, timing=timing), 5, [0])
    told = lab.simulated(settings)
    current, n = start.measurements[0, 0], len(start.time_s)
    expected = simulate_states(paper, start.voltage_v[0], 1e-4)[:, 0]
    belief = KalmanFilter.from_parameters(paper, sensor, 1e-4, process_noise_std=(1e-9, 1e-9))
    rule, filtered = MOfN(3, 5), run_filter(belief, start.measurements[0], start.voltage_v[0])
    statistic = rule.statistic(filtered.whitened)
    wanted = {
        "time_ms": 1e3 * start.time_s,
        "measured_a": current,
        "expected_a": expected,
        "residual_a": filtered.innovation[:, 0],
        "statistic": statistic,
    }
    for name, curve in wanted.items():
        np.testing.assert_allclose(told[name], curve, rtol=1e-5, atol=1e-9, err_msg=name)
    away = current - expected
    for k in (25, 1000, n - 25):  # 25 samples before, 24 after
        assert told["averaged_a"][k] == pytest.approx(away[k - 25 : k + 25].mean(), rel=1e-5)
    assert told["averaged_a"][0] == pytest.approx(np.r_[away[25:0:-1], away[:25]].mean(), rel=1e-4)
    assert told["averaged_band_a"] == pytest.approx(2.0 * 0.03 / 50.0**0.5)
    threshold = rule.threshold_for(false_alarm_probability=0.02, n_samples=n, n_channels=1).value
    assert (told["threshold"], told["noise_a"]) == (threshold, pytest.approx(0.03))
    assert told["alarm_ms"] == pytest.approx(1e3 * start.time_s[np.argmax(statistic > threshold)])
    assert lab.simulated(lab.Settings(kind="healthy", rule="nis"))["alarm_ms"] is None
    rules = {"cusum": Cusum(0.3, two_sided=True), "nis": rule, "row": in_a_row(3)}
    assert {name: each for name, (_, each) in lab.RULES.items()} == rules


def test_a_roc_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of starts at or above each threshold, of the healthy motor without tolerances and of the faulty one."""
    settings = lab.Settings(
        resistance_percent=3.0, friction_percent=2.0, false_alarm_percent=10.0, rule="nis"
    )
    rng, limit = np.random.default_rng(3), lab.simulated(settings)["threshold"]
    healthy, faulty = rng.normal(limit - 2.0, 1.0, 200), rng.normal(limit, 1.0, 200)
    asked: list[lab.Settings] = []

    def largest(one: lab.Settings) -> Any:
        asked.append(one)
        return healthy if one.kind == "healthy" else faulty

    with monkeypatch.context() as patched:
        patched.setattr(lab, "_largest_statistics", largest)
        told = lab.roc(settings)
    tolerances = [(one.kind, one.resistance_percent, one.friction_percent) for one in asked]
    assert tolerances == [("healthy", 0.0, 0.0), ("bearing", 3.0, 2.0)]
    thresholds = np.quantile(healthy, np.linspace(0.0, 1.0, 101))[::-1]
    wanted = [[0.0, *((values >= t).mean() for t in thresholds)] for values in (healthy, faulty)]
    wanted[1][0] = float((faulty > healthy.max()).mean())
    np.testing.assert_allclose([told["false_alarms"], told["found"]], wanted, rtol=1e-5)
    assert told["at"] == pytest.approx([0.1, (faulty > limit).mean()])
    many = lab._largest_statistics(settings)  # of the same starts, the first of which the page shows
    assert (len(many), told["starts"]) == (200, 200)
    assert many[0] == pytest.approx(max(lab.simulated(settings)["statistic"]), rel=1e-5)


def test_after_many_healthy_starts_a_motor_is_kept_and_no_path_is_shown(tmp_path: Path) -> None:
    uploads, unfit = lab.Uploads(), lab.Uploads()
    start = write_start(tmp_path / "a.csv", "healthy").read_bytes()
    uploads.healthy = [tmp_path] * 19
    uploads.keep("healthy", "h.csv", start)
    with pytest.raises(InputError, match="at most 20 healthy starts"):
        uploads.keep("healthy", "one.csv", start)
    assert uploads.keep("motor", "m.toml", MOTOR.read_bytes())["healthy"] == 20
    unfit.keep(
        "healthy",
        "mine.csv",
        b"time_s,current_a\n" + b"".join(b"%d,%d.5\n" % (k, k * 7 % 5) for k in range(60)),
    )
    with pytest.raises(InputError, match=r"^mine\.csv: a healthy recording cannot be used"):
        lab.recording_verdict("a.csv", start, "healthy starts", None, unfit)
    for each in (uploads, unfit):
        each.clear()


def raw_request(server: str, content: bytes) -> bytes:
    """What the server answers to these bytes; empty where it only ends the connection."""
    with socket.create_connection(("127.0.0.1", int(host_of(server).split(":")[1])), 60.0) as connection:
        with suppress(ConnectionError):  # it need not read to the end what it has refused
            connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
        with suppress(ConnectionError):
            return b"".join(iter(lambda: connection.recv(2**16), b""))
        return b""


def test_a_body_that_ends_early_is_refused(server: str) -> None:
    head = f"POST /api/simulate HTTP/1.1\r\nHost: {host_of(server)}\r\nContent-Length: 20\r\n\r\n{{}}"
    answer = raw_request(server, head.encode())
    assert answer.startswith(b"HTTP/1.0 400")
    assert b"the request ended after 2 of its 20 bytes" in answer


def test_uploads_are_data(server: str, tmp_path: Path) -> None:
    bearing = write_start(tmp_path / "b.csv", "bearing").read_bytes()
    status, told = diagnosed(server, bearing, "paper", "..%2F..%2Fx.csv")
    assert (status, told["verdict"], told["file"]) == (200, "bearing", "../../x.csv")
    for body in (b"", b"\x00\x01\x02\xff" * 100, b"time_s,current_a\n1,2\n", b"<script>alert(1)</script>"):
        status, told = diagnosed(server, body, "paper", "x.csv")
        assert (status, told["error"][:5]) == (400, "x.csv")
        assert tempfile.gettempdir() not in told["error"]
    status, told = diagnosed(server, bearing, "%2Fetc%2Fpasswd")
    assert (status, "motor must be one of" in told["error"]) == (400, True)
    for query in ("voltage=-1", "voltage=1e400", "voltage=nan", "voltage=" + "9" * 400):
        assert request(server, "POST", f"/api/diagnose?{query}", bearing)[0] == 400


@pytest.mark.parametrize("length", [str(LARGEST_UPLOAD_BYTES + 1), "9" * 400, "-1", "1e3", ""])
def test_lengths_of_requests_get_an_answer(server: str, length: str) -> None:
    status, told = request(server, "POST", "/api/diagnose?name=x.csv", b"", [("Content-Length", length)])
    assert status == 400
    assert ("at most 20 MB" in told["error"]) == (
        length == str(LARGEST_UPLOAD_BYTES + 1) or "9" in length[:1]
    )


def test_server_answers_its_own_machine_only(server: str) -> None:
    assert server.startswith("http://127.0.0.1:")
    own = server.rstrip("/")
    for sent, status in (
        ([], 200),
        ([("Origin", own), ("Sec-Fetch-Site", "same-origin")], 200),
        ([("Sec-Fetch-Site", "none")], 200),
        ([("Origin", own), ("Origin", "http://evil.example")], 403),
        ([("Origin", own), ("Origin", own)], 403),
        ([("Origin", "null")], 403),
        ([("Host", "evil.example")], 403),
        ([("Sec-Fetch-Site", "cross-site")], 403),
        ([("Origin", own), ("Sec-Fetch-Site", "same-site")], 403),
    ):
        for method, path in (("GET", "/api/options"), ("POST", "/api/simulate")):
            assert request(server, method, path, b"{}", sent)[0] == status, sent
    for path in ("/../pyproject.toml", "/lab.py", "/lab_assets/lab.js", "/api/none"):
        assert request(server, "GET", path)[0] == 404
    status, told = request(server, "GET", "/")
    assert (status, "default-src 'none'" in told["policy"]) == (200, True)
    assert "http" not in told["text"]  # nothing from elsewhere
    assert request(server, "GET", "ftp://[/")[0] == 400  # an address that cannot be taken apart


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_any_exception_gets_an_answer(
    server: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(lab, "simulated", fail)
    monkeypatch.setattr(lab, "options", fail)
    for method, path in (("POST", "/api/simulate"), ("GET", "/api/options")):
        status, answer = request(server, method, path, b"{}")
        assert (status, answer["error"]) == (500, "the lab failed: ZeroDivisionError: by zero")
    assert "Traceback" in capsys.readouterr().err


def test_many_requests_at_once_are_answered_or_refused(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(settings: lab.Settings) -> dict[str, Any]:
        time.sleep(0.05)
        return {"seed": settings.seed}

    monkeypatch.setattr(lab, "simulated", slow)
    body = b'{"seed": 3}' + b" " * 9_000
    with ThreadPoolExecutor(100) as pool:
        answers = list(pool.map(lambda _: request(server, "POST", "/api/simulate", body), range(100)))
    statuses = [status for status, _ in answers]
    assert set(statuses) == {200, 503}
    assert statuses.count(200) >= 8
    told = {200: {"seed": 3}, 503: {"error": "the lab is busy; try again"}}
    assert all(answer == told[status] for status, answer in answers)
    assert request(server, "POST", "/api/simulate", body)[0] == 200


def strange_request(server: str, rng: np.random.Generator) -> bytes:
    """A request with strange bytes in its line, its headers or its body."""
    paths = [
        "/",
        "/api/simulate",
        "/api/verdict",
        "/api/diagnose?name=x.npz&motor=paper",
        "/api/none",
        "//",
        "/%ff",
    ]
    body = b'{"kind": "bearing", "severity_percent": 20, "seed": 2}'
    lines = [
        f"{['GET', 'POST'][rng.integers(2)]} {paths[rng.integers(len(paths))]} HTTP/1.1",
        f"Host: {host_of(server)}",
        f"Content-Length: {len(body) if rng.random() < 0.8 else rng.integers(-5, 10**9)}",
        "Connection: close",
    ]
    content = bytearray("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
    for place in rng.integers(len(content), size=rng.integers(4)):
        content[place] = rng.integers(256)
    return bytes(content[: rng.integers(len(content)) if rng.random() < 0.1 else None])


def test_strange_requests_get_an_answer(server: str, capfd: pytest.CaptureFixture[str]) -> None:
    rng, answered = np.random.default_rng(6), 0
    for _ in range(200):
        answer = raw_request(server, content := strange_request(server, rng))
        status = answer[9:12]
        assert answer.startswith((b"HTTP/1.", b"{", b"<!DOCTYPE")) or not answer, (content, answer)
        assert not status.startswith(b"5") or status in (b"501", b"505"), (content, answer)
        answered += status == b"200"
    assert answered > 20
    assert request(server, "GET", "/")[0] == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_port_that_cannot_be_opened_is_one_sentence(
    server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    port = host_of(server).split(":")[1]
    assert main(["lab", "--port", port, "--no-browser"]) == 2
    assert f"port {port} cannot be opened" in capsys.readouterr().err
    for wrong in (-1, 65_536):
        with pytest.raises(InputError, match=f"port must lie in 0 .. 65535, got {wrong}"):
            make_server(wrong)


OVERLAPS = """[...document.querySelectorAll('#results svg')].flatMap((svg) => {
  const boxes = [...svg.querySelectorAll("text[text-anchor='middle']")].map((text) => text.getBoundingClientRect());
  return boxes.slice(1).filter((box, k) => box.left < boxes[k].right);
}).length"""  # numbers along the time axes that run into each other


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
