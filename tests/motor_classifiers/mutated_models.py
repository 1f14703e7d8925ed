"""Model files of strangers, each from its number: damaged, or forged by one who knows the format."""

import io
import json
import zipfile
from typing import Any

import numpy as np
from hostile import archive_of, damaged, forged, json_of, members_of
from safetensors.numpy import load
from saved_models import QUICK, content, head_of, with_head

NAMES = ("threshold", "residual-qda", "physical-logistic", "rules", *QUICK)
SEED = 21


def forged_array(values: Any, rng: np.random.Generator) -> Any:
    """An array of another size, type or content."""
    kind = int(rng.integers(5))
    if kind == 0:
        return values[: len(values) // 2] if values.ndim else np.zeros(3)
    if kind == 1:
        return np.concatenate([values, values]) if values.ndim else values[None]
    if kind == 2 and values.dtype.kind in "fiub":
        return values.astype(rng.choice(["float32", "int64", "int32", "uint8", "float64"]))
    if kind == 3:
        return values.reshape(-1)[::-1].reshape(values.shape)
    changed = values.copy().reshape(-1)
    field = changed if values.dtype.names is None else changed[str(rng.choice(list(values.dtype.names)))]
    if field.size:
        wild = rng.choice(np.array([0.0, -1.0, 1e6, 2.0**31 - 1.0, np.nan, np.inf]))
        with np.errstate(invalid="ignore"):
            field[int(rng.integers(field.size))] = np.array(wild).astype(field.dtype)
    return changed.reshape(values.shape)


def forged_model(file: bytes, rng: np.random.Generator) -> bytes:
    """What a stranger does: a file that is whole, and says something else."""
    if not zipfile.is_zipfile(io.BytesIO(file)):
        if rng.random() < 0.5:
            return with_head(file, forged(head_of(file), rng))
        name, values = sorted(load(file).items())[int(rng.integers(len(load(file))))]
        return with_head(file, head_of(file), **{name: forged_array(values, rng).copy()})
    members = members_of(file)
    name = str(rng.choice(sorted(members))) if rng.random() < 0.5 else "schema.json"
    if name.endswith(".json"):
        members[name] = json_of(forged(json.loads(members[name]), rng)).encode()
    else:
        buffer = io.BytesIO()
        np.save(buffer, forged_array(np.load(io.BytesIO(members[name])), rng))
        members[name] = buffer.getvalue()
    return archive_of(members)


def mutated(number: int) -> tuple[str, bytes]:
    """A file by its number; it follows from the seed and the number alone."""
    rng = np.random.default_rng([SEED, number])
    name = NAMES[number % len(NAMES)]
    file = content(name)
    # Half of the damage in the first bytes, where the header of a tensor file is.
    changed = damaged(file, rng, focus=range(3000)) if number % 2 else forged_model(file, rng)
    return f"{number:03d}-{'damaged' if number % 2 else 'forged'}-{name}", changed
