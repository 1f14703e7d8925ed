"""The lab: what it computes, and what its server refuses."""

import http.client
import io
import json
import re
import socket
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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
from motor_env.apps.lab_server import _Handler, make_server  # its reading is tested without a connection
from motor_env.cli import main
from motor_env.motor.faults import BUILT_IN_KINDS, SENSOR_KINDS
from motor_env.motor.parameters import CATALOGUE

# Reaches in: settings come from a page through the reader of documents, which no public name shows.
from motor_env.motor.toml_files import from_dict


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_lab() as address:
        yield address


def request(
    server: str, method: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None
) -> tuple[int, dict[str, Any], http.client.HTTPMessage]:
    connection = http.client.HTTPConnection(server.removeprefix("http://").rstrip("/"), timeout=60)
    connection.request(method, path, body, headers or {})
    response = connection.getresponse()
    content = response.read()
    connection.close()
    kind = response.getheader("Content-Type", "")
    return (
        response.status,
        json.loads(content) if "json" in kind else {"text": content.decode()},
        response.headers,
    )


def test_the_first_setting_shows_a_choice() -> None:
    """An alarm, the right verdict, and a curve on which more false alarms find more faults."""
    settings = lab.Settings()
    assert lab.simulated(settings)["alarm_ms"] is not None
    assert lab.verdict(settings)["verdict"] == "bearing"
    told = lab.roc(settings)
    assert 0.8 < told["at"][1] < 0.95
    assert np.interp(0.1, told["false_alarms"], told["found"]) > told["at"][1] + 0.04


def test_own_motor_and_healthy_starts_are_references(server: str, tmp_path: Path) -> None:
    recording = write_start(tmp_path / "a.csv", "healthy").read_bytes()
    assert request(server, "POST", "/api/diagnose?name=a.csv&motor=own+motor", recording)[1]["error"] == (
        "no own motor handed in yet"
    )
    for body in (b"nonsense", b"[motor]\nresistance_ohm = -1\n"):
        status, told, _ = request(server, "POST", "/api/keep?kind=motor&name=m.toml", body)
        assert (status, told["error"][:6]) == (400, "m.toml")
    own = Path("examples/motor.toml").read_bytes().replace(b"2.18", b"4.36")
    status, told, _ = request(server, "POST", "/api/keep?kind=motor&name=m.toml", own)
    assert (status, told["reference"]) == (200, "own motor")
    status, told, _ = request(server, "POST", "/api/diagnose?name=a.csv&motor=own+motor", recording)
    assert (status, told["verdict"]) == (200, "other")  # half the resistance of that motor file
    for body in (b"nonsense", b"[motor]\nresistance_ohm = -1\n"):
        status, told, _ = request(server, "POST", "/api/keep?kind=motor&name=bad.toml", body)
        assert (status, told["error"][:8]) == (400, "bad.toml")
        assert request(server, "POST", "/api/diagnose?name=a.csv&motor=own+motor", recording)[0] == 200
    for seed in range(3):
        start = write_start(tmp_path / "h.csv", "healthy", seed).read_bytes()
        assert request(server, "POST", "/api/keep?kind=healthy&name=h.csv", start)[0] == 200
    status, told, _ = request(server, "POST", "/api/diagnose?name=a.csv&motor=healthy+starts", recording)
    assert (status, told["verdict"]) == (200, "healthy")
    assert len(told["curves"]["healthy_a"]) == len(told["curves"]["time_ms"])


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("healthy", "healthy"),
        ("bearing", "bearing"),
        ("winding_contact", "winding"),
        ("winding_short", "winding"),
    ],
)
def test_verdicts_on_simulated_starts(kind: str, expected: str) -> None:
    assert lab.verdict(lab.Settings(kind=kind, noise_ma=10.0))["verdict"] == expected


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        ([], "must be an object"),
        ({"kind": "gremlin"}, "kind must be one of"),
        ({"severity_percent": 1000}, "severity_percent must lie in 0 .. 60, got 1000"),
        ({"severity_percent": "x"}, "severity_percent must be a valid number, got 'x'"),
        ({"severity_percent": float("nan")}, "severity_percent must lie in 0 .. 60, got nan"),
        ({"noise_ma": 10**400}, "noise_ma must"),
        ({"seed": True}, "seed must be a valid integer, got True"),
        ({"seed": 1.9}, "seed must be a valid integer, got 1.9"),
        ({"path": "x"}, "unknown key 'path' in the settings"),
    ],
)
def test_settings_are_checked(document: object, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        from_dict(lab.Settings, document, "the settings")  # type: ignore[arg-type]  # what a page may send


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("severity_percent", 0.0, 60.0),
        ("noise_ma", 1.0, 200.0),
        ("resistance_percent", -10.0, 10.0),
        ("friction_percent", -10.0, 10.0),
        ("false_alarm_percent", 0.1, 20.0),
        ("seed", 0, 1_000_000),
    ],
)
def test_sliders_end_where_they_say(name: str, low: float, high: float) -> None:
    for value in (low, high):
        lab.Settings(**{name: value})  # type: ignore[arg-type]
    for value in (np.nextafter(low, -1e9), np.nextafter(high, 1e9)):
        with pytest.raises(ValueError, match=re.escape(f"{name} must lie in {low:g} .. {high:g}")):
            lab.Settings(**{name: float(value)})  # type: ignore[arg-type]
    offered = lab.options()
    assert offered["ranges"][name] == (low, high)
    assert low <= offered["defaults"][name] <= high


