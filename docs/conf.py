import re
import sys
import tomllib
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from api_pages import write_pages  # it lies beside this file

write_pages()

project = "motor-env"
author = "The motor-env contributors"
copyright = f"2026, {author}"
release = version = installed_version("motor-env")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "notebooks/*.ipynb"]  # whose pages beside them are run

myst_enable_extensions = ["colon_fence", "deflist", "substitution"]
# Where the project lies: [project.urls] of pyproject.toml, which has them from the first release on.
settings = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
urls = settings["project"].get("urls", {})
myst_substitutions = {
    name.lower(): urls.get(name, "not set before the first release") for name in ("Repository", "DOI")
}
myst_heading_anchors = 3
nb_execution_mode = "force"  # the notebooks run at every build; an error ends it
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
nb_output_stderr = "remove"  # what is said at a first use, such as how long compiling takes
autodoc_typehints_format = "short"
maximum_signature_line_length = 80
autodoc_member_order = "bysource"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "FloatArray", "Floats")}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature has the types
default_role = "py:obj"  # `KalmanFilter` in a docstring leads there

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = f"motor-env {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]


def plain_aliases(app, what, name, obj, options, signature, returned):  # noqa: ANN001, ANN201
    """Aliases of types by their names: Sphinx shows the objects that stand for them."""
    return tuple(
        part and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", part) for part in (signature, returned)
    )


def as_rst(app, what, name, obj, options, lines):  # noqa: ANN001, ANN201
    """Docstrings have headings of Markdown, names like `classes_` and |x| for a size."""
    for n, line in enumerate(lines):
        if line.startswith("## "):
            lines[n] = f"**{line[3:]}**\n"
        elif ">>>" not in line:
            lines[n] = re.sub(r"(?<![`\w])(\w+)_(?=[:,. ;)]|$)", r"\1\\_", line).replace("|", r"\|")


def whole_sentence(app, what, name, obj, options, lines):  # noqa: ANN001, ANN201
    """Napoleon takes the words before a colon in the first line of a property for its type."""
    if what == "property" and lines and lines[-1].startswith(":type: "):
        lines[0] = f"{lines.pop().removeprefix(':type: ')}: {lines[0]}"


def left_out(app, what, name, obj, skip, options):  # noqa: ANN001, ANN201, D103
    return True if re.fullmatch("set_.*_request", name) else None  # scikit-learn's own


def setup(app):  # noqa: ANN001, ANN201, D103
    app.connect("autodoc-process-signature", plain_aliases)
    app.connect("autodoc-process-docstring", as_rst, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", whole_sentence, priority=600)  # after it
    app.connect("autodoc-skip-member", left_out)
