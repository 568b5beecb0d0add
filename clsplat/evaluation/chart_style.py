"""Looks and files of every chart. This is the only module that imports matplotlib.

The colours can be distinguished with the common kinds of colour blindness (Okabe and Ito 2008, the yellow darkened).
Each shape has one colour and one marker, the same in every chart. The same data give the same bytes.
"""

from __future__ import annotations

import colorsys
import importlib.util
import io
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..errors import OutputError
from ..files.atomic import atomic_writer
from ..splats.shapes import SHAPES

Label = tuple[float, float, str, str]  # x, y, text, colour
Box = tuple[float, float, float, float]  # left, bottom, right, top
MISSING = "charts need matplotlib: install it with pip install 'clsplat[charts]'"
FORMATS = ("png", "svg")
WIDTH = 9.0  # inches of a full chart: 900 px in a README at 100 dots per inch
INK, FAINT, FRONT, MARK = "#262626", "#d9d9d9", "#c4c4c4", "#d55e00"
# Shapes of one family have colours of one family.
_COLOURS = ("#262626", "#0072b2", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#e69f00", "#8c8c1e")
_CATEGORIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8c8c1e", "#56b4e9", "#e69f00", "#262626")
_MARKERS = ("o", "s", "D", "^", "v", "P", "X", "h")
_MORE_MARKERS = ("<", ">", "p", "*", "8", "d", "H")  # of shapes beyond these
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1, 1.3)), (0, (6, 1.3, 1, 1.3)), (0, (3, 1.2, 1, 1.2, 1, 1.2)))
_LEGEND_COLUMNS = 4
# Positions of a label beside its point: across in units of 6 points, up in units of 8. The first ones are above and to
# the left, because no point of a Pareto front lies there.
_SPOTS = ((-1.0, 0.7), (0.0, 1.2), (-1.0, 0.0), (1.0, -0.7), (1.0, 0.7), (1.0, 0.0), (0.0, -1.2), (-1.0, -0.7))
_STYLE = {
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "font.family": "DejaVu Sans",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#8c8c8c",
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "legend.frameon": False,
    "svg.hashsalt": "clsplat",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


@contextmanager
def drawing(out: str | Path, width: float = WIDTH, height: float = 4.0) -> Iterator[Any]:
    """An empty figure to draw on. Its files `out`.png and `out`.svg are written if the block ends without an error.

    Parameters
    ----------
    out : path without a suffix, or with one of the two suffixes.
    width, height : size [inches]; 100 dots an inch on a page, 200 in the PNG.

    Raises
    ------
    OutputError : matplotlib is not installed, or a file cannot be written.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise OutputError(MISSING) from None
    style: Any = dict(matplotlib.rcParamsDefault)
    with matplotlib.rc_context(style | _STYLE | {"backend": "agg"}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        _settle(figure)
        for path in chart_paths(out):
            content = io.BytesIO()
            kind = path.suffix[1:]
            figure.savefig(content, format=kind, metadata={"Date": None} if kind == "svg" else {"Software": None})
            with atomic_writer(path) as stream:
                stream.write(content.getvalue())


def chart_paths(out: str | Path) -> list[Path]:
    """The files of the chart `out`: PNG and SVG."""
    path = Path(out)
    stem = path.with_suffix("") if path.suffix[1:] in FORMATS else path
    return [stem.with_name(f"{stem.name}.{kind}") for kind in FORMATS]


def shape_colour(shape: str) -> str:
    """Colour of a shape: a fixed one for the first eight, others by their names; INK for an unknown shape."""
    return _shape_style(shape, _COLOURS, INK) or _hashed_colour(shape)


def shape_marker(shape: str) -> str:
    """Marker of a shape, by the same rule; a circle for an unknown shape."""
    return _shape_style(shape, _MARKERS, "o") or _MORE_MARKERS[_hash(shape) % len(_MORE_MARKERS)]


def category_colour(index: int) -> str:
    """Colour of a category that is not a shape."""
    return _CATEGORIES[index % len(_CATEGORIES)]


def looks(methods: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Keywords of `Axes.plot` for each method.

    A method has the colour and the marker of its shape. Methods of one shape differ in their dashes.

    Parameters
    ----------
    methods : the shape of each method, by label.
    """
    count: dict[str, int] = {}
    keywords = {}
    # The method that has its shape's name gets the plain line.
    for label, shape in sorted(methods.items(), key=lambda item: item[0] != item[1]):
        index = count.setdefault(shape, 0)
        count[shape] += 1
        keywords[label] = {
            "color": shape_colour(shape),
            "marker": shape_marker(shape),
            "linestyle": _DASHES[index % len(_DASHES)],
            "markerfacecolor": shape_colour(shape) if index % 2 == 0 else "white",
            "markeredgecolor": shape_colour(shape),
        }
    return {label: keywords[label] for label in methods}


def _shape_style(shape: str, styles: Sequence[str], unknown: str) -> str:
    """A style for each of the first shapes; empty for a further one."""
    if shape not in SHAPES:
        return unknown
    place = list(SHAPES).index(shape)
    return styles[place] if place < len(styles) else ""


def _hash(name: str) -> int:
    """A number that is the same for a name in every process."""
    return zlib.crc32(name.encode())


def _hashed_colour(name: str) -> str:
    """A colour of any hue, with a lightness that shows on white."""
    red, green, blue = colorsys.hls_to_rgb(_hash(name) % 360 / 360.0, 0.4, 0.6)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"


def short_count(number: float, _: object = None) -> str:
    """A number for ticks and labels, such as 950, 1k, 2.5k, 1M."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(number) >= 0.9995 * unit:
            return f"{number / unit:.3g}{letter}"
    return f"{number:.3g}"


def log_axis(axis: Any, low: float, high: float) -> None:
    """Set ticks at 1, 2 and 5 of each decade, written by `short_count`; over many decades at 1 alone.

    Parameters
    ----------
    axis : `Axes.xaxis` or `yaxis`, on a logarithmic scale.
    low, high : range of the axis.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    marks = (1.0,) if high / low > 1e3 else (1.0, 2.0, 5.0) if high / low > 2.5 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
    ticks = [mark * 10.0**power for power in range(-9, 13) for mark in marks if low <= mark * 10.0**power <= high]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(short_count))


