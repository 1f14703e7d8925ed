"""Where lines come from: a serial port (a pty), MQTT (a real mosquitto), a growing file."""

import os
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import hostile
import pytest
from real_parts import installed

from motor_env import InputError
from motor_env.diagnosis.streaming import sources
from motor_env.diagnosis.streaming.sources import SILENCE, Notice, Piece, identity, lines, source

WAIT_S = 20.0


def opened(name: str | None, *, follow: bool = False) -> Iterator[Piece]:
    return lines(source(name, follow=follow, baud=115_200))


def test_lines_are_whole_whatever_the_pieces() -> None:
    assert list(lines(iter([b"a", b"b\nc\n\nd", b"", b"e"]))) == [b"ab\n", b"c\n", b"\n", b"de"]
    assert list(lines(iter([b"a\nb"]), rest=False)) == [b"a\n"]
    gone = Notice("unplugged", "gone")
    assert list(lines(iter([b"a\nhal", gone, b"b\n"]))) == [b"a\n", gone, b"b\n"]


def told(heard: Iterator[Piece], kind: str, words: str = "") -> None:
    """The next piece is a notice of this kind."""
    notice = next(heard)
    assert isinstance(notice, Notice)
    assert notice.kind == kind
    assert words in notice.text


def test_a_log_that_is_rotated_is_read_to_its_end_and_then_the_new_one(tmp_path: Path) -> None:
    log, old = tmp_path / "log.csv", tmp_path / "log.1"
    log.write_bytes(b"one\ntwo\n")
    heard = opened(str(log), follow=True)
    assert [next(heard), next(heard)] == [b"one\n", b"two\n"]
    log.rename(old)
    with old.open("ab") as file:
        file.write(b"three\n")
    assert next(heard) == b"three\n"
    log.touch()  # as logrotate makes it, before the logger is told
    with old.open("ab") as file:
        file.write(b"four\n")
    assert next(heard) == b"four\n"
    log.write_bytes(b"new\n")
    told(heard, "new_file", "is another file now")
    assert next(heard) == b"new\n"
    log.write_bytes(b"a\n")
    told(heard, "new_file")
    assert next(heard) == b"a\n"
    heard.close()  # type: ignore[attr-defined]  # a generator


@pytest.mark.parametrize("old", [b"one\ntwo\n", b"12345678\n" * 60_000], ids=["small", "pieces"])
def test_a_log_written_anew_in_its_place_is_new_however_long_it_is(tmp_path: Path, old: bytes) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(old)
    heard = opened(str(log), follow=True)
    assert b"".join(piece for _ in old.splitlines() if isinstance(piece := next(heard), bytes)) == old
    log.write_bytes(b"new\n" + old)
    told(heard, "new_file", "is not the same file as before")
    assert next(heard) == b"new\n"
    assert next(heard) == old[: old.index(b"\n") + 1]


def test_a_log_that_is_gone_on_with_must_be_the_one_that_was_read(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(b"one\ntwo\nthree\n")
    heard = lines(source(str(log), follow=False, baud=0, offset=4, last_read=b"one\n"))
    assert list(heard) == [b"two\n", b"three\n"]
    for offset, last_read in ((4, b"ONE\n"), (20, b"x" * 20), (2**62, b"x" * 512)):
        heard = lines(source(str(log), follow=False, baud=0, offset=offset, last_read=last_read))
        told(heard, "new_file", "is not the same file as before")
        assert list(heard) == [b"one\n", b"two\n", b"three\n"]


def test_a_log_is_a_regular_file(tmp_path: Path) -> None:
    for path in hostile.odd_places(tmp_path / "log.csv"):
        for follow in (False, True):
            hostile.refused(partial(next, opened(str(path), follow=follow)), path)


def test_a_standard_input_that_cannot_be_read_ends_the_watch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(InputError, match="standard input is closed"):
        opened(None)
    with (tmp_path / "written").open("w", encoding="utf-8") as written:
        monkeypatch.setattr("sys.stdin", written)
        with pytest.raises(InputError, match="standard input: bad file descriptor"):
            opened(None)


def test_silence_is_said_where_bytes_come_but_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "SILENCE_S", -1.0)
    assert list(lines(iter([b"x", b"x"]), rest=False)) == [SILENCE]
    new = Notice("new_file", "shrunk")
    assert list(lines(iter([new, b""]))) == [new, SILENCE]
    gone = Notice("unplugged", "gone")
    assert list(lines(iter([gone, b""]))) == [gone]


