"""The few HTML parts a report is made of: a page that needs no other file, tables, figures. Texts are escaped here."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_CSS = """
body {
  font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 56rem; margin: 2rem auto; padding: 0 1.2rem;
}
h1 { font-size: 1.6rem; line-height: 1.2; margin-bottom: .2rem }
h2 { font-size: 1.15rem; margin-top: 2.2rem }
p.aside { color: #555; margin-top: 0 }
table { border-collapse: collapse; margin: .6rem 0 }
th, td { padding: .2rem .9rem .2rem 0; text-align: right; font-variant-numeric: tabular-nums }
th:first-child, td:first-child { text-align: left }
td:not(:first-child) { white-space: nowrap }
thead th { border-bottom: 1px solid #999 }
table.facts td { text-align: left; vertical-align: top; white-space: normal }
table.facts td:first-child { white-space: nowrap; color: #555 }
tr.chosen td { font-weight: 600 }
figure { margin: 1.2rem 0 }
figure svg { width: 100%; height: auto; display: block }
figcaption { color: #555; font-size: .92rem }
"""


def page(title: str, parts: Sequence[str]) -> str:
    """A whole HTML page of finished parts."""
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{_CSS}</style>\n</head>\n<body>\n{body}\n'
        "</body>\n</html>\n"
    )


def heading(text: str, level: int = 2) -> str:
    """A heading."""
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, *, aside: bool = False) -> str:
    """A paragraph; an aside is grey."""
    return f"<p{' class=aside' if aside else ''}>{escape(text)}</p>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], chosen: int | None = None) -> str:
    """A table of numbers, texts already formatted; row `chosen` is bold."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "\n".join(_row(row, index == chosen) for index, row in enumerate(rows))
    return f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"


def _row(cells: Sequence[str], chosen: bool) -> str:
    return f"<tr{' class=chosen' if chosen else ''}>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """Names and what belongs to them, a line each."""
    lines = (f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows)
    return '<table class="facts">' + "\n".join(lines) + "</table>"


def figure(svg: str, caption: str) -> str:
    """An SVG element with its caption."""
    return f"<figure>\n{svg}<figcaption>{escape(caption)}</figcaption>\n</figure>"
