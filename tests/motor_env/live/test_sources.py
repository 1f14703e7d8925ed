"""Where lines come from: a serial port (a pty), MQTT (a real mosquitto), a growing file."""

import os
import shutil
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from motor_env import InputError
from motor_env.live import sources
from motor_env.live.sources import SILENCE, Notice, Piece, lines, source

WAIT_S = 20.0


def opened(name: str | None, *, follow: bool = False, offset: int = 0) -> Iterator[Piece]:
    return lines(source(name, follow=follow, offset=offset, baud=115_200))


def test_lines_are_whole_whatever_the_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(lines(iter([b"a", b"b\nc\n\nd", b"", b"e"]))) == [b"ab\n", b"c\n", b"\n", b"de"]
    assert list(lines(iter([b"a\nb"]), rest=False)) == [b"a\n"]
    gone = Notice("unplugged", "gone")
    assert list(lines(iter([b"a\nhal", gone, b"b\n"]))) == [b"a\n", gone, b"b\n"]
    monkeypatch.setattr(sources, "SILENCE_S", -1.0)
    assert list(lines(iter([b"a\n", b"", b"", b"b\n", b""]))) == [b"a\n", SILENCE, b"b\n", SILENCE]


def test_a_file_that_grows_and_one_that_begins_anew(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(b"one\ntwo\n")
    assert list(opened(str(log), offset=4)) == [b"two\n"]
    heard = opened(str(log), follow=True)
    assert [next(heard), next(heard)] == [b"one\n", b"two\n"]
    with log.open("ab") as file:
        file.write(b"three\n")
    assert next(heard) == b"three\n"
    log.write_bytes(b"new\n")
    told = next(heard)
    assert isinstance(told, Notice)
    assert told.kind == "new_file"
    assert next(heard) == b"new\n"


def test_a_serial_port_and_its_cable() -> None:
    pytest.importorskip("serial", reason="pyserial is not installed")
    master, slave = os.openpty()
    tty.setraw(slave)
    heard = opened(f"serial:{os.ttyname(slave)}")
    sent = [f"{k},12,0.1,500\n".encode() for k in range(2_000)]  # more than the port's own buffer holds
    for line in sent:
        os.write(master, line)
    assert [next(heard) for _ in sent] == sent
    os.close(slave)
    os.close(master)
    told = next(heard)
    assert isinstance(told, Notice)
    assert told.kind == "unplugged"
    with pytest.raises(InputError, match="serial port /dev/none: no such file or directory"):
        opened("serial:/dev/none")


@pytest.fixture
def broker(tmp_path: Path) -> list[str]:
    """Command that starts a mosquitto, and its port."""
    pytest.importorskip("paho.mqtt", reason="paho-mqtt is not installed")
    program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        pytest.skip("mosquitto is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "m.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n", encoding="utf-8")
    return [program, "-c", str(tmp_path / "m.conf"), str(port)]


def started(broker: list[str]) -> subprocess.Popen[bytes]:
    running = subprocess.Popen(broker[:3], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + WAIT_S
    while time.monotonic() < until:
        try:
            socket.create_connection(("127.0.0.1", int(broker[3])), 1.0).close()
        except OSError:
            time.sleep(0.05)
        else:
            break
    return running


def test_mqtt_from_a_real_broker(broker: list[str]) -> None:
    from paho.mqtt import publish

    port = int(broker[3])

    def publish_until_heard(heard: Iterator[Piece], payload: str) -> Piece:
        """A subscription takes a moment."""
        until = time.monotonic() + WAIT_S
        pieces: list[Piece] = []
        while time.monotonic() < until and not pieces:
            publish.single("plant/motor", payload, hostname="127.0.0.1", port=port)
            pieces = [piece for piece in (next(heard),) if piece]
        return pieces[0]

    url = f"mqtt://127.0.0.1:{port}/plant/motor"
    with pytest.raises(InputError, match="refused"):
        opened(url)
    running = started(broker)
    try:
        heard = source(url, follow=False, offset=0, baud=0)
        assert publish_until_heard(heard, "1,2,3,4\n5,6,7,8") == b"1,2,3,4\n5,6,7,8\n"
        running.kill()
        running.wait()
        told = next(piece for piece in heard if isinstance(piece, Notice))
        assert told.kind == "unplugged"
        running = started(broker)
        assert publish_until_heard(heard, "9,9,9,9") == b"9,9,9,9\n"
    finally:
        running.kill()
        running.wait()
    with pytest.raises(InputError, match="mqtt://HOST/TOPIC"):
        opened("mqtt://127.0.0.1")
