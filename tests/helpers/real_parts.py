"""Programs that some tests run: they skip where one is missing, and fail where they must run."""

import os
import shutil

import pytest


def installed(*names: str, package: str) -> str:
    """Path of the first of these programs; where none is, skip, or fail if MOTOR_ENV_REAL_PARTS is set, as on CI."""
    path = f"{os.environ['PATH']}:/usr/sbin"
    found = next(filter(None, (shutil.which(name, path=path) for name in names)), None)
    if found is None:
        missing = f"{' or '.join(names)} is not installed: `apt-get install {package}`"
        if os.environ.get("MOTOR_ENV_REAL_PARTS"):
            pytest.fail(missing)
        pytest.skip(missing)
    return found
