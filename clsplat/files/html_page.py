"""A report as one HTML page without other files: inlined SVG charts, tables, and the caller's markup."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from ..errors import InputError
from .atomic import atomic_writer


@dataclass(frozen=True)
class Section:
    """A heading and its content, in the order of these fields.

    Parameters
    ----------
    title : the heading.
    text : paragraphs.
    chart : an SVG file.
    head, lines : a table: its column names and its rows of cells.
    files : links, relative to the page.
    markup : HTML that is inserted unchanged below the table.
    """

    title: str
    text: Sequence[str] = ()
    chart: Path | None = None
    head: Sequence[str] = ()
    lines: Sequence[Sequence[str]] = ()
    files: Sequence[str] = ()
    markup: str = ""


def write_page(path: Path, title: str, sections: Sequence[Section], style: str = "", script: str = "") -> Path:
    """Write the page and return its path.

    Parameters
    ----------
    style, script : CSS and JavaScript for the sections' markup.

    Raises
    ------
    InputError : a chart cannot be read.
    OutputError : the page cannot be written.
    """
    body = "".join(_section(section, number) for number, section in enumerate(sections, 1))
    style = package_text(__package__, "page.css") + style
    page = (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n{body}"
        + (f"<script>\n{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )
    with atomic_writer(path) as stream:
        stream.write(page.encode(errors="backslashreplace"))  # a file name may be no UTF-8
    return path


def _section(section: Section, number: int) -> str:
    parts = [f"<h2>{escape(section.title)}</h2>\n"]
    parts += [f"<p>{escape(paragraph)}</p>\n" for paragraph in section.text]
    if section.chart is not None:
        parts.append(f"<figure>{_inlined(section.chart, section.title, number)}</figure>\n")
    if section.lines:
        parts.append(_table(section.head, section.lines))
    parts.append(section.markup)
    if section.files:
        links = ", ".join(f'<a href="{escape(name)}">{escape(name)}</a>' for name in section.files)
        parts.append(f'<p class="files">Data: {links}</p>\n')
    return "".join(parts)


def _inlined(path: Path, title: str, number: int) -> str:
    """Return the SVG without its prologue, with a name for screen readers and ids that are unique on the page."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}): draw the chart again") from None
    drawing = text[max(text.find("<svg"), 0) :].strip()
    drawing = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>c{number}-", drawing)
    drawing = re.sub(r"<metadata>.*?</metadata>", "", drawing, flags=re.S)
    return drawing.replace("<svg", f'<svg role="img" aria-label="{escape(title)}"', 1)


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    # Columns of words are aligned to the left, columns of numbers to the right.
    words = [any(re.match(r"[^\W\d_]", line[column]) for line in lines) for column in range(len(head))]

    def row(tag: str, cells: Sequence[str]) -> str:
        return (
            "<tr>"
            + "".join(
                f"<{tag}{' class=text' if word else ''}>{escape(cell)}</{tag}>"
                for cell, word in zip(cells, words, strict=True)
            )
            + "</tr>\n"
        )

    body = "".join(row("td", line) for line in lines)
    return f'<div class="table"><table>\n{row("th", head)}{body}</table></div>\n'


def package_text(package: str, name: str) -> str:
    """Return the text of a file that lies among a package's modules."""
    return files(package).joinpath(name).read_text("utf-8")


def escape(text: str) -> str:
    """Return text escaped for HTML, attributes included."""
    return html.escape(text)
