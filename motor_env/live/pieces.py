"""What a source gives, the lines in it, and what is said where none come."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

NEW_FILE = "new_file"
SILENCE_S = 5.0
LONGEST_LINE = 1 << 16
BLOCK_BYTES = 512
"""By so many bytes before its place a reader sees that a file is still the one that it has read."""


@dataclass(frozen=True, slots=True)
class Notice:
    """What a source has to say beside lines: kind (silence, unplugged, lost, new_file), and words."""

    kind: str
    text: str


Piece = bytes | Notice
SILENCE = Notice("silence", f"no line for {SILENCE_S:g} s: is the cable in?")


def lines(pieces: Iterator[Piece], *, rest: bool = True) -> Iterator[Piece]:
    """Whole lines of pieces; SILENCE once where none come for a while.

    What is longer than LONGEST_LINE comes in parts, of which only the last one ends with a line end.

    Args:
        pieces: of a source.
        rest: whether what follows the last line end is a line, too.
    """
    left, heard_s, is_silent = bytearray(), time.monotonic(), False
    for piece in pieces:
        if isinstance(piece, Notice):
            left.clear()
            yield piece
            heard_s, is_silent = time.monotonic(), piece.kind == "unplugged"
            continue
        left += piece
        if b"\n" in piece:
            *whole, left = left.split(b"\n")
            yield from (bytes(line) + b"\n" for line in whole)
            heard_s, is_silent = time.monotonic(), False  # now: a window may have been judged meanwhile
        if len(left) > LONGEST_LINE:
            yield bytes(left)
            left.clear()
        if not is_silent and time.monotonic() - heard_s > SILENCE_S:
            is_silent = True
            yield SILENCE
    if left and rest:
        yield bytes(left)
