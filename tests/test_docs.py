"""The documentation holds: its Python runs, its commands run, its links and pictures are there.

Everything that a page shows as Python runs, block after block in one process, in a folder that holds `examples/`; so
do the cells of the pages that are notebooks. Text right below a block of Python is what the block prints. Commands run
where `<!-- run -->` stands above their block, and print the lines that the block shows below them. A block below
`<!-- not run: reason -->` is left out, and a page with `<!-- long -->` is run by `make test-long`. The package's
commands run in this process: to start one for each would take most of the time.
"""

import doctest
import importlib
import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import words
from PIL import Image, ImageChops

from motor_classifiers.cli.main import main as classifiers
from motor_datasets.cli import main as datasets
from motor_env.cli import main as env

PROGRAMS = {"motor-env": env, "motor-datasets": datasets, "motor-classifiers": classifiers}
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MADE_BY_THE_BUILD = [DOCS / "_build", DOCS / "api"]  # git ignores them
ENVIRONMENTS = sorted(
    (DOCS / "environments").glob("*.md")
)  # tests/test_pictures.py: they are made by a command
PAGES = sorted(
    page
    for page in DOCS.rglob("*.md")
    if page not in ENVIRONMENTS and not set(page.parents) & set(MADE_BY_THE_BUILD)
)
READMES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "motor_env/README.md")]
LINKING = [*READMES, *PAGES, *ENVIRONMENTS]
FENCE = re.compile(
    r"^(?:<!-- (?P<mark>[^>\n]*) -->\n\n?)?^```(?P<language>\w*|\{code-cell\} ipython3)\n"
    r"(?:---\n.*?^---\n)?(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
PYTHON = ("python", "{code-cell} ipython3")
LINK = re.compile(r"!?\[[^\]]*\]\((?!https?:|mailto:)([^)\s]*)\)")
# tests/test_new_fault.py runs it: it registers a kind, which must not stay.
HAS_OWN_TEST = {DOCS / "howto" / "own-fault.md"}


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def script(page: Path) -> str:
    """The page with everything but its Python blanked: a traceback tells the page's own line."""
    text = page.read_text(encoding="utf-8")
    lines = [""] * (text.count("\n") + 1)
    for block in FENCE.finditer(text):
        if block["language"] in PYTHON and not (block["mark"] or "").startswith("not run"):
            first = text.count("\n", 0, block.start("code"))
            for offset, line in enumerate(block["code"].splitlines()):
                lines[first + offset] = line
    return "\n".join(lines).rstrip() + "\n" if any(lines) else ""


def commands(page: Path) -> list[str]:
    """The commands of the blocks that are marked to be run, continued lines joined."""
    blocks = FENCE.finditer(page.read_text(encoding="utf-8"))
    text = "\n".join(
        block["code"]
        for block in blocks
        if block["mark"] == "run" and block["language"] in ("console", "bash")
    )
    lines = text.replace("\\\n", " ").splitlines()
    return [
        line.removeprefix("$ ").split("  #")[0].strip()
        for line in lines
        if line.startswith(("$ motor-", "$ python examples/"))
    ]


def shown(page: Path) -> list[str]:
    """What the blocks that are run, and those of text right below a block of Python, show of the output."""
    text = page.read_text(encoding="utf-8")
    parts = [block["code"] for block in FENCE.finditer(text) if block["mark"] == "run"]
    parts += re.findall(r"^```python\n.*?^```\n\n```text\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "\n".join(parts).replace("\\\n", " ").splitlines()
    return [line for line in lines if line and not line.startswith("$ ") and line.strip() != "..."]


def is_long(page: Path) -> bool:
    return "<!-- long -->" in page.read_text(encoding="utf-8")


def parameters(pages: list[Path]) -> list[object]:
    return [pytest.param(page, id=name(page), marks=[pytest.mark.long] * is_long(page)) for page in pages]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder beside the examples, as the working directory."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", parameters([page for page in PAGES if commands(page) or script(page)]))
def test_page_runs(
    page: Path, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    printed_so_far = ""
    for command in commands(page):
        program, *arguments = shlex.split(command)
        if program == "python":
            subprocess.run([sys.executable, *arguments], cwd=folder, check=True, timeout=300)
            continue
        status = PROGRAMS[program](arguments)
        printed = capsys.readouterr()
        # 1 says that a fault was found: the example motor has one.
        assert status in (0, 1), f"{command}\n{printed.out}{printed.err}"
        assert printed.out, command
        printed_so_far += printed.out
    if page not in HAS_OWN_TEST and (code := script(page)):
        path = folder / (page.stem.replace("-", "_") + "_page.py")
        path.write_text(code, encoding="utf-8")
        if "{code-cell}" in page.read_text(encoding="utf-8"):
            (folder / "docs" / page.parent.name).mkdir(parents=True)
            monkeypatch.chdir(folder / "docs" / page.parent.name)
        runpy.run_path(str(path))
        for drawn in folder.glob("*.png"):  # a picture that the page draws is the one that it shows
            with Image.open(drawn) as new, Image.open(DOCS / "images" / drawn.name) as kept:
                apart = ImageChops.difference(new.convert("L"), kept.convert("L"))
            assert np.mean(np.asarray(apart) > 60) < 0.001, f"{page}: draw {drawn.name} anew"
        plt.close("all")
        printed_so_far += capsys.readouterr().out
    assert [line for line in shown(page) if line.rstrip() not in printed_so_far] == []


@pytest.mark.parametrize("page", sorted((DOCS / "notebooks").glob("*.md")), ids=name)
def test_the_notebooks_with_output_have_the_cells_of_today(page: Path) -> None:
    """`make notebooks` runs them anew."""
    text = re.sub(r"\A---\n.*?^---\n", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    code = [block["code"] for block in FENCE.finditer(text)]
    prose = FENCE.sub("\0", text).split("\0")
    cells = json.loads(page.with_suffix(".ipynb").read_text(encoding="utf-8"))["cells"]
    kept = {
        kind: ["".join(cell["source"]).strip() for cell in cells if cell["cell_type"] == kind]
        for kind in ("code", "markdown")
    }
    assert kept == {
        "code": [each.strip() for each in code],
        "markdown": [each.strip() for each in prose if each.strip()],
    }
    assert sum("image/png" in output.get("data", {}) for cell in cells for output in cell.get("outputs", []))


@pytest.mark.parametrize(
    "module",
    [
        *("motor_env.detection", "motor_env.diagnosis", "motor_env.envs", "motor_env.filters"),
        *(
            "motor_env.diagnosis.estimation",
            "motor_env.inference",
            "motor_env.motor",
            "motor_env.diagnosis.readers",
        ),
        *(
            "motor_env.simulation",
            "motor_env.common.errors",
            "motor_env.diagnosis.prognosis",
            "motor_datasets",
            "motor_classifiers",
        ),
    ],
)
@pytest.mark.usefixtures("folder")
def test_example_of_the_api_reference_runs(module: str) -> None:
    """The pages of the API reference begin with it."""
    failed, attempted = doctest.testmod(importlib.import_module(module))
    assert attempted
    assert not failed


def test_every_page_of_the_api_reference_has_an_example() -> None:
    stub = (ROOT / "motor_env" / "__init__.pyi").read_text(encoding="utf-8")
    rooms = {match[1] for match in re.finditer(r"^from \.(\w+)", stub, re.MULTILINE)}
    pages = [f"motor_env.{room}" for room in rooms] + [
        "motor_env.envs",
        "motor_datasets",
        "motor_classifiers",
    ]
    assert [page for page in pages if ">>>" not in (importlib.import_module(page).__doc__ or "")] == []


@pytest.mark.parametrize("page", LINKING, ids=name)
def test_links_and_pictures_lead_to_what_a_clone_holds(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`|\$[^$\n]*\$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [link.split("#")[0] for link in LINK.findall(text)]
    there = [(page.parent / target).resolve() for target in targets if target]
    assert [path for path in there if not path.exists() or set(path.parents) & set(MADE_BY_THE_BUILD)] == []


def test_files_that_the_design_names_exist() -> None:
    text = (DOCS / "design.md").read_text(encoding="utf-8")
    files = re.findall(r"`((?:motor_env|datasets|classifiers)/[^`]*)`", text)
    assert len(files) > 40
    assert [file for file in files if not (ROOT / file).exists()] == []


@pytest.mark.parametrize("page", LINKING, ids=name)
def test_pictures_have_alternative_text(page: Path) -> None:
    assert re.findall(r"!\[\s*\]\([^)]*\)", page.read_text(encoding="utf-8")) == []


def test_the_prose_stays_short() -> None:
    """`make words` counts it by page."""
    prose = {group: counts[0] for group, counts in words.groups().items()}
    assert {group: prose[group] for group, limit in words.LIMITS.items() if prose[group] > limit} == {}
    assert len(words.results()) > 8


def test_navigation_lists_every_page_once() -> None:
    listed = []
    for page in PAGES:
        for tree in re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S):
            entries = [
                line
                for line in tree.splitlines()
                if line and not line.startswith((":", "api/", "environments/"))
            ]
            listed += [(page.parent / f"{entry}.md").resolve() for entry in entries]
    assert sorted(listed) == [page for page in PAGES if page.stem != "index"]
