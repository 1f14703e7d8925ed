"""A value that may be None, and is not: for types that say less than the test knows."""

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    assert value is not None
    return value
