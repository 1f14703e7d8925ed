"""Description of a data set: its card for Hugging Face, Croissant, and the recipe in words and pictures."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from motor_datasets.arrays import Column, columns
from motor_datasets.manifest import Manifest
from motor_env.simulation.disturbances import PER_MOTOR
from motor_env.simulation.recipes import FACTORS, Recipe


def describe(recipe: Recipe) -> str:
    """Describe what the recipe samples, a line for each quantity."""
    timing, sensor = recipe.timing, recipe.sensor
    lines = [f"recipe {recipe.name}", "motor"]
    lines += [f"  {f.name} = {getattr(recipe.motor, f.name):g}" for f in fields(recipe.motor)]
    duty, level = recipe.duty, f"{recipe.supply.voltage_v:g} V"
    if duty is None:
        lines.append(f"supply: step to {level}")
    else:
        lines.append(f"supply: up to {level}, each of these profiles as often: {', '.join(duty.profiles)}")
        lines.append("  hold_s: {:g} to {:g}, log-uniform, each start".format(*duty.hold_s))
    lines.append("relative standard deviations (supply: each start; the others: each motor)")
    lines += [f"  {name}: {100.0 * getattr(recipe.spread, name):g} %" for name in FACTORS]
    lines.append("classes")
    for fault_class, share in zip(recipe.classes, recipe.class_probabilities, strict=True):
        ranges = [
            f"{part.kind} {100 * part.severity:g} %"
            + ("" if part.severity_to is None else f" to {100 * part.severity_to:g} %")
            for part in fault_class.parts
            if part.kind is not None
        ]
        lines.append(f"  {fault_class.name}: {100 * share:.3g} %" + "".join(f", {text}" for text in ranges))
    lines.append(
        f"starts of each motor: {recipe.starts_per_motor}; healthy reference starts among them: {recipe.healthy_starts}"
    )
    lines.append(
        f"samples: {timing.n_samples} at {timing.sampling_rate_hz:g} Hz, {timing.quiet_s:g} s before the step"
        f" and {timing.duration_s:g} s after it"
    )
    lines.append(f"channels: {', '.join(recipe.channels)}; current noise {sensor.current_noise_a:g} A")
    if "speed" in sensor.channels:
        lines.append(f"speed noise {sensor.speed_noise_rad_s:g} rad/s")
    if recipe.field is not None:
        lines.append("field (uniform; torques relative to the viscous torque at no-load speed)")
        for name, (low, high) in recipe.priors.items():
            lines.append(f"  {name}: {low:g} to {high:g}, each {'motor' if name in PER_MOTOR else 'start'}")
        for name in ("ripple_hz", "sensor_lag_s", "sensor_range_a", "adc_bits", "missing_fraction"):
            lines.append(f"  {name} = {getattr(recipe.field, name):g}")
    if recipe.shifts:
        lines.append(f"shifts: {', '.join(shift.name for shift in recipe.shifts)}")
    lines.append("columns of its data sets")
    for column in columns(recipe):
        unit = f" [{column.unit}]" if column.unit else ""
        lines.append(f"  {column.name}{unit}: {column.meaning}")
    return "\n".join(lines)


def draw_sheet(recipe: Recipe, seed: int, path: Path) -> None:
    """Draw four examples of each class, the current over time: the start above, the settled level below.

    Raises:
        OSError: the picture cannot be written.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from motor_datasets.generate import generate_arrays

    data = generate_arrays(recipe, seed, 80 * len(recipe.classes))
    figure = Figure(figsize=(2.2 * len(recipe.classes) + 1.0, 5.0), layout="constrained")
    axes = figure.subplots(2, len(recipe.classes), sharex="row", sharey="row", squeeze=False)
    time_ms = 1e3 * data.time_s
    late = time_ms > 0.5 * time_ms[-1]
    for column, name in enumerate(data.class_names):
        rows = np.flatnonzero(data.class_name == name)[:4]
        axes[0, column].set_title(name.replace("_", " "), fontsize=9)
        for row in rows:
            axes[0, column].plot(time_ms, data.X[row, 0], linewidth=0.8)
            axes[1, column].plot(time_ms[late], data.X[row, 0][late], linewidth=0.6)
        axes[1, column].set_xlabel("time / ms")
    quantity = "current / A" if recipe.sensor.channels[0] == "current" else "speed / (rad/s)"
    for axis in axes[:, 0]:
        axis.set_ylabel(quantity)
    axes[0, 0].set_xlim(time_ms[0], min(25.0, time_ms[-1]))
    figure.savefig(path, dpi=120)


LICENSE = "https://spdx.org/licenses/MIT.html"
"""Licence of generated data: that of the package."""

