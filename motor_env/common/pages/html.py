"""Render text from Jinja2 templates: HTML is escaped, a missing value is an error, a page needs no other file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


def render(
    package: str,
    template: str,
    *,
    filters: Mapping[str, Callable[..., str]] | None = None,
    **values: Any,
) -> str:
    """Render a template of a package's folder `templates`; it may extend `base.html.j2`, which holds the common style.

    Args:
        package: import name of the package.
        template: file name of the template.
        filters: functions that the template applies to its values.
        **values: what the template names.
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("motor_env.common.pages")]),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters or {}
    return environment.get_template(template).render(values)
