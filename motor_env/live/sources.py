"""Where lines come from: standard input, a growing file, a serial port, MQTT; and what is said where none come.

A source yields bytes as they come, and nothing (b"") at least every second while none do.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

from motor_env.errors import InputError

NEW_FILE = "new_file"
SILENCE_S = 5.0
_PAUSE_S = 0.2
_CHUNK = 1 << 16
_MOST_WAITING = 10_000  # pieces; a watcher that lags farther behind loses some, which shows as a gap


@dataclass(frozen=True, slots=True)
class Notice:
    """What a source has to say beside lines: kind (silence, unplugged, new_file), and words."""

    kind: str
    text: str


Piece = bytes | Notice
SILENCE = Notice("silence", f"no line for {SILENCE_S:g} s: is the cable in?")


def lines(pieces: Iterator[Piece], *, rest: bool = True) -> Iterator[Piece]:
    """Whole lines of pieces; SILENCE once where none come for a while.

    Args:
        pieces: of a source.
        rest: whether what follows the last line end is a line, too.
    """
    left, heard_s, is_silent = b"", time.monotonic(), False
    for piece in pieces:
        if isinstance(piece, Notice):
            left, is_silent = b"", True
            yield piece
        elif piece:
            heard_s, is_silent = time.monotonic(), False
            *whole, left = (left + piece).split(b"\n")
            yield from (line + b"\n" for line in whole)
        elif not is_silent and time.monotonic() - heard_s > SILENCE_S:
            is_silent = True
            yield SILENCE
    if left and rest:
        yield left


def source(name: str | None, *, follow: bool, offset: int, baud: int) -> Iterator[Piece]:
    """Pieces of what a user names: a file, serial:PORT, mqtt://HOST/TOPIC; standard input without a name.

    Raises:
        InputError: there is no such thing, or the library that it needs is missing.
    """
    if name is None:
        return _standard_input()
    if name.startswith("serial:"):
        return _serial(name.removeprefix("serial:"), baud)
    if name.startswith("mqtt:"):
        return _mqtt(name)
    return _file(Path(name), offset, follow=follow)


def _standard_input() -> Iterator[Piece]:
    waiting: queue.Queue[Piece | None] = queue.Queue(16)

    def read() -> None:
        while piece := os.read(sys.stdin.fileno(), _CHUNK):
            waiting.put(piece)
        waiting.put(None)

    threading.Thread(target=read, daemon=True).start()
    return _from(waiting)


def _file(path: Path, offset: int, *, follow: bool) -> Iterator[Piece]:
    with path.open("rb") as file:
        file.seek(offset)
        while True:
            if file.tell() > os.fstat(file.fileno()).st_size:
                yield Notice(NEW_FILE, f"{path} has shrunk: read from its begin")
                file.seek(0)
            piece = file.read(_CHUNK)
            yield piece
            if not piece:
                if not follow:
                    return
                time.sleep(_PAUSE_S)


def _serial(port: str, baud: int) -> Iterator[Piece]:
    """A thread reads, so that nothing is lost while a window is judged; an unplugged port is opened anew."""
    try:
        import serial
    except ImportError:
        raise InputError("a serial port needs pyserial: pip install 'motor-env[live]'") from None
    try:
        device = serial.serial_for_url(port, baud, timeout=_PAUSE_S)
    except (serial.SerialException, ValueError) as error:
        reason = os.strerror(error.errno).lower() if isinstance(error, OSError) and error.errno else error
        raise InputError(f"serial port {port}: {reason}") from None
    waiting: queue.Queue[Piece | None] = queue.Queue(_MOST_WAITING)

    def read() -> None:
        while True:
            try:
                device.open() if not device.is_open else None
                _put(waiting, device.read(device.in_waiting or 1))
            except (OSError, TypeError):  # TypeError: pyserial's, of a port that closes while it is read
                if device.is_open:
                    device.close()
                    _put(waiting, Notice("unplugged", f"serial port {port} is gone; it is tried again"))
                time.sleep(_PAUSE_S)

    threading.Thread(target=read, daemon=True).start()
    return _from(waiting)


def _mqtt(url: str) -> Iterator[Piece]:
    """Each message holds one or more lines; the library's own thread connects again."""
    try:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError:
        raise InputError("MQTT needs paho-mqtt: pip install 'motor-env[live]'") from None
    parts = urlsplit(url)
    topic = unquote(parts.path.removeprefix("/"))
    if not parts.hostname or not topic:
        raise InputError(f"MQTT needs mqtt://HOST/TOPIC, got {url!r}")
    waiting: queue.Queue[Piece | None] = queue.Queue(_MOST_WAITING)
    client = Client(CallbackAPIVersion.VERSION2)
    if parts.username:
        client.username_pw_set(unquote(parts.username), unquote(parts.password or ""))

    def subscribe(*_: object) -> None:
        client.subscribe(topic, qos=1)

    client.on_connect = subscribe
    client.on_message = lambda *given: _put(waiting, bytes(given[2].payload).rstrip(b"\r\n") + b"\n")
    client.on_disconnect = lambda *_: _put(waiting, Notice("unplugged", f"{parts.hostname} is gone"))
    try:
        client.connect(parts.hostname, parts.port or 1883)
    except OSError as error:
        raise InputError(f"{url}: {(error.strerror or str(error)).lower()}") from None
    client.loop_start()
    return _from(waiting)


def _put(waiting: queue.Queue[Piece | None], piece: Piece) -> None:
    with suppress(queue.Full):
        waiting.put_nowait(piece)


def _from(waiting: queue.Queue[Piece | None]) -> Iterator[Piece]:
    """What threads have put in, up to None."""
    piece: Piece | None = b""
    while piece is not None:
        yield piece
        try:
            piece = waiting.get(timeout=1.0)
        except queue.Empty:
            piece = b""