_TERMS = (
    "citeAs column equivalentProperty extract field fileObject fileProperty fileSet format includes isLiveDataset"
    " jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate separator source"
    " subField transform"
)
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
}
_CONTEXT |= sorted(
    {
        **{term: f"cr:{term}" for term in _TERMS.split()},
        "conformsTo": "dct:conformsTo",
        "data": {"@id": "cr:data", "@type": "@json"},
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
        "examples": {"@id": "cr:examples", "@type": "@json"},
    }.items()
)
"""JSON-LD context that every Croissant 1.0 file has."""
_TYPES = {"text": "sc:Text", "whole": "sc:Integer", "number": "sc:Float", "samples": "sc:Float"}


def data_card(manifest: Manifest) -> str:
    """Return the card as Markdown."""
    rows: dict[str, int] = {}
    for entry in manifest.files:
        rows[entry.split] = rows.get(entry.split, 0) + entry.rows
    configs = "\n".join(f"  - split: {name}\n    path: data/{name}-*.parquet" for name in rows)
    counts = "\n".join(f"| {name} | {count} |" for name, count in rows.items())
    table = "\n".join(f"| `{c.name}` | {c.kind} | {c.unit} | {c.meaning} |" for c in columns(manifest.recipe))
    total = sum(rows.values())
    driven = "" if manifest.recipe.duty is None else ", and `applied_voltage_v`"
    return f"""---
license: mit
size_categories:
- {_size_category(total)}
pretty_name: DC motor transients, recipe {manifest.recipe.name}
task_categories:
- tabular-classification
tags:
- time-series
- fault-detection
- simulation
configs:
- config_name: default
  data_files:
{configs}
---

# DC motor transients, recipe `{manifest.recipe.name}`

Simulated {_subject(manifest)} with their labels, seed {manifest.seed}. One row a case; samples are lists of float32 in
`current_a` and, where measured, `speed_rad_s`{driven}. No motor stands in two splits. {total} cases in
{len(manifest.files)} files, {manifest.bytes / 1e6:.1f} MB. License: MIT, that of the package that made them.

| split | cases |
|---|---|
{counts}

## Columns

| column | kind | unit | meaning |
|---|---|---|---|
{table}

## What is sampled

```
{describe(manifest.recipe)}
```

Read it with `motor_datasets.load`, pandas, polars, DuckDB, pyarrow, or `datasets.load_dataset` on this folder.
`dataset.json` holds recipe, seed and the digest of every file; `motor-datasets verify` checks them. `croissant.json`
says the same to whoever reads Croissant.
"""


def _subject(manifest: Manifest) -> str:
    return "start-up transients" if manifest.recipe.duty is None else "records of motors at work"


def _size_category(count: int) -> str:
    bounds = {10**3: "n<1K", 10**4: "1K<n<10K", 10**5: "10K<n<100K", 10**6: "100K<n<1M", 10**7: "1M<n<10M"}
    return next((name for bound, name in bounds.items() if count < bound), "n>10M")


def croissant(manifest: Manifest) -> str:
    """Return the text of `croissant.json`: every file with its digest, and one set of records a file."""
    recipe = manifest.recipe
    name = f"motor-{recipe.name}-{manifest.seed}"
    files = [
        {
            "@type": "cr:FileObject",
            "@id": entry.path,
            "name": entry.path,
            "contentUrl": entry.path,
            "contentSize": f"{entry.bytes} B",
            "encodingFormat": "application/x-parquet",
            "sha256": entry.sha256,
        }
        for entry in manifest.files
    ]
    records = [
        {
            "@type": "cr:RecordSet",
            "@id": entry.path.removeprefix("data/").removesuffix(".parquet"),
            "name": entry.path.removeprefix("data/").removesuffix(".parquet"),
            "description": f"{entry.rows} cases of split {entry.split}.",
            "field": [_field(entry.path, column) for column in columns(recipe)],
        }
        for entry in manifest.files
    ]
    content = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": name,
        "description": f"Simulated {_subject(manifest)} of DC motors with faults, recipe {recipe.name}.",
        "license": LICENSE,
        "version": "1.0.0",
        "citeAs": f"motor-env, recipe {recipe.name}, seed {manifest.seed}, {manifest.cases} cases",
        "distribution": files,
        "recordSet": records,
    }
    return json.dumps(content, indent=1) + "\n"


def _field(path: str, column: Column) -> dict[str, Any]:
    record = path.removeprefix("data/").removesuffix(".parquet")
    unit = f", in {column.unit}" if column.unit not in ("", "1") else ""
    source = {"fileObject": {"@id": path}, "extract": {"column": column.name}}
    field = {
        "@type": "cr:Field",
        "@id": f"{record}/{column.name}",
        "name": f"{record}/{column.name}",
        "description": f"{column.meaning}{unit}",
        "dataType": _TYPES[column.kind],
        "source": source,
    }
    return field | ({"repeated": True} if column.kind == "samples" else {})