def tile(corner: tuple[float, float], fill: str, label: str | None = None) -> Any:
    """A unit square: a cell of a table, or with a label an entry of a legend."""
    from matplotlib.patches import Rectangle

    return Rectangle(corner, 1, 1, facecolor=fill, edgecolor=FAINT if label else "white", linewidth=1.2, label=label)


def system_legend(figure: Any, styles: dict[str, dict[str, Any]]) -> None:
    """Draw a legend of all methods below the panels. styles : what `looks` returned."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), _LEGEND_COLUMNS), handlelength=3)


def legend_rows(entries: int) -> int:
    """Number of lines of a legend, each about 0.2 inches high."""
    return -(-entries // _LEGEND_COLUMNS)


def place_labels(figure: Any, labels: Sequence[tuple[Any, Sequence[Label]]], *, size: float = 7.5) -> None:
    """Write labels beside points, where they cover no curve, point or other label.

    A label without room is left out. Call this last, because it fixes the layout.

    Parameters
    ----------
    labels : axes and the labels on them, the most important first.
    size : of the letters [points].
    """
    _settle(figure)
    for axes, points in labels:
        _place(axes, points, size, figure.dpi / 72)


def _settle(figure: Any) -> None:
    """Fix the layout, so that it is not computed again for each file."""
    if figure.get_constrained_layout():
        figure.draw_without_rendering()
        figure.set_layout_engine("none")


def _place(axes: Any, points: Sequence[Label], size: float, dot: float) -> None:
    """Place the labels of one panel. `dot` is the size of a point [px]."""
    box, near = axes.bbox, 3 * dot
    marked = [line for line in axes.lines if line.get_marker() not in ("None", "", None)]
    taken = [(x - near, y - near, x + near, y + near) for line in marked for x, y in _pixels(line, near)]
    for x, y, text, colour in points:
        at_x, at_y = axes.transData.transform((x, y))
        width, height = 0.62 * size * len(text) * dot, 1.05 * size * dot
        for across, up in _SPOTS:
            left = at_x + across * 6 * dot - width * (1 - min(max(across, -1), 1)) / 2
            bottom = at_y + up * 8 * dot - height / 2
            spot = (left, bottom, left + width, bottom + height)
            inside = box.x0 <= left and spot[2] <= box.x1 and box.y0 <= bottom and spot[3] <= box.y1
            if inside and not any(_overlap(spot, other) for other in taken):
                axes.annotate(
                    text,
                    (x, y),
                    (across * 6, up * 8),
                    textcoords="offset points",
                    color=colour,
                    va="center",
                    ha="center" if abs(across) < 1 else "left" if across > 0 else "right",
                    fontsize=size,
                )
                taken.append(spot)
                break


def _pixels(line: Any, step: float) -> list[tuple[float, float]]:
    """Positions on a line, at most `step` pixels apart; for a line without strokes its points."""
    path = line.get_path()
    corners = line.get_transform().transform(path.vertices).tolist()
    found = [(x, y) for x, y in corners]
    if line.get_linestyle() != "None":
        for (x, y), (next_x, next_y) in pairwise(corners):
            parts = int(math.hypot(next_x - x, next_y - y) // step) + 1
            found += [(x + (next_x - x) * n / parts, y + (next_y - y) * n / parts) for n in range(1, parts)]
    return found


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
