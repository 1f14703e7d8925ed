"""HTML pages by Jinja2, and charts as inline SVG, coloured by the page's CSS classes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


def render(
    package: str,
    template: str,
    *,
    filters: Mapping[str, Callable[..., str]] | None = None,
    **values: Any,
) -> str:
    """Render a template of a package's folder `templates`; it may extend `base.html.j2`.

    Args:
        package: import name of the package.
        template: file name of the template.
        filters: functions for the template.
        **values: variables of the template.
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


Point = tuple[float, float]
Values = Sequence[float] | NDArray[np.float64]


def percent(share: float) -> str:
    """Format a share in per cent, to three digits."""
    return f"{100 * share:.3g} %"


class Axis(NamedTuple):
    """Axis: title with unit, range, ticks and their text; `is_reversed` puts `low` at the right or top."""

    title: str
    low: float
    high: float
    ticks: Sequence[float] = ()
    number: Callable[[float], str] = "{:g}".format
    is_log: bool = False
    is_reversed: bool = False

    def place(self, value: float) -> float:
        """Scale a value from 0 at the begin to 1 at the end, limited to the axis."""
        low, high, at = self.low, self.high, min(max(value, self.low), self.high)
        if self.is_log:
            low, high, at = np.log([low, high, at])
        share = float((at - low) / max(high - low, 1e-9))
        return 1.0 - share if self.is_reversed else share


def round_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """List multiples of 1, 2 or 5 times a power of ten in a range, at most about `most`."""
    span = max(high - low, 1e-12)
    power = 10.0 ** np.floor(np.log10(span / most))
    step = next((power * f for f in (1.0, 2.0, 5.0) if span / (power * f) <= most), 10.0 * power)
    numbers = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return [float(value) for value in numbers * step + 0.0]  # no -0


class Chart:
    """SVG drawing with a plot area; `x` and `y` turn data into pixels, which shapes take.

    Args:
        x_axis: horizontal axis.
        y_axis: vertical axis, upwards.
        size: width and height in pixels.
        margins: pixels left, right, above and below the plot area.
        label: description for screen readers.
    """

    def __init__(
        self,
        x_axis: Axis,
        y_axis: Axis,
        *,
        size: Point,
        margins: tuple[float, float, float, float],
        label: str,
    ) -> None:
        left, right, top, bottom = margins
        self.x_axis, self.y_axis = x_axis, y_axis
        self.left, self.right, self.top, self.bottom = left, size[0] - right, top, size[1] - bottom
        view = f"0 0 {size[0]:g} {size[1]:g}"
        self._parts = [f'<svg viewBox="{view}" role="img" aria-label="{escape(label)}">']

    def x(self, value: float) -> float:
        """Convert to pixels from the left."""
        return self.left + (self.right - self.left) * self.x_axis.place(value)

    def y(self, value: float) -> float:
        """Convert to pixels from above."""
        return self.bottom - (self.bottom - self.top) * self.y_axis.place(value)

    def shape(self, tag: str, style: str = "", content: str = "", **attributes: float | str) -> None:
        """Add an element with attributes; `content` is markup."""
        named = "".join(
            f' {name}="{value if isinstance(value, str) else format(value, ".1f")}"'
            for name, value in attributes.items()
        )
        classes = f' class="{escape(style)}"' if style else ""
        self._parts.append(f"<{tag}{classes}{named}>{content}</{tag}>")

    @contextmanager
    def group(self, style: str, title: str = "") -> Iterator[None]:
        """Group shapes that share a style and a tooltip."""
        self._parts.append(f'<g class="{escape(style)}">' + _title(title))
        yield
        self._parts.append("</g>")

    def text(self, at: Point, content: str, style: str = "tick", anchor: str = "start") -> None:
        """Add a line of text; `anchor` is start, middle or end."""
        self.shape("text", style, escape(content), **{"text-anchor": anchor}, x=at[0], y=at[1])

    def line(self, style: str, begin: Point, end: Point) -> None:
        """Add a straight line."""
        self.shape("line", style, x1=begin[0], y1=begin[1], x2=end[0], y2=end[1])

    def dot(self, style: str, at: Point, radius: float, title: str = "") -> None:
        """Add a filled circle."""
        self.shape("circle", style, _title(title), cx=at[0], cy=at[1], r=radius)

    def curve(self, style: str, xs: Values, ys: Values) -> None:
        """Add a line through points given in data coordinates."""
        self.shape("polyline", style, points=self.points(xs, ys))

    def points(self, xs: Values, ys: Values) -> str:
        """Format points in data coordinates for SVG."""
        return " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in zip(xs, ys, strict=True))

    def across(self, style: str, y: float) -> None:
        """Add a horizontal line at a value."""
        self.line(style, (self.left, self.y(y)), (self.right, self.y(y)))

    def upright(self, style: str, x: float) -> None:
        """Add a vertical line at a value."""
        self.line(style, (self.x(x), self.top), (self.x(x), self.bottom))

    def x_numbers(self, *, grid: bool = False) -> None:
        """Add numbers below the ticks of the x axis."""
        for tick in self.x_axis.ticks:
            if grid:
                self.upright("grid", tick)
            self.text((self.x(tick), self.bottom + 18), self.x_axis.number(tick), anchor="middle")

    def y_numbers(self) -> None:
        """Add grid lines at the ticks of the y axis, and numbers beside them."""
        for tick in self.y_axis.ticks:
            self.across("grid", tick)
            self.text((self.left - 6, self.y(tick) + 4), self.y_axis.number(tick), anchor="end")

    def svg(self) -> str:
        """Return the markup."""
        return "".join(self._parts) + "</svg>"


def _title(text: str) -> str:
    return f"<title>{escape(text)}</title>" if text else ""