@pytest.mark.parametrize("kind", lab.options()["kinds"])
def test_every_fault_that_is_offered_can_be_simulated(kind: str) -> None:
    lab.simulated(lab.Settings(kind=kind, severity_percent=60.0))


def test_faults_of_sensors_that_are_not_there_are_not_offered() -> None:
    assert {"bearing", "current_dead"} <= set(lab.options()["kinds"])
    for kind in ("speed_dead", "voltage_polarity", "swapped"):
        with pytest.raises(ValueError, match="kind must be one of"):
            lab.Settings(kind=kind)


def test_every_fault_has_words_on_the_page() -> None:
    script = (resources.files("motor_env.apps") / "lab_assets" / "lab.js").read_text(encoding="utf-8")
    own = [str(kind) for kind in (*BUILT_IN_KINDS, *SENSOR_KINDS)]  # other tests register kinds
    assert all(f'{kind}: "' in script for kind in lab.fault_names() if kind in own)


def test_curves_are_those_of_the_start() -> None:
    """Every curve from the simulation, the filter and the rule themselves."""
    settings = lab.Settings(
        kind="bearing",
        severity_percent=30.0,
        noise_ma=30.0,
        resistance_percent=4.0,
        friction_percent=-3.0,
        false_alarm_percent=2.0,
        rule="nis",
        seed=5,
    )
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
    assert told["threshold"] == threshold
    assert told["alarm_ms"] == pytest.approx(1e3 * start.time_s[np.argmax(statistic > threshold)])
    assert told["noise_a"] == pytest.approx(0.03)
    quiet = lab.simulated(lab.Settings(kind="healthy", rule="nis"))
    assert quiet["alarm_ms"] is None
    assert max(quiet["statistic"]) < quiet["threshold"]
    assert {
        "cusum": ("CUSUM", Cusum(0.3, two_sided=True)),
        "nis": ("NIS, 3 of 5", rule),
        "row": ("NIS, 3 in a row", in_a_row(3)),
    } == lab.RULES


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
    assert [(one.kind, one.resistance_percent, one.friction_percent) for one in asked] == [
        ("healthy", 0.0, 0.0),
        ("bearing", 3.0, 2.0),
    ]
    thresholds = np.quantile(healthy, np.linspace(0.0, 1.0, 101))[::-1]
    wanted = [[0.0, *((values >= t).mean() for t in thresholds)] for values in (healthy, faulty)]
    wanted[1][0] = float((faulty > healthy.max()).mean())
    np.testing.assert_allclose([told["false_alarms"], told["found"]], wanted, rtol=1e-5)
    assert told["at"] == pytest.approx([0.1, (faulty > limit).mean()])
    assert told["starts"] == 200
    many = lab._largest_statistics(settings)  # of the same starts, the first of which the page shows
    assert (len(many), many[0]) == (200, pytest.approx(max(lab.simulated(settings)["statistic"]), rel=1e-5))


