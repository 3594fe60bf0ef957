"""The parts a report is made of, and the page of them: one HTML file that needs no other (page.html.jinja).

Sections say what is in a part; how it looks is in the template alone, which escapes every text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from matplotlib.figure import Figure

from thermostand.compensation.reporting.drawing.drawing import Draw, one_by_one


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading; 1 is the page's own."""

    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph; an aside is grey."""

    text: str
    aside: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table of numbers, texts already formatted; row `chosen` is bold, one of a first cell only heads those below
    it."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    chosen: int | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and what belongs to them, a line each."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Listing:
    """Lines that stand as they are, all letters of one width."""

    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure with its caption; `name` begins its ids, so that several fit in one page."""

    figure: Figure
    name: str
    caption: str


Part = Heading | Paragraph | Listing | Table | Facts | Drawing


def page(title: str, parts: Sequence[Part], draw: Draw = one_by_one) -> str:
    """A whole HTML page."""
    svg = iter(draw([(part.figure, part.name) for part in parts if isinstance(part, Drawing)]))
    named = [(type(part).__name__, part, next(svg) if isinstance(part, Drawing) else "") for part in parts]
    return _template().render(title=title, parts=named)


@cache
def _template() -> Template:
    loader = PackageLoader("compensation", "reporting")
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return made.get_template("page.html.jinja")
