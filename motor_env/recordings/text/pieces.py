"""The block of numbers in a text file of any length: read in pieces, neighbours averaged so that memory holds them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.text.block import CUT_OFF, Form, form_of, parsed, parsed_cell_by_cell
from motor_env.recordings.text.settings import Block, Table

MOST_ROWS = 4_000_000
_AT_ONCE = 2  # pieces: pandas lets other threads run while it parses
_HEAD_BYTES, _TAIL_BYTES, _PIECE_BYTES = 2_000_000, 65_536, 8_000_000


def large_block(path: Path, most: int = MOST_ROWS) -> Table:
    """The block of numbers in a file that begins and ends as text.

    Args:
        path: of the file.
        most: number of rows beyond which neighbours are averaged.

    Raises:
        InputError: there is no block, it tells the time by a clock, or a cell in it is no number.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).rpartition(b"\n")[0]
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(_TAIL_BYTES, size), os.SEEK_END)
        tail = file.read().partition(b"\n")[2]
        if not head or not tail or b"\0" in head:
            raise InputError(f"{path}: is no text with lines; only plain text may be so large")
        last = tail.decode("utf-8-sig", "replace").splitlines()
        first = head.decode("utf-8-sig", "replace").splitlines()
        has_end = tail.endswith((b"\n", b"\r"))
        block, form = form_of(path, [*first, *last], has_end)
        if block.clocks:
            raise InputError(f"{path}: so large a file needs its time in seconds, or --sampling-rate HZ")
        rows = size / (len(tail) / len(last))
        factor = max(int(np.ceil(rows / most)), 1)
        begin = block.table.lines[block.first]
        file.seek(0)
        for _ in range(begin - 1):
            file.readline()
        values = means(_values(file, block, form), factor)
    return form.table(block, values, range(begin, begin + len(values) * factor, factor), factor)


def _values(file: BinaryIO, block: Block, form: Form) -> Iterator[FloatArray]:
    """The numbers of each piece, shape (rows, columns); several are parsed at once."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        waiting: deque[Future[FloatArray]] = deque()
        for piece, line, rows in _pieces(file, block, form):
            waiting.append(pool.submit(_numbers, block, form, piece, line, rows))
            if len(waiting) > _AT_ONCE:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _pieces(file: BinaryIO, block: Block, form: Form) -> Iterator[tuple[bytes, int, int]]:
    """Whole lines, the number of the first in the file, and how many they are."""
    line = block.table.lines[block.first]
    while piece := file.read(_PIECE_BYTES) + file.readline():
        if CUT_OFF in form.remarks and not piece.endswith(b"\n"):
            piece = piece.rpartition(b"\n")[0]
        piece = piece.replace(b" -> ", form.arrow.encode()) if form.arrow else piece
        ends = int(np.count_nonzero(np.frombuffer(piece, np.uint8) == ord("\n")))
        rows = ends if piece.endswith(b"\n") else ends + 1
        yield piece, line, rows
        line += rows


def _numbers(block: Block, form: Form, piece: bytes, line: int, rows: int) -> FloatArray:
    values = parsed(block, piece, rows)
    if values is None:
        lines = piece.decode("utf-8", "replace").splitlines()
        values, _ = parsed_cell_by_cell(block, lines, form.names, line)
    return values


def means(parts: Iterable[FloatArray], factor: int) -> FloatArray:
    """Means of neighbouring rows of all parts, the last incomplete ones left out, shape (rows, columns)."""
    found, rest = [], None
    for part in parts:
        values = part if rest is None else np.concatenate([rest, part])
        whole = len(values) // factor * factor
        sums = np.add.reduceat(values[:whole], np.arange(0, whole, factor)) if factor > 1 else values
        found.append(sums / factor)
        rest = values[whole:]
    return np.concatenate(found)
