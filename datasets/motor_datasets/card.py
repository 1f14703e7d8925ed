"""The card of a data set: README.md with the YAML header that Hugging Face reads."""

from __future__ import annotations

from motor_datasets.describe import describe
from motor_datasets.manifest import Manifest


def data_card(manifest: Manifest) -> str:
    """Markdown of the card."""
    rows: dict[str, int] = {}
    for entry in manifest.files:
        rows[entry.split] = rows.get(entry.split, 0) + entry.rows
    configs = "\n".join(f"  - split: {name}\n    path: data/{name}-*.parquet" for name in rows)
    counts = "\n".join(f"| {name} | {count} |" for name, count in rows.items())
    return f"""---
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

Simulated start-up transients with their labels, seed {manifest.seed}. One row a case; samples are lists of float32 in
`current_a` and, where measured, `speed_rad_s`. No motor stands in two splits.

| split | cases |
|---|---|
{counts}

## What is sampled

```
{describe(manifest.recipe)}
```

Read it with `motor_datasets.load`, pandas, polars, DuckDB, pyarrow, or `datasets.load_dataset` on this folder.
`dataset.json` holds recipe, seed and the digest of every file; `motor-datasets verify` checks them.
"""
