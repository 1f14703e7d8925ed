"""Errors that become one sentence and exit status 2 on the command line."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used; the message is the sentence that the user reads."""


def require_extra(module: str, extra: str) -> None:
    """Raise `InputError` unless the module of an optional extra is installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(f"this needs {module}, which is not installed: pip install 'motor-env[{extra}]'")
