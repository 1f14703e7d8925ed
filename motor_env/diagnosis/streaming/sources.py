"""Read lines from standard input, a growing file, a serial port or MQTT.

A source yields bytes as they come, and b"" at least every second.
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
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from motor_env.common.errors import InputError

NEW_FILE = "new_file"
SILENCE_S = 5.0
LONGEST_LINE = 1 << 16
BLOCK_BYTES = 512
"""Bytes before a place in a file that identify it."""
_PAUSE_S = 0.2
_CHUNK = 1 << 16
_MOST_WAITING_BYTES = 1 << 26
_PIECE_BYTES = 100  # of a piece beside what is in it


@dataclass(frozen=True, slots=True)
class Notice:
    """Message of a source: kind (silence, unplugged, lost, new_file), and words."""

    kind: str
    text: str


Piece = bytes | Notice
SILENCE = Notice("silence", f"no line for {SILENCE_S:g} s: is the cable plugged in?")


def lines(pieces: Iterator[Piece], *, rest: bool = True) -> Iterator[Piece]:
    """Split pieces into lines; yield SILENCE once if none come for a while.

    A line beyond LONGEST_LINE comes in parts.

    Args:
        pieces: of a source.
        rest: whether an unfinished last line counts.
    """
    left, last_line_s, is_silent = bytearray(), time.monotonic(), False
    for piece in pieces:
        if isinstance(piece, Notice):
            left.clear()
            yield piece
            last_line_s, is_silent = time.monotonic(), piece.kind == "unplugged"
            continue
        left += piece
        if b"\n" in piece:
            *whole, left = left.split(b"\n")
            yield from (bytes(line) + b"\n" for line in whole)
            last_line_s, is_silent = time.monotonic(), False  # now: a window may have been judged meanwhile
        if len(left) > LONGEST_LINE:
            yield bytes(left)
            left.clear()
        if not is_silent and time.monotonic() - last_line_s > SILENCE_S:
            is_silent = True
            yield SILENCE
    if left and rest:
        yield bytes(left)


def identity(name: str | None) -> str:
    """Name a source: a file by its absolute path, a broker without a password.

    Raises:
        InputError: no such source.
    """
    if name is None:
        return "standard input"
    if name.startswith("serial:"):
        return name
    if name.startswith("mqtt:"):
        broker = _broker(name)
        return f"mqtt://{broker.host}:{broker.port}/{broker.topic}"
    if "://" in name:  # it may hold a password, too
        raise InputError("a source is a file, serial:PORT or mqtt://HOST/TOPIC, got another kind of URL")
    return str(Path(name).absolute())


def source(
    name: str | None, *, follow: bool, baud: int, offset: int = 0, last_read: bytes = b""
) -> Iterator[Piece]:
    """Open a file, serial:PORT, mqtt://HOST/TOPIC, or standard input without a name.

    Args:
        name: of the source.
        follow: whether to wait for more of a file or its successor.
        baud: of a serial port.
        offset: bytes of a file already read.
        last_read: the last BLOCK_BYTES of them.

    Raises:
        InputError: no such source, or its library is missing.
    """
    identity(name)
    if name is None:
        return _standard_input()
    if name.startswith("serial:"):
        return _serial(name.removeprefix("serial:"), baud)
    if name.startswith("mqtt:"):
        return _mqtt(_broker(name))
    return _file(Path(name), offset, last_read, follow=follow)


def _standard_input() -> Iterator[Piece]:
    if sys.stdin is None:
        raise InputError("standard input is closed; name a log, or pipe its lines")
    try:
        os.read(sys.stdin.fileno(), 0)
    except OSError as error:
        raise InputError(f"standard input: {(error.strerror or str(error)).lower()}") from None
    waiting: queue.Queue[Piece | None] = queue.Queue(16)

    def read() -> None:
        with suppress(OSError):  # a terminal that is gone
            while piece := os.read(sys.stdin.fileno(), _CHUNK):
                waiting.put(piece)
        waiting.put(None)

    threading.Thread(target=read, daemon=True).start()
    return _from(waiting)


def _file(path: Path, at: int, before: bytes, *, follow: bool) -> Iterator[Piece]:
    """Read a file. Each read repeats the last block, to detect another file."""
    file, successor = _open(path), None
    try:
        while True:
            if follow and successor is None:  # asked first, so that the old one is read to its end
                successor = _open_successor(path, file)
            file.seek(min(at - len(before), os.fstat(file.fileno()).st_size))
            block = file.read(len(before) + _CHUNK)
            if not block.startswith(before):
                words = f"{path} is not the same file as before: read from its beginning"
                yield Notice(NEW_FILE, f"{words}; what followed byte {at} may be lost")
                at, before = 0, b""
                continue
            piece = block[len(before) :]
            at, before = at + len(piece), block[-BLOCK_BYTES:]
            yield piece
            if piece:
                continue
            if successor is not None:
                file.close()
                file, successor, at, before = successor, None, 0, b""
                yield Notice(NEW_FILE, f"{path} is another file now: read from its beginning")
            elif follow:
                time.sleep(_PAUSE_S)
            else:
                return
    finally:
        file.close()
        if successor is not None:
            successor.close()


def _open(path: Path) -> FileIO:
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no regular file; a port is serial:PORT, and a pipe standard input")
    return FileIO(path)


def _open_successor(path: Path, file: FileIO) -> FileIO | None:
    """Open another file of the same name once it is not empty; until then the old one may grow."""
    with suppress(FileNotFoundError):
        now = path.stat()
        if now.st_size > 0 and not os.path.samestat(now, os.fstat(file.fileno())):
            return _open(path)
    return None


def _serial(port: str, baud: int) -> Iterator[Piece]:
    """Read in a thread, so that nothing is lost during fits; reopen an unplugged port."""
    try:
        import serial
    except ImportError:
        raise InputError("a serial port needs pyserial: pip install 'motor-env[live]'") from None
    try:
        device = serial.serial_for_url(port, baud, timeout=_PAUSE_S)
    except (serial.SerialException, ValueError) as error:
        reason = os.strerror(error.errno).lower() if isinstance(error, OSError) and error.errno else error
        raise InputError(f"serial port {port}: {reason}") from None
    waiting = _BoundedQueue()

    def read() -> None:
        while True:
            try:
                device.open() if not device.is_open else None
                waiting.offer(device.read(device.in_waiting or 1))
            except (OSError, TypeError):  # TypeError: pyserial's, of a port that closes while it is read
                if device.is_open:
                    device.close()
                    waiting.offer(Notice("unplugged", f"serial port {port} is gone; it is tried again"))
                time.sleep(_PAUSE_S)

    threading.Thread(target=read, daemon=True).start()
    return _from(waiting)


class _Broker(NamedTuple):
    host: str
    port: int
    topic: str
    user: str
    password: str


def _broker(url: str) -> _Broker:
    try:
        parts = urlsplit(url)
        port, topic = parts.port or 1883, unquote(parts.path.removeprefix("/"))
    except ValueError:
        parts, port, topic = urlsplit(""), 0, ""
    if not parts.hostname or not topic:  # not quoted: it may hold a password
        raise InputError(
            "MQTT needs mqtt://HOST/TOPIC or mqtt://USER:PASSWORD@HOST:PORT/TOPIC (in a password write / as %2F,"
            " # as %23, ? as %3F)"
        )
    return _Broker(parts.hostname, port, topic, unquote(parts.username or ""), unquote(parts.password or ""))


def _mqtt(broker: _Broker) -> Iterator[Piece]:
    try:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError:
        raise InputError("MQTT needs paho-mqtt: pip install 'motor-env[live]'") from None
    waiting = _BoundedQueue()
    client = Client(CallbackAPIVersion.VERSION2)
    if broker.user:
        client.username_pw_set(broker.user, broker.password)

    def subscribe(*arguments: Any) -> None:
        if arguments[3].is_failure:
            waiting.offer(Notice("unplugged", f"{broker.host} refuses: {arguments[3]}".lower()))
        else:
            client.subscribe(broker.topic, qos=1)

    client.on_connect = subscribe
    client.on_message = lambda *arguments: waiting.offer(bytes(arguments[2].payload).rstrip(b"\r\n") + b"\n")
    client.on_disconnect = lambda *_: waiting.offer(Notice("unplugged", f"{broker.host} is gone"))
    try:
        client.connect(broker.host, broker.port)
    except OSError as error:
        raise InputError(f"{broker.host}:{broker.port}: {(error.strerror or str(error)).lower()}") from None
    client.loop_start()
    return _from(waiting)


class _BoundedQueue(queue.Queue[Piece | None]):
    """Bounded queue of pieces for a slow watch, which counts the discarded ones."""

    def __init__(self) -> None:
        self._bytes, self._lost = 0, 0
        super().__init__(_MOST_WAITING_BYTES)

    def offer(self, piece: Piece) -> None:
        try:
            if self._lost:
                words = f"{self._lost} parts of lines came faster than they could be judged"
                self.put_nowait(Notice("lost", words))
                self._lost = 0
            self.put_nowait(piece)
        except queue.Full:
            self._lost += 1

    def _put(self, item: Piece | None) -> None:
        self._bytes += _size(item)
        super()._put(item)

    def _get(self) -> Piece | None:
        item: Piece | None = super()._get()
        self._bytes -= _size(item)
        return item

    def _qsize(self) -> int:
        return self._bytes


def _size(item: Piece | None) -> int:
    return _PIECE_BYTES + (len(item) if isinstance(item, bytes) else 0)


def _from(waiting: queue.Queue[Piece | None]) -> Iterator[Piece]:
    piece: Piece | None = b""
    while piece is not None:
        yield piece
        try:
            piece = waiting.get(timeout=1.0)
        except queue.Empty:
            piece = b""
