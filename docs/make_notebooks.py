"""Runs the pages of docs/notebooks and writes each with its output beside it, as .ipynb: `make notebooks`.

tests/test_docs.py says when one is stale.
"""

from pathlib import Path

import nbformat
from myst_nb.core.read import read_myst_markdown_notebook
from nbclient import NotebookClient

for page in (Path(__file__).parent / "notebooks").glob("*.md"):
    notebook = read_myst_markdown_notebook(page.read_text(encoding="utf-8"))
    NotebookClient(
        notebook, timeout=600, record_timing=False, resources={"metadata": {"path": page.parent}}
    ).execute()
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"  # nbformat draws it anew each time
        if "outputs" in cell:  # but for what is said at a first use, such as how long compiling takes
            cell["outputs"] = [each for each in cell["outputs"] if each.get("name") != "stderr"]
    nbformat.write(notebook, page.with_suffix(".ipynb"))