def test_what_comes_faster_than_it_is_judged_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_MOST_WAITING_BYTES", 2_000)
    waiting = sources._BoundedQueue()
    for k in range(30):
        waiting.offer(b"%02d\n" % k + b"x" * 97)
    heard = sources._from(waiting)
    assert next(heard) == b""
    assert [next(heard)[:2] for _ in range(10)] == [b"%02d" % k for k in range(10)]  # type: ignore[index]
    waiting.offer(b"a\n")
    waiting.offer(b"b\n")
    assert next(heard) == Notice("lost", "20 parts of lines came faster than they could be judged")
    waiting.put(None)
    assert list(heard) == [b"a\n", b"b\n"]  # it is told once


@pytest.mark.parametrize(
    "url",
    [
        "mqtt://me:SECRET@127.0.0.1:1/topic",
        "mqtt://me:SECRET@127.0.0.1",
        "mqtt://me:SECRET\u2100@host/topic",
        "mqtt://me:SECRET@[host/topic",
    ],
)
def test_no_password_is_said(url: str) -> None:
    pytest.importorskip("paho.mqtt", reason="paho-mqtt is not installed")
    with pytest.raises(InputError) as refusal:
        opened(url)
    assert "SEC" not in str(refusal.value)


def test_what_is_watched_has_a_name_without_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert identity("mqtt://me:SECRET@host/a/b%2Fc") == "mqtt://host:1883/a/b/c"
    assert identity("mqtt://host:1884/a") == "mqtt://host:1884/a"
    monkeypatch.chdir(tmp_path)
    assert identity("log.csv") == identity(str(tmp_path / "log.csv")) == str(tmp_path / "log.csv")
    assert (identity("serial:/dev/tty"), identity(None)) == ("serial:/dev/tty", "standard input")


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
    told(heard, "unplugged")
    with pytest.raises(InputError, match="serial port /dev/none: no such file or directory"):
        opened("serial:/dev/none")


@pytest.fixture
def broker(tmp_path: Path) -> list[str]:
    """Command that starts a mosquitto, and its port."""
    pytest.importorskip("paho.mqtt", reason="paho-mqtt is not installed")
    program = installed("mosquitto", package="mosquitto")
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
        heard = source(url, follow=False, baud=0)
        assert publish_until_heard(heard, "1,2,3,4\n5,6,7,8") == b"1,2,3,4\n5,6,7,8\n"
        running.kill()
        running.wait()
        assert next(piece for piece in heard if isinstance(piece, Notice)).kind == "unplugged"
        running = started(broker)
        assert publish_until_heard(heard, "9,9,9,9") == b"9,9,9,9\n"
    finally:
        running.kill()
        running.wait()
    with pytest.raises(InputError, match="mqtt://HOST/TOPIC"):
        opened("mqtt://127.0.0.1")


def test_a_broker_that_refuses_is_told_without_the_password(broker: list[str]) -> None:
    Path(broker[2]).write_text(f"listener {broker[3]} 127.0.0.1\nallow_anonymous false\n", encoding="utf-8")
    running = started(broker)
    try:
        heard = source(f"mqtt://me:SECRET@127.0.0.1:{broker[3]}/plant", follow=False, baud=0)
        said = next(piece for piece in heard if isinstance(piece, Notice))
    finally:
        running.kill()
        running.wait()
    assert said == Notice("unplugged", "127.0.0.1 refuses: not authorized")
