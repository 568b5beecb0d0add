"""Renders the docstrings of clsplat's public names: python docs/api.py FOLDER [--overwrite].

It needs pdoc: pip install "clsplat[docs]".
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import clsplat
from clsplat.errors import OutputError
from clsplat.files.existing import refuse_existing

_HEADING = re.compile(r"^([A-Z]\w+)\n-{3,}\n", re.M)
# Several may stand on a line: "width, height : of the image [px]. focal : ..."
_ITEM = re.compile(r"(?:^|(?<=[.;] ))([A-Za-z_*][\w.,* ]{0,60}?) : ")


def render(folder: Path, overwrite: bool = False) -> Path:
    """Write the pages; returns the first."""
    refuse_existing([folder / page for page in ("clsplat.html", "index.html", "search.js")], overwrite)
    try:
        import pdoc
        from pdoc import docstrings
    except ImportError:
        sys.exit('error: pdoc is not installed: pip install "clsplat[docs]"')
    for name in clsplat.__all__:  # they load on first use, which pdoc does not ask for
        vars(clsplat)[name] = getattr(clsplat, name)
    docstrings.numpy = markdown_of  # NumPy's sections, but with several items to a line
    pdoc.render.configure(docformat="numpy", show_source=False, footer_text=f"clsplat {clsplat.__version__}")
    pdoc.pdoc("clsplat", output_directory=folder)
    return folder / "clsplat.html"


def markdown_of(docstring: str) -> str:
    """A docstring with its sections as lists."""
    head, *sections = _HEADING.split(docstring)
    parts = [head.strip()]
    for title, text in zip(sections[::2], sections[1::2], strict=True):
        entries = [" ".join(entry.split()) for entry in re.split(r"\n(?=\S)", text.strip())]
        items = [_ITEM.sub(r"\n- **\1**: ", entry).strip() for entry in entries]
        parts.append(f"*{title}*\n\n" + "\n".join(item if item.startswith("- ") else f"- {item}" for item in items))
    return "\n\n".join(parts)


if __name__ == "__main__":
    folders = [word for word in sys.argv[1:] if word != "--overwrite"]
    if len(folders) != 1:
        sys.exit("usage: python docs/api.py FOLDER [--overwrite]")
    try:
        print(render(Path(folders[0]), "--overwrite" in sys.argv))
    except OutputError as error:
        sys.exit(f"error: {error}")
