"""The harness of hostile files bites: what it must not let pass fails, and what it makes repeats itself."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hostile import DAMAGES, Child, cuts, damaged, deep, flips, forged, json_of, refused

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


def test_damage_and_forgery_change_the_content_and_repeat_themselves() -> None:
    content = bytes(range(1, 201))
    for kind in DAMAGES:
        first, again = (damaged(content, np.random.default_rng(3), kinds=(kind,)) for _ in range(2))
        assert first == again != content, kind
    assert [len(cut) for cut in cuts(content, 3)] == [0, 99, 199]
    for flipped in flips(content, np.random.default_rng(0), 20, within=range(50, 60)):
        ((at, bits),) = [(n, a ^ b) for n, (a, b) in enumerate(zip(content, flipped, strict=True)) if a != b]
        assert (50 <= at < 60, bits.bit_count()) == (True, 1)
    tree = {"a": [1, 2.5, {"b": "text"}], "c": "[3]"}
    trees = [json_of(forged(tree, np.random.default_rng(n))) for n in range(200)]
    assert len(set(trees) - {json_of(tree)}) > 100
    assert any(deep() in each for each in trees)


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
    given = [("a", b"four"), ("b", b"refuse"), ("c", b"bug"), ("d", b"crash"), ("e", b"again")]
    with Child(read) as child:
        assert child.outcomes(given, tmp_path) == {
            "a": "4",
            "b": "refused",
            "c": "ZeroDivisionError: integer division or modulo by zero",
            "d": "it ended its process with -6",
            "e": "5",
        }