def test_a_verdict_shows_the_start_from_just_before_it() -> None:
    told = lab.verdict(lab.Settings(kind="bearing", noise_ma=10.0))
    curves, start = told["curves"], lab.simulate_start(lab.Settings(kind="bearing", noise_ma=10.0))
    onset = int(np.argmax(start.voltage_v[0] > 0.0))
    assert curves["time_ms"][0] == pytest.approx(-2.0, abs=0.15)  # 20 samples
    assert np.diff(curves["time_ms"]) == pytest.approx(
        0.2, abs=1e-3
    )  # every other sample: 1,200 to 2,400 points
    current, begin = start.measurements[0, 0], round(onset + 10.0 * curves["time_ms"][0])
    near = [k for k in range(begin - 2, begin + 3) if abs(current[k] - curves["measured_a"][0]) < 1e-6]
    assert near
    assert {len(curve) for curve in curves.values()} == {len(curves["time_ms"])}
    shown = np.array(curves["measured_a"]) - curves["fitted_a"]
    np.testing.assert_allclose(shown, curves["residual_a"], atol=2e-5)
    middle = len(shown) // 2  # the motor runs steadily
    seen = current[near[0] + 2 * middle - 25 : near[0] + 2 * middle + 25]
    assert curves["beyond_a"][middle] == pytest.approx(seen.mean() - curves["healthy_a"][middle], abs=1e-6)


def test_names_and_sizes_of_files_end_where_they_say(tmp_path: Path) -> None:
    assert lab.display_name("a" * 90) == "a" * 80
    assert lab.display_name("\n\x00") == "recording"
    endings = {
        "a.CSV": ".csv",
        "a.z": ".z",
        "a.abcdefgh": ".abcdefgh",
        "a.abcdefghi": ".csv",
        "a.b-c": ".csv",
        "a": ".csv",
    }
    assert {name: lab.file_suffix(name) for name in endings} == endings
    uploads, own = lab.Uploads(), Path("examples/motor.toml").read_bytes()
    uploads.healthy = [tmp_path] * 19
    assert uploads.keep("motor", "m.csv", own) == {"name": "m.csv", "reference": "own motor", "healthy": 19}
    uploads.healthy = [tmp_path] * 20
    with pytest.raises(InputError, match="at most 20 healthy starts"):
        uploads.keep("healthy", "h.csv", own)
    uploads.clear()
    for port in (-1, 65_536):
        with pytest.raises(InputError, match=f"port must lie in 0 .. 65535, got {port}"):
            make_server(port)


class Told(_Handler):
    """A handler without a connection."""

    def __init__(self, length: str, body: bytes = b"") -> None:
        self.headers = http.client.HTTPMessage()
        self.headers["Content-Length"] = length
        self.rfile = io.BytesIO(body)


def test_requests_are_read_in_pieces_and_up_to_their_largest_length() -> None:
    body = bytes(150_000)
    assert [len(piece) for piece in Told("", body)._chunks(150_000)] == [65_536, 65_536, 18_928]
    assert [len(piece) for piece in Told("", body)._chunks(10)] == [10]
    assert [len(piece) for piece in Told("", body[:7])._chunks(10)] == [7]  # the connection ended
    assert Told("10000")._length(10_000) == 10_000
    assert Told("10".zfill(15))._length(10_000) == 10
    for length in ("10001", "10".zfill(16)):
        with pytest.raises(InputError, match=r"at most 0\.01 MB can be taken"):
            Told(length)._length(10_000)


def test_after_many_healthy_starts_a_motor_is_kept_and_no_path_is_shown(tmp_path: Path) -> None:
    uploads = lab.Uploads()
    start = write_start(tmp_path / "a.csv", "healthy").read_bytes()
    for number in range(20):
        uploads.keep("healthy", f"h{number}.csv", start)
    with pytest.raises(InputError, match="at most 20 healthy starts"):
        uploads.keep("healthy", "one.csv", start)
    assert uploads.keep("motor", "m.toml", Path("examples/motor.toml").read_bytes())["healthy"] == 20
    noise = b"time_s,current_a\n" + b"".join(b"%d,%d.5\n" % (k, k * 7 % 5) for k in range(60))
    unfit = lab.Uploads()
    unfit.keep("healthy", "mine.csv", noise)
    with pytest.raises(InputError, match=r"^mine\.csv: a healthy recording cannot be used"):
        lab.recording_verdict("a.csv", start, "healthy starts", None, unfit)
    for each in (uploads, unfit):
        each.clear()


