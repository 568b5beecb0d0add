"""The import drawing of ARCHITECTURE.md: python docs/draw_imports.py writes docs/images/imports.svg.

The script reads the imports of `clsplat/` with `ast`. Each package is a box. The order of the boxes, from the bottom to
the top, is the package line of ARCHITECTURE.md. An arrow leads from the importing package to the imported one, and its
number counts imports from module to module. An arrow that points upward breaks the rule and is drawn in red.
"""

from __future__ import annotations

import ast
import math
import re
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parents[1]
DRAWING = ROOT / "docs" / "images" / "imports.svg"
# Every package may import these modules, so their arrows would hide the others.
BASE = ("errors", "_version", "activity")

BOX_WIDTH, BOX_HEIGHT, STEP = 324, 46, 74
LEFT, TOP = 24, 24
REACH = 50  # px: how far an arrow swings out for each box it passes
COLOURS = ("#4269d0", "#c77700", "#c7372f", "#3a8f8a", "#3ca951", "#d6457f", "#8a56c9", "#77624a")


@dataclass(frozen=True)
class Arrow:
    """All imports of one package by another.

    Attributes
    ----------
    source, target : the importing and the imported package.
    count : pairs of importing and imported module.
    """

    source: str
    target: str
    count: int


@cache
def modules() -> dict[str, Path]:
    """Return each module of the library by its dotted name below `clsplat`."""
    folder = ROOT / "clsplat"
    return {".".join(path.relative_to(folder).with_suffix("").parts): path for path in sorted(folder.rglob("*.py"))}


@cache
def imports_of(name: str, path: Path) -> set[str]:
    """Return the modules of the library that a module imports, at its top or inside a function."""
    known, found = modules(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = name.split(".")[: -node.level]
            target = ".".join([*base, *(node.module or "").split(".")]).strip(".")
            found |= {target} if target in known else {f"{target}.{alias.name}".strip(".") for alias in node.names}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            if any(full.split(".")[0].startswith("clsplat") for full in names):
                raise ValueError(f"{name}: import relatively")
    return found


def package_of(name: str) -> str:
    """Return the package of a module, or the module itself where it is in none."""
    return name.split(".")[0]


def package_line() -> list[str]:
    """Return the packages of ARCHITECTURE.md's package line, from left to right."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    line = re.search(r"^    (\w+(?:\s+< \w+)+(?:, \w+)*)$", text, re.M)
    if line is None:
        raise ValueError("ARCHITECTURE.md has no line 'package < package < ...'")
    return re.findall(r"\w+", line[1])


def arrows() -> list[Arrow]:
    """Return the imports between packages, without those of `BASE` and of the public names in `__init__`."""
    counts: Counter[tuple[str, str]] = Counter()
    for name, path in modules().items():
        if "." in name:
            counts.update((package_of(name), package_of(imported)) for imported in imports_of(name, path))
    return [
        Arrow(source, target, count)
        for (source, target), count in sorted(counts.items())
        if source != target and target not in BASE
    ]


def positions() -> dict[str, float]:
    """Return the height of each package's box centre [px]; the leftmost package of the line is at the bottom."""
    order = [package for package in package_line() if package not in BASE]
    return {package: TOP + BOX_HEIGHT / 2 + STEP * place for place, package in enumerate(reversed(order))}


def draw() -> str:
    """Return the drawing as SVG."""
    heights = positions()
    order = list(heights)
    drawn = arrows()
    reach = max(abs(order.index(arrow.source) - order.index(arrow.target)) for arrow in drawn)
    width = LEFT + BOX_WIDTH + math.ceil(0.75 * REACH * reach) + 40
    height = TOP * 2 + STEP * (len(order) - 1) + BOX_HEIGHT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="Helvetica, Arial, sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    layers = [_draw_arrow(arrow, order, heights) for arrow in sorted(drawn, key=lambda arrow: arrow.count)]
    parts += [arc for arc, _ in layers] + [count for _, count in layers]
    parts += [_draw_box(package, heights[package], COLOURS[i % len(COLOURS)]) for i, package in enumerate(order)]
    return "\n".join([*parts, "</svg>", ""])


def _draw_arrow(arrow: Arrow, order: list[str], heights: dict[str, float]) -> tuple[str, str]:
    """Draw an arc on the right of the boxes, and its count for the arc's farthest point."""
    start, end = order.index(arrow.source), order.index(arrow.target)
    colour = COLOURS[start % len(COLOURS)] if end > start else "#ff0000"
    x = LEFT + BOX_WIDTH
    # Arrows leave a box in its lower half and enter one in its upper half, the longest outermost.
    span = abs(end - start)
    offset = 2 + 18 * (1 - span / len(order))
    y0, y1 = heights[arrow.source] + offset, heights[arrow.target] - offset
    bulge = REACH * span
    thickness = 1 + 0.8 * math.log2(arrow.count)
    tip_x, middle = x + 0.75 * bulge, (y0 + y1) / 2
    path = f"M{x},{y0:.1f} C{x + bulge},{y0:.1f} {x + bulge},{y1:.1f} {x + 9},{y1:.1f}"
    head = f"M{x + 1},{y1:.1f} l10,-5 l0,10 z"
    box = 8 + 7 * len(str(arrow.count))
    arc = (
        f'<g><title>{arrow.source} imports {arrow.target}: {arrow.count}</title><path d="{path}" fill="none" '
        f'stroke="{colour}" stroke-width="{thickness:.1f}" stroke-opacity="0.75"/>'
        f'<path d="{head}" fill="{colour}"/></g>'
    )
    count = (
        f'<rect x="{tip_x - box / 2:.1f}" y="{middle - 8:.1f}" width="{box}" height="16" rx="4" fill="#ffffff"/>'
        f'<text x="{tip_x:.1f}" y="{middle + 4:.1f}" font-size="12" text-anchor="middle" fill="{colour}">'
        f"{arrow.count}</text>"
    )
    return arc, count


def _draw_box(package: str, centre: float, colour: str) -> str:
    """Draw a package with its name, the number of its modules and the first line of its docstring."""
    members = [name for name in modules() if package_of(name) == package and not name.endswith("__init__")]
    purpose = (
        ast.get_docstring(ast.parse((ROOT / "clsplat" / package / "__init__.py").read_text(encoding="utf-8"))) or ""
    )
    y = centre - BOX_HEIGHT / 2
    return (
        f'<rect x="{LEFT}" y="{y}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="7" fill="#ffffff" stroke="{colour}" '
        f'stroke-width="2"/><text x="{LEFT + 12}" y="{y + 19}" font-size="16" font-weight="bold" fill="{colour}">'
        f'{package}</text><text x="{LEFT + BOX_WIDTH - 12}" y="{y + 19}" font-size="12" text-anchor="end" '
        f'fill="#555555">{len(members)} modules</text><text x="{LEFT + 12}" y="{y + 37}" font-size="12" fill="#333333">'
        f"{escape(purpose.splitlines()[0] if purpose else '')}</text>"
    )


if __name__ == "__main__":
    DRAWING.parent.mkdir(exist_ok=True)
    DRAWING.write_text(draw(), encoding="utf-8")
    print(DRAWING.relative_to(ROOT))
