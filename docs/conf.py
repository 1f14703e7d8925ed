from importlib.metadata import version as installed_version

project = "motor-env"
author = "The motor-env contributors"
copyright = f"2026, {author}"
release = version = installed_version("motor-env")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"motor-env {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
