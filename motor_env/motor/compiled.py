"""Functions compiled by numba, kept in its cache where that works: a broken cache costs time, never a command."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import numba
from numba.core.caching import FunctionCache


@cache
def _say_once() -> None:
    """One line a process: `cache` swallows the repetitions."""
    sys.stderr.write("numba's cache cannot be read or written: compiling without it\n")


class _ForgivingCache(FunctionCache):
    """numba's cache of a function; where a file of it cannot be read or written, there is none."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for these types; None where it has to be compiled."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001  # a damaged file can raise anything
            _say_once()
            with suppress(OSError):
                self.flush()  # so that the next process finds a whole one
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled function."""
        try:
            super().save_overload(sig, data)
        except Exception:  # noqa: BLE001  # see above
            _say_once()


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with a cache that may fail."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cache:
            try:
                dispatcher._cache = _ForgivingCache(function)  # noqa: SLF001  # as its enable_caching() does
            except RuntimeError:  # neither the package's folder nor the user's can be written
                _say_once()
        return dispatcher

    return compiled