def test_a_body_that_ends_early_is_refused(server: str) -> None:
    name, port = server.removeprefix("http://").rstrip("/").split(":")
    with socket.create_connection((name, int(port)), timeout=30) as sent:
        head = f"POST /api/simulate HTTP/1.1\r\nHost: {name}:{port}\r\nContent-Length: 20\r\n\r\n{{}}"
        sent.sendall(head.encode())
        sent.shutdown(socket.SHUT_WR)
        answer = sent.makefile("rb").read()
    assert answer.startswith(b"HTTP/1.0 400")
    assert b"the request ended after 2 of its 20 bytes" in answer


def test_uploads_are_data(server: str, tmp_path: Path) -> None:
    bearing = write_start(tmp_path / "b.csv", "bearing").read_bytes()
    status, told, _ = request(server, "POST", "/api/diagnose?name=..%2F..%2Fx.csv&motor=paper", bearing)
    assert (status, told["verdict"], told["file"]) == (200, "bearing", "../../x.csv")
    for body in (b"", b"\x00\x01\x02\xff" * 100, b"time_s,current_a\n1,2\n", b"<script>alert(1)</script>"):
        status, told, _ = request(server, "POST", "/api/diagnose?name=x.csv&motor=paper", body)
        assert status == 400
        assert told["error"].startswith("x.csv")
        assert tempfile.gettempdir() not in told["error"]
    status, told, _ = request(server, "POST", "/api/diagnose?name=x.csv&motor=%2Fetc%2Fpasswd", bearing)
    assert (status, "motor must be one of" in told["error"]) == (400, True)
    status, told, _ = request(server, "POST", "/api/diagnose?voltage=-1", bearing)
    assert (status, told["error"]) == (400, "voltage must be > 0, got '-1'")


def test_too_large_an_upload_is_refused_unread(server: str) -> None:
    connection = http.client.HTTPConnection(server.removeprefix("http://").rstrip("/"), timeout=30)
    connection.putrequest("POST", "/api/diagnose?name=x.csv")
    connection.putheader("Content-Length", str(LARGEST_UPLOAD_BYTES + 1))
    connection.endheaders()
    response = connection.getresponse()
    assert (response.status, "at most 20 MB" in json.loads(response.read())["error"]) == (400, True)
    connection.close()


def test_server_answers_its_own_machine_only(server: str) -> None:
    assert server.startswith("http://127.0.0.1:")
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
        assert request(server, "GET", "/", headers=headers)[0] == 403
        assert request(server, "POST", "/api/simulate", b"{}", headers)[0] == 403
    own, port = server.rstrip("/"), int(server.rstrip("/").rpartition(":")[2])
    for sent, status in (
        ([], 200),
        ([("Origin", own), ("Sec-Fetch-Site", "same-origin")], 200),
        ([("Sec-Fetch-Site", "none")], 200),
        ([("Origin", own), ("Origin", "http://evil.example")], 403),
        ([("Origin", own), ("Origin", own)], 403),
        ([("Host", "evil.example")], 403),
        ([("Sec-Fetch-Site", "cross-site")], 403),
        ([("Origin", own), ("Sec-Fetch-Site", "same-site")], 403),
    ):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.putrequest("GET", "/api/options")
        for name, value in sent:
            connection.putheader(name, value)
        connection.endheaders()
        assert connection.getresponse().status == status, sent
        connection.close()
    for path in ("/../pyproject.toml", "/lab.py", "/lab_assets/lab.js", "/api/none"):
        assert request(server, "GET", path)[0] == 404
    status, told, headers_back = request(server, "GET", "/")
    assert status == 200
    assert "default-src 'none'" in headers_back["Content-Security-Policy"]
    assert "http" not in told["text"]  # nothing from elsewhere
    assert request(server, "POST", "/api/simulate", b"{")[:2] == (400, {"error": "settings must be JSON"})


