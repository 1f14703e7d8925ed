"""Serve the lab on the loopback interface only.

It binds to 127.0.0.1 and refuses requests with another Host (DNS rebinding) or Origin; the page loads nothing from
elsewhere (Content-Security-Policy).
"""

from __future__ import annotations

import json
import math
import threading
import traceback
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from motor_env.apps import lab
from motor_env.apps.lab import LARGEST_UPLOAD_BYTES, Uploads
from motor_env.common.errors import InputError
from motor_env.motor.toml_files import from_dict

HOST = "127.0.0.1"
_LARGEST_SETTINGS_BYTES = 10_000
_ASSETS = {
    "/": ("lab.html", "text/html; charset=utf-8"),
    "/lab.js": ("lab.js", "text/javascript; charset=utf-8"),
    "/lab.css": ("lab.css", "text/css; charset=utf-8"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class _Server(ThreadingHTTPServer):
    def __init__(self, *arguments: Any) -> None:
        self.uploads = Uploads()  # first: a port that is taken closes the server
        super().__init__(*arguments)

    def server_close(self) -> None:
        super().server_close()
        self.uploads.clear()

    request_queue_size = 256  # connections that wait to be taken; the usual 5 would reset the others


def make_server(port: int = 0) -> ThreadingHTTPServer:
    """Open a server without serving; port 0 takes a free one (`server.server_port`).

    Raises:
        InputError: the port is taken, or out of range.
    """
    if not 0 <= port <= 65_535:
        raise InputError(f"port must lie in 0 .. 65535, got {port}")
    try:
        return _Server((HOST, port), _Handler)
    except OSError as error:
        raise InputError(f"port {port} cannot be opened ({(error.strerror or str(error)).lower()})") from None


def address(server: ThreadingHTTPServer) -> str:
    """Return the page's address."""
    return f"http://{HOST}:{server.server_port}/"


_OWN_SITES = {"same-origin", "none"}  # what a browser says of our own page, and of an address that was typed
_FIT_LOCK = threading.Lock()  # a fit takes a whole core; requests of a moved slider must not pile up
_QUEUE = threading.BoundedSemaphore(8)  # for the one that is at work and those that wait


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "motor-env-lab"
    sys_version = ""
    timeout = 30

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, action: Callable[[], None]) -> None:
        try:
            if self._is_ours():
                action()
        except (InputError, ValueError, OverflowError) as error:
            self._send_json(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        except (ConnectionError, TimeoutError):  # whoever asked is gone
            self.close_connection = True
        except Exception as error:  # noqa: BLE001  # a bug is said on the page and on the terminal
            traceback.print_exc()
            self.close_connection = True
            said = f"the lab failed: {type(error).__name__}: {error}"
            self._send_json(HTTPStatus.INTERNAL_SERVER_ERROR, {"error": said})

    def _get(self) -> None:
        path = urlsplit(self.path).path
        if path in _ASSETS:
            name, kind = _ASSETS[path]
            self._send(HTTPStatus.OK, (files("motor_env.apps") / "lab_assets" / name).read_bytes(), kind)
        elif path == "/api/options":
            self._send_json(HTTPStatus.OK, lab.options())
        else:
            self._send_json(HTTPStatus.NOT_FOUND, {"error": "no such page"})

    def _post(self) -> None:
        actions: dict[str, tuple[int, Callable[[bytes], dict[str, Any]]]] = {
            "/api/simulate": (_LARGEST_SETTINGS_BYTES, lambda body: lab.simulated(_settings(body))),
            "/api/verdict": (_LARGEST_SETTINGS_BYTES, lambda body: lab.verdict(_settings(body))),
            "/api/roc": (_LARGEST_SETTINGS_BYTES, lambda body: lab.roc(_settings(body))),
            "/api/keep": (LARGEST_UPLOAD_BYTES, self._keep),
            "/api/diagnose": (LARGEST_UPLOAD_BYTES, self._diagnose),
        }
        path = urlsplit(self.path).path
        if path not in actions:
            self._send_json(HTTPStatus.NOT_FOUND, {"error": "no such page"})
            return
        largest, action = actions[path]
        if not _QUEUE.acquire(blocking=False):
            for _ in self._chunks(self._length(largest)):  # an unread request would be reset, not refused
                pass
            self._send_json(HTTPStatus.SERVICE_UNAVAILABLE, {"error": "the lab is busy; try again"})
            return
        try:
            length = self._length(largest)
            body = b"".join(self._chunks(length))
            if len(body) < length:
                self.close_connection = True
                raise InputError(f"the request ended after {len(body)} of its {length} bytes")
            with _FIT_LOCK:
                answer = action(body)
        finally:
            _QUEUE.release()
        self._send_json(HTTPStatus.OK, answer)

    def _diagnose(self, body: bytes) -> dict[str, Any]:
        query = parse_qs(urlsplit(self.path).query)
        level = query.get("voltage", [""])[0]
        try:
            voltage = float(level) if level else None
        except ValueError:
            voltage = math.nan
        if voltage is not None and not 0.0 < voltage < math.inf:
            raise InputError(f"voltage must be > 0, got {level[:40]!r}")
        name = unquote(query.get("name", ["recording.csv"])[0])
        wanted = query.get("motor", [""])[0]
        return lab.recording_verdict(name, body, wanted, voltage, self.server.uploads)

    def _keep(self, body: bytes) -> dict[str, Any]:
        query = parse_qs(urlsplit(self.path).query)
        kind, name = (query.get(key, [""])[0] for key in ("kind", "name"))
        return self.server.uploads.keep(kind, unquote(name), body)

    def _length(self, largest: int) -> int:
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdigit():
            self.close_connection = True
            raise InputError("the request has no length")
        if len(length) > 15 or int(length) > largest:
            self.close_connection = True  # the rest is not read
            raise InputError(f"at most {largest / 1e6:g} MB can be taken, got {float(length) / 1e6:.1f} MB")
        return int(length)

    def _chunks(self, length: int) -> Iterator[bytes]:
        while length and (chunk := self.rfile.read(min(length, 2**16))):
            length -= len(chunk)
            yield chunk

    def _is_ours(self) -> bool:
        port = self.connection.getsockname()[1]
        hosts = {f"{name}:{port}" for name in (HOST, "localhost")}
        allowed = {
            "Host": hosts,
            "Origin": {f"http://{host}" for host in hosts},
            "Sec-Fetch-Site": _OWN_SITES,
        }
        given = {name: self.headers.get_all(name, []) for name in allowed}
        if given["Host"] and all(
            len(values) < 2 and set(values) <= allowed[name] for name, values in given.items()
        ):
            return True
        self.close_connection = True
        self._send_json(HTTPStatus.FORBIDDEN, {"error": "this page answers its own machine only"})
        return False

    def _send_json(self, status: HTTPStatus, document: dict[str, Any]) -> None:
        body = json.dumps(document, ensure_ascii=False, allow_nan=False, default=str).encode()
        self._send(status, body, "application/json; charset=utf-8")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **_HEADERS}.items():
            self.send_header(name, value)
        try:
            self.end_headers()
            self.wfile.write(body)
        except ConnectionError:  # the page was closed, or asks anew
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  # the base class names it so
        """Say nothing."""


def _settings(body: bytes) -> lab.Settings:
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        raise InputError("settings must be JSON") from None
    return from_dict(lab.Settings, document, "the settings")
