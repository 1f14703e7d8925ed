"""The harnesses of tests and benchmarks bite: what they must not let pass fails, and a count that was cut goes on."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hostile import (
    ABSURD,
    DAMAGES,
    Child,
    cuts,
    damaged,
    deep,
    flips,
    forged,
    json_of,
    refused,
    refused_or_same,
)
from verdict_tables import How, Said, counted

from motor_env import InputError


def said(sentence: str, status: int = 2, *, error: bool = False) -> Callable[[], int]:
    def call() -> int:
        if error:
            raise InputError(sentence)
        sys.stderr.write(f"{sentence}\n")
        return status

    return call


@pytest.mark.parametrize("error", [False, True])
def test_a_refusal_is_one_sentence_that_names_the_file_and_leaves_nothing(
    tmp_path: Path, error: bool
) -> None:
    path = tmp_path / "a.csv"
    assert refused(said("a.csv: is bad", error=error), path) == "a.csv: is bad"
    assert refused(said("it is bad", error=error), path, named=False) == "it is bad"
    bad = [said(words, error=error) for words in ("", "b.csv is bad")]
    bad += [said("a.csv:\nbad"), said("a.csv" + "x" * 1500)]
    bad += [said("a.csv: is bad", status) for status in (0, 1, 70)]
    bad.append(lambda: (tmp_path / "half").write_text("") + said("a.csv: is bad", error=error)())
    for call in bad:
        with pytest.raises(AssertionError):
            refused(call, path)


def test_what_is_read_instead_is_compared(tmp_path: Path) -> None:
    def same(value: int) -> None:
        assert value == 3

    assert refused_or_same(lambda: 3, tmp_path, same) == ""
    with pytest.raises(AssertionError):
        refused_or_same(lambda: 4, tmp_path, same)
    with pytest.raises(ZeroDivisionError):
        refused_or_same(lambda: 1 // 0, tmp_path, same)


def test_damage_and_forgery_change_the_content_and_repeat_themselves() -> None:
    content = bytes(range(1, 201))
    for kind in DAMAGES:
        first, again = (damaged(content, np.random.default_rng(3), kinds=(kind,)) for _ in range(2))
        assert first == again != content, kind
    assert [len(cut) for cut in cuts(content, 3)] == [0, 99, 199]
    for flipped in flips(content, np.random.default_rng(0), 20, within=range(50, 60)):
        ((at, bits),) = [(n, a ^ b) for n, (a, b) in enumerate(zip(content, flipped, strict=True)) if a != b]
        assert 50 <= at < 60
        assert bits.bit_count() == 1
    tree = {"a": [1, 2.5, {"b": "text"}], "c": "[3]"}
    trees = [json_of(forged(tree, np.random.default_rng(n))) for n in range(200)]
    assert len(set(trees) - {json_of(tree)}) > 100
    assert any(deep() in each for each in trees)
    assert json_of(tree) == '{"a": [1, 2.5, {"b": "text"}], "c": "[3]"}'
    assert len(ABSURD) > 40


def test_a_child_tells_of_crashes_and_of_other_errors(tmp_path: Path) -> None:
    read = """
import os
def read(path):
    text = path.read_text()
    if text == "crash":
        os.abort()
    if text == "refuse":
        raise InputError(f"{path}: no")
    return len(text) if text != "bug" else 1 // 0
"""
    with Child(read) as child:
        found = child.outcomes([("a", b"four"), ("b", b"refuse"), ("c", b"bug")], tmp_path)
        assert found == {
            "a": "4",
            "b": "refused",
            "c": "ZeroDivisionError: integer division or modulo by zero",
        }
        found = child.outcomes([("d", b"crash"), ("e", b"again")], tmp_path)
        assert found == {"d": "it ended its process with -6", "e": "5"}


def judge(number: int) -> Said:
    return [(("of three", str(number % 3)), "odd" if number % 2 else "even")]


def test_a_count_goes_on_from_its_file(tmp_path: Path) -> None:
    rows = tmp_path / "rows.jsonl"
    whole, first = counted(judge, 20), counted(judge, 7, How(rows=rows), of={"seed": 1})
    assert (len(rows.read_text().splitlines()), whole["of three", "0"]) == (7, {"even": 4, "odd": 3})
    assert sum(verdicts.total() for verdicts in first.cells.values()) == 7
    more = counted(judge, 20, How(workers=2, rows=rows), of={"seed": 1})
    assert more.cells == whole.cells == counted(judge, 20, How(rows=rows), of={"seed": 1}).cells
    assert more.by(0) == {("of three",): {"even": 10, "odd": 10}}
    with pytest.raises(ValueError, match="name another file"):
        counted(judge, 20, How(rows=rows), of={"seed": 2})