@pytest.mark.parametrize(
    "number", ["1e400", "1" + "0" * 400, "-1" + "0" * 400, "1" * 5000, "NaN", "-Infinity", "[[1]]", "1e308"]
)
def test_overflowing_numbers_get_an_answer(server: str, number: str) -> None:
    for name in ("severity_percent", "noise_ma", "seed"):
        for path in ("/api/simulate", "/api/verdict"):
            status, answer, _ = request(server, "POST", path, f'{{"{name}": {number}}}'.encode())
            assert (status, len(answer["error"]) < 300) == (400, True)
    for query in ("voltage=1e400", "voltage=nan", "voltage=" + "9" * 400):
        assert request(server, "POST", f"/api/diagnose?{query}", b"t,i\n")[0] == 400


@pytest.mark.parametrize("length", ["9" * 400, "-1", "1e3", ""])
def test_lengths_of_requests_get_an_answer(server: str, length: str) -> None:
    status, _, _ = request(server, "POST", "/api/simulate", b"{}", {"Content-Length": length})
    assert status == 400


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_any_exception_gets_an_answer(
    server: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(lab, "simulated", fail)
    monkeypatch.setattr(lab, "options", fail)
    for method, path in (("POST", "/api/simulate"), ("GET", "/api/options")):
        status, answer, _ = request(server, method, path, b"{}")
        assert (status, answer["error"]) == (500, "the lab failed: ZeroDivisionError: by zero")
    assert "Traceback" in capsys.readouterr().err
    assert request(server, "GET", "ftp://[/")[0] == 400  # an address that cannot be taken apart


def test_many_requests_at_once_are_answered_or_refused(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(settings: lab.Settings) -> dict[str, Any]:
        time.sleep(0.05)
        return {"seed": settings.seed}

    monkeypatch.setattr(lab, "simulated", slow)
    body = b'{"seed": 3}' + b" " * 9_000
    with ThreadPoolExecutor(100) as pool:
        answers = list(pool.map(lambda _: request(server, "POST", "/api/simulate", body)[:2], range(100)))
    statuses = [status for status, _ in answers]
    assert set(statuses) == {200, 503}
    assert statuses.count(200) >= 8
    assert all(
        answer == ({"seed": 3} if status == 200 else {"error": "the lab is busy; try again"})
        for status, answer in answers
    )
    assert request(server, "POST", "/api/simulate", body)[0] == 200


def raw_request(server: str, content: bytes) -> bytes:
    """What the server answers to these bytes; empty where it only ends the connection."""
    with socket.create_connection(
        ("127.0.0.1", int(server.rstrip("/").rpartition(":")[2])), 60.0
    ) as connection:
        with suppress(ConnectionError):  # it need not read to the end what it has refused
            connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
        with suppress(ConnectionError):
            return b"".join(iter(lambda: connection.recv(2**16), b""))
        return b""


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
        f"Host: {server.removeprefix('http://').rstrip('/')}",
        f"Content-Length: {len(body) if rng.random() < 0.8 else rng.integers(-5, 10**9)}",
        "Connection: close",
    ]
    content = bytearray("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
    for place in rng.integers(len(content), size=rng.integers(4)):
        content[place] = rng.integers(256)
    return bytes(content[: rng.integers(len(content)) if rng.random() < 0.1 else None])


def test_strange_requests_get_an_answer(server: str, capfd: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(6)
    answered = 0
    for _ in range(200):
        answer = raw_request(server, content := strange_request(server, rng))
        status = answer[9:12]
        assert answer.startswith((b"HTTP/1.", b"{", b"<!DOCTYPE")) or not answer, (content, answer)
        assert not status.startswith(b"5") or status in (b"501", b"505"), (content, answer)
        answered += status == b"200"
    assert answered > 20
    assert request(server, "GET", "/")[0] == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_taken_port_is_one_sentence(server: str, capsys: pytest.CaptureFixture[str]) -> None:
    port = server.rstrip("/").rpartition(":")[2]
    assert main(["lab", "--port", port, "--no-browser"]) == 2
    assert f"port {port} cannot be opened" in capsys.readouterr().err
    assert main(["lab", "--port", "70000", "--no-browser"]) == 2
